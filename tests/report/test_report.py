"""Figures, videos and tables: what comes out is read back and compared with what went in."""

import math
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import pytest
import torch
from PIL import Image

from franka_wm.errors import UserError
from franka_wm.files import atomic_write
from franka_wm.report import style
from franka_wm.report.curves import plot_learning_curves
from franka_wm.report.run import read_run
from franka_wm.report.table import evaluation_tables, markdown
from franka_wm.video import tile_frames, write_gif, write_png, write_video

# -- video -----------------------------------------------------------------------------------------------


def moving_square(t: int = 12, height: int = 64, width: int = 96) -> torch.Tensor:
    """A white square crosses a dark blue picture, 4 pixels per frame. Returns (t, height, width, 3) uint8."""
    frames = torch.zeros(t, height, width, 3, dtype=torch.uint8)
    frames[..., 2] = 90
    for i in range(t):
        frames[i, 20:44, 4 * i : 4 * i + 24] = 255
    return frames


def test_video_decodes_to_the_frames_that_were_written(tmp_path: Path) -> None:
    frames = moving_square()
    path = write_video(frames, tmp_path / "new" / "folder" / "a.mp4", fps=25)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert stream.average_rate == 25
        decoded = np.stack([f.to_ndarray(format="rgb24") for f in container.decode(stream)])
    assert decoded.shape == frames.shape
    # Each decoded frame resembles its own original, and no neighbour's, more than compression blurs it.
    error = np.abs(decoded.astype(int) - frames.numpy().astype(int)).mean(axis=(1, 2, 3))
    shifted = np.abs(decoded[1:].astype(int) - frames[:-1].numpy().astype(int)).mean(axis=(1, 2, 3))
    assert error.max() < 4 < shifted.min()


@pytest.mark.parametrize(
    ("frames", "name", "fps", "says"),
    [
        (torch.zeros(2, 63, 64, 3, dtype=torch.uint8), "a.mp4", 10, "63 × 64.*even"),
        (torch.zeros(2, 64, 64, 3), "a.mp4", 10, "uint8"),
        (torch.zeros(2, 3, 64, 64, dtype=torch.uint8), "a.mp4", 10, "height, width, 3"),
        (torch.zeros(0, 64, 64, 3, dtype=torch.uint8), "a.mp4", 10, "at least one"),
        (moving_square(), "a.avi", 10, r"end in \.mp4"),
        (moving_square(), "a.mp4", 0, "fps is 0"),
    ],
)
def test_video_refuses_what_it_cannot_write(tmp_path: Path, frames, name: str, fps: int, says: str) -> None:
    with pytest.raises(UserError, match=says):
        write_video(frames, tmp_path / name, fps=fps)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_video_leaves_the_earlier_one_and_nothing_else(tmp_path: Path, monkeypatch) -> None:
    path = write_video(moving_square(), tmp_path / "a.mp4", fps=25)
    before = path.read_bytes()

    def fail(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(av, "VideoFrame", SimpleNamespace(from_ndarray=fail))
    with pytest.raises(UserError, match="No space left"):
        write_video(moving_square(), path, fps=25)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_tiles_lie_row_by_row_and_the_rest_is_black() -> None:
    frames = torch.arange(1, 6, dtype=torch.uint8).view(1, 5, 1, 1, 1).expand(2, 5, 4, 6, 3)
    tiled = tile_frames(frames, columns=3)
    assert tiled.shape == (2, 8, 18, 3)
    expected = torch.tensor([[1, 2, 3], [4, 5, 0]], dtype=torch.uint8)
    assert torch.equal(tiled[1, ::4, ::6, 0], expected)
    assert torch.equal(tiled[0, :4, 6:12], frames[0, 1])
    assert tile_frames(frames).shape == (2, 8, 18, 3)  # as square as possible: 3 columns
    assert tile_frames(frames, columns=9).shape == (2, 4, 30, 3)
    with pytest.raises(UserError, match="columns is 0"):
        tile_frames(frames, columns=0)
    with pytest.raises(UserError, match="T, N, H, W, 3"):
        tile_frames(frames[0], columns=2)


def test_gif_and_png_hold_the_pictures(tmp_path: Path) -> None:
    frames = moving_square(t=5, height=33, width=47)  # odd sizes are fine here
    with Image.open(write_gif(frames, tmp_path / "a.gif", fps=10)) as gif:
        assert (getattr(gif, "n_frames", 1), gif.size, gif.info["duration"]) == (5, (47, 33), 100)
        gif.seek(4)
        assert np.abs(np.asarray(gif.convert("RGB"), int) - frames[4].numpy().astype(int)).mean() < 4
    with Image.open(write_png(frames[2], tmp_path / "a.png")) as png:
        assert np.array_equal(np.asarray(png), frames[2].numpy())
    with pytest.raises(UserError, match=r"end in \.png"):
        write_png(frames[2], tmp_path / "a.jpg")


# -- learning curves ---------------------------------------------------------------------------------------


def logged_rows() -> list[dict[str, float]]:
    """What a short training run logs: losses at every row, evaluations at every fifth."""
    rows = []
    for i in range(1, 41):
        row = {
            "env_steps": 1000.0 * i,
            "train/success": min(1.0, i / 30),
            "loss_consistency": 0.5 / i,
            "loss_policy": -0.1 * i,
        }
        if i % 5 == 0:
            row |= {"eval/planner/final_distance": 0.25 / i, "eval/planner/success": min(1.0, i / 20)}
        rows.append(row)
    return rows


def test_curves_are_drawn_and_are_not_blank(tmp_path: Path) -> None:
    path = plot_learning_curves(logged_rows(), tmp_path / "plots" / "curves.png")
    with Image.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB"))
    assert pixels.shape[1] > 1200
    blue = np.array([int(style.BLUE[i : i + 2], 16) for i in (1, 3, 5)])
    for panel in (
        pixels[:, : pixels.shape[1] // 3],
        pixels[:, pixels.shape[1] // 3 : 2 * pixels.shape[1] // 3],
    ):
        # The planner's curve is there, in the planner's colour, in the distance and in the success panel.
        assert (np.abs(panel.astype(int) - blue).max(axis=-1) < 8).sum() > 100


def test_curves_show_the_values_in_the_units_they_name(tmp_path: Path, monkeypatch) -> None:
    from matplotlib.axes import Axes

    drawn: dict[str, tuple[list[float], list[float]]] = {}
    plot = Axes.plot

    def record(self, xs, ys, **kwargs):
        drawn[f"{len(self.figure.axes)}:{self.figure.axes.index(self)}:{kwargs['label']}"] = (
            list(xs),
            list(ys),
        )
        return plot(self, xs, ys, **kwargs)

    monkeypatch.setattr(Axes, "plot", record)
    rows = logged_rows()
    rows[9]["eval/planner/success"] = math.nan
    plot_learning_curves(list(reversed(rows)), tmp_path / "a.svg")
    xs, ys = drawn["3:0:planner"]
    assert xs == [5000.0 * k for k in range(1, 9)]  # sorted, and only where an evaluation was logged
    assert ys[0] == pytest.approx(5.0)  # 0.05 m in cm
    assert drawn["3:1:planner"][1][0] == pytest.approx(25.0)
    assert math.isnan(drawn["3:1:planner"][1][1])
    assert drawn["3:1:while collecting"][1][-1] == pytest.approx(100.0)
    assert drawn["3:2:policy"][1][0] == pytest.approx(-0.1)


def test_success_has_no_panel_where_nothing_tells_it(tmp_path: Path, monkeypatch) -> None:
    from franka_wm.report import curves

    drawn = []
    monkeypatch.setattr(curves, "save_figure", lambda figure, path: drawn.append(figure))
    rows = [{"env_steps": 100.0 * k, "eval/planner/return": float(k), "loss_value": 1.0} for k in range(3)]
    plot_learning_curves(rows, tmp_path / "a.png")
    assert [axes.get_title() for axes in drawn[0].axes] == ["return of an episode", "losses"]


def test_curves_can_be_drawn_before_anything_but_time_was_logged(tmp_path: Path) -> None:
    assert plot_learning_curves([{"time_s": 1.0}], tmp_path / "a.png", x="time_s").stat().st_size > 1000


@pytest.mark.parametrize(
    ("rows", "name", "says"),
    [
        ([], "a.png", "no logged row has 'env_steps'"),
        ([{"updates": 1.0}], "a.png", "no logged row has 'env_steps'"),
        (logged_rows(), "a.bmp", r"must end in \.pdf, \.png, \.svg"),
    ],
)
def test_curves_refuse_what_they_cannot_draw(tmp_path: Path, rows, name: str, says: str) -> None:
    with pytest.raises(UserError, match=says):
        plot_learning_curves(rows, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_an_unwritable_place_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(UserError, match=r"cannot write .*file/a\.png"):
        plot_learning_curves(logged_rows(), tmp_path / "file" / "a.png")
    assert (tmp_path / "file").read_text() == "no folder"


def test_an_interrupted_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_write(path) as temporary:
        temporary.write_text("ne")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_two_who_write_one_file_at_once_do_not_mix(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with atomic_write(path) as mine:
        mine.write_text("mine, longer")
        with atomic_write(path) as other:
            other.write_text("other")
        assert path.read_text() == "other"
    assert path.read_text() == "mine, longer"
    assert list(tmp_path.iterdir()) == [path]


# -- tables ------------------------------------------------------------------------------------------------


def interval(mean: float) -> dict[str, float]:
    return {"mean": mean, "low": 0.5 * mean, "high": 1.5 * mean}


def evaluation() -> dict[str, dict]:
    return {
        policy: {
            "final_distance": interval(distance),
            "success": {"0.01": interval(0.1), "0.05": interval(0.6), "0.025": interval(0.4)},
            "return": interval(-3.0),
            "episodes": 64,
        }
        for policy, distance in (("planner", 0.0212), ("noop", 0.2455), ("mine", 0.1))
    }


def test_markdown_has_units_order_and_intervals() -> None:
    lines = markdown(evaluation_tables(evaluation())[0]).splitlines()
    assert lines[0] == (
        "| policy | final distance [cm] | success at 5 cm [%] | success at 2.5 cm [%] "
        "| success at 1 cm [%] | return | episodes |"
    )
    assert lines[1].count("|") == lines[0].count("|")
    assert lines[2] == (
        "| planner | 2.12 (1.06 – 3.18) | 60 (30 – 90) | 40 (20 – 60) | 10 (5 – 15) "
        "| -3.00 (-1.50 – -4.50) | 64 |"
    )
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| planner", "| noop", "| mine"]


def test_policies_that_are_compared_have_different_colours() -> None:
    assert len(set(style.POLICY_COLOURS.values())) == len(style.POLICY_COLOURS)
    assert style.POLICY_COLOURS.keys() == {*style.POLICY_LEGEND, "train"}


@pytest.mark.parametrize("told", ["[1]", "hydra: {overrides: [1]}", "hydra: {overrides: {hydra: null}}"])
def test_a_foreign_runs_search_path_may_have_any_form(told: str, make_run) -> None:
    run = make_run()
    (run / ".hydra" / "hydra.yaml").write_text(told)
    assert not any("searchpath" in one for one in read_run(run).overrides)
