"""The configuration: ``config.yaml``, a folder for each group, and what their ``${…}`` call.

Importing this registers the resolvers, which any Hydra command that composes these files needs. The folder ``conf`` at
the top of a checkout is this one.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf, open_dict

from franka_wm.conf import wrong
from franka_wm.errors import UserError
from franka_wm.options import unknown

if TYPE_CHECKING:
    from hydra.core.config_loader import ConfigLoader

FOLDER = Path(__file__).resolve().parent

SCALES = ("smoke", "laptop", "gpu")
"""The columns of ``${at_scale:…}`` and ``${at_size:…}``."""


KNOWN = (
    "env", "model", "planner", "objective", "collector", "replay", "trainer", "evaluation", "logger", "dataset",
    "export", "pretrain", "scale", "size", "seed", "device", "gpus", "plugins", "resume",
)  # fmt: skip
"""All that stands at the top of a configuration."""

RENAMED = {"model.fresh_values": "model.reanalyze", "collector.acts": "collector.policy"}
"""Former names of options -> their present names."""


def presets(group: str) -> list[str]:
    """What ``GROUP=`` may be, of this package's own."""
    return sorted(file.stem for file in (FOLDER / group).glob("*.yaml"))


def use_present_names(config: DictConfig) -> None:
    """Rename the options of a checkpoint that had other names when it was written, in place."""
    whole: DictConfig | None = config.get("whole_run")
    for one in [config] if whole is None else [config, whole]:
        for old, new in RENAMED.items():
            value = OmegaConf.select(one, old)
            if value is not None:
                group, name = old.rsplit(".", 1)
                OmegaConf.update(one, new, value, force_add=True)
                del OmegaConf.select(one, group)[name]


def refuse_unknown(names: Iterable[Any]) -> None:
    """Refuses what a ``+`` adds to the top of a configuration, where nothing reads it.

    Raises:
        UserError: One line that names the nearest.
    """
    for name in names:
        if name not in KNOWN:
            raise UserError(unknown(str(name), KNOWN))


def compose(*overrides: str) -> DictConfig:
    """The configuration that ``python train.py OVERRIDE …`` runs with.

    Raises:
        UserError: An override that cannot be, in one line.
    """
    try:
        return compose_or_raise(*overrides)
    except UserError:
        raise
    except wrong.refusals() as error:
        raise UserError(wrong.said_of(error, overrides, compose_or_raise)) from error


def compose_or_raise(*overrides: str) -> DictConfig:
    """The same, with errors of Hydra as they are.

    Raises:
        UserError: An option by a former name, a group that does not exist, folders that Hydra would not look in, or a
            scale that a file sets as a value.
        HydraException, OmegaConfBaseException: An override that cannot be.
    """
    import hydra

    for override in overrides:
        name = override.split("=", 1)[0].lstrip("+~")
        if name in RENAMED:
            raise UserError(f"{override}: this option is now called {RENAMED[name]}")
        if name == "hydra.searchpath" and override[0] in "+~":  # Hydra would not look there, nor say so
            raise UserError(f"{override}: write hydra.searchpath=[file://FOLDER], without {override[0]}")
    with hydra_session():
        cfg = hydra.compose("config", overrides=list(overrides), return_hydra_config=True)
    chosen = cfg.hydra.runtime.choices.get("scale")
    with open_dict(cfg):
        del cfg["hydra"]
    refuse_unknown(cfg)
    if chosen in SCALES and (value := cfg.get("scale")) != chosen:
        raise UserError(
            f"scale: is the value {value} beside the numbers of scale={chosen}; in a file, choose it among the "
            f"defaults, `override /scale: {value}`"
        )
    return cfg


def scale_of_files(*overrides: str) -> str | None:
    """The scale that a file chooses by ``override /scale: …``, as an experiment may; ``None``: no file does.

    Raises:
        HydraException: An override that cannot be.
    """
    from hydra.types import RunMode

    others = [one for one in overrides if not one.startswith("scale=")]  # Hydra lets the command line win
    with hydra_session() as loader:
        found = loader.compute_defaults_list("config", others, RunMode.RUN)
    chosen = found.overrides.override_choices.get("scale")
    return None if chosen is None else str(chosen)


@contextmanager
def hydra_session() -> Iterator[ConfigLoader]:
    """Hydra at these files, with what loads them; ``HydraConfig`` is as before afterwards, ``GlobalHydra`` is cleared.

    Raises:
        UserError: A file is not YAML, or a folder of ``hydra.searchpath`` is not there, which Hydra only warns of.
    """
    import hydra
    import yaml
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.hydra_config import HydraConfig

    GlobalHydra.instance().clear()
    before = HydraConfig.instance().cfg
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", r"provider=hydra\.searchpath .* is not available", UserWarning)
            with hydra.initialize_config_dir(str(FOLDER), version_base="1.3"):
                yield GlobalHydra.instance().config_loader()
    except UserWarning as error:
        folder = str(error).partition(" path=")[2].removesuffix(" is not available.")
        raise UserError(
            f"hydra.searchpath: {folder}: no such folder (looked for from {Path.cwd()}), and no such package"
        ) from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f"{mark.name}, line {mark.line + 1}" if mark else "a configuration file"
        raise UserError(f"{where}: not YAML ({error.problem})") from error
    finally:
        HydraConfig.instance().cfg = before
        GlobalHydra.instance().clear()


def _column(option: str, chosen: Any, values: tuple[Any, ...]) -> Any:
    if chosen not in SCALES:
        raise UserError(
            f"{option}={chosen}: must be one of {', '.join(SCALES)}; a scale of your own begins with "
            "`defaults: [laptop, _self_]`, or one of the others"
        )
    return dict(zip(SCALES, values, strict=True))[chosen]


def at_scale(*values: Any, _root_: DictConfig) -> Any:
    """``${at_scale:1,2,3}``: 1 with ``scale=smoke``, 2 with ``laptop``, 3 with ``gpu``."""
    return _column("scale", _root_.scale, values)


def at_size(*values: Any, _root_: DictConfig) -> Any:
    """The same by ``size``, which is the scale's unless it is given."""
    return _column("size", _root_.size, values)


def one_each(count: int, *, _root_: DictConfig) -> int:
    """``${one_each:4}``: 4; of several tasks at once as many as there are tasks, if these are more."""
    return max(count, len(_root_.env.get("tasks") or ()))


def run_name(resume: str | None, env: str, seed: Any) -> str:
    """What a run's folder is called, after its time: as the run that it goes on from, else by environment and seed."""
    parts = Path(resume or "").parts
    if parts and parts[-1] == "checkpoints":
        parts = parts[:-1]
    elif len(parts) > 1 and parts[-2] == "checkpoints":
        parts = parts[:-2]
    name = re.sub(r"^\d\d-\d\d-\d\d-", "", parts[-1]) if parts else ""
    return name.strip("/. ") or f"{env}-{seed}"


def env_name(preset: str, *, _root_: DictConfig) -> str:
    """The environment in the names of folders: the preset; of another library, the name and the task in it."""
    found = [OmegaConf.select(_root_, key) for key in ("env.name", "env.task")]  # an arm has no name
    named = "-".join(str(part) for part in found if part is not None) if found[0] is not None else preset
    return re.sub(r"[^\w.-]+", "-", named)  # Gymnasium has names with slashes


for resolver in (at_scale, at_size, one_each, run_name, env_name):
    OmegaConf.register_new_resolver(resolver.__name__, resolver, replace=True)
