"""Heads for goals: they learn where an action leads and how far it is, shape what they should, and plans use them."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from franka_wm.models import make
from franka_wm.models.goal_heads import GoalHeads
from franka_wm.planning import CEM, GoalImage
from franka_wm.policies.planner import ModelPolicy, PlannerPolicy
from franka_wm.seeding import drawing_for

SMALL: dict[str, dict[str, Any]] = {
    "lewm": dict(
        embed_dim=16, encoder_width=16, encoder_depth=1, encoder_heads=2, projector_hidden=32, predictor_depth=1,
        predictor_heads=2, predictor_head_dim=8, predictor_mlp=32, dropout=0.0, sigreg_directions=32,
    ),
    "action_world_model": dict(
        encoder_width=16, encoder_depth=1, encoder_heads=2, grid=2, predictor_width=16, predictor_depth=1,
        predictor_heads=2, guard_directions=32,
    ),
}  # fmt: skip


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def small(name: str, **options: Any) -> Any:
    return make(name, image_sizes={"pixels": (16, 16, 3)}, action_dim=2, **SMALL[name], **options)


def windows(batch: int, horizon: int) -> TensorDict:
    images = torch.randint(0, 256, (batch, horizon + 1, 16, 16, 3), dtype=torch.uint8)
    action = torch.rand(batch, horizon, 2) * 2 - 1
    after = TensorDict({"pixels": images[:, 1:]}, [batch, horizon])
    return TensorDict({"pixels": images[:, :-1], "action": action, "next": after}, [batch, horizon])


def walks(batch: int, horizon: int) -> tuple[Tensor, Tensor]:
    """Places (B, H+1, 2) of walkers, each with one heading in its window, and the actions (B, H, 2)."""
    angle = 2 * torch.pi * torch.rand(batch, 1)
    action = 0.7 * torch.stack((angle.cos(), angle.sin()), -1).expand(batch, horizon, 2)
    start = 4 * torch.rand(batch, 1, 2) - 2
    return torch.cat((start, start + 0.2 * action.cumsum(1)), 1), action


def test_they_learn_the_way_and_how_far_it_is() -> None:
    heads = GoalHeads(2, 2, policy=True, distance=True, hidden=64)
    optimiser = torch.optim.Adam(heads.parameters(), 3e-3)
    for _ in range(300):
        policy, distance = heads.losses(*walks(128, 8))
        assert policy is not None and distance is not None
        optimiser.zero_grad()
        (policy + distance).backward()
        optimiser.step()
    places, action = walks(256, 8)
    found = heads.act(places[:, 2], places[:, 7], deterministic=True)
    assert (found - action[:, 0]).norm(dim=-1).mean() < 0.15
    drawn = heads.act(places[:, 2], places[:, 7], deterministic=False)
    assert 0.005 < (drawn - found).std() < 0.3
    means = [heads.steps(places[:, 1], places[:, 1 + k]).mean() for k in (0, 2, 4, 7)]
    assert means == sorted(means) and means[-1] - means[0] > 0.3
    assert heads.steps(places[:, 0], places[:, 0].roll(1, 0)).mean() > means[-1]


def test_with_frames_reached_later_they_know_goals_beyond_a_window() -> None:
    heads = GoalHeads(2, 2, policy=True, distance=True, episode_length=40, hidden=64)
    optimiser = torch.optim.Adam(heads.parameters(), 3e-3)
    for _ in range(400):
        places, action = walks(128, 40)
        steps = torch.randint(4, 41, (128, 1)) - torch.arange(4)  # from each of four steps on
        later = places.gather(1, steps[:, :1, None].expand(-1, -1, 2))
        policy, distance = heads.losses(places[:, :5], action[:, :4], later, steps.unsqueeze(-1))
        assert policy is not None and distance is not None
        optimiser.zero_grad()
        (policy + distance).backward()
        optimiser.step()
    places, action = walks(256, 40)
    found = heads.act(places[:, 0], places[:, 30], deterministic=True)
    assert (found - action[:, 0]).norm(dim=-1).mean() < 0.15
    near, far = (heads.steps(places[:, 0], places[:, k]).mean() for k in (4, 30))
    assert near < 0.5 and far > near + 0.3  # shares of an episode, no longer of a window


@pytest.mark.parametrize("name", SMALL)
def test_goals_reached_later_are_those_of_the_batch(name: str) -> None:
    batch = windows(8, 4)
    model = small(name, goal_policy_coef=1.0, goal_steps_coef=1.0, episode_length=20)

    def losses(frame: Tensor | None, steps: int) -> dict[str, Tensor]:
        given = batch.clone()
        if frame is not None:
            future = {"pixels": frame.expand(8, 4, 16, 16, 3), "steps": torch.full((8, 4, 1), steps)}
            given["future"] = TensorDict(future, [8, 4])
        torch.manual_seed(1)
        found = model.eval().loss(given)
        return {key: found[key] for key in ("loss_goal_policy", "loss_goal_steps", "loss_prediction")}

    one, other = torch.randint(0, 256, (2, 8, 1, 16, 16, 3), dtype=torch.uint8)
    torch.nn.init.normal_(model.goal_heads.ruler[-1].weight)
    without, with_one = losses(None, 0), losses(one, 9)
    assert torch.equal(without["loss_prediction"], with_one["loss_prediction"])
    for changed in (losses(other, 9), without):
        for key in ("loss_goal_policy", "loss_goal_steps"):
            assert not torch.allclose(changed[key], with_one[key]), key
    assert not torch.allclose(losses(one, 19)["loss_goal_steps"], with_one["loss_goal_steps"])
    assert torch.equal(losses(one, 19)["loss_goal_policy"], with_one["loss_goal_policy"])
    with pytest.raises(ValueError, match="episode_length"):
        small(name, goal_steps_coef=1.0).loss(
            batch.clone().set("future", TensorDict({"pixels": one.expand(8, 4, 16, 16, 3),
                                                    "steps": torch.ones(8, 4, 1)}, [8, 4]))
        )  # fmt: skip


@pytest.mark.parametrize("name", SMALL)
def test_a_model_without_them_does_not_read_frames_reached_later(name: str) -> None:
    batch, model = windows(8, 4), small(name)
    images = torch.randint(0, 256, (8, 1, 16, 16, 3), dtype=torch.uint8).expand(8, 4, 16, 16, 3)
    given = batch.clone().set("future", TensorDict({"pixels": images, "steps": torch.ones(8, 4, 1)}, [8, 4]))
    found = []
    for one in (batch, given):
        torch.manual_seed(1)
        found.append(model.loss(one)["loss"])
    assert torch.equal(*found)


def test_all_images_of_a_window_and_of_its_goal_are_shifted_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    model, batch = small("lewm", random_shift=2, goal_policy_coef=1.0), windows(16, 3)
    later = batch["pixels"][:, :1].expand(16, 3, 16, 16, 3)  # the goal shows what the first frame shows
    batch["future"] = TensorDict({"pixels": later, "steps": torch.full((16, 3, 1), 9)}, [16, 3])
    seen: list[Tensor] = []
    encode = model.encode_frame

    def watched(observation: TensorDict, **options: Any) -> Tensor:
        seen.append(observation["pixels"])
        return encode(observation, **options)

    monkeypatch.setattr(model, "encode_frame", watched)
    model.loss(batch)
    model.eval().loss(batch)
    [shifted, plain] = seen
    assert torch.equal(plain[:, :3], batch["pixels"])
    assert torch.equal(shifted[:, 0], shifted[:, -1])
    moved = (shifted != plain).flatten(1).any(1)
    assert moved.sum() >= 8 and len({one.numpy().tobytes() for one in shifted}) == 16
    middle, found = shifted[:, :, 4:-4, 4:-4], set()
    for one, whole in zip(middle, plain, strict=True):
        ways = [
            (r, c)
            for r in range(2, 7)
            for c in range(2, 7)
            if torch.equal(whole[:, r : r + 8, c : c + 8], one)
        ]
        assert len(ways) == 1
        found.add(ways[0])
    assert len(found) > 4  # each window has its own


class Captured(TorchDispatchMode):
    """Refuses to ask the device for a number, as the capture of a CUDA graph does."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        assert func is not torch.ops.aten._local_scalar_dense.default, "the host waits for the device"
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("name", SMALL)
def test_their_losses_can_be_captured(name: str) -> None:
    batch = windows(8, 4)
    images = torch.randint(0, 256, (8, 1, 16, 16, 3), dtype=torch.uint8).expand(8, 4, 16, 16, 3)
    batch["future"] = TensorDict({"pixels": images, "steps": torch.full((8, 4, 1), 9)}, [8, 4])
    model = small(name, goal_policy_coef=1.0, goal_steps_coef=1.0, episode_length=20)
    with Captured():
        model.loss(batch)["loss"].backward()


@pytest.mark.parametrize("name", SMALL)
def test_the_distance_shapes_embeddings_and_the_policy_does_not(name: str) -> None:
    batch = windows(8, 4)
    for options, shapes in (({"goal_policy_coef": 1.0}, False), ({"goal_steps_coef": 1.0}, True)):
        model = small(name, **options)
        torch.nn.init.normal_(model.goal_heads.ruler[-1].weight) if shapes else None
        losses = model.goal_losses(frames(model, batch), batch)
        [(_, loss)] = losses.items()
        loss.backward()
        reached = [p.grad is not None and bool(p.grad.any()) for p in model.encoder.parameters()]
        assert any(reached) == shapes
        assert all(p.grad is not None for p in model.goal_heads.parameters())


def test_if_asked_the_policy_shapes_embeddings_of_frames_and_of_goals() -> None:
    model = small("lewm", goal_policy_coef=1.0, goal_policy_gradient=True)
    seen = frames(model, windows(8, 4)).detach().requires_grad_()
    later = seen[:, -1:].detach().clone().requires_grad_()
    action = torch.rand(8, 4, 2)
    policy, _ = model.goal_heads.losses(seen, action, later, torch.full((8, 4, 1), 9.0))
    policy.backward()
    assert seen.grad is not None and seen.grad[:, 0].any() and seen.grad[:, -1].any()
    assert later.grad is not None and later.grad.any()


@pytest.mark.parametrize("name", SMALL)
def test_the_policy_reads_the_robots_own_state_and_the_goals_image_alone(name: str) -> None:
    model = small(
        name, observation_sizes={"state": 3}, goal_policy_coef=1.0, goal_steps_coef=1.0, episode_length=20
    ).eval()
    frame, goal = torch.randn(5, model.history.frame_dim), torch.randn(5, model.goal_heads.embed_dim)
    assert model.history.frame_dim > model.goal_heads.embed_dim
    other = frame.clone()
    other[:, model.goal_heads.embed_dim :] += 1.0
    one, two = (model.goal_policy(model.history.start(x), goal, deterministic=True) for x in (frame, other))
    assert (one - two).abs().max() > 1e-3

    # Neither a later state is a goal, nor is a distance told by it.
    seen, action = torch.randn(8, 5, model.history.frame_dim), torch.rand(8, 4, 2)
    found = []
    for shift in (0.0, 1.0):
        frames = seen.clone()
        frames[:, -1, model.goal_heads.embed_dim :] += shift  # a window's last frame is a goal alone
        torch.manual_seed(1)
        found.append(
            torch.stack(model.goal_heads.losses(frames, action, frames[:, -1:], torch.ones(8, 4, 1)))
        )
    assert torch.equal(*found)


def frames(model: Any, batch: TensorDict) -> Tensor:
    images = torch.cat((batch["pixels"], batch["next", "pixels"][:, -1:]), 1)
    return model.encode_frame(TensorDict({"pixels": images}, images.shape[:2]), batch_statistics=True)


@pytest.mark.parametrize("name", SMALL)
def test_they_are_part_of_the_loss_and_absent_by_default(name: str) -> None:
    batch = windows(8, 4)
    plain, both = small(name), small(name, goal_policy_coef=0.5, goal_steps_coef=2.0)
    assert not plain.has_goal_policy and not plain.has_goal_steps and plain.goal_heads is None
    with pytest.raises(NotImplementedError, match="goal_policy"):
        plain.goal_policy(None, None)
    assert "loss_goal_policy" not in plain.loss(batch).keys()  # noqa: SIM118
    found = both.loss(batch)
    half = small(name, goal_policy_coef=0.25, goal_steps_coef=1.0)
    half.load_state_dict(both.state_dict())
    torch.manual_seed(1)
    found = both.loss(batch)
    torch.manual_seed(1)
    less = half.loss(batch)
    for key in ("loss_goal_policy", "loss_goal_steps"):
        assert torch.allclose(found[key], 2 * less[key])
    extra = 0.5 * (found["loss_goal_policy"] + found["loss_goal_steps"])
    assert torch.allclose(found["loss"] - less["loss"], extra, rtol=1e-3, atol=1e-5)


def observed(envs: int) -> TensorDict:
    images = torch.randint(0, 256, (2, envs, 16, 16, 3), dtype=torch.uint8)
    init = torch.ones(envs, 1, dtype=torch.bool)
    return TensorDict({"pixels": images[0], "goal_pixels": images[1], "is_init": init}, [envs])


@pytest.mark.parametrize("name", SMALL)
def test_plans_follow_the_policy_towards_the_goal(name: str) -> None:
    """One candidate beside the plan of doing nothing, and an objective that likes large actions."""
    model = small(name, goal_policy_coef=1.0).eval()
    torch.nn.init.normal_(model.goal_heads.actor[-1].weight, std=0.5)
    seen = observed(3)
    alone = ModelPolicy.for_model(model, explore=False)
    own = alone(seen.clone())["action"]
    other = alone(seen.clone().set("goal_pixels", seen["goal_pixels"].flip(0)))["action"]
    assert own.abs().max() > 0.1 and not torch.allclose(own, other)  # the goal counts

    class Large(GoalImage):
        def bind(self, tensordict: Any) -> Any:
            return lambda trajectory, actions: actions.square().sum((-1, -2))

    planner = CEM(action_dim=2, horizon=3, num_samples=2, num_policy_samples=1, num_elites=1, iterations=1)
    objective = Large(model.encode_goal, embed=model.embed)
    policy = PlannerPolicy.for_model(model, planner, objective=objective, explore=False)
    assert torch.allclose(policy(seen.clone())["action"], own, atol=1e-6)
    planner.num_policy_samples = 0
    assert (policy(seen.clone())["action"] - own).abs().max() > 0.05


def test_the_learned_distance_is_part_of_the_score() -> None:
    model = small("lewm", goal_steps_coef=1.0).eval()
    torch.nn.init.normal_(model.goal_heads.ruler[-1].weight)
    seen, trajectory = observed(2), torch.randn(2, 5, 4, model.latent_dim)
    goals = GoalImage(model.encode_goal, embed=model.embed)
    plain = goals.bind(seen)(trajectory, trajectory)
    goals = GoalImage(model.encode_goal, embed=model.embed, steps=model.goal_steps, steps_weight=2.0)
    reached, goal = model.embed(trajectory[:, :, 1:]), goals.goal(seen)[:, None, None]
    own = model.goal_steps(reached, goal.expand_as(reached)).sum(-1)
    assert own.std() > 0.01
    assert torch.allclose(goals.bind(seen)(trajectory, trajectory), plain - 2.0 * own, rtol=1e-5)


def test_sampled_actions_are_actions() -> None:
    """In [-1, 1], and those of a world are the same in any share of the worlds."""
    heads = GoalHeads(4, 2, policy=True, distance=False)
    embedded, goal = torch.randn(2, 64, 4)
    with drawing_for(0, 64, 64):
        torch.manual_seed(1)
        whole = heads.act(embedded, goal, deterministic=False)
    assert whole.abs().max() == 1.0 and len(whole.unique()) > 100
    with drawing_for(32, 32, 64):
        torch.manual_seed(1)
        assert torch.equal(heads.act(embedded[32:], goal[32:], deterministic=False), whole[32:])
