# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""What tasks with a gripper share: reading hand and objects in kernels, goals that are places, rewards."""

# Warp reads annotations as types: no `from __future__ import annotations` here.
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
import warp as wp
from tensordict import TensorDictBase

from franka_wm.envs.constants import MOST_OPEN, NUM_FINGERS, NUM_JOINTS, OBJECT_DIM
from franka_wm.envs.kernels.functions import episode_rng
from franka_wm.envs.kernels.goals import nearest_turn
from franka_wm.envs.tasks.base import Task, with_goal
from franka_wm.errors import UserError

if TYPE_CHECKING:
    from franka_wm.envs.config import FrankaConfig
    from franka_wm.envs.scene import Body
    from franka_wm.envs.simulation import Simulation

READY = (0.0, 0.1, 0.0, -2.3, 0.0, 2.4, 0.785)
"""Joint angles with the hand upright, 0.3 m above the middle of the table [rad]."""

EACH = wp.constant(OBJECT_DIM)
GRIP = wp.constant(NUM_JOINTS)
FIRST = wp.constant(NUM_FINGERS)
"""Where the first object begins in ``rest_q``: behind the fingers."""
OPEN = wp.constant(MOST_OPEN)
QUARTER = wp.constant(0.5 * math.pi)


@wp.func
def place_of(objects: wp.array2d[float], world: int, body: int) -> wp.vec3f:
    """Position of an object [m]."""
    at = EACH * body
    return wp.vec3f(objects[world, at], objects[world, at + 1], objects[world, at + 2])


@wp.func
def rotation_of(objects: wp.array2d[float], world: int, body: int) -> wp.quatf:
    """Orientation of an object."""
    at = EACH * body + 3
    return wp.quatf(
        objects[world, at], objects[world, at + 1], objects[world, at + 2], objects[world, at + 3]
    )


@wp.func
def speed_of(objects: wp.array2d[float], world: int, body: int) -> float:
    """Speed of an object [m/s]."""
    at = EACH * body + 7
    return wp.length(wp.vec3f(objects[world, at], objects[world, at + 1], objects[world, at + 2]))


@wp.func
def tool_of(state: wp.array2d[float], world: int) -> wp.vec3f:
    """Position of the tool, between the fingers [m]."""
    return wp.vec3f(state[world, 14], state[world, 15], state[world, 16])


@wp.func
def holds(state: wp.array2d[float], joint_target: wp.array2d[float], at: wp.vec3f, world: int) -> bool:
    """Whether the fingers are stopped by something at ``at``: they were told to close further, and do not."""
    near = wp.length(tool_of(state, world) - at) < 0.025
    pressed = state[world, 20] - joint_target[world, GRIP] > 0.003
    return near and pressed and wp.abs(state[world, 22]) < 0.1


@wp.func
def nearness(distance: float) -> float:
    """1 at no distance [m], 0.24 at 20 cm, 0 far away."""
    return 1.0 - wp.tanh(5.0 * distance)


@wp.func
def fastest_joint(state: wp.array2d[float], world: int) -> float:
    """Largest speed of the arm's joints [rad/s]."""
    speed = float(0.0)
    for j in range(7):
        speed = wp.max(speed, wp.abs(state[world, 7 + j]))
    return speed


@wp.func
def effort(action: wp.array2d[float], world: int) -> float:
    """Mean squared action, as it is applied."""
    total = float(0.0)
    for j in range(action.shape[1]):
        a = wp.clamp(action[world, j], -1.0, 1.0)
        if wp.isfinite(action[world, j]):
            total += a * a
    return total / float(action.shape[1])


@wp.kernel(enable_backward=False)
def goal_from_start(
    mask: wp.array[wp.bool],
    rest_q: wp.array2d[float],
    body: int,
    away: wp.vec3f,
    rises: wp.vec2f,
    sizes: wp.array2d[float],
    seed: wp.array[int],
    episode: wp.array[int],
    spread: float,
    goal: wp.array2d[float],
):
    """A goal where an object stands as the episode begins, moved; see :meth:`GripperTask.launch_goal`."""
    world = wp.tid()
    if mask[world]:
        for i in range(3):
            goal[world, i] = rest_q[world, FIRST + 7 * body + i] + away[i]
        if rises[0] > 0.0:
            goal[world, 2] += rises[0] * sizes[world, 0] + rises[1] * sizes[world, body]
        if spread > 0.0:
            rng = episode_rng(seed[0], seed[1] + world, episode[world], 7)  # as draw_uniform's first number
            goal[world, 0] += spread * (2.0 * wp.randf(rng) - 1.0)


@wp.kernel(enable_backward=False)
def bring_to_goal(
    mask: wp.array[wp.bool],
    goal: wp.array2d[float],
    tool: wp.vec3f,
    widths: wp.vec2f,
    sizes: wp.array2d[float],
    opening: float,
    turned: bool,
    like: int,
    rest: wp.array2d[float],
    hand: wp.array2d[float],
):
    """The first object at the goal, and the hand at it; see :meth:`GripperTask.launch_goal_pose`."""
    world = wp.tid()
    if not mask[world]:
        return
    yaw = 2.0 * wp.atan2(rest[world, FIRST + 5], rest[world, FIRST + 6])
    turn = float(0.0)
    if like >= 0:
        other = 2.0 * wp.atan2(rest[world, FIRST + 7 * like + 5], rest[world, FIRST + 7 * like + 6])
        turn = nearest_turn(other - yaw, QUARTER)
    for i in range(3):
        rest[world, FIRST + i] = goal[world, i]
        hand[world, i] = goal[world, i] + tool[i]
    hand[world, 3] = wp.where(
        turned, nearest_turn(yaw, QUARTER) + turn, 0.0
    )  # grasped as it stood, then turned
    yaw += turn
    rest[world, FIRST + 3] = 0.0
    rest[world, FIRST + 4] = 0.0
    rest[world, FIRST + 5] = wp.sin(0.5 * yaw)
    rest[world, FIRST + 6] = wp.cos(0.5 * yaw)
    across = wp.abs(wp.sin(hand[world, 3] - yaw)) > 0.5  # the fingers stand along the object's x
    wide = wp.where(across, widths[0], widths[1]) * sizes[world, 0]
    for f in range(FIRST):
        rest[world, f] = wp.where(opening < 0.0, wp.min(0.5 * wide, OPEN), opening)


# -- tasks and their experts ----------------------------------------------------------------------------------


class GripperTask(Task):
    """A task with a hand that starts upright over the table; rewards are in [0, 1], minus the action penalty."""

    draws_goals = True
    gripper = True
    home = READY
    rewards = ("dense", "sparse")
    own_options = ()
    least_objects = 1
    """How many objects the scene must have."""
    grasps = True
    """Whether the first of them must fit between the fingers."""

    @classmethod
    def check(cls, config: "FrankaConfig") -> None:
        super().check(config)
        if config.num_objects < cls.least_objects:
            raise UserError(
                f"scene: task={config.task} is about {cls.least_objects} objects, the scene has "
                f"{config.num_objects}; add to scene.objects"
            )
        if cls.grasps and cls.least_objects and config.resolved_scene is not None:
            first, most = config.resolved_scene.objects[0], 1 + config.randomization.object_size
            # A mesh has its width from the box around it, and may be grasped where it is thinner.
            if first.shape != "mesh" and most * min(first.widths) >= 2 * MOST_OPEN:
                raise UserError(
                    f"scene.{first.name}: {most * min(first.widths):g} m wide; task={config.task} grasps it, and the "
                    f"fingers open {2 * MOST_OPEN:g} m: make it narrower (size)"
                )

    @property
    def reward_bounds(self) -> tuple[float, float]:
        return -self.config.action_penalty, 1.0

    @property
    def objects(self) -> "tuple[Body, ...]":
        """The scene's."""
        assert self.config.resolved_scene is not None
        return self.config.resolved_scene.objects

    def launch_goal(
        self,
        sim: "Simulation",
        mask: wp.array,
        *,
        body: int = 0,
        away: tuple[float, float, float] = (0.0, 0.0, 0.0),
        onto: bool = False,
        spread: float = 0.0,
    ) -> None:
        """For ``reset``: the goal is where an object stands as the episode begins, moved.

        Args:
            sim, mask: As given.
            body: Number of the object.
            away: From its centre [m].
            onto: Whether the first object is to lie on that one: up by half of both heights, as they are drawn.
            spread: Half-width of the uniform draw of how much farther along x, in each episode [m].
        """
        w, halves = sim.warp, [self.objects[k].half_height if onto else 0.0 for k in (0, body)]
        inputs = [mask, w.rest_q, body, wp.vec3f(*away), wp.vec2f(*halves), w.sizes]
        inputs += [w.seed, w.episode, spread, w.task_goal]
        wp.launch(goal_from_start, sim.num_envs, inputs, device=sim.device)

    def launch_reward(self, sim: "Simulation", kernel: wp.Kernel, *further: object) -> None:
        """Launches a kernel that takes state, joint target and objects after the step, goal, action, whether the reward
        is sparse, the action penalty, ``further``, and writes reward and success; one thread for each world."""
        w, c = sim.warp, self.config
        inputs = [
            w.next_true_state,
            w.next_joint_target,
            w.next_true_objects,
            w.task_goal,
            w.action,
            c.reward == "sparse",
        ]
        inputs += [c.action_penalty, *further, w.reward, w.success]
        wp.launch(kernel, sim.num_envs, inputs, device=sim.device)

    def launch_goal_pose(
        self,
        sim: "Simulation",
        mask: wp.array,
        *,
        tool: tuple[float, float, float] = (0.0, 0.0, 0.0),
        opening: float | None = None,
        turned: bool = True,
        like: int | None = None,
    ) -> None:
        """For :attr:`pose_at_goal`: the first object at the goal, upright, in the hand, which points down.

        Args:
            sim, mask: As given.
            tool: Where the tool is, from the object's centre [m].
            opening: Opening of each finger [m]; the object's width if not given.
            turned: Whether the hand is turned as the object is.
            like: Number of the object that it is turned like, up to quarter turns; as at the start if not given.
        """
        w, scene = sim.warp, self.config.resolved_scene
        assert scene is not None
        widths, wide = wp.vec2f(*scene.objects[0].widths), -1.0 if opening is None else opening
        inputs = [
            mask,
            w.task_goal,
            wp.vec3f(*tool),
            widths,
            w.sizes,
            wide,
            turned,
            -1 if like is None else like,
        ]
        wp.launch(bring_to_goal, sim.num_envs, [*inputs, w.goal_rest, w.goal_hand], device=sim.device)
        assert sim.bodies is not None
        sim.bodies.launch_upright(mask)


RewardInTorch = Callable[
    [torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor]
]
"""State (…, 28), joint target (…, 8), objects (…, 13 · K + …), goal (…, 3) -> (…,) dense reward before the penalty of
the action, and (…,) bool success."""


def first_of_episode(transitions: TensorDictBase) -> torch.Tensor:
    """State (B, S) of the first step of each window's episode, of (B, H): steps of another may stand in front.

    With these there is `is_init`, see `Dreamer.burn_in`.
    """
    state, begun = transitions.get("state"), transitions.get("is_init", None)
    if begun is None:
        return state[:, 0]
    windows, steps = (torch.arange(size, device=state.device) for size in state.shape[:2])
    return state[windows, (begun.squeeze(-1) * steps).amax(1)]


def relabel_place(
    task: GripperTask, reward_and_success: RewardInTorch, transitions: TensorDictBase, goal: torch.Tensor
) -> TensorDictBase:
    """As :meth:`Reach.relabel`, where the goal is a place for the first object; exact without noise.

    Args:
        task: Its config says the reward.
        reward_and_success: The task's reward and success in torch.
        transitions: (B, H) with ``state``, ``action``, and in ``next`` ``state``, ``joint_target``, ``objects``.
        goal: (B, 3) [m].
    """
    c, out = task.config, with_goal(transitions, goal)
    following = [transitions.get(("next", key)) for key in ("joint_target", "objects")]
    wide = goal.unsqueeze(1).expand(*transitions.batch_size, 3)
    value, solved = reward_and_success(out.get(("next", "state")), *following, wide)
    applied = transitions.get("action").nan_to_num(0.0).clamp(-1.0, 1.0)
    value = solved.float() if c.reward == "sparse" else value
    out.set(("next", "reward"), (value - c.action_penalty * applied.square().mean(-1)).unsqueeze(-1))
    out.set(("next", "terminated"), solved.unsqueeze(-1) & c.terminate_on_success)
    return out


def near_in_torch(distance: torch.Tensor) -> torch.Tensor:
    """:func:`nearness` of distances [m]."""
    return 1.0 - torch.tanh(5.0 * distance)


def held_in_torch(state: torch.Tensor, joint_target: torch.Tensor, at: torch.Tensor) -> torch.Tensor:
    """:func:`holds`: (…, 28), (…, 8), (…, 3) -> (…,) bool."""
    near = (state[..., 14:17] - at).norm(dim=-1) < 0.025
    pressed = state[..., 20] - joint_target[..., NUM_JOINTS] > 0.003
    return near & pressed & (state[..., 22].abs() < 0.1)
