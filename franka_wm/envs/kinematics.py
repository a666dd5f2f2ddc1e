# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
# pyright: reportCallIssue=false, reportReturnType=false, reportIndexIssue=false
# (Warp's and TorchRL's annotations know neither vectors nor shapes as tuples.)
"""Forward kinematics, Jacobian and inverse kinematics of the arm, in torch, for any batch.

Newton has its own inverse kinematics; this one needs no second Newton model, works on any device and leading
dimensions without a host sync, and is differentiable, so that policies and planners can call it inside a step.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from franka_wm.envs.constants import HOME
from franka_wm.envs.robots import Robot


def _matrix(frame: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    rotation = np.array(wp.quat_to_matrix(wp.quatf(*frame[3:].tolist())), dtype=np.float32).reshape(3, 3)
    return torch.from_numpy(rotation), torch.from_numpy(np.ascontiguousarray(frame[:3]))


class Kinematics:
    """The arm's geometry as tensors.

    Args:
        robot: Frames, axes and limits.
        device: Where the tensors live.
    """

    def __init__(self, robot: Robot, device: torch.device | str = "cpu"):
        def stack(frames: Sequence[np.ndarray]) -> tuple[torch.Tensor, torch.Tensor]:
            pairs = [_matrix(f) for f in frames]
            return (
                torch.stack([r for r, _ in pairs]).to(device),
                torch.stack([p for _, p in pairs]).to(device),
            )

        self._parent = stack(list(robot.parent_frames))
        child_r, child_p = stack(list(robot.child_frames))
        self._child_inverse = (child_r.mT.contiguous(), -(child_r.mT @ child_p.unsqueeze(-1)).squeeze(-1))
        turned, tool = stack([robot.tool_frame])
        self._tool, self._tool_turned = tool[0], turned[0]
        self.lower = torch.from_numpy(robot.lower).to(device)
        self.upper = torch.from_numpy(robot.upper).to(device)
        axes = torch.from_numpy(robot.axes).to(device)
        zero = torch.zeros_like(axes[:, 0])
        x, y, z = axes.unbind(-1)
        self._axes = axes
        self._cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).view(-1, 3, 3)
        self._eye = torch.eye(3, device=device)

    def _chain(
        self, q: torch.Tensor
    ) -> tuple[torch.Tensor, list[torch.Tensor], list[torch.Tensor], torch.Tensor]:
        """Tool (..., 3), origins and directions of the joints, rotation of the tool's link (..., 3, 3)."""
        rotation = self._eye.expand(*q.shape[:-1], 3, 3)
        position = torch.zeros(*q.shape[:-1], 3, device=q.device, dtype=q.dtype)
        origins, directions = [], []
        for j in range(q.shape[-1]):
            position = position + rotation @ self._parent[1][j]
            rotation = rotation @ self._parent[0][j]
            origins.append(position)
            directions.append(rotation @ self._axes[j])
            angle = q[..., j, None, None]
            k = self._cross[j]
            rotation = rotation @ (
                self._eye + torch.sin(angle) * k + (1 - torch.cos(angle)) * (k @ k)
            )  # Rodrigues
            position = position + rotation @ self._child_inverse[1][j]
            rotation = rotation @ self._child_inverse[0][j]
        return position + rotation @ self._tool, origins, directions, rotation

    def forward(self, q: torch.Tensor) -> torch.Tensor:
        """Tool position: (..., 7) [rad] → (..., 3) [m]."""
        return self._chain(q)[0]

    def upright(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Tool position (..., 3) [m] and how far the hand is turned around the vertical axis (...,) [rad]."""
        tool, _, _, rotation = self._chain(q)
        x_axis = (rotation @ self._tool_turned)[..., 0]
        return tool, torch.atan2(x_axis[..., 1], x_axis[..., 0])

    def jacobian(self, q: torch.Tensor) -> torch.Tensor:
        """Derivative of the tool position: (..., 7) → (..., 3, 7) [m/rad]."""
        return self._forward_and_jacobian(q)[1]

    def _forward_and_jacobian(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        tool, origins, directions, _ = self._chain(q)
        columns = [torch.linalg.cross(d, tool - o) for o, d in zip(origins, directions, strict=True)]
        return tool, torch.stack(columns, -1)

    def solve(
        self, goal: torch.Tensor, start: torch.Tensor, *, iterations: int = 12, damping: float = 1e-3
    ) -> torch.Tensor:
        """Joint angles whose tool position is ``goal``, near ``start``, inside the joint limits.

        Damped least squares (Wampler 1986; Buss, "Introduction to inverse kinematics", 2004) with a fixed
        number of iterations: no convergence test, so no host sync; check :meth:`forward` where it matters.

        Args:
            goal: (..., 3) [m].
            start: (..., 7) [rad].
            iterations: Gauss-Newton steps.
            damping: Added to J Jᵀ [m²].

        Returns:
            (..., 7) [rad].
        """
        q = start
        ridge = damping * self._eye
        for _ in range(iterations):
            tool, jacobian = self._forward_and_jacobian(q)
            error = (goal - tool).unsqueeze(-1)
            gram = jacobian @ jacobian.mT + ridge
            # A 3×3 solve by its adjugate: batched LAPACK calls cost more than the whole chain.
            step = jacobian.mT @ (_inverse3(gram) @ error)
            q = torch.clamp(q + step.squeeze(-1).clamp(-0.5, 0.5), self.lower, self.upper)
        return q

    def solve_upright(
        self,
        goal: torch.Tensor,
        yaw: torch.Tensor,
        start: torch.Tensor,
        *,
        iterations: int = 8,
        damping: float = 1e-4,
    ) -> torch.Tensor:
        """As :meth:`solve`, with the hand pointing straight down, turned by ``yaw`` around the vertical axis.

        Args:
            goal: (..., 3) [m].
            yaw: (...,) [rad]; at 0 the tool's x points along x, and the fingers move along y.
            start, iterations, damping: As there; damping of metres and radians alike.

        Returns:
            (..., 7) [rad].
        """
        q, zero = start, torch.zeros_like(yaw)
        c, s, one = torch.cos(yaw), torch.sin(yaw), torch.ones_like(yaw)
        wanted = torch.stack([c, s, zero, s, -c, zero, zero, zero, -one], -1).unflatten(-1, (3, 3)).mT
        ridge = damping * torch.eye(6, device=q.device, dtype=q.dtype)
        for _ in range(iterations):
            tool, origins, directions, rotation = self._chain(q)
            turn = wanted @ (rotation @ self._tool_turned).mT  # its antisymmetric part is the way to turn
            aside = 0.5 * torch.stack(
                [
                    turn[..., 2, 1] - turn[..., 1, 2],
                    turn[..., 0, 2] - turn[..., 2, 0],
                    turn[..., 1, 0] - turn[..., 0, 1],
                ],
                -1,
            )
            error = torch.cat([goal - tool, aside], -1)
            linear = [torch.linalg.cross(d, tool - o) for o, d in zip(origins, directions, strict=True)]
            jacobian = torch.cat([torch.stack(linear, -1), torch.stack(directions, -1)], -2)
            solved, _ = torch.linalg.solve_ex(jacobian @ jacobian.mT + ridge, error.unsqueeze(-1))
            step = (jacobian.mT @ solved).squeeze(-1)
            q = torch.clamp(q + step.clamp(-0.3, 0.3), self.lower, self.upper)
        return q

    def reachable(self, goal: Sequence[float], *, tolerance: float = 0.01) -> bool:
        """Whether some pose puts the tool within ``tolerance`` [m] of ``goal`` (x, y, z) [m]."""
        generator = torch.Generator().manual_seed(0)
        low, high = self.lower.cpu(), self.upper.cpu()
        starts = low + (high - low) * torch.rand(64, low.numel(), generator=generator)
        starts[0] = torch.tensor(HOME)
        starts = starts.to(self.lower.device)
        target = torch.tensor(list(goal), dtype=torch.float32, device=self.lower.device)
        reached = self.forward(self.solve(target.expand(64, 3), starts, iterations=60))
        return bool(((reached - target).norm(dim=-1) < tolerance).any())


def _inverse3(m: torch.Tensor) -> torch.Tensor:
    """Inverse of (..., 3, 3)."""
    a, b, c = m.unbind(-2)
    cofactors = torch.stack(
        [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], -1
    )
    determinant = (a * torch.linalg.cross(b, c)).sum(-1)
    return cofactors / determinant[..., None, None]
