"""Worlds of other libraries in Ray actors, on all hosts of a cluster; needs the extra ``ray``."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torchrl.envs import EnvBase, SerialEnv

from franka_wm.errors import UserError
from franka_wm.version import __version__

STARTING = 300.0
"""How long actors may take until all have a core and have built their worlds [s]."""

MEETING = 10.0
"""How long the cluster's address may take to answer [s]."""

DECISIVE = ("torchrl", "gymnasium", "dm-control", "mujoco", "numpy")
"""Packages that decide what a world does: every host must have the same."""

Arrays = dict[NestedKey, np.ndarray]
"""Key → (worlds, …). Ray sends arrays as they are, tensors ten times slower."""


class RayEnv(EnvBase):
    """N copies of an environment; each of several Ray actors has an equal share of them, a ``SerialEnv``.

    They play what one ``SerialEnv`` of all copies does: a step asks all actors and waits for them, and a seed is handed
    from one copy to the next.

    Args:
        make: Makes one copy; known by name on every host.
        num_envs: Copies, N.
        workers: Actors, a divisor of N. Each takes a core, spread over the hosts of the cluster.
        device: Where the TensorDicts live; the simulators stay on the CPU.

    Raises:
        UserError: The extra is not installed, the cluster is not there or has too few cores, a host has other versions.
            Later: an actor has died.
    """

    def __init__(
        self,
        make: Callable[[], EnvBase],
        *,
        num_envs: int,
        workers: int,
        device: torch.device | str | None = None,
    ):
        ray = import_ray()
        like = SerialEnv(num_envs, make, device=device)  # never started
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.observation_spec = like.observation_spec
        self.full_action_spec = like.full_action_spec
        self.full_reward_spec = like.full_reward_spec
        self.full_done_spec = like.full_done_spec
        self._shares: list[Any] = []
        self._now: list[Arrays] = []
        self._started_ray = not ray.is_initialized()
        if self._started_ray:
            _join(ray)
        try:
            cores = int(ray.cluster_resources().get("CPU", 0))
            if workers > cores:
                raise UserError(
                    f"collector.workers={workers}: each actor takes a core, and Ray has {cores}; use at most as many"
                )
            # Hosts in turn, or Ray would fill one after the other.
            actor = ray.remote(num_cpus=1, scheduling_strategy="SPREAD")(Share)
            self._shares = [actor.remote() for _ in range(workers)]
            found = self._ask("begin", [(make, num_envs // workers)] * workers, timeout=STARTING)
            here = _versions()
            for name, there in ((name, there) for one in found for name, there in one.items()):
                if there != here.get(name):
                    raise UserError(
                        f"collector=ray: a host has {name} {there}, this one {here.get(name)}; install the same on all"
                    )
        except BaseException:
            self.close()
            raise

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Each copy gets a seed that follows from the one before; the next one is returned."""
        for k in range(len(self._shares)):
            ask = [(seed, static_seed) if k == one else None for one in range(len(self._shares))]
            seed = self._ask("set_seed", ask)[k]
        return seed

    def _set_seed(self, seed: int | None) -> None:
        """Not used: :meth:`set_seed` does it."""

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = tensordict.select(*self.action_keys).chunk(len(self._shares))
        self._now = self._ask("step", [(_arrays(one),) for one in actions])
        return self._joined()

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        ask: list[Any] = [(None, kwargs)] * len(self._shares)
        if mask is not None:
            ask = [(one.cpu().numpy(), kwargs) for one in mask.chunk(len(self._shares))]
            ask = [one if one[0].any() or not self._now else None for one in ask]
        found = self._ask("reset", ask)
        # Worlds of actors that were not asked stand where they stood; a reset has no reward.
        now = [self._now[k] if one is None else one for k, one in enumerate(found)]
        kept = [key for key in now[0] if key not in self.reward_keys and all(key in one for one in now)]
        self._now = [{key: one[key] for key in kept} for one in now]
        return self._joined()

    def _joined(self) -> TensorDict:
        """What all actors have answered last, (N, …)."""
        joined = {key: np.concatenate([one[key] for one in self._now]) for key in self._now[0]}
        return _tensors(joined, self.batch_size, self.device)

    def _ask(self, what: str, arguments: Sequence[tuple | None], timeout: float | None = None) -> list[Any]:
        """Calls a method of all actors at once and waits; ``None``: one that is not asked, nor answers."""
        ray = import_ray()
        asked = [k for k, one in enumerate(arguments) if one is not None]
        found: list[Any] = [None] * len(arguments)
        try:
            calls = [getattr(self._shares[k], what).remote(*(arguments[k] or ())) for k in asked]
            for k, answer in zip(asked, ray.get(calls, timeout=timeout), strict=True):
                found[k] = answer
        except ray.exceptions.GetTimeoutError as error:
            raise UserError(
                f"collector=ray: {len(asked)} actors have not begun after {timeout:.0f} s; other work may hold the "
                "cluster's cores: use a smaller collector.workers, or wait"
            ) from error
        except ray.exceptions.RayActorError as error:
            raise UserError(
                f"collector=ray: an actor has died ({str(error).splitlines()[0]}); resume=FOLDER goes on from "
                "a checkpoint"
            ) from error
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, UserError):
                raise UserError(f"collector=ray, in an actor: {error.cause}") from error
            raise
        return found

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Ends the actors, and Ray where this has started it or joined a cluster."""
        ray = import_ray()
        for one in self._shares:
            ray.kill(one)
        self._shares = []
        if self._started_ray:
            ray.shutdown()
        super().close(raise_if_closed=raise_if_closed)


class Share:
    """What runs in one actor: its share of the worlds, one after the other."""

    env: SerialEnv

    def begin(self, make: Callable[[], EnvBase], worlds: int) -> dict[str, str]:
        """Builds the worlds; returns the versions of this host."""
        self.env = SerialEnv(worlds, make, device="cpu")
        self.env.start()
        return _versions()

    def set_seed(self, seed: int | None, static_seed: bool) -> int | None:
        """Returns the seed of the world that follows these."""
        return self.env.set_seed(seed, static_seed=static_seed)

    def step(self, action: Arrays) -> Arrays:
        """What the actions led to."""
        return _arrays(self.env._step(_tensors(action, self.env.batch_size, self.env.device)))

    def reset(self, mask: np.ndarray | None, kwargs: dict[str, Any]) -> Arrays:
        """First observations of the worlds of the mask, (worlds, 1); of the others the present ones."""
        asked = None if mask is None else _tensors({"_reset": mask}, self.env.batch_size, self.env.device)
        return _arrays(self.env._reset(asked, **kwargs))


def import_ray() -> Any:
    """The module.

    Raises:
        UserError: It is not installed.
    """
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise UserError(f"collector=ray needs pip install 'franka-wm[ray]' ({error})") from error
    return ray


def _join(ray: Any) -> None:
    """Joins the cluster of ``RAY_ADDRESS`` or the one that runs on this host, else starts one of this host alone."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # else Ray reports home
    where = os.environ.get("RAY_ADDRESS")
    host, _, port = (where or "").rpartition("/")[2].rpartition(":")
    try:
        if port.isdigit():  # Ray would try for minutes
            socket.create_connection((host, int(port)), timeout=MEETING).close()
        ray.init(log_to_driver=False, logging_level="ERROR", include_dashboard=False)
    except Exception as error:  # Ray raises many: nobody there, other versions
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise UserError(
            f"collector=ray: cannot {f'join RAY_ADDRESS={where}' if where else 'start Ray on this host'}: {reason}"
        ) from error


def _versions() -> dict[str, str]:
    """Versions of what decides what a world does; what is not installed is left out."""
    found = {"franka_wm": __version__}
    for name in DECISIVE:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def _arrays(data: TensorDictBase) -> Arrays:
    return {key: value.cpu().numpy() for key, value in data.items(True, True)}


def _tensors(arrays: Arrays, size: torch.Size, device: torch.device | None) -> TensorDict:
    data = TensorDict({}, size, device=device)
    for key, value in arrays.items():
        data.set(key, torch.tensor(value))  # copied: what Ray gives may not be written
    return data
