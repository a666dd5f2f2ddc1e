"""What a run shows at its end: table, curves, video."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from franka_wm.envs.camera import project, whole_arm
from franka_wm.evaluation.closed_loop import play_episodes, success_distance
from franka_wm.evaluation.protocol import Evaluation
from franka_wm.evaluation.results import FILE, Result, last_row
from franka_wm.files import atomic_write
from franka_wm.report.curves import axis, plot_learning_curves
from franka_wm.report.diagnostics import evaluation_markdown, terminal
from franka_wm.report.style import policy_name
from franka_wm.report.table import evaluation_tables
from franka_wm.seeding import drawing_for, seeded
from franka_wm.training.build import arm_of, make_evaluation_env
from franka_wm.training.settings import RunSettings
from franka_wm.video import draw_labels, draw_marker, tile_frames, write_png, write_video


def report_run(
    settings: RunSettings,
    folder: Path,
    env: Any,
    policies: Mapping[str, Any],
    found: Evaluation,
    *,
    rows: Sequence[Mapping[str, float]],
    log: Callable[[Mapping[str, float]], Any] | None = None,
    log_video: Callable[[str, torch.Tensor, int], None] | None = None,
) -> None:
    """Writes what a run leaves behind for people, and prints the table.

    Writes ``evaluation.md``, ``curves.png`` and, of the arm, ``video.mp4`` and ``last_frame.png`` into ``folder``.

    Args:
        settings: Settings of the run.
        folder: Folder of the run; :func:`~franka_wm.evaluation.protocol.evaluate_run` has written its results there.
        env: Evaluation worlds.
        policies: By name.
        found: What they reached.
        rows: What training logged.
        log: Called with the numbers of the curves' last point, which are those of the table.
        log_video: Called with name, film and frames per second.
    """
    from rich.console import Console

    with atomic_write(folder / "evaluation.md") as path:
        path.write_text(evaluation_markdown(found))
    last = last_row([Result(folder / FILE, found.protocol, found.policies)], settings.evaluation.during)
    drawn = [*rows, last]
    if log is not None and last:
        log({name: value for name, value in last.items() if name.startswith("eval/")})
    arm = arm_of(env)
    if x := axis(drawn):
        mark = success_distance(env)
        plot_learning_curves(drawn, folder / "curves.png", x=x, success_distance=mark)
    if settings.evaluation.video_episodes and arm is not None:
        name = acting(policies)
        frames = film(settings, folder, policies[name], name, found)
        if log_video is not None:
            log_video(f"eval/{name}", frames, _slow(arm.config.fps))
    Console(width=120).print(terminal(evaluation_tables(found.policies)[0]))


def acting(policies: Mapping[str, object]) -> str:
    """The policy that a run is about: the planner, the policy where there is none, else whatever comes first."""
    return next((name for name in ("planner", "policy") if name in policies), next(iter(policies)))


def film(settings: RunSettings, folder: Path, policy: Any, name: str, found: Evaluation) -> torch.Tensor:
    """``video.mp4`` and ``last_frame.png``: the worst episodes of one policy at half speed, the goal drawn as a ring.

    They are played again, one after the other, from the same poses with the same random numbers. Each image says which
    episode it is and how it ended.
    """
    rows = found.episodes[name]
    env = make_evaluation_env(settings, num_envs=1)
    arm = arm_of(env)
    assert arm is not None
    size, whole = settings.evaluation.video_size, whole_arm(arm.config, arm.kinematics)
    frames: list[torch.Tensor] = []

    def image() -> None:
        view = arm.render(size, samples=2, config=whole)
        marks = project(arm.goal, whole, size)
        frames.append(draw_marker(view.cpu(), marks.cpu(), radius=size / 32))

    films, lines = [], []
    for number in worst(rows, settings.evaluation.video_episodes):
        k, world = divmod(number, found.worlds)
        together = min(len(rows) - k * found.worlds, found.worlds)
        with seeded(found.seeds[k], policy), drawing_for(world, 1, together):
            played = play_episodes(env, policy, seed=found.seeds[k], first_world=world, video=image)
        films.append(torch.stack(frames))
        lines.append(ending(played, policy_name(name), number, arm))
        frames.clear()
    fps = _slow(arm.config.fps)
    longest = max(map(len, films))  # shorter ones stand still at their ends
    beside = torch.cat(
        [torch.cat([one, one[-1:].expand(longest - len(one), *one.shape[1:])]) for one in films], 1
    )
    beside = torch.cat([beside, beside[-1:].expand(fps, *beside.shape[1:])])  # a second to look at the end
    film = tile_frames(draw_labels(beside, lines))
    write_video(film, folder / "video.mp4", fps=fps)
    write_png(film[-1], folder / "last_frame.png")
    return film


def worst(episodes: TensorDictBase, count: int) -> list[int]:
    """Numbers of the worst, worst first: farthest from the goal; else without success, and by return.

    Args:
        episodes: As :func:`~franka_wm.evaluation.closed_loop.play_episodes` gives them.
    """
    distance = episodes.get("final_distance", None)
    if distance is not None:
        return distance.argsort(descending=True, stable=True)[:count].tolist()
    order = episodes["return"].argsort(stable=True)
    return order[episodes["success"][order].argsort(stable=True)][:count].tolist()


def ending(played: TensorDictBase, who: str, number: int, arm: Any) -> str:
    """One line: policy, final distance where there is a goal, success, and which of the episodes it is, from 1.

    Args:
        played: As :func:`~franka_wm.evaluation.closed_loop.play_episodes` gives it, of one episode.
    """
    distance = played.get("final_distance", None)
    parts = [who]
    if distance is None:
        success = bool(played["success"])
    else:
        success = float(distance) < arm.config.success_distance
        parts.append(f"{100 * float(distance):.1f} cm")
    return ", ".join([*parts, "success" if success else "no success", f"episode {number + 1}"])


def _slow(fps: float) -> int:
    """Half the frames per second of the arm's."""
    return max(1, round(fps / 2))
