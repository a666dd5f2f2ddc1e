"""What a planner maximises: callables `(trajectory (E, S, H+1, D), actions (E, S, H, A)) -> scores (E, S)`.

E environments, S candidates, H steps. The trajectory starts at the current latent. They are classes rather
than closures so that a policy that holds one can be copied and sent to another process.
"""

from collections.abc import Callable

from torch import Tensor


class RewardPlusValue:
    """Discounted rewards of the H steps plus the discounted value of the last latent.

    score = Σ_{t<H} γ^t · reward(z_t, a_t) + γ^H · value(z_H). The value is that of the latent after the last
    action, so every action counts (TD-MPC2, arXiv:2310.16828, equation 5).

    Args:
        reward: (z (..., D), action (..., A)) -> (..., 1).
        value: z (..., D) -> (..., 1).
        discount: γ per step.

    Raises:
        ValueError: `discount` outside [0, 1].
    """

    def __init__(
        self, reward: Callable[[Tensor, Tensor], Tensor], value: Callable[[Tensor], Tensor], discount: float
    ) -> None:
        if not 0.0 <= discount <= 1.0:
            raise ValueError(f"discount must be in [0, 1], got {discount}")
        self.reward, self.value, self.discount = reward, value, discount

    def __call__(self, trajectory: Tensor, actions: Tensor) -> Tensor:
        horizon = actions.shape[2]
        rewards = self.reward(trajectory[:, :, :horizon], actions).squeeze(-1)  # (E, S, H), one call
        score = self.discount**horizon * self.value(trajectory[:, :, horizon]).squeeze(-1)
        for t in range(horizon):
            score = score + self.discount**t * rewards[:, :, t]
        return score


class GoalDistance:
    """Minus the squared Euclidean distance to a goal latent, summed over the rollout or at its end only.

    The current latent, which no action can change, is left out. Summing rewards arriving early and staying.

    Args:
        goal_latent: (D,) for all environments, or (E, D), one each.
        summed: over the H predicted latents; else the last one alone.

    Raises:
        ValueError: `goal_latent` has another number of dimensions.
    """

    def __init__(self, goal_latent: Tensor, summed: bool = True) -> None:
        if goal_latent.dim() not in (1, 2):
            raise ValueError(f"goal_latent must be (D,) or (E, D), got {tuple(goal_latent.shape)}")
        self.goal_latent, self.summed = goal_latent, summed

    def __call__(self, trajectory: Tensor, actions: Tensor) -> Tensor:
        goal = self.goal_latent if self.goal_latent.dim() == 1 else self.goal_latent[:, None, None]
        reached = trajectory[:, :, 1:] if self.summed else trajectory[:, :, -1:]
        return -(reached - goal).square().sum(dim=(-2, -1))
