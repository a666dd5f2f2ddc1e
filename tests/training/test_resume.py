"""N + N updates are 2 N updates, to the bit: after an end, a signal or a kill, in every stage."""

from __future__ import annotations

import os
import random
import signal
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from tensordict import TensorDictBase

from forks import train_in_fork
from franka_wm.commands.main import main
from franka_wm.data.lerobot import cache
from franka_wm.training import build
from franka_wm.training.checkpoint import Checkpoint, latest_checkpoint, load_checkpoint
from franka_wm.training.learner import Learner
from franka_wm.training.moment import draws
from franka_wm.training.resume import restore
from franka_wm.training.trainer import Trainer

HALF = 15  # amid the updates of a batch, which has 10

KINDS = {
    "policy": (),
    "planner": ("collector.policy=planner",),
    "random": ("collector.policy=random",),
    "exploring": ("collector.noise=0.4", "collector.planner_worlds=1", "env.goal_sampling=reachable"),
    "moves": ("model=muzero", "planner=gumbel"),
    "pictures": (
        "env=reach_fixed_pixels",
        "env.image_size=40",
        "env.frame_stack=2",
        "model=tdmpc2_pixels",
        "model.channels=4",
        "env.randomization.action_noise=0.1",
        "env.randomization.observation_noise=0.01",
    ),
    "recurrent": ("model=dreamer", "collector.noise=0.4", "collector.planner_worlds=1"),
    "tasks": (
        "env=multitask",
        *(f"~env.tasks.{name}" for name in ("track", "push", "pick", "stack", "drawer", "peg")),
        "env.tasks.reach.substeps=1",
        "env.tasks.lift.substeps=1",
        "env.tasks.lift.episode_length=8",
    ),
    "memory": ("model=lewm", "env=reach_goal_image", "env.image_size=32", "planner=icem", "collector.policy=planner"),
}  # fmt: skip


@pytest.fixture(scope="module")
def kind(request) -> str:
    return getattr(request, "param", "policy")


@pytest.fixture(scope="module")
def make(kind: str, settled, tiny: list[str], tmp_path_factory) -> Callable[..., Trainer]:
    """Makes trainers whose weights, policies, worlds and global generators are those of ``seed``."""
    asked = KINDS[kind]
    given = {one.split("=", 1)[0] for one in asked}
    sizes = [one for one in tiny if one.split("=", 1)[0] not in given]
    if kind == "tasks":  # each has options of its own
        sizes = [one for one in sizes if not one.startswith("env.")]
    if kind in ("moves", "memory"):
        sizes = [one for one in sizes if not one.startswith("planner.")]
    cfg = settled(
        *sizes, *asked, "trainer.schedule=cosine", "trainer.warmup=5", f"trainer.updates={2 * HALF}"
    )
    env, folder = build.make_env(cfg), tmp_path_factory.mktemp(kind)

    def make(name: str, *, seed: int, updates: int = 2 * HALF, **options: Any) -> Trainer:
        mine = cfg.changed(seed=seed, trainer={"updates": updates, **options})
        torch.manual_seed(seed)
        random.seed(seed)
        np.random.seed(seed)
        env.set_seed(seed)
        spaces = build.Spaces.of_env(env)
        model = build.make_model(mine, spaces, "cpu")
        return Trainer(
            env=env,
            learner=Learner(model, lr=1e-3, schedule="cosine", warmup=5, total_updates=2 * HALF),
            replay=build.make_replay_buffer(mine, env.device, build.make_hindsight(mine)),
            policies=build.make_agent_policies(mine, model, env, spaces, purpose="training"),
            actor=mine.actor,
            settings=mine,
            spaces=spaces,
            folder=folder / name,
            loggers=[],
            evaluate=dict,
        )

    return make


def everything(trainer: Trainer) -> dict[str, Any]:
    """All that the next step depends on, as tensors and numbers by name."""
    experience = trainer.experience()
    assert experience is not None and trainer.acting is not None and trainer._collector is not None
    arm = getattr(trainer.env, "base_env", trainer.env)
    parts = {
        "weights": trainer.model.state_dict(),
        "optimizer": trainer.learner.optimizer.state_dict(),
        "experience": experience,
        "worlds": arm.get_state(),
        "carry": trainer._collector._carrier,
        "policies": draws(trainer.acting.policies),
        "generators": [torch.get_rng_state(), list(np.random.get_state())[1:], random.getstate()],
        "counters": [trainer.env_steps, trainer.learner.updates],
    }
    return flat(parts)


def play(trainer: Trainer) -> dict[str, Any]:
    """Everything at the end of the run."""
    save, states = trainer.save, []
    trainer.save = lambda **options: (states.append(everything(trainer)), save(**options))[1]  # type: ignore[method-assign]
    trainer.fit()
    return states[-1]


def flat(value: Any, name: str = "") -> dict[str, Any]:
    if isinstance(value, (dict, TensorDictBase)):
        return {k: v for key, one in value.items() for k, v in flat(one, f"{name}/{key}").items()}
    if isinstance(value, (list, tuple)):
        return {k: v for i, one in enumerate(value) for k, v in flat(one, f"{name}/{i}").items()}
    return {name: torch.as_tensor(value).clone() if isinstance(value, (torch.Tensor, np.ndarray)) else value}


def differing(a: dict[str, Any], b: dict[str, Any]) -> list[str]:
    assert a.keys() == b.keys()
    same = lambda x, y: torch.equal(x, y) if isinstance(x, torch.Tensor) else x == y  # noqa: E731
    return [name for name in a if not same(a[name], b[name])]


@pytest.mark.parametrize("kind", list(KINDS), indirect=True)
def test_two_halves_are_a_whole(make: Callable[..., Trainer]) -> None:
    """All of it: weights, optimiser, experience, worlds, carried roots and plans, policies, generators."""
    expected = play(make("whole", seed=0))
    first = make("first", seed=0, updates=HALF)
    halfway = play(first)
    second = make("second", seed=99)  # other weights, worlds, policies and generators
    second.env.rollout(3)
    second.settings = second.settings.changed(seed=0)
    restore(second, load_checkpoint(latest_checkpoint(first.folder)))
    assert differing(everything(second), halfway) == []
    got = play(second)
    assert {name.split("/")[1] for name in got} >= {"weights", "optimizer", "worlds", "carry", "policies"}
    assert differing(got, expected) == []
    assert not torch.equal(expected["/generators/0"], halfway["/generators/0"])


def test_a_signal_changes_nothing(make: Callable[..., Trainer]) -> None:
    """SIGTERM, as a cluster's scheduler sends it, amid the updates."""
    expected = play(make("whole", seed=0))
    first = make("first", seed=0)
    update = first.learner.update

    def signalled(*arguments: Any, **options: Any) -> None:
        update(*arguments, **options)
        if first.learner.updates == 13:
            os.kill(os.getpid(), signal.SIGTERM)

    first.learner.update = signalled  # type: ignore[method-assign]
    first.fit()
    assert first.interrupted and first.learner.updates == 13  # amid a batch of 10
    second = make("second", seed=98)
    second.settings = second.settings.changed(seed=0)
    restore(second, load_checkpoint(latest_checkpoint(first.folder)))
    assert differing(play(second), expected) == []


# -- whole runs ------------------------------------------------------------------------------------------------


def weights(checkpoint: Checkpoint) -> dict[str, torch.Tensor]:
    return load_file(checkpoint.folder / "model.safetensors")


@pytest.mark.slow  # three runs
def test_after_a_kill(train, one_thread: None, made: Counter[str], tiny: list[str], tmp_path: Path) -> None:
    """``kill -9`` between two checkpoints: from the last one, in another process, to the same weights."""
    (tmp_path / "killer.py").write_text(
        "import os, signal\n"
        "from franka_wm.training.learner import Learner\n"
        "update = Learner.update\n"
        "def killed(self, *arguments, **options):\n"
        "    update(self, *arguments, **options)\n"
        "    if self.updates == 25:\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "Learner.update = killed\n"
    )
    sizes = [*tiny, "evaluation.during=[]", "trainer.updates=40"]
    options = ["plugins=[killer]", "trainer.checkpoint_every=1e-9", f"hydra.run.dir={tmp_path}/killed"]
    killed = train_in_fork(*sizes, *options, cwd=tmp_path)
    assert killed.returncode == -signal.SIGKILL, killed.stdout + killed.stderr
    assert load_checkpoint(latest_checkpoint(tmp_path / "killed")).counters["updates"] == 20
    whole = weights(train(*sizes, folder=tmp_path / "whole"))
    made.clear()
    resumed = train(f"resume={tmp_path}/killed", folder=tmp_path / "resumed")
    assert resumed.counters["updates"] == 40 and made == {"TDMPC2": 20}
    assert differing(weights(resumed), whole) == []


@pytest.mark.slow
@pytest.mark.parametrize("worlds", [2, 5])
def test_another_number_of_worlds_gathers_anew(train, worlds: int, tmp_path: Path, capsys) -> None:
    first = train("evaluation.during=[]", "trainer.updates=10", folder=tmp_path / "first")
    more = (f"collector.num_envs={worlds}", "trainer.updates=20")
    second = train(f"resume={tmp_path}/first", *more, folder=tmp_path / "second")
    said = [line for line in capsys.readouterr().out.splitlines() if "will not be the same" in line]
    why = f"the checkpoint is of collector.num_envs=3, this run has {worlds}"
    assert said == [f"  {why}: this run gathers anew and will not be the same"]
    before, after = first.replay(), second.replay()
    assert before is not None and after is not None and second.counters["updates"] == 20
    assert len(after) == worlds and second.counters["env_steps"] == before.numel() + after.numel()


@pytest.fixture
def one_thread() -> Iterator[None]:
    """As many as a fork has (`tests/helpers/forks.py`): on some processors products of matrices differ by it."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def made(monkeypatch) -> Counter[str]:
    """Updates by class of the model, in this process: a run from the beginning would have the same weights, too."""
    counts: Counter[str] = Counter()
    update = Learner.update

    def counted(self, *arguments: Any, **options: Any) -> None:
        update(self, *arguments, **options)
        counts[type(self.model).__name__] += 1

    monkeypatch.setattr(Learner, "update", counted)
    return counts


def interrupt(monkeypatch, number: int, stage: type) -> None:
    """Signals this process after so many updates of a model of this class."""
    update = Learner.update

    def signalled(self, *arguments: Any, **options: Any) -> None:
        update(self, *arguments, **options)
        if self.updates == number and type(self.model) is stage:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(Learner, "update", signalled)


@pytest.mark.slow
def test_recorded_data_go_on_where_they_were(train, made: Counter[str], monkeypatch, tmp_path: Path) -> None:
    """The second half draws other batches than the first."""
    from franka_wm.models.tdmpc2 import TDMPC2

    arguments = [
        "collect",
        f"out={tmp_path}/data",
        "env=reach_fixed",
        "scale=smoke",
        "episodes=6",
        "num_envs=3",
    ]
    sizes = ["env.substeps=1", "env.episode_length=8", "device=cpu"]
    assert main([*arguments, *sizes, "seed=0", "workers=0"]) == 0
    data = [
        "trainer=offline",
        "dataset=lerobot",
        f"dataset.root={tmp_path}/data",
        "dataset.workers=1",
        *sizes,
    ]
    data += [f"dataset.cache_dir={tmp_path}/cache", "env=reach_fixed", "dataset.validation_fraction=0.3"]
    data += ["trainer.updates=12", "trainer.updates_per_batch=1", "evaluation.during=[]"]
    whole = train(*data, folder=tmp_path / "whole")
    with monkeypatch.context() as patched:
        interrupt(patched, 6, TDMPC2)
        train(*data, folder=tmp_path / "first", status=130)
    assert load_checkpoint(latest_checkpoint(tmp_path / "first")).counters["updates"] == 6
    made.clear()
    second = train(f"resume={tmp_path}/first", folder=tmp_path / "second")
    assert made == {"TDMPC2": 6}
    assert differing(weights(second), weights(whole)) == []
    states = [(one.extra() or {})["moment"] for one in (whole, second)]
    assert torch.equal(states[0]["windows"], states[1]["windows"])


@pytest.mark.slow
def test_demonstrations_and_hindsight_go_on_where_they_were(
    train, made: Counter[str], monkeypatch, tmp_path: Path
) -> None:
    """Which of them are drawn and how many, episodes that begin along them, goals that were reached later."""
    from franka_wm.models.tdmpc2 import TDMPC2

    monkeypatch.setattr(cache, "default_cache_dir", lambda: tmp_path / "cache")
    worlds = ["env=push", "env.substeps=1", "env.episode_length=8", "seed=0", "device=cpu"]
    root = tmp_path / "push"
    assert main(["collect", f"out={root}", "policy=expert", "episodes=4", "num_envs=4", *worlds]) == 0
    shares = ["replay.demo_updates=5", "replay.demo_share_end=0.25", "replay.hindsight=0.5"]
    starts = ["replay.demo_resets=0.5", "replay.demo_reset_updates=25"]
    run = [*worlds, f"replay.demos={root}", *shares, *starts, "evaluation.during=[]", "trainer.updates=30"]
    whole = train(*run, folder=tmp_path / "whole")
    with monkeypatch.context() as patched:
        interrupt(patched, 15, TDMPC2)
        train(*run, folder=tmp_path / "first", status=130)
    begun = load_checkpoint(latest_checkpoint(tmp_path / "first")).counters["updates"]
    assert 15 <= begun < 30
    made.clear()
    second = train(f"resume={tmp_path}/first", folder=tmp_path / "second")
    assert made == {"TDMPC2": 30 - begun}
    assert differing(weights(second), weights(whole)) == []


@pytest.fixture(scope="module")
def kept() -> dict[str, Checkpoint]:
    """Runs that several tests compare with."""
    return {}


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["first", "second"])
def test_any_stage_goes_on(
    stage: str, train, kept, made: Counter[str], monkeypatch, tmp_path: Path, capsys
) -> None:
    from franka_wm.models.action_world_model import ActionWorldModel
    from franka_wm.models.jepa import JEPA

    run = [
        "model=action_world_model",
        "pretrain=lejepa",
        "env=reach_goal_image",
        "env.image_size=32",
        "planner=icem",
    ]
    run += [
        "pretrain.updates=12",
        "trainer.updates=6",
        "trainer.updates_per_batch=3",
        "evaluation.during=[]",
    ]
    run += ["planner.num_samples=8", "planner.num_elites=4", "planner.iterations=1"]
    if not kept:
        kept["whole"] = train(*run, folder=tmp_path / "whole")
    whole = kept["whole"]
    with monkeypatch.context() as patched:
        # The first stage has made as many updates as the second will make.
        interrupt(patched, *((6, JEPA) if stage == "first" else (3, ActionWorldModel)))
        train(*run, folder=tmp_path / "stopped", status=130)
    assert f"resume={tmp_path}/stopped" in capsys.readouterr().out
    begun = latest_checkpoint(tmp_path / "stopped")
    assert load_checkpoint(begun).model_name == ("JEPA" if stage == "first" else "ActionWorldModel")
    made.clear()
    resumed = train(f"resume={tmp_path}/stopped", folder=tmp_path / "resumed")
    left = {"JEPA": 6, "ActionWorldModel": 6} if stage == "first" else {"ActionWorldModel": 3}
    assert made == left and "only the run's end" not in capsys.readouterr().out
    assert resumed.model_name == "ActionWorldModel" and resumed.counters == whole.counters | {
        "seconds": resumed.counters["seconds"]
    }
    assert differing(weights(resumed), weights(whole)) == []
    if stage == "first":
        runs = whole.folder.parents[1], tmp_path / "resumed"
        one, other = (load_checkpoint(run / "pretrained/checkpoints/latest") for run in runs)
        assert differing(weights(one), weights(other)) == []


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_cuda_but_for_rounding(train, monkeypatch, tmp_path: Path) -> None:
    """The same batches and noise, also while a resumed run is eager again: other draws would be far off."""
    from franka_wm.models.tdmpc2 import TDMPC2

    run = ["device=cuda", "trainer.updates=40", "evaluation.during=[]"]
    whole = train(*run, folder=tmp_path / "whole")
    with monkeypatch.context() as patched:
        interrupt(patched, 20, TDMPC2)
        train(*run, folder=tmp_path / "first", status=130)
    second = weights(train(f"resume={tmp_path}/first", folder=tmp_path / "second"))
    for name, expected in weights(whole).items():
        torch.testing.assert_close(
            second[name], expected, rtol=1e-3, atol=1e-4, msg=lambda text, name=name: f"{name}: {text}"
        )


# -- what cannot be put back --------------------------------------------------------------------------------


def test_more_updates_and_another_rate(make: Callable[..., Trainer]) -> None:
    """A resumed run may be longer; a learning rate that is given anew counts."""
    first = make("first", seed=0, updates=10)
    first.fit()
    longer = make("longer", seed=0, updates=20)
    longer.learner.rates = [2e-3 for _ in longer.learner.rates]
    longer.learner._scheduled = False
    restore(longer, load_checkpoint(latest_checkpoint(first.folder)))
    assert [group["lr"] for group in longer.learner.optimizer.param_groups] == longer.learner.rates
    longer.fit()
    assert longer.learner.updates == 20


def test_other_worlds_start_new_episodes_and_say_so(make: Callable[..., Trainer], capsys) -> None:
    first = make("first", seed=0, updates=10)
    first.fit()
    other = make("other", seed=0, updates=20)
    other.settings = other.settings.changed(env={"success_distance": 0.2})
    restore(other, load_checkpoint(latest_checkpoint(first.folder)))
    said = capsys.readouterr().out
    assert "of another configuration; they start new episodes" in said
    arm = getattr(other.env, "base_env", other.env)
    assert arm.get_state()["episode"].eq(-1).all()
    assert arm.simulation.tensors.seed[0].item() != first.settings.seed


def test_other_simulators_start_new_episodes_and_say_so(train, tmp_path: Path, capsys) -> None:
    """Not those that the first run has seen."""
    pytest.importorskip("gymnasium")
    first = train("env=gym", "env.name=Pendulum-v1", "env.episode_length=8", folder=tmp_path / "first")
    assert "cannot be put back" not in capsys.readouterr().out
    second = train(f"resume={tmp_path}/first", "trainer.updates=50", folder=tmp_path / "second")
    assert "cannot be put back; they start new episodes" in capsys.readouterr().out
    before, after = first.replay(), second.replay()
    assert before is not None and after is not None and after.shape[1] == before.shape[1] + 10
    new = after[:, before.shape[1] :]
    assert new["is_init"][:, 0].all()
    starts, seen = new["state"][:, 0], before["state"][before["is_init"].squeeze(-1)]
    assert not (starts.unsqueeze(1) == seen.unsqueeze(0)).all(-1).any()
