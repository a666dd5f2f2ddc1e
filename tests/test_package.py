"""The package as a whole: what importing it costs, and what its files promise."""

import re
import runpy
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

import franka_wm
from franka_wm.errors import FrankaError, UserError

ROOT = Path(__file__).parents[1]


def test_import_is_light() -> None:
    heavy = ["torch", "tensordict", "torchrl", "warp", "newton", "lerobot", "matplotlib", "numpy", "hydra"]
    code = f"import sys, franka_wm, franka_wm.errors; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


def test_the_environment_is_loaded_when_it_is_used() -> None:
    heavy = ["torch", "tensordict", "torchrl", "warp", "newton"]
    code = f"import sys, franka_wm.envs; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


def test_names_at_the_top() -> None:
    from franka_wm import envs
    from franka_wm.envs.franka import FrankaEnv
    from franka_wm.training import load

    assert franka_wm.FrankaEnv is envs.FrankaEnv is FrankaEnv
    assert (franka_wm.load, franka_wm.load_agent) == (load.load_model, load.load_agent)
    for name in envs.__all__:  # those of the reference environment among them
        assert callable(getattr(envs, name)), name
    for module in (franka_wm, envs):
        with pytest.raises(AttributeError, match="no_such_name"):
            module.no_such_name  # noqa: B018


def test_report_does_not_load_what_it_may_not_need() -> None:
    heavy = ["matplotlib", "av", "PIL", "rich"]
    modules = ", ".join(f"franka_wm.report.{m}" for m in ("curves", "style", "table"))
    code = f"import sys, {modules}; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "[]"


def test_version_is_written_once_and_cited() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "version" in project["project"]["dynamic"]
    assert project["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "franka_wm.version.__version__"}
    assert version("franka-wm") == franka_wm.__version__
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == franka_wm.__version__
    assert f"\n## {franka_wm.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_readme_on_an_index_has_whole_addresses_or_none() -> None:
    shown = runpy.run_path(str(ROOT / "setup.py"), run_name="metadata")
    text = (ROOT / "README.md").read_text()
    images = re.findall(r"!\[[^\]]*\]\((docs/images/[a-z]+\.png)\)", text)
    assert images

    hosted = shown["readme"](text, "https://example.org/us/it")
    links = re.findall(r"\]\(([^)]+)\)", hosted)
    assert all(link.startswith(("https://", "#")) for link in links)
    assert f"(https://example.org/us/it/raw/HEAD/{images[0]})" in hosted
    assert "[docs/tasks.md](https://example.org/us/it/blob/HEAD/docs/tasks.md)" in shown["readme"](
        "[docs/tasks.md](docs/tasks.md)", "https://example.org/us/it"
    )
    assert all(
        url.startswith("https://example.org/us/it")
        for url in shown["addresses"]("https://example.org/us/it").values()
    )

    unknown = shown["readme"](text, "")
    assert "docs/images" not in unknown
    assert all(link.startswith(("https://", "#")) for link in re.findall(r"\]\(([^)]+)\)", unknown))
    assert shown["addresses"]("") == {}


def test_workflow_runs_what_ci_runs_with_pinned_actions() -> None:
    workflow = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    assert {"run": ".ci/run"} in steps
    actions = [step["uses"] for step in steps if "uses" in step]
    assert actions and all(re.fullmatch(r"actions/[a-z-]+@[0-9a-f]{40}", action) for action in actions)
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    commands = (ROOT / ".ci/run").read_text() + (ROOT / "CONTRIBUTING.md").read_text()
    assert set(re.findall(r"^make ([a-z-]+)", commands, re.MULTILINE)) <= targets


def locked(name: str) -> dict[str, str]:
    """Package → version of a lock file."""
    return dict(re.findall(r"^([A-Za-z0-9._-]+)==([^ ]+)", (ROOT / name).read_text().lower(), re.MULTILINE))


def direct(*wanted: str) -> set[str]:
    """The names of requirements, with those of our own optional parts in place of ``franka-wm[…]``."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    ours = [w for w in wanted if w.startswith("franka-wm[")]
    parts = [part for w in ours for part in w.split("[")[1].rstrip("]").split(",")]
    names = [w for w in wanted if w not in ours] + [w for part in parts for w in extras[part]]
    return {re.split(r"[\[<>=~! ]", w)[0].lower().replace("_", "-") for w in names}


@pytest.mark.parametrize("name", ["requirements.lock", "requirements-dev.lock"])
def test_lock_holds_hashes_and_no_addresses(name: str) -> None:
    lock = (ROOT / name).read_text()
    assert "://" not in lock
    assert "--index-url" not in lock
    packages = re.findall(r"^[A-Za-z0-9][^ ]*==", lock, flags=re.MULTILINE)
    entries = re.split(r"^(?=[A-Za-z0-9])", lock, flags=re.MULTILINE)[1:]
    assert len(packages) == len(entries) > 50
    assert all("--hash=sha256:" in entry for entry in entries)


def test_locks_cover_every_direct_dependency() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    running = direct(*project["dependencies"], "franka-wm[view]", "setuptools", "uv")
    assert running <= locked("requirements.lock").keys()
    everything = running | direct("franka-wm[dev]") | direct(*project["optional-dependencies"]["dev"])
    assert everything - {"franka-wm"} <= locked("requirements-dev.lock").keys()


def test_lock_for_running_is_part_of_the_lock_for_tests() -> None:
    assert locked("requirements.lock").items() <= locked("requirements-dev.lock").items()


def test_user_error_is_one_line_and_a_value_error() -> None:
    error = UserError("num_envs is 0;\n   at least 1 is needed")
    assert str(error) == "num_envs is 0; at least 1 is needed"
    assert isinstance(error, ValueError)
    assert isinstance(error, FrankaError)


def test_the_wheel_takes_every_file_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    patterns = [*project["tool"]["setuptools"]["package-data"]["*"], "*.py"]
    files = [path for path in (ROOT / "franka_wm").rglob("*") if path.is_file() and path.suffix != ".pyc"]
    assert not [str(path) for path in files if not any(path.match(one) for one in patterns)]


def test_docstrings_begin_with_a_noun_or_a_verb() -> None:
    """Not ``seed: Of the run.``: a reader of one line must know what it is."""
    begins = re.compile(r'"""Of |^\s+\w+(, \w+)*: Of ')
    files = sorted((Path(franka_wm.__file__).parent).rglob("*.py"))
    lines = [(file, line) for file in files for line in file.read_text(encoding="utf-8").splitlines()]
    assert not [f"{file.name}: {line.strip()}" for file, line in lines if begins.search(line)]
