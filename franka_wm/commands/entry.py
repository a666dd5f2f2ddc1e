"""The command line of ``train.py``: the scale by the device, overrides checked early, errors in one line."""

from __future__ import annotations

import functools
import gc
import math
import os
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from itertools import islice
from pathlib import Path
from typing import Any, NoReturn, TextIO, cast

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from franka_wm import conf
from franka_wm.commands import launching, several
from franka_wm.commands.overrides import compose, given, unknown_flags, values
from franka_wm.commands.sweep import Sweep, jobs, names, spread
from franka_wm.console import program, quoted, resuming, say, terminal_log
from franka_wm.errors import REFUSALS, FrankaError, machine_refused
from franka_wm.interrupt import INTERRUPTED

ELSEWHERE = ("submitit_slurm", "ray")
"""Launchers that take jobs to other machines: this one does not know their devices."""
MOST_JOBS = 1000
"""Most runs of one sweep: each is checked before the first begins."""
_sweep: Sweep | None = None
"""That of this process; jobs in processes of other launchers have a copy."""
_there: frozenset[Path] | None = None
"""Folders that stood before Hydra made the run's; ``None`` where nobody looked: then nothing is removed."""


def run_command(main: Callable[[], object], arguments: list[str] | None = None) -> None:
    """Runs a Hydra main: chooses the scale by device, and turns bad input into one line and exit status 1.

    Args:
        main: Reads ``sys.argv``, as Hydra's are.
        arguments: After the program's name; the command line's if not given.
    """
    # Imports make a million objects, all to stay: looking for garbage among them takes a sixth of their time. The run
    # looks for it again, and :func:`franka_wm.training.run.start` says so.
    gc.disable()
    try:
        with terminal_log(), one_line_refusals():
            try:
                _run(main, sys.argv[1:] if arguments is None else arguments)
            except KeyboardInterrupt:  # before a run begins
                sys.exit(INTERRUPTED)
    except BaseException as error:
        several.end_process(error)
        raise
    finally:
        gc.enable()


@contextmanager
def ends_together() -> Iterator[None]:
    """Around what a process does that torchrun has started for a verb: what ends one ends all, and is said once."""
    try:
        with one_line_refusals():
            try:
                yield
            except FrankaError as error:
                fail_by(error)
    except BaseException as error:
        several.end_process(error)
        raise


@contextmanager
def one_line_refusals() -> Iterator[None]:
    """What the machine has no more of (room on the disk, descriptors, memory) is one line, too."""
    try:
        yield
    except REFUSALS as error:
        refused = machine_refused(error)
        if refused is None:
            raise
        fail(refused)


def _run(main: Callable[[], Any], arguments: list[str]) -> None:
    global _sweep, _there
    _sweep, _there, asked = None, None, hydra_flags(arguments)
    if asked.experimental_rerun:
        fail("--experimental-rerun unpickles a file, which may run anything; resume=RUN goes on with a run")
    modes = [flag for flag in ("run", "multirun", "cfg", "info", "shell_completion") if getattr(asked, flag)]
    if len(modes) > 1 and not (asked.help or asked.hydra_help):
        fail(f"--{' beside --'.join(modes)}: give one of them")
    flags = [a for a in arguments if a not in asked.overrides]
    overrides = with_folder(asked)
    elsewhere = asked.config_name or asked.config_path
    only_shows = asked.help or asked.hydra_help or asked.shell_completion or asked.info
    joins = several.started_by_torchrun() and not only_shows
    if not (elsewhere or asked.hydra_help or asked.shell_completion):
        composed = list(swept(overrides)) if asked.multirun else [overrides]
        checked = [check_overrides(one) for one in composed]
        for cfg in [] if only_shows or asked.cfg or joins else checked:
            if not any(a.startswith("hydra/launcher=") for a in overrides):  # may take jobs to other machines
                check_folders(cfg)
            check_settings(cfg)
    if joins:
        if elsewhere or asked.multirun:
            fail("several processes learn one model of this package's configuration: leave out Hydra's flags")
        try:
            overrides = several.enter(overrides)
        except FrankaError as error:
            fail(str(error))
    if not (elsewhere or only_shows):
        overrides = with_scale(overrides, sys.stderr if asked.cfg else sys.stdout)
        if asked.multirun:
            _sweep = check_sweep(overrides)
        problem = None if asked.cfg or asked.multirun else check_command(overrides)
        if problem is not None:
            fail(problem)
        if not (joins or asked.cfg) and _launched(flags, overrides, asked.multirun):
            return
        if not asked.multirun:  # a sweep's folders stay, for the same command to go on there
            place = Path(given(overrides, "hydra.run.dir") or "outputs").resolve()
            _there = frozenset(one for one in (place, *place.parents, *place.glob("*")) if one.is_dir())
    sys.argv[1:] = [*flags, *overrides]
    try:
        with (
            _sweep.waiting() if _sweep is not None and "hydra/launcher=joblib" in overrides else nullcontext()
        ):
            main()
    except FrankaError as error:
        fail(str(error))
    if joins:
        from franka_wm import processes

        processes.leave()
    problem = None if _sweep is None else _sweep.outcome()
    if (
        _sweep is not None
        and len(_sweep.failed) < _sweep.ran
        and Path(_sweep.folder, "multirun.yaml").is_file()
    ):
        say(f"its runs in a table: {program()} summary {shlex.quote(_sweep.folder)}")
    if problem is not None:
        fail(problem)


def _launched(flags: list[str], overrides: list[str], multirun: bool) -> bool:
    """Runs a command that asks for several processes, which is not the business of this one; whether it does."""
    if multirun:  # its jobs may
        return False
    try:
        gpus, device = several.wanted(overrides)
        if gpus > 1:
            launching.launch(flags, overrides, gpus, device)
    except FrankaError as error:
        fail(str(error))
    return gpus > 1


def hydra_flags(arguments: list[str]) -> Any:
    """The flags of Hydra on a command line, read by its own parser; ``overrides`` are the other arguments."""
    from hydra._internal.utils import get_args_parser

    parser = get_args_parser()
    parser.allow_abbrev = False  # --experiment=NAME would be --experimental-rerun
    parser.error = lambda message: fail(f"{message}; python train.py --hydra-help lists the flags")  # type: ignore
    asked, unknown = parser.parse_known_intermixed_args(arguments)
    if unknown:
        parser.error(unknown_flags(arguments, unknown))
    return asked


def with_folder(asked: Any) -> list[str]:
    """The overrides, and the folder of ``--config-dir`` as one more: what checks and starts a run knows no flags.

    To Hydra both mean the same.
    """
    overrides = list(asked.overrides)
    if asked.config_dir is None:
        return overrides
    folder = Path(asked.config_dir).resolve()
    if not folder.is_dir():
        fail(f"--config-dir={asked.config_dir}: no such folder")
    own = f"hydra.searchpath=[{quoted(f'file://{folder}')}]"
    if any(one.startswith("hydra.searchpath=") and one != own for one in overrides):
        fail("--config-dir beside hydra.searchpath=: name all folders in hydra.searchpath=[file://FOLDER,…]")
    return overrides if own in overrides else [*overrides, own]


def swept(overrides: list[str]) -> Iterator[list[str]]:
    """What a sweep will compose: the first value of each list ``a=1,2``, and every choice of each group once.

    Lists that only Hydra can expand (``glob``) are left to it.
    """
    try:
        parsed = OverridesParser.create().parse_overrides(overrides)
    except OverrideParseException as error:
        fail(conf.wrong.explain(str(error)))
    known = [o for o in parsed if not o.is_sweep_override() or o.is_choice_sweep() or o.is_range_sweep()]
    try:
        values = [
            [
                f"{str(o.input_line).partition('=')[0]}={value}"
                for value in islice(o.sweep_string_iterator(), MOST_JOBS + 1)
            ]
            if o.is_sweep_override()
            else [str(o.input_line)]
            for o in known
        ]
    except ValueError as error:  # range(0,5,0)
        fail(f"a list of the sweep has no values: {error}")
    if not all(values):
        fail("a list of the sweep has no values")
    if math.prod(map(len, values)) > MOST_JOBS:
        fail(f"a sweep of more than {MOST_JOBS} jobs, the most that are checked at once; make several of it")
    first = [choices[0] for choices in values]
    yield first
    for k, o in enumerate(known):
        if (conf.FOLDER / o.key_or_group).is_dir():
            for choice in values[k][1:]:
                yield [*first[:k], choice, *first[k + 1 :]]


def one_line_errors(main: Callable[[DictConfig], object]) -> Callable[[DictConfig], object]:
    """Inside Hydra's own wrapper, which would print a traceback where the input is wrong."""

    @functools.wraps(main)
    def wrapped(cfg: DictConfig) -> object:
        try:
            told = HydraConfig.get()
            if _sweep is not None:
                with nullcontext() if _sweep.process == os.getpid() else terminal_log():
                    return _sweep.run(main, cfg)
            spread(cfg, int(told.job.num) if told.mode == RunMode.MULTIRUN else 0)
            if several.goes_on(cfg):
                several.go_on(cfg, Path(told.runtime.output_dir))
            with one_line_refusals():
                return main(cfg)
        except FrankaError as error:
            _discard()
            fail_by(error)
        except SystemExit:  # what the machine refused; or a run that has saved
            _discard()
            raise
        except KeyboardInterrupt:
            folder = Path(HydraConfig.get().runtime.output_dir)
            values = cast(dict[str, object], OmegaConf.to_container(cfg))
            saved = f"there is no checkpoint to go on from yet; what was written is in {folder}"
            if any((folder / stage / "checkpoints" / "latest").exists() for stage in ("", "pretrained")):
                saved = f"go on from what was saved: {resuming(folder, values)}"
            gone = _discard()  # of several processes the first one made the folder, and knows
            if int(os.environ.get("RANK") or 0) == 0 or not several.started_by_torchrun():
                print(f"stopped; {'nothing was saved yet' if gone else saved}", file=sys.stderr)
            sys.exit(INTERRUPTED)

    return wrapped


def _discard() -> bool:
    """A run that was refused late leaves no folder that was made for it."""
    if _there is None or several.JOB in os.environ:
        return False
    from franka_wm.training.run import discard

    return discard(_there)


def check_overrides(arguments: list[str]) -> DictConfig:
    """Composes the configuration alone, so that a typo is answered before torch or the simulator are imported."""
    try:
        cfg = compose([a for a in arguments if a != "scale=auto"])
        OmegaConf.to_container(cfg, resolve=True)
        if "trainer=offline" in arguments and cfg.resume is None and cfg.dataset.kind == "none":
            fail("trainer=offline: trains on recorded data; name them, dataset=lerobot dataset.root=FOLDER")
        return cfg
    except FrankaError as error:
        fail(str(error))
    except OmegaConfBaseException as error:
        fail(conf.wrong.explain(str(error)))


def check_settings(cfg: DictConfig) -> None:
    """Reads the settings of checked overrides: a value of a wrong type or out of range is answered as early.

    At any scale, since the device that decides on it is not known yet: each value's own range is that of all scales.
    Not where plugins have names of their own, nor where the other options are those of a checkpoint.
    """
    from franka_wm.training.settings import RunSettings

    try:
        if not cfg.plugins and cfg.resume is None:
            RunSettings.whole(cfg)
    except FrankaError as error:
        fail(str(error))


def check_folders(cfg: DictConfig) -> None:
    """Whether the folders that a run reads are there, which needs no simulator."""
    for option in ("resume", "dataset.root", "replay.demos"):
        named = OmegaConf.select(cfg, option)
        for folder in named if isinstance(named, ListConfig) else [named]:
            if folder is not None and not Path(str(folder)).expanduser().is_dir():
                makes = "franka-wm collect out=FOLDER makes one"
                wanted = "give that of a run, as train.py prints it last" if option == "resume" else makes
                fail(f"{option}={folder}: no such folder; {wanted}")


def fail(message: str) -> NoReturn:
    """Says what is wrong and exits with status 1."""
    if several.speaks():
        print(f"error: {several.named(message)}", file=sys.stderr, flush=True)
    if several.started_by_torchrun():
        from franka_wm import processes

        processes.leave(1)
    sys.exit(1)


def fail_by(error: FrankaError) -> NoReturn:
    """As :func:`fail`, by what ended a run; that it lost another process is left to our launcher, if that waits."""
    from franka_wm import processes

    if isinstance(error, processes.LostAnother) and several.TOLD in os.environ:
        Path(os.environ[several.TOLD]).write_text(str(error), encoding="utf-8")
        processes.leave(processes.LOST_STATUS)
    lost = isinstance(error, processes.LostAnother)
    fail(f"{error}{': go on with resume=FOLDER, and collect with resume=true' if lost else ''}")


def with_scale(arguments: list[str], stream: TextIO | None = None, *, quiet: bool = False) -> list[str]:
    """Adds ``scale=gpu`` or ``scale=laptop`` where none is given, and no experiment chooses one, or for ``scale=auto``.

    A run that resumes keeps its own.

    Args:
        stream: Where that is said.
        quiet: Say nothing, since nothing is trained.

    Raises:
        SystemExit: The device of other machines decides, or experiments of a sweep that are alike in that; one line.
    """
    chosen = next((a for a in arguments if a.startswith("scale=")), None)
    if chosen not in (None, "scale=auto"):
        return arguments
    if any(a.startswith("resume=") for a in arguments):
        return [a for a in arguments if a != chosen]
    if chosen is None and (own := _scales_of_files(arguments)) != {None}:
        if None in own:
            fail(
                "some experiments of this sweep choose a scale, others do not; add scale=, or make two sweeps"
            )
        if not quiet:
            say(
                f"scale={', '.join(sorted(map(str, own)))}, by the experiment; choose with scale=laptop, gpu or smoke",
                stream,
            )
        return arguments
    devices = {*values(arguments, "device")}
    if not devices:
        named = [a for a in arguments if a != chosen] if any(map(_may_choose, arguments)) else []
        devices = {str(compose(one).device) for one in swept(named)} if named else {"auto"}
    launcher = given(arguments, "hydra/launcher")
    own_cluster = launcher == "ray" and given(arguments, "hydra.launcher.ray.init.address") is None
    if launcher in ELSEWHERE and "auto" in devices and not own_cluster:
        fail(
            f"hydra/launcher={launcher}: the device of this machine does not say how large runs on others are; add "
            "scale=gpu, scale=laptop or scale=smoke"
        )
    import torch

    gpu = ("cuda", "spread", *(["auto"] if torch.cuda.is_available() else []))
    scales = {"gpu" if one.strip().startswith(gpu) else "laptop" for one in devices}
    if len(scales) > 1:
        fail("some devices of this sweep want scale=gpu, others scale=laptop; add scale=, or make two sweeps")
    [scale] = scales
    if not quiet:
        say(f"scale={scale}, by the device; choose with scale=laptop, gpu or smoke", stream)
    return [a for a in arguments if a != chosen] + [f"scale={scale}"]


def _may_choose(argument: str) -> bool:
    """Whether files that it names may choose what is chosen on the command line."""
    return argument.startswith(("experiment=", "hydra.searchpath="))


def _scales_of_files(arguments: list[str]) -> set[str | None]:
    """What experiments on the command line choose, of a sweep all of them; ``None`` of one that chooses nothing."""
    if not any(map(_may_choose, arguments)):
        return {None}  # no file of this package chooses one unasked
    try:
        return {conf.scale_of_files(*one) for one in swept(arguments)}
    except HydraException:  # said before, where it is composed
        return {None}


def check_sweep(overrides: list[str]) -> Sweep:
    """Checks every job of a sweep, and its folder, before the first one begins."""
    if (
        given(overrides, "hydra/sweeper") == "optuna"
        and given(overrides, "hydra.sweeper.direction") != "maximize"
    ):
        fail(
            "hydra/sweeper=optuna: a run returns what is better the higher; add hydra.sweeper.direction=maximize"
        )
    try:
        found = jobs(overrides)
    except FrankaError as error:
        fail(str(error))
    for name, job in zip(names(found), found, strict=True):
        problem = check_command(job.overrides, job.folder) or launching.refused_job(job.overrides)
        if problem is not None:
            fail(f"{name}: {problem}")
    return Sweep(names(found), [job.folder for job in found])


def check_command(arguments: list[str], folder: Path | None = None) -> str | None:
    """What is wrong with the overrides or the folder they write to, in one line; ``None`` if nothing is.

    Args:
        folder: That of a sweep's job, which may go on with what it finds there.
    """
    from franka_wm.training.place import left_by, occupied, unwritable
    from franka_wm.training.run import check_once, import_plugins, resumed
    from franka_wm.training.settings import RunSettings

    try:
        cfg = compose(arguments)
        typed = cfg.copy()
        spread(cfg)
        import_plugins(cfg.plugins)
        if cfg.resume is not None:
            _, cfg = resumed(cfg, arguments)
        check_once(RunSettings.of(cfg, saved=cfg.resume is not None).of_one_gpu())
        if folder is not None and cfg.resume is None:
            left_by(folder, typed)
            return unwritable(folder, "hydra.sweep.dir")
    except FrankaError as error:
        return str(error)
    named = given(arguments, "hydra.run.dir")
    if named == "":
        return "hydra.run.dir=: names no folder; give one for the results, or leave it out"
    place = folder or Path(named or "outputs")
    problem = unwritable(place)
    return problem if several.goes_on(typed) else problem or occupied(place, cfg.resume)
