"""The command line of ``train.py``: the scale by the device, overrides checked early, errors in one line."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from franka_wm.commands.overrides import compose
from franka_wm.console import say
from franka_wm.errors import FrankaError

INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells expect."""


def run_command(main: Callable[[], Any], arguments: list[str] | None = None) -> None:
    """Runs a Hydra main: chooses the scale by device, and turns bad input into one line and exit status 1.

    Args:
        main: Reads ``sys.argv``, as Hydra's are.
        arguments: After the program's name; the command line's if not given.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    sys.argv[1:] = arguments
    sweeps = any(a in ("-m", "--multirun") for a in arguments)
    asks_hydra = any(a.startswith("-") and a not in ("-m", "--multirun") for a in arguments)
    if not asks_hydra and not sweeps:
        check_overrides(arguments)
    import warp as wp  # from here on: what takes seconds to import

    wp.config.log_level = wp.LOG_WARNING  # its list of compiled modules drowns what a run has to say
    if not asks_hydra:
        sys.argv[1:] = arguments = with_scale(arguments)
        problem = check_command(arguments)
        if problem is not None:
            fail(problem)
    main()


def one_line_errors(main: Callable[[DictConfig], Any]) -> Callable[[DictConfig], Any]:
    """Inside Hydra's own wrapper, which would print a traceback for what is the user's to mend."""

    @functools.wraps(main)
    def wrapped(cfg: DictConfig) -> Any:
        try:
            return main(cfg)
        except FrankaError as error:
            fail(str(error))
        except KeyboardInterrupt:
            print(
                "stopped; what was saved is in the run's folder: python train.py resume=FOLDER",
                file=sys.stderr,
            )
            sys.exit(INTERRUPTED)

    return wrapped


def check_overrides(arguments: list[str]) -> None:
    """Composes the configuration alone, so that a typo is answered before torch or the simulator are imported."""
    try:
        compose([a for a in arguments if a != "scale=auto"])
    except FrankaError as error:
        fail(str(error))


def fail(message: str) -> None:
    """Says what is wrong and exits with status 1."""
    print(f"error: {message}", file=sys.stderr, flush=True)
    sys.exit(1)


def with_scale(arguments: list[str]) -> list[str]:
    """Adds ``scale=gpu`` or ``scale=laptop`` where none, or ``scale=auto``, is given."""
    given = next((a for a in arguments if a.startswith("scale=")), None)
    if given not in (None, "scale=auto"):
        return arguments
    import torch

    device = next((a.split("=", 1)[1] for a in arguments if a.startswith("device=")), "auto")
    on_gpu = device.startswith("cuda") or (device == "auto" and torch.cuda.is_available())
    scale = "gpu" if on_gpu else "laptop"
    if not any(a.startswith("resume=") for a in arguments):
        say(f"scale={scale}, by the device; choose with scale=laptop, gpu or smoke")
    return [a for a in arguments if a != given] + [f"scale={scale}"]


def check_command(arguments: list[str]) -> str | None:
    """What is wrong with the overrides or the folder they write to, in one line; ``None`` if nothing is."""
    from franka_wm.training.run import check_once, import_plugins, occupied, resumed, unwritable
    from franka_wm.training.settings import RunSettings

    if any(a in ("-m", "--multirun") for a in arguments):
        return None  # sweeps are resolved by Hydra itself
    try:
        cfg = compose(arguments)
        import_plugins(cfg.plugins)
        if cfg.resume is not None:
            _, cfg = resumed(cfg, arguments)
        check_once(RunSettings.of(cfg, saved=cfg.resume is not None))
    except FrankaError as error:
        return str(error)
    chosen = next((a.split("=", 1)[1] for a in arguments if a.startswith("hydra.run.dir=")), "outputs")
    return unwritable(Path(chosen)) or occupied(Path(chosen), cfg.resume)
