"""Configurations composed once for all tests of a process, and files read once: Hydra does both anew each time.

One composition takes a tenth of a second of CPU time, each command line of training several, and the tests compose
thousands.
"""

from __future__ import annotations

import copy
import functools
import importlib
from collections.abc import Callable
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.core.plugins import Plugins
from omegaconf import DictConfig

from franka_wm import conf, source

SOURCES = {
    "file_config_source": "FileConfigSource",
    "importlib_resources_config_source": "ImportlibResourcesConfigSource",
}
OURS = (str(conf.FOLDER), "franka_wm.conf", "hydra.conf")
"""Folders whose files no test changes."""


def compose_once() -> None:
    """From now on, in this process and in its forks; what most of them need is composed now."""
    Plugins.instance()  # this executes their modules anew: the classes of before are not those that read
    for module, name in SOURCES.items():
        reader = getattr(importlib.import_module(f"hydra._internal.core_plugins.{module}"), name)
        reader.load_config = _read_once(reader.load_config)
    conf.compose_or_raise = _composed_once(conf.compose_or_raise)
    conf.compose("scale=smoke")


def load_what_runs_load() -> None:
    """What each run imports, and computes of its code, before any forks."""
    for name in ("torch.utils.tensorboard", "matplotlib.backends.backend_agg", "mpl_toolkits.mplot3d"):
        importlib.import_module(name)
    importlib.import_module("newton.solvers").SolverMuJoCo  # noqa: B018  what it needs is loaded when it is asked for
    names = [file.relative_to(source.ROOT).as_posix() for file in conf.FOLDER.parent.rglob("*.py")]
    for name, content in source.read([*names, "train.py"]).items():
        source.code_hash(name, content)


def _read_once(load: Callable[..., Any]) -> Callable[..., Any]:
    known: dict[tuple[str, str], Any] = {}

    def load_config(self: Any, config_path: str) -> Any:
        if self.path not in OURS:
            return load(self, config_path)
        if (self.path, config_path) not in known:
            known[self.path, config_path] = load(self, config_path)
        return copy.deepcopy(known[self.path, config_path])

    return load_config


def _composed_once(make: Callable[..., DictConfig]) -> Callable[..., DictConfig]:
    known: dict[tuple[str, ...], DictConfig] = {}

    @functools.wraps(make)
    def compose(*overrides: str) -> DictConfig:
        if any("searchpath" in one for one in overrides):  # files of the test
            return make(*overrides)
        GlobalHydra.instance().clear()
        if overrides not in known:
            known[overrides] = make(*overrides)
        return copy.deepcopy(known[overrides])

    return compose
