"""What a run saves and when: on the way, at its end, when it is asked to stop, and when it breaks."""

from __future__ import annotations

import os
import signal
from types import SimpleNamespace

import pytest
import torch

from franka_wm.errors import UserError
from franka_wm.training import storage_budget
from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint
from tests.training.conftest import Make


def test_a_disk_without_room_costs_the_experience_not_the_weights(make: Make, monkeypatch, capsys) -> None:
    monkeypatch.setattr(storage_budget.shutil, "disk_usage", lambda folder: SimpleNamespace(free=10e6))
    trainer = make()
    trainer.settings = trainer.settings.changed(trainer={"checkpoint_every": 1e-9})
    trainer.fit()
    said = capsys.readouterr().out
    assert said.count("WITHOUT the experience") == 2  # once on the way, and at the end
    checkpoint = load_checkpoint(latest_checkpoint(trainer.folder))
    assert checkpoint.counters["updates"] == 20 and checkpoint.replay("cpu") is None


def test_large_experience_is_written_at_the_end_alone(make: Make, monkeypatch, capsys) -> None:
    monkeypatch.setattr(storage_budget, "BETWEEN", 10.0)
    trainer = make(updates=40)
    trainer.settings = trainer.settings.changed(trainer={"checkpoint_every": 1e-9})
    written = []
    experience = trainer.experience
    trainer.experience = lambda: (written.append(trainer.learner.updates), experience())[1]  # type: ignore[method-assign]
    trainer.fit()
    assert written == [40]
    assert capsys.readouterr().out.count("written at the end") == 1
    assert load_checkpoint(latest_checkpoint(trainer.folder)).replay("cpu") is not None


def test_who_is_asked_to_stop_saves_before_anything_else(make: Make, capsys) -> None:
    """Whoever asked may kill it soon: the evaluation that was due is left to the run that goes on."""
    trainer = make(updates=40, evaluate=lambda: pytest.fail("evaluated"))
    trainer.settings = trainer.settings.changed(evaluation={"every": 10, "at_steps": [1, 999]})
    trainer._draw = lambda draw=trainer._draw: (signal.raise_signal(signal.SIGTERM), draw())[1]  # type: ignore
    trainer.fit()
    assert trainer.interrupted and trainer.learner.updates == 1  # not the whole batch of 10
    assert latest_checkpoint(trainer.folder).is_dir()
    assert capsys.readouterr().out.count("at_steps") == 1  # one is left out; the other is still ahead


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_with_everything_saved(make: Make, number: int) -> None:
    before = signal.getsignal(number)
    trainer = make(
        updates=40, evaluate=lambda: (os.kill(os.getpid(), number), {"eval/policy/success": 0.5})[1]
    )
    trainer.settings = trainer.settings.changed(evaluation={"every": 10})
    trainer.fit()
    assert trainer.interrupted and trainer.learner.updates == 10
    checkpoint = load_checkpoint(latest_checkpoint(trainer.folder))
    assert checkpoint.counters["updates"] == 10 and checkpoint.replay("cpu") is not None
    assert signal.getsignal(number) is before


@pytest.mark.parametrize("at_once", [True, False])
def test_a_run_that_breaks_stops_and_keeps_the_last_whole_checkpoint(
    make: Make, at_once: bool, monkeypatch
) -> None:
    """Within a few updates on the CPU; elsewhere (no wait for the device in between) before it logs or saves."""
    trainer = make(updates=60, checkpoint_every=1e-9, log_every=1e6)  # to log is to ask, too
    update, broken = trainer.learner.update, trainer.learner.broken
    asked = []

    def breaking(*arguments, **options) -> None:
        if trainer.learner.updates == 12:
            for group in trainer.learner.optimizer.param_groups:
                group["lr"] = 1e30
        update(*arguments, **options)

    trainer.learner.update = breaking  # type: ignore[method-assign]
    if not at_once:
        trainer._asks_at_once = False  # as on CUDA
        trainer.learner.broken = lambda: (asked.append(trainer.learner.updates), broken())[1]  # type: ignore[method-assign]
    with pytest.raises(UserError, match=r"not finite at update \d+; lower trainer\.lr") as caught:
        trainer.fit()
    assert 12 < trainer.learner.updates <= (20 if not at_once else 16)
    assert asked == ([] if at_once else [10, 20])
    latest = load_checkpoint(latest_checkpoint(trainer.folder))
    assert latest.counters["updates"] == 10 and str(latest.folder) in str(caught.value)
    latest.load_model(trainer.model)
    assert all(x.isfinite().all() for x in trainer.model.state_dict().values() if isinstance(x, torch.Tensor))


def test_weights_that_are_not_finite_are_not_saved(make: Make) -> None:
    """Though the losses so far were."""
    trainer = make(updates=10)
    trainer.fit()
    with torch.no_grad():
        next(iter(trainer.model.parameters())).flatten()[0] = torch.inf
    with pytest.raises(UserError, match="weights not finite"):
        trainer.save()
    assert load_checkpoint(latest_checkpoint(trainer.folder)).counters["updates"] == 10
