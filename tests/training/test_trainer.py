"""The loop in this process: it gathers, learns, logs, saves, and goes on where it stopped."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from franka_wm import processes
from franka_wm.console import Progress
from franka_wm.errors import UserError
from franka_wm.training import build, storage_budget
from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint
from franka_wm.training.learner import Learner
from franka_wm.training.resume import restore
from franka_wm.training.run import Run
from franka_wm.training.settings import RunSettings
from franka_wm.training.trainer import Trainer, UpdateProgress
from tests.training.conftest import CAPACITY, Make, N


def in_order(trainer: Trainer) -> TensorDict:
    """(worlds, time), the oldest first, by the writer's position alone."""
    data = trainer.replay[:]
    cursor = trainer.replay.writer._cursor
    return torch.cat([data[:, cursor:], data[:, :cursor]], 1) if data.shape[1] == CAPACITY else data


def test_a_run(make: Make) -> None:
    trainer = make()
    before = {k: v.clone() for k, v in trainer.model.state_dict().items()}
    trainer.fit()
    assert trainer.learner.updates == 20 and not trainer.interrupted
    # 10 seed steps, then two batches of 5, in 4 worlds.
    assert trainer.env_steps == (10 + 10) * N == len(trainer.replay)
    after = trainer.model.state_dict()
    assert any(not torch.equal(before[k], after[k]) for k in before)
    row = trainer.rows[-1]
    assert row["updates"] == 20 and row["env_steps"] == trainer.env_steps
    assert {"loss", "train/episodes", "updates_per_s", "time_s"} <= set(row)
    checkpoint = load_checkpoint(latest_checkpoint(trainer.folder))
    # The range of values is saved: another reward does not change it when the weights come back.
    assert checkpoint.config["model"]["value_high"] == trainer.model.two_hot.high < 4.0
    assert checkpoint.config["derived"] == ["value_high", "value_low"]  # nobody asked for these
    assert checkpoint.counters["updates"] == 20 and checkpoint.counters["env_steps"] == trainer.env_steps


def test_rates_and_time_left_are_without_the_first_update(make: Make, monkeypatch, capsys) -> None:
    """Compiling it may take minutes."""
    update = Learner.update

    def slowly(learner: Learner, *inputs: object, **options: bool) -> None:
        if not learner.updates:
            time.sleep(5.0)
        update(learner, *inputs, **options)

    monkeypatch.setattr(Learner, "update", slowly)
    trainer = make(updates=10, log_every=0.1)
    trainer.fit()
    assert trainer.rows[0]["updates"] == 10 and trainer.rows[0]["updates_per_s"] > 3.0


def test_an_evaluation_counts_for_the_time_left_and_not_for_rates(monkeypatch, capsys) -> None:
    now = 0.0
    monkeypatch.setattr("franka_wm.console.time", SimpleNamespace(perf_counter=lambda: now))
    progress = UpdateProgress(100, every=10.0)
    now = 20.0  # of which 15 s went into an evaluation
    progress.leave_out(15.0)
    assert not progress.due(), "a line after 5 s of updates would tell of one batch alone"
    now = 25.0
    assert progress.due() and progress.line(20, 200) == {"updates_per_s": 2.0, "env_steps_per_s": 20.0}
    assert "left 1:40" in capsys.readouterr().out  # 80 more; the next evaluations come, too


@pytest.mark.parametrize("low", [None, -0.01])
def test_targets_outside_of_the_range_are_said(make: Make, capsys, low) -> None:
    make(model={"value_low": low}).fit()
    said = [line for line in capsys.readouterr().out.splitlines() if "outside" in line]
    assert bool(said) == (low is not None) and all("model.value_low" in line for line in said)


@pytest.mark.parametrize(
    ("low", "others", "said"),
    [(-0.5, [], "beyond reward_bounds=(-0.5, 0)"), (-1.5, [], ""), (-1.5, ["rank 1's"], "rank 1's")],
)
def test_rewards_beyond_what_the_task_declares_are_said_once(
    make: Make, capsys, monkeypatch, low, others, said
) -> None:
    """Whichever process learned from them: the first one speaks for all."""
    left, objects = list(others), processes.objects

    def of_two(own: object) -> list[object]:
        return [own, left.pop() if left else ""] if isinstance(own, str) else objects(own)

    monkeypatch.setattr(processes, "objects", of_two)
    trainer = make()
    trainer.spaces = replace(trainer.spaces, reward_bounds=(low, 0.0))
    trainer.fit()
    trainer.log(Progress(20, every=1.0))
    lines = [line for line in capsys.readouterr().out.splitlines() if "warning" in line]
    assert len(lines) == bool(said) and all(said in line for line in lines)


def test_weights_fit_when_a_run_goes_on_in_another_environment(make: Make, tmp_path: Path) -> None:
    """With episodes that end at success and with another reward: parts and ranges stay those of the first start."""
    trainer = make()
    trainer.fit()
    checkpoint = load_checkpoint(latest_checkpoint(trainer.folder))
    cfg = RunSettings.of(checkpoint.config, saved=True).changed(
        env={"terminate_on_success": True, "action_penalty": 5.0}
    )
    env = build.make_env(cfg)
    _, spaces = Run(settings=cfg, folder=tmp_path, checkpoint=checkpoint).build_experience(env)
    model = build.make_model(cfg, spaces, env.device)
    checkpoint.load_model(model)
    assert torch.equal(model.two_hot.support, trainer.model.two_hot.support)
    assert build.make_model(cfg, env).termination_head is not None  # of a run that starts there


def test_observations_are_standardized_by_the_seed_data(make: Make) -> None:
    trainer = make()
    given = []
    trainer.model.set_observation_statistics = lambda mean, std: given.append((mean, std))
    trainer.seed()
    data = trainer.replay[:]
    seen = torch.cat([data[key] for key in trainer.model.observation_sizes], -1).flatten(0, 1)
    torch.testing.assert_close(given[0][0], seen.mean(0))
    torch.testing.assert_close(given[0][1], seen.std(0).clamp_min(1e-3))


@pytest.mark.parametrize("standardize", [True, False])
def test_an_observation_that_is_not_finite_is_named(make: Make, standardize: bool) -> None:
    """Rather than the model's statistics, or a loss that no learning rate mends."""
    trainer = make(standardize=standardize)
    key = trainer._vectors[-1]
    gather = trainer.gather

    def one_odd() -> None:
        gather()
        trainer.replay.storage._storage.get(key)[0, 0, -1] = torch.nan

    trainer.gather = one_odd  # type: ignore[method-assign]
    with pytest.raises(
        UserError, match=rf"observation {key}: not finite \(NaN or inf\) in the first steps of reach,"
    ):
        trainer.fit()


def test_images_are_standardized_by_the_seed_data(make: Make, settled) -> None:
    cfg = settled(
        *("scale=smoke", "device=cpu", "env=reach_pixels", "env.frame_stack=2", "model=tdmpc2_pixels"),
        *("env.cameras=[front,side]", "model.observations=[pixels,pixels_side]", "env.substeps=1"),
        *("collector.num_envs=3", "model.standardize_images=true"),
    )
    env = build.make_env(cfg)
    trainer = make(cfg=cfg, env=env)
    trainer.seed()
    encoders = trainer.model.encoder.convolutions
    for key, encoder in zip(("pixels", "pixels_side"), encoders, strict=True):
        seen = trainer.replay[:][key].flatten(0, 1) / 255.0  # single images
        mean, variance = seen.mean(0), seen.var(0, correction=0)
        torch.testing.assert_close(encoder.mean, torch.cat((mean, mean), -1))
        torch.testing.assert_close(encoder.std, variance.mean().sqrt())
        assert float(encoder.std) > 0.01
    plain = make("plain", cfg=cfg, env=env, standardize=False)
    plain.seed()
    assert all((one.mean == 0.5).all() and one.std == 1 for one in plain.model.encoder.convolutions)


def test_demonstrations_count_once_in_statistics_of_all_processes(make: Make, monkeypatch) -> None:
    """All processes have the same ones; the first brings them."""
    counts = []
    monkeypatch.setattr(processes, "pooled", lambda mean, std, n: counts.append(n) or (mean, std))
    for first in (True, False):
        trainer = make()
        sizes = trainer.model.observation_sizes
        shown = TensorDict({key: torch.zeros(48, 1, size) for key, size in sizes.items()}, [48, 1])
        trainer.demonstrations = SimpleNamespace(transitions=shown)
        monkeypatch.setattr(processes, "is_first", lambda first=first: first)
        trainer.seed()
    own = trainer.replay[:].numel()
    assert {*counts[: len(counts) // 2]} == {own + 48} and {*counts[len(counts) // 2 :]} == {own}


def test_experience_is_whole(make: Make) -> None:
    """The last transition of every episode is there, its next observation the true one."""
    trainer = make()
    trainer.fit()
    data = in_order(trainer)
    assert data.shape == (N, 20)
    starts = data["is_init"].squeeze(-1)
    assert (starts == (torch.arange(20) % 7 == 0)).all()
    follows = data["next", "state"][:, :-1] == data["state"][:, 1:]
    assert torch.equal(follows.all(-1), ~starts[:, 1:])
    assert torch.isfinite(data["next", "state"]).all() and (data["next", "state"] != 0).any(-1).all()


def test_where_there_is_no_experience(make: Make) -> None:
    """Before anything was gathered, and where windows are recorded."""
    assert make().experience() is None
    assert Trainer.experience(SimpleNamespace(env=None, replay=[0])) is None


def test_steps_of_all_processes_are_counted(make: Make, monkeypatch) -> None:
    trainer = make()
    monkeypatch.setattr(processes, "count", lambda: 2)
    trainer.gather()
    assert trainer.env_steps == 2 * trainer.replay[:].numel() == 2 * 5 * N


def test_room_for_the_experience_is_asked_for_once(make: Make, monkeypatch) -> None:
    """Before the first batch; later what is free has shrunk by what was taken."""
    trainer = make()
    monkeypatch.setattr(storage_budget, "free_memory", lambda device: 1)
    with pytest.raises(UserError, match="do not fit"):
        trainer.gather()
    monkeypatch.setattr(storage_budget, "free_memory", lambda device: None)
    trainer.gather()
    monkeypatch.setattr(storage_budget, "free_memory", lambda device: 1)
    trainer.gather()
    assert trainer.replay[:].shape == (N, 10)


@pytest.mark.parametrize("updates", [20, 110])
def test_going_on(make: Make, updates: int) -> None:
    """Also with a buffer that has wrapped around: all of it, in order, as windows of the same worlds."""
    first = make("first", updates=updates)
    first.fit()
    if updates == 110:
        assert first.env_steps > CAPACITY * N
    second = make("second", updates=updates + 10)
    restore(second, load_checkpoint(latest_checkpoint(first.folder)))
    assert second.learner.updates == updates and second.env_steps == first.env_steps
    assert second.rows == first.rows and second.seconds == pytest.approx(first.seconds)
    for key, value in first.model.state_dict().items():
        assert torch.equal(value, second.model.state_dict()[key]), key

    kept, restored = in_order(first), in_order(second)
    assert restored.shape == kept.shape
    assert (restored == kept).all()
    sample = second.replay.sample(200)
    assert (sample["next", "state"][:, :-1] == sample["state"][:, 1:]).all()

    second.fit()
    assert second.learner.updates == updates + 10
    assert second.env_steps == first.env_steps + 5 * N  # no second seed phase
    assert second.rows[: len(first.rows)] == first.rows and len(second.rows) > len(first.rows)
    newest = in_order(second)
    follows = (newest["next", "state"][:, :-1] == newest["state"][:, 1:]).all(-1)
    assert torch.equal(follows, ~newest["is_init"].squeeze(-1)[:, 1:])  # the worlds went on where they were


def test_going_on_without_the_experience_keeps_the_scale_of_observations(make: Make) -> None:
    first = make("first", checkpoint_replay=False)
    first.fit()
    second = make("second", updates=25, checkpoint_replay=False)
    restore(second, load_checkpoint(latest_checkpoint(first.folder)))
    assert len(second.replay) == 0
    calls = []
    second.model.set_observation_statistics = lambda mean, std: calls.append(mean)
    second.fit()
    assert second.learner.updates == 25
    assert not calls, "weights learned with one scale would see another"


def test_evaluation_while_training(make: Make, cfg: RunSettings) -> None:
    trainer = make(evaluate=lambda: {"eval/policy/success": 0.5})
    trainer.settings = trainer.settings.changed(evaluation={"every": 10})
    trainer.fit()
    rows = [row["updates"] for row in trainer.rows if "eval/policy/success" in row]
    assert rows == [10]  # after the first batch; the last one is left to the end of the run


def test_evaluations_that_take_long_are_left_out_unless_asked_for(make: Make, capsys, monkeypatch) -> None:
    def slowly() -> dict[str, float]:
        time.sleep(1.0)
        return {"eval/policy/success": 0.5}

    left_out: list[float] = []
    monkeypatch.setattr(UpdateProgress, "leave_out", lambda self, seconds: left_out.append(seconds))
    cases = ((None, 0.5, 0.1, 1), (10, 0.5, 0.1, 3), (None, 4.5, 0.1, 3), (None, 0.5, 99.0, 3))
    for every, seconds, share, count in cases:
        monkeypatch.setattr("franka_wm.training.trainer.EVALUATION_SECONDS", seconds)
        monkeypatch.setattr("franka_wm.training.trainer.EVALUATION_SHARE", share)
        trainer = make(f"{every}-{seconds}-{share}", updates=40, evaluate=slowly)
        trainer.settings = trainer.settings.changed(evaluation={"every": every})
        trainer.fit()
        assert sum("eval/policy/success" in row for row in trainer.rows) == count
        assert capsys.readouterr().out.count("some are left out") == (count == 1)
        assert sum(left_out) >= 1.0 * count, "rates are of updates alone"
        left_out.clear()


def test_evaluation_at_environment_steps(make: Make, capsys) -> None:
    """At the end of the batch in which the steps are reached, once, and not again by a resumed run."""
    trainer = make(updates=40, evaluate=lambda: {"eval/policy/success": 0.5})
    trainer.settings = trainer.settings.changed(evaluation={"at_steps": [17 * N, 21 * N, 22 * N]})
    trainer.fit()  # 10 steps to begin with, then 5 for every 10 updates
    rows = [row for row in trainer.rows if "eval/policy/success" in row]
    assert [row["env_steps"] for row in rows] == [20 * N, 25 * N]

    resumed = make("resumed", updates=60, evaluate=lambda: {"eval/policy/success": 0.5})
    resumed.settings = resumed.settings.changed(evaluation={"at_steps": [17 * N, 33 * N, 999 * N]})
    restore(resumed, load_checkpoint(latest_checkpoint(trainer.folder)))
    resumed.fit()
    assert f"at_steps=[{999 * N}]: not evaluated" in capsys.readouterr().out
    rows = [row for row in resumed.rows[len(trainer.rows) :] if "eval/policy/success" in row]
    assert [row["env_steps"] for row in rows] == [35 * N]


@pytest.mark.parametrize("reward", [torch.nan, -torch.inf])
def test_rewards_that_are_not_finite_are_not_blamed_on_the_learning_rate(make: Make, reward: float) -> None:
    """Of -inf losses stay finite where a model clips its targets."""
    trainer = make(updates=10)
    draw = trainer._draw

    def spoiled() -> TensorDictBase:
        batch = draw()
        batch["next", "reward"].fill_(reward)
        return batch

    trainer._draw = spoiled
    with pytest.raises(UserError, match=r"broke: (\d+) of \1 rewards .* update 1; mend the reward of reach"):
        trainer.fit()


def test_policies_take_turns(make: Make) -> None:
    """Smooth random motion first, then the actor."""
    trainer = make(updates=10)
    used = []
    forward = trainer.acting.forward
    trainer.acting.forward = lambda td: (used.append(trainer.acting.name), forward(td))[1]  # type: ignore[method-assign]
    trainer.fit()
    acted = used[-15:]
    assert acted == ["random"] * 10 + ["policy"] * 5
