# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
# (Newton's annotations know one kind of solver.)
"""Modules are compiled side by side before they are launched: those that are launched, and no others."""

import importlib.util
import os
import threading
from pathlib import Path

import pytest
import warp as wp

from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.simulation import simulator
from franka_wm.envs.simulation.compiling import (
    SOLVER,
    STEP,
    Compiler,
    compile_collisions,
    physics_modules,
    solver_modules,
    step_modules,
)

KERNEL = """
import warp as wp

@wp.kernel(enable_backward=False)
def fill(out: wp.array(dtype=float)):
    out[wp.tid()] = {value}
"""
CONSTRUCTION = {"mujoco_warp._src.set_const"}
"""Launched as the solver is made, not in a step."""

LATE = {
    "newton._src.geometry.bvh",  # by the main thread, which makes the model meanwhile
    "create_kernel",  # by the main thread: an image is rendered while others compile the physics
    "_update_gradient_JTCJ_dense",  # while the others are looked for
    "franka_wm.envs.tasks.manipulation",  # small
}
"""What is launched in a step, compiled otherwise."""

WITH_BACKWARD = {"mul_m_kernel__locals___mul_m"}
"""One small kernel of MuJoCo's, whose module only its maker can set."""


@pytest.mark.parametrize(("task", "observations"), [("reach", ("pixels", "state")), ("lift", ("state",))])
def test_what_is_compiled_ahead_is_what_a_step_launches(task: str, observations: tuple[str, ...]) -> None:
    config = FrankaConfig(task=task, substeps=1, observations=observations)
    sim = FrankaEnv(config, num_envs=2, device="cpu").simulation
    sim.reset()
    known = [*solver_modules(config), *step_modules(config, config.task_class)]
    assert {name for name, _ in known} >= {*SOLVER, *STEP}
    ahead = {str(name) for name, _ in known} | {m.name for m, _ in physics_modules(sim.solver)}
    with wp.Tape() as tape:
        if config.resolved_scene:
            with wp.ScopedDevice("cpu"):  # on a machine with a GPU that is the default one
                compile_collisions(sim.solver)
    looked_for = {kernel.module.name for kernel, *_ in tape.launches}
    with wp.Tape() as tape:
        sim._launch_step_and_restart()
    launched = {kernel.module.name for kernel, dim, *_ in tape.launches if 0 not in dim}
    assert ahead - launched == CONSTRUCTION
    assert {name.partition("__")[0] for name in launched - ahead - looked_for} <= LATE
    for kernel, *_ in tape.launches:
        backward = {**kernel.module.options, **kernel.options}["enable_backward"]
        assert backward is False or kernel.module.name.startswith(tuple(WITH_BACKWARD)), kernel.key


def test_looking_for_what_a_step_launches_moves_no_world() -> None:
    sim = FrankaEnv(FrankaConfig(task="lift", substeps=1), num_envs=2, device="cpu").simulation
    sim.reset()
    before = sim.get_state()
    assert len(physics_modules(sim.solver)) > 20
    with wp.ScopedDevice("cpu"):
        compile_collisions(sim.solver)
    after = sim.get_state()
    assert [name for name, value in before.items() if not after[name].equal(value)] == []


def test_a_compiler_leaves_what_the_next_start_loads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "cache"))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    kernels = []
    for k in range(2):
        path = tmp_path / f"compiled_ahead_{k}.py"
        path.write_text(KERNEL.format(value=float(k)))
        spec = importlib.util.spec_from_file_location(path.stem, path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        kernels.append(module.fill)
    with Compiler("cpu") as compiler:
        compiler.finish(compiler.begin((kernel.module.name, None) for kernel in kernels))
    assert len(list((tmp_path / "cache").glob("wp_compiled_ahead_*/*.o"))) == 2

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("compiled again")

    monkeypatch.setattr("warp._src.build.build_cpu", refuse)
    for k, kernel in enumerate(kernels):
        kernel.module.unload()  # as in another process
        out = wp.zeros(2, dtype=float, device="cpu")
        wp.launch(kernel, 2, [out], device="cpu")
        assert out.numpy().tolist() == [k, k]


def test_an_error_of_a_compiler_is_raised_where_it_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    with Compiler("cpu") as compiler, pytest.raises(RuntimeError, match=r"no\.such\.module"):
        compiler.finish(compiler.begin([("no.such.module", None)]))


@pytest.mark.parametrize("device", ["cpu", "cuda:0"])
def test_two_cores_load_ahead_on_every_device(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    called = []
    with Compiler(device) as compiler:
        assert compiler.ahead
        compiler.finish(compiler.begin_calls([lambda: called.append(device)]))
    assert called == [device]


def test_one_core_loads_nothing_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0}, raising=False)
    with Compiler("cpu") as compiler:
        assert not compiler.ahead and compiler.begin([("no.such.module", None)]) == []
        assert compiler.begin_calls([pytest.fail]) == []


class Watched(Compiler):
    """Waits for its threads at once: a waiting thread compiles, too, and which one is first depends on the machine."""

    def begin_calls(self, loads):
        loading = super().begin_calls(loads)
        for future, _ in loading:
            future.result()
        return loading


@pytest.mark.parametrize(("task", "times"), [("lift", 1), ("reach", 0)])
def test_a_thread_of_its_own_compiles_what_finds_contacts(
    task: str, times: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads = []
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    monkeypatch.setattr(simulator, "Compiler", Watched)
    monkeypatch.setattr(simulator, "compile_collisions", lambda _: threads.append(threading.current_thread()))
    FrankaEnv(FrankaConfig(task=task, substeps=1), num_envs=1, device="cpu")
    assert len(threads) == times and threading.main_thread() not in threads
