"""Which of two results of a run is shown, and which may take another's place."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from franka_wm.commands.evaluate import check_larger
from franka_wm.errors import UserError
from franka_wm.evaluation.results import COMMAND, END, results
from franka_wm.training import load


def write(folder: Path, by: str, episodes: int, **protocol: Any) -> None:
    folder.mkdir(exist_ok=True)
    found = {"protocol": {"by": by, **protocol}, "policies": {"planner": {"episodes": episodes}}}
    (folder / "evaluation.json").write_text(json.dumps(found))


def shown(run: Path) -> list[str]:
    return [one.told for one in results(run)]


def test_later_weights_come_before_more_episodes(tmp_path: Path) -> None:
    """A checkpoint of half the training over 500 episodes does not hide what became of the run."""
    write(tmp_path, END, 100, updates=4000)
    write(tmp_path / "evaluation", COMMAND, 500, updates=2000)
    end = "the end of training, 100 episodes after 4,000 updates"
    assert shown(tmp_path) == [end, "franka-wm evaluate, 500 episodes after 2,000 updates"]
    write(tmp_path / "evaluation", COMMAND, 500, updates=4000)
    assert shown(tmp_path) == ["franka-wm evaluate, 500 episodes after 4,000 updates", end]
    write(tmp_path / "evaluation", COMMAND, 500)
    assert shown(tmp_path) == ["franka-wm evaluate, 500 episodes", end]
    write(tmp_path / "evaluation", COMMAND, 100, updates=4000)
    assert shown(tmp_path)[1] == end


def test_a_result_of_earlier_weights_may_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    updates = {"now": 4000}
    monkeypatch.setattr(
        load, "find_checkpoint", lambda _: SimpleNamespace(counters={"updates": updates["now"]})
    )
    write(tmp_path, COMMAND, 500, updates=2000)
    check_larger(tmp_path, 100, "run")
    for updates["now"] in (2000, 1000):
        check_larger(tmp_path, 500, "run")
        with pytest.raises(UserError, match="holds a result of 500 episodes, which one of 100 would replace"):
            check_larger(tmp_path, 100, "run")
