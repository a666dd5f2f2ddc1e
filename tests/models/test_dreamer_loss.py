"""DreamerV3's whole loss against plain loops over numbers: which state, reward and return each part is made of."""

from __future__ import annotations

import math
from collections import defaultdict

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from franka_wm.models.dreamer import Dreamer
from small_tdmpc2 import windows

B, H, K = 3, 4, 3
"""Windows, their steps, steps of an imagined trajectory."""
ENDED = 1
"""The window whose last step terminated its episode."""
WEIGHTS = {"dynamics": 0.7, "representation": 0.3, "decoder": 0.2, "reward": 1.5, "termination": 0.6}
WEIGHTS |= {"replay_value": 0.4}
VECTORS = 1.7
"""Weight of vectors in the reconstruction."""


def small(burn_in: int) -> Dreamer:
    """Heads with random weights: rewards, values, ends and the slow critic all say something, and not the same."""
    model = Dreamer(
        observation_sizes={"state": 3, "joint_target": 2}, action_dim=2, discount=0.8, return_lambda=0.7,
        deter_dim=16, hidden_dim=16, codes=3, classes=4, blocks=2, encoder_layers=2, bins=21, imagination=K,
        value_low=-4.0, value_high=4.0, terminates=True, free_nats=0.9, entropy_coef=0.3,
        burn_in=burn_in, vector_coef=VECTORS,
        **{f"{name}_coef": weight for name, weight in WEIGHTS.items()},
    )  # fmt: skip
    with torch.no_grad():
        for head in (model.reward_head, model.critic, model.slow_critic, model.termination_head, model.actor):
            assert head is not None
            head[-1].weight.normal_()
    return model


class Plain:
    """The losses, from states that were drawn once, number by number."""

    def __init__(self, model: Dreamer, z: Tensor, imagined: Tensor, actions: Tensor):
        self.model, self.z = model, z
        self.imagined, self.actions = (one.view(-1, H + 1, B, one.shape[-1]) for one in (imagined, actions))

    def value(self, z: Tensor) -> float:
        return self.read(self.model.critic, z)

    def read(self, head: torch.nn.Module, z: Tensor) -> float:
        """What a head of bins says: the expectation, in symlog space."""
        mean = sum(p * s for p, s in zip(head(z).softmax(-1).tolist(), self.support, strict=True))
        return math.copysign(math.expm1(abs(mean)), mean)

    @property
    def support(self) -> list[float]:
        return [-4.0 + 0.4 * k for k in range(21)]

    def cross_entropy(self, head: torch.nn.Module, z: Tensor, target: float) -> float:
        """With the two bins around the target."""
        squashed = min(4.0, max(-4.0, math.copysign(math.log1p(abs(target)), target)))
        below = min(19, int((squashed + 4.0) / 0.4))
        above = (squashed - self.support[below]) / 0.4
        logs = head(z).log_softmax(-1).tolist()
        return -((1.0 - above) * logs[below] + above * logs[below + 1])

    def critics(self, z: Tensor, target: float) -> float:
        return self.cross_entropy(self.model.critic, z, target) + self.cross_entropy(
            self.model.critic, z, self.read(self.model.slow_critic, z)
        )

    def returns(self, t: int, b: int) -> tuple[list[float], list[float]]:
        """λ-returns of the trajectory from one state of a window, and the chance that its steps are come to."""
        states = self.imagined[:, t, b]
        rewards = [self.read(self.model.reward_head, states[k + 1]) for k in range(K)]
        ends = [float(self.model.termination_head(states[k + 1]).sigmoid()) for k in range(K)]  # type: ignore[misc]
        after, returns = self.value(states[K]), []
        for k in reversed(range(K)):
            ahead = 0.3 * self.value(states[k + 1]) + 0.7 * after
            after = rewards[k] + 0.8 * (1.0 - ends[k]) * ahead
            returns.insert(0, after)
        weights = [0.0 if (t, b) == (H, ENDED) else 1.0]
        for k in range(K - 1):
            weights.append(weights[-1] * 0.8 * (1.0 - ends[k]))
        return returns, weights

    def losses(self, batch: TensorDict, posterior: Tensor, scale: float) -> dict[str, float]:
        parts: dict[str, list[float]] = defaultdict(list)
        first = {}
        for t, b in ((t, b) for t in range(H + 1) for b in range(B)):
            returns, weights = self.returns(t, b)
            first[t, b] = returns[0]
            for k in range(K):
                z, action = self.imagined[k, t, b], self.actions[k, t, b].tolist()
                means, stds = (one.tolist() for one in self.model.action_distribution(z))
                density = entropy = 0.0
                for a, mean, std in zip(action, means, stds, strict=True):
                    density -= 0.5 * ((a - mean) / std) ** 2 + math.log(std) + 0.5 * math.log(2 * math.pi)
                    entropy += 0.5 + 0.5 * math.log(2 * math.pi) + math.log(std)
                advantage = (returns[k] - self.value(z)) / scale
                parts["policy"].append(-weights[k] * (advantage * density + 0.3 * entropy))
                parts["value"].append(weights[k] * self.critics(z, returns[k]))
            seen = batch[b, t] if t < H else batch[b, H - 1]["next"]
            vectors = [*seen["state"].tolist(), *seen["joint_target"].tolist()]
            guessed = self.model.vector_decoder(self.z[t, b]).tolist()  # type: ignore[misc]
            squashed = [math.copysign(math.log1p(abs(x)), x) for x in vectors]
            errors = [(x - y) ** 2 for x, y in zip(guessed, squashed, strict=True)]
            parts["decoder"].append(VECTORS * sum(errors))
        for b in range(B):
            after = first[H, b]
            for t in reversed(range(H)):  # step t leads from z[t] to z[t + 1]
                step, z, following = batch[b, t]["next"], self.z[t, b], self.z[t + 1, b]
                reward, ended = float(step["reward"]), (t, b) == (H - 1, ENDED)
                after = reward + (0.0 if ended else 0.8 * (0.3 * first[t + 1, b] + 0.7 * after))
                parts["replay_value"].append(self.critics(z, after))
                parts["reward"].append(self.cross_entropy(self.model.reward_head, following, reward))
                end = float(self.model.termination_head(following).sigmoid())  # type: ignore[misc]
                parts["termination"].append(-math.log(end if ended else 1.0 - end))
                prior = self.model.rssm.prior(following[:16]).flatten().tolist()
                own = posterior[t + 1, b].flatten().tolist()
                nats = sum(math.exp(p) * (p - q) for p, q in zip(own, prior, strict=True))
                parts["dynamics"].append(max(0.9, nats))
        parts["representation"] = parts["dynamics"]  # the same number: their gradients differ
        return {name: sum(numbers) / len(numbers) for name, numbers in parts.items()}


@pytest.mark.parametrize("burn_in", [0, 2])
@torch.no_grad()
def test_the_whole_loss_is_that_of_plain_loops(burn_in: int, monkeypatch) -> None:
    torch.manual_seed(3)
    model = small(burn_in).eval()
    model.scale.value.fill_(2.5)
    batch = windows(batch=B, horizon=H)
    batch["next", "reward"] = torch.linspace(-1.0, 3.0, B * H).view(B, H, 1)[:, torch.randperm(H)]
    batch["next", "terminated"] = torch.zeros(B, H, 1, dtype=torch.bool)
    batch["next", "terminated"][ENDED, -1] = True
    drawn: dict[str, tuple[Tensor, Tensor]] = {}
    for name in ("_filter", "_imagine"):
        made = getattr(model, name)
        monkeypatch.setattr(
            model, name, lambda *given, name=name, made=made: drawn.setdefault(name, made(*given))
        )
    earlier = windows(batch=B, horizon=burn_in)
    begins = torch.zeros(B, burn_in + H, 1, dtype=torch.bool)
    found = model.loss(torch.cat((earlier, batch), 1).set("is_init", begins))  # type: ignore[arg-type]
    (z, posterior), (imagined, actions) = drawn["_filter"], drawn["_imagine"]
    assert torch.equal(imagined[0], z.flatten(0, 1))  # a trajectory from every state of the batch
    expected = Plain(model, z, imagined, actions).losses(batch, posterior, 2.5)
    assert {f"loss_{name}" for name in expected} == {key for key in found.keys() if key.startswith("loss_")}  # noqa: SIM118
    for name, number in expected.items():
        torch.testing.assert_close(
            float(found[f"loss_{name}"]),
            number,
            rtol=1e-4,
            atol=1e-5,
            msg=lambda text, name=name: f"{name}: {text}",
        )
    total = sum(WEIGHTS.get(name, 1.0) * number for name, number in expected.items())
    torch.testing.assert_close(float(found["loss"]), total, rtol=1e-4, atol=1e-5)
