"""The convolutions of Dreamer: against torch's own layout of pixels, and all cameras side by side."""

import pytest
import torch
from tensordict import TensorDict

from franka_wm.models import make
from franka_wm.models.dreamer import Dreamer
from franka_wm.models.dreamer_images import PixelEncoder
from franka_wm.models.layers import symlog
from franka_wm.models.windows import window_of
from small_tdmpc2 import windows

SIZE = (40, 44, 3)
CAMERAS = dict.fromkeys(("pixels", "pixels_side"), SIZE)


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def small(**overrides) -> Dreamer:
    sizes = dict(
        deter_dim=16, hidden_dim=16, codes=3, classes=4, blocks=2, encoder_layers=2, bins=41, imagination=2
    )
    read = dict(observation_sizes={"state": 3}, image_sizes=CAMERAS, channels=2)
    return make("dreamer", action_dim=2, discount=0.9, **{**sizes, **read, **overrides})  # type: ignore[return-value]


def one_camera(size, **options) -> PixelEncoder:
    return PixelEncoder({"pixels": size}, channels=2, **options)


def pictures(*leading: int, size=SIZE) -> torch.Tensor:
    return torch.randint(0, 256, (*leading, *size), dtype=torch.uint8)


def test_an_image_is_halved_four_times():
    encoder = PixelEncoder({"pixels": (64, 64, 3)})
    assert encoder.features == 64 * 4 * 4  # the last of 32, 48, 64, 64
    assert encoder(pictures(2, 5, size=(64, 64, 3))).shape == (2, 5, 1024)
    assert [one.out_channels for one in encoder.convolutions] == [32, 48, 64, 64]
    assert one_camera(SIZE)(pictures(3)).shape == (3, 4 * 3 * 3)  # 40 × 44: filled up to 48 × 48


def test_four_pixels_of_an_image_are_channels_of_the_smaller_one():
    encoder, images = one_camera((32, 64, 3)), pictures(4, size=(32, 64, 3))
    x = images.permute(0, 3, 1, 2) / 255.0 - 0.5
    for norm, convolution in zip(encoder.norms, encoder.convolutions, strict=True):
        own = torch.nn.functional.pixel_unshuffle(x, 2)  # torch's order: a channel's four, one by one
        four = own.unflatten(1, (-1, 4)).transpose(1, 2).flatten(1, 2)
        x = torch.nn.functional.silu(norm(convolution(four).permute(0, 2, 3, 1))).permute(0, 3, 1, 2)
    torch.testing.assert_close(encoder(images), x.permute(0, 2, 3, 1).flatten(1))


def test_a_side_is_filled_up_behind_its_last_pixel():
    encoder, images = one_camera(SIZE), pictures(1)
    full = one_camera((48, 48, 3), standardize=True)
    full.load_state_dict(encoder.state_dict(), strict=False)
    full.set_statistics({"pixels": (torch.zeros(48, 48, 3), torch.ones(48, 48, 3))})
    shown = torch.zeros(1, 48, 48, 3, dtype=torch.uint8)
    shown[:, :40, :44] = images
    full.mean[:40, :44] = 0.5  # what is added stays at zero
    torch.testing.assert_close(encoder(images), full(shown))


def test_the_channels_of_all_cameras_lie_side_by_side():
    model = small()
    seen = TensorDict({"state": torch.zeros(2, 3), **{key: pictures(2) for key in CAMERAS}}, [2])
    both = model.image_encoder.images(seen)
    assert both.shape == (2, 40, 44, 6)
    assert torch.equal(both[..., :3], seen["pixels"]) and torch.equal(both[..., 3:], seen["pixels_side"])
    assert model.image_encoder.convolutions[0].in_channels == 24
    other = seen.clone().update({"pixels_side": pictures(2)})
    assert not torch.allclose(model.encode(seen), model.encode(other))
    with pytest.raises(ValueError, match="images must be uint8"):
        model.encode(seen.update({"pixels_side": torch.rand(2, *SIZE)}))


def test_cameras_of_several_sizes_are_refused():
    with pytest.raises(ValueError, match="all images must have one size to share an encoder"):
        small(image_sizes=CAMERAS | {"pixels_side": (48, 48, 3)})


def test_the_reconstruction_is_that_of_every_camera():
    model, batch = small(vector_coef=3.0), windows(batch=4, horizon=2)
    for part in (batch, batch["next"]):
        part.update({key: pictures(4, 2) for key in CAMERAS})
    window = window_of(batch, model.observation_keys)
    z = torch.randn(4, 3, model.latent_dim)
    drawn = model.image_decoder(z)
    error = 3.0 * (model.vector_decoder(z) - symlog(window["state"])).square().sum(-1).mean()
    for key, part in zip(CAMERAS, drawn.split(3, dim=-1), strict=True):
        error = error + (part - window[key] / 255.0).square().sum((-3, -2, -1)).mean()
    torch.testing.assert_close(model._reconstruction(z, window), error)


def test_images_are_standardised_if_asked_for():
    with pytest.raises(ValueError, match="no images"):
        small(standardize_images=True, image_sizes=None)
    plain, asked = (small(standardize_images=one) for one in (False, True))
    assert list(plain.standardized_images) == [] and list(asked.standardized_images) == list(CAMERAS)
    asked.image_encoder.load_state_dict(plain.image_encoder.state_dict(), strict=False)
    images = torch.cat([pictures(4) for _ in CAMERAS], -1)
    torch.testing.assert_close(asked.image_encoder(images), plain.image_encoder(images))  # until it is told
    asked.set_image_statistics(
        {key: (torch.full(SIZE, 0.05 * len(key)), torch.full(SIZE, 0.03 * len(key))) for key in CAMERAS}
    )
    means = torch.tensor([0.3] * 3 + [0.55] * 3)
    deviation = ((0.18**2 + 0.33**2) / 2) ** 0.5
    given = []
    asked.image_encoder.convolutions[0].register_forward_pre_hook(lambda _, inputs: given.append(inputs[0]))
    asked.image_encoder(images)
    scaled = (images[:, 2:4, 6:8] / 255.0 - means) / deviation
    torch.testing.assert_close(given[0][:, :, 1, 3], scaled.flatten(1))
    same = torch.full(SIZE, 0.4), torch.full(SIZE, 1e-3)  # nothing moved
    asked.set_image_statistics(dict.fromkeys(CAMERAS, same))
    assert asked.image_encoder.std == 1


def test_moments_of_one_frame_are_those_of_each_in_a_stack():
    model = small(image_sizes={"pixels": (40, 44, 9)}, standardize_images=True)
    mean, std = torch.rand(SIZE), torch.rand(SIZE)
    model.set_image_statistics({"pixels": (mean, std)})
    assert torch.equal(model.image_encoder.mean, torch.cat((mean,) * 3, -1))
