"""Episodes of the evaluation: none of them occurs in training, whatever the seed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase

from franka_wm.envs.simulation import Simulation
from franka_wm.evaluation.protocol import during_training, evaluate_run, held_out_seeds
from franka_wm.evaluation.rollouts import ROLLOUT_SEED
from franka_wm.policies.scripted import NoopPolicy, SmoothRandomPolicy
from franka_wm.seeding import derive_seed, evaluation_seed
from franka_wm.training import build
from franka_wm.training.run import Run
from franka_wm.training.settings import RunSettings

EPISODES = 12


class Watching(NoopPolicy):
    """Does nothing, and keeps joint angles and goals of the first observations that it sees."""

    def __init__(self) -> None:
        super().__init__()
        self.starts: list[torch.Tensor] = []

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        first = tensordict.get("is_init").squeeze(-1)
        self.starts.append(torch.cat([tensordict.get("state")[:, :7], tensordict.get("goal")], 1)[first])
        return super().forward(tensordict)


@pytest.fixture(scope="module")
def cfg(settled, tiny: list[str]) -> RunSettings:
    sizes = [one for one in tiny if not one.startswith("env.episode_length")]
    return settled(*sizes, "env.episode_length=4", "env.observations=[state,joint_target]", "seed=5")


@pytest.fixture(scope="module")
def run(cfg: RunSettings, tmp_path_factory) -> Run:
    return Run(settings=cfg, folder=tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def worlds(run: Run) -> tuple[Any, Any]:
    return run.build_environments()


@pytest.fixture(scope="module")
def trained(worlds) -> torch.Tensor:
    """Joint angles and goals at the start of every episode that training plays, (worlds · EPISODES, 10)."""
    env = worlds[0]
    watching = Watching()
    root = env.reset()
    for _ in range(EPISODES * env.config.episode_length):
        root = env.step_and_maybe_reset(watching(root))[1]
    starts = torch.cat(watching.starts)
    assert len(starts) == env.num_envs * EPISODES
    return starts


def meet(a: torch.Tensor, b: torch.Tensor) -> bool:
    return bool(((a.unsqueeze(1) - b.unsqueeze(0)).abs() < 1e-4).all(-1).any())


def test_no_episode_of_the_evaluation_occurs_in_training(run: Run, worlds, trained) -> None:
    watching = Watching()
    during = during_training(run.settings.evaluation, worlds[1], {"policy": watching})
    assert during()
    evaluate_run(
        run.settings, run.folder, worlds[1], {"policy": watching}, counters={}, say=lambda text: None
    )
    evaluated = torch.cat(watching.starts)
    assert len(evaluated) >= 2 * run.settings.evaluation.episodes
    assert not meet(evaluated, trained)
    worlds[0].set_seed(derive_seed("training", run.settings.seed))
    root = worlds[0].reset()
    assert meet(torch.cat([root["state"][:, :7], root["goal"]], 1), trained)  # such a meeting would be seen


def test_seeds_of_a_whole_run(train, monkeypatch, tmp_path: Path) -> None:
    """Worlds of training get training's seed, worlds of the evaluation held-out ones; the run's own: nobody."""
    given: dict[int, set[int]] = {1: set(), 2: set(), 3: set()}
    set_seed = Simulation.set_seed
    monkeypatch.setattr(
        Simulation, "set_seed", lambda self, seed: (given[self.num_envs].add(seed), set_seed(self, seed))[1]
    )
    train("seed=5", "evaluation.during=[policy]", "evaluation.every=10", "evaluation.video_episodes=4")
    training, evaluation = derive_seed("training", 5), evaluation_seed(5)
    held_out = held_out_seeds(1)[0]
    assert given == {3: {training}, 2: {evaluation, held_out}, 1: {held_out}}  # the film has one world
    assert len({5, training, evaluation, *held_out_seeds(3), ROLLOUT_SEED}) == 7


def test_held_out_seeds_are_no_seeds_of_training() -> None:
    """Of other purposes, whatever the run's own seed; published results are of these."""
    held_out = held_out_seeds(1000)
    assert held_out[:3] == [1248032192, 2113170484, 117168142]
    others = {
        purpose: {derive_seed(purpose, seed) for seed in range(1000)}
        for purpose in ("training", "evaluation")
    }
    assert not any(others[purpose] & set(held_out) for purpose in others)
    assert not set(range(1000)) & set(held_out)


def test_seeds_of_the_worlds_of_a_configuration(cfg: RunSettings) -> None:
    """Also of those that are built alone, to look at a checkpoint."""
    assert build.make_env(cfg, num_envs=1).simulation.tensors.seed[0].item() == derive_seed("training", 5)
    assert build.make_evaluation_env(cfg, num_envs=1).simulation.tensors.seed[0].item() == evaluation_seed(5)


def test_policies_draw_from_the_purpose_they_serve(cfg: RunSettings, worlds) -> None:
    env = worlds[0]
    model = build.make_model(cfg, env)
    made = [
        build.make_agent_policies(cfg, model, env, build.Spaces.of_env(env), purpose=purpose)["random"]
        for purpose in ("training", "evaluation")
    ]
    assert all(isinstance(policy, SmoothRandomPolicy) for policy in made)
    assert made[0].generator is not made[1].generator
    assert made[0].generator.initial_seed() != made[1].generator.initial_seed()
