"""Every kind of picture: what was drawn is read back from the figure, and the file is not blank."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from matplotlib.colors import to_hex
from PIL import Image

from franka_wm.errors import UserError
from franka_wm.evaluation.calibration import calibration_bins
from franka_wm.evaluation.projection import principal_components
from franka_wm.report import style
from franka_wm.report.bars import bars_figure
from franka_wm.report.calibration import calibration_figure
from franka_wm.report.curves import panel_figure, quantity, seed_bands, seeds_figure
from franka_wm.report.document import sparkline
from franka_wm.report.figure import inline_svg, save_figure
from franka_wm.report.frames import hide_patches, mask_figure, strip_figure
from franka_wm.report.horizon import horizon_figure
from franka_wm.report.spectra import latent_figure, spectrum_figure
from franka_wm.report.style import DARK, LIGHT, PALETTE

THEMES = {theme.name: theme for theme in (LIGHT, DARK)}


def lines(figure) -> dict[str, np.ndarray]:
    """Label -> (2, n) coordinates of the first panel's lines."""
    return {str(line.get_label()): np.array(line.get_data(), float) for line in figure.axes[0].get_lines()}


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"), int)


def has_colour(picture: np.ndarray, colour: str, at_least: int = 40) -> bool:
    wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return bool((np.abs(picture - wanted).max(-1) < 10).sum() >= at_least)


# -- colours ---------------------------------------------------------------------------------------------

# Linear RGB as seen without one kind of cone: Machado, Oliveira & Fernandes, IEEE TVCG 15 (2009), severity 1.
BLINDNESS = {
    "none": np.eye(3),
    "protan": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deutan": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritan": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}


def lab(colour: str, matrix) -> np.ndarray:
    """CIE L*a*b* (D65) of a colour as seen through the matrix."""
    srgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    linear = np.clip(np.asarray(matrix) @ linear, 0, 1)
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ linear
    f = np.cbrt(xyz / [0.9505, 1.0, 1.089])
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("kind", BLINDNESS)
@pytest.mark.parametrize("theme", THEMES.values(), ids=THEMES)
def test_colours_stay_apart_for_everybody(theme: style.Theme, kind: str) -> None:
    seen = [lab(colour, BLINDNESS[kind]) for colour in theme.palette]
    apart = min(np.linalg.norm(a - b) for i, a in enumerate(seen) for b in seen[:i])
    assert apart > 12  # some five times what one can just tell apart


@pytest.mark.parametrize("theme", THEMES.values(), ids=THEMES)
def test_text_and_lines_stand_out_from_the_ground(theme: style.Theme) -> None:
    ground = lab(theme.colour(style.PAPER), np.eye(3))[0]
    assert abs(lab(theme.colour(style.INK), np.eye(3))[0] - ground) > 70
    assert all(abs(lab(colour, np.eye(3))[0] - ground) > 25 for colour in theme.palette)


def test_themes_have_all_colours() -> None:
    assert DARK.colours.keys() == LIGHT.colours.keys() == style.NAMES.keys()


def test_many_series_differ() -> None:
    assert len({style.series_style(k) for k in range(21)}) == 21


# -- files ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("theme", THEMES.values(), ids=THEMES)
def test_a_figure_has_the_themes_ground_and_colours(tmp_path: Path, theme: style.Theme) -> None:
    figure = horizon_figure({"model": {"mean": [0.1, 0.2, 0.4]}}, theme=theme)
    picture = pixels(save_figure(figure, tmp_path / "new" / "a.png"))
    assert to_hex(picture[2, 2] / 255).upper() == theme.colour(style.PAPER)
    assert has_colour(picture, theme.colour(style.BLUE)) and has_colour(picture, theme.colour(style.INK))


def test_figures_are_saved_as_what_the_ending_says(tmp_path: Path) -> None:
    figure = horizon_figure({"model": {"mean": [0.1]}})
    assert save_figure(figure, tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")
    assert b"<svg" in save_figure(figure, tmp_path / "a.svg").read_bytes()
    with pytest.raises(UserError, match=r"must end in \.pdf, \.png, \.svg"):
        save_figure(figure, tmp_path / "a.jpg")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.pdf", "a.svg"]


def test_inline_svg_follows_the_page_and_needs_nothing_else() -> None:
    figure = bars_figure({"a": {"x": 1.0}, "b": {"x": 2.0}}, label="success & <more>")
    svg = inline_svg(figure, 'bars "a" & b')
    root = ElementTree.fromstring(svg)  # well-formed
    assert root.attrib["aria-label"] == 'bars "a" & b'
    assert "var(--blue)" in svg and "var(--font)" in svg
    assert not any(colour.lower() in svg.lower() for colour in style.NAMES)  # none is left fixed
    assert "success &amp; &lt;more>" in svg or "success &amp; &lt;more&gt;" in svg  # text stays text
    assert svg == inline_svg(figure, 'bars "a" & b')
    identities = [e.attrib["id"] for e in root.iter() if "id" in e.attrib]
    assert len(identities) == len(set(identities))


def test_pictures_on_one_page_share_no_ids() -> None:
    def ids(label: str) -> set[str]:
        svg = inline_svg(horizon_figure({"model": {"mean": [0.1, 0.2]}}), label)
        return {e.attrib["id"] for e in ElementTree.fromstring(svg).iter() if "id" in e.attrib}

    assert ids("one") and not ids("one") & ids("two")


# -- curves ------------------------------------------------------------------------------------------------


def rows(values: list[float], key: str = "eval/planner/final_distance", start: float = 0) -> list[dict]:
    return [{"env_steps": start + 100.0 * k, key: v} for k, v in enumerate(values)]


def test_bands_run_from_lowest_to_highest_of_what_all_runs_cover() -> None:
    key = "eval/planner/final_distance"
    band = seed_bands([rows([0.0, 1.0, 2.0]), rows([4.0, 3.0], start=50.0)], key, points=3)
    assert band["x"].tolist() == [50, 100, 150]  # the second run starts at 50 and ends at 150
    assert band["low"].tolist() == [0.5, 1.0, 1.5]  # in between, linearly
    assert band["high"].tolist() == [4.0, 3.5, 3.0]
    assert band["mean"].tolist() == [2.25, 2.25, 2.25]


def test_bands_of_nothing_and_of_one_place() -> None:
    assert seed_bands([], "loss")["x"].size == 0
    assert seed_bands([rows([1.0], "loss"), rows([1.0], "loss", start=500)], "loss")["x"].size == 0
    assert seed_bands([rows([1.0, math.nan], "loss")], "loss")["mean"].tolist() == [1.0]


def test_seeds_are_drawn_as_mean_and_band() -> None:
    groups = {"lewm": [rows([0.2, 0.1]), rows([0.4, 0.3])], "tdmpc2": [rows([0.3, 0.2])]}
    figure = seeds_figure(groups, "eval/planner/final_distance")
    drawn = lines(figure)
    assert list(drawn) == ["lewm (2 runs)", "tdmpc2"]
    np.testing.assert_allclose(drawn["lewm (2 runs)"][1][[0, -1]], [30, 20])  # cm
    (band,) = figure.axes[0].collections  # one run alone has none
    heights = band.get_paths()[0].vertices[:, 1]
    np.testing.assert_allclose([heights.min(), heights.max()], [10, 40])
    assert "[cm]" in figure.axes[0].get_title() and figure.axes[0].get_xlabel() == "environment steps"


def test_small_curves_have_two_points_to_a_pixel_however_long_the_run() -> None:
    rows = [math.sin(k / 5000) for k in range(100_000)]
    assert 2_000 < len(sparkline(rows, "loss")) < 10_000
    few = sparkline([0.0, 1.0, math.nan, 2.0], "loss")
    assert len(few) < 500


def test_panels_are_drawn_only_where_there_is_something() -> None:
    logged = rows([0.3, 0.1])
    panel = panel_figure(logged, "final_distance")
    assert panel is not None
    np.testing.assert_allclose(lines(panel)["planner"][1], [30, 10])
    assert lines(panel)["success: 5 cm"][1].tolist() == [5, 5]
    assert panel_figure(logged, "success") is None
    assert panel_figure(logged, "losses") is None
    assert panel_figure(logged, "gradients") is None
    norms = panel_figure(rows([1.0, 2.0], "grad_norm_model"), "gradients")
    assert norms is not None and list(lines(norms)) == ["gradient, model"]


def test_panels_of_the_same_runs_share_the_horizontal_axis() -> None:
    """Losses are logged from the start, evaluations later: side by side, the same step is at the same place."""
    logged = [*rows([0.3, 0.1], start=400), *rows([2.0, 1.0, 0.5], "loss")]
    panels = [panel_figure(logged, name) for name in ("final_distance", "losses")]
    bands = [seeds_figure({"a": [logged]}, key) for key in ("eval/planner/final_distance", "loss")]
    ranges = {figure.axes[0].get_xlim() for figure in (*panels, *bands) if figure is not None}
    assert len(ranges) == 1 and len(panels) == 2, ranges
    low, high = ranges.pop()
    assert low <= 0 and high > max(row["env_steps"] for row in logged)


# -- horizon -----------------------------------------------------------------------------------------------


def test_horizon_shows_curves_intervals_and_the_baseline() -> None:
    curves = {
        "model": {"mean": [0.1, 0.2, 0.3], "low": [0.0, 0.1, 0.2], "high": [0.2, 0.3, 0.5]},
        "no_change": {"mean": [1.0, 1.0, math.nan]},
    }
    figure = horizon_figure(curves, unit="error")
    drawn = lines(figure)
    np.testing.assert_allclose(drawn["model"], [[1, 2, 3], [0.1, 0.2, 0.3]])
    assert math.isnan(drawn["no change"][1][2])
    baseline = next(line for line in figure.axes[0].get_lines() if line.get_label() == "no change")
    assert baseline.get_linestyle() == "--" and baseline.get_color() == style.GREY
    (band,) = figure.axes[0].collections
    assert band.get_paths()[0].vertices[:, 1].max() == pytest.approx(0.5)
    assert figure.axes[0].get_ylim()[0] == 0
    assert lines(horizon_figure(curves, steps=[5, 10, 15]))["model"][0].tolist() == [5, 10, 15]


def test_horizon_refuses_what_does_not_fit() -> None:
    with pytest.raises(UserError, match="2 values of low for 3 steps"):
        horizon_figure({"model": {"mean": [1, 2, 3], "low": [1, 2], "high": [1, 2, 3]}})
    with pytest.raises(UserError, match="no horizon curve"):
        horizon_figure({})


def test_horizon_shows_lines_whose_intervals_are_far_wider() -> None:
    """The axis follows the lines, and says what it leaves out."""
    curves = {"model": {"mean": [40, 2], "low": [1, 1], "high": [5341, 9]}, "no_change": {"mean": [1, 1]}}
    axes = horizon_figure(curves).axes[0]
    assert axes.get_ylim() == (0, 60) and "intervals are cut; they reach 5,341" in axes.get_title()
    curves["model"]["high"] = [100, 9]
    axes = horizon_figure(curves).axes[0]
    assert axes.get_ylim()[1] >= 100 and "cut" not in axes.get_title()


# -- spectra -----------------------------------------------------------------------------------------------


def test_spectrum_is_relative_sorted_and_marked() -> None:
    figure = spectrum_figure({"z": [1.0, 4.0, 2.0, 0.0]}, marks={"RankMe": 2.5})
    drawn = lines(figure)
    np.testing.assert_allclose(drawn["z"], [[1, 2, 3, 4], [1, 0.5, 0.25, 1e-6]])  # zero at the scale's end
    assert drawn["RankMe 2.5"][0].tolist() == [2.5, 2.5]
    assert figure.axes[0].get_yscale() == "log"
    for bad in ({}, {"z": []}, {"z": [1, -1]}, {"z": [math.nan]}):
        with pytest.raises(UserError, match="singular values"):
            spectrum_figure(bad)


def test_principal_components_find_the_plane_that_points_lie_in() -> None:
    generator = np.random.default_rng(0)
    plane = generator.normal(size=(500, 2)) * [3.0, 1.0]
    basis = np.linalg.qr(generator.normal(size=(8, 2)))[0]
    found = principal_components(plane @ basis.T + 5.0)
    assert found.explained.sum() == pytest.approx(1.0)
    assert found.explained[0] == pytest.approx(0.9, abs=0.02)
    # A rotation at most: distances stay what they were.
    centred = plane - plane.mean(0)
    np.testing.assert_allclose(np.linalg.norm(found.points, axis=1), np.linalg.norm(centred, axis=1))
    line = principal_components(np.arange(4.0)[:, None])
    assert line.points.shape == (4, 2) and line.explained.tolist() == [1, 0]
    assert principal_components(np.ones((3, 2))).explained.tolist() == [0, 0]
    with pytest.raises(UserError, match="N ≥ 2"):
        principal_components(np.ones((1, 2)))
    with pytest.raises(UserError, match="not all finite"):
        principal_components([[1, math.nan], [0, 1]])


def test_latents_are_points_coloured_by_the_quantity() -> None:
    figure = latent_figure([[0, 1], [2, 3]], [0.1, 0.5], label="distance [m]", explained=[0.6, 0.3])
    axes, bar = figure.axes
    (points,) = axes.collections
    assert np.asarray(points.get_offsets()).tolist() == [[0, 1], [2, 3]]
    assert np.asarray(points.get_array()).tolist() == [0.1, 0.5]
    assert bar.get_ylabel() == "distance [m]" and axes.get_xlabel() == "first (60 %)"
    with pytest.raises(UserError, match=r"\(N, 2\) and \(N,\)"):
        latent_figure([[0, 1]], [1, 2], label="x")


# -- bars --------------------------------------------------------------------------------------------------


def test_bars_have_their_lengths_and_whiskers() -> None:
    values = {
        "5 cm": {"planner": {"mean": 0.5, "low": 0.4, "high": 0.7}, "noop": 0.1},
        "1 cm": {"planner": 0.2, "noop": None},
    }
    figure = bars_figure(values, scale=100, label="[%]", limits=(0, 100), colours={"noop": style.BLACK})
    axes = figure.axes[0]
    planner, noop = (c for c in axes.containers if hasattr(c, "patches"))
    assert [bar.get_width() for bar in planner] == [50, 20]
    assert [bar.get_width() for bar in noop] == [10]  # what is not known leaves a gap
    assert to_hex(noop[0].get_facecolor()) == style.BLACK
    whiskers = np.concatenate([path.vertices[:, 0] for path in axes.collections[0].get_paths()])
    assert {40.0, 70.0} <= set(whiskers.round(6))
    assert [label.get_text() for label in axes.get_yticklabels()] == ["5 cm", "1 cm"]
    assert axes.get_xlim() == (0, 100) and axes.yaxis_inverted()
    with pytest.raises(UserError, match="no bar"):
        bars_figure({"a": {"b": math.nan}})


def test_a_bar_that_the_axis_cuts_says_how_far_it_goes() -> None:
    values = {"joints": {"ridge": 0.5, "neighbours": -6.25}, "tool": {"ridge": -1.0, "neighbours": 1.5}}
    said = [text.get_text() for text in bars_figure(values, limits=(-1, 1)).axes[0].texts]
    assert said == ["← -6.25", "1.5 →"]
    assert not bars_figure(values).axes[0].texts


def test_bars_of_one_series_have_their_numbers_beyond_their_whiskers() -> None:
    values = {
        "planner": {"": {"mean": 0.004, "low": 0.003, "high": 0.01}},
        "noop": {"": 0.40617},
        "random": {"": {"mean": -12.345, "low": -13.0, "high": -11.0}},
    }
    axes = bars_figure(values, scale=100).axes[0]
    assert [(text.get_text(), text.xy) for text in axes.texts] == [
        ("0.4", (1.0, 0)),
        ("40.6", (pytest.approx(40.617), 1)),
        ("-1,234", (0.0, 2)),
    ]
    assert not bars_figure({"a": {"": 0.5}}, limits=(0, 1)).axes[0].texts


# -- calibration -------------------------------------------------------------------------------------------


def test_an_exact_value_lies_on_the_line() -> None:
    values = np.random.default_rng(0).normal(size=1000)
    bins = calibration_bins(values, values, bins=10)
    assert bins["true"] == pytest.approx(bins["predicted"])
    assert bins["count"] == [100.0] * 10
    assert bins["predicted"] == sorted(bins["predicted"])
    drawn = lines(calibration_figure(bins))
    np.testing.assert_allclose(drawn["this value"][0], drawn["this value"][1])
    np.testing.assert_allclose(drawn["perfect"][0], drawn["perfect"][1])


def test_calibration_bins_hold_means_and_the_middle_half() -> None:
    bins = calibration_bins([0, 0, 0, 0, 1, 1, 1, 1], [0, 1, 2, 3, 10, 11, 12, 13], bins=2)
    assert bins["predicted"] == [0, 1] and bins["true"] == [1.5, 11.5]
    assert bins["low"] == [0.75, 10.75] and bins["high"] == [2.25, 12.25]
    assert len(calibration_bins([1.0], [2.0])["true"]) == 1
    for bad in (([1], [1, 2]), ([], []), ([math.inf], [1])):
        with pytest.raises(UserError):
            calibration_bins(*bad)
    with pytest.raises(UserError, match="`predicted` and `true`"):
        calibration_figure({"predicted": [1.0], "true": []})


# -- frames ------------------------------------------------------------------------------------------------


def video(shade: int, t: int = 6) -> torch.Tensor:
    return torch.full((t, 8, 10, 3), shade, dtype=torch.uint8)


def test_strips_show_first_to_last_frame(tmp_path: Path) -> None:
    real = torch.arange(0, 60, 10, dtype=torch.uint8).view(6, 1, 1, 1).expand(6, 8, 10, 3)
    figure = strip_figure({"real": real, "imagined": video(200)}, columns=3)
    shown = [axes.get_images()[0].get_array() for axes in figure.axes]
    assert [int(np.asarray(picture)[0, 0, 0]) for picture in shown] == [0, 20, 50, 200, 200, 200]
    assert [axes.get_title() for axes in figure.axes[:3]] == ["t = 0", "t = 2", "t = 5"]
    assert [text.get_text() for axes in figure.axes for text in axes.texts] == ["real", "imagined"]
    assert pixels(save_figure(figure, tmp_path / "a.png")).std() > 10


def test_masks_veil_exactly_the_hidden_patches() -> None:
    frame = torch.full((8, 8, 3), 200, dtype=torch.uint8)
    hidden = torch.tensor([[True, False], [False, False]])
    seen = hide_patches(frame, hidden, keep=0.0, shade=50)
    assert (seen[:4, :4] == 50).all()
    seen[:4, :4] = 200
    assert torch.equal(seen, frame)
    assert torch.equal(hide_patches(frame, hidden.flatten()), hide_patches(frame, hidden))
    assert (hide_patches(frame, hidden, keep=0.5, shade=100)[0, 0] == 150).all()  # half shines through
    with pytest.raises(UserError, match="do not divide"):
        hide_patches(frame, torch.ones(3, 3, dtype=torch.bool))
    with pytest.raises(UserError, match="no square grid"):
        hide_patches(frame, torch.ones(5, dtype=torch.bool))
    figure = mask_figure(frame, {"context": hidden, "target": ~hidden})
    assert [axes.get_title() for axes in figure.axes] == ["frame", "context", "target"]
    assert np.asarray(figure.axes[1].get_images()[0].get_array())[0, 0, 0] < 200


def test_the_palette_is_what_series_are_drawn_in() -> None:
    drawn = horizon_figure({"a": {"mean": [1]}, "b": {"mean": [2]}}).axes[0].get_lines()
    assert [line.get_color() for line in drawn] == list(PALETTE[:2])


@pytest.mark.filterwarnings("error")
def test_many_runs_leave_room_for_their_curves(tmp_path: Path) -> None:
    runs = {
        f"{k}-reach": [[{"env_steps": 0, "loss": 1.0}, {"env_steps": 5, "loss": 0.5 + k}]] for k in range(30)
    }
    figure = seeds_figure(runs, "loss")
    save_figure(figure, tmp_path / "curves.png")
    assert len(figure.axes[0].get_lines()) == 30 and figure.axes[0].get_position().height > 0.6
    spectrum = spectrum_figure({name: [3.0, 2.0, 1.0] for name in runs})
    save_figure(spectrum, tmp_path / "spectrum.png")
    assert spectrum.axes[0].get_position().height > 0.6


@pytest.mark.filterwarnings("error")
def test_long_names_of_runs_leave_room_and_differ(tmp_path: Path) -> None:
    """As of Hydra's override_dirname; tables have them whole."""
    middle = "planner.horizon={},planner.num_samples=512,model.latent_dim=128"
    names = [f"10{k}-{middle.format(k)},seed={k % 2}" for k in range(4)] + [f"103-{middle.format(7)},seed=1"]
    bar = {"mean": 0.1, "low": 0.05, "high": 0.2}
    figure = bars_figure({name: {"": bar} for name in names}, label="distance")
    save_figure(figure, tmp_path / "bars.png")
    assert figure.axes[0].get_position().width > 0.3
    labels = [one.get_text() for one in figure.axes[0].get_yticklabels()]
    assert len({*labels}) == 5 and labels[-1].endswith("seed=1 (2)")


def test_one_of_several_tasks_success_is_in_percent_of_its_episodes() -> None:
    """`success_TASK`; other quantities as they are."""
    assert quantity("success_push") == ("successful episodes of push [%]", 100.0)
    assert quantity("cube_to_disc_m") == ("cube to disc [m]", 1.0)
    assert quantity("path_length") == ("path length", 1.0)
    rows = [{"env_steps": k, "eval/planner/success_push": 0.1 * k} for k in range(1, 4)]
    axes = seeds_figure({"a": [rows]}, "eval/planner/success_push").axes[0]
    assert axes.get_ylim() == (-3, 103) and axes.lines[0].get_ydata()[-1] == pytest.approx(30)


def test_losses_of_recorded_data_say_which_were_held_out():
    row = {"train/loss": 1.0, "train/loss_policy": 2.0, "validation/loss": 3.0, "validation/loss_policy": 4.0}
    figure = panel_figure([{"updates": 1, **row}, {"updates": 2, **row}], "losses", x="updates")
    drawn = {label: y[0] for label, (_, y) in lines(figure).items()}
    assert drawn == {"loss": 1.0, "policy": 2.0, "loss, validation": 3.0, "policy, validation": 4.0}
