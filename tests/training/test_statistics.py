"""What several processes say together of their episodes."""

from __future__ import annotations

from franka_wm.training.trainer import _of_all


def test_statistics_of_several_processes_are_means_over_their_episodes() -> None:
    """Success of a task by that task's episodes: here 1 of 1 and 0 of 3."""
    found = _of_all(
        [
            {"episodes": 9, "success": 1.0, "success/lift": 1.0, "episodes/lift": 1, "overflow": 2},
            {"episodes": 3, "success": 0.0, "success/lift": 0.0, "episodes/lift": 3, "overflow": 1},
            {"episodes": 0, "overflow": 0},
        ]
    )
    assert found == {"episodes": 12, "success": 0.75, "success/lift": 0.25, "episodes/lift": 4, "overflow": 3}
