"""Where worlds, policies and samplers of a run stand: what the next step depends on besides weights and experience."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector

from franka_wm.envs import Environment, FrankaEnv, MultiTaskEnv
from franka_wm.envs.specs import MARKS
from franka_wm.envs.transformed import arm_of
from franka_wm.seeding import derive_seed
from franka_wm.training.tree import nested


def same_worlds(saved: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Whether worlds and plans of a run with the configuration ``saved`` fit into one with ``now``, both plain."""
    parts = ("env", "planner", "objective")
    fitting = saved["collector"]["num_envs"] == now["collector"]["num_envs"]
    return fitting and all(saved[part] == now[part] for part in parts)


def restorable(env: Environment) -> FrankaEnv | MultiTaskEnv | None:
    """Where the states of worlds can be taken and put back; ``None``: another library's simulators."""
    return env if isinstance(env, MultiTaskEnv) else arm_of(env)


def worlds_now(env: Environment, collector: Collector | None) -> dict[str, object] | None:
    """The simulation of all worlds and the root that the collector's next step starts from, plans included.

    ``None`` before anything was gathered, and for environments of other libraries.
    """
    worlds = restorable(env)
    if worlds is None or collector is None:
        return None
    # TorchRL keeps this to itself; its own state_dict leaves it out.
    return {"state": nested(worlds.get_state()), "carry": nested(collector._carrier)}


def put_back(env: Environment, collector: Collector, worlds: Mapping[str, Any]) -> None:
    """Undoes whatever happened to worlds and collector since :func:`worlds_now`, in this process or another."""
    there = restorable(env)
    assert there is not None
    size = [] if isinstance(there, MultiTaskEnv) else there.batch_size
    there.set_state(TensorDict(worlds["state"], batch_size=size, device=there.device))
    carry = TensorDict(worlds["carry"], batch_size=there.batch_size, device=there.device)
    for key in {*there.observation_spec.keys()} & {*MARKS} - {*carry.keys()}:  # of an earlier version
        carry[key] = there.observation_spec[key].zero()
    collector._carrier = carry.clear_device_() if collector._carrier.device is None else carry


@runtime_checkable
class Drawing(Protocol):
    """A policy that draws at random: what it carries from step to step can be kept and put back."""

    def get_state(self) -> dict[str, torch.Tensor | None]: ...

    def set_state(self, state: Mapping[str, torch.Tensor | None], device: torch.device) -> bool: ...


def draws(policies: Mapping[str, TensorDictModuleBase]) -> dict[str, dict[str, torch.Tensor | None]]:
    """What policies that draw at random carry from step to step: generators, last actions. By name of the module."""
    return {name: module.get_state() for name, module in _drawing(policies).items()}


def go_on_drawing(
    policies: Mapping[str, TensorDictModuleBase],
    states: Mapping[str, Mapping[str, torch.Tensor | None]],
    device: torch.device,
) -> bool:
    """Puts policies where :func:`draws` found them; ``False`` if any drew on another kind of device."""
    there = [(module, states[name]) for name, module in _drawing(policies).items() if name in states]
    return all([module.set_state(state, device) for module, state in there])


def draw_anew(policies: Mapping[str, TensorDictModuleBase], seed: int) -> None:
    """Lets policies that draw at random begin from ``seed``, each with numbers of its own."""
    for name, module in _drawing(policies).items():
        for value in vars(module).values():
            if isinstance(value, torch.Generator):
                value.manual_seed(derive_seed(name, seed))


def _drawing(policies: Mapping[str, TensorDictModuleBase]) -> dict[str, Drawing]:
    return {
        f"{name}/{path}": module
        for name, policy in policies.items()
        for path, module in policy.named_modules()
        if isinstance(module, Drawing)
    }
