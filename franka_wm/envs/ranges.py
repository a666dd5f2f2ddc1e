"""What each episode of each world draws anew, as ranges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

from franka_wm.errors import UserError
from franka_wm.options import check_whole, is_real


@dataclass(frozen=True, kw_only=True)
class Randomization:
    """What each episode of each world draws anew; all off by default. Reproducible from seed × world × episode.

    A factor of ``x`` means a uniform draw from [1 − x, 1 + x]; an offset of ``x`` one from [−x, x].

    Attributes:
        color: Offset of the red, green and blue of every shape but the ground, which all worlds share.
        brightness: Factor of the whole image.
        camera_position: Offset of the front camera's eye [m] in x, y and z; the side camera moves alike.
        camera_target: Offset of the point it looks at [m].
        gains: Factor of the servo's stiffness and damping, one each; ``limit_velocity`` does not know of it.
        armature: Factor of the joints' armature.
        friction: Largest dry friction of a joint [N·m]; drawn from [0, friction].
        mass: Factor of every link's and object's mass and inertia.
        object_size: Factor of each object's size; its mass goes with the cube, its inertia with the fifth power.
        table_height: Offset of the table's height [m]; all that stands on it stands with it, the arm does not.
        contact_friction: Factor of the sliding friction of each shape that is touched: objects, table, fingers.
        grip_force: Factor of the fingers' stiffness and largest force.
        action_noise: Standard deviation of noise added to actions, in every step.
        action_latency: Largest delay of actions [control steps]; drawn from 0 … action_latency.
        observation_noise: Standard deviation of noise on observed joint angles [rad] and, times 10, velocities
            [rad/s], in every step. Tool, goal and rewards stay true.
        object_noise: Standard deviation of noise on the observed positions of objects and handles [m], in every step.
            Rewards stay true.
    """

    color: float = 0.0
    brightness: float = 0.0
    camera_position: float = 0.0
    camera_target: float = 0.0
    gains: float = 0.0
    armature: float = 0.0
    friction: float = 0.0
    mass: float = 0.0
    object_size: float = 0.0
    table_height: float = 0.0
    contact_friction: float = 0.0
    grip_force: float = 0.0
    action_noise: float = 0.0
    action_latency: int = 0
    observation_noise: float = 0.0
    object_noise: float = 0.0

    def __post_init__(self) -> None:
        limits = {
            "color": 1.0,
            "brightness": 0.99,
            "object_noise": 1.0,
            "object_size": 0.5,
            "table_height": 0.1,
        }
        limits |= dict.fromkeys(("gains", "armature", "mass", "contact_friction", "grip_force"), 0.9)
        for f in fields(self):
            value, limit = getattr(self, f.name), limits.get(f.name, 100.0)
            if not is_real(value) or not 0 <= value <= limit:
                raise UserError(f"randomization.{f.name}={value!r}: must be from 0 to {limit:g}")
        check_whole("randomization.action_latency", self.action_latency, least=0, unit="steps")

    def any(self) -> bool:
        """Whether anything is drawn at all."""
        return any(getattr(self, f.name) for f in fields(self))

    @property
    def dynamics(self) -> bool:
        """Whether anything of the physical model is drawn."""
        return bool(
            self.gains or self.armature or self.friction or self.mass or self.grip_force or self.object_size
        )

    @property
    def inertial(self) -> bool:
        """Whether masses are drawn."""
        return bool(self.mass or self.object_size)

    @classmethod
    def from_mapping(cls, values: Mapping) -> Randomization:
        """From a mapping; an unknown name is an error that lists the known ones."""
        known = {f.name for f in fields(cls)}
        for name in values:
            if name not in known:
                raise UserError(f"unknown randomization {name!r}; known: {', '.join(sorted(known))}")
        return cls(**dict(values))
