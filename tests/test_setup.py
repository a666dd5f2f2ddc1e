"""``scripts/setup.sh``: uv or pip, whole or not at all. A project of one file stands for this one."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# Real environments, with uv and setuptools from the package index that the machine uses.
pytestmark = pytest.mark.slow


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A folder with the script, a module to install, and a lock of the two packages that install it."""
    (tmp_path / "scripts").mkdir()
    shutil.copy(ROOT / "scripts/setup.sh", tmp_path / "scripts/setup.sh")
    (tmp_path / "tiny_project.py").write_text("")
    (tmp_path / "pyproject.toml").write_text(
        '[build-system]\nrequires = ["setuptools"]\nbuild-backend = "setuptools.build_meta"\n'
        '[project]\nname = "tiny-project"\nversion = "1"\n[tool.setuptools]\npy-modules = ["tiny_project"]\n'
    )
    entries = re.split(r"^(?=[A-Za-z0-9])", (ROOT / "requirements.lock").read_text(), flags=re.MULTILINE)
    (tmp_path / "tiny.lock").write_text("".join(e for e in entries if e.startswith(("setuptools==", "uv=="))))
    return tmp_path


def install(project: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "scripts/setup.sh", ".venv", ".venv/.installed", "tiny.lock"],
        cwd=project,
        env=os.environ | {"PYTHON": sys.executable} | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def imports(project: Path) -> bool:
    done = subprocess.run(
        [project / ".venv/bin/python", "-c", "import tiny_project, setuptools"], check=False
    )
    return done.returncode == 0


def test_uv_installs_the_lock_and_the_project(project: Path) -> None:
    done = install(project)
    assert done.returncode == 0, done.stderr
    assert "pip instead" not in done.stdout
    assert (project / ".venv/.installed").is_file()
    assert not (project / ".venv/.installing").exists()
    assert imports(project)


def test_pip_steps_in_where_uv_cannot_work_and_says_so(project: Path) -> None:
    done = install(project, UV_CACHE_DIR="/dev/null")
    assert done.returncode == 0, done.stderr
    assert "trying pip instead" in done.stdout
    assert imports(project)


def test_a_wrong_hash_installs_nothing_and_leaves_no_stamp(project: Path) -> None:
    assert install(project).returncode == 0
    (project / ".venv/.installed-dev").touch()  # as the other lock would have left it
    for folder in (project / ".venv").glob("lib/python*/site-packages/setuptools*"):
        shutil.rmtree(folder)
    lock = project / "tiny.lock"
    setuptools, uv = re.split(r"^(?=uv==)", lock.read_text(), flags=re.MULTILINE)
    lock.write_text(re.sub(r"sha256:\w{64}", "sha256:" + "0" * 64, setuptools) + uv)
    done = install(project)
    assert done.returncode == 1
    assert "could not install the packages" in done.stderr
    assert not list((project / ".venv").glob(".installed*"))
    assert not imports(project)
