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
from franka_wm.policies.scripted import NoopPolicy, SmoothRandomPolicy
from franka_wm.report import end_of_run
from franka_wm.report.end_of_run import ending, report_run, worst
from franka_wm.training import build
from franka_wm.video import draw_labels


@pytest.mark.parametrize("during", [["planner", "policy"], ["policy"], []])
def test_the_table_is_the_curves_last_point(
    during: list[str], small_env, settled, tmp_path: Path, monkeypatch
) -> None:
    env = small_env(3, episode_length=4, goal_sampling="reachable", success_distance=0.4)
    shown = f"evaluation.during=[{','.join(during)}]"
    cfg = settled("seed=7", shown, "evaluation.video_episodes=0")
    before = {"eval/policy/final_distance": 0.9, "eval/policy/success": 0.1, "env_steps": 50, "updates": 5}
    before |= {"eval/planner/final_distance": 0.9, "eval/planner/success": 0.1}
    drawn: dict[tuple[int, str], tuple[list[float], list[float]]] = {}
    plot, logged = Axes.plot, []

    def record(self, xs, ys, **kwargs):
        drawn[self.figure.axes.index(self), kwargs["label"]] = (list(xs), list(ys))
        return plot(self, xs, ys, **kwargs)

    monkeypatch.setattr(Axes, "plot", record)
    counters = {"updates": 9, "env_steps": 120, "seconds": 3.5}
    policies = {"planner": NoopPolicy(), "policy": NoopPolicy(), "noop": NoopPolicy()}
    results = evaluate_run(cfg, tmp_path, env, policies, counters=counters, say=lambda text: None)
    report_run(cfg, tmp_path, env, policies, results, rows=[before], log=logged.append)
    found = read_result(tmp_path / "evaluation.json")
    assert json.loads((tmp_path / "evaluation.json").read_text())["policies"] == results.policies
    assert found.told == f"{END}, 3 episodes after 9 updates" and found.protocol["seed"] == 7
    assert found.protocol["planner"] == cfg.planner.label
    assert [found.protocol[k] for k in ("updates", "env_steps", "training_seconds")] == [9, 120, 3.5]
    numbers = {}
    for policy in during:
        table = found.policies[policy]
        distance, success = table["final_distance"]["mean"], table["success"]["0.4"]["mean"]
        assert 0 < success < 1
        assert drawn[0, policy] == ([50, 120], pytest.approx([90.0, 100 * distance]))
        assert drawn[1, policy] == ([50, 120], pytest.approx([10.0, 100 * success]))
        of = {"final_distance": distance, "success": success, "return": table["return"]["mean"]}
        numbers |= {f"eval/{policy}/{name}": value for name, value in of.items()}
    assert logged == ([numbers] if during else [])
    for policy in {"planner", "policy"} - {*during}:  # no curve was asked for
        assert drawn[0, policy][0] == [50]


def test_the_video_shows_the_worst_episodes_again(settled, tmp_path: Path, monkeypatch, capsys) -> None:
    """Of a policy that draws: the same poses and the same draws, so the same ends."""
    few = ("env.substeps=1", "env.episode_length=6", "evaluation.episodes=5", "evaluation.video_episodes=2")
    cfg = settled("scale=smoke", "device=cpu", *few)
    env = build.make_evaluation_env(cfg)
    generator = torch.Generator().manual_seed(3)
    policies = {"policy": SmoothRandomPolicy(7, generator=generator), "noop": NoopPolicy(7)}
    results = evaluate_run(cfg, tmp_path, env, policies, counters={}, say=lambda text: None)
    said: list[str] = []
    placed, place = [], end_of_run.whole_arm
    monkeypatch.setattr(end_of_run, "whole_arm", lambda *of: (placed.append(of), place(*of))[1])
    monkeypatch.setattr(end_of_run, "draw_labels", lambda frames, lines: said.extend(lines) or frames)
    report_run(cfg, tmp_path, env, policies, results, rows=[])
    assert "filming the policy …" in capsys.readouterr().out
    assert len(placed) == 1  # it takes longer than an image does
    distances = results.episodes["policy"]["final_distance"]
    order = distances.argsort(descending=True)[:2].tolist()
    assert said == [f"policy, {100 * float(distances[k]):.1f} cm, no success, episode {k + 1}" for k in order]
    assert (tmp_path / "video.mp4").stat().st_size > 1000


def test_of_an_episode_that_ends_early_the_video_shows_no_other(settled, tmp_path: Path, monkeypatch) -> None:
    """Its last frame stands still until the longest beside it has ended."""
    few = ("env.substeps=1", "env.episode_length=8", "evaluation.episodes=4", "evaluation.video_episodes=4")
    ends = ("env.terminate_on_success=true", "env.success_distance=0.25", "evaluation.video_size=32")
    cfg = settled("scale=smoke", "device=cpu", *few, *ends)
    env = build.make_evaluation_env(cfg)
    policies = {"policy": build.make_scripted_policies(env)["ik"]}
    results = evaluate_run(cfg, tmp_path, env, policies, counters={}, say=lambda text: None)
    shown: list[torch.Tensor] = []
    monkeypatch.setattr(end_of_run, "draw_labels", lambda frames, lines: shown.append(frames) or frames)
    report_run(cfg, tmp_path, env, policies, results, rows=[])
    rows = results.episodes["policy"]
    lengths = rows["length"].int().tolist()
    assert 1 < min(lengths) < max(lengths)
    frames = shown[0]
    assert len(frames) == max(lengths) + end_of_run._slow(cfg.env.arm.fps)
    for beside, number in enumerate(worst(rows, 4)):
        moved = (frames[1:, beside] != frames[:-1, beside]).flatten(1).any(1)
        assert moved.tolist() == [k < lengths[number] - 1 for k in range(len(moved))]


def test_of_several_tasks_the_worst_episodes_of_each_are_shown(settled, tmp_path: Path, monkeypatch) -> None:
    """The very episodes: they have the same returns. Each task is played at its own rate."""
    left_out = [f"~env.tasks.{name}" for name in ("track", "lift", "pick", "stack", "drawer", "peg")]
    lengths = {"reach": 4, "push": 6}
    short = [
        f"env.tasks.{name}.{key}"
        for name, n in lengths.items()
        for key in (f"episode_length={n}", "substeps=1")
    ]
    few = ("evaluation.episodes=5", "evaluation.video_episodes=6", "evaluation.video_size=32")
    slower = "env.tasks.reach.fps=20"  # a push at 30 Hz beside it
    cfg = settled("scale=smoke", "device=cpu", "env=multitask", *left_out, *short, *few, slower)
    env = build.make_evaluation_env(cfg)
    policies = {"policy": SmoothRandomPolicy(8, generator=torch.Generator().manual_seed(3))}
    results = evaluate_run(cfg, tmp_path, env, policies, counters={}, say=lambda text: None)
    rows = results.episodes["policy"]
    said, shown, returns, play = [], [], [], end_of_run.play_episodes
    monkeypatch.setattr(
        end_of_run, "draw_labels", lambda frames, lines: (said.extend(lines), shown.append(frames), frames)[2]
    )
    monkeypatch.setattr(
        end_of_run, "play_episodes", lambda *a, **k: (returns.append(play(*a, **k)), returns[-1])[1]
    )
    rates: list[int] = []
    report_run(cfg, tmp_path, env, policies, results, rows=[], log_video=lambda _, __, fps: rates.append(fps))
    assert rates == [15]
    numbers = [
        k for task in (0, 1) for k in sorted(range(task, 5, 2), key=lambda k: float(rows["return"][k]))
    ]
    assert len(numbers) == 5  # all there are, also the fifth, without a world of the second task beside it
    names = list(lengths)
    assert said == [f"{names[k % 2]}, policy, no success, episode {k + 1}" for k in numbers]
    for number, played in zip(numbers, returns, strict=True):
        assert played["return"][number % 2] == rows["return"][number]
    moved = (shown[0][1:] != shown[0][:-1]).flatten(2).any(2)
    # Four frames of a reach take as long as six of a push: two of them are there twice. Then a second of stillness.
    assert moved.int().tolist() == [[k, k, k, 1, 1] for k in (0, 1, 1, 0, 1)] + [[0] * 5] * 15
    assert (tmp_path / "video.mp4").stat().st_size > 1000


def test_the_worst_are_those_without_success_and_then_those_with_the_least_return() -> None:
    found = {"success": torch.tensor([1.0, 0.0, 1.0, 0.0]), "return": torch.tensor([5.0, 3.0, 1.0, 2.0])}
    assert worst(TensorDict(found, [4]), 3) == [3, 1, 2]
    assert worst(TensorDict({**found, "final_distance": torch.tensor([0.1, 0.4, 0.2, 0.3])}, [4]), 9) == [
        1,
        3,
        2,
        0,
    ]


def test_a_line_says_whose_episode_it_is_and_how_it_ended() -> None:
    """Success is the task's own word, whatever the distance."""
    for distance, success, said in ((0.021, 0.0, "2.1 cm, no success"), (0.3, 1.0, "30.0 cm, success")):
        played = TensorDict(
            {"final_distance": torch.tensor([distance]), "success": torch.tensor([success])}, [1]
        )
        assert ending(played, "planner", 6) == f"planner, {said}, episode 7"
    assert ending(TensorDict({"success": torch.ones(1)}, [1]), "policy", 0) == "policy, success, episode 1"


@pytest.mark.parametrize("size", [96, 256])
def test_labels_fit_their_pictures(size: int) -> None:
    frames = torch.full((3, 2, size, size, 3), 20, dtype=torch.uint8)
    labelled = draw_labels(frames, ["planner, 30.0 cm, no success, worst", "ik"])
    assert (frames == 20).all() and labelled.shape == frames.shape
    assert (labelled[0] == labelled[2]).all() and (labelled[:, :, size // 2 :] == 20).all()
    bright = labelled[0].float().mean(-1) > 80
    assert bright[0].any(0).sum() > bright[1].any(0).sum() > 0  # more columns are written on by a longer line
    assert not bright[0, :, -2:].any()  # and it ends before its picture does
