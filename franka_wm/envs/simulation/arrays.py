# pyright: reportArgumentType=false
# (Newton's annotations do not say what a built model always has.)
"""Everything that a step reads and writes, by name: fixed memory that torch and Warp share."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import newton
import torch
import warp as wp

from franka_wm.envs.camera import camera_framing, look_at
from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.constants import NUM_JOINTS

STATISTICS = ("episodes", "return", "length", "success", "success_once", "nonfinite", "overflow")
"""Columns of :attr:`Arrays.statistics`: counts of episodes, of broken worlds, of steps that lost contacts; else sums
over finished episodes."""


@dataclass(frozen=True)
class Arrays[T]:
    """The arrays of N worlds, one row for each: as torch tensors or as Warp arrays, over the same memory.

    The next launch overwrites them, so clone what is kept. The S = 20 numbers of a state are joints 7 [rad], velocities
    7 [rad/s], tool 3 [m], tool − goal 3 [m]; with a gripper S = 28: fingers 2 [m], their speeds 2 [m/s], and the tool's
    quaternion x y z w follow. The 13 of each of K objects are position 3 [m], quaternion x y z w, velocity 3 [m/s],
    angular velocity 3 [rad/s], in the world's frame. Behind them are 13 of the handle of each of M articulated bodies,
    and behind these 2 of each joint: how far it is open [m or rad], and its speed.

    Attributes:
        action: (N, A), written before a step; not clipped.
        applied: (N, A) what of it arrives at the arm: late and noisy, if asked for.
        state, joint_target, goal: The present observation, (N, S), (N, 7) [rad] with the fingers' set point [m]
            behind it where there is a gripper, (N, 3) [m].
        objects: (N, 13 · (K + M) + 2 · M) the same of the objects and articulated bodies.
        contacts: (N, 2) force of what each finger touches [N], along the contacts' normals; (N, 0) if not asked for.
        next_state, next_joint_target, next_goal, next_objects, next_contacts: What the last step led to, before any
            reset.
        true_state, next_true_state: (N, S) without observation noise; the same memory where there is none.
        true_objects, next_true_objects: The same of ``objects``.
        reward, success: Reward and success of the last step, (N, 1) float and bool: what a task writes.
        terminated, truncated, done: Whether the last step ended the episode, (N, 1) bool.
        step_count: (N, 1) int32, steps done in the episode.
        episode_return, episode_success: Sum of rewards, and any success, of the episode so far, (N, 1).
        ended: (N,) bool: the episode is over, and the next one has not begun.
        statistics: (N, 7) float64, see :data:`STATISTICS`.
        task_goal: (N, 3) the goal of the episode [m], which ``goal`` and ``state`` observe.
        goal_q: (N, 7) joints that reach it [rad].
        goal_rest: As ``rest_q``, in images of the goal; (N, 0) without these or without a gripper.
        goal_hand: (N, 4) where the hand is in them, pointing down: the tool [m] and its yaw [rad]; scratch memory.
        goal_center, phase: (N, 3) [m] and (N,) [rad], of the circle that a moving goal follows.
        draws: (N, D) uniform in [0, 1), new in each episode: random numbers for the task.
        initial_distance: (N,) tool to goal at the start of the episode [m], or what else a task notes there.
        target: (N, 7) what the servo was told last [rad].
        history: (N, latency + 1, A), actions not yet applied; a ring.
        delay: (N,) int32, delay of this episode's actions [steps].
        brightness: (N,) factor of this episode's images.
        poses: (N,) transforms, (N, 7) in torch: the front camera of this episode.
        broken: (N,) bool: the last step was no longer finite.
        overflow: (N,) int32, MuJoCo's bits of the last step: contacts were lost for want of room.
        cut: (N,) bool: the last step ended the episode before its time: lost contacts, or a lost object.
        seed: (2,) int32: the seed and the number of the first world; with ``episode`` they decide all randomness.
        episode: (N,) int32, number of the episode, from 0.
        reset_mask: (N + 1,) bool: which worlds begin their next episode; the last entry is Newton's global world.
        mask: (N,) bool: the worlds' part of it.
        joint_q, joint_qd, control: (N, 7) Newton's joints [rad], [rad/s] and set points [rad].
        rest_q, rest_qd, rest_control: What Newton's arrays have behind the arm's joints: two fingers [m], then of each
            object x y z and the quaternion x y z w, and linear and angular velocity; then one number of each
            articulated body, [m] or [rad].
        bases: (N, M) transforms, (N, M, 7) in torch: where the cases of the M articulated bodies stand; part of
            Newton's frames of joints.
        grip: (N,) the fingers' set point [m].
        sizes: (N, K) factor of each object's size in this episode.
        raised: (N,) how much higher the table is in this episode than the scene says [m].
        solids: (S, 8) boxes around obstacles, see ``Scene.solids``.
        body_q: (N, B) transforms, (N, B, 7) in torch: Newton's frames of the moving links.
        origins, directions: (N, 7) vectors, (N, 7, 3) in torch: scratch memory of the differential inverse kinematics.
    """

    action: T
    applied: T
    state: T
    joint_target: T
    goal: T
    objects: T
    contacts: T
    next_state: T
    next_joint_target: T
    next_goal: T
    next_objects: T
    next_contacts: T
    true_state: T
    next_true_state: T
    true_objects: T
    next_true_objects: T
    reward: T
    success: T
    terminated: T
    truncated: T
    done: T
    step_count: T
    episode_return: T
    episode_success: T
    ended: T
    statistics: T
    task_goal: T
    goal_q: T
    goal_rest: T
    goal_hand: T
    goal_center: T
    phase: T
    draws: T
    initial_distance: T
    target: T
    history: T
    delay: T
    brightness: T
    poses: T
    broken: T
    overflow: T
    cut: T
    seed: T
    episode: T
    reset_mask: T
    mask: T
    joint_q: T
    joint_qd: T
    control: T
    rest_q: T
    rest_qd: T
    rest_control: T
    bases: T
    grip: T
    sizes: T
    raised: T
    solids: T
    body_q: T
    origins: T
    directions: T

    def __iter__(self):
        return (getattr(self, field.name) for field in fields(self))


def allocate(
    config: FrankaConfig,
    model: newton.Model,
    state: newton.State,
    control: newton.Control,
    *,
    seed: int,
    first_world: int,
    draws: int,
) -> tuple[Arrays[torch.Tensor], Arrays[wp.array]]:
    """The arrays of all worlds in torch and in Warp; those of Newton's state and control are views of these."""
    n, device = model.world_count, str(wp.device_to_torch(model.device))
    actions, slots = config.action_dim, config.randomization.action_latency + 1

    def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.zeros(shape, dtype=dtype, device=device)

    def flags(*shape: int) -> torch.Tensor:
        return zeros(*shape, dtype=torch.bool)

    def newtons(array: wp.array, *size: int) -> torch.Tensor:
        return wp.to_torch(array).view(n, -1, *size)

    q, qd, control_q = (newtons(a) for a in (state.joint_q, state.joint_qd, control.joint_target_q))
    frames = newtons(model.joint_X_p, 7)
    arm, size = NUM_JOINTS, config.state_dim
    observed, next_observed = zeros(n, size), zeros(n, size)
    seen, next_seen = zeros(n, config.object_dim), zeros(n, config.object_dim)
    shows_goal = config.has_gripper and "goal_pixels" in config.images
    noisy = bool(config.randomization.observation_noise)
    framing = torch.tensor(list(look_at(*camera_framing(config))), device=device)
    reset_mask, scene = flags(n + 1), config.resolved_scene
    tensors = Arrays(
        action=zeros(n, actions),
        applied=zeros(n, actions),
        state=observed,
        joint_target=zeros(n, config.target_dim),
        goal=zeros(n, 3),
        objects=seen,
        contacts=zeros(n, config.contact_dim),
        next_state=next_observed,
        next_joint_target=zeros(n, config.target_dim),
        next_goal=zeros(n, 3),
        next_objects=next_seen,
        next_contacts=zeros(n, config.contact_dim),
        # Without noise what is seen is what is true: the same memory, and no launch between them.
        true_state=zeros(n, size) if noisy else observed,
        next_true_state=zeros(n, size) if noisy else next_observed,
        true_objects=zeros(n, config.object_dim) if config.randomization.object_noise else seen,
        next_true_objects=zeros(n, config.object_dim) if config.randomization.object_noise else next_seen,
        reward=zeros(n, 1),
        success=flags(n, 1),
        terminated=flags(n, 1),
        truncated=flags(n, 1),
        done=flags(n, 1),
        step_count=zeros(n, 1, dtype=torch.int32),
        episode_return=zeros(n, 1),
        episode_success=flags(n, 1),
        ended=flags(n),
        statistics=zeros(n, len(STATISTICS), dtype=torch.float64),
        task_goal=zeros(n, 3),
        goal_q=zeros(n, NUM_JOINTS),
        goal_rest=zeros(n, q.shape[1] - arm if shows_goal else 0),
        goal_hand=zeros(n, 4 if shows_goal else 0),
        goal_center=zeros(n, 3),
        phase=zeros(n),
        draws=zeros(n, draws),
        initial_distance=torch.ones(n, device=device),
        target=zeros(n, NUM_JOINTS),
        history=zeros(n, slots, actions),
        delay=zeros(n, dtype=torch.int32),
        brightness=torch.ones(n, device=device),
        poses=framing.repeat(n, 1),
        broken=flags(n),
        overflow=zeros(n, dtype=torch.int32),
        cut=flags(n),
        seed=torch.tensor([as_int32(seed), first_world], dtype=torch.int32, device=device),
        episode=torch.full((n,), -1, dtype=torch.int32, device=device),
        reset_mask=reset_mask,
        mask=reset_mask[:n],
        joint_q=q[:, :arm],
        joint_qd=qd[:, :arm],
        control=control_q[:, :arm],
        rest_q=q[:, arm:],
        rest_qd=qd[:, arm:],
        rest_control=control_q[:, arm:],
        bases=frames[
            :, frames.shape[1] - 2 * config.num_articulated :: 2
        ],  # each is fixed, and carries one joint
        grip=zeros(n),
        sizes=torch.ones(n, config.num_objects, device=device),
        raised=zeros(n),
        solids=torch.tensor(scene.solids if scene else [], device=device).reshape(-1, 8),
        body_q=newtons(state.body_q, 7),
        origins=zeros(n, NUM_JOINTS, 3),
        directions=zeros(n, NUM_JOINTS, 3),
    )
    warp = Arrays(*map(wp.from_torch, tensors))
    return tensors, replace(
        warp,
        **{
            name: wp.from_torch(getattr(tensors, name), wp.transformf)
            for name in ("poses", "body_q", "bases")
        },
        **{name: wp.from_torch(getattr(tensors, name), wp.vec3f) for name in ("origins", "directions")},
    )


def as_int32(seed: int) -> int:
    """Any Python integer as the 32-bit one that Warp's generator takes."""
    seed &= 0xFFFFFFFF
    return seed - (1 << 32) if seed >= 1 << 31 else seed
