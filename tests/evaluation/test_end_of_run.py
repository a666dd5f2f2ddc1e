"""What a run leaves at its end: one table, whose numbers are the last point of the curves, drawn and logged."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from matplotlib.axes import Axes
from tensordict import TensorDict

from franka_wm.evaluation.protocol import evaluate_run
from franka_wm.evaluation.results import END, read_result
from franka_wm.policies.scripted import NoopPolicy
from franka_wm.report.end_of_run import endings, report_run
from franka_wm.video import draw_labels


@pytest.mark.parametrize("during", [["policy"], []])
def test_the_table_is_the_curves_last_point(
    during: list[str], small_env, settled, tmp_path: Path, monkeypatch
) -> None:
    env = small_env(3, episode_length=4, goal_sampling="reachable", success_distance=0.4)
    shown = f"evaluation.during=[{','.join(during)}]"
    cfg = settled("seed=7", shown, "evaluation.video_episodes=0")
    before = {"eval/policy/final_distance": 0.9, "eval/policy/success": 0.1, "env_steps": 50, "updates": 5}
    drawn: dict[tuple[int, str], tuple[list[float], list[float]]] = {}
    plot, logged = Axes.plot, []

    def record(self, xs, ys, **kwargs):
        drawn[self.figure.axes.index(self), kwargs["label"]] = (list(xs), list(ys))
        return plot(self, xs, ys, **kwargs)

    monkeypatch.setattr(Axes, "plot", record)
    counters = {"updates": 9, "env_steps": 120, "seconds": 3.5}
    policies = {"policy": NoopPolicy(), "noop": NoopPolicy()}
    results = evaluate_run(cfg, tmp_path, env, policies, counters=counters, say=lambda text: None)
    report_run(cfg, tmp_path, env, policies, results, rows=[before], log=logged.append)
    found = read_result(tmp_path / "evaluation.json")
    assert json.loads((tmp_path / "evaluation.json").read_text())["policies"] == results.policies
    assert found.told == f"{END}, 3 episodes" and found.protocol["seed"] == 7
    assert [found.protocol[k] for k in ("updates", "env_steps", "training_seconds")] == [9, 120, 3.5]
    table = found.policies["policy"]
    distance, success = table["final_distance"]["mean"], table["success"]["0.4"]["mean"]
    assert 0 < success < 1
    if during:
        assert drawn[0, "policy"] == ([50, 120], pytest.approx([90.0, 100 * distance]))
        assert drawn[1, "policy"] == ([50, 120], pytest.approx([10.0, 100 * success]))
        numbers = {"final_distance": distance, "success": success, "return": table["return"]["mean"]}
        assert logged == [{f"eval/policy/{name}": value for name, value in numbers.items()}]
    else:  # no curve was asked for
        assert drawn[0, "policy"][0] == [50] and logged == []


def test_the_video_says_whose_episodes_it_shows_and_how_they_ended(small_env) -> None:
    arm = small_env(1, success_distance=0.05)
    near = TensorDict(
        {"final_distance": torch.tensor([0.021, 0.3]), "return": torch.tensor([-1.0, -9.0])}, [2]
    )
    assert endings(near, "planner", arm) == [
        "planner, 2.1 cm, success",
        "planner, 30.0 cm, no success, worst",
    ]
    other = TensorDict({"success": torch.tensor([0.0, 1.0]), "return": torch.tensor([-1.0, 3.0])}, [2])
    assert endings(other, "policy", arm) == ["policy, no success, worst", "policy, success"]
    assert endings(near[:1], "ik", arm) == ["ik, 2.1 cm, success"]


@pytest.mark.parametrize("size", [96, 256])
def test_labels_fit_their_pictures(size: int) -> None:
    frames = torch.full((3, 2, size, size, 3), 20, dtype=torch.uint8)
    labelled = draw_labels(frames, ["planner, 30.0 cm, no success, worst", "ik"])
    assert (frames == 20).all() and labelled.shape == frames.shape
    assert (labelled[0] == labelled[2]).all() and (labelled[:, :, size // 2 :] == 20).all()
    bright = labelled[0].float().mean(-1) > 80
    assert bright[0].any(0).sum() > bright[1].any(0).sum() > 0  # more columns are written on by a longer line
    assert not bright[0, :, -2:].any()  # and it ends before its picture does
