# pyright: reportArgumentType=false, reportCallIssue=false
# (TorchRL's annotations do not know shapes as tuples.)
"""``MultiTaskEnv``: several tasks of the arm as one TorchRL environment; each world has its own task."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn import functional as F
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from franka_wm.device import resolve_device
from franka_wm.envs.franka import FLAGS, FrankaEnv, own_seed
from franka_wm.envs.multitask_config import MultiTaskConfig
from franka_wm.envs.specs import MARKS, check_state
from franka_wm.envs.start import check_arguments
from franka_wm.errors import UserError
from franka_wm.seeding import derive_seed
from franka_wm.streams import side_stream

MEANS = ("return", "length", "success", "success_once")


class MultiTaskEnv(EnvBase):
    """N worlds of K tasks: world k has task k mod K. Every task has a simulation and a captured graph of its own.

    Observations are those of all tasks; what a task does not have, or has less of, is filled with zeros. ``task``
    (N, K) float32 is one-hot. Actions have the size of the largest; the others ignore what is beyond their own.
    Rewards, ends and automatic resets are those of :class:`FrankaEnv`.

    Args:
        config: The tasks.
        num_envs: Number of worlds, N ≥ K.
        device, seed, first_world: As for :class:`FrankaEnv`; the first world is of the first task.

    Raises:
        UserError: Fewer worlds than tasks, or a task that cannot be built.
    """

    device: torch.device

    def __init__(
        self,
        config: MultiTaskConfig,
        *,
        num_envs: int,
        device: torch.device | str | None = None,
        seed: int | None = None,
        first_world: int = 0,
    ):
        seed = own_seed() if seed is None else seed
        check_arguments(next(iter(config.tasks.values())), num_envs, seed, first_world)
        num_envs = int(num_envs)
        count = len(config.tasks)
        if num_envs < count:
            raise UserError(f"num_envs={num_envs}: {count} tasks need at least as many worlds")
        _require_first_task(first_world, count)
        device = resolve_device(device)
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.config, self.num_envs = config, num_envs
        self.envs = {
            name: FrankaEnv(
                one,
                num_envs=len(range(k, num_envs, count)),
                device=device,
                seed=derive_seed("task", seed, name),
                first_world=first_world // count,
            )
            for k, (name, one) in enumerate(config.tasks.items())
        }
        specs = [env.observation_spec for env in self.envs.values()]
        names = dict.fromkeys(key for spec in specs for key in spec if key not in MARKS)
        self.sizes = {key: max(spec[key].shape[-1] for spec in specs if key in spec) for key in names}
        self.one_hot = F.one_hot(torch.arange(num_envs, device=device) % count, count).float()
        n = num_envs
        vectors = {key: Unbounded(shape=(n, size), device=device) for key, size in self.sizes.items()}
        flagged = [key for key in MARKS if any(key in spec for spec in specs)]
        marks = {key: Binary(shape=(n, 1), dtype=torch.bool, device=device) for key in flagged}
        task = Unbounded(shape=(n, count), device=device)
        self.observation_spec = Composite(**vectors, task=task, **marks, shape=(n,), device=device)
        self.action_spec = Bounded(-1.0, 1.0, shape=(n, self.action_dim), device=device)
        self.reward_spec = Unbounded(shape=(n, 1), device=device)
        flags = {key: Binary(shape=(n, 1), dtype=torch.bool, device=device) for key in FLAGS}
        self.done_spec = Composite(**flags, shape=(n,), device=device)

    # -- TorchRL ------------------------------------------------------------------------------------------

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, seed: int | None = None, **_
    ) -> TensorDictBase:
        if seed is not None:
            self._set_seed(seed)
        mask = None if tensordict is None else tensordict.get("_reset", None)
        parts = []
        for k, env in enumerate(self.envs.values()):
            own = None if mask is None else mask[k :: len(self.envs)]
            asked = None if own is None else TensorDict({"_reset": own}, env.batch_size, device=env.device)
            parts.append(env._reset(asked))
        return TensorDict(self._together(parts), batch_size=self.batch_size, device=self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action")
        if action.shape != self.action_spec.shape:
            raise UserError(
                f"action has shape {tuple(action.shape)}; it must be {tuple(self.action_spec.shape)}"
            )
        parts, lanes = [], []
        for k, env in enumerate(self.envs.values()):
            own = action[k :: len(self.envs), : env.action_dim]
            # The worlds of one task are few for a GPU: all tasks step at the same time there.
            with side_stream(action, lane=k) as lane:
                parts.append(env._step(TensorDict({"action": own}, env.batch_size, device=env.device)))
            lanes.append(lane)
        for lane, part in zip(lanes, parts, strict=True):
            lane.join(*part.values())
        return TensorDict(self._together(parts), batch_size=self.batch_size, device=self.device)

    # It asks for `config.auto_reset`, `restarting` and `_present` alone.
    _step_and_maybe_reset = FrankaEnv._step_and_maybe_reset  # pyright: ignore[reportAssignmentType]

    @contextmanager
    def restarting(self) -> Iterator[None]:
        """Steps inside begin the next episode of finished worlds."""
        with ExitStack() as stack:
            for env in self.envs.values():
                stack.enter_context(env.restarting())
            yield

    def _present(self) -> dict[str, Tensor]:
        return self._together([env._present() for env in self.envs.values()])

    def _set_seed(self, seed: int | None) -> None:
        seed = own_seed() if seed is None else seed
        for name, env in self.envs.items():
            env._set_seed(derive_seed("task", seed, name))

    def set_first_world(self, number: int) -> None:
        """From the next reset on, these worlds play the episodes of those from ``number``, which has the first task.

        Raises:
            UserError: It has another task.
        """
        _require_first_task(number, len(self.envs))
        for env in self.envs.values():
            env.simulation.set_first_world(number // len(self.envs))

    def _together(self, parts: list[Any]) -> dict[str, Tensor]:
        """Entries of all worlds, of those of each task's worlds in order; ``task`` is added."""
        count, out = len(parts), {"task": self.one_hot.clone()}
        for key in dict.fromkeys(key for part in parts for key in part.keys()):  # noqa: SIM118
            having = [part[key] for part in parts if key in part.keys()]  # noqa: SIM118
            if len({own.shape for own in having}) == 1 and len(having) == count:  # in turns, in one launch
                out[key] = torch.stack(having, 1).flatten(0, 1)
                continue
            out[key] = having[0].new_zeros(self.num_envs, max(own.shape[-1] for own in having))
            for k, part in enumerate(parts):
                own = part.get(key, None)
                if own is not None:
                    out[key][k::count, : own.shape[-1]] = own
        return out

    def split(self, tensordict: TensorDictBase) -> dict[str, TensorDict]:
        """Task -> what its worlds observe, in its own sizes; of the first worlds alone, only tasks that they have."""
        parts, worlds = {}, tensordict.batch_size[0]
        for k, (name, env) in enumerate(self.envs.items()):
            sizes = {
                key: env.observation_spec[key].shape[-1] for key in self.sizes if key in env.observation_spec
            }
            own = {
                key: tensordict.get(key)[k :: len(self.envs), :size]
                for key, size in sizes.items()
                if tensordict.get(key, None) is not None
            }
            if k < worlds:
                parts[name] = TensorDict(own, [len(range(k, worlds, len(self.envs)))], device=env.device)
        return parts

    def join(self, parts: Mapping[str, Tensor]) -> Tensor:
        """Actions (N, A) of the worlds that :meth:`split` had, of those of each task's."""
        out = next(iter(parts.values())).new_zeros(sum(map(len, parts.values())), self.action_dim)
        for k, name in enumerate(self.envs):
            if name in parts:
                out[k :: len(self.envs), : parts[name].shape[-1]] = parts[name]
        return out

    # -- what trainers ask of an environment ----------------------------------------------------------------

    @property
    def action_dim(self) -> int:
        """Size of the largest action."""
        return max(env.action_dim for env in self.envs.values())

    @property
    def action_masks(self) -> list[list[float]] | None:
        """For each task 1 where it has the entry of an action, else 0; ``None`` where all have the same."""
        sizes, most = [env.action_dim for env in self.envs.values()], self.action_dim
        return None if min(sizes) == most else [[float(k < size) for k in range(most)] for size in sizes]

    @property
    def terminates(self) -> bool:
        """Whether episodes may end by more than their length."""
        return self.config.terminate_on_success

    @property
    def reward_bounds(self) -> tuple[float, float] | None:
        """The least and the largest reward of a step of any task; ``None`` where one does not say."""
        bounds = [env.reward_bounds for env in self.envs.values()]
        known = [one for one in bounds if one is not None]
        return None if len(known) < len(bounds) else (min(a for a, _ in known), max(b for _, b in known))

    def statistics(self, *, clear: bool = True) -> dict[str, float]:
        """Those of :meth:`FrankaEnv.statistics` over all tasks; ``success/TASK`` and ``episodes/TASK`` of each.

        A host sync for each task.
        """
        found = {name: env.statistics(clear=clear) for name, env in self.envs.items()}
        ended = {name: one["episodes"] for name, one in found.items()}
        total = sum(ended.values())
        out = {"episodes": total}
        if total:
            for key in MEANS:
                out[key] = sum(one[key] * ended[name] for name, one in found.items() if ended[name]) / total
        for key in ("nonfinite", "overflow"):
            out[key] = sum(one.get(key, 0.0) for one in found.values())
        for name, one in found.items():
            if ended[name]:
                out |= {f"success/{name}": one["success"], f"episodes/{name}": ended[name]}
        return out

    def get_state(self) -> TensorDict:
        """Task -> :meth:`FrankaEnv.get_state` of its worlds."""
        return TensorDict({name: env.get_state() for name, env in self.envs.items()}, device=self.device)

    def set_state(self, state: TensorDictBase) -> None:
        """Puts all worlds where :meth:`get_state` found them.

        Raises:
            UserError: It is no state, or one of other tasks or numbers of worlds; nothing is changed then.
        """
        check_state(state)
        for name in state.keys():  # noqa: SIM118  (a TensorDict iterates over its worlds)
            check_state(state.get(name))
        if set(state.keys()) != set(self.envs):
            raise UserError(
                f"set_state: of {', '.join(map(str, state.keys()))}; these worlds are of {', '.join(self.envs)}"
            )
        sizes = {name: state.get(name).batch_size for name in self.envs}
        wrong = [
            name for name, env in self.envs.items() if sizes[name] not in (env.batch_size, torch.Size([]))
        ]
        if wrong:
            raise UserError(
                f"set_state: {wrong[0]} has another number of worlds; take it from get_state() of this one"
            )
        entries = {name: dict(state.get(name).items()) for name in self.envs}
        for name, env in self.envs.items():
            env.simulation.check_state(entries[name])
        for name, env in self.envs.items():
            env.set_state(TensorDict(entries[name], batch_size=env.batch_size, device=env.device))


def _require_first_task(first_world: int, tasks: int) -> None:
    if first_world % tasks:
        raise UserError(f"first_world={first_world}: must be a multiple of the {tasks} tasks")
