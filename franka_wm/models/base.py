"""Base class of all world models: what a trainer, a planner or an evaluation may ask, with its default."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from franka_wm.errors import UserError
from franka_wm.models.groups import ParameterGroup, decay_groups
from franka_wm.options import Bounds, check_arguments

ABILITIES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "has_next": ("next",),
        "has_reward": ("reward",),
        "has_arrival_reward": ("arrival_reward",),
        "has_value": ("value",),
        "has_policy": ("policy",),
        "has_goal": ("encode_goal",),
        "has_goal_policy": ("goal_policy",),
        "has_goal_steps": ("goal_steps",),
        "has_memory": ("observe",),
        "has_search": ("prediction", "recurrent"),
    }
)
"""Flag -> methods that a family defines to have this ability. The flags are set when the class is defined."""


def summed(*losses: Tensor) -> Tensor:
    """Sum of losses; where gradients are recorded, without those that are constant.

    A constant 0 that is added is what inductor leaves out. Of a sum of one term and zeros the detached metric of that
    term would then be the loss, without a gradient.
    """
    trained = [loss for loss in losses if loss.requires_grad]
    total, *others = trained or losses
    for loss in others:
        total = total + loss
    return total


class WorldModel(nn.Module):
    """A latent model of an environment: `encode` and `loss`, and the optional abilities that a family defines.

    To define one of the optional methods is to have the ability: its flag is then True (see `ABILITIES`). A family
    whose ability depends on an option sets the flag in its constructor. Latents z are (..., Z); leading dimensions
    are free everywhere.
    """

    # What a family is. Known before it is built.
    discrete: bool = False
    """Whether actions are numbers of discrete actions (...) int64, chosen by tree search."""
    cross_episode: bool = False
    """Whether `loss` takes windows that go on past the end of an episode."""
    moved_windows: bool = False
    """Whether its windows are so long that the first and last steps of episodes would be in few of them: windows that
    would cross the end of an episode are moved into it."""
    burn_in: int = 0
    """So many steps are in front of each window that `loss` takes, of any episode, for a memory to begin with. The
    option of this name says it, to what makes batches and to the constructor."""
    replay_keys: tuple[str, ...] = ()
    """Entries that the acting policy writes and `loss` reads."""
    pretrained: bool = False
    """Whether it cannot do without a pretrained encoder: `encoder_from`, `huggingface` or a first stage."""
    ranges: ClassVar[Mapping[str, Bounds]] = MappingProxyType({})
    """Option -> values that it may have. `validate` checks them."""

    # Abilities, see `ABILITIES`.
    has_next: bool = False
    has_reward: bool = False
    has_arrival_reward: bool = False
    has_value: bool = False
    has_policy: bool = False
    has_goal: bool = False
    has_goal_policy: bool = False
    has_goal_steps: bool = False
    has_memory: bool = False
    has_search: bool = False

    # What a model is. Set by its constructor.
    observation_sizes: Mapping[str, int] = MappingProxyType({})
    """Vector key -> size of its last dimension."""
    image_sizes: Mapping[str, tuple[int, int, int]] = MappingProxyType({})
    """Image key -> (height, width, channels), uint8."""
    standardized_images: Sequence[str] = ()
    """Image keys whose mean and deviation `set_image_statistics` is told before the first update."""
    num_actions: int = 0
    """Number of discrete actions, of a family with `discrete`."""
    discount: float = math.nan
    """Discount per step, of a family with reward or value."""
    terminates: bool = False
    """Whether `terminated` predicts ends of episodes."""
    weight_decay: float = 0.0
    """Weight decay of matrices, see `parameter_groups`."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        # Its own, and those of bases that are no models themselves, whose flags are set already.
        own = {
            name
            for kind in cls.__mro__
            if kind is cls or not issubclass(kind, WorldModel)
            for name in vars(kind)
        }
        for flag, methods in ABILITIES.items():
            if flag not in cls.__dict__ and own.intersection(methods):
                setattr(cls, flag, all(getattr(cls, m) is not getattr(WorldModel, m) for m in methods))

    # ------------------------------------------------------------------ every family

    @property
    def observation_keys(self) -> list[str]:
        """Keys of an observation that `encode` reads: vectors, then images."""
        return [*self.observation_sizes, *self.image_sizes]

    def encode(self, observation: TensorDictBase) -> Tensor:
        """Latents z (..., Z) of observations of batch size (...)."""
        raise self._lacks("encode")

    def loss(self, batch: TensorDictBase) -> TensorDict:
        """Entry `loss` () to differentiate, and metrics () to log.

        Args:
            batch: windows [B, H] of contiguous transitions, with what follows each in `next`; [B, burn_in + H] where
                the model asks for steps in front of them.
        """
        raise self._lacks("loss")

    def forward(self, batch: TensorDictBase) -> TensorDict:
        """Same as `loss`, for wrappers that call the module."""
        return self.loss(batch)

    # ------------------------------------------------------------------ optional abilities

    def next(self, z: Tensor, action: Tensor) -> Tensor:
        """Next latents (..., Z) after actions (..., A) in z (..., Z)."""
        raise self._lacks("next")

    def reward(self, z: Tensor, action: Tensor) -> Tensor:
        """Expected reward (..., 1) of actions (..., A) in z (..., Z)."""
        raise self._lacks("reward")

    def arrival_reward(self, z: Tensor) -> Tensor:
        """Expected reward (..., 1) of the action that led to z (..., Z), where a reward depends on that alone."""
        raise self._lacks("arrival_reward")

    def value(self, z: Tensor) -> Tensor:
        """Expected discounted return (..., 1) from z (..., Z)."""
        raise self._lacks("value")

    def terminated(self, z: Tensor) -> Tensor:
        """Whether an episode ends in z (..., Z): (..., 1) bool; of models with `terminates`."""
        raise self._lacks("terminated")

    def policy(self, z: Tensor, deterministic: bool = False) -> Tensor:
        """Actions (..., A) for z (..., Z): a sample, or the mode."""
        raise self._lacks("policy")

    def encode_goal(self, observation: TensorDictBase) -> Tensor:
        """Embedding (..., D) of a goal from its images, in the space of `embed`.

        Args:
            observation: the images that the model reads, under its own keys (`pixels`, not `goal_pixels`), showing the
                goal; no vectors.
        """
        raise self._lacks("encode_goal")

    def goal_policy(self, z: Tensor, goal: Tensor, deterministic: bool = False) -> Tensor:
        """Actions (..., A) for z (..., Z) towards goals (..., D) of `encode_goal`: a sample, or the mode."""
        raise self._lacks("goal_policy")

    def goal_steps(self, embedded: Tensor, goal: Tensor) -> Tensor:
        """Learned distance (...) in steps, in [0, 1], of embeddings (..., D) to goals (..., D) of `encode_goal`."""
        raise self._lacks("goal_steps")

    def embed(self, z: Tensor) -> Tensor:
        """What distances are measured on (..., D): z itself by default."""
        return z

    def observe(
        self, observation: TensorDictBase, previous_z: Tensor, action: Tensor, is_init: Tensor
    ) -> Tensor:
        """Latent z (E, Z) after `action` led to `observation`, of a model with memory.

        Args:
            observation: batch size [E].
            previous_z: (E, Z), before the action.
            action: (E, A).
            is_init: (E, 1) bool; where True the observation is an episode's first, and z that of `encode`.
        """
        raise self._lacks("observe")

    def prediction(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (..., M) and value (..., 1) of z (..., Z), for tree search."""
        raise self._lacks("prediction")

    def recurrent(self, z: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """One step of a search: next z, reward, discount, and the next z's logits and value."""
        raise self._lacks("recurrent")

    # ------------------------------------------------------------------ training

    def set_observation_statistics(self, mean: Tensor, std: Tensor) -> None:
        """Standardise vector observations from now on; does nothing by default.

        Args:
            mean, std: (sum of `observation_sizes`), in the units of the observations.
        """

    def set_image_statistics(self, moments: Mapping[str, Sequence[Tensor]]) -> None:
        """Standardise images from now on, of a model with `standardized_images`; does nothing by default.

        Args:
            moments: mean and deviation (height, width, c) of each of these, of images in [0, 1].
        """

    def parameter_groups(self, lr: float) -> list[ParameterGroup]:
        """Groups for AdamW, of all that are trained: matrices with `weight_decay`, the rest without."""
        return decay_groups(self.parameters(), lr, weight_decay=self.weight_decay)

    def after_update(self) -> None:
        """Move slow copies of weights, after each optimiser step; there are none by default."""

    parts_of_loss: ClassVar[tuple[str, ...]] = ()
    """Methods that `loss` calls and that are compiled one by one, rather than `loss` as one program."""
    repeated: ClassVar[tuple[str, ...]] = ()
    """Modules whose weights `loss` multiplies by again and again: in low precision they are cast once for all."""

    def compiled_loss(self) -> Callable[[TensorDictBase], TensorDict]:
        """`loss`, compiled by `torch.compile`: each of `parts_of_loss`, else as one program.

        Parts are compiled for every shape that they are called with; what else `loss` does runs as it is. A subclass
        with a loss of its own has the parts that it names itself.
        """
        loss, parts = self.loss, self.__class__._parts()
        if not parts:
            return torch.compile(loss)
        compiled = {name: torch.compile(getattr(self, name), dynamic=False) for name in parts}

        def of_parts(batch: TensorDictBase) -> TensorDict:
            own = vars(self)
            before = {name: own[name] for name in compiled if name in own}
            own.update(compiled)  # what `loss` finds under these names, before the class's
            try:
                return loss(batch)
            finally:
                for name in compiled:
                    own.pop(name, None)
                own.update(before)

        return of_parts

    @classmethod
    def _parts(cls) -> tuple[str, ...]:
        """`parts_of_loss` of the class that defines `loss`, or of a subclass that names its own."""
        owner = next(kind for kind in cls.__mro__ if {"loss", "parts_of_loss"}.intersection(vars(kind)))
        parts = vars(owner).get("parts_of_loss", ())
        missing = [name for name in parts if not hasattr(cls, name)]
        if missing:
            raise UserError(
                f"{cls.__name__}.parts_of_loss names {missing[0]}, which is no method of the class"
            )
        return parts

    def rebuild_overrides(self) -> dict[str, Any]:
        """Constructor arguments that replace those which read other files or depend on the environment.

        A checkpoint stores them, so that its own weights rebuild the model. They can be written as JSON.
        """
        return {}

    @classmethod
    def validate(cls, options: Mapping[str, Any], *, window: int | None = None) -> None:
        """Check options before anything is built: their types by the constructor, and `ranges`.

        Args:
            options: those of `conf/model`; entries that the constructor does not take are not looked at.
            window: transitions of a training window; None: not known yet.

        Raises:
            UserError: one line with the option, its value and what is allowed.
        """
        check_arguments(cls, options, "model", cls.ranges)

    def _lacks(self, name: str) -> NotImplementedError:
        return NotImplementedError(f"{type(self).__name__} has no {name}; see docs/models.md")
