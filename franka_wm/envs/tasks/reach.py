# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false, reportCallIssue=false
# (Kernels are Warp's language: pyright knows neither its arrays nor its vectors.)
"""Reach: bring the tool to a goal that stands still."""

# Warp reads annotations as types: no `from __future__ import annotations` here.
from typing import TYPE_CHECKING

import torch
import warp as wp
from tensordict import TensorDictBase

from franka_wm.envs.kernels import JOINTS, away_from_solids, chain_forward, episode_rng
from franka_wm.envs.tasks.base import Task, with_goal
from franka_wm.errors import UserError

if TYPE_CHECKING:
    from franka_wm.envs.config import FrankaConfig
    from franka_wm.envs.simulation import Simulation

CLEAR = 0.05
"""Drawn goals are farther from obstacles [m]: there the hand has no room."""
REWARDS = {"dense": 0, "sparse": 1, "normalized": 2}


def goal_distance(state: torch.Tensor) -> torch.Tensor:
    """Distance from tool to goal [m]: (..., 20) → (...,)."""
    return state[..., 17:20].norm(dim=-1)


def reach_reward(
    state: torch.Tensor,
    action: torch.Tensor,
    *,
    kind: str = "dense",
    action_penalty: float = 0.01,
    success_distance: float = 0.05,
    initial_distance: torch.Tensor | None = None,
) -> torch.Tensor:
    """Reward of being in ``state`` after ``action``: (..., 20), (..., A) → (..., 1).

    ``dense``: −tanh(distance), bounded, so that a categorical value head needs no tuning. ``sparse``: 1 within
    ``success_distance``, else 0. ``normalized``: the part of ``initial_distance`` (..., 1) [m] that has been
    closed, at least −1. All minus action_penalty · mean(action²), of the action as it is applied: clipped.

    The same stands in the kernel :func:`reach_reward_and_success`. ``tests/envs/test_tasks.py`` holds both equal.
    """
    distance = goal_distance(state).unsqueeze(-1)
    effort = action.clamp(-1.0, 1.0).square().mean(-1, keepdim=True)
    if kind == "sparse":
        value = (distance < success_distance).float()
    elif kind == "normalized":
        if initial_distance is None:
            raise ValueError("kind='normalized' needs initial_distance")
        value = (1.0 - distance / initial_distance.clamp_min(success_distance)).clamp_min(-1.0)
    else:
        value = -torch.tanh(distance)
    return value - action_penalty * effort


@wp.kernel(enable_backward=False)
def fixed_goal(
    mask: wp.array[wp.bool],
    fixed: wp.array[float],
    pose: wp.array[float],
    goal_q: wp.array2d[float],
    goal: wp.array2d[float],
):
    world = wp.tid()
    if mask[world]:
        for i in range(3):
            goal[world, i] = fixed[i]
        for j in range(JOINTS):
            goal_q[world, j] = pose[j]


@wp.kernel(enable_backward=False)
def reachable_goal(
    mask: wp.array[wp.bool],
    seed: wp.array[int],
    episode: wp.array[int],
    home: wp.array[float],
    noise: float,
    lower: wp.array[float],
    upper: wp.array[float],
    parent_frames: wp.array[wp.transformf],
    child_frames: wp.array[wp.transformf],
    axes: wp.array[wp.vec3f],
    tool_frame: wp.array[wp.transformf],
    lowest: float,
    raised: wp.array[float],
    solids: wp.array2d[float],
    clear: float,
    goal_q: wp.array2d[float],
    goal: wp.array2d[float],
):
    """The tool position of a random pose around home; in the ground, the base or an obstacle it is drawn again."""
    world = wp.tid()
    if not mask[world]:
        return
    rng = episode_rng(seed[0], seed[1] + world, episode[world], 1)
    found = bool(False)
    for _attempt in range(32):
        if not found:
            for j in range(JOINTS):
                goal_q[world, j] = wp.clamp(home[j] + wp.randf(rng, -noise, noise), lower[j], upper[j])
            tool = chain_forward(goal_q, world, parent_frames, child_frames, axes, tool_frame)
            free = away_from_solids(tool, raised[world], solids) > clear
            if (
                free
                and tool[2] > lowest + raised[world]
                and wp.sqrt(tool[0] * tool[0] + tool[1] * tool[1]) > 0.25
            ):
                for i in range(3):
                    goal[world, i] = tool[i]
                found = True
    if (
        not found
    ):  # one in 10^12 episodes at the default noise without obstacles: the home pose is a goal, too
        for j in range(JOINTS):
            goal_q[world, j] = home[j]
        tool = chain_forward(goal_q, world, parent_frames, child_frames, axes, tool_frame)
        for i in range(3):
            goal[world, i] = tool[i]


@wp.kernel(enable_backward=False)
def note_initial_distance(
    mask: wp.array[wp.bool], state: wp.array2d[float], initial_distance: wp.array[float]
):
    world = wp.tid()
    if mask[world]:
        initial_distance[world] = wp.length(wp.vec3f(state[world, 17], state[world, 18], state[world, 19]))


@wp.kernel(enable_backward=False)
def reach_reward_and_success(
    state: wp.array2d[float],
    action: wp.array2d[float],
    kind: int,
    penalty: float,
    success_distance: float,
    initial_distance: wp.array[float],
    reward: wp.array2d[float],
    success: wp.array2d[wp.bool],
):
    """Reward and success, the same as :func:`reach_reward`. ``kind``: 0 dense, 1 sparse, 2 normalized."""
    world = wp.tid()
    distance = wp.length(wp.vec3f(state[world, 17], state[world, 18], state[world, 19]))
    effort = float(0.0)
    for j in range(action.shape[1]):
        a = wp.clamp(action[world, j], -1.0, 1.0)
        if wp.isfinite(action[world, j]):
            effort += a * a
    solved = distance < success_distance
    value = -wp.tanh(distance)
    if kind == 1:
        value = wp.where(solved, 1.0, 0.0)
    if kind == 2:
        value = wp.max(1.0 - distance / wp.max(initial_distance[world], success_distance), -1.0)
    reward[world, 0] = value - penalty * effort / float(action.shape[1])
    success[world, 0] = solved


class Reach(Task):
    """Bring the tool to the goal and keep it there.

    **Goal**: ``config.goal``, or with ``goal_sampling="reachable"`` the tool position of a pose drawn
    uniformly within ``goal_noise`` of home, at least 0.10 m above the ground, or the table where there is one, 0.25 m
    from the base's axis and 5 cm from obstacles (``Scene.solids``), or, where 32 poses are not, at home; new in every
    world and episode. **Reward**: :func:`reach_reward`.
    **Success**: tool within ``success_distance``.
    """

    words = "Move the tool to the goal position and hold it there."

    def __init__(self, config: "FrankaConfig"):
        super().__init__(config)
        self._fixed: tuple[wp.array, wp.array] | None = None

    @classmethod
    def check(cls, config: "FrankaConfig") -> None:
        if config.goal_sampling == "reachable" and config.goal != type(config).goal:
            raise UserError(
                f"goal={config.goal}: with goal_sampling={config.goal_sampling} each episode draws another; leave it "
                "out, or give goal_sampling=fixed"
            )
        if config.fixed_goal and config.goal_noise != type(config).goal_noise:
            raise UserError(
                f"goal_noise={config.goal_noise}: is for goals that are drawn; leave it out, or give "
                "goal_sampling=reachable"
            )

    @property
    def _judges(self) -> bool:
        """Whether no subclass pays and judges otherwise."""
        return type(self).reward_and_success is Reach.reward_and_success

    @property
    def reward_bounds(self) -> tuple[float, float] | None:
        """Bounds of :func:`reach_reward`; ``None`` where a subclass pays otherwise."""
        if not self._judges:
            return None
        least, largest = {"dense": (-1.0, 0.0), "sparse": (0.0, 1.0), "normalized": (-1.0, 1.0)}[
            self.config.reward
        ]
        return least - self.config.action_penalty, largest

    @property
    def goal_distance(self) -> bool:
        """Not where a subclass has another success."""
        return self._judges

    @property
    def success_distance(self) -> float | None:
        """The config's; ``None`` where a subclass has another success."""
        return self.config.success_distance if self._judges else None

    @property
    def clear(self) -> float:
        """How far a drawn goal is from obstacles, at least [m]."""
        return CLEAR

    def reset(self, sim: "Simulation", mask: wp.array) -> None:
        self.choose(sim, mask, sim.warp.task_goal)

    @property
    def table_top(self) -> float:
        """Height of the table before ``randomization.table_height`` adds to it; 0 without a scene [m]."""
        scene = self.config.resolved_scene
        return 0.0 if scene is None else scene.top

    def choose(self, sim: "Simulation", mask: wp.array, goal: wp.array) -> None:
        """Writes the masked worlds' goals into ``goal`` (N, 3) and poses that reach them into ``goal_q``."""
        w, c, n = sim.warp, sim.chain, sim.num_envs
        if self.config.fixed_goal:
            if self._fixed is None:
                point = torch.tensor(self.config.goal, dtype=torch.float32)
                pose = sim.kinematics.solve(
                    point.to(sim.device),
                    torch.tensor(self.config.start_pose, device=sim.device),
                    iterations=60,
                )
                self._fixed = (
                    wp.array(self.config.goal, dtype=float, device=sim.device),
                    wp.from_torch(pose),
                )
            wp.launch(fixed_goal, n, [mask, *self._fixed, w.goal_q, goal], device=sim.device)
            return
        wp.launch(
            reachable_goal,
            n,
            [
                mask, w.seed, w.episode, c.home, self.config.goal_noise, c.lower, c.upper,
                c.parent_frames, c.child_frames, c.axes, c.tool_frame, 0.10 + self.table_top, w.raised,
                w.solids, self.clear, w.goal_q, goal,
            ],
            device=sim.device,
        )  # fmt: skip

    def pose_at_goal(self, sim: "Simulation", mask: wp.array) -> None:
        """With a gripper: fingers and objects as they are at the start; ``reset`` has written the joints."""

    def relabel(self, transitions: TensorDictBase, goal: torch.Tensor) -> TensorDictBase:
        """What another goal changes in recorded transitions; exact where observations have no noise.

        Args:
            transitions: (B, H) with ``state``, ``action`` (continuous), and in ``next`` ``state`` and ``reward``.
            goal: (B, 3) [m].

        Returns:
            (B, H): ``state``, ``goal`` where there is one, and in ``next`` the same, ``reward`` and ``terminated``.
        """
        c, out = self.config, with_goal(transitions, goal)
        after = out.get(("next", "state"))
        reward = reach_reward(
            after,
            transitions.get("action"),
            kind=c.reward,
            action_penalty=c.action_penalty,
            success_distance=c.success_distance,
        )
        out.set(("next", "reward"), reward)
        reached = goal_distance(after).unsqueeze(-1) < c.success_distance
        out.set(("next", "terminated"), reached & c.terminate_on_success)
        return out

    def present_reward(self, sim: "Simulation", action: torch.Tensor) -> torch.Tensor:
        if not self._judges:
            return super().present_reward(sim, action)
        return reach_reward(
            sim.tensors.true_state,
            action,
            kind=self.config.reward,
            action_penalty=self.config.action_penalty,
            success_distance=self.config.success_distance,
            initial_distance=sim.tensors.initial_distance.unsqueeze(-1),
        )

    def begin(self, sim: "Simulation", mask: wp.array) -> None:
        if self.config.reward == "normalized":
            inputs = [mask, sim.warp.true_state, sim.warp.initial_distance]
            wp.launch(note_initial_distance, sim.num_envs, inputs, device=sim.device)

    def reward_and_success(self, sim: "Simulation") -> None:
        w, c = sim.warp, self.config
        wp.launch(
            reach_reward_and_success,
            sim.num_envs,
            [
                w.next_true_state, w.action, REWARDS[c.reward], c.action_penalty, c.success_distance,
                w.initial_distance, w.reward, w.success,
            ],
            device=sim.device,
        )  # fmt: skip
