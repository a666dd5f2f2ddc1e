"""``python train.py``: one run from nothing to its report, going on, Ctrl-C, and one line for what cannot be."""

from __future__ import annotations

import json
import os
import runpy
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import av
import pytest
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from forks import TRAIN, Fork, run_in_fork, script, train_in_fork
from franka_wm.commands.entry import check_command
from franka_wm.conf import run_name
from franka_wm.errors import FrankaError
from franka_wm.report.run import read_run
from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint
from franka_wm.training.history import read_rows
from franka_wm.training.place import occupied
from light import Answer, answers

LENGTH = 20
SMOKE = ["scale=smoke", "device=cpu", f"env.episode_length={LENGTH}", "env.substeps=2"]


def train(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """In a process of its own, in a folder of its own."""
    command = [sys.executable, str(TRAIN), *arguments]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=240, check=False)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """The smoke run: its folder and what it said."""
    place = tmp_path_factory.mktemp("smoke")
    done = train_in_fork(*SMOKE, f"hydra.run.dir={place}/run", cwd=place)
    assert done.returncode == 0, done.stdout + done.stderr
    return place / "run", done


# -- a run -----------------------------------------------------------------------------------------------


def test_what_it_says(run) -> None:
    folder, done = run
    lines = done.stdout.strip().splitlines()
    assert lines[-1] == f"results: {folder}"
    assert any(line.startswith("updates 30/30") for line in lines)
    assert "compiles kernels" in done.stdout
    assert "Traceback" not in done.stderr
    for noise in ("Module ", "Warp", "CUDA driver"):
        assert noise not in done.stdout + done.stderr


def test_train_log_holds_what_the_terminal_showed(run) -> None:
    """Lines of both streams in their order, those before the folder was named, tables, and the last line."""
    folder, done = run
    log = (folder / "train.log").read_text().splitlines()
    for stream in (done.stdout, done.stderr):
        rest = iter(log)
        assert all(line in rest for line in stream.splitlines())
    assert len(log) == len(done.stdout.splitlines()) + len(done.stderr.splitlines())


def test_evaluation_json(run) -> None:
    found = json.loads((run[0] / "evaluation.json").read_text())
    assert set(found) == {"protocol", "policies"}
    told, results = found["protocol"], found["policies"]
    assert (told["by"], told["task"], told["model"]) == ("the end of training", "reach", "tdmpc2")
    assert (told["planner"], told["seed"], told["episodes"], told["device"]) == ("mppi", 0, 4, "cpu")
    assert (told["updates"], told["env_steps"]) == (30, 8 * (10 + 15)) and told["training_seconds"] > 0
    assert told["hardware"].endswith(("thread", "threads")) and told["franka_wm"] and told["seeds"]
    assert set(results) == {"planner", "policy", "noop", "random", "ik"}
    for name, result in results.items():
        assert {"final_distance", "success", "return", "episodes", "success_once", "jerk"} <= set(result), (
            name
        )
        assert result["episodes"] == 4
        assert set(result["success"]) == {"0.05", "0.025", "0.01"}
        for interval in (result["final_distance"], result["return"], *result["success"].values()):
            assert set(interval) == {"mean", "low", "high"}
            assert interval["low"] <= interval["mean"] <= interval["high"]
        assert -LENGTH * 1.01 <= result["return"]["mean"] <= 0
    assert results["ik"]["final_distance"]["mean"] < 0.05 < results["noop"]["final_distance"]["mean"]


def test_the_curves_end_with_the_table(run) -> None:
    """Planner and policy, in files, on the page, and in the picture, which is drawn from the same rows."""
    folder = run[0]
    policies = json.loads((folder / "evaluation.json").read_text())["policies"]
    last = read_run(folder).rows[-1]
    for name in ("planner", "policy"):
        table = {
            "final_distance": policies[name]["final_distance"]["mean"],
            "success": policies[name]["success"]["0.05"]["mean"],
            "return": policies[name]["return"]["mean"],
        }
        for quantity, value in table.items():
            assert last[f"eval/{name}/{quantity}"] == value
            lines = (folder / "csv" / "scalars" / "eval" / name / f"{quantity}.csv").read_text().splitlines()
            step, logged = map(float, lines[-1].split(","))
            assert step == last["updates"] == 30 and logged == pytest.approx(value)
    assert (last["env_steps"], last["time_s"] > 0) == (8 * (10 + 15), True)


def test_what_it_leaves(run) -> None:
    folder = run[0]
    for name in ("evaluation.md", "curves.png", "last_frame.png", "csv", "tensorboard"):
        assert (folder / name).exists(), name
    assert (folder / "curves.png").read_bytes().startswith(b"\x89PNG")
    cfg = OmegaConf.load(folder / "config.yaml")
    assert cfg.scale == "smoke" and cfg.env.episode_length == LENGTH and cfg.model.latent_dim == 32
    assert "${" not in (folder / "config.yaml").read_text()
    losses = list(folder.glob("csv/**/loss.csv"))
    assert losses and losses[0].read_text().strip()


def test_video(run) -> None:
    """As many frames as an episode has steps, at half speed, and a second to look at its end; the arm moves in it."""
    with av.open(str(run[0] / "video.mp4")) as film:
        rate = film.streams.video[0].average_rate
        frames = [frame.to_ndarray(format="rgb24").astype(int) for frame in film.decode(video=0)]
    assert rate == round(OmegaConf.load(run[0] / "config.yaml").env.fps / 2)
    assert len(frames) == LENGTH + rate
    assert all(frame.std() > 10 for frame in frames)
    assert (abs(frames[0] - frames[-1]).max(-1) > 40).mean() > 0.005


def test_checkpoint(run) -> None:
    checkpoint = load_checkpoint(latest_checkpoint(run[0]))
    assert checkpoint.counters["updates"] == 30
    assert checkpoint.counters["env_steps"] == 8 * (10 + 15)


def test_going_on(run, tmp_path: Path) -> None:
    done = train_in_fork(
        f"resume={run[0]}",
        "trainer.updates=50",
        "evaluation.video_episodes=0",
        f"hydra.run.dir={tmp_path}/more",
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    before, after = (load_checkpoint(latest_checkpoint(f)) for f in (run[0], tmp_path / "more"))
    assert after.counters["updates"] == 50
    assert after.counters["env_steps"] == before.counters["env_steps"] + 8 * 10  # no second seed phase
    assert after.counters["seconds"] > before.counters["seconds"]
    history = read_rows(after)
    assert history[: len(read_rows(before))] == read_rows(before)
    assert before.replay().numel() == 8 * 25 and after.replay().numel() == 8 * 35
    assert (tmp_path / "more" / "evaluation.json").exists()
    assert (
        after.config["model"] == before.config["model"]
    )  # of the checkpoint, not of the scale of this machine


def test_ctrl_c(tmp_path: Path) -> None:
    """Exit status 130, and a whole checkpoint to go on from."""
    command = [*SMOKE, "trainer.updates=1000000", "trainer.log_every=0.2", f"hydra.run.dir={tmp_path}/run"]
    fork = Fork(script(TRAIN, *command), cwd=tmp_path, log=tmp_path / "log")
    ends = time.monotonic() + 120
    while "\nupdates" not in fork.said()[0] and time.monotonic() < ends:
        time.sleep(0.05)
    os.kill(fork.pid, signal.SIGINT)
    done = fork.wait(60)
    text = done.stdout + done.stderr
    assert done.returncode == 130, text
    assert "Traceback" not in text and f"resume={tmp_path}/run" in text
    checkpoint = load_checkpoint(latest_checkpoint(tmp_path / "run"))
    assert 0 < checkpoint.counters["updates"] < 1_000_000
    assert checkpoint.replay() is not None
    assert not (tmp_path / "run" / "evaluation.json").exists()


# -- bad input -------------------------------------------------------------------------------------------


def assert_one_line(text: str) -> None:
    lines = text.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: "), text


@pytest.fixture
def refuse(tmp_path: Path, monkeypatch, capfd):
    """Runs train.py in this process; returns the one line with which it refuses."""

    def refuse(*arguments: str, folder: Path = tmp_path / "run") -> str:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [str(TRAIN), "scale=smoke", *arguments, f"hydra.run.dir={folder}"])
        GlobalHydra.instance().clear()
        capfd.readouterr()
        with pytest.raises(SystemExit) as caught:
            runpy.run_path(str(TRAIN), run_name="__main__")
        assert caught.value.code == 1
        text = capfd.readouterr().err
        assert_one_line(text)
        return text

    return refuse


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("collector.num_env=3", "num_env"),
        ("env=fly", "fly"),
        ("model=crystal_ball", "crystal_ball"),
        ("env.substep=3", "substep"),
        ("+env.substep=3", "substep"),
        ("env.substeps=-1", "substeps"),
        ("env.goal=null", "goal"),
        ("env.image_size=0", "image_size"),
        ("collector.num_envs=0", "num_envs"),
        ("device=tpu", "tpu"),
        ("seed=abc", "seed"),
        ("env.substeps=", "substeps"),
        ("nonsense", "nonsense"),
    ],
)
def test_bad_values(override: str, named: str, refuse) -> None:
    assert named in refuse(override)


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        (["env=reach_fixed", "env.goal=[3,0,0]"], "goal"),
        (["replay.capacity=6"], "capacity"),
        (["trainer.lr=-1"], "lr"),
        (["collector.smoothness=1.5"], "smoothness"),
        (["evaluation.during=[nobody]"], "nobody"),
        (["logger.names=[carrier_pigeon]"], "carrier_pigeon"),
        (["planner.num_elites=0"], "num_elites"),
        (["model.latent_dim=-8"], "latent_dim"),
    ],
)
def test_bad_values_that_only_a_part_knows(overrides: list[str], named: str, refuse) -> None:
    assert named in refuse("collector.num_envs=2", "evaluation.episodes=2", *overrides)


@pytest.mark.parametrize(
    "override",
    [
        "collector.num_env=3",
        "env=fly",
        "env.substeps=-1",
        "collector.num_envs=0",
        "device=tpu",
        "resume=nowhere",
        "env.goal_sampling=fixed env.goal=[3,0,0]",
        "trainer.lr=-1",
        "logger.names=[carrier_pigeon]",
        "replay.capacity=1000000000000",
        "replay.capacity=1000000000000000000",
    ],
)
def test_a_refusal_leaves_nothing_behind(override: str, refuse, tmp_path: Path) -> None:
    """No folder that looks like the results of a run."""
    refuse("collector.num_envs=2", "evaluation.episodes=2", *override.split())
    assert sorted(tmp_path.rglob("*")) == []


def test_cuda_where_there_is_none(refuse) -> None:
    import torch

    if torch.cuda.is_available():
        pytest.skip("this machine has CUDA")
    assert "device=cpu" in refuse("device=cuda")


def test_a_folder_that_cannot_be(refuse, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    assert "not a folder" in refuse(folder=tmp_path / "file" / "run")
    assert (tmp_path / "file").read_text() == "in the way"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_is_read_only(refuse, tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o500)
    assert "not writable" in refuse(folder=tmp_path / "locked" / "run")


def test_going_on_from_nothing(refuse, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert "empty" in refuse(f"resume={tmp_path}/empty")


def test_going_on_from_a_truncated_checkpoint(run, refuse, tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(latest_checkpoint(run[0]), broken)
    weights = broken / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])
    assert "model.safetensors" in refuse(f"resume={broken}")


def test_going_on_with_another_model(run, refuse) -> None:
    refuse(f"resume={run[0]}", "model=tdmpc2")  # a group
    refuse(f"resume={run[0]}", "model.latent_dim=64")  # a size that the weights do not have


def test_going_on_with_an_unknown_option(run, refuse) -> None:
    assert "updatez" in refuse(f"resume={run[0]}", "trainer.updatez=3")
    assert "did you mean trainer" in refuse(f"resume={run[0]}", "+trianer.updates=3")


def test_a_learning_rate_that_breaks_the_run(refuse, tmp_path: Path) -> None:
    """One line, no checkpoint that nobody could use."""
    said = refuse(
        "device=cpu", "collector.num_envs=2", "evaluation.episodes=2", "env.substeps=1", "trainer.lr=1e30"
    )
    assert "not finite" in said and "trainer.lr (1e+30)" in said and "no checkpoint was written" in said
    assert not (tmp_path / "run" / "checkpoints").exists()


def test_a_run_that_goes_on_and_breaks_names_what_it_went_on_from(run, refuse) -> None:
    said = refuse(f"resume={run[0]}", "trainer.lr=1e30", "trainer.updates=100")
    assert f"; no checkpoint was written; what it went on from is whole: {run[0]}\n" in said
    assert "trainer.capture=true: needs" in refuse("device=cpu", "trainer.capture=true")


def test_the_folder_of_another_run(run, refuse) -> None:
    """Its weights stay what they are; to go on with them one has to say so."""
    everything = {path: path.stat().st_mtime_ns for path in run[0].rglob("*")}
    said = refuse("seed=1", folder=run[0])
    assert f"resume={run[0]}" in said and "another folder" in said
    assert {path: path.stat().st_mtime_ns for path in run[0].rglob("*")} == everything
    checkpoint = latest_checkpoint(run[0])
    assert occupied(run[0], str(run[0])) is None and occupied(run[0], str(checkpoint)) is None
    assert occupied(run[0], str(run[0].parent / "other")) is not None


def test_the_exit_status_and_what_the_terminal_shows(tmp_path: Path) -> None:
    done = run_in_fork(script(TRAIN, "env.substeps=-1"), tmp_path)
    assert done.returncode == 1
    assert_one_line(done.stderr)
    assert "substeps" in done.stderr


def test_help_explains_the_groups(tmp_path: Path) -> None:
    done = train("--help", cwd=tmp_path)
    assert done.returncode == 0 and done.stdout.startswith(
        "usage: python train.py [group=choice …] [key=value …]"
    )
    for word in ("env:", "model:", "planner:", "scale:", "reach_fixed_pixels", "resume", "num_samples"):
        assert word in done.stdout, word


# -- the command line, without a run ---------------------------------------------------------------------


def test_check_command(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr(sys, "argv", [str(TRAIN)])
    monkeypatch.chdir(tmp_path)
    assert check_command(["env=reach", "scale=smoke", "hydra.run.dir=somewhere"]) is None
    problem = check_command(["env=fly"])
    assert problem is not None and "reach_fixed" in problem and "\n" not in problem
    assert list(tmp_path.iterdir()) == []


def test_errors_are_one_line() -> None:
    assert str(FrankaError("first\n  second")) == "first second"


@pytest.mark.parametrize(
    ("resume", "name"),
    [
        ("outputs/2026-01-02/03-04-05-reach_pixels-1", "reach_pixels-1"),
        ("outputs/2026-01-02/03-04-05-reach-1/checkpoints/latest", "reach-1"),
        ("outputs/2026-01-02/03-04-05-reach-1/checkpoints", "reach-1"),
        ("/mnt/checkpoints/today/03-04-05-reach-0/", "reach-0"),
        ("/tmp/größe", "größe"),
        (".", "reach-7"),
        (None, "reach-7"),
    ],
)
def test_a_resumed_run_s_folder_has_the_name_of_the_first(resume: str | None, name: str) -> None:
    """And not that of the default environment."""
    assert run_name(resume, "reach", 7) == name
    cfg = OmegaConf.create(
        {"resume": resume, "dir": "x-${run_name:${resume},reach,7}"}
    )  # as conf/config.yaml asks
    assert cfg.dir == f"x-{name}"


TYPOS = [
    ("env.image_sise=3", "env.image_sise: no such option; did you mean env.image_size?"),
    ("model=tdmcp2", "did you mean tdmpc2?"),
    ("--cfg job env.image_sise=3", "did you mean env.image_size?"),
    ("env.randomization={colour:0.2}", "env.randomization.colour: no such option; did you mean"),
    ("seed=1 --cfg job --resolve env.fps=${nope}", "Interpolation key 'nope' not found"),
    ("--help model=tdmcp2", "did you mean tdmpc2?"),
    ("--info defaults modle=tdmpc2", "did you mean model?"),
    ("--multirun seed=0,1 env.image_sise=3,4", "did you mean env.image_size?"),
    ("-m env=reach,raech", "did you mean reach?"),
    ("-m env=[", "no viable alternative at input '['"),
    ("--cfg jbo", "invalid choice: 'jbo' (choose from 'job', 'hydra', 'all')"),
    ("--fast", "unrecognized arguments: --fast"),
    ("model=nope", "model=nope: must be one of action_world_model"),
    ("trainer.updates=-1", "trainer.updates=-1: must be a whole number of at least 0"),
    ("+trianer.updates=3", "trianer: there is no such option; did you mean trainer?"),
    ("scale=auto trainer.lr=abc", "trainer.lr='abc': must be a finite number above 0"),
    ("env=gym model.name=nope", "model=nope: must be one of action_world_model"),
    ("env=gym env.frame_skip=0", "env.frame_skip=0: must be a whole number"),
    ("env.substeps=0", "substeps=0: must be a whole number"),
    ("trainer=offline", "trainer=offline: trains on recorded data; name them, dataset=lerobot"),
    ("resume=nowhere", "resume=nowhere: no such folder; give that of a run"),
    ("trainer=offline dataset=lerobot dataset.root=[nowhere]", "dataset.root=nowhere: no such folder"),
    ("-m seed=0,1 replay.demos=nowhere", "replay.demos=nowhere: no such folder"),
    ("-m seed=0,1 planner.precision=half", "planner.precision='half': must be one of float32, bfloat16"),
]
SCRIPT, VERB = (str(TRAIN),), ("-m", "franka_wm", "train")


@pytest.fixture(scope="module")
def answered(tmp_path_factory) -> tuple[Path, dict[tuple[str, ...], Answer]]:
    """The folder of all these commands, and how each of them ended."""
    place = tmp_path_factory.mktemp("typos")
    return place, answers([(*program, *a.split()) for a, _ in TYPOS for program in (SCRIPT, VERB)], place)


@pytest.mark.parametrize(("arguments", "said"), TYPOS)
@pytest.mark.parametrize("program", [SCRIPT, VERB], ids=["train.py", "franka-wm train"])
def test_a_typo_or_a_wrong_value_is_answered_before_torch_and_the_simulator_load(
    program: tuple[str, ...], arguments: str, said: str, answered
) -> None:
    place, found = answered
    done = found[(*program, *arguments.split())]
    lines = done.stderr.splitlines()
    assert done.returncode == 1 and len(lines) == 1 and lines[0].startswith("error: "), lines
    assert said in lines[0] and "+env" not in lines[0] and done.stdout == ""
    assert "hydra" in done.loaded
    assert not done.loaded & {"torch", "newton", "warp", "torchrl", "pandas"}
    assert list(place.iterdir()) == []


def test_cfg_shows_the_configuration_that_would_run(tmp_path: Path) -> None:
    """Options may stand before and after the flag; the scale is that of the device, which is said elsewhere."""
    done = train("device=cpu", "--cfg", "job", "--resolve", "env.substeps=7", cwd=tmp_path)
    assert done.returncode == 0 and "scale=laptop, by the device" in done.stderr
    shown = OmegaConf.create(done.stdout)
    assert (shown.scale, shown.device, shown.env.substeps) == ("laptop", "cpu", 7)
    assert list(tmp_path.iterdir()) == []
