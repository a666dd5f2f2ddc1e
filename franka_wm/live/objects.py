"""Free objects of the live world that are moved by hand, and where things touch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch

from franka_wm.envs.constants import NUM_FINGERS
from franka_wm.errors import UserError

if TYPE_CHECKING:
    from tensordict import TensorDict

    from franka_wm.envs import FrankaEnv
    from franka_wm.envs.scene import Body

HIGHEST = 1.0
"""How far above the table an object may be put [m]: above the arm's reach."""
DEEPEST = 0.5
"""How far below its top a hand may point, which puts the object onto it [m]."""


def free_objects(arm: FrankaEnv) -> tuple[str, ...]:
    """Names of what can be moved, in the order of the observation."""
    scene = arm.config.resolved_scene
    return tuple(one.name for one in scene.objects) if scene else ()


def rows(arm: FrankaEnv) -> dict[str, int]:
    """Name → row of the body poses."""
    return {name: arm.model.body_label.index(name) for name in free_objects(arm)}


def room(arm: FrankaEnv) -> tuple[tuple[float, float], ...]:
    """(least, most) of x, y and z of where an object may be put [m]."""
    scene = arm.config.resolved_scene
    assert scene is not None  # there is an object
    (x, y, top), (length, width, _) = scene.table.at, scene.table.size
    sides = ((x - length / 2, x + length / 2), (y - width / 2, y + width / 2))
    return (*sides, (top - DEEPEST, top + HIGHEST))


def point_over_table(arm: FrankaEnv, name: str, point: Sequence[float]) -> list[float]:
    """Where an object may be put, as floats.

    Raises:
        UserError: There is no such object, or the point is not over the table.
    """
    if name not in (names := free_objects(arm)):
        raise UserError(
            f"object {name!r}: choose from {', '.join(names) or 'none; this task has no objects'}"
        )
    found = [float(x) for x in point]
    bounds = room(arm)
    if len(found) != 3 or not all(a <= x <= b for x, (a, b) in zip(found, bounds, strict=True)):  # NaN is not
        ranges = ", ".join(f"{axis} {a:g} to {b:g}" for axis, (a, b) in zip("xyz", bounds, strict=True))
        raise UserError(f"object {name} to {tuple(found)}: must be three numbers over the table, {ranges} m")
    return found


def move_object(arm: FrankaEnv, name: str, point: Sequence[float]) -> TensorDict:
    """Put a free object to a point, at rest and turned as it is; nothing else changes.

    Args:
        arm: One world.
        name: Name of the object.
        point: Place of its centre (x, y, z) [m]; where it would sink into the table, it is put onto it.

    Returns:
        What the world observes now, as a reset does.

    Raises:
        UserError: There is no such object, or the point is not over the table.
    """
    x, y, z = point_over_table(arm, name, point)
    scene = arm.config.resolved_scene
    assert scene is not None
    number, state = scene.body(name), arm.get_state()
    at, speed = NUM_FINGERS + 7 * number, NUM_FINGERS + 6 * number
    place, row = state["rest_q"][0, at : at + 7], rows(arm)[name]
    size = float(arm.simulation.tensors.sizes[0, number])
    top = scene.top + float(arm.simulation.tensors.raised[0])
    lowest = top + size * _hanging(scene.objects[number], place[3:].tolist())
    place[:3] = torch.tensor([x, y, max(z, lowest)], device=place.device)
    state["rest_qd"][0, speed : speed + 6] = 0.0
    state["body_q"][0, row], state["body_qd"][0, row] = place, 0.0
    return arm.set_state(state)


def _hanging(body: Body, quaternion: Sequence[float]) -> float:
    """How far a turned object reaches below its centre, at most [m]: the box around it."""
    x, y, z, w = quaternion
    down = (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))  # world's z in its own frame
    return math.fsum(
        abs(d) * half for d, half in zip(down, (*(w / 2 for w in body.widths), body.half_height), strict=True)
    )


def touching(arm: FrankaEnv) -> np.ndarray:
    """Contacts of the last substep of one world: (C, 7): point [m], normal, force along it [N].

    The normal points out of the first of the two into the second. It waits for the device.
    """
    data = arm.simulation.solver.mjw_data  # pyright: ignore[reportAttributeAccessIssue]
    contact = data.contact
    count = min(int(data.nacon.numpy()[0]), data.naconmax)
    force, first = data.efc.force.numpy()[0], contact.efc_address.numpy()[:count, 0]
    rows = np.clip(first, 0, len(force) - 1)  # of elliptic cones the first row is the normal's; −1: none
    forces = np.where((first >= 0) & (first < len(force)), force[rows], 0.0)
    points, normals = contact.pos.numpy()[:count], contact.frame.numpy()[:count, 0]
    return np.concatenate([points, normals, forces[:, None]], 1)
