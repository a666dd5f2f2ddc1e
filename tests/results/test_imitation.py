"""What the benchmark of LeRobot's policies asks of its programs, and what it makes of their answers; none runs."""

from __future__ import annotations

import json
import sys
from importlib import import_module
from pathlib import Path

import pytest

from forks import script, spare

TOP = Path(__file__).resolve().parents[2]


def test_each_seed_is_trained_and_judged(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(str(TOP / "benchmarks"))
    imitation, rows, asked = import_module("imitation"), [], []

    def run(program: str, *options: str) -> float:
        given = dict(option.removeprefix("--").split("=", 1) for option in options)
        asked.append((program.rpartition(".")[2], given))
        if program.endswith("eval"):
            out = Path(given["output_dir"])
            out.mkdir()
            successes = [True, False, True, True]
            info = {"per_task": [{"metrics": {"successes": successes}}], "overall": {"pc_success": 0.0}}
            (out / "eval_info.json").write_text(json.dumps(info))
        return 60.0

    monkeypatch.setattr(imitation, "run", run)
    monkeypatch.setattr(
        imitation,
        "read_provenance",
        lambda root: {"sessions": [{"command": "collect", "config": {"env": {"task": "lift"}}}]},
    )
    monkeypatch.setattr(imitation, "publish", lambda title, found, out, **kwargs: rows.extend(found))
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text('{"total_episodes": 200}')
    words = [
        "--seeds",
        "3",
        "4",
        "--device",
        "cpu",
        "--steps",
        "9",
        "--held-out",
        "4",
        "--also",
        "num_workers=0",
    ]
    monkeypatch.setattr(sys, "argv", ["imitation.py", str(tmp_path), *words])
    imitation.main()
    assert [(row["seed"], row["success [%]"], row["training [s]"]) for row in rows] == [
        (3, 75.0, 60.0),
        (4, 75.0, 60.0),
    ]
    assert all((row["dataset"], row["episodes"]) == ("collect", 200) for row in rows)
    assert [program for program, _ in asked] == ["lerobot_train", "lerobot_eval"] * 2
    (_, trained), (_, judged) = asked[2:]
    assert trained["seed"] == "4" and trained["steps"] == "9" and trained["num_workers"] == "0"
    assert trained["dataset.root"] == judged["env.dataset"] == str(tmp_path)
    assert judged["policy.path"].startswith(trained["output_dir"])
    assert judged["eval.n_episodes"] == judged["eval.batch_size"] == "4"


def test_a_folder_that_is_no_dataset(tmp_path: Path) -> None:
    """As a program: beside it lies a file called lerobot.py, which must not be taken for LeRobot."""
    done = spare().fork(script(TOP / "benchmarks" / "imitation.py", str(tmp_path)), TOP)
    assert done.returncode == 2 and "was not written by franka-wm" in done.stderr


@pytest.mark.parametrize("kind", ["act", "diffusion"])
def test_lerobot_knows_the_options(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    configs = pytest.importorskip("lerobot.configs.policies").PreTrainedConfig
    draccus = pytest.importorskip("draccus")
    import_module(f"lerobot.policies.{kind}.configuration_{kind}")
    monkeypatch.syspath_prepend(str(TOP / "benchmarks"))
    options = import_module("imitation").POLICIES[kind]
    assert all(option.startswith("--policy.") for option in options)
    words = [option.replace("--policy.", "--", 1) for option in options]
    draccus.parse(configs.get_choice_class(kind), args=[*words, "--device=cpu"])
