"""What a run shows at its end: table, curves, video."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDictBase

from franka_wm.console import say
from franka_wm.envs import FrankaConfig, FrankaEnv, MultiTaskEnv
from franka_wm.envs.camera import project, whole_arm
from franka_wm.envs.multitask_config import MultiTaskConfig
from franka_wm.envs.transformed import arm_of
from franka_wm.evaluation.closed_loop import play_episodes, success_distance
from franka_wm.evaluation.protocol import Evaluation
from franka_wm.evaluation.results import FILE, Result, last_row
from franka_wm.files import atomic_write
from franka_wm.report.curves import axis, plot_learning_curves
from franka_wm.report.diagnostics import evaluation_markdown, terminal
from franka_wm.report.style import acting, policy_name
from franka_wm.report.table import evaluation_tables
from franka_wm.seeding import drawing_for, seeded
from franka_wm.training.build import make_evaluation_env
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
    arms = _arms(env)
    if x := axis(drawn):
        mark = success_distance(env)
        plot_learning_curves(drawn, folder / "curves.png", x=x, success_distance=mark)
    if settings.evaluation.video_episodes and arms:
        name = acting(policies)
        say(f"filming the {policy_name(name)} …")
        frames = film(settings, folder, policies[name], name, found)
        if log_video is not None:
            log_video(f"eval/{name}", frames, _film_rate(arms))
    Console(width=120).print(terminal(evaluation_tables(found.policies)[0]))


def film(settings: RunSettings, folder: Path, policy: Any, name: str, found: Evaluation) -> torch.Tensor:
    """``video.mp4`` and ``last_frame.png``: the worst episodes of one policy at half speed, the goal drawn as a ring.

    They are played again, one after the other, from the same poses with the same random numbers. Each image says which
    episode it is and how it ended. Of several tasks at once each is shown, by as many episodes as each of the others.
    """
    rows = found.episodes[name]
    config = settings.env.config
    tasks = len(config.tasks) if isinstance(config, MultiTaskConfig) else 1
    env = make_evaluation_env(settings, num_envs=tasks)
    arms = _arms(env)
    size = settings.evaluation.video_size
    fps = _film_rate(arms)
    views = {task: whole_arm(arm.config, arm.kinematics) for task, arm in arms.items()}
    films, lines = [], []
    for number in _filmed(rows, settings.evaluation.video_episodes, found.worlds, tasks):
        k, world = divmod(number, found.worlds)
        place = world % tasks  # worlds have tasks in turn, from the first one's
        first, together = world - place, min(len(rows) - k * found.worlds, found.worlds)
        task, arm = list(arms.items())[place]
        frames, count = [], min(tasks, together - first)
        image = partial(_image, arm, views[task], size, frames)
        with seeded(found.seeds[k], policy), drawing_for(first, count, together):
            played = play_episodes(
                env, policy, seed=found.seeds[k], episodes=count, first_world=first, video=image
            )
        own: Any = played[place : place + 1]
        # Other tasks' episodes may be longer, and their rates higher.
        films.append(_at_rate(torch.stack(frames[: int(own["length"])]), _slow(arm.config.fps), fps))
        who = policy_name(name) if tasks == 1 else f"{task}, {policy_name(name)}"
        lines.append(ending(own, who, number))
    longest = max(map(len, films))  # shorter ones stand still at their ends
    beside = torch.cat(
        [torch.cat([one, one[-1:].expand(longest - len(one), *one.shape[1:])]) for one in films], 1
    )
    beside = torch.cat([beside, beside[-1:].expand(fps, *beside.shape[1:])])  # a second to look at the end
    film = tile_frames(draw_labels(beside, lines))
    write_video(film, folder / "video.mp4", fps=fps)
    write_png(film[-1], folder / "last_frame.png")
    return film


def _arms(env: Any) -> dict[str, FrankaEnv]:
    """The arms of an environment by their tasks: one, or several at once; none of another library."""
    if isinstance(env, MultiTaskEnv):
        return env.envs
    arm = arm_of(env)
    return {} if arm is None else {arm.config.task: arm}


def _image(arm: FrankaEnv, camera: FrankaConfig, size: int, frames: list[torch.Tensor]) -> None:
    """Adds what a camera shows of the first world now, (1, size, size, 3), to the frames."""
    view = arm.render(size, samples=2, config=camera)
    marks = project(arm.goal, camera, size)
    frames.append(draw_marker(view.cpu(), marks.cpu(), radius=size / 32))


def _filmed(episodes: TensorDictBase, count: int, worlds: int, tasks: int) -> list[int]:
    """Numbers of the worst episodes, of each task as many, in order of the tasks; worlds have tasks in turn."""
    numbers = torch.arange(len(episodes))
    out = []
    for task in range(tasks):
        own = numbers[numbers % worlds % tasks == task]
        out += own[worst(cast(TensorDictBase, episodes[own]), -(-count // tasks))].tolist()
    return out


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


def ending(played: TensorDictBase, who: str, number: int) -> str:
    """One line: policy, final distance where there is a goal, success, and which of the episodes it is, from 1.

    Args:
        played: As :func:`~franka_wm.evaluation.closed_loop.play_episodes` gives it, of one episode.
    """
    distance = played.get("final_distance", None)
    parts = [who, *([] if distance is None else [f"{100 * float(distance):.1f} cm"])]
    success = "success" if bool(played["success"]) else "no success"
    return ", ".join([*parts, success, f"episode {number + 1}"])


def _slow(fps: float) -> int:
    """Half the frames per second of the arm's."""
    return max(1, round(fps / 2))


def _film_rate(arms: Mapping[str, Any]) -> int:
    """Frames per second of a film of all of these."""
    return max(_slow(arm.config.fps) for arm in arms.values())


def _at_rate(frames: torch.Tensor, own: int, fps: int) -> torch.Tensor:
    """Frames of which ``own`` are a second as ``fps`` of them are, some of them several times."""
    return frames[torch.arange(-(-len(frames) * fps // own)) * own // fps]
