"""Names and values that others chose, in pictures and pages: shown as they are."""

from __future__ import annotations

import json
from typing import Any

import pytest

from franka_wm.evaluation.results import COMMAND, END
from franka_wm.report.bars import bars_figure
from franka_wm.report.curves import seeds_figure
from franka_wm.report.figure import inline_svg
from franka_wm.report.horizon import horizon_figure
from franka_wm.report.page import page
from franka_wm.report.run import RunFiles, read_run
from franka_wm.report.sections import reproduce, videos, what
from franka_wm.report.spectra import spectrum_figure

NAMES = ("_omitted", "b$x^{$", r"c\$d$")
ROWS = [{"env_steps": 1.0, "loss": 1.0}, {"env_steps": 2.0, "loss": 2.0}]


@pytest.mark.parametrize(
    "figure",
    [
        lambda: seeds_figure({name: [ROWS] for name in NAMES}, "loss"),
        lambda: spectrum_figure({name: [1.0, 0.5] for name in NAMES}),
        lambda: horizon_figure({name: {"mean": [1.0]} for name in NAMES}),
        lambda: bars_figure({name: dict.fromkeys(NAMES, 1.0) for name in NAMES}),
    ],
    ids=["curves", "spectra", "horizon", "bars"],
)
def test_names_of_runs_are_no_formulas_and_stay_in_the_legend(figure: Any) -> None:
    svg = inline_svg(figure(), "names")
    for name in NAMES:
        assert name in svg or name.replace("_", " ") in svg, name


@pytest.mark.parametrize(
    ("env", "named"),
    [
        ({"kind": "dm_control", "name": "walker", "task": "run"}, "walker run · dreamer"),
        ({"kind": "gym", "name": "CartPole-v1"}, "CartPole-v1 · dreamer"),
        ({"kind": "multitask"}, "multitask · dreamer"),
    ],
)
def test_a_page_names_a_task_with_its_domain(env: dict[str, str], named: str, tmp_path: Any) -> None:
    assert named in page(RunFiles(tmp_path, config={"env": env, "model": {"name": "dreamer"}}))


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("franka", ("evaluate", "robustness", "view")),
        ("multitask", ("evaluate",)),
        ("dm_control", ("evaluate",)),
        ("none", ()),
    ],
)
def test_a_page_names_only_commands_that_the_run_can_have(
    kind: str, said: tuple[str, ...], tmp_path: Any
) -> None:
    run = RunFiles(tmp_path, config={"env": {"kind": kind}}, counters={"updates": 1.0}, overrides=["seed=1"])
    text = reproduce(run)
    assert tuple(word for word in ("evaluate", "robustness", "view") if word in text) == said
    assert "train" in text and "resume=" in text and "report" in text


@pytest.mark.parametrize(
    ("policies", "label"),
    [
        (("noop", "policy", "planner"), "episodes of the planner"),
        (("noop", "policy"), "episodes of the policy"),
        (("expert", "noop"), "episodes of the expert"),
        (("oracle",), "episodes of the ik"),
        ((), "episodes"),
    ],
)
def test_a_film_is_said_to_be_of_whom_the_end_of_training_filmed(
    policies: tuple[str, ...], label: str, make_run
) -> None:
    """And not of whom ``franka-wm evaluate`` measured later, which makes no film."""
    run = make_run(pictures=True)
    measured = {"planner": {"return": 1.0}}
    (run / "evaluation").mkdir()
    for folder, by, some in (
        (run, END, {one: {} for one in policies}),
        (run / "evaluation", COMMAND, measured),
    ):
        (folder / "evaluation.json").write_text(json.dumps({"protocol": {"by": by}, "policies": some}))
    shown = videos(read_run(run))
    assert f'aria-label="{label}"' in shown


def test_a_configuration_of_others_is_not_parsed(tmp_path: Any) -> None:
    """An interpolation that is none ended in a traceback; one that is none of the run's would be looked up."""
    config = {"x": "${a", "y": "${oc.env:HOME}", "model": {"name": "tdmpc2", "sizes": [1, 2]}}
    text = what(RunFiles(folder=tmp_path, config=config))
    assert "${a" in text and "${oc.env:HOME}" in text and "name: tdmpc2" in text
