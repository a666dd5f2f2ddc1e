"""``franka-wm``: what it prints, how it fails, and what it does not import."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import franka_wm
from forks import module, spare
from franka_wm.commands import bench, entry, listing
from franka_wm.commands import main as cli
from franka_wm.commands.arguments import check_run
from franka_wm.errors import UserError
from light import Answer, answers


def test_listing_imports_neither_simulator_nor_torch() -> None:
    code = (
        "import sys; from franka_wm.commands import main as cli; assert cli.main(['list']) == 0;"
        "print([m for m in ('torch', 'newton', 'warp', 'torchrl', 'hydra', 'numpy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_list_names_everything_with_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    entries = [line.split(maxsplit=1) for line in lines if line.startswith("  ")]
    names = {entry[0] for entry in entries}
    conf = Path(franka_wm.__file__).parents[1] / "conf"
    assert names >= {file.stem for group in ("env", "planner") for file in (conf / group).glob("*.yaml")}
    assert names >= {"embedded", "reach", "tdmpc2"}
    assert all(len(entry) == 2 for entry in entries), "an entry has no description"
    groups = ("env", "model", "planner", "pretrain", "dataset", "scale", "experiment")
    cut = [line for group in groups for line in listing.options(group).values() if line[-1] not in ".?"]
    assert not cut, "only the first line of a file's comment is shown: it must end a sentence"


def test_list_shows_what_is_one_s_own(tmp_path: Path) -> None:
    """Plugins, their configuration groups, datasets in ./datasets; without them, what the package has."""
    examples = Path(franka_wm.__file__).parents[1] / "examples"
    (tmp_path / "examples").symlink_to(examples)
    for name, text in (("whole", '{"total_episodes": 1200, "total_frames": 60000}'), ("broken", "{")):
        (tmp_path / "datasets" / name / "meta").mkdir(parents=True)
        (tmp_path / "datasets" / name / "meta" / "info.json").write_text(text)
    plugins = [f"examples.add_a_{kind}" for kind in ("model", "planner", "task")]
    own = [f"plugins=[{','.join(plugins)}]", "hydra.searchpath=[file://examples/conf]"]

    # In forks of a process in which no test has imported these plugins.
    shown = []
    for words in ([], own):
        done = spare().fork(module("franka_wm", "list", *words), tmp_path)
        assert done.returncode == 0, done.stderr
        shown.append(done.stdout)
    names = [{tuple(line.split()) for line in text.splitlines()} for text in shown]
    more = {line[0] for line in names[1] - names[0] if line[0] not in ("models", "planners", "tasks")}
    assert more == {"linear", "shooting", "raise_tool"}
    assert "planner.name=" in shown[1] and "planner.name=" not in shown[0]
    for text in shown:
        assert "datasets/whole           1,200 episodes, 60,000 steps" in text
        assert "datasets/broken          meta/info.json cannot be read" in text
        for choice in ("vjepa", "two_stages", "lerobot", "laptop"):
            assert f"\n  {choice} " in text


def test_robots_are_those_that_the_config_accepts() -> None:
    from franka_wm.envs import FrankaConfig

    with pytest.raises(ValueError, match="must be one of") as error:
        FrankaConfig(robot="?")
    accepted = str(error.value).split("must be one of ")[1].split(";")[0].split(", ")
    assert sorted(listing.ROBOTS) == sorted(accepted)


def test_tasks_are_those_that_the_config_accepts() -> None:
    from franka_wm.envs import FrankaConfig
    from franka_wm.envs.tasks import _REGISTERED

    with pytest.raises(ValueError, match="must be one of") as error:
        FrankaConfig(task="?")
    accepted = str(error.value).split("must be one of ")[1].split(";")[0].split(", ")
    # Another test in this process may have registered a task of its own.
    assert sorted(listing.tasks()) == sorted(set(accepted) - set(_REGISTERED))
    assert all(listing.tasks().values())


def test_unknown_verb_is_one_line_and_status_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["fly"]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: no verb 'fly'")
    assert cli.main(["evalute"]) == 2 and "did you mean evaluate?" in capsys.readouterr().err
    assert captured.err.count("\n") == 1


@pytest.mark.parametrize("arguments", [["bench", "nothing"], ["list", "x"]])
def test_bad_arguments_are_one_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(arguments) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_version_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"franka-wm {franka_wm.__version__}\n"
    assert cli.main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(f"\n  {verb} " in out for verb in cli.VERBS)


def test_the_package_runs_as_a_module() -> None:
    for arguments, status in ((["list"], 0), (["nothing"], 2)):
        command = [sys.executable, "-m", "franka_wm", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == status
        assert ("panda_meshes" in done.stdout) == (status == 0)


def test_a_verb_is_one_line_in_the_table(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a_verb.py").write_text(
        "from franka_wm.commands.arguments import verb, word\n"
        "from franka_wm.errors import UserError\n"
        "@verb('try')\n"
        "@word('x', 'what')\n"
        "def run(x):\n"
        "    if x == 'stop': raise KeyboardInterrupt\n"
        "    if x: raise UserError('bad:\\n  ' + x)\n"
        "    return 7\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(cli.VERBS, "try", "a_verb:run")
    assert cli.main(["try"]) == 7
    assert cli.main(["try", "x=y"]) == 1
    assert capsys.readouterr().err == "error: bad: y\n"
    assert cli.main(["try", "x=stop"]) == 130
    assert not capsys.readouterr().err.strip()


HEAVY = {"torch", "tensordict", "torchrl", "newton", "warp", "pandas", "scipy", "matplotlib", "lerobot"}
"""Modules that take seconds to import, or import those that do."""


VERBS = [verb for verb in cli.VERBS if verb != "train"]
WRONG: list[tuple[list[str], str]] = [
    (["list", "x"], "'x': write options as name=value"),
    (["list", "hydra.searchpath=[file://nowhere]"], "nowhere is not a folder"),
    (["list", "plugin=x"], "did you mean plugins?"),
    (["evaluate", "checkpoint=x", "episode=3"], "did you mean episodes?"),
    # also for root, who may write anywhere
    (["evaluate", "checkpoint=x", "out=/proc/x"], "/proc is not writable"),
    (["collect", "out=/proc/x"], "/proc is not writable"),
    (["export", "source=hf:me/run", "out=/proc/x"], "/proc is not writable"),
    (["view", "rerun=/proc/x.rrd"], "/proc is not writable"),
    (["report", "RUN", "out=/proc/x.html"], "/proc is not writable"),
    (["compare", "A", "B", "out=/proc/x.html"], "/proc is not writable"),
    (["evaluate", "checkpoint=x", "episodes=10000000000"], "at most 1000000"),
    (["collect", "out=x", "workers=1000000"], "at most 256"),
    (["evaluate", "checkpoint=x", "episodes=1"], "episodes=1: must be a whole number of at least 2"),
    (["evaluate", "episodes=3"], "give checkpoint="),
    (["summary", "--x"], "x: no such option"),
    (["report", "RUN", "ot=x.html"], "did you mean out?"),
    (["compare", "A", "B", "--outt=x.html"], "did you mean out?"),
    (["view", "prot=3"], "did you mean port?"),
    (["view", "env.goal={"], "env.goal"),
    (["demo", "port=x"], "port=x: must be a whole number"),
    (["collect", "out=x", "episode=3"], "did you mean episodes?"),
    (["collect", "out=x", "policy=smart"], "policy='smart': must be one of"),
    (["collect", "out=x", "env.image_sise=3"], "did you mean env.image_size?"),
    (["collect", "out=x", "seed=abc"], "seed=abc: must be a whole number"),
    (["export", "source=x", "out=y", "format=gif"], "format=gif: must be one of exact, video"),
    (["publish", "repo_id=user/name", "rot=x"], "did you mean root?"),
    (["publish", "repo_id=user/name"], "give root=DATASET or checkpoint=RUN"),
    (["report", "RUN", "out=x"], "out=x: the page must end in .html"),
    (["compare", "A", "B"], "A is not a folder"),
    (["evaluate", "nowhere"], "checkpoint=nowhere: no such folder"),
    (["view", "env=nope"], "env=nope: must be one of dm_control, drawer"),
    (["view", "checkpoint=nowhere"], "checkpoint=nowhere: no such folder"),
    (["export", "source=nowhere", "out=y"], "source=nowhere: no such folder"),
    (["bench", "envv"], "did you mean env?"),
]


@pytest.fixture(scope="module")
def answered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Callable[..., Answer]]:
    """The folder in which all of them ran, and how each of them ended."""
    place = tmp_path_factory.mktemp("verbs")
    program = ("-m", "franka_wm")
    helps = [(*program, verb, flag) for verb in VERBS for flag in ("--help", "-h")]
    found = answers([*helps, *((*program, *arguments) for arguments, _ in WRONG)], place)
    return place, lambda *arguments: found[(*program, *arguments)]


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_every_verb_has_one_form_and_imports_nothing_heavy(verb: str, answered) -> None:
    """The usage, what it does, a line for each option; -h is the same."""
    done = answered[1](verb, "--help")
    lines = done.stdout.splitlines()
    assert done.returncode == 0 and lines[0].startswith(f"usage: franka-wm {verb}") and not done.stderr
    assert lines[2].startswith("  ") and lines[2].strip()[0].isupper()
    assert [line.split() for line in lines if line.strip()][-1] == ["--help", "print", "this"]
    assert "click" in done.loaded and not done.loaded & HEAVY
    assert answered[1](verb, "-h").stdout == done.stdout


@pytest.mark.parametrize(("arguments", "said"), WRONG)
def test_bad_arguments_are_answered_before_anything_heavy_is_imported(
    arguments: list[str], said: str, answered
) -> None:
    place, found = answered
    done = found(*arguments)
    assert done.returncode == 1 and said in done.stderr and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("error: ") and not done.loaded & HEAVY
    assert list(place.iterdir()) == []


def test_a_run_is_there_while_its_checkpoint_is_replaced(tmp_path: Path) -> None:
    """Killed between two renames, NAME is only there as NAME.old, which is read in its place."""
    (tmp_path / "last.old" / "checkpoints").mkdir(parents=True)
    check_run("view", "checkpoint", f"{tmp_path}/last/")
    with pytest.raises(UserError, match="no such folder"):
        check_run("view", "checkpoint", str(tmp_path / "first"))


def test_a_folder_that_is_no_runs_is_refused_before_anything_is_loaded(tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    with pytest.raises(UserError, match=r"is no run.s folder; give one as train\.py prints it last"):
        check_run("view", "checkpoint", str(tmp_path))
    latest = tmp_path / "pretrained" / "checkpoints" / "latest"  # a run that ended in its first stage
    latest.mkdir(parents=True)
    (latest / "manifest.json").touch()
    for one in (latest, latest.parent, latest.parent.parent):
        check_run("view", "checkpoint", str(one))
    check_run("view", "checkpoint", str(tmp_path))


def test_shells_complete_verbs_options_and_choices(monkeypatch: pytest.MonkeyPatch) -> None:
    for words, wanted in (
        ("franka-wm ev", "evaluate"),
        ("franka-wm evaluate --epi", "--episodes"),
        ("franka-wm export --format vid", "video_near_lossless"),
    ):
        variables = {"_FRANKA_WM_COMPLETE": "bash_complete", "COMP_WORDS": words}
        variables["COMP_CWORD"] = str(len(words.split()) - 1)
        command = [sys.executable, "-m", "franka_wm"]
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, env=os.environ | variables
        )
        assert f"plain,{wanted}" in done.stdout.splitlines()


def test_bench_runs_the_script_with_its_arguments_and_status(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "benchmarks").mkdir()
    (tmp_path / "pyproject.toml").touch()
    (tmp_path / "benchmarks" / "common.py").write_text("FACTOR = 2\n")
    (tmp_path / "benchmarks" / "tiny.py").write_text(
        "import sys\nfrom common import FACTOR\nprint(FACTOR, sys.argv[1:])\nsys.exit(3)\n"
    )
    monkeypatch.setattr(bench, "CHECKOUT", tmp_path)
    assert cli.main(["bench", "tiny", "--worlds", "4"]) == 3
    assert "2 ['--worlds', '4']" in capfd.readouterr().out
    assert cli.main(["bench", "common"]) == 1, "common is no benchmark"


def test_outside_a_checkout_bench_says_so_and_list_still_lists(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "CHECKOUT", tmp_path)
    assert cli.main(["bench", "env"]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "checkout" in error
    assert cli.main(["list"]) == 0
    assert "tdmpc2" in capsys.readouterr().out


@pytest.mark.parametrize("words", ["list", "train --help"])
def test_a_closed_pipe_leaves_no_traceback(words: str) -> None:
    """Whether Python keeps what is printed until it ends, as it does for a pipe, or not."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    reads, writes = os.pipe()
    os.close(reads)
    with os.fdopen(writes, "w") as closed:
        command = [sys.executable, "-m", "franka_wm.commands.main", *words.split()]
        for environment in (kept, kept | {"PYTHONUNBUFFERED": "1"}):
            done = subprocess.run(
                command, stdout=closed, stderr=subprocess.PIPE, env=environment, text=True, check=False
            )
            assert done.stderr == "" and done.returncode == 1


def test_ctrl_c_before_a_run_begins(monkeypatch, capsys) -> None:
    """`train.py`: while the configuration is composed, or libraries are loaded."""

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(entry, "check_command", interrupted)
    with pytest.raises(SystemExit) as caught:
        entry.run_command(lambda: None, ["scale=smoke"])
    assert caught.value.code == 130 and capsys.readouterr().err == ""
