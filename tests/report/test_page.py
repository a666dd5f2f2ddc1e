"""A run's page and the comparison: what is there is shown, nothing else is, and nothing is fetched from elsewhere."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from franka_wm.commands import main as cli
from franka_wm.errors import UserError
from franka_wm.evaluation.results import COMMAND
from franka_wm.report import document
from franka_wm.report.compare import compare_page, differences, repetitions, unique_names
from franka_wm.report.page import page, write_page
from franka_wm.report.run import csv_rows, read_run
from franka_wm.versions import versions, write_versions
from tests.report.conftest import extras, policy

VOID = {"meta", "img", "br", "hr", "link", "input"}


class Reader(HTMLParser):
    """Sections, links and text of a page; complains about tags that are not closed in order."""

    def __init__(self, text: str):
        super().__init__()
        self.open: list[str] = []
        self.sections: list[str] = []
        self.links: list[tuple[str, str, str]] = []
        self.text = ""
        self.feed(text)
        assert not self.open, f"left open: {self.open}"

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)
        values = dict(attrs)
        if tag == "section":
            self.sections.append(values["id"])
        for name in ("src", "href", "poster", "xlink:href", "data"):
            if values.get(name):
                self.links.append((tag, name, values[name]))

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" not in self.open:
            self.text += data


def read(run: Path) -> Reader:
    return Reader(page(read_run(run)))


def check_self_contained(text: str) -> None:
    reader = Reader(text)
    for tag, name, value in reader.links:
        assert value.startswith(("data:", "#")), f"{tag} {name}={value[:60]}"
    targets = set(re.findall(r'\bid="([^"]+)"', text))
    assert {v[1:] for _, _, v in reader.links if v.startswith("#")} <= targets
    assert "<script" not in text and "@import" not in text and not re.search(r"url\((?!#)", text)
    assert "default-src 'none'" in text  # and if all that were wrong, a browser would still not go there


# -- a run's page ----------------------------------------------------------------------------------------


def test_a_full_page_has_every_section_and_needs_nothing_else(make_run) -> None:
    run = make_run(more=extras(), pictures=True)
    text = page(read_run(run))
    check_self_contained(text)
    reader = Reader(text)
    assert reader.sections == [
        "result",
        "curves",
        "videos",
        "imagined",
        "horizon",
        "probes",
        "latents",
        "calibration",
        "robustness",
        "health",
        "what",
        "reproduce",
    ]
    assert [v for tag, _, v in reader.links if tag == "a"] == [f"#{name}" for name in reader.sections]
    kinds = [v.split(";")[0] for _, name, v in reader.links if name == "src"]
    assert kinds.count("data:video/mp4") == 2 and "data:image/png" in kinds
    assert "the latents have collapsed <to a point>" in reader.text  # escaped, and read back
    for words in (
        "reach, fixed goal · tdmpc2 · seed 0",
        "2.00",
        "(1.80 – 2.20)",
        "noop: does nothing",
        "breaks",
    ):
        assert words in reader.text


def test_sections_appear_only_with_their_data(make_run) -> None:
    assert read(make_run("plain")).sections == ["result", "curves", "health", "what", "reproduce"]
    assert read(make_run("unlogged", rows=False)).sections == ["result", "what", "reproduce"]
    everything = extras()
    sections = {
        "open_loop": "horizon",
        "probes": "probes",
        "spectrum": "latents",
        "calibration": "calibration",
        "robustness": "robustness",
        "health": "health",
    }
    for entry, section in sections.items():
        found = read(make_run(entry, rows=False, more={entry: everything[entry]})).sections
        assert found == sorted(
            ["result", section, "what", "reproduce"],
            key=["result", section, "what", "reproduce"].index,
        )
        # Empty, as for families that have no such thing.
        assert section not in read(make_run(f"no-{entry}", rows=False, more={entry: {}})).sections


def test_the_page_says_how_to_do_it_again(make_run) -> None:
    run = make_run()
    hydras = "hydra: {overrides: {hydra: [hydra.mode=RUN, 'hydra.searchpath=[file://my]']}}"
    (run / ".hydra" / "hydra.yaml").write_text(hydras)
    text = read(run).text
    assert "franka-wm train env=reach_fixed seed=0 'note=a b' 'hydra.searchpath=[file://my]'\n" in text
    assert f"franka-wm report {run}" in text


def test_the_page_of_a_resumed_run_with_plugins_says_commands_that_work(make_run) -> None:
    run = make_run()
    (run / ".hydra" / "overrides.yaml").write_text("- resume=/before\n- scale=laptop\n- plugins=[mine]\n")
    config = run / "config.yaml"
    config.write_text(config.read_text() + "\nplugins: [mine]\n")
    checkpoint(run)
    text = read(run).text
    assert "franka-wm train resume=/before 'plugins=[mine]'" in text
    for words in (
        f"franka-wm evaluate {run} robustness=true 'plugins=[mine]'",
        f"franka-wm view checkpoint={run} 'plugins=[mine]'",
        f"franka-wm train resume={run} 'plugins=[mine]'",
    ):
        assert words in text, text[-900:]


@pytest.mark.parametrize("episodes", [2, 128])
def test_of_two_results_the_one_with_more_episodes_is_shown_and_the_other_named(
    episodes: int, make_run, capsys
) -> None:
    """A small one of the command does not replace what the end of training found over 100."""
    run, other = make_run(distance=0.5), make_run("other")
    (run / "evaluation").mkdir()
    theirs = {"planner": policy(0.03) | {"episodes": episodes}}
    result = {"policies": theirs, "protocol": {"by": COMMAND}, "probes": {"joints": {"ridge": 0.91}}}
    (run / "evaluation" / "evaluation.json").write_text(json.dumps(result))
    timing = {"planner": {"seconds_per_decision": 0.0123, "worlds": 64}}
    (run / "evaluation" / "timing.json").write_text(json.dumps(timing))
    found = read_run(run)
    shown = 0.03 if episodes == 128 else 0.5
    assert found.policies["planner"]["final_distance"]["mean"] == shown
    assert found.extras == {"probes": {"joints": {"ridge": 0.91}}}  # the command alone looks for them
    command, end = f"franka-wm evaluate, {episodes} episodes", "the end of training, 100 episodes"
    first, second = (command, end) if episodes == 128 else (end, command)
    reader = Reader(page(found))
    assert "12.30" in reader.text and "64" in reader.text
    assert f"Measured by {first}" in reader.text and f"Also measured, by {second}" in reader.text
    assert f"episodes={episodes} robustness=true" in reader.text or not found.counters
    text = Reader(compare_page([found, read_run(other)])).text
    assert f"{100 * shown:.2f}" in text and first in text and second in text
    cli.main(["summary", str(run)])
    said = capsys.readouterr().out
    assert f"1 run of {max(episodes, 100)} episodes" in said and f"measured by {first.split(',')[0]};" in said


def test_the_curves_last_point_is_the_end_of_training(make_run) -> None:
    """Once: a logger's files hold it already, a checkpoint's rows do not."""
    run = make_run(rows=False)
    config = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(config + "evaluation: {during: [planner], during_episodes: 16}\n")
    last = {
        "eval/planner/final_distance": 0.02,
        "eval/planner/success": 0.5,
        "eval/planner/return": -2.0,
        "updates": 300,
        "env_steps": 3000,
        "time_s": 30.0,
    }
    assert read_run(run).rows == [last]
    text = Reader(page(read_run(run))).text
    assert "The last points are what the end of training measured over 100 episodes" in text
    assert "over 16 of these" in text
    for name, value in last.items():
        if name.startswith("eval/"):
            path = run / "csv" / "scalars" / f"{name}.csv"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"200,9.0\n300,{value}\n")
    rows = read_run(run).rows
    assert [row["updates"] for row in rows] == [200, 300]
    (run / "evaluation" / "x").mkdir(parents=True)
    many = {"policies": {"planner": policy(0.9) | {"episodes": 500}}, "protocol": {"by": COMMAND}}
    (run / "evaluation" / "evaluation.json").write_text(json.dumps(many))
    assert read_run(run).rows == rows  # of other episodes


def checkpoint(run: Path) -> Path:
    import torch

    from franka_wm.training.checkpoint import save_checkpoint

    return save_checkpoint(
        run / "checkpoints" / "latest",
        model=torch.nn.Linear(2, 2),
        config={"seed": 0},
        counters={"updates": 900, "env_steps": 7360, "seconds": 30.2},
        extra={"rows": [{"env_steps": 10, "updates": 1, "loss": 0.5}]},
    )


def test_a_run_whose_checkpoint_is_damaged_has_a_page_that_says_so(make_run) -> None:
    run = make_run()
    rows = read_run(run).rows
    weights = checkpoint(run) / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1] + b"x")
    found = read_run(run)
    assert found.rows == rows and "is damaged" in found.damage
    assert found.damage in read(run).text


def test_a_checkpoints_rows_and_counters_are_read(make_run) -> None:
    run = make_run(rows=False)
    checkpoint(run)
    found = read_run(run)
    assert found.rows == [{"env_steps": 10, "updates": 1, "loss": 0.5}]
    text = Reader(page(found)).text
    assert "7.36 k" in text and "900" in text and "30 s" in text
    assert "0.5" in text


def test_what_is_too_large_stays_beside_the_page(make_run, monkeypatch) -> None:
    run = make_run(pictures=True)
    monkeypatch.setattr(document, "LARGEST", 10)
    reader = read(run)
    assert "video.mp4 (0 MiB) lies beside this page" in reader.text
    assert not [v for _, name, v in reader.links if name == "src"]


def test_names_of_a_run_cannot_break_the_page(make_run) -> None:
    run = make_run("<script>alert(1)<&'\"")
    text = page(read_run(run))
    check_self_contained(text)
    assert "<script>alert(1)<&'\"" in Reader(text).text


def test_writing_is_atomic(make_run, tmp_path: Path, monkeypatch) -> None:
    run = make_run()
    path = write_page(run)
    assert path == run / "report.html" and path.read_text().endswith("</html>\n")
    before = path.read_text()

    def fail(self, target):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", fail)
        with pytest.raises(UserError, match="No space left"):
            write_page(run)
    assert path.read_text() == before
    assert not list(run.glob("*.writing"))
    assert page(read_run(run)) == before  # the same run gives the same page
    with pytest.raises(UserError, match=r"must end in \.html"):
        write_page(run, tmp_path / "page.txt")


def test_the_verb_writes_and_says_where(make_run, tmp_path: Path, capsys) -> None:
    run = make_run()
    assert cli.main(["report", str(run), f"out={tmp_path / 'a' / 'page.html'}"]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "a" / "page.html")
    assert (tmp_path / "a" / "page.html").exists() and not (run / "report.html").exists()
    assert cli.main(["report", "--help"]) == 0
    assert "usage: franka-wm report RUN" in capsys.readouterr().out
    for arguments, says in (
        (["report", "out=x.html"], "report: give RUN"),
        (["report", str(tmp_path / "nowhere")], "is not a folder"),
        (["report", str(tmp_path / "a")], "holds neither config.yaml nor evaluation.json"),
        (["report", str(run), "ot=x.html"], "report: ot: no such option; did you mean out?"),
    ):
        assert cli.main(arguments) == 1
        assert says in capsys.readouterr().err


# -- reading -----------------------------------------------------------------------------------------------


def test_damaged_files_are_named(make_run) -> None:
    run = make_run()
    (run / "evaluation.json").write_text("{")
    with pytest.raises(UserError, match=r"evaluation\.json cannot be read"):
        read_run(run)
    (run / "evaluation.json").write_text("[]")
    with pytest.raises(UserError, match="holds no object"):
        read_run(run)
    run = make_run("other")
    (run / "config.yaml").write_text("a: [")
    with pytest.raises(UserError, match=r"config\.yaml cannot be read"):
        read_run(run)
    (run / "csv" / "scalars" / "loss_value.csv").write_text("1,2\nthree\n")
    with pytest.raises(UserError, match=r"loss_value\.csv, line 2: 'three'"):
        csv_rows(run / "csv" / "scalars")


def test_rows_of_csv_files_are_put_together_by_step(make_run) -> None:
    rows = read_run(make_run()).rows
    assert rows[0] == {
        "updates": 100,
        "loss_value": 1.0,
        "eval/planner/final_distance": 0.3,
        "grad_norm_model": 1.0,
    }
    assert [row["updates"] for row in rows] == [100, 200, 300]


def test_results_of_an_older_form_are_refused_in_one_line(make_run, capsys) -> None:
    run = make_run()
    for old in ({"planner": policy(0.1)}, {"policies": {"planner": policy(0.1)}}):
        (run / "evaluation.json").write_text(json.dumps(old))
        assert cli.main(["report", str(run)]) == 1
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and "evaluation.json is of an older form" in said and "evaluate" in said
    (run / "evaluation.json").write_text('{"protocol": {}, "policies": {"planner": 1}}')
    with pytest.raises(UserError, match="an object for each policy"):
        read_run(run)


def test_policies_of_earlier_versions_have_their_present_names(make_run, tmp_path: Path) -> None:
    run = make_run()
    found = json.loads((run / "evaluation.json").read_text())
    found["policies"]["oracle"] = policy(0.01)
    found["robustness"] = {"camera": {"oracle": {"final_distance": policy(0.01)["final_distance"]}}}
    (run / "evaluation.json").write_text(json.dumps(found))
    assert "ik" in read_run(run).policies and "oracle" not in read_run(run).policies
    text = read(run).text
    assert "oracle" not in text and "ik: inverse kinematics" in text


def test_logged_numbers_have_the_units_of_the_tables(make_run) -> None:
    run = make_run(distance=0.02)
    name = "<b>x</b>".replace("/", "")
    (run / "csv" / "scalars" / f"{name}.csv").write_text("100,1\n")
    text = page(read_run(run))
    assert "final distance to the goal [cm], planner" in text and "2 – 30" in Reader(text).text
    assert "<b>" not in text and "<b>x<b>" in Reader(text).text


def test_versions_are_written_and_shown(make_run) -> None:
    import torch

    run = make_run()
    told = json.loads(write_versions(run, "cpu").read_text())
    assert {name: told[name] for name in told if name != "started"} == versions("cpu")
    assert (told["torch"], told["device"]) == (torch.__version__, "cpu") or told["torch"] in torch.__version__
    assert told["torch"] in read(run).text


# -- comparing ---------------------------------------------------------------------------------------------


def test_differences_are_found_at_any_depth() -> None:
    configs = {
        "a": {"env": {"task": "reach", "goal": [1, 2]}, "seed": 0, "same": 1},
        "b": {"env": {"task": "track", "goal": [1, 2]}, "seed": 1, "same": 1, "new": {}},
    }
    assert differences(configs) == {
        "env.task": {"a": "reach", "b": "track"},
        "seed": {"a": 0, "b": 1},
        "new": {"b": {}},
    }
    assert differences({"a": {"x": 1}, "b": {"x": 1}}) == {}
    assert differences({"a": {"x": 1}, "b": {"x": True}}) == {"x": {"a": 1, "b": True}}


def test_runs_that_differ_in_their_seed_alone_are_repetitions(make_run) -> None:
    runs = [read_run(make_run(f"s{k}", seed=k)) for k in range(2)] + [read_run(make_run("lr", lr=1e-3))]
    groups = repetitions(dict(zip(unique_names(runs), runs, strict=True)))
    assert {name: list(group) for name, group in groups.items()} == {"s0": ["s0", "s1"], "lr": ["lr"]}


def test_names_are_as_long_as_it_takes(make_run) -> None:
    runs = [read_run(make_run(name)) for name in ("reach/one", "track/one")]
    assert unique_names(runs) == ["reach/one", "track/one"]
    with pytest.raises(UserError, match="given twice"):
        unique_names([runs[0], runs[0]])


def test_the_comparison_shows_results_curves_and_what_differs(make_run, tmp_path: Path, capsys) -> None:
    runs = [
        make_run("s0", seed=0, distance=0.031, more=extras()),
        make_run("s1", seed=1, distance=0.042, more=extras()),
        make_run("lr", lr=1e-3, distance=0.053),
    ]
    out = tmp_path / "c.html"
    assert cli.main(["compare", *map(str, runs), f"out={out}"]) == 0
    assert capsys.readouterr().out.strip() == str(out)
    check_self_contained(out.read_text())
    reader = Reader(out.read_text())
    assert reader.sections == ["result", "curves", "horizon", "latents", "config", "reproduce"]
    for words in ("3.10", "4.20", "5.30", "3 runs in 2 groups", "s0 (2 runs)", "trainer.lr", "0.001"):
        assert words in reader.text
    assert "env.task" not in reader.text  # the same in all
    (curveless := make_run("unlogged", rows=False, distance=0.06)).joinpath("evaluation.json").unlink()
    both = Reader(compare_page([read_run(runs[0]), read_run(curveless)])).text
    assert "Without curves, since nothing was logged: unlogged." in both
    plain = Reader(compare_page([read_run(make_run("p", rows=False)), read_run(make_run("q", rows=False))]))
    assert plain.sections == ["result", "config", "reproduce"]
    assert "the configurations are the same" in plain.text


def test_runs_of_several_families_begin_with_a_table_of_tasks(make_run) -> None:
    other = make_run("other")
    config = other / "config.yaml"
    config.write_text(config.read_text().replace("tdmpc2", "dreamer"))
    reader = Reader(compare_page([read_run(make_run()), read_run(other)]))
    assert reader.sections[0] == "tasks"
    for words in ("dreamer", "reach_fixed", "50 % within 5 cm"):
        assert words in reader.text


def test_a_sweep_is_compared_by_its_runs(make_run, tmp_path: Path, capsys) -> None:
    runs = [make_run(f"sweep/{k}-reach", seed=k, distance=k / 100) for k in (1, 2, 3)]
    (runs[0].parent / "multirun.yaml").touch()
    (runs[1] / "evaluation.json").unlink()
    out = tmp_path / "c.html"
    assert cli.main(["compare", str(runs[0].parent), f"out={out}"]) == 0
    assert "1 of 3 runs have no result (yet; train.log says more): 2-reach" in capsys.readouterr().out
    assert "1-reach (2 runs)" in Reader(out.read_text()).text


def test_comparing_needs_runs(make_run, capsys) -> None:
    assert cli.main(["compare", str(make_run())]) == 1
    assert "at least two runs, got 1" in capsys.readouterr().err
