"""Other environments than the arm, through TorchRL's own wrappers: Gymnasium and the DeepMind Control Suite.

They run on the CPU, one copy after the other (``SerialEnv``), in several processes (``ParallelEnv``), or in Ray actors.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.process import BaseProcess
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl._utils import seed_generator
from torchrl.data import Bounded, Categorical
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.transforms import (
    ActionScaling,
    BatchSizeTransform,
    CatTensors,
    Compose,
    DeviceCastTransform,
    DoubleToFloat,
    InitTracker,
    RewardSum,
    StepCounter,
)

from franka_wm.envs.external_config import ExternalConfig
from franka_wm.envs.external_ray import RayEnv
from franka_wm.errors import UserError


class ExternalEnv(TransformedEnv):
    """N copies of an environment of another simulator, with the keys that models of this package read.

    ``state`` (N, D) float32 and whatever else ``config.observations`` names; ``action`` in [−1, 1], (N, A), or int64
    (N,) where actions are discrete; ``reward`` (N, 1); ``is_init``, ``done``, ``terminated``, ``truncated`` (N, 1).
    Finished copies are reset as TorchRL's collectors do it (standard mode).

    Args:
        config: Which environment.
        num_envs: Copies, N.
        seed: Seed of all copies.
        device: Where the TensorDicts live; the simulators stay on the CPU.
        workers: Processes that share the copies equally, and play the same episodes; 0: this one does. ``close()`` ends
            them.
        ray: These are Ray actors, also on other hosts.

    Raises:
        UserError: The extra is not installed, there is no such environment or observation, no model here can choose its
            actions, or what Ray says.
    """

    device: torch.device
    reward_bounds = None  # of a step: neither library says them
    action_masks = None  # all entries count

    def __init__(
        self,
        config: ExternalConfig,
        *,
        num_envs: int = 1,
        seed: int = 0,
        device: torch.device | str | None = None,
        workers: int = 0,
        ray: bool = False,
    ):
        make = partial(_make_one, config)
        one = make()
        try:
            groups = _groups(config, one)
            _require_actions(config, one)
            continuous = one.action_spec.dtype.is_floating_point
        finally:
            one.close()
        processes: list[BaseProcess] = []
        transforms = [
            DoubleToFloat(),
            *(CatTensors(in_keys=keys, out_key=name, sort=False) for name, keys in groups.items()),
            # TorchRL's wrapper for Gymnasium leaves actions in the units of the environment.
            *([ActionScaling(in_keys_inv=["action"])] if continuous else []),
            StepCounter(max_steps=config.episode_length),
            RewardSum(),
            InitTracker(),
        ]
        if ray:
            base = RayEnv(make, num_envs=num_envs, workers=workers, device=device)
        elif workers:
            share = partial(_worker, os.getpid(), num_envs // workers, make)
            # Daemons end with this process, however it ends. It keeps its threads: TorchRL would take one for each
            # worker, and with fewer the learner is slower and rounds otherwise.
            keeps = {"daemon": True, "num_threads": torch.get_num_threads()}
            base = ParallelEnv(workers, share, device="cpu", **keeps)
            base.start()
            processes = list(base._workers)
            flat = BatchSizeTransform(reshape_fn=_flat)
            flat.enable_inv_on_reset = True  # masks of a reset, too
            base = TransformedEnv(base, flat)
        else:
            base = SerialEnv(num_envs, make, device="cpu")
        # Each entry is copied for all worlds at once: copies world by world take longer than the worlds.
        if device is not None and torch.device(device).type != "cpu" and not ray:
            transforms.append(_ToDevice(device, orig_device="cpu"))
        super().__init__(base, Compose(*transforms))
        self.config, self.num_envs = config, num_envs
        self._totals = torch.zeros(3, device=device)
        self._first_world, self._workers = 0, processes
        self.set_seed(seed)

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Each copy gets a seed that follows from the one before; the first one ``seed``, unless it has a number."""
        if seed is not None and not static_seed:
            for _ in range(self._first_world):
                seed = seed_generator(seed)
        with self._workers_live():
            return super().set_seed(seed, static_seed=static_seed)

    def set_first_world(self, number: int) -> None:
        """From the next :meth:`set_seed` on, these copies play the episodes of those from ``number``."""
        self._first_world = number

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """Uniform actions; TorchRL's own refuses an environment of transformed ones, as with ``workers``."""
        return EnvBase.rand_action(self, tensordict)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        with self._workers_live():
            out = super()._step(tensordict)
        done = out.get("done")
        finished = (out.get("episode_reward"), out.get("step_count").float(), torch.ones_like(done).float())
        self._totals += torch.stack([torch.where(done, x, 0.0).sum() for x in finished]).to(self._totals)
        return out

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        with self._workers_live():
            return super()._reset(tensordict, **kwargs)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Ends the workers; that one had died is said by what was asked of it before, and here by nothing."""
        with suppress(UserError), self._workers_live():
            super().close(raise_if_closed=raise_if_closed)
        self._workers = []

    @contextmanager
    def _workers_live(self) -> Iterator[None]:
        """Where a worker has died, TorchRL raises whatever the pipe to it or its own patience says."""
        try:
            yield
        except Exception as error:
            if not any(map(_ended, self._workers)):
                raise
            raise UserError(
                f"collector.workers={len(self._workers)}: a worker has died, by an error of the environment, printed "
                "above, or killed, perhaps for want of memory; resume=FOLDER goes on from a checkpoint"
            ) from error

    @property
    def terminates(self) -> bool:
        """Whether episodes may end by more than their length: those of the suite do not."""
        return self.config.kind == "gym"

    @property
    def action_dim(self) -> int:
        """Size of a continuous action, A; the number of actions where they are discrete."""
        spec = self.action_spec
        return spec.shape[-1] if spec.dtype.is_floating_point else int(spec.n)  # type: ignore[attr-defined]

    def statistics(self, *, clear: bool = True) -> dict[str, float]:
        """``episodes`` that ended since the last call; if any, means over them, too: ``return``, ``length``."""
        total, length, count = self._totals.tolist()
        if clear:
            self._totals.zero_()
        means = {"return": total / count, "length": length / count} if count else {}
        return {"episodes": count, **means}


class _ToDevice(DeviceCastTransform):
    """Worlds on the CPU, entries on another device; what worlds and counters do not read stays there."""

    READ = (
        "action", "step_count", "episode_reward", "is_init", "done", "terminated", "truncated", "_reset", "_step",
    )  # fmt: skip
    enable_inv_on_reset = True  # masks of a reset, too

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.select(*self.READ, strict=False).to("cpu", non_blocking=False)


def check_external(config: ExternalConfig) -> tuple[dict[str, int], int, int]:
    """Makes one copy and closes it again.

    Returns:
        Sizes of the observations that models read; the size of a continuous action, or 0; how many discrete actions
        there are, or 0.

    Raises:
        UserError: The extra is not installed, there is no such environment or observation, or no model here can choose
            its actions.
    """
    env = _make_one(config)
    try:
        spec = env.observation_spec
        sizes = {
            name: sum(spec[key].shape.numel() for key in keys) for name, keys in _groups(config, env).items()
        }
        _require_actions(config, env)
        action: Any = env.action_spec
        continuous = action.dtype.is_floating_point
        return sizes, action.shape[-1] if continuous else 0, 0 if continuous else int(action.n)
    finally:
        env.close()


def _flat(data: Any) -> Any:
    """(processes, copies of each, …) → (N, …)"""
    return data.flatten(0, 1)


def _worker(starter: int, num_envs: int, make: Callable[[], EnvBase]) -> SerialEnv:
    """The worlds of a worker, which leaves the process group that Ctrl-C and launchers signal.

    The process that has started it still needs its worlds, to end what it is at and save. TorchRL calls this in that
    process, too, whose group stays.
    """
    if os.getpid() != starter:
        os.setsid()
    return SerialEnv(num_envs, make, device="cpu")


def _ended(process: BaseProcess) -> bool:
    try:
        process.join(0.1)  # its pipe may break before it has ended
        return process.exitcode is not None
    except ValueError:  # TorchRL has closed it
        return True


def _make_one(config: ExternalConfig) -> EnvBase:
    # The device is said, or TorchRL would not move the masks of a reset to where the simulator is.
    try:
        if config.kind == "gym":
            from torchrl.envs import GymEnv

            return GymEnv(
                config.name, frame_skip=config.frame_skip, categorical_action_encoding=True, device="cpu"
            )
        from torchrl.envs import DMControlEnv

        return DMControlEnv(config.name, config.task, frame_skip=config.frame_skip, device="cpu")
    except ImportError as error:
        extra = config.kind
        raise UserError(f"env={extra} needs pip install 'franka-wm[{extra}]' ({error})") from error
    except Exception as error:  # whatever the other library raises for a name that it does not know
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise UserError(f"env={config.kind}: cannot make {config.label!r}: {reason}") from error


def _groups(config: ExternalConfig, env: EnvBase) -> dict[str, list[str]]:
    """Key that models read → the wrapper's keys."""
    vectors = [
        key
        for key, spec in env.observation_spec.items()
        if spec is not None and spec.dtype.is_floating_point and len(spec.shape) <= 1
    ]
    if not vectors:
        raise UserError(
            f"env.name={config.name}: it observes no vector of real numbers, which models here read"
        )
    if not config.observations:
        return {"state": [str(key) for key in vectors]}
    groups: dict[str, list[str]] = {}
    for name, keys in config.observations.items():
        groups[name] = [keys] if isinstance(keys, str) else list(keys)
        for key in groups[name]:
            if key not in vectors:
                raise UserError(
                    f"env.observations: no {key!r}; {config.label} has {', '.join(map(str, vectors))}"
                )
    return groups


def _require_actions(config: ExternalConfig, env: EnvBase) -> None:
    """Refuses actions that are neither a vector that can be scaled to [−1, 1] nor the number of one choice."""
    spec = env.action_spec
    if isinstance(spec, Bounded) and len(spec.shape) == 1 and spec.dtype.is_floating_point:
        if bool((spec.high - spec.low).isfinite().all()):
            return
    elif isinstance(spec, Categorical) and not spec.shape:
        return
    raise UserError(
        f"env.name={config.name}: its actions must be one vector with finite bounds or one discrete number"
    )
