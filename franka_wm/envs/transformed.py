"""``TransformedFrankaEnv``: transforms over the arm, in steps that do not wait for the device."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Compose, EnvBase, TransformedEnv
from torchrl.envs.transforms import VecNorm, VecNormV2

from franka_wm.envs.franka import FrankaEnv
from franka_wm.errors import UserError


def arm_of(env: EnvBase | None) -> FrankaEnv | None:
    """The arm inside an environment, under whatever transforms; ``None`` for one of another library."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env if isinstance(env, FrankaEnv) else None


class TransformedFrankaEnv(TransformedEnv):
    """A ``TransformedEnv`` that does not ask the device in each step whether an episode has ended.

    TorchRL's own gives the same numbers: it resets by mask after the steps in which a world is done, and waits for
    the device to know. This one resets by mask after every step, which is nothing where no world is done. For
    transforms that learn from each observation that a reset gives them (``VecNorm``, ``VecNormV2``), for
    ``auto_reset="standard"`` and over other environments it does what TorchRL's does.
    """

    device: torch.device

    def set_state(self, state: TensorDictBase) -> TensorDictBase:
        """Transforms keep what they have seen, so a state of the worlds alone cannot be put back here.

        Raises:
            UserError: It names what can.
        """
        raise UserError("set_state: transforms have memories of their own; call base_env.set_state(state)")

    def _step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        if not self._resets_every_step():
            return super()._step_and_maybe_reset(tensordict)
        if tensordict.device != self.device:
            tensordict = tensordict.to(self.device)
        tensordict = self.step(tensordict)
        following = self._step_mdp(tensordict)
        tensordict, following = self._post_step_mdp_hooks(tensordict, following)
        done = following.get("done")
        first = self._reset(
            TensorDict({"_reset": done.clone()}, batch_size=self.batch_size, device=self.device)
        )
        mask = done.reshape(self.batch_size)
        for key, new in first.items(True, True):
            old = following.get(key, None)
            if old is not None:
                where = mask.view(*mask.shape, *[1] * (new.dim() - mask.dim()))
                following.set(key, torch.where(where, new, old))
        return tensordict, following

    def _resets_every_step(self) -> bool:
        """Whether a reset of no world changes nothing here, and is wanted."""
        env: EnvBase = self
        while isinstance(env, TransformedEnv):
            if any(isinstance(transform, (VecNorm, VecNormV2)) for transform in _flat(env.transform)):
                return False
            env = env.base_env
        return isinstance(env, FrankaEnv) and env.config.auto_reset == "native"


def _flat(transform: torch.nn.Module) -> Iterator[torch.nn.Module]:
    """The transforms that one is made of."""
    if isinstance(transform, Compose):
        for part in transform.transforms:
            yield from _flat(part)
    else:
        yield transform
