"""TD-MPC2's update: which gradients go where, what the targets come from, what it learns."""

import pytest
import torch
from tensordict import TensorDict

from franka_wm.models import make
from small_tdmpc2 import optimiser_of, point_mass, randomise, small, update, windows


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def test_one_backward_keeps_policy_and_model_gradients_apart():
    torch.manual_seed(0)
    batch = windows()

    def gradients(**coefficients) -> dict[str, torch.Tensor | None]:
        torch.manual_seed(1)
        model = small(dropout=0.0, **coefficients)
        randomise(model)
        torch.manual_seed(2)
        model.loss(batch)["loss"].backward()
        return {name: p.grad for name, p in model.named_parameters()}

    full = gradients()
    policy_alone = gradients(consistency_coef=0.0, reward_coef=0.0, value_coef=0.0)
    for name, gradient in full.items():
        assert gradient is not None and gradient.abs().sum() > 0, f"{name} gets no gradient"
        alone = policy_alone[name]
        if name.startswith("policy_head"):  # the model losses do not reach the policy
            torch.testing.assert_close(gradient, alone)
        else:  # the policy loss reaches nothing else: not the critic, not the encoder
            assert alone is None or alone.abs().max() == 0, name


def test_target_and_detached_parameters_do_not_move_with_the_optimiser():
    model, batch = small(), windows()
    randomise(model)
    optimiser = optimiser_of(model)
    targets = {name: b.clone() for name, b in model.q_ensemble.named_buffers()}
    model.loss(batch)["loss"].backward()
    optimiser.step()
    assert all(torch.equal(b, targets[name]) for name, b in model.q_ensemble.named_buffers())
    model.after_update()
    name = "weight_1"
    old, live = targets[f"target_{name}"], model.q_ensemble.get_parameter(name).detach()
    moved = model.q_ensemble.get_buffer(f"target_{name}")
    torch.testing.assert_close(moved, old + 0.01 * (live - old))
    assert not torch.equal(moved, old)


def test_a_terminated_step_has_the_reward_as_its_target_and_a_truncated_one_bootstraps():
    model, batch = small(), windows(reward=2.0)
    randomise(model)
    with torch.no_grad():
        model.q_ensemble.get_parameter("bias_2")[..., 80] += 12.0  # every value is about symexp(6) = 402
    model.q_ensemble.update_target(1.0)
    bootstrapped = model.loss(batch)["q_target_mean"]
    assert bootstrapped > 100
    batch["next", "truncated"] = torch.ones(6, 3, 1, dtype=torch.bool)
    assert model.loss(batch)["q_target_mean"] > 100
    batch["next", "terminated"][:] = True
    assert model.loss(batch)["q_target_mean"] == pytest.approx(2.0)


def test_targets_come_from_the_slow_copies():
    model, batch = small(), windows()
    randomise(model)
    torch.manual_seed(1)
    before = model.loss(batch)
    with torch.no_grad():
        model.q_ensemble.get_parameter("bias_2")[..., 80] += 12.0
    torch.manual_seed(1)
    after = model.loss(batch)
    assert after["q_target_mean"] == before["q_target_mean"]
    assert after["q_mean"] > before["q_mean"] + 100


def test_the_last_next_observation_is_learned_from():
    model, batch = small(dropout=0.0), windows()
    changed = batch.clone()
    changed["next", "state"][:, -1] += 1.0
    assert model.loss(changed)["loss_consistency"] != model.loss(batch)["loss_consistency"]
    # while what the following root holds already is not read twice
    changed = batch.clone()
    changed["next", "state"][:, :-1] = torch.nan
    torch.testing.assert_close(model.loss(changed)["loss_consistency"], model.loss(batch)["loss_consistency"])


def test_a_window_of_images_is_its_frames_and_the_last_next_one():
    model = small(image_sizes={"pixels": (64, 64, 3)}).eval()
    frames = torch.randint(256, (2, 5, 64, 64, 3), dtype=torch.uint8)
    pieces = {"pixels": frames, "state": torch.randn(2, 5, 3), "joint_target": torch.randn(2, 5, 2)}
    after = {key: value[:, 1:] for key, value in pieces.items()}
    root = {key: value[:, :-1] for key, value in pieces.items()}
    batch = TensorDict(root | {"next": TensorDict(after, batch_size=[2, 4])}, batch_size=[2, 4])
    moments = [
        TensorDict({key: value[:, t] for key, value in pieces.items()}, batch_size=[2]) for t in range(5)
    ]
    expected = [model.encode(moment) for moment in moments]
    torch.testing.assert_close(model._encode_window(batch), torch.stack(expected))


def test_the_target_is_the_smaller_of_two_distinct_members():
    model = small()
    randomise(model)
    z, action = model.encode(windows(1, 1)), torch.rand(1, 1, 2)
    members = model.two_hot.decode(model.q_ensemble(torch.cat((z, action), -1))).flatten()
    second_largest = members.sort().values[-2]
    seen = {round(model.q(z, action, reduce="pair_min").item(), 3) for _ in range(200)}
    assert max(seen) <= second_largest + 1e-3  # the largest is never the minimum of two distinct ones
    assert len(seen) == 4
    torch.testing.assert_close(model.q(z, action).flatten(), members.mean(0, keepdim=True))


def test_value_is_deterministic_in_evaluation_and_on_demand():
    model = small(dropout=0.5)
    randomise(model)
    z = model.encode(windows())
    assert not torch.equal(model.value(z), model.value(z))
    assert torch.equal(model.value(z, deterministic=True), model.value(z, deterministic=True))
    model.eval()
    assert torch.equal(model.value(z), model.value(z))
    assert not torch.equal(model.value(z, deterministic=False), model.value(z, deterministic=False))


def test_evaluating_the_loss_leaves_the_scale_alone():
    model, batch = small(), windows()
    randomise(model)
    model.eval()
    model.loss(batch)
    assert model.scale.value == 1.0
    model.train()
    for _ in range(3):
        model.loss(batch)
    assert model.scale.value > 1.0


def test_the_scale_is_that_of_encoded_latents_not_of_imagined_ones(monkeypatch):
    """As published: imagined latents follow other actions, and their values drift with the model."""
    model, seen = small().train(), []
    z = model.encode(windows(6, 3)).transpose(0, 1).detach()
    monkeypatch.setattr(model, "q", lambda z, action, **options: z[..., :1])
    monkeypatch.setattr(model.scale, "update", seen.append)
    model._policy_loss(z, torch.ones(len(z), 1, 1))
    assert len(seen) == 1 and torch.equal(seen[0], z[0, :, :1])


def test_parameter_groups_hold_every_parameter_once():
    model = small()
    groups = model.parameter_groups(1e-3)
    held = [id(p) for group in groups for p in group["params"]]
    assert sorted(held) == sorted(id(p) for p in model.parameters())
    by_name = {group["name"]: group for group in groups}
    assert by_name["encoder"]["lr"] == pytest.approx(3e-4) and by_name["model"]["lr"] == 1e-3
    assert by_name["policy"]["eps"] == 1e-5
    assert {g["name"]: g["clip"] for g in groups} == {
        "encoder": "model",
        "model": "model",
        "policy": "policy",
    }


def test_the_loss_refuses_single_transitions():
    with pytest.raises(ValueError, match=r"\[B, H\]"):
        small().loss(windows()[:, 0])


def test_a_saved_model_is_the_same_model():
    model = small()
    randomise(model)
    model.set_observation_statistics(torch.randn(5), torch.rand(5))
    other = small()
    other.load_state_dict(model.state_dict())
    batch = windows()
    assert torch.equal(other.encode(batch), model.encode(batch))
    assert torch.equal(
        other.q(model.encode(batch), batch["action"], weights="target"),
        model.q(model.encode(batch), batch["action"], weights="target"),
    )


def test_on_a_tiny_problem_the_losses_fall_the_critic_stays_true_and_the_policy_heads_home():
    torch.manual_seed(0)
    model = small(observation_sizes={"state": 1}, action_dim=1, discount=0.8, tau=0.05)
    optimiser = optimiser_of(model, lr=3e-3)
    history = [update(model, optimiser, point_mass(64)) for _ in range(500)]
    first, last = history[5], history[-1]
    assert last["reward_error"] < 0.3 * first["reward_error"]
    # Returns lie in [0, 1 / (1 - 0.8) = 5]; a critic driven by its policy runs off to symexp(10).
    assert max(float(h["q_mean"]) for h in history) < 5.0
    assert 2.0 < last["q_mean"] < 5.0
    model.eval()
    at = TensorDict({"state": torch.tensor([[-0.8], [0.8]])}, [2])
    z = model.encode(at)
    action = model.policy(z, deterministic=True)
    assert action[0] > 0.3 and action[1] < -0.3
    # one step on, the dynamics' latent is that of the true next observation
    push = torch.tensor([[1.0], [-1.0]])
    true_next = model.encode(TensorDict({"state": torch.tensor([[-0.5], [0.5]])}, [2]))
    near = (model.next(z, push) - true_next).norm(dim=-1)
    far = (z - true_next).norm(dim=-1)
    assert (near < 0.5 * far).all()


def test_the_update_traces_without_graph_breaks_or_host_reads():
    """Data-dependent control flow or `.item()` in the loss fails here before it fails in a CUDA graph."""
    model, batch = small(), windows()
    randomise(model)
    seen: list[bool] = []

    def loss(**data: torch.Tensor) -> torch.Tensor:
        seen.append(True)
        nested = TensorDict(
            {
                "state": data["state"],
                "joint_target": data["joint_target"],
                "action": data["action"],
                "next": {k.removeprefix("next_"): v for k, v in data.items() if k.startswith("next_")},
            },
            batch_size=[6, 3],
        )
        return model.loss(nested)["loss"]

    flat = {"_".join(k) if isinstance(k, tuple) else k: v for k, v in batch.items(True, True)}
    compiled = torch.compile(loss, backend="eager", fullgraph=True)
    torch.manual_seed(3)
    expected = loss(**flat)
    model.scale.value.fill_(1.0)
    torch.manual_seed(3)
    torch.testing.assert_close(compiled(**flat), expected)


def test_the_value_averages_as_many_members_as_asked():
    model = small(num_q=3).eval()
    randomise(model)
    z = model.encode(windows()[:, 0])
    x = torch.cat((z, model.policy(z, deterministic=True)), -1)
    members = model.two_hot.decode(model.q_ensemble(x))
    torch.testing.assert_close(model.value(z), members.mean(0))
    model.value_members = 2
    torch.testing.assert_close(model.value(z), members[:2].mean(0))
    assert not torch.allclose(members[:2].mean(0), members.mean(0))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_side_by_side_is_as_one_after_the_other(monkeypatch):
    """On a GPU, losses and gradients do not depend on the streams that they are computed on."""
    from franka_wm.models import tdmpc2

    class Plainly:
        def __init__(self, *inputs, lane=0): ...

        def __enter__(self):
            return self

        def __exit__(self, *error): ...

        def join(self, *outputs): ...

    model = make("tdmpc2", observation_sizes={"state": 20}, action_dim=7, episode_length=20).cuda().eval()
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.05)
    shape = (256, 3)
    batch = TensorDict(
        {
            "state": torch.randn(*shape, 20),
            "action": torch.rand(*shape, 7) * 2 - 1,
            "next": TensorDict(
                {
                    "state": torch.randn(*shape, 20),
                    "reward": torch.randn(*shape, 1),
                    "terminated": torch.rand(*shape, 1) < 0.1,
                },
                batch_size=shape,
            ),
        },
        batch_size=shape,
    ).cuda()

    def results():
        found = []
        for seed in range(20):
            torch.manual_seed(seed)
            model.zero_grad()
            losses = model.loss(batch)
            losses["loss"].backward()
            found += [losses["loss"].detach().clone(), *(p.grad.clone() for p in model.parameters())]
        return found

    beside = results()
    monkeypatch.setattr(tdmpc2, "side_stream", Plainly)
    for found, expected in zip(beside, results(), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)
