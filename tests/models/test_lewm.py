import pytest
import torch
from tensordict import TensorDict

from franka_wm.models import lewm, make
from franka_wm.models.history import FrameHistory
from franka_wm.models.lewm import LeWorldModel
from franka_wm.models.transformer import CausalTransformer, block_causal_mask, hide_invalid
from franka_wm.models.windows import check_windows, window_of


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


SMALL = dict(
    action_dim=2,
    embed_dim=32,
    encoder_width=32,
    encoder_depth=1,
    encoder_heads=2,
    patch_size=8,
    projector_hidden=64,
    predictor_depth=1,
    predictor_heads=2,
    predictor_head_dim=16,
    predictor_mlp=64,
    dropout=0.0,
    sigreg_directions=64,
)


def small(**overrides) -> LeWorldModel:
    settings = {"image_sizes": {"pixels": (16, 16, 3)}, **SMALL, **overrides}
    return make("lewm", **settings)


def train(model, windows, *, steps: int, lr: float = 3e-3, batch: int = 64, horizon: int = 3) -> None:
    optimiser = torch.optim.AdamW(model.parameter_groups(lr))
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.01, steps)
    for _ in range(steps):
        losses = model.loss(windows(batch, horizon))
        optimiser.zero_grad()
        losses["loss"].backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 10.0)
        optimiser.step()
        schedule.step()
        model.after_update()


# -- the transformer and the memory


def test_a_block_causal_transformer_sees_no_later_frame():
    mask = block_causal_mask(3, 2)
    assert mask.tolist()[0] == [True, True, False, False, False, False]
    assert mask.tolist()[3] == [True, True, True, True, False, False]
    net = CausalTransformer(width=16, depth=2, heads=2, head_dim=8, hidden=32)
    x, time = torch.randn(2, 6, 16), torch.arange(3).repeat_interleave(2)
    changed = x.clone()
    changed[:, 4:] += torch.randn(2, 2, 16)
    a, b = net(x, time, mask), net(changed, time, mask)
    torch.testing.assert_close(a[:, :4], b[:, :4])
    assert not torch.allclose(a[:, 4:], b[:, 4:])
    changed = x.clone()
    changed[:, 3] += torch.randn(2, 16)  # the other token of the same frame counts
    assert not torch.allclose(net(changed, time, mask)[:, 2], a[:, 2])


def test_adaln_zero_starts_as_the_identity_and_learns_the_condition():
    net = CausalTransformer(width=16, depth=2, heads=2, head_dim=8, hidden=32, condition=4)
    x, time, mask = torch.randn(2, 3, 16), torch.arange(3), block_causal_mask(3)
    c = torch.randn(2, 3, 4)
    torch.testing.assert_close(net(x, time, mask, c), net.norm(x))
    net(x, time, mask, c).square().sum().backward()
    for block in net.blocks:
        assert block.modulation.weight.grad is not None
    with torch.no_grad():
        for block in net.blocks:
            block.modulation.weight.normal_(std=0.3)
    assert not torch.allclose(net(x, time, mask, c), net(x, time, mask, c + 1))


def test_a_short_history_predicts_alike_wherever_it_stands():
    """Two real frames at the end of a history of four, and the same two at the start of a sequence."""
    net = CausalTransformer(width=16, depth=3, heads=2, head_dim=8, hidden=32)
    with torch.no_grad():
        for p in net.parameters():
            p.add_(0.2 * torch.randn_like(p))
    real, junk = torch.randn(5, 2, 16), 100 * torch.randn(5, 2, 16)
    alone = net(real, torch.arange(2), block_causal_mask(2))
    valid = torch.tensor([[0.0, 0.0, 1.0, 1.0]]).expand(5, -1)
    inside = net(torch.cat((junk, real), 1), torch.arange(4), hide_invalid(block_causal_mask(4), valid))
    assert inside.isfinite().all()
    torch.testing.assert_close(inside[:, 2:], alone, rtol=1e-4, atol=1e-5)


def test_memory_is_a_queue():
    memory = FrameHistory(length=3, frame_dim=2, action_dim=1)
    frames, actions = torch.randn(4, 5, 2), torch.randn(4, 4, 1)
    z = memory.start(frames[:, 0])
    assert z.shape == (4, memory.size) == (4, 3 * 2 + 2 * 1 + 3)
    assert memory.split(z)[2].tolist() == [[0.0, 0.0, 1.0]] * 4
    for t in range(4):
        z = memory.push(z, actions[:, t], frames[:, t + 1])
        torch.testing.assert_close(memory.last(z), frames[:, t + 1])
    kept, between, valid = memory.split(z)
    assert torch.equal(kept, frames[:, 2:]) and torch.equal(between, actions[:, 2:]) and valid.all()
    assert torch.equal(memory.gather(frames, actions)[:, -1], z)
    cut = memory.windows(frames)
    assert cut.shape == (4 * 3, 3, 2) and torch.equal(cut.view(4, 3, 3, 2)[:, 1], frames[:, 1:4])
    single = FrameHistory(length=1, frame_dim=2, action_dim=1)
    assert torch.equal(
        single.last(single.push(single.start(frames[:, 0]), actions[:, 0], frames[:, 1])), frames[:, 1]
    )


# -- the family


@pytest.mark.parametrize("leading", [(), (4,), (2, 3)])
@pytest.mark.parametrize("reads", ["pixels", "both", "vectors"])
def test_every_part_takes_any_leading_dimensions(reads, leading, dots):
    vectors = {} if reads == "pixels" else {"position": 2}
    images = {} if reads == "vectors" else {"pixels": dots.size}
    model = small(observation_sizes=vectors, image_sizes=images)
    batch = dots.windows(6, 1)[: max(1, torch.Size(leading).numel()), 0]
    observation = batch.reshape(*leading) if leading else batch[0]
    z, action = model.encode(observation), torch.rand(*leading, 2)
    assert z.shape == model.next(z, action).shape == (*leading, model.latent_dim)
    assert model.embed(z).shape == model.encode_goal(observation).shape == (*leading, 32)
    torch.testing.assert_close(model.embed(z), model.encode_goal(observation))
    assert model.observation_keys == [*vectors, *images]
    assert not model.has_reward
    losses = model.loss(dots.windows(4, 3))
    losses["loss"].backward()
    assert losses.isfinite().all()
    assert all(p.grad is not None for p in model.parameters())


def test_a_goal_picture_needs_no_vectors(dots):
    model = small(observation_sizes={"position": 2})
    goal = TensorDict({"pixels": dots.windows(3, 1)["pixels"][:, 0]}, [3])
    assert model.encode_goal(goal).shape == (3, 32)


def test_observe_pushes_and_starts_anew(dots):
    model = small().eval()
    batch = dots.windows(4, 3)
    z = model.encode(batch[:, 0])
    never, first = torch.zeros(4, 1, dtype=torch.bool), torch.tensor([[True], [False], [True], [False]])
    for t in range(3):
        before, z = z, model.observe(batch["next"][:, t], z, batch["action"][:, t], never)
        torch.testing.assert_close(model.embed(z), model.embed(model.encode(batch["next"][:, t])))
    frames, actions, valid = model.history.split(z)
    assert valid.all() and torch.equal(actions, batch["action"][:, 1:])
    torch.testing.assert_close(frames[:, 0], model.embed(model.encode(batch["next"][:, 0])))
    mixed = model.observe(batch["next"][:, 2], before, batch["action"][:, 2], first)
    fresh = model.encode(batch["next"][:, 2])
    torch.testing.assert_close(mixed[first.squeeze(1)], fresh[first.squeeze(1)])
    torch.testing.assert_close(mixed[~first.squeeze(1)], z[~first.squeeze(1)])


def test_prediction_is_the_trained_one_at_every_length_of_history(dots):
    """`next` after `observe` predicts what `loss` was trained on: the causal pass over the window."""
    model = small().eval()
    with torch.no_grad():
        for block in model.predictor.blocks:
            block.modulation.weight.normal_(std=0.3)
    batch = dots.windows(4, 3)
    frames = torch.stack([model.embed(model.encode(batch[:, t])) for t in range(3)], 1)
    causal = model._predict(frames, batch["action"], block_causal_mask(3), training=False)
    z = model.encode(batch[:, 0])
    for t in range(3):
        torch.testing.assert_close(
            model.embed(model.next(z, batch["action"][:, t])), causal[:, t], rtol=1e-4, atol=1e-5
        )
        z = model.observe(batch["next"][:, t], z, batch["action"][:, t], torch.zeros(4, 1, dtype=torch.bool))


def test_planning_does_not_depend_on_the_rest_of_the_batch_in_any_mode(dots):
    model = small(dropout=0.5).train()
    batch = dots.windows(5, 1)[:, 0]
    running = model.projector.norm.running_mean.clone()
    torch.testing.assert_close(model.encode(batch)[:1], model.encode(batch[:1]))
    z = model.encode(batch)
    assert torch.equal(model.next(z, batch["action"]), model.next(z, batch["action"]))
    assert torch.equal(model.projector.norm.running_mean, running)
    model.loss(dots.windows(5, 2))
    assert not torch.equal(model.projector.norm.running_mean, running)


def test_windows_are_counted(dots):
    assert check_windows(dots.windows(5, 2)) == (5, 2)
    with pytest.raises(ValueError, match=r"batch size \[B, H\], got \[5\]"):
        check_windows(dots.windows(5, 2)[:, 0])


def test_the_loss_is_what_it_says(dots):
    model = small(sigreg_coef=0.5)
    torch.manual_seed(3)
    losses = model.loss(dots.windows(8, 2))
    expected = losses["loss_prediction"] + 0.5 * losses["loss_sigreg"]
    torch.testing.assert_close(losses["loss"].detach(), expected)
    batch = dots.windows(8, 2)
    changed = batch.clone()
    changed["next", "pixels"][:, -1] = 0
    assert model.loss(changed)["loss_prediction"] != model.loss(batch)["loss_prediction"]
    still = batch.clone()
    still["pixels"] = still["next", "pixels"] = torch.full_like(batch["pixels"], 7)
    assert model.eval().loss(still)["relative_error"].isfinite()  # nothing moves: no division by zero
    extra = small(rollout=2, infonce_coef=0.1, inverse_coef=0.2, history=2, reward_head=True).loss(batch)
    parts = {"loss_rollout", "loss_infonce", "loss_inverse", "loss_reward"}
    assert parts <= set(extra.keys())
    torch.manual_seed(0)
    single, twice = small(inverse_coef=0.2, history=2), small(inverse_coef=0.4, history=2)
    twice.load_state_dict(single.state_dict())
    read, doubled = (each.eval().loss(batch)["loss_inverse"] for each in (single, twice))
    torch.testing.assert_close(2 * read, doubled)
    total = extra["loss_prediction"] + 0.09 * extra["loss_sigreg"] + sum(extra[part] for part in parts)
    torch.testing.assert_close(extra["loss"].detach(), total)


def test_each_part_of_the_loss_sees_its_own_frames(dots, monkeypatch):
    model = small(infonce_coef=0.5, inverse_coef=0.25, history=3).eval()
    batch, seen = dots.windows(6, 3), {}
    sigreg, inverse = model._sigreg, model._inverse_loss
    monkeypatch.setattr(model, "_sigreg", lambda frames: seen.update(sigreg=frames) or sigreg(frames))
    monkeypatch.setattr(
        model, "_inverse_loss", lambda *given: seen.update(inverse=inverse(*given)) or seen["inverse"]
    )
    monkeypatch.setattr(lewm, "info_nce", lambda *given: seen.update(pairs=given) or torch.tensor(8.0))
    losses = model.loss(batch)
    frames = model.encode_frame(window_of(batch, ["pixels"]))
    torch.testing.assert_close(seen["sigreg"], frames.transpose(0, 1))  # time leads
    predicted, came = seen["pairs"]
    torch.testing.assert_close(came, frames[:, -1])
    z = model.history.gather(frames, batch["action"])[:, 2]
    torch.testing.assert_close(predicted, model.history.last(model.next(z, batch["action"][:, 2])))
    assert losses["loss_infonce"] == 4.0
    torch.testing.assert_close(losses["loss_inverse"], 0.25 * seen["inverse"].detach())


@pytest.mark.parametrize("rollout", [2, 3, 9])
def test_the_rollout_loss_compares_predictions_fed_back_with_what_came(rollout, dots):
    """Step by step, with `observe` and `next`; the first prediction is that of the plain loss, and not counted."""
    model = small(rollout=rollout, history=2).eval()
    with torch.no_grad():
        for block in model.predictor.blocks:
            block.modulation.weight.normal_(std=0.3)
    batch, never = dots.windows(6, 4), torch.zeros(6, 1, dtype=torch.bool)
    z, start = model.encode(batch[:, 0]), max(0, 4 - rollout)
    for t in range(start):
        z = model.observe(batch["next"][:, t], z, batch["action"][:, t], never)
    errors = []
    for t in range(start, 4):
        z = model.next(z, batch["action"][:, t])
        errors.append((model.embed(z) - model.embed(model.encode(batch["next"][:, t]))).square().mean())
    expected = torch.stack(errors[1:]).mean().detach()
    torch.testing.assert_close(model.loss(batch)["loss_rollout"], expected, rtol=1e-4, atol=1e-6)

    frames = torch.randn(6, 5, 32, requires_grad=True)  # no stop-gradient: what came is pulled, too
    model._rollout_loss(frames, batch["action"]).backward()
    assert frames.grad is not None
    reached = frames.grad.abs().amax((0, 2)) > 0
    assert reached[: start + 1][-2:].all() and not reached[start + 1] and reached[start + 2 :].all()


def test_inverse_dynamics_pull_the_encoder_and_read_the_actions(dots):
    model = small(inverse_coef=1.0, history=2)
    batch = dots.windows(8, 2)
    silent = small(inverse_coef=0.0, history=2)
    silent.load_state_dict(model.state_dict(), strict=False)
    gradients = []
    for each in (model, silent, silent):
        torch.manual_seed(0)  # SIGReg's directions
        weight = each.encoder.patch_embedding.weight
        gradients.append(torch.autograd.grad(each.loss(batch)["loss"], weight)[0])
    assert torch.equal(gradients[1], gradients[2]) and not torch.allclose(gradients[0], gradients[1])
    train(model, dots.windows, steps=150, horizon=2)
    read = model.loss(dots.windows(64, 2))["loss_inverse"]
    assert read < 0.5 * dots.windows(64, 2)["action"].var()
    with pytest.raises(ValueError, match="history=2"):
        model.loss(dots.windows(4, 1))


def test_inverse_dynamics_read_the_pictures_alone_where_there_are_any(dots):
    """Vectors beside pictures, such as commanded angles, would give the actions away."""
    model = small(inverse_coef=1.0, history=2, observation_sizes={"angles": 2}).eval()
    batch = dots.windows(6, 4)  # longer than the history, too
    angles = torch.rand(6, 5, 2)
    batch.set("angles", angles[:, :-1]).set(("next", "angles"), angles[:, 1:])
    other = batch.clone().set("angles", -angles[:, :-1]).set(("next", "angles"), -angles[:, 1:])
    first, second = model.loss(batch), model.loss(other)
    assert first["loss_inverse"] == second["loss_inverse"]
    assert first["loss_prediction"] != second["loss_prediction"]
    alone = small(image_sizes={}, observation_sizes={"angles": 2}, inverse_coef=1.0, history=2)
    assert alone.loss(batch)["loss_inverse"] > 0


def test_the_gradient_passes_through_the_target(dots):
    """No stop-gradient: with what the prediction starts from cut off, the encoder is still pulled."""
    model, batch = small(sigreg_coef=0.0), dots.windows(8, 1)
    predict = model._predict
    model._predict = lambda frames, *a, **k: predict(frames.detach(), *a, **k)  # type: ignore[method-assign]
    model.loss(batch)["loss"].backward()
    assert model.encoder.patch_embedding.weight.grad.abs().sum() > 0


def test_the_reward_is_a_probe_that_trains_nothing_else(dots):
    model = small(reward_head=True)
    batch = dots.windows(8, 3)
    z = model.encode(batch[:, 0])
    assert model.reward(z, batch["action"][:, 0]).abs().max() < 1e-5  # type: ignore[operator]
    plain = small()
    plain.load_state_dict(model.state_dict(), strict=False)
    torch.manual_seed(1)
    model.loss(batch)["loss"].backward()
    torch.manual_seed(1)
    plain.loss(batch)["loss"].backward()
    grads = dict(model.named_parameters())
    for name, p in plain.named_parameters():
        torch.testing.assert_close(grads[name].grad, p.grad)


@pytest.mark.slow
def test_it_learns_how_actions_move_a_dot_and_plans_to_a_goal_picture(dots):
    model = small(patch_size=4)
    train(model, dots.windows, steps=250, lr=1e-3)
    model.eval()
    with torch.no_grad():
        batch = dots.windows(256, 4)
        root = z = model.encode(batch[:, 0])
        for h in range(4):
            z = model.next(z, batch["action"][:, h])
            true = model.embed(model.encode(batch["next"][:, h]))
            error = (model.embed(z) - true).square().mean()
            unchanged = (model.embed(root) - true).square().mean()
            assert error < 0.6 * unchanged, h
        # dynamics react to actions
        right, left = (model.embed(model.next(root, torch.full((256, 2), s))) for s in (1.0, -1.0))
        assert (right - left).norm(dim=-1).mean() > 0.3 * model.embed(root).std(0).norm()

        start, goal = (2.0 + 11.0 * torch.rand(24, 2) for _ in range(2))
        reached = plan_to(model, dots, start, goal, steps=6)
        before, after = (start - goal).norm(dim=-1).mean(), (reached - goal).norm(dim=-1).mean()
        assert after < 0.4 * before  # doing nothing leaves `before`


def plan_to(model, dots, position, goal, *, steps: int, horizon: int = 3, samples: int = 64):
    """Cross-entropy method on the latent distance to a goal picture, summed over the rollout."""
    envs = position.shape[0]

    def picture(where) -> TensorDict:
        return TensorDict({"pixels": dots.draw(where)}, [envs])

    target = model.encode_goal(picture(goal))
    z = model.encode(picture(position))
    for _ in range(steps):
        mean, std = torch.zeros(envs, horizon, 2), torch.ones(envs, horizon, 2)
        for _ in range(3):
            plans = (mean.unsqueeze(1) + std.unsqueeze(1) * torch.randn(envs, samples, horizon, 2)).clamp(
                -1, 1
            )
            rolled, cost = z.unsqueeze(1).expand(-1, samples, -1), torch.zeros(envs, samples)
            for t in range(horizon):
                rolled = model.next(rolled, plans[:, :, t])
                cost = cost + (model.embed(rolled) - target.unsqueeze(1)).square().sum(-1)
            best = cost.topk(8, largest=False).indices[..., None, None].expand(-1, -1, horizon, 2)
            elites = plans.gather(1, best)
            mean, std = elites.mean(1), elites.std(1)
        position = dots.move(position, mean[:, 0])
        z = model.observe(picture(position), z, mean[:, 0], torch.zeros(envs, 1, dtype=torch.bool))
    return position


def test_a_small_embedding_may_have_a_wide_predictor(dots):
    model = small(embed_dim=4, predictor_width=32)
    batch = dots.windows(6, 3)
    z = model.encode(batch[:, 0])
    assert model.embed(z).shape == (6, 4)
    assert model.embed(model.next(z, batch["action"][:, 0])).shape == (6, 4)
    before = {name: p.clone() for name, p in model.named_parameters()}
    train(model, dots.windows, steps=3)
    still = [name for name, p in model.named_parameters() if torch.equal(p, before[name])]
    assert still == []


def test_a_saved_model_is_the_same_model(dots):
    model, other = small(observation_sizes={"position": 2}), small(observation_sizes={"position": 2})
    model.set_observation_statistics(torch.randn(2), torch.rand(2))
    train(model, dots.windows, steps=2, batch=4)
    other.load_state_dict(model.state_dict())
    batch = dots.windows(3, 1)[:, 0]
    z = model.encode(batch)
    assert torch.equal(other.encode(batch), z)
    assert torch.equal(other.next(z, batch["action"]), model.next(z, batch["action"]))


def test_matrices_decay_and_nothing_else(dots):
    model = small()
    groups = model.parameter_groups(1e-3)
    assert sorted(id(p) for g in groups for p in g["params"]) == sorted(id(p) for p in model.parameters())
    by_name = {g["name"]: g for g in groups}
    assert by_name["model"]["weight_decay"] == 1e-3 and by_name["model_plain"]["weight_decay"] == 0
    assert all(p.squeeze().dim() >= 2 for p in by_name["model"]["params"])


def test_the_loss_traces_without_graph_breaks_or_host_reads(dots):
    model = small(rollout=2, inverse_coef=0.1)

    def loss(pixels, last, action):
        batch = TensorDict({"pixels": pixels, "action": action, "next": {"pixels": last}}, [4, 3])
        return model.loss(batch)["loss"]

    batch = dots.windows(4, 3)
    compiled = torch.compile(loss, backend="eager", fullgraph=True)
    assert compiled(batch["pixels"], batch["next", "pixels"], batch["action"]).isfinite()


def test_one_frame_of_memory_learns_and_plans(dots):
    """Of one frame there are no actions in between."""
    model, batch = small(history=1, rollout=2), dots.windows(4, 3)
    model.loss(batch)["loss"].backward()
    z = model.eval().encode(batch[:, 0])
    assert model.next(z.unsqueeze(1).expand(-1, 5, -1), torch.rand(4, 5, 2)).shape == (4, 5, z.shape[-1])


def test_settings_that_cannot_work_are_refused(dots):
    for wrong, message in [
        (dict(image_sizes={}), "nothing to read"),
        (dict(history=0), "history"),
        (dict(rollout=0), "rollout"),
        (dict(inverse_coef=-0.1), "inverse_coef"),
        (dict(predictor_head_dim=3), "even"),
        (dict(dropout=1.0), "dropout"),
        (dict(random_shift=-1), "random_shift"),
        (dict(random_shift=2, image_sizes=None, observation_sizes={"x": 3}), "shifts images"),
        (dict(goal_policy_gradient=True), "no policy towards goals"),
        (dict(encoder_size="huge"), "tiny"),
        (dict(image_sizes={"a": (16, 16, 3), "b": (8, 8, 3)}), "one size"),
    ]:
        with pytest.raises(ValueError, match=message):
            small(**wrong)
    with pytest.raises(ValueError, match=r"\[B, H\]"):
        small().loss(dots.windows(3, 2)[0])
