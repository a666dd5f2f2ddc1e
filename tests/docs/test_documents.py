"""What the documents promise: links lead somewhere, code blocks run, commands compose."""

import ast
import importlib
import importlib.util
import re
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import click
import pytest
import torch
from hydra.core.override_parser.overrides_parser import OverridesParser

from forks import script, spare
from franka_wm.commands.demo import AGENT

ROOT = Path(__file__).resolve().parents[2]
GROUPS = ("*.md", "docs/*.md", "docs/models/*.md", "docs/reference/*.md", ".github/*.md")
DOCUMENTS = sorted(file for pattern in GROUPS for file in ROOT.glob(pattern))
NAMES = [file.relative_to(ROOT).as_posix() for file in DOCUMENTS]

FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"(?<!`)\[[^\]]*\]\(([^)\s]+)\)")


def blocks(name: str, language: str) -> list[str]:
    """The code blocks of one language in a document."""
    return [code for found, code in FENCE.findall((ROOT / name).read_text()) if found == language]


# -- links ------------------------------------------------------------------------------------------------


def anchors(document: Path) -> set[str]:
    """The fragments that a Markdown file's headings answer to, as GitHub makes them."""
    text = FENCE.sub("", document.read_text())
    headings = re.findall(r"^#{1,6} (.+?)#*$", text, re.MULTILINE)
    plain = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower() for heading in headings]
    return {re.sub(r"[^\w\- ]", "", heading).replace(" ", "-") for heading in plain}


@pytest.mark.parametrize("name", NAMES)
def test_links_lead_somewhere(name: str) -> None:
    document = ROOT / name
    targets = [t for t in LINK.findall(FENCE.sub("", document.read_text())) if not re.match(r"\w+:", t)]
    lost = []
    for target in targets:
        path, _, fragment = target.partition("#")
        file = (document.parent / path).resolve() if path else document
        if not file.exists() or (fragment and file.suffix == ".md" and fragment not in anchors(file)):
            lost.append(target)
    assert lost == []


def test_every_page_is_in_the_navigation() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[2].partition("\nexclude_docs")[0]
    pages = {file.relative_to(ROOT / "docs").as_posix() for file in (ROOT / "docs").rglob("*.md")}
    assert {page for page in pages if page not in navigation} == set()


# -- Python -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in NAMES if blocks(name, "python")])
def test_python_blocks_name_what_exists(name: str) -> None:
    for code in blocks(name, "python"):
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("franka_wm"):
                module = importlib.import_module(node.module or "")
                missing = [alias.name for alias in node.names if not hasattr(module, alias.name)]
                missing = [m for m in missing if not importlib.util.find_spec(f"{node.module}.{m}")]
                assert missing == [], node.module


def test_readme_collects(tmp_path: Path) -> None:
    """Two worlds in place of 1,024; otherwise as it stands there, a script that says nothing else."""
    (code,) = blocks("README.md", "python")
    assert code.count("1024") >= 3
    (tmp_path / "script.py").write_text(code.replace("1024", "2"))
    done = spare().fork(script(tmp_path / "script.py"), tmp_path)  # of a process without threads
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    assert len(lines) == 10 and all("torch.Size([2, 16, 64, 64, 3])" in line for line in lines)


def test_environment_page_steps() -> None:
    code, *_ = blocks("docs/environment-names.md", "python")
    scope: dict[str, Any] = {}
    exec(compile(code, "docs/environment-names.md", "exec"), scope)
    pixels, reward = (scope["step"]["next", key] for key in ("pixels", "reward"))
    assert pixels.shape == (8, 64, 64, 3) and reward.shape == (8, 1)


def test_environment_page_samples_windows() -> None:
    """Two worlds in place of 64."""
    code = blocks("docs/environment-names.md", "python")[1]
    scope: dict[str, Any] = {}
    exec(compile(code.replace("64", "2"), "docs/environment-names.md", "exec"), scope)
    batch = scope["batch"]
    assert batch.batch_size == (256, 5) and batch["next", "pixels"].shape == (256, 5, 64, 64, 3)
    assert (batch["pixels"][:, 1:] == batch["next", "pixels"][:, :-1]).all()


def test_environment_page_lets_a_trained_agent_act() -> None:
    (code,) = (one for one in blocks("docs/environment-names.md", "python") if "load_agent" in one)
    scope: dict[str, Any] = {}
    code = code.replace("outputs/DATE/TIME-reach-0", str(AGENT)).replace("num_envs=16", "num_envs=2")
    exec(compile(code, "docs/environment-names.md", "exec"), scope)
    assert scope["episode"].batch_size == (2, 50) and scope["episode"]["next", "truncated"][:, -1].all()
    assert {"planner", "policy", "noop", "random", "ik"} <= {*scope["agent"].policies}


def test_models_page_makes_a_model() -> None:
    (code,) = blocks("docs/models.md", "python")
    scope: dict[str, Any] = {}
    exec(compile(code.partition("model = franka_wm.load")[0], "docs/models.md", "exec"), scope)
    z = scope["model"].encode({"state": torch.zeros(2, 20)})
    assert scope["model"].next(z, torch.zeros(2, 7)).shape == z.shape


def test_planning_page_plans() -> None:
    class Integrator:
        def next(self, z: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
            return z + action

    (code,) = blocks("docs/planning.md", "python")
    scope = {"model": Integrator(), "z": torch.zeros(2, 7), "goal": torch.full((2, 7), 0.5)}
    scope |= {"last": None, "starts": None}
    exec(compile(code, "docs/planning.md", "exec"), scope)
    assert (scope["plan"]["action"].mean(-1) > 0.05).all()


def test_reports_page_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (code,) = blocks("docs/reports.md", "python")
    exec(compile(code, "docs/reports.md", "exec"), {})
    assert {file.name for file in tmp_path.iterdir()} == {"horizon.pdf", "horizon-dark.png"}


# -- commands ---------------------------------------------------------------------------------------------


def commands(program: str) -> Iterator[tuple[str, list[str]]]:
    """(document, arguments) of every documented call of ``program``, comments and continuations resolved.

    Also of calls within a sentence or an indented block, unless they are cut short by ``…``.
    """
    span = re.compile(rf"`({program}\s[^`…]+)`|^ {{4,}}({program} [^…\n]+)$", re.MULTILINE)
    for name in NAMES:
        lines = [
            " ".join("".join(found).split())
            for found in span.findall(FENCE.sub("", (ROOT / name).read_text()))
        ]
        for code in blocks(name, "bash"):
            lines += code.replace("\\\n", " ").splitlines()
        for line in dict.fromkeys(lines):
            if line.startswith(program + " "):
                yield name, shlex.split(line, comments=True)[len(program.split()) :]


PLUGINS = {
    "hydra/launcher=joblib": "hydra_plugins.hydra_joblib_launcher",
    "hydra/launcher=ray": "hydra_plugins.hydra_ray_launcher",
    "hydra/launcher=submitit_slurm": "hydra_plugins.hydra_submitit_launcher",
    "hydra/sweeper=optuna": "hydra_plugins.hydra_optuna_sweeper",
}
"""Packages that Hydra finds its launchers and sweepers in."""

TRAIN = [
    (name, arguments)
    for name, arguments in [*commands("python train.py"), *commands("franka-wm train")]
    # A folder that a reader makes; no training.
    if not any(a.startswith(("hydra.searchpath=[file://mine]", "--cfg")) for a in arguments)
]
VERBS = list(commands("franka-wm"))


def choices(overrides: list[str]) -> Iterator[list[str]]:
    """What a sweep would run: every value of a list ``a=1,2``, the ends of a range, the other lists at their first."""
    parsed = OverridesParser.create().parse_overrides(overrides)
    values = [
        [f"{o.input_line.partition('=')[0]}={o.value().start}"]
        if o.is_interval_sweep()
        else [f"{o.input_line.partition('=')[0]}={v}" for v in o.sweep_string_iterator()]
        if o.is_sweep_override()
        else [o.input_line]
        for o in parsed
    ]
    first = [options[0] for options in values]
    yield first
    for k, options in enumerate(values):
        for option in options[-1:] if parsed[k].is_range_sweep() else options[1:]:
            yield [*first[:k], option, *first[k + 1 :]]


@pytest.mark.parametrize(("name", "arguments"), TRAIN, ids=[f"{n}: {' '.join(a)}" for n, a in TRAIN])
def test_documented_training_composes(
    name: str, arguments: list[str], composed: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    flags = [a for a in arguments if a.startswith("-")]
    assert set(flags) <= {"--multirun", "-m", "--help"}
    overrides = [a for a in arguments if not a.startswith("-")]
    for plugin in [a for a in overrides if a.startswith(("hydra/launcher=", "hydra/sweeper="))]:
        if importlib.util.find_spec(PLUGINS[plugin]) is None:  # an extra of few
            group = plugin.partition("=")[0]
            prefixes = (group, group.replace("/", "."))
            overrides = [a for a in overrides if not a.lstrip("+").startswith(prefixes)]
    for chosen in choices(overrides):
        assert "env" in composed(*chosen)


def test_documented_verbs_take_their_words(composed: Callable[..., Any]) -> None:
    from franka_wm.commands.main import VERBS as known
    from franka_wm.commands.main import program

    calls = [(name, a) for name, a in VERBS if a[0] not in ("train", "VERB") and not a[0].startswith("-")]
    assert len(calls) > 40
    wrong = []
    for name, (verb, *words) in calls:
        try:
            assert verb in known, "no such verb"
            command = program.get_command(click.Context(program), verb)
            needed = {one.name for one in command.params if one.required}
            whole = words and "--help" not in words and needed <= {word.partition("=")[0] for word in words}
            # A sentence may name a verb with some of its words: values are checked of whole calls, names of all.
            context = command.make_context(verb, words, resilient_parsing=not whole)
            if verb == "collect" and not any(word.startswith("hydra.") for word in words):
                composed(*context.params["overrides"])
        except Exception as error:  # all are told together
            wrong.append(f"{name}: {verb} {' '.join(words)}: {error}")
    assert wrong == []


def test_documented_make_targets_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = {(name, a[0]) for name, a in commands("make") if a and "=" not in a[0]}
    assert named and {(name, target) for name, target in named if target not in targets} == set()
