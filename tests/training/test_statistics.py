"""What is said of training episodes, of several processes together, too."""

from __future__ import annotations

from franka_wm.training.episode_statistics import described, of_all


def test_statistics_of_several_processes_are_means_over_their_episodes() -> None:
    """Success of a task by that task's episodes: here 1 of 1 and 0 of 3."""
    found = of_all(
        [
            {"episodes": 9, "success": 1.0, "success/lift": 1.0, "episodes/lift": 1, "overflow": 2},
            {"episodes": 3, "success": 0.0, "success/lift": 0.0, "episodes/lift": 3, "overflow": 1},
            {"episodes": 0, "overflow": 0},
        ]
    )
    assert found == {"episodes": 12, "success": 0.75, "success/lift": 0.25, "episodes/lift": 4, "overflow": 3}


def test_in_words() -> None:
    assert described({"episodes": 0.0}) == "", "means over nothing are not 0"
    assert described({"episodes": 2.0, "return": 1.234, "nonfinite": 0.0}) == "return 1.23"
    told = described({"episodes": 2.0, "return": 1.0, "success": 0.5, "nonfinite": 3.0, "overflow": 4.0})
    assert told == (
        "return 1.00   success 50 %   3 worlds broke and were reset   "
        "4 times too little room for contacts (env.max_contacts)"
    )
    assert described({"episodes": 0.0, "nonfinite": 3.0}) == "3 worlds broke and were reset"
