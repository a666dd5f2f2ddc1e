"""Policies that need no learning, as TensorDict modules that a TorchRL collector can run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.constants import NUM_JOINTS
from franka_wm.envs.kinematics import Kinematics
from franka_wm.errors import UserError
from franka_wm.seeding import of_worlds, restore_generator

if TYPE_CHECKING:
    from franka_wm.envs.franka import FrankaEnv


class ScriptedPolicy(TensorDictModuleBase):
    """A policy that learned nothing; its class names what it reads."""

    # TensorDict declares properties and accepts lists.
    in_keys: Any = []  # pyright: ignore[reportIncompatibleVariableOverride]
    out_keys: Any = ["action"]  # pyright: ignore[reportIncompatibleVariableOverride]


class DrawingPolicy(ScriptedPolicy):
    """A scripted policy that draws at random: where it stands can be kept, and put back.

    Args:
        generator: Source of randomness; torch's own if not given.
    """

    def __init__(self, generator: torch.Generator | None):
        super().__init__()
        self.generator = generator

    def get_state(self) -> dict[str, torch.Tensor | None]:
        """What the next actions depend on besides the observation."""
        return {"generator": None if self.generator is None else self.generator.get_state()}

    def set_state(self, state: Mapping[str, torch.Tensor | None], device: torch.device | str = "cpu") -> bool:
        """Goes on from what :meth:`get_state` gave; actions are on ``device``.

        Returns:
            ``False`` where the generator's state is another kind of device's.
        """
        known = state["generator"]
        return self.generator is None or known is None or restore_generator(self.generator, known)


class NoopPolicy(ScriptedPolicy):
    """Does nothing: action 0, which leaves the servo's targets where they are. What every agent must beat.

    Args:
        action_dim: Size of the environment's actions.
        kinematics: The arm's, where actions are poses (``action_mode="joint_position"``), of which 0 is the middle of
            the joints' limits: the action is the servo's present targets, which must be observed; the fingers' is 0.
    """

    def __init__(self, action_dim: int = 7, *, kinematics: Kinematics | None = None):
        super().__init__()
        self.action_dim, self.kinematics = action_dim, kinematics
        self.in_keys = ["is_init"] if kinematics is None else ["is_init", "joint_target"]

    @classmethod
    def of(cls, env: FrankaEnv) -> NoopPolicy:
        """As the environment's actions need it."""
        posed = env.config.action_mode == "joint_position"
        return cls(env.config.action_dim, kinematics=env.kinematics if posed else None)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        is_init, k = tensordict.get("is_init"), self.kinematics
        action = is_init.new_zeros(*is_init.shape[:-1], self.action_dim, dtype=torch.float32)
        if k is not None:
            target = _joint_target(tensordict, "noop")[..., :NUM_JOINTS]
            action[..., :NUM_JOINTS] = 2 * (target - k.lower) / (k.upper - k.lower) - 1
        return tensordict.set("action", action)


class SmoothRandomPolicy(DrawingPolicy):
    """First-order autoregressive random actions in [−1, 1], started anew where an episode starts.

    Args:
        action_dim: Size of the environment's actions.
        smoothness: Correlation of successive actions, in [0, 1).
        generator: Source of randomness.
    """

    in_keys = ["is_init"]

    def __init__(
        self,
        action_dim: int = 7,
        *,
        smoothness: float = 0.7,
        generator: torch.Generator | None = None,
    ):
        super().__init__(generator)
        if not 0.0 <= smoothness < 1.0:
            raise UserError(f"smoothness={smoothness}: must be at least 0 and below 1")
        self.action_dim = action_dim
        self.smoothness = smoothness
        self._present: torch.Tensor | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        is_init = tensordict.get("is_init")
        shape = (*is_init.shape[:-1], self.action_dim)
        noise = of_worlds(
            lambda drawn: torch.randn(drawn, device=is_init.device, generator=self.generator), shape
        )
        if self._present is None or self._present.shape != noise.shape:
            self._present = noise
        else:
            s = self.smoothness
            self._present = torch.where(is_init, noise, s * self._present + math.sqrt(1 - s * s) * noise)
        return tensordict.set("action", self._present.clamp(-1.0, 1.0))

    def get_state(self) -> dict[str, torch.Tensor | None]:
        return super().get_state() | {"present": self._present}

    def set_state(self, state: Mapping[str, torch.Tensor | None], device: torch.device | str = "cpu") -> bool:
        present = state["present"]
        self._present = None if present is None else present.to(device)
        return super().set_state(state, device)


class IKPolicy(ScriptedPolicy):
    """Inverse kinematics with the true geometry and the true goal: what the environment allows at best.

    Solves for joint angles that put the tool on the goal, starting from the servo's present targets, and
    moves the targets there as fast as actions may.

    Args:
        kinematics: The arm's.
        config: The environment's: what an action means.
    """

    in_keys = ["joint_target", "goal"]

    def __init__(self, kinematics: Kinematics, config: FrankaConfig):
        super().__init__()
        self.check(config)
        self.kinematics = kinematics
        self.config = config

    @staticmethod
    def check(config: FrankaConfig) -> None:
        """Refuse an arm with a gripper, before it is built.

        Raises:
            UserError: it has one.
        """
        if config.has_gripper:
            raise UserError(
                f"policy=ik: brings the tool to the goal and knows no gripper, which task={config.task} has; use "
                "policy=expert"
            )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        target = _joint_target(tensordict, "ik")
        goal, c, k = tensordict.get("goal"), self.config, self.kinematics
        if c.action_mode == "ee_delta":
            action = (goal - k.forward(target)) / c.ee_scale
        elif c.action_mode == "joint_position":
            action = 2 * (k.solve(goal, target) - k.lower) / (k.upper - k.lower) - 1
        else:
            action = (k.solve(goal, target) - target) / c.action_scale
        return tensordict.set("action", action.clamp(-1.0, 1.0))


def _joint_target(tensordict: TensorDictBase, policy: str) -> torch.Tensor:
    target = tensordict.get("joint_target", None)
    if target is None:
        raise UserError(f"policy={policy} reads joint_target; add it to the environment's observations")
    return target


class DiscreteIKPolicy(ScriptedPolicy):
    """``ik`` for discrete actions: the first of the two actions after which the tool is nearest to the goal.

    All pairs of actions are tried with the true geometry, on the tool's position where the servo's targets put it. A
    tenth of the distance after the first action counts as well, so that arriving is not put off. How near it
    comes: `docs/results.md`, MuZero's *search with the same actions*.

    Args:
        kinematics: The arm's.
        config: The environment's: what an action means.
        table: The discrete actions, (M, A).
    """

    in_keys = ["joint_target", "goal"]

    def __init__(self, kinematics: Kinematics, config: FrankaConfig, table: torch.Tensor):
        super().__init__()
        self.kinematics = kinematics
        self.config = config
        self.table = table

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        target, goal = _joint_target(tensordict, "ik"), tensordict.get("goal")
        if self.config.action_mode == "ee_delta":
            target = self.kinematics.forward(target)  # tool positions stand for targets: actions shift them
        once = self._moved(target)  # (N, M, 7 or 3)
        twice = self._moved(once)  # (N, M, M, 7 or 3)
        soon = (self._tool(once) - goal[..., None, :]).norm(dim=-1)
        late = (self._tool(twice) - goal[..., None, None, :]).norm(dim=-1).amin(-1)
        return tensordict.set("action", (late + 0.1 * soon).argmin(-1))

    def _moved(self, target: torch.Tensor) -> torch.Tensor:
        """Targets (..., 7), or tool positions (..., 3), after each action: (..., M, 7 or 3)."""
        c, k, target = self.config, self.kinematics, target.unsqueeze(-2)
        if c.action_mode == "ee_delta":
            return target + c.ee_scale * self.table
        if c.action_mode == "joint_position":
            return (k.lower + 0.5 * (self.table + 1.0) * (k.upper - k.lower)).expand(
                *target.shape[:-2], -1, -1
            )
        return torch.clamp(target + c.action_scale * self.table, k.lower, k.upper)

    def _tool(self, target: torch.Tensor) -> torch.Tensor:
        return target if self.config.action_mode == "ee_delta" else self.kinematics.forward(target)


class DiscretePolicy(ScriptedPolicy):
    """A policy for continuous actions, played with discrete actions: the row of the table nearest to its action.

    Args:
        policy: Writes ``action`` (N, A).
        table: The discrete actions, (M, A).
    """

    def __init__(self, policy: TensorDictModuleBase, table: torch.Tensor):
        super().__init__()
        self.policy = policy
        self.table = table
        self.in_keys = list(policy.in_keys)
        self.out_keys = ["action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = self.policy(tensordict).get("action")
        distance = (action.unsqueeze(-2) - self.table).square().sum(-1)
        return tensordict.set("action", distance.argmin(-1))


class RandomDiscretePolicy(DrawingPolicy):
    """An action drawn uniformly, in every step: int64 (N,).

    Args:
        num_actions: How many actions there are.
        generator: Source of randomness.
    """

    in_keys = ["is_init"]

    def __init__(self, num_actions: int, *, generator: torch.Generator | None = None):
        super().__init__(generator)
        self.num_actions = num_actions

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        is_init = tensordict.get("is_init")
        action = of_worlds(
            lambda drawn: torch.randint(
                self.num_actions, drawn, device=is_init.device, generator=self.generator
            ),
            is_init.shape[:-1],
        )
        return tensordict.set("action", action)
