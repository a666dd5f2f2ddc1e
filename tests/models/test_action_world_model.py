import copy

import pytest
import torch
from safetensors.torch import save_file
from tensordict import TensorDict

from franka_wm.models import make
from franka_wm.models.action_world_model import ActionWorldModel
from franka_wm.models.backbone import read_encoder
from franka_wm.models.tdmpc2 import TDMPC2


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


SMALL = dict(
    action_dim=2,
    encoder_width=32,
    encoder_depth=1,
    encoder_heads=2,
    patch_size=8,
    state_embed_dim=16,
    state_hidden_dim=32,
    grid=2,
    predictor_width=32,
    predictor_depth=1,
    predictor_heads=2,
    predictor_hidden_dim=32,
    guard_directions=32,
)


def small(**overrides) -> ActionWorldModel:
    return make("action_world_model", **{"image_sizes": {"pixels": (16, 16, 3)}, **SMALL, **overrides})


def train(model, windows, *, steps: int, lr: float = 3e-3, batch: int = 48, horizon: int = 3) -> list:
    optimiser = torch.optim.AdamW(model.parameter_groups(lr))
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.01, steps)
    history = []
    for _ in range(steps):
        losses = model.loss(windows(batch, horizon))
        optimiser.zero_grad()
        losses["loss"].backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 10.0)
        optimiser.step()
        schedule.step()
        model.after_update()
        history.append(losses.detach())
    return history


@pytest.fixture(scope="module")
def jepa_folder(tmp_path_factory):
    """A checkpoint's weights as a run leaves them."""
    torch.manual_seed(1)
    jepa = make(
        "jepa",
        image_sizes={"pixels": (16, 16, 3)},
        patch_size=4,
        encoder_width=32,
        encoder_depth=1,
        encoder_heads=2,
        predictor_width=32,
        predictor_depth=1,
        predictor_heads=2,
    )
    with torch.no_grad():
        for p in jepa.target_encoder.parameters():
            p.add_(0.01)  # the teacher is not the student
        jepa.target_encoder.patch_embedding.weight.mul_(10.0)  # as one that has learned to look at pixels
    folder = tmp_path_factory.mktemp("run")
    (folder / "checkpoints" / "latest").mkdir(parents=True)
    save_file(jepa.state_dict(), folder / "checkpoints" / "latest" / "model.safetensors")
    return folder, jepa


READS = {
    "vit": dict(encoder="vit"),
    "vit and state": dict(encoder="vit", observation_sizes={"position": 2}),
    "conv": dict(encoder="conv", image_sizes={"pixels": (40, 40, 3)}),
    "state": dict(encoder="state", image_sizes={}, observation_sizes={"position": 2}),
}


@pytest.mark.parametrize("predictor", ["transformer", "mlp"])
@pytest.mark.parametrize("reads", READS)
def test_every_encoder_with_every_predictor(reads, predictor, dots):
    side = 40 if reads == "conv" else 16
    model = small(**READS[reads], predictor=predictor)
    losses = model.loss(dots.windows(6, 4, side))
    assert losses.isfinite().all()
    losses["loss"].backward()
    batch = dots.windows(6, 1, side)[:, 0]
    for leading in [(), (6,), (2, 3)]:
        observation = batch.reshape(*leading) if leading else batch[0]
        z, action = model.encode(observation), torch.rand(*leading, 2)
        assert z.shape == model.next(z, action).shape == (*leading, model.latent_dim)
        torch.testing.assert_close(model.embed(z), model.encode_goal(observation), rtol=1e-4, atol=1e-5)
    # it starts as: nothing changes
    torch.testing.assert_close(model.embed(model.next(z, action)), model.embed(z), rtol=1e-3, atol=1e-3)


def test_tokens_are_layer_normed_from_the_encoder_and_from_the_dynamics(dots):
    model = small()
    with torch.no_grad():
        model.dynamics.leave.weight.normal_()
    z = model.encode(dots.windows(4, 1)[:, 0])
    for latent in (z, model.next(z, torch.rand(4, 2))):
        tokens = model.embed(latent).view(4, 4, 32)
        torch.testing.assert_close(tokens.mean(-1), torch.zeros(4, 4), atol=1e-4, rtol=0)
        torch.testing.assert_close(tokens.var(-1, correction=0), torch.ones(4, 4), atol=1e-2, rtol=0)


def test_observe_pushes_and_starts_anew(dots):
    model = small(observation_sizes={"position": 2}, history=3)
    batch = dots.windows(4, 2)
    z = model.encode(batch[:, 0])
    first = torch.tensor([[True], [False], [True], [False]])
    seen = model.observe(batch["next"][:, 0], z, batch["action"][:, 0], first)
    fresh = model.encode(batch["next"][:, 0])
    torch.testing.assert_close(seen[::2], fresh[::2])
    frames, actions, valid = model.history.split(seen[1::2])
    assert valid.tolist() == [[0.0, 1.0, 1.0]] * 2
    torch.testing.assert_close(frames[:, 1], model.history.last(z)[1::2])
    assert torch.equal(actions[:, 1], batch["action"][1::2, 0])
    torch.testing.assert_close(model.embed(seen), model.embed(fresh))


def test_prediction_is_the_trained_one_at_every_length_of_history(dots):
    model = small(history=3, collapse="none").eval()
    with torch.no_grad():
        model.dynamics.leave.weight.normal_(std=0.3)
    batch = dots.windows(4, 3)
    frames = torch.stack([model.embed(model.encode(batch[:, t])) for t in range(3)], 1)
    causal = model._normalise(model.dynamics(frames, batch["action"], None))
    z, never = model.encode(batch[:, 0]), torch.zeros(4, 1, dtype=torch.bool)
    for t in range(3):
        predicted = model.embed(model.next(z, batch["action"][:, t]))
        torch.testing.assert_close(predicted, causal[:, t], rtol=1e-3, atol=1e-4)
        z = model.observe(batch["next"][:, t], z, batch["action"][:, t], never)


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    "collapse", ["sigreg", pytest.param("vicreg", marks=SLOW), pytest.param("ema", marks=SLOW)]
)
def test_trained_along_the_encoder_does_not_collapse_and_actions_matter(collapse, dots):
    model = small(collapse=collapse)
    with torch.no_grad():
        before = model.embed(model.encode(dots.windows(64, 1)[:, 0])).std(0).mean()
    train(model, dots.windows, steps=80)
    with torch.no_grad():
        z = model.encode(dots.windows(64, 1)[:, 0])
        assert model.embed(z).std(0).mean() > 0.3 * before
        if collapse != "ema":  # whose teacher hardly moves in so few steps
            right, left = (model.embed(model.next(z, torch.full((64, 2), s))) for s in (1.0, -1.0))
            assert (right - left).norm(dim=-1).mean() > 0.1 * model.embed(z).std(0).norm()


def test_with_no_guard_it_collapses(dots):
    model = small(collapse="none")
    with torch.no_grad():
        before = model.embed(model.encode(dots.windows(64, 1)[:, 0])).std(0).mean()
    train(model, dots.windows, steps=80)
    with torch.no_grad():
        assert model.embed(model.encode(dots.windows(64, 1)[:, 0])).std(0).mean() < 0.2 * before


def test_a_pretrained_encoder_is_the_teacher_stays_frozen_and_the_dynamics_learn(jepa_folder, dots):
    folder, jepa = jepa_folder
    model = small(encoder_from=str(folder))
    pictures = dots.windows(4, 1)["pixels"][:, 0]
    assert model.frozen and model.token_dim == 32
    torch.testing.assert_close(model.encoder.network(pictures), jepa.target_encoder(pictures))
    before = copy.deepcopy(model.encoder.state_dict())
    batch = dots.windows(
        16, 2
    )  # always the same: what a random encoder makes of new ones takes long to learn
    history = train(model, lambda *_: batch, steps=300)
    assert all(torch.equal(v, before[k]) for k, v in model.encoder.state_dict().items())
    held = {id(p) for group in model.parameter_groups(1e-3) for p in group["params"]}
    assert held.isdisjoint({id(p) for p in model.encoder.parameters()})
    assert history[0]["relative_error"] == pytest.approx(1.0, abs=0.01)
    assert history[-1]["relative_error"] < 0.6
    assert history[-1]["loss_guard"] == 0
    assert not model.train().encoder.training
    tuned = small(encoder_from=str(folder), freeze_encoder=False)
    start = tuned.encoder.network.patch_embedding.weight.clone()
    train(tuned, dots.windows, steps=2)
    assert not torch.equal(tuned.encoder.network.patch_embedding.weight, start)


def test_its_own_weights_rebuild_it_without_the_pretrained_checkpoint(jepa_folder, dots):
    model = small(encoder_from=str(jepa_folder[0]))
    again = small(**model.rebuild_overrides())
    again.load_state_dict(model.state_dict())
    batch = dots.windows(3, 1)[:, 0]
    assert torch.equal(again.encode(batch), model.encode(batch)) and again.frozen


def test_the_teacher_of_another_one_is_read(tmp_path):
    model = small(collapse="ema")
    with torch.no_grad():
        for weight in model.encoder.parameters():
            weight.add_(1.0)
    save_file({k: v.contiguous() for k, v in model.state_dict().items()}, tmp_path / "model.safetensors")
    found = read_encoder(tmp_path)
    for name, weight in model.target_encoder.network.state_dict().items():
        assert torch.equal(found[name], weight), name


def test_what_is_no_checkpoint_is_refused_in_one_line(tmp_path, jepa_folder):
    (tmp_path / "other").mkdir()
    save_file({"head.weight": torch.zeros(2)}, tmp_path / "other" / "model.safetensors")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "model.safetensors").write_bytes(b"not safetensors")
    for path, message in [
        ("nowhere", "neither"),
        ("other", "no vision transformer"),
        ("broken", "cannot be read"),
    ]:
        with pytest.raises(ValueError, match=message) as error:
            read_encoder(tmp_path / path)
        assert "\n" not in str(error.value)
    save_file({"encoder.architecture": torch.zeros(3, dtype=torch.int64)}, tmp_path / "model.safetensors")
    with pytest.raises(ValueError, match=r"encoder_from=.*architecture must be .*; give another checkpoint"):
        small(encoder_from=str(tmp_path))
    with pytest.raises(ValueError, match="multiples of 4"):
        small(encoder_from=str(jepa_folder[0]), image_sizes={"pixels": (18, 18, 3)})


def test_a_hugging_face_backbone(tmp_path, dots):
    transformers = pytest.importorskip("transformers")
    config = transformers.Dinov2Config(
        hidden_size=16, num_hidden_layers=1, num_attention_heads=2, image_size=28, patch_size=7, mlp_ratio=2
    )
    backbone = transformers.Dinov2Model(config)
    backbone.save_pretrained(tmp_path / "dino", safe_serialization=True)
    model = small(huggingface=str(tmp_path / "dino"), local_files_only=True)
    assert model.frozen and model.encoder.own_grid == (4, 4) and model.token_dim == 16
    pictures = dots.windows(2, 1)["pixels"][:, 0]
    x = torch.nn.functional.interpolate(
        pictures.permute(0, 3, 1, 2) / 255.0, size=(28, 28), mode="bilinear", antialias=True
    )
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    x = (x - mean.view(1, 3, 1, 1)) / std.view(1, 3, 1, 1)
    expected = backbone.eval()(pixel_values=x).last_hidden_state[:, 1:]  # without the class token
    torch.testing.assert_close(
        model.encoder.network.maps(pictures).flatten(2).mT, expected, rtol=1e-4, atol=1e-5
    )
    losses = model.loss(dots.windows(4, 3))
    losses["loss"].backward()
    assert all(p.grad is None for p in model.encoder.parameters())
    assert not any(m.training for m in model.train().encoder.modules())
    again = small(**model.rebuild_overrides())  # reads no file
    again.load_state_dict(model.state_dict())
    batch = dots.windows(2, 1)[:, 0]
    assert torch.equal(again.encode(batch), model.encode(batch))
    with pytest.raises(ValueError, match="huggingface="):
        small(huggingface=str(tmp_path / "nothing"), local_files_only=True)


def test_no_constant_is_added_to_a_loss_of_one_term(dots):
    """See `summed`: compiled, it would have no gradient."""
    losses = small(rollout=1, collapse="none").loss(dots.windows(4, 3))
    loss = losses["loss"]
    assert loss.grad_fn is not None and "Add" not in loss.grad_fn.name()
    assert loss == losses["loss_prediction"]


def test_the_loss_traces_without_graph_breaks_or_host_reads(dots):
    model = small()

    def loss(pixels, last, action):
        batch = TensorDict({"pixels": pixels, "action": action, "next": {"pixels": last}}, [4, 3])
        return model.loss(batch)["loss"]

    batch = dots.windows(4, 3)
    compiled = torch.compile(loss, backend="eager", fullgraph=True)
    assert compiled(batch["pixels"], batch["next", "pixels"], batch["action"]).isfinite()


def test_settings_that_cannot_work_are_refused():
    for wrong, message in [
        (dict(encoder="unet"), "vit"),
        (dict(predictor="rnn"), "mlp"),
        (dict(rollout=0), "rollout"),
        (dict(image_sizes={}), "pixels"),
        (dict(encoder="state"), "vectors only"),
        (dict(encoder="state", image_sizes={}), "observation_sizes"),
        (dict(encoder_from="a", huggingface="b"), "not both"),
        (dict(predictor_width=30), "predictor_width"),
        (dict(grid=0), "grid"),
    ]:
        with pytest.raises(ValueError, match=message):
            small(**wrong)


# -- TD-MPC2 with pictures


def pixels_model(**overrides) -> TDMPC2:
    settings = dict(action_dim=2, discount=0.8, latent_dim=64, encoder_dim=32, hidden_dim=32, channels=4)
    return make("tdmpc2", **{**settings, "image_sizes": {"pixels": (40, 40, 3)}, **overrides})


def test_tdmpc2_of_64_pixels_is_the_published_encoder():
    model = make("tdmpc2", image_sizes={"pixels": (64, 64, 3)}, action_dim=2, discount=0.9)
    assert [tuple(p.shape) for p in model.encoder.parameters()] == [
        shape
        for kernel, inputs in ((7, 3), (5, 32), (3, 32), (3, 32))
        for shape in ((32, inputs, kernel, kernel), (32,))
    ]
    assert model.observation_keys == ["pixels"] and model.observation_sizes == {}


@pytest.mark.parametrize("vectors", [{}, {"position": 2}])
def test_tdmpc2_learns_from_pixels(vectors, dots):
    model = pixels_model(observation_sizes=vectors)
    batch = dots.windows(4, 3, 40)
    z = model.encode(batch)
    assert z.shape == (4, 3, 64)
    torch.testing.assert_close(z.unflatten(-1, (8, 8)).sum(-1), torch.ones(4, 3, 8))
    assert torch.equal(model.encode(batch), z)  # no shift while planning, though in training mode
    optimiser = torch.optim.Adam(model.parameter_groups(1e-3))
    errors = []
    for _ in range(60):
        losses = model.loss(dots.windows(16, 3, 40))
        optimiser.zero_grad()
        losses["loss"].backward()
        optimiser.step()
        model.after_update()
        errors.append(losses["reward_error"])
    assert errors[-1] < 0.8 * errors[0]
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in model.encoder.parameters())


def test_tdmpc2_shifts_pictures_in_training_only(dots):
    batch = dots.windows(4, 2, 40)

    def consistency(model: TDMPC2) -> float:
        torch.manual_seed(0)
        return model.loss(batch)["loss_consistency"].item()

    shifted, still = pixels_model(random_shift=3), pixels_model(random_shift=0)
    still.load_state_dict(shifted.state_dict())
    assert consistency(shifted) != consistency(still)
    assert consistency(shifted.eval()) == consistency(still.eval())


def test_tdmpc2_takes_a_pretrained_encoder_and_freezes_it(jepa_folder, dots):
    folder, jepa = jepa_folder
    settings = dict(image_sizes={"pixels": (16, 16, 3)}, encoder_from=str(folder))
    model = pixels_model(**settings, freeze_encoder=True, observation_sizes={"position": 2})
    pictures = dots.windows(2, 1)["pixels"][:, 0]
    torch.testing.assert_close(model.encoder.backbone.network(pictures), jepa.target_encoder(pictures))
    before = copy.deepcopy(model.encoder.backbone.state_dict())
    optimiser = torch.optim.Adam(model.parameter_groups(1e-2))
    join = model.encoder.join.linear.weight.clone()
    model.loss(dots.windows(4, 3))["loss"].backward()
    optimiser.step()
    assert all(torch.equal(v, before[k]) for k, v in model.encoder.backbone.state_dict().items())
    assert not torch.equal(model.encoder.join.linear.weight, join)
    again = pixels_model(
        image_sizes={"pixels": (16, 16, 3)},
        freeze_encoder=True,
        observation_sizes={"position": 2},
        **model.rebuild_overrides(),
    )
    again.load_state_dict(model.state_dict())
    batch = dots.windows(2, 1)
    assert torch.equal(again.encode(batch), model.encode(batch))
    tuned = pixels_model(**settings)
    tuned.loss(dots.windows(4, 3))["loss"].backward()
    assert tuned.encoder.backbone.network.patch_embedding.weight.grad.abs().sum() > 0
    with pytest.raises(ValueError, match="encoder_from"):
        pixels_model(freeze_encoder=True)
