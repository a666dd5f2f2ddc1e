"""``python train.py --multirun``: what is refused before the first job, what a failure and Ctrl-C end, going on."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import OmegaConf

from forks import TRAIN, Fork, script, spare, torchrun_in_fork, train_in_fork
from franka_wm.commands import entry, launching
from franka_wm.commands.launching import refused_job
from franka_wm.commands.overrides import compose
from franka_wm.commands.sweep import spread
from franka_wm.conf.wrong import explain
from franka_wm.errors import UserError
from franka_wm.evaluation.results import read_result, score
from franka_wm.training import run
from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint
from franka_wm.training.place import left_by

SMOKE = [
    "env=reach",
    "scale=smoke",
    "device=cpu",
    "env.episode_length=12",
    "env.substeps=1",
    "trainer.updates=4",
]
SMALL = ["evaluation.episodes=2", "evaluation.video_episodes=0", "logger.names=[csv]"]
FEW = ["planner.num_samples=8", "planner.num_elites=4"]
BREAKS = "trainer.lr=1e30,1e-3"
KEEPS = "+hydra.callbacks.kept._target_=hydra.experimental.callbacks.PickleJobInfoCallback"
"""What each job returns to Hydra's sweeper."""


def sweep(place: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """In a fork; so are the processes of a job that has several."""
    words = ("--multirun", *SMOKE, *SMALL, KEEPS, *arguments, f"hydra.sweep.dir={place / 'sweep'}")
    return spare().fork(torchrun_in_fork(script(TRAIN, *words)), place)


def returned(job: Path) -> float | None:
    return pickle.loads((job / ".hydra" / "job_return.pickle").read_bytes()).return_value


def state(place: Path) -> dict[Path, int]:
    return {path: 0 if path.is_dir() else path.stat().st_mtime_ns for path in place.rglob("*")}


@pytest.fixture(scope="module")
def swept(tmp_path_factory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """A sweep whose first job breaks: its folder, and what it said."""
    place = tmp_path_factory.mktemp("sweep")
    return place, sweep(place, BREAKS)


def test_a_job_that_fails_does_not_end_the_others(swept) -> None:
    place, done = swept
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    first, last = done.stderr.strip().splitlines()
    assert first.startswith("error: job 0 (trainer.lr=1e+30): training broke: ")
    assert last.startswith("error: 1 of 2 jobs failed: job 0 (trainer.lr=1e+30): training broke: ")
    assert last.endswith(f"the same command with hydra.sweep.dir={place}/sweep runs what is missing")
    assert f"its runs in a table: franka-wm summary {place}/sweep" in done.stdout
    assert (place / "sweep/1-reach/finished.json").is_file()
    logs = [(place / "sweep" / job / "train.log").read_text() for job in ("0-reach", "1-reach")]
    assert first in logs[0] and "training broke" not in logs[1]
    assert returned(place / "sweep/0-reach") is None
    planner = read_result(place / "sweep/1-reach/evaluation.json").policies["planner"]
    assert returned(place / "sweep/1-reach") == pytest.approx(-planner["final_distance"]["mean"])


def test_the_same_sweep_again_runs_what_is_missing(swept) -> None:
    """What is done is left alone, what was begun goes on, what failed is tried again."""
    place, _ = swept
    job = place / "sweep" / "1-reach"
    (job / "finished.json").unlink()
    done = sweep(place, BREAKS)
    assert "job 1 (trainer.lr=0.001) goes on where it stopped" in done.stdout, done.stdout + done.stderr
    assert done.returncode == 1 and "error: 1 of 2 jobs failed: job 0" in done.stderr
    assert (job / "finished.json").is_file()
    assert load_checkpoint(latest_checkpoint(job)).config["resume"] == str(job)
    assert (
        "are made: only the run's end is done again, a larger number trains on"
        in (job / "train.log").read_text()
    )
    weights = state(job / "checkpoints")
    done = sweep(place, BREAKS)
    assert f"job 1 (trainer.lr=0.001) was finished before: {job}" in done.stdout, done.stdout + done.stderr
    assert done.returncode == 1 and state(job / "checkpoints") == weights
    assert returned(job) == score(read_result(job / "evaluation.json").policies)


def test_a_job_is_refused_before_anything_is_written(swept, tmp_path: Path) -> None:
    """Where a run of other settings is, what the settings refuse, and two jobs in one folder."""
    place, _ = swept
    before = state(place)
    done = sweep(place, BREAKS, "seed=3")
    assert done.returncode == 1 and state(place) == before
    assert done.stderr.startswith("error: job 1 (trainer.lr=0.001): ") and done.stderr.count("\n") == 1
    assert "1-reach holds a run of other settings: seed is 0 there and 3 here" in done.stderr

    done = sweep(tmp_path, "planner.num_elites=8,0")
    assert done.stderr.startswith("error: job 1 (planner.num_elites=0): planner.num_elites=0: ")
    done = sweep(tmp_path, "seed=0,1", "hydra.sweep.subdir=one")
    assert "jobs 0 and 1 would both write into" in done.stderr and done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_job_is_finished_once_it_has_exported(tmp_path: Path) -> None:
    """The same sweep again makes the dataset that is missing, and leaves alone one that is there."""
    (tmp_path / "full.py").write_text(
        "from pathlib import Path\n"
        "from franka_wm.data.lerobot.writer import DatasetWriter\n"
        "from franka_wm.errors import UserError\n"
        "def merge(self):\n"
        "    if not Path('room').exists():\n"
        "        raise UserError('the disk is full')\n"
        "    merged(self)\n"
        "merged, DatasetWriter._merge = DatasetWriter._merge, merge\n"
    )
    job = tmp_path / "sweep" / "0-reach"
    finished, dataset = job / "finished.json", job / "dataset" / "meta" / "info.json"

    def again() -> str:
        exports = ("plugins=[full]", "export=lerobot", "export.workers=1")
        done = sweep(tmp_path, *exports, *FEW, "evaluation.during=[]")
        assert done.returncode == int(not finished.exists()), done.stdout + done.stderr
        return done.stdout + done.stderr

    assert "error: job 0: the disk is full" in again()
    assert list((job / "dataset.writing" / "shards").iterdir()) and not finished.exists()
    (tmp_path / "room").touch()
    said = again()
    assert "job 0 goes on where it stopped" in said and "dataset: " in said and "written before" not in said
    written = dataset.read_bytes(), dataset.stat().st_mtime_ns
    assert finished.exists() and not (job / "dataset.writing").exists()
    finished.unlink()  # ended between the two
    assert f"dataset: {job / 'dataset'} was written before" in again() and finished.exists()
    assert (dataset.read_bytes(), dataset.stat().st_mtime_ns) == written


def test_a_search_needs_its_plugin_and_its_direction(tmp_path: Path, capsys) -> None:
    said = explain("Could not find 'hydra/sweeper/optuna'\n\nAvailable options:\n\tbasic\n")
    assert said == "hydra/sweeper=optuna: must be one of basic; pip install 'franka-wm[optuna]'"
    said = explain("Could not find 'planner/walk'\n\nAvailable options:\n\tcem\n\tmppi\n")
    assert said.endswith(
        "of cem, mppi; of your own: hydra.searchpath=[file://FOLDER], with planner/walk.yaml"
    )
    with pytest.raises(SystemExit):
        entry.check_sweep(["hydra/sweeper=optuna", "hydra.sweeper.direction=minimize"])
    assert "better the higher; add hydra.sweeper.direction=maximize" in capsys.readouterr().err
    assert entry.check_sweep(["hydra/sweeper=optuna", "hydra.sweeper.direction=maximize"]).names == []


def test_folders_are_not_looked_for_where_a_launcher_may_take_jobs_to_other_machines(
    monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    """Of a search, whose jobs are not known beforehand: of those of a sweep each is checked whole."""
    for plugin in ("optuna_sweeper", "joblib_launcher"):
        pytest.importorskip(f"hydra_plugins.hydra_{plugin}")
    monkeypatch.setattr(sys, "argv", ["train.py"])
    search = ["-m", "hydra/sweeper=optuna", "hydra.sweeper.direction=maximize", "scale=smoke", "device=cpu"]
    begun = []
    entry._run(lambda: begun.append(1), [*search, "replay.demos=elsewhere", "hydra/launcher=joblib"])
    assert begun and capsys.readouterr().err == ""
    with pytest.raises(SystemExit):
        entry._run(lambda: pytest.fail("begun"), [*search, "replay.demos=elsewhere"])
    assert (
        capsys.readouterr().err
        == "error: replay.demos=elsewhere: no such folder; franka-wm collect out=FOLDER makes one\n"
    )


@pytest.mark.parametrize("launcher", ["submitit_slurm", "ray"])
def test_jobs_on_other_machines_name_their_scale(launcher: str, capsys: pytest.CaptureFixture[str]) -> None:
    """A login node without a GPU would make all of them small."""
    command = ["env=lift", f"hydra/launcher={launcher}"]
    if launcher == "ray":  # on this machine, where no other is named
        assert entry.with_scale([*command, "device=auto"])[-1].startswith("scale=")
        command += ["hydra.launcher.ray.init.address=auto"]
    for more in ([], ["scale=auto"]):
        with pytest.raises(SystemExit):
            entry.with_scale([*command, *more])
        said = capsys.readouterr().err
        assert said.startswith(f"error: hydra/launcher={launcher}: ") and "add scale=gpu, " in said
    assert entry.with_scale([*command, "scale=gpu"]) == [*command, "scale=gpu"]
    assert entry.with_scale([*command, "device=cuda"])[-1] == "scale=gpu"
    assert entry.with_scale(["hydra/launcher=joblib", "device=cpu"])[-1] == "scale=laptop"


def test_what_a_run_returns_is_better_the_higher() -> None:
    rate, distance, gain = ({"mean": x, "low": 0.0, "high": 1.0} for x in (0.25, 0.3, 7.0))
    assert score({"planner": {"success": rate, "return": gain}, "policy": {"return": gain}}) == 0.25
    reach = {"success": {"0.05": rate}, "final_distance": distance, "return": gain}
    assert score({"noop": {"return": gain}, "policy": reach}) == -0.3
    assert score({"planner": {"return": gain}}) == 7.0
    assert score({"noop": {"return": gain}}) is None


LAUNCHERS = {
    "joblib": ["hydra.launcher.n_jobs=2"],
    "submitit_local": [],
    "ray": [
        "+hydra.launcher.ray.init.num_cpus=2",
        "+hydra.launcher.ray.remote.num_cpus=1",
    ],  # a cluster of one node
}


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_jobs_of_other_processes_are_looked_after_as_well(tmp_path: Path, launcher: str) -> None:
    """Two at a time: who failed is named, the others finish, and what is missing runs when it is asked for again."""
    plugin = f"hydra_plugins.hydra_{launcher.partition('_')[0]}_launcher"
    pytest.importorskip(plugin, reason=f"hydra/launcher={launcher} is not installed")
    rates = "trainer.lr=1e30,1e-3" if launcher == "joblib" else "trainer.lr=1e30,1e-3,2e-3"
    command = ["--multirun", f"hydra/launcher={launcher}", *LAUNCHERS[launcher], *SMOKE, *SMALL, *FEW, rates]
    command += ["evaluation.during=[]", f"hydra.sweep.dir={tmp_path}/sweep"]
    done = train_in_fork(*command, cwd=tmp_path)  # its jobs are processes of their own
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    failed = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    count = 1 + rates.count(",")
    assert failed[-1].startswith(f"error: 1 of {count} jobs failed: job 0 (trainer.lr=1e+30): see ")
    logs = [(tmp_path / "sweep" / f"{k}-reach" / "train.log").read_text() for k in range(count)]
    assert "training broke" in logs[0] and all("results: " in log for log in logs[1:])
    if launcher == "joblib":
        command[command.index("hydra.launcher.n_jobs=2")] = "hydra.launcher.n_jobs=1"  # in the fork itself
        again = train_in_fork(*command, cwd=tmp_path)
        assert again.returncode == 1 and "job 1 (trainer.lr=0.001) was finished before" in again.stdout


@pytest.mark.slow
def test_a_search_goes_on_without_the_trial_that_fails(tmp_path: Path) -> None:
    """The best of the others is in its file; a longer search of the same folder keeps what is done."""
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="needs pip install 'franka-wm[optuna]'")
    place = tmp_path / "sweep"
    command = ["hydra/sweeper=optuna", "hydra.sweeper.direction=maximize", "hydra.sweeper.n_jobs=1"]
    # Of this seed's trials the second alone breaks; the first and the third differ in the run's seed.
    command += ["hydra.sweeper.sampler.seed=21", "trainer.lr=choice(1e30,1e-3)", "seed=choice(0,1)"]
    command += ["evaluation.during=[]"]

    def search(trials: int) -> subprocess.CompletedProcess[str]:
        done = sweep(tmp_path, *command, *FEW, f"hydra.sweeper.n_trials={trials}")
        assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
        last = done.stderr.strip().splitlines()[-1]
        assert last.startswith(f"error: 1 of {trials} jobs failed: job 1: training broke: "), last
        return done

    search(3)
    assert not (place / "1-reach/finished.json").exists()
    results = {k: read_result(place / f"{k}-reach/evaluation.json").policies for k in (0, 2)}
    best = max(results, key=lambda k: score(results[k]) or -9.0)
    chosen = {"seed": {0: 0, 2: 1}[best], "trainer.lr": 1e-3}
    found = OmegaConf.load(place / "optimization_results.yaml")
    assert found == {"name": "optuna", "best_params": chosen, "best_value": score(results[best])}
    trained = {k: state(place / f"{k}-reach/checkpoints") for k in results}
    longer = search(4)
    assert longer.stdout.count("was finished before") == 2 and (place / "3-reach/finished.json").is_file()
    assert {k: state(place / f"{k}-reach/checkpoints") for k in results} == trained
    assert OmegaConf.load(place / "optimization_results.yaml") == found


@pytest.mark.slow
def test_a_search_by_joblib_names_the_trial_that_fails(tmp_path: Path) -> None:
    """Optuna chooses its trials, and other processes run them: what they left tells."""
    for plugin in ("optuna_sweeper", "joblib_launcher"):
        pytest.importorskip(f"hydra_plugins.hydra_{plugin}")
    command = ["--multirun", "hydra/sweeper=optuna", "hydra.sweeper.direction=maximize", *SMOKE, *SMALL, *FEW]
    command += ["hydra/launcher=joblib", "hydra.sweeper.n_jobs=2", "hydra.sweeper.n_trials=2"]
    # Of this seed's trials the second alone breaks.
    command += ["hydra.sweeper.sampler.seed=21", "trainer.lr=choice(1e30,1e-3)", "seed=choice(0,1)"]
    command += ["evaluation.during=[]", f"hydra.sweep.dir={tmp_path}/sweep"]
    done = train_in_fork(*command, cwd=tmp_path)  # its jobs are processes of their own
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    log = tmp_path / "sweep/1-reach/train.log"
    failed = [
        line for line in done.stderr.splitlines() if line.startswith("error: ")
    ]  # joblib may warn later
    assert failed[-1].startswith(f"error: 1 of 2 jobs failed: job 1-reach: see {log}; "), done.stderr
    assert "training broke" in log.read_text() and (tmp_path / "sweep/0-reach/finished.json").is_file()


@pytest.mark.slow
def test_jobs_of_several_processes_are_looked_after_as_well(tmp_path: Path) -> None:
    done = sweep(tmp_path, BREAKS, "gpus=2", *FEW, "evaluation.during=[]")
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    assert "training broke" in done.stderr
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith(
        "error: 1 of 2 jobs failed: job 0 (trainer.lr=1e+30): its lines above say why, or "
    )
    assert (tmp_path / "sweep/0-reach/train.log").is_file()
    job = tmp_path / "sweep/1-reach"
    assert returned(job) == score(read_result(job / "evaluation.json").policies)
    assert load_checkpoint(latest_checkpoint(job)).config["gpus"] == 2


def test_jobs_of_several_processes_that_cannot_be(monkeypatch: pytest.MonkeyPatch) -> None:
    several_gpus = ["scale=smoke", "gpus=2", "device=cuda"]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "gpus=2: this machine has 0 usable CUDA devices" in str(refused_job(several_gpus))
    assert "would take the same GPUs" in str(refused_job([*several_gpus, "hydra/launcher=joblib"]))
    assert refused_job(["scale=smoke", "gpus=2", "device=cpu"]) is None
    monkeypatch.setattr(launching, "wanted", lambda _: (2, "cuda"))  # the extra may be missing
    assert refused_job([*several_gpus, "hydra/launcher=ray"]) is None  # its hosts may have them


def test_a_begun_job_of_several_processes_keeps_its_groups(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Its processes find what it has saved; ``resume=`` beside ``env=`` would be refused."""
    options = ["env=reach", "scale=smoke", "gpus=2", "device=cpu"]
    begun(tmp_path, *options)
    cfg = compose(options)
    cfg.resume = str(tmp_path)  # as the sweep has found it
    began = []

    def processes(command: list[str], *_: object) -> None:
        began.append(command[1:])
        assert entry.check_command(command[1:]) is None
        told = {"mode": RunMode.RUN, "runtime": {"output_dir": str(tmp_path)}}
        monkeypatch.setattr(HydraConfig, "get", lambda: OmegaConf.create(told))
        entry.one_line_errors(began.append)(compose(command[1:]))

    monkeypatch.setattr(launching, "launch_verb", processes)
    monkeypatch.setattr(entry, "_sweep", None)
    launching.launch_job(options, cfg, tmp_path)
    command, goes_on = began
    assert command == [*options, f"hydra.run.dir={tmp_path}"] and goes_on.resume == str(tmp_path)
    assert "a run has left its weights there" in str(entry.check_command(command))  # not of a sweep


def test_jobs_take_the_gpus_in_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    cfgs = [OmegaConf.create({"device": "spread"}) for _ in range(3)]
    for k, cfg in enumerate(cfgs):
        spread(cfg, k)
    assert [cfg.device for cfg in cfgs] == ["cuda:0", "cuda:1", "cuda:0"]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UserError, match="device=spread: this machine has 0 usable CUDA devices"):
        spread(OmegaConf.create({"device": "spread"}))


def begun(folder: Path, *overrides: str) -> None:
    """What a run of these options leaves that has saved, as far as a sweep looks at it."""
    (folder / "checkpoints" / "latest").mkdir(parents=True)
    (folder / "checkpoints" / "latest" / "manifest.json").write_text("{}")
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(compose(overrides), resolve=True))


def test_jobs_that_take_the_gpus_in_turn_go_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Each has its own number in its folder; with one GPU less, job 1 goes on upon the first one."""
    options = ["scale=smoke", "env=reach"]
    for k in range(2):
        begun(tmp_path / f"{k}-reach", *options, f"seed={k}", f"device=cuda:{k}")
    command = [*options, "device=spread", "seed=0,1", f"hydra.sweep.dir={tmp_path}"]
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(run, "check_once", lambda _: None)  # there is no GPU to look at
    for there in (2, 1):
        monkeypatch.setattr(torch.cuda, "device_count", lambda there=there: there)
        found = entry.check_sweep(command)
    job = (
        {"num": 1},
        {"output_dir": str(tmp_path / "1-reach")},
        {"dir": str(tmp_path)},
        {"hydra": [], "task": []},
    )
    told = OmegaConf.create(dict(zip(("job", "runtime", "sweep", "overrides"), job, strict=True)))
    monkeypatch.setattr(HydraConfig, "get", lambda: told)
    ran = []
    found.run(ran.append, compose([*options, "seed=1", "device=spread"]))
    assert [(cfg.device, cfg.resume) for cfg in ran] == [("cuda:0", str(tmp_path / "1-reach"))]
    (tmp_path / "0-reach" / "config.yaml").write_text("device: cpu\n")
    with pytest.raises(UserError, match="device is cpu there and spread here"):
        left_by(tmp_path / "0-reach", OmegaConf.create({"device": "spread"}))


def test_a_job_goes_on_upon_the_device_of_now(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    saved = SimpleNamespace(config={"device": "cuda:1", "seed": 0})
    monkeypatch.setattr(run, "latest_checkpoint", Path)
    monkeypatch.setattr(run, "load_checkpoint", lambda _: saved)
    cfg = OmegaConf.create({"device": "cuda:0", "resume": str(tmp_path), "plugins": []})
    assert run.resumed(cfg, ["device=spread"])[1].device == "cuda:0"  # resume=RUN was typed
    told = {
        "runtime": {"output_dir": str(tmp_path)},
        "job": {"name": "train"},
        "overrides": {"task": ["device=spread"]},
    }
    monkeypatch.setattr(HydraConfig, "get", lambda: OmegaConf.create(told))
    monkeypatch.setattr(run, "_require_same", lambda _: None)

    def read(cfg: Any, saved: bool) -> None:
        assert saved and cfg.device == "cuda:0"
        raise UserError("read")

    monkeypatch.setattr(run.RunSettings, "of", read)
    with pytest.raises(UserError, match="read"):
        run.start(cfg)


def test_ctrl_c_ends_the_sweep(tmp_path: Path) -> None:
    command = [*SMOKE, *SMALL, "trainer.updates=1000000", "trainer.log_every=0.2", "seed=0,1"]
    work = script(TRAIN, "--multirun", *command, f"hydra.sweep.dir={tmp_path}/sweep")
    fork = Fork(work, cwd=tmp_path, log=tmp_path / "log")
    ends = time.monotonic() + 120
    while "\nupdates" not in fork.said()[0] and time.monotonic() < ends:
        time.sleep(0.05)
    os.kill(fork.pid, signal.SIGINT)
    done = fork.wait(60)
    assert done.returncode == 130 and "Traceback" not in done.stderr, done.stdout + done.stderr
    assert f"hydra.sweep.dir={tmp_path}/sweep runs what is missing" in done.stdout
    assert latest_checkpoint(tmp_path / "sweep" / "0-reach")
    assert not (tmp_path / "sweep" / "1-reach").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["seed=range(0,5,0)"], "has no values"),
        (["seed=range(5,0)"], "has no values"),
        (["seed=range(0,1000000000000)"], "more than 1000 jobs"),
        (["seed=range(0,40)", "trainer.lr=range(1,40)"], "more than 1000 jobs"),
    ],
)
def test_lists_that_are_empty_or_endless(words: list[str], said: str, capsys) -> None:
    with pytest.raises(SystemExit):
        list(entry.swept(words))
    told = capsys.readouterr().err
    assert told.startswith("error: ") and said in told and told.count("\n") == 1
