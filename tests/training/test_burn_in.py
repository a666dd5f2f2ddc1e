"""Steps in front of windows (`model.burn_in`): whatever makes a run's batches gives as many as its model asks for."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from franka_wm.commands import main as cli
from franka_wm.envs import FrankaEnv
from franka_wm.errors import UserError
from franka_wm.training import build, storage_budget
from franka_wm.training.demos import open_demonstrations
from franka_wm.training.spaces import Spaces

ARM = ("env=reach", "env.substeps=1", "env.episode_length=10", "seed=0", "device=cpu")
WORDS = ("scale=smoke", "model=dreamer", *ARM)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("recorded") / "reach"
    assert cli.main(["collect", f"out={root}", "policy=ik", "episodes=3", "num_envs=3", *ARM]) == 0
    return root


def test_recorded_windows_have_them(recorded: Path, settled) -> None:
    run = settled(*WORDS, "dataset=lerobot", "trainer=offline", f"dataset.root={recorded}", "model.burn_in=3")
    train, held_out = build.open_recorded(run, torch.device("cpu"))
    assert train.sample().shape == (run.replay.batch_size, 3 + run.window)
    assert held_out is not None and held_out.sample().shape == train.sample().shape


def test_a_batch_of_the_replay_and_demonstrations_has_them(recorded: Path, settled) -> None:
    """With goals in hindsight, of what the run keeps; and as the model's loss takes them."""
    run = settled(*WORDS, f"replay.demos={recorded}", "collector.num_envs=2")
    env = FrankaEnv(run.env.arm, num_envs=2, seed=0)
    spaces, hindsight = Spaces.of_env(env), build.make_hindsight(run)
    shown = open_demonstrations(run, spaces, hindsight)
    replay = build.make_replay_buffer(run, torch.device("cpu"), hindsight, shown)
    model = build.make_model(run, spaces, torch.device("cpu"))
    keys = [*model.observation_keys, "action", "is_init"]
    after = [("next", key) for key in (*model.observation_keys, "reward", "terminated")]
    root, steps = env.reset(seed=0), []
    for _ in range(30):
        step, root = env.step_and_maybe_reset(
            root.clone().set("action", torch.zeros(2, env.config.action_dim))
        )
        steps.append(step.select(*keys, *after).clone())
    replay.extend(torch.stack(steps, 1))
    batch = torch.cat([replay.sample() for _ in range(20)])
    assert run.burn_in == 4 and batch.shape == (20 * run.replay.batch_size, 4 + run.window)
    assert batch["demonstrated"][:, 0].any() and not batch["demonstrated"][:, 0].all()
    goal = batch["state"][..., 14:17] - batch["state"][..., 17:20]
    assert torch.allclose(goal[:, 4:], goal[:, 4:5].expand_as(goal[:, 4:]), atol=1e-6)
    same = batch["is_init"].flatten(1)[:, 1:5].flip(1).cumsum(1).flip(1) == 0  # of the window's episode
    assert (((goal[:, :4] - goal[:, 4:5]).abs() < 1e-6).all(-1) | ~same).all()
    assert model.loss(batch)["loss"].isfinite()


def test_memory_is_asked_for_whole_batches(settled, monkeypatch) -> None:
    monkeypatch.setattr(storage_budget, "free_memory", lambda device: 10**9)
    said = []
    for steps in (0, 8):
        run = settled(*WORDS, "replay.batch_size=4000000", f"model.burn_in={steps}")
        spaces = Spaces.of_config(run.env.arm)
        with pytest.raises(UserError) as refused:
            storage_budget.check_memory(run, build.make_model(run, spaces, "meta"), spaces)
        said.append(re.search(r"a batch .*: at least ([\d.]+) GB", str(refused.value)))
    alone, longer = (float(one[1]) for one in said if one)
    assert longer == pytest.approx(2 * alone, rel=0.02)
