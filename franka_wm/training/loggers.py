"""Where the numbers of a run go: files always, and services by name.

``csv`` and ``tensorboard`` write into the run's folder and need nothing. ``wandb``, ``mlflow`` and ``trackio`` are
TorchRL's wrappers around packages that are installed by who wants them. Videos are encoded here, with the same
writer as everywhere else: TorchRL's own way needs moviepy or torchcodec, of which neither need be installed.
"""

from __future__ import annotations

import importlib.util
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from torch import Tensor
from torchrl.record.loggers import Logger

from franka_wm.console import say
from franka_wm.errors import UserError
from franka_wm.files import atomic_write
from franka_wm.options import leaves

FILES = ("csv", "tensorboard")
SERVICES = ("wandb", "mlflow", "trackio")
NAMES = (*FILES, *SERVICES)

PROJECT = "franka_wm"

MOST_PARAMETERS, LONGEST_PARAMETER = 100, 6000
"""What MLflow takes in one call, and in one value."""

OPTIONS = {
    "wandb": {"project", "offline", "entity", "group", "tags"},
    "mlflow": {"experiment", "uri"},
    "trackio": {"project", "space_id"},
}


def check_loggers(names: Iterable[str], **options: Mapping[str, object]) -> None:
    """Whether `make_loggers` could open these, before anything is built.

    Raises:
        UserError: a logger or an option that does not exist, or a package that is not installed.
    """
    for name in names:
        if name not in NAMES:
            raise UserError(f"no logger {name!r}; choose from {', '.join(NAMES)}.")
        if name in SERVICES and importlib.util.find_spec(name) is None:
            raise UserError(
                f"logger {name!r} needs a package that is not installed: pip install 'franka-wm[{name}]'"
            )
    for name, given in options.items():
        if name not in OPTIONS:
            raise UserError(f"no options for a logger {name!r}; {', '.join(OPTIONS)} have some.")
        unknown = sorted(set(given) - OPTIONS[name])
        if unknown:
            raise UserError(
                f"logger {name!r} has no option {unknown[0]!r}; choose from {', '.join(sorted(OPTIONS[name]))}."
            )


def make_loggers(
    names: Sequence[str], folder: str | Path, *, updates: int | None = None, **options: Mapping[str, object]
) -> list[Logger]:
    """Open loggers.

    Args:
        names: of `NAMES`, in any order; none for no logging.
        folder: of the run. Files go there, also what an offline service keeps; its name is the run's.
        updates: of the checkpoint that a run goes on from: what files hold of later ones is taken out, since the run
            makes those anew.
        options: by logger, as ``conf/logger/NAME.yaml`` lists them.

    Returns:
        TorchRL loggers, in the order of `names`.

    Raises:
        UserError: see `check_loggers`; or a service that cannot be reached or refuses.
    """
    check_loggers(names, **options)
    loggers = []
    for name in names:
        try:
            if name == "csv" and updates is not None:
                _forget_later_lines(Path(folder) / name, updates)
            loggers.append(_open(name, Path(folder), dict(options.get(name, {}))))
            if name == "tensorboard" and updates is not None:
                _forget_later_events(loggers[-1], updates)
        except Exception as error:  # a service fails in ways of its own
            close_loggers(loggers)
            hint = "; logger.wandb.offline=true works without it" if name == "wandb" else ""
            raise UserError(f"logger {name!r} cannot start: {error}{hint}") from error
    return loggers


def log_numbers(loggers: Iterable[Logger], numbers: Mapping[str, float], *, step: int) -> None:
    """Log a row of numbers: one entry of a service's history, not one for each number.

    What cannot be logged (a full disk, a service that is away) is said, here as below, and training goes on.

    Args:
        numbers: by name; a service shows ``a/b`` as b in the group a.
        step: updates made.
    """
    for logger in loggers:
        with _going_on(logger, f"cannot log the numbers of update {step}"):
            _log_row(logger, dict(numbers), step)


@contextmanager
def _going_on(logger: Logger, fails: str) -> Iterator[None]:
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # services fail in ways of their own
        say(f"  warning: {kind(logger)} {fails}: {error}")


def _log_row(logger: Any, numbers: dict[str, float], step: int) -> None:
    if kind(logger) == "trackio":  # TorchRL would send one message for each number
        logger.experiment.log(numbers, step=step)
    elif kind(logger) == "wandb":  # the run's own step: charts of all groups share it
        logger.log_metrics(numbers, step=step, override_global_step=True)
    else:
        logger.log_metrics(numbers, step=step)


def log_config(loggers: Iterable[Logger], config: Mapping[str, object]) -> None:
    """Tell the services what is being run; files have ``config.yaml`` beside them.

    Args:
        config: nested, resolved, plain values.
    """
    for logger in loggers:
        if kind(logger) == "mlflow":  # knows no nesting, and takes so many at a time
            mlflow = import_module("mlflow")
            flat = [(name, str(value)[:LONGEST_PARAMETER]) for name, value in leaves(config).items()]
            for start in range(0, len(flat), MOST_PARAMETERS):
                mlflow.log_params(dict(flat[start : start + MOST_PARAMETERS]))
        elif kind(logger) in ("wandb", "trackio"):
            logger.log_hparams(dict(config))


def log_video(loggers: Iterable[Logger], name: str, frames: Tensor, *, fps: int, step: int) -> None:
    """Log a video where the logger can show or keep it; all of `NAMES` can.

    ``csv`` keeps ``csv/videos/NAME_STEP.mp4``; TensorBoard shows an animated image; services get an .mp4.

    Args:
        frames: (T, H, W, 3) uint8, H and W even.
        fps: frames per second.
        step: updates made.

    Raises:
        UserError: other frames, or a file that cannot be written.
    """
    from franka_wm.video import write_gif, write_video

    with tempfile.TemporaryDirectory() as place:
        film = Path(place) / f"{name.replace('/', '_')}_{step}.mp4"
        for logger in loggers:
            with _going_on(logger, f"cannot log the video {name} of update {step}"):
                which = kind(logger)
                if which == "csv":
                    folder = Path(logger.experiment.log_dir) / "videos"
                    write_video(frames, folder / f"{name}_{step}.mp4", fps)
                    continue
                if which == "tensorboard":
                    moving = write_gif(frames, film.with_suffix(".gif"), fps)
                    _tensorboard_image(logger, name, moving.read_bytes(), frames, step)
                    continue
                if not film.exists():
                    write_video(frames, film, fps)
                if which == "wandb":
                    shown = import_module("wandb").Video(str(film), format="mp4")
                    logger.experiment.log({name: shown}, step=step)
                elif which == "mlflow":
                    import_module("mlflow").log_artifact(str(film), "videos")
                elif which == "trackio":
                    shown = import_module("trackio").Video(str(film), fps=fps, format="mp4")
                    logger.experiment.log({name: shown}, step=step)


def close_loggers(loggers: Iterable[Logger]) -> None:
    """Write what is still held back, and end runs, so that services do not show them as running or crashed."""
    for logger in loggers:
        with _going_on(logger, "cannot end its run"):
            if kind(logger) == "mlflow":
                import_module("mlflow").end_run()
            else:
                logger.shutdown()


def kind(logger: Logger) -> str:
    """Which of `NAMES` a TorchRL logger is."""
    name = type(logger).__name__.removesuffix("Logger").lower()
    return name if name in NAMES else "other"


def _forget_later_lines(folder: Path, updates: int) -> None:
    """Removes lines beyond so many updates of every quantity, and what is no line, as one that was cut off."""
    for file in sorted(folder.rglob("*.csv")):
        lines = file.read_bytes().decode(errors="replace").splitlines(keepends=True)
        found = [re.match(r"(\d+),.*\n$", line) for line in lines]
        kept = [one[0] for one in found if one is not None and int(one[1]) <= updates]
        if len(kept) < len(lines):
            with atomic_write(file) as path:
                path.write_text("".join(kept), encoding="utf-8")


def _forget_later_events(logger: Any, updates: int) -> None:
    """Tells TensorBoard, which only adds to its files, that what follows so many updates is written anew."""
    events = import_module("tensorboard.compat.proto.event_pb2")
    start = events.SessionLog(status=events.SessionLog.START)
    logger.experiment._get_file_writer().add_event(events.Event(session_log=start), updates + 1)


def _open(name: str, folder: Path, options: dict[str, Any]) -> Any:
    from torchrl.record.loggers import get_logger
    from torchrl.record.loggers.mlflow import MLFlowLogger

    given = {key: value for key, value in options.items() if value is not None}
    if "tags" in given:
        given["tags"] = list(given["tags"])  # from a configuration it is a list of another type
    if name in FILES:
        return get_logger(name, logger_name=str(folder), experiment_name=name)
    if name == "wandb":
        # Its list of installed packages names folders of this machine; versions.json says what matters.
        given = {"project": PROJECT, "log_env_packages": False, **given}
        return get_logger("wandb", logger_name=str(folder), experiment_name=folder.name, wandb_kwargs=given)
    if name == "trackio":
        given = {"project": PROJECT, **given}
        return get_logger(
            "trackio", logger_name=str(folder), experiment_name=folder.name, trackio_kwargs=given
        )
    # TorchRL's get_logger points MLflow at a folder, which MLflow no longer writes to: a database it is.
    uri = given.get("uri") or os.environ.get("MLFLOW_TRACKING_URI")
    artifacts = None
    if uri is None:
        place = folder.resolve() / "mlflow"
        place.mkdir(parents=True, exist_ok=True)
        uri, artifacts = f"sqlite:///{place / 'mlflow.db'}", (place / "files").as_uri()
    logger = MLFlowLogger(
        exp_name=given.get("experiment", PROJECT), tracking_uri=uri, artifact_location=artifacts
    )
    import_module("mlflow").set_tag("mlflow.runName", folder.name)  # it would invent one
    return logger


def _tensorboard_image(logger: Any, name: str, gif: bytes, frames: Tensor, step: int) -> None:
    """TensorBoard plays a .gif that is logged as an image; its own `add_video` needs moviepy."""
    Summary = import_module("tensorboard.compat.proto.summary_pb2").Summary
    _, height, width, _ = frames.shape
    image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=gif)
    summary = Summary(value=[Summary.Value(tag=name, image=image)])
    logger.experiment._get_file_writer().add_summary(summary, step)
