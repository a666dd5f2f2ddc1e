import pytest
import torch

from franka_wm.models.images import RandomShift
from franka_wm.models.vision import Architecture, Block, ConvDecoder, ConvEncoder, ViT, vit_size


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def pictures(*leading: int, side: int = 16) -> torch.Tensor:
    return torch.randint(0, 256, (*leading, side, side, 3), dtype=torch.uint8)


def small(**overrides) -> ViT:
    settings = dict(image_size=(16, 16, 3), patch_size=4, width=32, depth=2, heads=2)
    return ViT(**{**settings, **overrides})


# -- random shift


def test_a_shift_moves_the_picture_by_whole_pixels_and_repeats_its_edges():
    image = pictures(40)
    shifted = RandomShift(3)(image)
    assert shifted.shape == image.shape and shifted.dtype == torch.uint8
    padded = torch.nn.functional.pad(image.permute(0, 3, 1, 2).float(), (3, 3, 3, 3), mode="replicate")
    padded = padded.permute(0, 2, 3, 1).to(torch.uint8)
    found = set()
    for k in range(40):
        matches = [
            (y, x)
            for y in range(7)
            for x in range(7)
            if torch.equal(padded[k, y : y + 16, x : x + 16], shifted[k])
        ]
        assert len(matches) == 1
        found.add(matches[0])
    assert len(found) > 20  # each picture has its own
    assert {y for y, _ in found} == set(range(7)) == {x for _, x in found}  # up to 3 each way


def test_all_frames_of_a_window_are_shifted_alike():
    frame = pictures(8)
    shifted = RandomShift(3)(frame.unsqueeze(1).expand(-1, 5, -1, -1, -1))
    assert (shifted == shifted[:, :1]).all()
    assert not torch.equal(shifted[:, 0], frame)


def test_nothing_is_shifted_in_evaluation():
    image = pictures(4)
    assert torch.equal(RandomShift(3).eval()(image), image)
    assert torch.equal(RandomShift(0)(image), image)
    with pytest.raises(ValueError, match="pad"):
        RandomShift(-1)


# -- convolutions


def test_the_convolutional_encoder_has_the_published_shape():
    encoder = ConvEncoder((64, 64, 3))
    assert encoder.features == 512 and encoder.grid == (4, 4)
    assert encoder(pictures(2, 3, side=64)).shape == (2, 3, 512)
    kernels = [(m.kernel_size[0], m.stride[0]) for m in encoder.network if isinstance(m, torch.nn.Conv2d)]
    assert kernels == [(7, 2), (5, 2), (3, 2), (3, 1)]


def test_images_are_standardised_by_a_mean_image_and_one_deviation():
    plain = ConvEncoder((64, 64, 6))
    encoder, images = ConvEncoder((64, 64, 6), standardize=True), pictures(5, side=64)
    encoder.network = plain.network
    stacks = torch.cat((images, images.flip(0)), -1)
    torch.testing.assert_close(encoder(stacks), plain(stacks))  # until it is told
    seen = images / 255.0
    encoder.set_statistics(seen.mean(0), seen.std(0))
    given = []
    encoder.network.register_forward_pre_hook(lambda module, inputs: given.append(inputs[0]))
    assert not torch.allclose(encoder(stacks), plain(stacks))
    moved = (seen - seen.mean(0)) / seen.std(0).square().mean().sqrt()
    torch.testing.assert_close(given[0], torch.cat((moved, moved.flip(0)), -1).permute(0, 3, 1, 2))
    encoder.set_statistics(seen.mean(0), torch.full((64, 64, 3), 1e-3))  # nothing moved
    assert encoder.std == 1


def test_what_is_no_uint8_picture_is_refused():
    with pytest.raises(ValueError, match="uint8"):
        ConvEncoder((64, 64, 3))(torch.rand(1, 64, 64, 3))
    with pytest.raises(ValueError, match="uint8"):
        small()(torch.rand(1, 16, 16, 3))
    with pytest.raises(ValueError, match="38"):
        ConvEncoder((32, 32, 3))


# -- the vision transformer


def test_hidden_pixels_change_nothing_not_even_a_bit():
    vit, image = small(), pictures(3)
    keep = torch.tensor([[0, 5, 9], [1, 2, 3], [15, 0, 7]])
    changed = image.clone()
    for k in range(3):
        for token in set(range(16)) - set(keep[k].tolist()):
            y, x = 4 * (token // 4), 4 * (token % 4)
            changed[k, y : y + 4, x : x + 4] = 255 - changed[k, y : y + 4, x : x + 4]
    assert torch.equal(vit(image, keep), vit(changed, keep))
    assert not torch.equal(vit(image), vit(changed))


def test_only_the_visible_tokens_are_computed():
    vit = small(cls=True)
    seen: list[int] = []
    for layer in (vit.patch_embedding, *(m for m in vit.modules() if isinstance(m, Block))):
        layer.register_forward_hook(lambda module, inputs, output: seen.append(inputs[0].shape[1]))
    assert vit(pictures(2), torch.tensor([[1, 4, 6], [0, 2, 9]])).shape == (2, 4, 32)
    assert seen == [3, 4, 4]  # the class token joins after the embedding


def test_tokens_know_their_places():
    vit, image = small(depth=1), torch.full((1, 16, 16, 3), 90, dtype=torch.uint8)
    tokens = vit(image)[0]
    assert torch.pdist(tokens).min() > 1e-3  # the picture is uniform: only places differ
    order = torch.randperm(16).unsqueeze(0)
    torch.testing.assert_close(vit(image, order)[0], tokens[order[0]])


def test_clips_have_tubelets_and_a_single_picture_fills_one():
    vit = small(tubelet=2)
    clip = pictures(2, 6)
    assert vit(clip).shape == (2, 3 * 16, 32)
    image = pictures(2)
    torch.testing.assert_close(vit(image), vit(image.unsqueeze(1).expand(-1, 2, -1, -1, -1)))
    still = image.unsqueeze(1).expand(-1, 4, -1, -1, -1)
    tokens = vit.positions(4).unflatten(0, (2, 16))
    assert not torch.allclose(tokens[0], tokens[1])  # time is told apart
    torch.testing.assert_close(tokens[0], vit.positions(2))
    assert vit(still).isfinite().all()
    with pytest.raises(ValueError, match="tokens of"):
        vit(pictures(2, 3))


def test_smaller_pictures_lie_on_the_same_places():
    vit = small()
    assert vit(pictures(2, side=8)).shape == (2, 4, 32)
    coarse, fine = vit.positions(1, (2, 2)), vit.positions(1).view(4, 4, 32)
    own = (fine[0, 0] + fine[0, 1] + fine[1, 0] + fine[1, 1]) / 4
    distances = (coarse[0] - fine.flatten(0, 1)).norm(dim=-1)
    assert set(distances.topk(4, largest=False).indices.tolist()) == {0, 1, 4, 5}
    assert (coarse[0] - own).norm() < distances.min()


def test_weights_alone_rebuild_it():
    vit = small(cls=True, tubelet=2)
    again = ViT.from_weights(vit.state_dict())
    clip = pictures(2, 2)
    assert torch.equal(vit(clip), again(clip))


def test_sizes():
    assert vit_size("tiny") == (192, 12, 3) and vit_size("small", depth=2) == (384, 2, 6)
    with pytest.raises(ValueError, match="tiny"):
        vit_size("huge")
    for wrong in (dict(patch_size=5), dict(width=30), dict(depth=0), dict(tubelet=0)):
        with pytest.raises(ValueError):
            small(**wrong)


def test_weights_of_another_architecture_are_one_line():
    """Somebody else may have written them: nothing is built by what they claim before it is held against them."""
    weights = dict(ViT(image_size=(16, 16, 3), patch_size=8, width=16, depth=1, heads=2).state_dict())
    names, numbers = Architecture._fields, weights["architecture"].tolist()

    def claiming(**other: int) -> dict[str, torch.Tensor]:
        said = [other.get(name, number) for name, number in zip(names, numbers, strict=True)]
        return weights | {"architecture": torch.tensor(said)}

    first = next(name for name in weights if name != "architecture")
    for given, says in (
        ({name: x for name, x in weights.items() if name != first}, f"{first} holds nothing"),
        (weights | {first: torch.zeros(3)}, f"{first} holds"),
        (weights | {"other": torch.zeros(3)}, "other holds .* asks for nothing"),
        (claiming(width=4_000_000), "its architecture asks for"),
        (claiming(depth=10**9), "architecture must be height, "),
        (weights | {"architecture": torch.tensor([1, 2])}, "architecture must be height, "),
        (weights | {"architecture": torch.rand(len(names))}, "architecture must be height, "),
    ):
        with pytest.raises(ValueError, match=says) as caught:
            ViT.from_weights(given)
        assert "\n" not in str(caught.value)


# -- the decoder


def test_images_come_back_in_any_size():
    for size in ((64, 64, 3), (40, 56, 9)):
        assert ConvDecoder(7, size, channels=2)(torch.randn(2, 3, 7)).shape == (2, 3, *size)


def test_four_channels_of_a_small_image_are_a_square_of_the_larger_one():
    decoder = ConvDecoder(7, (32, 16, 3), channels=2)
    features = torch.randn(5, 7)
    x = decoder.start(features).reshape(5, 2, 1, 4)
    for norm, convolution in zip(decoder.norms, decoder.convolutions, strict=True):
        four = convolution(torch.nn.functional.silu(norm(x)).permute(0, 3, 1, 2))
        own_order = (
            four.unflatten(1, (4, -1)).transpose(1, 2).flatten(1, 2)
        )  # torch's: a channel's four, one by one
        x = torch.nn.functional.pixel_shuffle(own_order, 2).permute(0, 2, 3, 1)
    torch.testing.assert_close(decoder(features), x + 0.5)
