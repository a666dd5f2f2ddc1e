import copy
import shutil

import pytest
import torch
from tensordict import TensorDict

from franka_wm.models import make
from franka_wm.models.images import random_crops
from franka_wm.models.jepa import JEPA, SIGREG_PLACES
from franka_wm.models.regularizers import covariance_loss, feature_std, variance_loss
from franka_wm.models.vision import ViT

SIZE = dict(encoder_width=32, encoder_depth=1, encoder_heads=2, predictor_width=32, predictor_depth=1)


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def small(**overrides) -> JEPA:
    settings = dict(image_sizes={"pixels": (16, 16, 3)}, patch_size=4, predictor_heads=2, guard_directions=32)
    return make("jepa", **{**settings, **SIZE, "local_views": 2, "ema_steps": 100, **overrides})


def train(model: JEPA, windows, *, steps: int, batch: int = 32, horizon: int = 2, lr: float = 3e-3) -> list:
    optimiser = torch.optim.AdamW(model.parameter_groups(lr))
    history = []
    for _ in range(steps):
        losses = model.loss(windows(batch, horizon))
        optimiser.zero_grad()
        losses["loss"].backward()
        optimiser.step()
        model.after_update()
        history.append(losses.detach())
    return history


@pytest.mark.parametrize("recipe", ["ijepa", "vjepa", "lejepa"])
@pytest.mark.parametrize("collapse", ["ema", "sigreg", "vicreg", "none"])
def test_every_recipe_trains_with_every_guard_from_pixels_alone(recipe, collapse, dots):
    model = small(recipe=recipe, collapse=collapse)
    batch = dots.windows(6, 2).select("pixels")  # no actions, no next
    losses = model.loss(batch)
    losses["loss"].backward()
    assert losses.isfinite().all()
    for name, parameter in model.named_parameters():
        if name.startswith("target_"):
            assert parameter.grad is None
        else:
            assert parameter.grad is not None and parameter.grad.isfinite().all(), name
    z = model.encode(batch)
    assert z.shape == (6, 2, model.latent_dim) and not z.requires_grad
    assert not model.has_next


def test_the_context_is_blind_to_what_is_masked(dots):
    """Perturb the pixels of everything that was not seen: the context's features do not change by a bit."""
    model = small()
    clips = dots.windows(4, 1)["pixels"]
    seen: list[torch.Tensor] = []
    model.encoder.register_forward_hook(lambda module, inputs, output: seen.append(inputs[1]))
    model.loss(TensorDict({"pixels": clips}, [4, 1]))
    keep = seen[0]
    before = model.encoder(clips, keep)
    changed = clips.clone()
    for k in range(4):
        for token in set(range(16)) - set(keep[k].tolist()):
            y, x = 4 * (token // 4), 4 * (token % 4)
            changed[k, :, y : y + 4, x : x + 4] = torch.randint(0, 256, (1, 4, 4, 3), dtype=torch.uint8)
    assert not torch.equal(changed, clips)
    assert torch.equal(model.encoder(changed, keep), before)


def test_context_and_targets_come_from_the_right_encoders(dots):
    model = small()
    calls: list[tuple[str, int]] = []
    for name in ("encoder", "target_encoder"):
        getattr(model, name).register_forward_hook(
            lambda module, inputs, output, name=name: calls.append((name, output.shape[1]))
        )
    model.loss(dots.windows(4, 1))
    visible = 16 - 4 * round(0.175 * 16)
    assert calls == [("encoder", visible), ("target_encoder", 16)]


@pytest.mark.parametrize("recipe", ["ijepa", "vjepa"])
def test_each_block_is_asked_for_its_own_tokens_of_the_teacher(recipe, dots, monkeypatch):
    """Against a plain loop; what is answered depends on which token is asked for."""
    model = small(recipe=recipe)
    with torch.no_grad():
        for weight in model.encoder.parameters():
            weight.mul_(1.5)
    batch = dots.windows(3, 2)
    clips = model._as_clips(batch)
    answers = torch.randn(model.encoder.num_patches * clips.shape[1], 32)
    asked = []

    def answer(context, seen, targets, frames):
        asked.append(targets)
        return answers[targets]

    monkeypatch.setattr(model.predictor, "forward", answer)
    loss = model.loss(batch)["loss_prediction"]
    tokens = torch.nn.functional.layer_norm(model.target_encoder(clips), (32,))
    distance = torch.nn.functional.l1_loss if recipe == "vjepa" else torch.nn.functional.smooth_l1_loss
    losses = [
        distance(answers[index], tokens[n, index])
        for n, groups in enumerate(asked[0].tolist())
        for group in groups
        for index in group
    ]
    torch.testing.assert_close(loss, torch.stack(losses).mean())


def test_what_it_encodes_is_of_the_teacher(dots):
    model, alone = small(), small(collapse="none")
    with torch.no_grad():
        for weight in [*model.encoder.parameters(), *alone.encoder.parameters()]:
            weight.mul_(1.5)
    batch = dots.windows(3, 2)
    images = batch["pixels"].flatten(0, 1).unsqueeze(1)
    for one, network in ((model, model.target_encoder), (alone, alone.encoder)):
        torch.testing.assert_close(one.encode(batch).flatten(0, 1), network(images).mean(1).detach())


def test_the_teacher_follows_its_schedule(dots):
    model = small(ema_start=0.9, ema_end=1.0, ema_steps=4)
    assert isinstance(model.target_encoder, ViT)
    with torch.no_grad():
        for p in model.encoder.parameters():
            p.add_(1.0)
    live = model.encoder.patch_embedding.weight.detach()
    for expected in (0.9, 0.925, 0.95, 0.975, 1.0, 1.0):
        old = model.target_encoder.patch_embedding.weight.clone()
        assert model.ema() == pytest.approx(expected)
        model.after_update()
        moved = model.target_encoder.patch_embedding.weight
        torch.testing.assert_close(moved, expected * old + (1 - expected) * live)
    assert model.updates == 6


def test_the_teacher_is_in_no_parameter_group_and_gets_no_gradient(dots):
    model = small(recipe="lejepa", collapse="ema")
    held = {id(p) for group in model.parameter_groups(1e-3) for p in group["params"]}
    assert {g["weight_decay"] for g in small(weight_decay=0.3).parameter_groups(1.0)} == {0.3, 0.0}
    own = {id(p) for name, p in model.named_parameters() if not name.startswith("target_")}
    assert held == own
    before = copy.deepcopy(model.target_encoder.state_dict())
    model.loss(dots.windows(4, 1))["loss"].backward()
    assert all(torch.equal(v, before[k]) for k, v in model.target_encoder.state_dict().items())


@pytest.mark.parametrize("collapse", ["none", "ema", "sigreg", "vicreg"])
@pytest.mark.parametrize("recipe", ["ijepa", pytest.param("lejepa", marks=pytest.mark.slow)])
def test_without_a_guard_it_collapses_and_with_any_it_does_not(recipe, collapse, dots):
    model = small(recipe=recipe, collapse=collapse, projection=16, ema_steps=1000)

    def spread() -> float:
        """Deviation over pictures of what agrees with its prediction: pooled tokens, or lejepa's embeddings.

        Tokens are layer-normed, so that 1 is the most; embeddings are 1 if SIGReg had its way."""
        torch.manual_seed(7)
        x = model.encoder(dots.windows(128, 1)["pixels"].flatten(0, 1)).mean(1)
        if recipe == "lejepa":
            return feature_std(model.projector(x, batch_statistics=False)).item()
        return feature_std(torch.nn.functional.layer_norm(x, x.shape[-1:])).item()

    before = spread()
    history = train(model, dots.windows, steps=80 if recipe == "ijepa" else 100)
    after = spread()
    first, last = history[0]["loss_prediction"], history[-1]["loss_prediction"]
    if collapse == "none":
        assert after < (0.2 * before if recipe == "ijepa" else 0.02)
        assert last < 0.02 * first  # all too easy
    else:
        assert after > (0.5 * before if recipe == "ijepa" else 0.1)
        assert last > 0.02 * first


def test_features_pooled_or_flat(dots):
    pictures = dots.windows(3, 2)
    assert small(features="mean").encode(pictures).shape == (3, 2, 32)
    flat = small(features="flat")
    assert flat.latent_dim == 16 * 32 and flat.encode(pictures).shape == (3, 2, 16 * 32)
    two = small(image_sizes={"pixels": (16, 16, 3), "wrist": (16, 16, 3)})
    pictures["wrist"] = pictures["pixels"].flip(2)
    assert two.latent_dim == 64
    torch.testing.assert_close(
        two.encode(pictures)[..., 32:],
        two.encode(TensorDict({"pixels": pictures["wrist"], "wrist": pictures["pixels"]}, [3, 2]))[..., :32],
    )
    assert two.loss(pictures)["loss"].isfinite()


def test_crops_are_parts_of_the_picture():
    ramp = torch.arange(16, dtype=torch.float32).mul(15).to(torch.uint8)
    picture = ramp.view(1, 1, 1, 16, 1).expand(2, 3, 16, 16, 3)  # brightness is the column
    crops = random_crops(picture, 5, (0.25, 0.25), (8, 8))
    assert crops.shape == (5, 2, 3, 8, 8, 3) and crops.dtype == torch.uint8
    assert (crops == crops[:, :, :1]).all()  # all frames alike
    span = (crops[..., -1, 0].int() - crops[..., 0, 0].int()).float()[:, :, 0, 0]
    # A quarter of the area spans 7 columns from first to last pixel, times the root of the aspect ratio.
    assert span.min() > 15 * 7 * (3 / 4) ** 0.5 - 2 and span.max() < 15 * 7 * (4 / 3) ** 0.5 + 2
    assert len(set(crops[:, :, 0, 0, 0, 0].flatten().tolist())) > 3
    whole = random_crops(picture, 1, (1.0, 1.0), (16, 16))
    assert (whole[0].int() - picture.int()).abs().max() < 45  # only the aspect ratio cuts a little


def test_a_saved_model_is_the_same_model(dots):
    model, other = small(), small()
    train(model, dots.windows, steps=2, batch=4)
    other.load_state_dict(model.state_dict())
    pictures = dots.windows(2, 2)
    assert torch.equal(model.encode(pictures), other.encode(pictures))
    assert other.updates == 2


@pytest.mark.parametrize("recipe", ["ijepa", "vjepa", "lejepa"])
def test_the_loss_traces_without_graph_breaks_or_host_reads(recipe, dots):
    model = small(recipe=recipe, collapse="sigreg")
    compiled = torch.compile(
        lambda pixels: model.loss(TensorDict({"pixels": pixels}, [4, 2]))["loss"],
        backend="eager",
        fullgraph=True,
    )
    assert compiled(dots.windows(4, 2)["pixels"]).isfinite()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a compiler")
def test_a_compiled_loss_of_one_term_has_a_gradient(dots, monkeypatch):
    """A constant 0 that is added is left out: then the loss is the metric, which is detached.

    The term is a small one: of the networks' own, code would be generated for most of a minute.
    """
    torch._dynamo.reset()
    model = small(collapse="ema")
    weight = model.encoder.patch_embedding.weight

    def term(clips):
        features = clips.flatten(1)[:, :32].float()
        return weight.square().mean(), model.guard(features.view(1, 1, *features.shape)), features

    monkeypatch.setattr(model, "_loss_of_masks", term)
    loss = model.compiled_loss()(dots.windows(4, 2).select("pixels"))["loss"]
    loss.backward()
    assert weight.grad.abs().sum() > 0


@pytest.mark.parametrize("recipe", ["ijepa", "lejepa"])
def test_the_loss_is_the_sum_with_and_without_gradients(recipe, dots):
    model = small(recipe=recipe, collapse="sigreg")
    for recorded in (True, False):
        with torch.set_grad_enabled(recorded):
            losses = model.loss(dots.windows(4, 2))
        assert float(losses["loss_guard"]) > 0
        torch.testing.assert_close(losses["loss"].detach(), losses["loss_prediction"] + losses["loss_guard"])


def test_settings_that_cannot_work_are_refused(dots):
    for wrong, message in [
        (dict(recipe="mae"), "ijepa"),
        (dict(collapse="hope"), "vicreg"),
        (dict(masks="stripes"), "multiblock"),
        (dict(image_sizes={}), "pixels"),
        (dict(observation_sizes={"state": 3}), "images only"),
        (dict(tubelet=2), "clips"),
        (dict(patch_size=5), "patch_size"),
        (dict(patch_size=8), "no context"),
        (dict(recipe="lejepa", masks="random"), "crops"),
        (dict(features="cls"), "flat"),
        (dict(ema_start=1.1), "ema_start"),
    ]:
        with pytest.raises(ValueError, match=message):
            small(**wrong)
    with pytest.raises(ValueError, match=r"\[B, H\]"):
        small().loss(dots.windows(3, 2)[0])
    with pytest.raises(ValueError, match="frames"):
        small(recipe="vjepa").loss(dots.windows(3, 1))


@pytest.mark.parametrize("recipe", ["ijepa", "vjepa"])
def test_the_guard_spreads_every_place_of_every_camera_over_images(recipe, dots):
    model = small(
        recipe=recipe, collapse="vicreg", image_sizes=dict.fromkeys(("pixels", "side"), (16, 16, 3))
    )
    windows = dots.windows(8, 2)
    windows["side"] = dots.windows(8, 2)["pixels"]
    cameras = []
    with torch.no_grad():
        seen = torch.stack((windows["pixels"], windows["side"]), 2)  # (8, 2, cameras, …)
        clips = seen.transpose(1, 2) if recipe == "vjepa" else seen.flatten(0, 1).unsqueeze(2)
        tokens = model.encoder(clips.flatten(0, 1))
        tokens = model.projector(tokens, batch_statistics=True)
        tokens = torch.nn.functional.layer_norm(tokens, tokens.shape[-1:])
        for camera in range(2):
            for place in range(tokens.shape[1]):
                x = tokens[camera::2, place]
                cameras.append(variance_loss(x) + covariance_loss(x) / 25)
    assert model.loss(windows)["loss_guard"].item() == pytest.approx(
        torch.stack(cameras).mean().item(), rel=1e-5
    )


def test_sigreg_looks_at_some_places_the_same_ones_in_all_processes(dots, monkeypatch) -> None:
    """Means over processes of unlike places would be of none; all places at once are too many numbers."""
    model, seen, said = small(collapse="sigreg"), [], []
    guard = model.guard.forward
    monkeypatch.setattr(model.guard, "forward", lambda x: seen.append(x) or guard(x))
    monkeypatch.setattr("franka_wm.processes.broadcast", lambda x: said.append(x) or torch.zeros_like(x))
    model.loss(dots.windows(6, 2))
    assert seen[0].shape == (1, SIGREG_PLACES, 12, 64)
    assert said[0].shape == (SIGREG_PLACES,) and (seen[0] == seen[0][:, :1]).all()  # the first process's draw
