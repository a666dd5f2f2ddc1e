"""A wheel in an environment of its own, away from any checkout: everything that is documented works there."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import franka_wm
from preloaded import Preloaded

ROOT = Path(__file__).parents[1]
SOURCES = ("pyproject.toml", "setup.py", "README.md", "LICENSE", "franka_wm")

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this checkout, built from a copy, so that nothing of an earlier build gets in."""
    copy = tmp_path_factory.mktemp("source")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, copy / name)
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", "dist", "."]
    done = subprocess.run(command, cwd=copy, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return next((copy / "dist").glob("*.whl"))


@pytest.fixture(scope="module")
def franka(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., str]]:
    """Run ``franka-wm`` of a new environment in an empty folder; gives what it printed.

    Where `fork` is, it is a fork of one process of that environment, which has loaded what the verbs need.

    The environment sees the packages of the present one, but not the project installed there: files named ``*.pth``
    work in an environment's own folder only.
    """
    place = tmp_path_factory.mktemp("elsewhere")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", place / "venv"], check=True)
    python = place / "venv/bin/python"
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", wheel]
    subprocess.run(pip, env=clean, check=True)
    (own,) = (place / "venv").glob("lib/python*/site-packages")
    (own / "packages_of_the_tests.pth").write_text(sysconfig.get_path("purelib") + "\n")
    folder = place / "work"
    folder.mkdir()

    clean["OMP_NUM_THREADS"] = "1"
    loaded = Preloaded(
        "franka_wm.commands.train", "franka_wm.training.trainer", "franka_wm.evaluation.protocol",
        "franka_wm.report.end_of_run", "franka_wm.data.lerobot.writer", "franka_wm.live.page",
        environment=clean, python=python,
    )  # fmt: skip

    def run(*arguments: str, fork: bool = True) -> str:
        if fork:
            done = loaded.run("franka_wm", *arguments, cwd=folder)
        else:
            command = [place / "venv/bin/franka-wm", *arguments]
            done = subprocess.run(command, cwd=folder, env=clean, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{arguments}\n{done.stdout[-1000:]}\n{done.stderr[-3000:]}"
        return done.stdout

    where = subprocess.run(
        [python, "-c", "import franka_wm; print(franka_wm.__file__)"],
        cwd=folder, env=clean, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert where.startswith(str(own)), where
    yield run
    loaded.close()


@pytest.fixture(scope="module")
def run_folder(franka: Callable[..., str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "smoke"
    few = ("trainer.updates=10", "env.episode_length=12", "evaluation.episodes=2", "evaluation.during=[]")
    franka("train", "scale=smoke", "device=cpu", *few, f"hydra.run.dir={folder}", fork=False)
    return folder


def test_wheel_brings_its_data_and_nothing_else(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    data = {name for name in names if not name.endswith(".py") and ".dist-info/" not in name}
    tracked = {p.relative_to(ROOT).as_posix() for p in (ROOT / "franka_wm").rglob("*") if p.is_file()}
    expected = {name for name in tracked if not name.endswith((".py", ".pyc"))}
    assert data == expected
    assert "franka_wm/py.typed" in data
    assert all(name.startswith("franka_wm") for name in names)


def test_version(franka: Callable[..., str], wheel: Path) -> None:
    assert franka("--version", fork=False).split()[-1] == franka_wm.__version__ == wheel.name.split("-")[1]


def test_train_writes_a_run(run_folder: Path) -> None:
    assert (run_folder / "evaluation.json").is_file()
    assert (run_folder / "report.html").is_file()


def test_evaluate_and_report(franka: Callable[..., str], run_folder: Path, tmp_path: Path) -> None:
    quick = ("episodes=4", "device=cpu", "open_loop=false")
    franka("evaluate", f"checkpoint={run_folder}", f"out={tmp_path}", *quick)
    assert json.loads((tmp_path / "evaluation.json").read_text())
    franka("report", str(run_folder), f"out={tmp_path}/page.html")
    assert "<html" in (tmp_path / "page.html").read_text()[:2000]


def test_collect(franka: Callable[..., str], tmp_path: Path) -> None:
    out = tmp_path / "set"
    franka("collect", f"out={out}", "episodes=4", "policy=ik", "env=reach", "num_envs=4", "device=cpu",
           "env.episode_length=5")  # fmt: skip
    assert json.loads((out / "meta/info.json").read_text())["total_episodes"] == 4


def test_view(franka: Callable[..., str]) -> None:
    assert "http://127.0.0.1:" in franka("view", "port=0", "seconds=2", "device=cpu")


def test_list_names_what_the_wheel_holds(franka: Callable[..., str]) -> None:
    listed = franka("list", fork=False)
    for name in ("reach_fixed", "tdmpc2", "mppi"):
        assert name in listed
