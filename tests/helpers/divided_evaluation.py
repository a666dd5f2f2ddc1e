"""Evaluations whose episodes two processes divide."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import distributed

from franka_wm import processes
from franka_wm.commands.overrides import compose
from franka_wm.evaluation import protocol
from franka_wm.training import build
from franka_wm.training.run import Run
from franka_wm.training.settings import RunSettings

SMOKE = ["scale=smoke", "device=cpu", "collector.num_envs=6", "logger=none", "gpus=2"]
SHORT, TASKS = "env.episode_length=12", ("reach", "track", "lift")
LEFT_OUT = ("push", "pick", "stack", "drawer", "peg")
EXTERNAL = [SHORT, "model=tdmpc2", "evaluation.episodes=5", "collector.policy=random"]
CASES: dict[str, list[str]] = {
    "reach": ["env=reach", SHORT, "evaluation.episodes=5", "env.goal_sampling=reachable",
              "env.randomization.action_noise=0.1"],
    "multitask": ["env=multitask", "evaluation.episodes=7", *(f"~env.tasks.{one}" for one in LEFT_OUT),
                  *(f"env.tasks.{one}.episode_length=12" for one in TASKS)],
    "gym": ["env=gym", "env.name=Pendulum-v1", *EXTERNAL],
    "dm_control": ["env=dm_control", "env.name=cartpole", "env.task=swingup", *EXTERNAL],
}  # fmt: skip
for extra, name in {"gymnasium": "gym", "dm_control": "dm_control"}.items():
    if find_spec(extra) is None:
        del CASES[name]


def evaluated(name: str, folder: Path) -> dict[str, Any]:
    """Rows of each policy, the table of the run's end, a point of its curves, how many episodes were played here."""
    settings = RunSettings.of(compose([*SMOKE, *CASES[name]]))
    run = Run(settings, folder)
    env, worlds = run.build_environments()
    assert worlds is not None
    spaces = build.Spaces.of_env(worlds)
    torch.manual_seed(1)
    model = build.make_model(settings, spaces, run.device)
    policies = build.make_agent_policies(settings, model, worlds, spaces)
    played, play = [], protocol.play_episodes

    def counting(*arguments: Any, **options: Any) -> TensorDict:
        out = play(*arguments, **options)
        played.append(len(out))
        return out

    protocol.play_episodes = counting
    try:
        torch.manual_seed(processes.rank())  # what a process has drawn before must not matter
        found = protocol.evaluate_run(settings, folder, worlds, policies, counters={})
        together = protocol.all_worlds(settings.evaluation, worlds)
        point = protocol.numbers_to_log(worlds, policies, episodes=3, together=together)
    finally:
        protocol.play_episodes = play
    assert env is not None
    env.close()
    worlds.close()
    rows = {name: one.to_dict() for name, one in found.episodes.items()}
    return {
        "rows": rows,
        "policies": found.policies,
        "protocol": found.protocol,
        "point": point,
        "played": played,
    }


def together(folder: Path) -> None:
    """What one process of the job does: it writes what it has found into a folder."""
    distributed.init_process_group("gloo")
    for name in CASES:
        (folder / name).mkdir(exist_ok=True)
    found = {name: evaluated(name, folder / name) for name in CASES}
    torch.save(found, folder / f"found{processes.rank()}.pt")
    processes.wait()
    processes.leave()
