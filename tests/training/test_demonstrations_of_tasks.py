"""Demonstrations of several tasks at once: each is of one task, and looks as that task's worlds do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from franka_wm.commands import main as cli
from franka_wm.data.lerobot import cache, open_dataset
from franka_wm.errors import UserError
from franka_wm.training import build
from franka_wm.training.check import check
from franka_wm.training.demos import open_demonstrations, told
from franka_wm.training.learner import Learner
from franka_wm.training.spaces import Spaces

SHORT = ("env.substeps=1", "env.episode_length=8", "device=cpu")
TASKS = ("reach", "push", "stack")
OTHERS = ("track", "lift", "pick", "drawer", "peg")
MANY = (
    "env=multitask",
    *(f"~env.tasks.{name}" for name in OTHERS),
    *(f"env.tasks.{name}.{option}" for name in TASKS for option in ("substeps=1", "episode_length=8")),
    "device=cpu",
    "seed=0",
    "evaluation.during=[]",
)


@pytest.fixture(scope="module")
def roots(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Episodes of eight steps: six of reach, four of stack."""
    folder = tmp_path_factory.mktemp("demos")
    for task, policy, episodes in (("reach", "ik", 6), ("stack", "expert", 4)):
        words = (f"policy={policy}", f"episodes={episodes}", "num_envs=2", f"env={task}", "seed=0", *SHORT)
        assert cli.main(["collect", f"out={folder / task}", *words]) == 0
    return {task: folder / task for task in ("reach", "stack")}


@pytest.fixture(autouse=True)
def own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cache, "default_cache_dir", lambda: tmp_path / "cache")


def demos_of(*roots: Path) -> str:
    return f"replay.demos=[{','.join(map(str, roots))}]"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "demonstrations: 50 % of each batch"),
        (
            ("replay.demo_share_end=0.1", "replay.demo_updates=7"),
            "demonstrations: 50 % of each batch, 10 % at the last update; the first 7 updates see them alone",
        ),
        (("replay.demo_share=0.25", "replay.demo_share_end=0.25"), "demonstrations: 25 % of each batch"),
    ],
)
def test_their_share_is_told(words: tuple[str, ...], said: str, settled) -> None:
    assert told(settled("scale=smoke", "env=push", "device=cpu", "replay.demos=here", *words)) == said


def test_they_look_as_the_worlds_of_their_task_do(roots: dict[str, Path], settled, capsys) -> None:
    run = settled("scale=smoke", *MANY, demos_of(roots["stack"], roots["reach"]), "collector.num_envs=6")
    check(run)
    env: Any = build.make_env(run)
    spaces = Spaces.of_tasks(run.env.config)
    assert spaces == Spaces.of_env(env)
    shown = open_demonstrations(run, spaces, None)
    assert shown is not None and "demonstrations: 50 % of each batch" in capsys.readouterr().out
    steps = shown.transitions.squeeze(1)
    seen = env.reset()
    whose = {name: steps[steps["task"][:, k] == 1.0] for k, name in enumerate(TASKS)}
    assert {name: len(one) for name, one in whose.items()} == {"reach": 48, "push": 0, "stack": 32}
    for name in ("reach", "stack"):
        own = next(
            iter(open_dataset(roots[name], window=1, batch_size=100, validation_fraction=0.0).batches(100))
        )
        world = TASKS.index(name)
        for part, recorded in ((whose[name], own), (whose[name]["next"], own["next"])):
            assert (part["task"] == env.one_hot[world]).all()
            for key in ("state", "objects", "joint_target"):
                assert part[key].shape[-1] == seen[key].shape[-1]
                absent = seen[key][world :: len(TASKS)] == 0.0
                size = recorded[key].shape[-1] if key in recorded.keys() else 0  # noqa: SIM118
                assert (
                    torch.equal(part[key][:, :size], recorded[key].flatten(0, 1)[..., :size])
                    if size
                    else True
                )
                assert not part[key][:, size:].any() and absent[:, size:].all()
        size = env.envs[name].action_dim
        assert torch.equal(whose[name]["action"][:, :size], own["action"].flatten(0, 1))
        assert not whose[name]["action"][:, size:].any() and whose[name]["action"].shape[-1] == 8
        assert torch.equal(whose[name]["next", "reward"], own["next", "reward"].flatten(0, 1))


def test_no_window_spans_two_tasks(roots: dict[str, Path], settled) -> None:
    run = settled("scale=smoke", *MANY, demos_of(*roots.values()), "replay.window=8")
    shown = open_demonstrations(run, Spaces.of_tasks(run.env.config), None)
    assert shown is not None
    assert shown._starts.tolist() == list(range(0, 80, 8))


def test_a_run_learns_from_them(roots: dict[str, Path], train, monkeypatch) -> None:
    seen, update = [], Learner.update

    def watched(self: Learner, batch: Any, **options: Any) -> None:
        shown = batch["demonstrated"][:, 0, 0]
        seen.append((int(shown.sum()), batch["task"][shown][:, 0].sum(0).tolist()))
        update(self, batch, **options)

    monkeypatch.setattr(Learner, "update", watched)
    words = (demos_of(*roots.values()), "replay.demo_updates=10", "model.imitation_coef=1")
    run = train(*MANY, *words, "collector.num_envs=3", "evaluation.episodes=3")
    assert run.counters["updates"] == 30
    assert [count for count, _ in seen] == [8] * 10 + [4] * 20
    total = torch.tensor([one for _, one in seen]).sum(0)
    assert total[0] > 20 and total[1] == 0 and total[2] > 20


def test_a_dataset_is_of_the_entry_with_its_options(roots: dict[str, Path], settled, monkeypatch) -> None:
    """Of two entries with one task; its folder may be given from one's home."""
    monkeypatch.setenv("HOME", str(roots["reach"].parent))
    other = ("env.tasks.reach.action_scale=0.05", 'replay.demos="~/reach"')
    run = settled("scale=smoke", *MANY, *other)
    tasks = run.env.config.tasks
    tasks = {**tasks, "near": replace(tasks["reach"], action_scale=0.085)}
    run = replace(run, env=replace(run.env, config=replace(run.env.config, tasks=tasks)))
    check(run)
    shown = open_demonstrations(run, Spaces.of_tasks(run.env.config), None)
    assert shown is not None and (shown.transitions["task"][..., -1] == 1.0).all()


def test_a_task_whose_demonstrations_are_too_short_is_told(roots: dict[str, Path], settled) -> None:
    run = settled("scale=smoke", *MANY, demos_of(*roots.values()), "replay.window=9")
    with pytest.raises(UserError, match="no demonstration of reach has 9 steps"):
        open_demonstrations(run, Spaces.of_tasks(run.env.config), None)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            ("~env.tasks.stack",),
            r"stack: was recorded in env\.task=stack; with env=multitask .*: reach, push$",
        ),
        (
            ("env.tasks.stack.action_scale=0.05",),
            r"recorded with env\.action_scale=0\.085, env\.tasks\.stack has 0\.05",
        ),
        (("env.tasks.reach.reward=sparse",), r"with env\.reward=dense, env\.tasks\.reach has sparse"),
        (("replay.demos=nowhere",), r"^replay\.demos=nowhere: no such folder"),
        (("replay.demo_resets=0.5",), "episodes of env=multitask do not begin along"),
    ],
)
def test_what_cannot_be_is_refused(roots: dict[str, Path], settled, changes, message) -> None:
    run = settled("scale=smoke", *MANY, demos_of(*roots.values()), *changes)
    with pytest.raises(UserError, match=message) as refused:
        check(run)
    assert "\n" not in str(refused.value)
