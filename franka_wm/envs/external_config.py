"""Which environment of another library is meant; read before TorchRL is imported."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from franka_wm.errors import UserError
from franka_wm.options import check_whole


@dataclass(frozen=True, kw_only=True)
class ExternalConfig:
    """An environment that is not the arm.

    Attributes:
        kind: ``gym`` or ``dm_control``.
        name: Name of Gymnasium's environment, or the suite's domain.
        task: Task of the suite's domain; not for Gymnasium.
        episode_length: Steps after which an episode is truncated, action repeats counted once.
        frame_skip: Simulator steps for each action; rewards are summed.
        observations: Key that models read → the wrapper's keys, concatenated in this order. Empty: every vector, in
            the wrapper's order, as ``state``.
    """

    kind: str
    name: str
    task: str | None = None
    episode_length: int = 500
    frame_skip: int = 1
    observations: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.kind not in ("gym", "dm_control"):
            raise UserError(f"env.kind={self.kind!r}: must be franka, gym or dm_control")
        if self.kind == "gym" and self.task is not None:
            raise UserError(f"env.task={self.task}: Gymnasium's environments have one; leave it out")
        for name in ("episode_length", "frame_skip"):
            check_whole(f"env.{name}", getattr(self, name))

    @property
    def label(self) -> str:
        """Its name; of the suite the domain and its task."""
        return self.name if self.task is None else f"{self.name} {self.task}"


OTHERS = ("action", "reward", "done", "terminated", "truncated", "next", "is_init", "success")
"""What else a step holds."""


def external_config(values: Mapping[str, Any]) -> ExternalConfig:
    """From a plain mapping.

    Raises:
        UserError: A key that does not exist.
    """
    known = set(ExternalConfig.__dataclass_fields__)
    unknown = sorted(set(values) - known)
    if unknown:
        raise UserError(f"env.{unknown[0]}: no such field; choose from {', '.join(sorted(known))}")
    given: dict[str, Any] = dict(values)
    observations = given.get("observations") or {}
    if not isinstance(observations, Mapping) or not all(
        keys and isinstance(keys, str | Sequence) for keys in observations.values()
    ):
        raise UserError(
            f"env.observations={observations!r}: must be keys with lists of the environment's own, "
            "as in {state: [position, velocity]}"
        )
    for key in observations:
        if not str(key).isidentifier() or key in OTHERS:
            raise UserError(
                f"env.observations: an observation cannot be called {key!r}; take letters, digits and _, and none of "
                f"{', '.join(OTHERS)}"
            )
    if not {"kind", "name"} <= given.keys():
        raise UserError("env.kind and env.name: both are needed, as in env=gym env.name=Pendulum-v1")
    given["observations"] = dict(observations)
    return ExternalConfig(**given)
