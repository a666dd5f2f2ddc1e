import pytest
import torch

from franka_wm.models.masks import ASPECT, CONTEXT, SAMPLERS, TUBES, make_masks

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


def rectangles(area, aspect, count=4000, grid=(1, 16, 16)):
    """Rows and columns that blocks of this area and aspect cover, (count, first … last) of each."""
    near = make_masks("tube", grid)._distances(count, 1, area, aspect, "cpu").squeeze(1) < 0.5
    near = near.view(count, *grid[1:])
    rows, columns = near.any(2).float(), near.any(1).float()
    whole = (near == (rows.unsqueeze(2) * columns.unsqueeze(1)).bool()).flatten(1).all(1)
    assert whole.float().mean() > 0.99  # rectangles without holes, but for what breaks ties at an edge
    return rows, columns


@pytest.mark.parametrize(
    ("aspect", "height", "width"), [(4.0, 8, 2), (0.25, 2, 8), (1.0, 4, 4), (100.0, 16, 1)]
)
def test_blocks_have_the_area_and_aspect_that_was_asked_for(aspect, height, width):
    rows, columns = rectangles(16.0, (aspect, aspect))
    # A block begins between two rows; one row more or less is rounding, none on average.
    assert rows.sum(1).mean().item() == pytest.approx(height, abs=0.1)
    assert columns.sum(1).mean().item() == pytest.approx(width, abs=0.1)
    assert (rows.sum(1) - height).abs().max() <= 1 and (columns.sum(1) - width).abs().max() <= 1


def test_aspects_are_drawn_evenly_between_their_bounds_in_logarithm():
    rows, columns = rectangles(36.0, (0.25, 4.0))
    tall = (rows.sum(1) > columns.sum(1)).float().mean()
    wide = (rows.sum(1) < columns.sum(1)).float().mean()
    assert 0.35 < tall < 0.55 and 0.35 < wide < 0.55
    assert rows.sum(1).max() >= 11 and rows.sum(1).min() <= 4  # √(36 · 4) = 12, √(36 / 4) = 3


def test_blocks_lie_anywhere_whatever_their_shape():
    rows, columns = rectangles(36.0, (0.25, 4.0))
    place = torch.arange(16.0)
    row, column = ((one * place).sum(1) / one.sum(1) for one in (rows, columns))
    assert row.mean().item() == pytest.approx(7.5, abs=0.25) == column.mean().item()
    for cells in (rows, columns):
        assert (cells.sum(0) > 0).all()  # to the edges
        assert (cells.sum(0) - cells.sum(0).flip(0)).abs().max() < 0.1 * len(cells)  # as far from either edge
    drawn = torch.stack([row, column, rows.sum(1)])
    assert (torch.corrcoef(drawn) - torch.eye(3)).abs().max() < 0.08  # drawn independently


def test_ties_are_broken_at_random_and_nothing_else():
    near = make_masks("tube", (1, 4, 4))._distances(500, 1, 16.0, (1.0, 1.0), "cpu").squeeze(1)
    # The block is the whole grid: its middle is at 1.5, half a row away from places in the middle rows.
    middle = near[:, [5, 6, 9, 10]]
    assert (middle - 0.125).min() >= 0 and (middle - 0.125).max() <= 1e-4
    assert len(set(middle.argmin(1).tolist())) == 4


class Given:
    """Distances for a sampler: to the target blocks, then to the context block."""

    def __init__(self, *distances):
        self.distances = list(distances)

    def __call__(self, count, blocks, area, aspect, device):
        return self.distances.pop(0)


def multiblock_with(context, count=300):
    """Samples where both target blocks are places 0 and 1, and places lie so far from the context block."""
    sampler = make_masks("multiblock", (1, 2, 4), targets=2, target_scale=0.25)
    target = torch.arange(8.0).expand(count, 2, 8)
    sampler._distances = Given(target, torch.tensor(context).expand(count, 1, 8))
    return sampler(count, "cpu")


def test_the_context_is_drawn_from_its_block_and_then_from_beside_it():
    masks = multiblock_with([0.0, 0.1, 0.2, 0.3, 0.4, 0.502, 0.6, 0.51])
    assert (masks.targets.sort(-1).values == torch.tensor([0, 1])).all()
    assert (masks.context.sort(-1).values == torch.tensor([2, 3, 4, 5])).all()


def test_inside_its_block_the_context_is_drawn_evenly():
    masks = multiblock_with([0.0, 0.0, 0.0, 0.1, 0.2, 0.3, 0.4, 0.49], count=3000)
    counts = torch.bincount(masks.context.flatten(), minlength=8)
    assert (counts[:2] == 0).all()
    assert (counts[2:] / 3000 - 4 / 6).abs().max() < 0.04


def test_defaults_are_the_papers():
    """I-JEPA: 4 targets of 0.15 to 0.2, aspect 0.75 to 1.5, context 0.85 to 1; V-JEPA: tubes of the same shapes."""
    blocks = make_masks("multiblock", (1, 20, 20))
    assert (blocks.blocks, blocks.block, ASPECT, CONTEXT) == (4, 70, (0.75, 1.5), 0.925)
    tube = make_masks("tube", (2, 20, 20))
    assert (TUBES, tube.hidden) == (4, 300)
    assert (make_masks("temporal", (4, 2, 2)).hidden, make_masks("random", (2, 4, 4)).hidden) == (2, 24)


def test_the_smallest_that_can_be_masked():
    one = make_masks("multiblock", (1, 1, 2), targets=1, target_scale=0.5)(3, "cpu")
    assert one.context.shape == (3, 1) and one.targets.shape == (3, 1, 1)
    assert make_masks("multiblock", (1, 2, 2), targets=1, target_scale=0.01).block == 1
    two = make_masks("temporal", (2, 1, 1))(3, "cpu")
    assert two.context.shape == (3, 1) and two.targets.shape == (3, 1, 1)
    assert make_masks("tube", (1, 1, 3), ratio=0.34)(3, "cpu").targets.shape == (3, 1, 1)
    for grid in ((1, 4), (0, 4, 4)):
        with pytest.raises(ValueError, match="grid"):
            make_masks("random", grid)
    with pytest.raises(ValueError, match="leave no context"):
        make_masks("multiblock", (1, 2, 2), targets=0)


def test_each_group_of_the_clip_covers_every_slot():
    masks = make_masks("multiblock", (3, 4, 4), targets=2, target_scale=0.25)(5, "cpu")
    assert masks.targets.shape == (5, 2, 3 * 4) and masks.context.shape == (5, 3 * 8)
    places = masks.targets.view(5, 2, 3, 4)
    assert torch.equal(places - places[:, :, :1], 16 * torch.arange(3).view(1, 1, 3, 1).expand_as(places))
