"""Windows that begin with the acting policy's memory (`model.stored_state`): as it was, or none where it would lie."""

from __future__ import annotations

import pytest
import torch

from franka_wm.data.hindsight import Hindsight
from franka_wm.envs import FrankaEnv
from franka_wm.errors import UserError
from franka_wm.training import build, resume, storage_budget
from franka_wm.training.check import check
from franka_wm.training.spaces import Spaces
from tests.training.conftest import Make

ARM = ("env=reach", "env.substeps=1", "env.episode_length=10", "seed=0", "device=cpu")
WORDS = ("scale=smoke", "model=dreamer", "model.stored_state=true", *ARM)


def test_the_replay_keeps_what_the_policy_remembered(make: Make, settled) -> None:
    """From the first step on: random motion would remember nothing."""
    sizes = ("collector.num_envs=4", "collector.seed_steps=20", "replay.capacity=400")
    cfg = settled(*WORDS, *sizes, "trainer.standardize=false", "logger=none")
    trainer = make(cfg=cfg, env=FrankaEnv(cfg.env.arm, num_envs=4, seed=0))
    trainer.seed()
    data, begins = trainer.replay[:], 0
    z = data["context"]
    with torch.no_grad():
        for t in range(1, data.shape[1]):
            seen = data[:, t].select(*trainer.model.observation_keys)
            expected = trainer.model.observe(
                seen, z[:, t - 1], data["action"][:, t - 1], data["is_init"][:, t]
            )
            torch.testing.assert_close(z[:, t], expected)
            begins += int(data["is_init"][:, t].sum())
    assert data.shape[1] >= 20 and begins > 0
    trainer.learner.update(trainer.replay.sample())


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_memory_of_the_recorded_goal_is_forgotten_in_hindsight(share: float, settled) -> None:
    cfg = settled(*WORDS, "collector.num_envs=2", f"replay.hindsight={share}", "model.burn_in=2")
    env = FrankaEnv(cfg.env.arm, num_envs=2, seed=0)
    hindsight = build.make_hindsight(cfg)
    assert isinstance(hindsight, Hindsight) == (share > 0)
    replay = build.make_replay_buffer(cfg, torch.device("cpu"), hindsight)
    root, steps = env.reset(seed=0), []
    for _ in range(30):
        step, root = env.step_and_maybe_reset(root.set("action", torch.zeros(2, env.config.action_dim)))
        steps.append(step.clone().set("context", torch.ones(2, 5)))
    recorded = torch.stack(steps, 1)
    replay.extend(recorded)
    batch = torch.cat([replay.sample() for _ in range(40)])
    known = recorded["goal"].reshape(-1, 3)
    new = ~(batch["goal"][:, 2].unsqueeze(1) == known).all(-1).any(1)
    begins = batch["is_init"].squeeze(-1)
    assert bool(begins[new, 0].all()) and bool((~new).any()) == (share < 1) and bool(new.any()) == (share > 0)
    assert (share == 1) or not bool(begins[~new, 0].all())
    if share:
        assert not bool(begins[new, 1:].all(0).any()), "the steps after it are as they were"
    # A batch of a model that keeps no memory is marked as it was gathered.
    replay = build.make_replay_buffer(cfg, torch.device("cpu"), hindsight)
    replay.extend(recorded.exclude("context"))
    batch = torch.cat([replay.sample() for _ in range(40)])
    assert not bool(batch["is_init"][:, 0].all())


@pytest.mark.parametrize(
    ("words", "what"),
    [
        *(
            (((f"collector.policy={one}",), f"steps of collector.policy={one}"))
            for one in ("random", "noop", "ik")
        ),
        (("replay.demos=nowhere",), "demonstrations"),
        (("trainer=offline", "dataset=lerobot", "dataset.root=nowhere"), "recorded data"),
    ],
)
def test_what_has_no_memory_is_refused(words: tuple[str, ...], what: str, settled, monkeypatch) -> None:
    monkeypatch.setattr("franka_wm.training.check.check_dataset", lambda run: None)
    with pytest.raises(UserError, match=f"model.stored_state=true: {what} have no memory to keep"):
        check(settled(*WORDS, *words))


def test_room_for_memory_is_asked_for(settled, monkeypatch) -> None:
    monkeypatch.setattr(storage_budget, "free_memory", lambda device: 10**7)
    said = []
    for stored in ("false", "true"):
        run = settled(
            *WORDS, f"model.stored_state={stored}", "trainer.updates=4000000", "replay.capacity=4000000"
        )
        spaces = Spaces.of_config(run.env.arm)
        model = build.make_model(run, spaces, "meta")
        with pytest.raises(UserError, match="experience") as refused:
            storage_budget.check_memory(run, model, spaces)
        said.append(float(str(refused.value).split("at least ")[1].split(" GB")[0]))
    assert said[1] - said[0] == pytest.approx(4e6 * 4 * model.latent_dim / 1e9, rel=0.1)


def test_experience_without_memory_cannot_be_resumed_with_it(make: Make, settled) -> None:
    cfg = settled(
        *WORDS, "collector.num_envs=2", "collector.seed_steps=20", "replay.capacity=200", "logger=none"
    )
    trainer = make(cfg=cfg, env=FrankaEnv(cfg.env.arm, num_envs=2, seed=0))
    trainer.seed()
    resume._fitting(trainer, trainer.replay[:])
    with pytest.raises(UserError, match=r"has no context, .*leave the model's options as they were then"):
        resume._fitting(trainer, trainer.replay[:].exclude("context"))
    with pytest.raises(
        UserError, match=r"has no next.reward, .*leave the options of export as they were then"
    ):
        resume._fitting(trainer, trainer.replay[:].exclude(("next", "reward")))
