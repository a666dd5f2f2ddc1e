"""Warp modules compiled side by side, before anything launches them.

Left alone, Warp compiles a module when it is launched first: one after another, on one core. It keeps the machine code
on disk, where the next start finds it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace

import mujoco_warp
import newton
import warp as wp

from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.tasks import Task
from franka_wm.versions import usable_cores

Loading = list[tuple[Future[None], Callable[[], None]]]
Variant = tuple[str | wp.Module, int | None]
"""A module, by its name where it has one, and the threads of a block; ``None`` for Warp's default."""

FORWARD_ONLY = (
    "mujoco_warp._src.set_const",
    "newton._src.sim.articulation",
    "newton._src.solvers.featherstone.kernels",
    "newton._src.solvers.mujoco.kernels",
    "newton._src.viewer.kernels",
)
"""Warp modules whose kernels are compiled without a backward pass.

Nothing here runs it, and it takes most of the time that they take to compile. A Warp tape over one of their kernels
raises an error; to differentiate through them, set the option again after the import of this module.
"""

for _name in FORWARD_ONLY:
    wp.set_module_options({"enable_backward": False}, module=_name)

SOLVER = (
    "newton._src.solvers.mujoco.kernels",
    "mujoco_warp._src.forward",
    "mujoco_warp._src.smooth",
    "mujoco_warp._src.derivative",
    "mujoco_warp._src.passive",
    "mujoco_warp._src.set_const",
    "mujoco_warp._src.solver",
    "mujoco_warp._src.support",
    "mujoco_warp._src.constraint",
)
"""What MuJoCo's solver launches of every arm while it is made and in each step; what takes longest comes first."""

STEP = (
    "newton._src.sim.articulation",
    "franka_wm.envs.kernels.servo",
    "franka_wm.envs.kernels.observation",
    "franka_wm.envs.kernels.episodes",
)
"""What is launched around the physics of every arm."""


class Compiler:
    """Threads that load Warp modules, compiled where the disk does not have them. Ends with a ``with`` block.

    The thread that waits compiles, too. With one core there are no others, and nothing is loaded ahead: Warp compiles
    as modules are launched.

    Args:
        device: ``"cpu"`` or ``"cuda:k"``.
    """

    def __init__(self, device: str):
        self.device = device
        cores = usable_cores()
        self._pool = ThreadPoolExecutor(cores - 1) if cores > 1 else None

    @property
    def ahead(self) -> bool:
        """Whether anything is loaded before it is launched."""
        return self._pool is not None

    def __enter__(self) -> Compiler:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def begin(self, variants: Iterable[Variant]) -> Loading:
        """Starts to load modules, the first ones first, and returns at once."""

        def loader(module: str | wp.Module, threads: int | None) -> Callable[[], None]:
            return lambda: wp.load_module(module, device=self.device, block_dim=threads)

        return self.begin_calls(loader(*variant) for variant in variants)

    def begin_calls(self, loads: Iterable[Callable[[], None]]) -> Loading:
        """The same for calls that load modules by launching their kernels."""
        return [] if self._pool is None else [(self._pool.submit(load), load) for load in loads]

    def finish(self, loading: Loading) -> None:
        """Loads those of ``loading`` that no thread has begun, and waits for the others.

        Nothing may launch a module while a thread loads it: it would be compiled twice.
        """
        for future, load in reversed(loading):
            if future.cancel():
                load()
        for future, _ in loading:
            if not future.cancelled():
                future.result()


def solver_modules(config: FrankaConfig) -> list[Variant]:
    """What the construction of the solver launches, and each step of it, where that is known before."""
    return [(name, None) for name in SOLVER if config.solver != "featherstone" and _has_kernels(name)]


def step_modules(config: FrankaConfig, task: type[Task]) -> list[Variant]:
    """What a step launches around its physics."""
    kernels = "franka_wm.envs.kernels"
    names = [*([f"{kernels}.rendering"] if config.images else []), *STEP]
    names += [f"{kernels}.bodies"] if config.has_gripper else []
    return [(name, None) for name in (*names, task.__module__) if _has_kernels(name)]


def _has_kernels(name: str) -> bool:
    """Whether a module of that name is there and defines kernels: another version of Newton may have other names."""
    defined = vars(sys.modules[name]).values() if name in sys.modules else ()
    return any(isinstance(one, wp.Kernel) and one.module.name == name for one in defined)


def physics_modules(solver: newton.solvers.SolverMuJoCo) -> list[Variant]:
    """What a step of this solver launches, found by a step of no world: nothing is compiled, and no thread runs.

    MuJoCo's kernels are made for a model when it is stepped first, each a module of its own. Without a world their
    launches are empty; a tape notes them all the same. Those that would be empty in any world have a second zero.
    Collisions are left out: they are looked for in all contacts at once. No thread may load meanwhile: it would write
    to the tape.
    """
    model, data = solver.mjw_model, solver.mjw_data
    once = replace(model.opt, graph_conditional=False, iterations=1)  # a loop over worlds that are not solved
    start = wp.clone(data.qacc_warmstart)  # the one array of worlds that is copied into, not launched upon
    alone = replace(data, nworld=0, naconmax=0, qacc_warmstart=start)
    # With many joints MuJoCo divides by the number of worlds: what it launches after that is compiled then.
    with wp.Tape() as tape, wp.ScopedDevice(solver.model.device), suppress(ZeroDivisionError):
        mujoco_warp.step(replace(model, opt=once), alone)
    launches = [(kernel, dim, threads) for kernel, dim, _, _, _, _, threads, _ in tape.launches]
    found = {(kernel.module, threads): None for kernel, dim, threads in launches if list(dim).count(0) == 1}
    return list(found)


def compile_collisions(solver: newton.solvers.SolverMuJoCo) -> None:
    """Compiles and launches what finds contacts, in no world: one kernel of it takes as long as all others together.

    A thread may do this where the solver's device is the default one: that is the whole process's.
    """
    mujoco_warp.collision(solver.mjw_model, replace(solver.mjw_data, nworld=0))
