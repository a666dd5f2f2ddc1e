"""What a run leaves at its end: one table, whose numbers are the last point of the curves, drawn and logged."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from matplotlib.axes import Axes

from franka_wm.evaluation.protocol import evaluate_run
from franka_wm.evaluation.results import END, read_result
from franka_wm.policies.scripted import NoopPolicy
from franka_wm.report.end_of_run import report_run


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
