"""Tests leave nothing behind for those that run after them in the same process."""

import logging
import os
import sys
from pathlib import Path

import pytest

from forks import run_in_fork, script, spare
from franka_wm.envs import franka, tasks
from franka_wm.seeding import derive_seed


def test_a_task_that_a_test_registers_and_removes_others() -> None:
    tasks.register("left_behind", tasks.Reach)
    tasks.TASKS.remove("reach")


def test_is_not_there_for_the_next_one() -> None:
    assert "left_behind" not in tasks._REGISTERED and "left_behind" not in tasks.TASKS
    assert "reach" in tasks.TASKS


def test_a_test_that_changes_its_process() -> None:
    """As TorchRL's logger for Weights & Biases does, and Hydra."""
    os.environ["WANDB_MODE"] = "dryrun"
    del os.environ["HOME"]
    logging.getLogger().addHandler(logging.StreamHandler(sys.stdout))
    logging.getLogger().setLevel(logging.ERROR)


def test_leaves_it_as_it_was() -> None:
    root = logging.getLogger()
    assert "WANDB_MODE" not in os.environ and "HOME" in os.environ
    assert root.level != logging.ERROR
    assert all(type(handler) is not logging.StreamHandler for handler in root.handlers)


def test_forks_of_the_spare_have_seen_nothing_of_the_tests(tmp_path: Path) -> None:
    os.environ["SEEN"] = "yes"
    (tmp_path / "seen.py").write_text("import os; print(os.environ.get('SEEN', 'no'))\n")
    work = script(tmp_path / "seen.py")
    assert run_in_fork(work, tmp_path).stdout == "yes\n"
    assert spare().fork(work, tmp_path).stdout == "no\n"


@pytest.mark.parametrize("time", [1, 2])
def test_environments_without_a_seed_are_counted_anew(time: int) -> None:
    assert franka.own_seed() == derive_seed("worlds", 0)
