import pytest
import torch

from franka_wm.models.masks import SAMPLERS, make_masks

GRIDS = {"multiblock": (1, 8, 8), "tube": (4, 8, 8), "temporal": (4, 3, 5), "random": (2, 4, 4)}


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


@pytest.mark.parametrize("name", SAMPLERS)
def test_nothing_is_both_seen_and_predicted_and_shapes_never_vary(name):
    grid = GRIDS[name]
    sampler = make_masks(name, grid)
    shapes = set()
    for _ in range(3):
        masks = sampler(50, "cpu")
        shapes.add((masks.context.shape, masks.targets.shape))
        for context, targets in zip(masks.context, masks.targets, strict=True):
            seen = set(context.tolist())
            assert len(seen) == context.numel() > 0  # each once
            for group in targets:
                assert len(set(group.tolist())) == group.numel() > 0
            assert not seen & set(targets.flatten().tolist())
            assert max(seen | set(targets.flatten().tolist())) < grid[0] * grid[1] * grid[2]
    assert len(shapes) == 1
    first, second = sampler(50, "cpu"), sampler(50, "cpu")
    assert not torch.equal(first.targets, second.targets)


def test_multiblock_targets_are_blocks():
    masks = make_masks("multiblock", (1, 8, 8))(200, "cpu")
    assert masks.targets.shape == (200, 4, 11)  # 0.175 of 64
    rows, columns = masks.targets // 8, masks.targets % 8
    area = (rows.amax(-1) - rows.amin(-1) + 1) * (columns.amax(-1) - columns.amin(-1) + 1)
    assert (
        area.float().mean() < 14
    )  # 11 tokens within little more than 11 places; scattered ones span about 50
    assert area.max() <= 20
    counts = torch.zeros(64).index_add_(0, masks.targets.flatten(), torch.ones(masks.targets.numel()))
    assert (counts > 0).all()  # everywhere in the picture


def test_blocks_and_tubes_go_through_time():
    masks = make_masks("tube", (4, 8, 8), ratio=0.75)(20, "cpu")
    assert masks.context.shape == (20, 4 * 16) and masks.targets.shape == (20, 1, 4 * 48)
    for part in (masks.context, masks.targets.squeeze(1)):
        places = part.view(20, 4, -1) % 64
        assert (places == places[:, :1]).all()
        assert torch.equal(part.view(20, 4, -1) // 64, torch.arange(4).view(1, 4, 1).expand_as(places))


def test_temporal_masks_hide_whole_frames():
    masks = make_masks("temporal", (4, 3, 5), ratio=0.5)(50, "cpu")
    hidden = (masks.targets.squeeze(1) // 15).view(50, 2, 15)
    assert (hidden == hidden[..., :1]).all()
    assert len({tuple(row) for row in hidden[..., 0].tolist()}) > 3
    future = make_masks("temporal", (4, 3, 5), ratio=0.25, future=True)(5, "cpu")
    assert (future.targets // 15 == 3).all()


def test_what_leaves_nothing_is_refused():
    with pytest.raises(ValueError, match="available"):
        make_masks("stripes", (1, 4, 4))
    with pytest.raises(ValueError, match="context"):
        make_masks("multiblock", (1, 2, 2), target_scale=0.5)
    with pytest.raises(ValueError, match="time slots"):
        make_masks("temporal", (1, 4, 4))
    for ratio in (0.0, 1.0):
        with pytest.raises(ValueError, match="ratio"):
            make_masks("random", (1, 4, 4), ratio=ratio)
