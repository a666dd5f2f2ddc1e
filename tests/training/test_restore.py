"""What of a checkpoint is put back, what is not, and what is said of that."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from franka_wm import processes
from franka_wm.commands.main import main
from franka_wm.envs import FrankaEnv, MultiTaskEnv
from franka_wm.errors import UserError
from franka_wm.seeding import derive_seed
from franka_wm.training import build, moment, resume, storage_budget
from franka_wm.training.checkpoint import Checkpoint, latest_checkpoint, load_checkpoint
from franka_wm.training.learner import Learner
from franka_wm.training.resume import OTHER_DEVICE, restore
from franka_wm.training.settings import RunSettings
from franka_wm.training.trainer import Trainer

WORLDS, UPDATES = 4, 2
ANEW = "this run gathers anew and will not be the same"

Make = Callable[..., Trainer]


@pytest.fixture(scope="module")
def cfg(settled, tiny: list[str]) -> RunSettings:
    return settled(
        *tiny, f"collector.num_envs={WORLDS}", f"trainer.updates={UPDATES}", "collector.seed_steps=12"
    )


@pytest.fixture(scope="module")
def env(cfg: RunSettings) -> FrankaEnv:
    return build.make_env(cfg)


@pytest.fixture(scope="module")
def make(cfg: RunSettings, env: FrankaEnv, tmp_path_factory) -> Make:
    folder = tmp_path_factory.mktemp("runs")

    def make(name: str = "second", **changes: Any) -> Trainer:
        mine = cfg.changed(trainer={"updates": UPDATES + 10, **changes})
        model = build.make_model(mine, env)
        return Trainer(
            env=env,
            learner=Learner(model),
            replay=build.make_replay_buffer(mine, env.device),
            policies=build.make_policies(model, build.make_planner(mine, env.action_dim), env),
            actor="policy",
            settings=mine,
            spaces=build.Spaces.of_env(env),
            folder=folder / name,
            loggers=[],
            evaluate=dict,
        )

    return make


@pytest.fixture(scope="module")
def first(make: Make) -> Trainer:
    """A run that has ended."""
    trainer = make("first", updates=UPDATES)
    trainer.fit()
    return trainer


@pytest.fixture
def checkpoint(first: Trainer) -> Checkpoint:
    return load_checkpoint(latest_checkpoint(first.folder))


def said(capsys) -> list[str]:
    return [line.strip() for line in capsys.readouterr().out.splitlines()]


def test_all_of_it_and_nothing_is_said(
    make: Make, first: Trainer, checkpoint: Checkpoint, env, capsys
) -> None:
    drawn = []
    for seed in range(2):
        second = make()
        env.rollout(3)
        torch.manual_seed(seed)
        capsys.readouterr()
        restore(second, checkpoint)
        assert said(capsys) == []
        drawn.append(torch.rand(3))
    assert torch.equal(*drawn)
    assert second.learner.updates == UPDATES and second.env_steps == first.env_steps > 0
    assert second.seconds == first.seconds and second.rows == first.rows != []
    assert (second.replay[:] == first.replay[:]).all()
    saved = checkpoint.moment()["worlds"]["state"]
    assert torch.equal(env.get_state()["episode"], saved["episode"]) and (saved["episode"] >= 0).all()


def test_a_checkpoint_without_rows(make: Make, checkpoint: Checkpoint, monkeypatch) -> None:
    """One that was saved without anything besides."""
    monkeypatch.setattr(Checkpoint, "extra", lambda self: None)
    second = make()
    second.rows = [{"updates": 1.0}]
    restore(second, checkpoint)
    assert second.rows == []


@pytest.mark.parametrize("updates", [UPDATES, UPDATES + 1])
def test_experience_that_is_missing(
    make: Make, checkpoint: Checkpoint, updates: int, monkeypatch, capsys
) -> None:
    """It is said where it would be needed: not of a run that has no updates left."""
    monkeypatch.setattr(Checkpoint, "replay", lambda *_: None)
    second = make(updates=updates)
    restore(second, checkpoint)
    assert len(second.replay) == 0
    expected = f"the checkpoint holds no experience: {ANEW}"
    assert said(capsys) == ([] if updates == UPDATES else [expected])


def test_another_number_of_worlds(make: Make, checkpoint: Checkpoint, env: FrankaEnv, capsys) -> None:
    checkpoint.config["collector"]["num_envs"] = WORLDS + 1
    second = make()
    restore(second, checkpoint)
    why = f"is of collector.num_envs={WORLDS + 1}, this run has {WORLDS}"
    assert said(capsys) == [f"the checkpoint {why}: {ANEW}"]
    assert len(second.replay) == 0 and (env.get_state()["episode"] == -1).all()
    assert second.learner.updates == UPDATES


def test_another_number_of_processes(make: Make, checkpoint: Checkpoint, monkeypatch, capsys) -> None:
    """Random numbers start anew, from a seed of the process and of how far the run is."""
    monkeypatch.setattr(resume, "own_experience", lambda one, device: one.replay(device, 0))
    monkeypatch.setattr(resume, "own_moment", lambda one: {"worlds": one.moment()["worlds"]})
    monkeypatch.setattr(Checkpoint, "processes", 2)
    second = make()
    restore(second, checkpoint)
    (line,) = said(capsys)
    assert line.startswith("the checkpoint is of 2 processes, here are 1: random numbers start anew")
    assert torch.initial_seed() == derive_seed("process", second.settings.seed, 0, UPDATES)
    assert len(second.replay) > 0 and second.acting is not None
    generator: Any = second.acting.policies["random"].generator
    begun = derive_seed("policies", second.settings.seed, "resumed", UPDATES)
    assert generator.initial_seed() in {
        derive_seed(name, begun) for name in moment.draws(second.acting.policies)
    }


def test_weights_that_differ_between_processes_are_not_saved(make: Make, monkeypatch) -> None:
    """What was saved before stays; see ``tests/processes/test_start.py`` for what is seen."""
    trainer = make("apart")
    latest = trainer.save()
    with monkeypatch.context() as patched:
        patched.setattr(processes, "count", lambda: 2)
        patched.setattr(processes, "objects", lambda mine: [mine, mine + 1])
        trainer.learner.updates = 7
        with pytest.raises(UserError, match="weights of process 1 are no longer those of process 0"):
            trainer.save()
    assert load_checkpoint(latest).counters["updates"] == 0


def test_two_stages_of_several_processes_draw_unlike_numbers(
    make: Make, cfg: RunSettings, env: FrankaEnv, monkeypatch, tmp_path
) -> None:
    other, seeds = make(), []
    parts: Any = {"env": env, "learner": other.learner, "replay": other.replay, "policies": {}, "loggers": []}
    parts["spaces"] = other.spaces
    first = replace(cfg, values={**cfg.values, "whole_run": cfg.values})
    for rank in range(2):
        monkeypatch.setattr(processes, "count", lambda: 2)
        monkeypatch.setattr(processes, "rank", lambda rank=rank: rank)
        for settings in (first, cfg):
            Trainer(**parts, actor="policy", settings=settings, folder=tmp_path, evaluate=dict)
            seeds.append(torch.initial_seed())
    assert len(set(seeds)) == 4 and seeds[1] == derive_seed("process", cfg.seed, 0)


def test_room_is_for_what_comes_back_and_what_will_be_gathered(
    make: Make, first: Trainer, checkpoint: Checkpoint, monkeypatch
) -> None:
    second = make()
    ahead = WORLDS * second.settings.planned_steps(UPDATES)
    step = first.replay.storage.bytes_per_step(checkpoint.replay())
    room = step * (ahead + first.replay[:].numel())
    assert ahead + first.replay[:].numel() < second.settings.replay.capacity
    for free, fits in ((room, True), (room - step, False)):
        monkeypatch.setattr(storage_budget, "free_memory", lambda device, free=free: free)
        if fits:
            restore(make(), checkpoint)
        else:
            with pytest.raises(UserError, match="do not fit"):
                restore(make(), checkpoint)


@pytest.mark.parametrize(
    "why", ["the checkpoint holds none", "of another configuration", "of other libraries"]
)
def test_worlds_that_start_new_episodes(why: str, make: Make, checkpoint, env, monkeypatch, capsys) -> None:
    if why == "of another configuration":
        checkpoint.config["env"]["success_distance"] = 0.2
    else:
        monkeypatch.setattr(resume, "own_moment", lambda one: {})
    if why == "of other libraries":
        monkeypatch.setattr(resume, "restorable", lambda env: None)
        why = "the simulators of other libraries cannot be put back"
    restore(make(), checkpoint)
    told = [f"worlds: {why}; they start new episodes, and this run will not be the same"]
    if why == "of another configuration":
        gathered = "the checkpoint's experience was gathered with env.success_distance=0.2"
        told.insert(
            0, f"{gathered}; it stays in the replay beside what is gathered now, as earlier points in curves"
        )
    assert said(capsys) == told
    assert (env.get_state()["episode"] == -1).all()


def test_a_dataset_is_of_one_environment(make: Make, checkpoint) -> None:
    """Episodes from before would be said to be of the environment that is now, and be cut by its length."""
    checkpoint.config["env"]["episode_length"] = 5
    trainer = make()
    trainer.settings = trainer.settings.changed(export={"kind": "lerobot"})
    with pytest.raises(UserError, match=r"gathered with env\.episode_length=5, and a dataset is of one"):
        restore(trainer, checkpoint)


def test_that_experience_is_of_another_environment_too_is_remembered(
    make: Make, checkpoint, tmp_path, capsys
) -> None:
    """Resumed once more, in the same environment now, and published by `franka-wm export`."""
    checkpoint.config["env"]["success_distance"] = 0.2
    mixed = make()
    restore(mixed, checkpoint)
    mixed.folder = tmp_path
    again = load_checkpoint(mixed.save())
    third = make()
    capsys.readouterr()
    restore(third, again)
    assert "gathered with env.success_distance=0.2; it stays in the replay" in capsys.readouterr().out
    third.settings = third.settings.changed(export={"kind": "lerobot"})
    with pytest.raises(
        UserError, match=r"=0\.2, and a dataset is of one environment; add export\.kind=none$"
    ):
        restore(third, again)
    assert main(["export", f"source={tmp_path}", f"out={tmp_path / 'set'}"]) == 1
    assert "gathered with env.success_distance=0.2, and a dataset is of one" in capsys.readouterr().err
    assert not (tmp_path / "set").exists()


CUBE = {"objects": [{"name": "cube", "shape": "box", "size": [0.05, 0.05, 0.05], "mass": 0.1}]}


@pytest.mark.parametrize(
    ("words", "before", "changed"),
    [
        (("env=reach",), {"max_contacts": 9, "target_ke": 4500.0}, ["env.target_ke=4500.0"]),
        (("env=reach",), {"camera_distance": 1.0}, []),  # it has no images
        (("env=lift",), {"scene": CUBE}, ["another env.scene"]),
        (("env=push",), {"task_options": {"reach": 0.1}}, ["env.task_options={reach: 0.1}"]),
        (("env=gym", "env.name=Pendulum-v1"), {"frame_skip": 3}, ["env.frame_skip=3"]),
    ],
)
def test_what_gives_transitions_another_meaning(
    words: tuple[str, ...], before: dict, changed: list[str], settled
) -> None:
    """Also where one of both is null; not what changes none of them, such as the room for contacts."""
    settings = settled("scale=smoke", *words)
    own = settings.values["env"]
    assert resume._changed(own, settings) == []
    assert resume._changed({**own, **before}, settings) == changed


def test_policies_that_drew_on_another_kind_of_device(make: Make, checkpoint, monkeypatch, capsys) -> None:
    monkeypatch.setattr(resume, "go_on_drawing", lambda *_: False)
    restore(make(), checkpoint)
    assert said(capsys) == [OTHER_DEVICE]


@pytest.mark.parametrize("device", [None, "cpu"])
def test_worlds_of_several_tasks_go_on_where_they_stood(settled, tiny: list[str], device: str | None) -> None:
    """Also of a checkpoint of an earlier version, which lacks a mark; the collector's root stays as it has it."""
    dropped = [f"~env.tasks.{name}" for name in ("track", "lift", "pick", "stack", "drawer", "peg")]
    arm = [one for one in tiny if not one.startswith(("env.", "collector."))]
    run = settled(*arm, "env=multitask", *dropped, "collector.num_envs=4")
    env = build.make_env(run)
    assert isinstance(env, MultiTaskEnv)
    action = torch.rand(3, 4, env.action_dim, generator=torch.Generator().manual_seed(0)) * 2 - 1

    def go_on(root: Any) -> torch.Tensor:
        steps = []
        for one in action:
            step, root = env.step_and_maybe_reset(root.clone().set("action", one))
            steps.append(torch.cat((step["state"], step["next", "state"]), -1))
        return torch.stack(steps)

    carrier = env.rollout(2)[:, -1]["next"].exclude("reward")
    collector: Any = SimpleNamespace(_carrier=carrier if device else carrier.clear_device_())
    saved: Any = moment.worlds_now(env, collector)
    assert saved["carry"].pop("overflow").shape == (4, 1)
    before = go_on(collector._carrier)
    collector._carrier = collector._carrier.clone().zero_()
    moment.put_back(env, collector, saved)
    assert collector._carrier.device == (torch.device(device) if device else None)
    assert not collector._carrier["overflow"].any() and collector._carrier["task"].any()
    assert torch.equal(go_on(collector._carrier), before)


@pytest.mark.parametrize("held_out", [True, False])
def test_recorded_windows_are_put_back(held_out: bool, capsys) -> None:
    """Those that were saved, of training and held out; without worlds there is nothing else."""

    class Windows:
        def __init__(self, fits: bool = True) -> None:
            self.fits, self.given = fits, []

        def set_state(self, state: str) -> bool:
            self.given.append(state)
            return self.fits

    trainer: Any = SimpleNamespace(env=None, replay=Windows(), validation=Windows() if held_out else None)
    resume._restore_moment(trainer, None, {"windows": "a", "validation": "b"})
    assert trainer.replay.given == ["a"] and said(capsys) == []
    assert not held_out or trainer.validation.given == ["b"]
    resume._restore_moment(trainer, None, {})
    assert trainer.replay.given == ["a"] and said(capsys) == []
    trainer.replay = Windows(fits=False)
    resume._restore_moment(trainer, None, {"windows": "a"})
    assert said(capsys) == [OTHER_DEVICE]


class Seeded:
    """Worlds that keep the seed that they were given."""

    def set_seed(self, seed: int) -> None:
        self.seed = seed


@pytest.mark.parametrize("arm", [True, False])
def test_worlds_of_other_libraries_go_on_unlike_on_each_gpu(arm: bool, monkeypatch) -> None:
    """Those of the arm are told apart by their numbers."""
    seeds = []
    monkeypatch.setattr(resume, "restorable", lambda env: env if arm else None)
    for rank in range(2):
        monkeypatch.setattr(processes, "count", lambda: 2)
        monkeypatch.setattr(processes, "rank", lambda rank=rank: rank)
        trainer: Any = SimpleNamespace(env=Seeded(), settings=SimpleNamespace(seed=0), env_steps=100)
        resume._begin_new_episodes(trainer)
        seeds.append(trainer.env.seed)
    assert (seeds[0] == seeds[1]) == arm


# -- the form of experience --------------------------------------------------------------------------------


def steps(*size: int, channels: int = 6) -> TensorDict:
    images = torch.zeros(*size, 8, 8, channels, dtype=torch.uint8)
    after = {"reward": torch.zeros(*size, 1)}
    return TensorDict({"state": torch.zeros(*size, 4), "pixels": images, "next": after}, size)


def gathering(channels: int = 6, frame_stack: int = 2) -> Any:
    """A trainer of two worlds that gathers such steps, and an entry of its model's own besides."""
    return SimpleNamespace(
        env=SimpleNamespace(fake_tensordict=lambda: steps(2, channels=channels)),
        settings=SimpleNamespace(env=SimpleNamespace(frame_stack=frame_stack)),
        model=SimpleNamespace(replay_keys=("plan",)),
        kept=["plan", "state", "pixels", ("next", "reward")],
    )


def test_experience_that_fits() -> None:
    whole = steps(2, 4).set("plan", torch.zeros(2, 4, 7, 7))
    names = {"plan", "state", "pixels", "next"}
    assert set(resume._fitting(gathering(), whole.set("other", whole["state"])).keys()) == names
    whole["pixels"] = whole["pixels"][..., :3]  # as StackStorage keeps them
    resume._fitting(gathering(), whole)
    with pytest.raises(ValueError, match="experience of pixels is of shape"):
        resume._fitting(gathering(frame_stack=1), whole)  # what is not stacked is kept whole


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        (("next", "reward"), None, "the checkpoint's experience has no next.reward, which this run keeps"),
        ("state", torch.zeros(2, 4, 4, dtype=torch.float64), "experience of state is torch.float64"),
        ("state", torch.zeros(2, 4, 5), "experience of state is of shape"),
        (
            "state",
            torch.zeros(2, 4, 3),
            "experience of state is of shape",
        ),  # as many as an image has channels
        ("state", torch.zeros(2, 4), "experience of state is of shape"),
        ("state", TensorDict({}, [2, 4]), "experience of state is None"),
        ("plan", TensorDict({}, [2, 4]), "experience of plan is None"),
        ("pixels", torch.zeros(2, 4, 8, 8, 4, dtype=torch.uint8), "experience of pixels is of shape"),
    ],
)
def test_experience_of_another_form_is_refused(key: Any, value: Any, said: str) -> None:
    """It would be noticed many steps later, in the words of a library."""
    whole = steps(2, 4).set("plan", torch.zeros(2, 4, 7))
    other = whole.exclude(key) if value is None else whole.set(key, value)
    with pytest.raises((ValueError, KeyError), match=said):
        resume._fitting(gathering(), other)


def test_a_signal_during_the_last_save_counts(make: Make) -> None:
    """Else a scheduler's only one is lost: a second stage would begin, or the end of the run go on."""
    trainer = make("stopped", updates=UPDATES)
    save = trainer.save

    def late(**options: bool) -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        save(**options)

    trainer.save = late  # type: ignore[method-assign]
    trainer.fit()
    assert trainer.interrupted and trainer.learner.updates == UPDATES
    assert load_checkpoint(latest_checkpoint(trainer.folder)).counters["updates"] == UPDATES
