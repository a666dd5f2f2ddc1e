"""The end of a run: table, ``evaluation.json``, curves, video."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from franka_wm.envs.camera import project
from franka_wm.evaluation.closed_loop import arm_of, evaluate_policies, play_episodes
from franka_wm.evaluation.tables import motion_table, outcome_table, terminal
from franka_wm.report import written_whole
from franka_wm.report.curves import plot_learning_curves
from franka_wm.report.table import markdown
from franka_wm.report.video import draw_marker, tile_frames, write_png, write_video
from franka_wm.seeding import evaluation_seed, seeded


def evaluate_and_report(
    cfg: DictConfig,
    folder: Path,
    env: Any,
    policies: Mapping[str, Any],
    *,
    rows: Sequence[Mapping[str, float]],
    say: Any = print,
    log_video: Callable[[str, torch.Tensor, int], None] | None = None,
) -> dict[str, dict[str, Any]]:
    """Evaluates every policy on the same unseen episodes and writes what a run leaves behind.

    Writes ``evaluation.json``, ``evaluation.md``, ``curves.png`` and, of the arm, ``video.mp4`` and ``last_frame.png``
    into ``folder``, and prints the table; ``log_video`` is given the film, too. Policies may be any; the
    table shows what there is.
    """
    from rich.console import Console

    say(f"evaluating over {env.num_envs} episodes that training never saw …")
    results = evaluate_policies(
        env,
        policies,
        seed=cfg.seed,
        thorough=bool(cfg.evaluation.get("thorough", False)),
        report=lambda name, r: say(_line(name, r)),
    )
    tables = [table for table in (outcome_table(results), motion_table(results)) if table.rows]
    with written_whole(folder / "evaluation.json") as path:
        path.write_text(json.dumps(results, indent=2) + "\n")
    with written_whole(folder / "evaluation.md") as path:
        path.write_text("\n".join(map(markdown, tables)))
    arm = arm_of(env)
    if rows:
        mark = None if arm is None else arm.config.success_distance
        plot_learning_curves(rows, folder / "curves.png", success_distance=mark)
    if cfg.evaluation.video_episodes and arm is not None:
        name = acting(policies)
        frames = film(cfg, folder, policies[name])
        if log_video is not None:
            log_video(f"eval/{name}", frames, round(arm.config.fps))
    console = Console(width=120)
    for table in tables:
        console.print(terminal(table))
    return results


def acting(policies: Mapping[str, Any]) -> str:
    """The policy that a run is about: the planner, the policy where there is none, else whatever comes first."""
    return next((name for name in ("planner", "policy") if name in policies), next(iter(policies)))


def _line(name: str, result: Mapping[str, Any]) -> str:
    if "final_distance" in result:
        return f"  {name}: final distance {result['final_distance']['mean']:.4f} m"
    return f"  {name}: return {result['return']['mean']:.2f}"


def film(cfg: DictConfig, folder: Path, policy: Any) -> torch.Tensor:
    """``video.mp4`` and ``last_frame.png``: episodes of one policy, the goal drawn as a ring."""
    from franka_wm.training.build import make_evaluation_env

    env = make_evaluation_env(cfg, num_envs=cfg.evaluation.video_episodes)
    arm = arm_of(env)
    assert arm is not None
    size = cfg.evaluation.video_size
    frames: list[torch.Tensor] = []

    def picture() -> None:
        view = arm.render(size, samples=2)
        marks = project(arm.goal, arm.config, size)
        frames.append(draw_marker(view.cpu(), marks.cpu(), radius=size / 32))

    seed = evaluation_seed(cfg.seed)
    with seeded(seed, policy):
        play_episodes(env, policy, seed=seed, video=picture)
    film = tile_frames(torch.stack(frames))
    write_video(film, folder / "video.mp4", fps=round(arm.config.fps))
    write_png(film[-1], folder / "last_frame.png")
    return film
