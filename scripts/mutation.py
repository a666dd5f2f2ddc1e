"""Mutation testing: small mistakes put into the code one at a time, and whether the tests notice.

    make mutation                                          every target of scripts/mutation.yaml; hours on one core
    make mutation ARGS="--only seeding masks --sample 40 --jobs 2"

The mistakes are cosmic-ray's (https://cosmic-ray.readthedocs.io), the run is ours: torch and its like are imported
once, and every mutant is tested in a fork of that process, which is given the changed module instead of the file. No
file is ever changed. Writes docs/mutation.json, and docs/mutation.md from it.
"""

from __future__ import annotations

import argparse
import ast
import importlib.abc
import importlib.util
import json
import os
import random
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from franka_wm.errors import UserError  # noqa: E402
from franka_wm.files import atomic_write  # noqa: E402
from franka_wm.source import code_hash  # noqa: E402
from franka_wm.versions import versions  # noqa: E402

DECLARED = ROOT / "scripts" / "mutation.yaml"
RESULTS = ROOT / "docs" / "mutation.json"
PAGE = ROOT / "docs" / "mutation.md"

HEAVY = (
    "hydra", "hypothesis", "newton", "omegaconf", "pytest", "safetensors.torch", "tensordict.nn", "torch",
    "torchrl.collectors", "torchrl.data", "torchrl.envs", "torchrl.modules", "warp",
)  # fmt: skip
"""Imported before forking; nothing of ours is among them."""

PAIRS = {
    "ReplaceBinaryOperator": "Add_Sub Sub_Add Mul_Div Div_Mul Pow_Mul FloorDiv_Mul Mod_Mul BitOr_BitAnd BitAnd_BitOr",
    "ReplaceComparisonOperator": "Eq_NotEq NotEq_Eq Lt_LtE Lt_GtE LtE_Lt LtE_Gt "
    "Gt_GtE Gt_LtE GtE_Gt GtE_Lt Is_IsNot IsNot_Is",
    "ReplaceUnaryOperator": "USub_UAdd Delete_USub Delete_Invert Delete_Not",
}  # fmt: skip
OPERATORS = (
    *(f"{name}_{pair}" for name, pairs in PAIRS.items() for pair in pairs.split()),
    "AddNot", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue", "ReplaceAndWithOr", "ReplaceOrWithAnd", "NumberReplacer",
    "ReplaceBreakWithContinue", "ReplaceContinueWithBreak", "RemoveDecorator", "ZeroIterationForLoop",
)  # fmt: skip
"""Of cosmic-ray's; of `a + b` its minus stands for all the others, which every test of a sum would notice."""


@dataclass(frozen=True)
class Target:
    """A file, the functions in it that are changed, and the tests that must notice."""

    path: str
    tests: list[str]
    only: list[str] = field(default_factory=list)
    explained: dict[str, str] = field(default_factory=dict)

    @property
    def module(self) -> str:
        return self.path.removesuffix(".py").replace("/", ".")

    @property
    def code(self) -> str:
        return (ROOT / self.path).read_text()

    @property
    def hash(self) -> str:
        """Of what the file does, without comments and docstrings."""
        return code_hash(self.path, self.code.encode())


@dataclass(frozen=True)
class Mutant:
    """One mistake in one line."""

    target: Target
    operator: str
    occurrence: int
    line: int

    def code(self) -> str:
        """The whole file with the mistake."""
        from cosmic_ray.mutating import mutate_code
        from cosmic_ray.plugins import get_operator

        changed = mutate_code(self.target.code, get_operator(f"core/{self.operator}")(), self.occurrence)
        assert changed is not None
        return changed

    def change(self) -> str:
        """``line before → line after``."""
        before, after = (
            [line for line in code.splitlines() if line.strip()] for code in (self.target.code, self.code())
        )
        apart = next(
            (k for k, (a, b) in enumerate(zip(before, after, strict=False)) if a != b), self.line - 1
        )
        # cosmic-ray sets a blank before numbers
        changed = after[apart].strip().replace("( ", "(").replace("[ ", "[")
        return f"{before[apart].strip()} → {changed}"


def load_targets(path: Path = DECLARED) -> list[Target]:
    """What mutation.yaml declares.

    Raises:
        UserError: It names a file or a function that is not there.
    """
    targets = [Target(name, **entry) for name, entry in yaml.safe_load(path.read_text())["targets"].items()]
    for target in targets:
        for file in (target.path, *target.tests):
            if not (ROOT / file).is_file():
                raise UserError(f"{path.name}: {target.path}: there is no {file}")
        ranges(target)
    return targets


# -- where mistakes are put ---------------------------------------------------------------------------------


def ranges(target: Target) -> list[tuple[int, int]]:
    """First and last lines of what the target names.

    Raises:
        UserError: One of the names is not there.
    """
    found: dict[str, tuple[int, int]] = {}

    def visit(node: ast.AST, prefix: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, (ast.FunctionDef, ast.ClassDef)):
                first = min([child.lineno, *(one.lineno for one in child.decorator_list)])
                assert child.end_lineno is not None
                found[prefix + child.name] = (first, child.end_lineno)
                visit(child, f"{prefix}{child.name}.")

    visit(ast.parse(target.code), "")
    if missing := [name for name in target.only if name not in found]:
        raise UserError(f"mutation.yaml: {target.path} has no {', '.join(missing)}")
    return [found[name] for name in target.only] or [(1, len(target.code.splitlines()))]


def not_executed(code: str) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Positions of annotations, which nobody evaluates, and of the messages of errors."""
    for node in ast.walk(ast.parse(code)):
        nodes: list[ast.AST | None] = []
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            nodes = [node.returns]
        elif isinstance(node, (ast.arg, ast.AnnAssign)):
            nodes = [node.annotation]
        elif isinstance(node, ast.Raise):
            nodes = [node.exc]
        for one in nodes:
            if isinstance(one, ast.expr):
                assert one.end_lineno is not None and one.end_col_offset is not None
                yield (one.lineno, one.col_offset), (one.end_lineno, one.end_col_offset)


def mutants(target: Target) -> list[Mutant]:
    """Every mistake that the operators know, in the code that the target names."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator

    code = target.code
    lines, silent = ranges(target), list(not_executed(code))
    nodes = list(ast_nodes(get_ast(code)))
    found = []
    for name in OPERATORS:
        operator = get_operator(f"core/{name}")()
        positions = [position for node in nodes for position in operator.mutation_positions(node)]
        for occurrence, (start, _) in enumerate(positions):
            inside = any(first <= start[0] <= last for first, last in lines)
            if inside and not any(begin <= start < end for begin, end in silent):
                found.append(Mutant(target, name, occurrence, start[0]))
    return found


# -- whether tests notice -----------------------------------------------------------------------------------


class Changed(importlib.abc.MetaPathFinder, importlib.abc.SourceLoader):
    """Imports one module from the given code instead of its file."""

    def __init__(self, module: str, path: Path, code: str) -> None:
        self.module, self.path, self.code = module, path, code

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> Any:
        if fullname != self.module:
            return None
        return importlib.util.spec_from_file_location(fullname, self.path, loader=self)

    def get_filename(self, fullname: str) -> str:
        return str(self.path)

    def get_data(self, path: str | bytes) -> bytes:
        return self.code.encode()

    def path_stats(self, path: str | bytes) -> Mapping[str, Any]:
        raise OSError("never cached")


def start(target: Target, code: str) -> int:
    """Forks a process that runs the target's tests on this code; its id. It exits with pytest's status."""
    sys.stdout.flush()
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", DeprecationWarning
        )  # of threads that torch keeps; they hold no lock of ours
        pid = os.fork()
    if pid:
        return pid
    status = 3
    try:
        os.setsid()
        quiet = os.open(os.environ.get("MUTATION_LOG", os.devnull), os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        os.chdir(ROOT)
        for name in [name for name in sys.modules if name.split(".")[0] == "franka_wm"]:
            del sys.modules[name]  # what this script imported itself
        sys.meta_path.insert(0, Changed(target.module, ROOT / target.path, code))
        import pytest

        with tempfile.TemporaryDirectory() as folder:
            options = [
                "-x",
                "-q",
                "-p",
                "no:cacheprovider",
                "-m",
                "not slow and not gpu",
                f"--basetemp={folder}/t",
            ]
            status = int(pytest.main([*options, *target.tests]))
    finally:
        os._exit(status)


def judge(jobs: Sequence[tuple[Target, str]], *, at_once: int, limit: float) -> Iterator[tuple[int, str]]:
    """Index and outcome of each job as it ends: ``survived``, ``killed`` or, past ``limit`` seconds, ``timeout``."""
    waiting = list(enumerate(jobs))[::-1]
    running: dict[int, tuple[int, float]] = {}
    try:
        while waiting or running:
            while waiting and len(running) < at_once:
                index, (target, code) = waiting.pop()
                running[start(target, code)] = (index, time.monotonic())
            for pid, (index, since) in list(running.items()):
                done, status = os.waitpid(pid, os.WNOHANG)
                if done:
                    del running[pid]
                    yield index, "killed" if status else "survived"
                elif time.monotonic() - since > limit:
                    _end(pid)
                    del running[pid]
                    yield index, "timeout"
            time.sleep(0.02)
    finally:
        for pid in running:
            _end(pid)


def _end(pid: int) -> None:
    """Ends a process that was started here, and its own."""
    os.killpg(pid, signal.SIGKILL)
    os.waitpid(pid, 0)


def measure(target: Target, *, sample: int | None, seed: int, at_once: int) -> dict[str, Any]:
    """Puts mistakes into one target.

    Args:
        target: What to change.
        sample: How many mistakes, drawn at random; all if not given.
        seed: Of the draw.
        at_once: Processes at a time.

    Raises:
        UserError: Its tests fail as they are.
    """
    everything = mutants(target)
    chosen = everything
    if sample is not None and sample < len(everything):
        chosen = sorted(random.Random(seed).sample(everything, sample), key=lambda one: one.line)
    begin = time.monotonic()
    ((_, outcome),) = judge([(target, target.code)], at_once=1, limit=600)
    taken = time.monotonic() - begin
    if outcome != "survived":
        raise UserError(f"{target.path}: {' '.join(target.tests)} fail as they are; mend them first")
    print(f"{target.path}: {len(chosen)} of {len(everything)} mutants, tests take {taken:.0f} s", flush=True)
    outcomes = {"killed": 0, "survived": 0, "timeout": 0}
    survivors = []
    jobs = [(target, one.code()) for one in chosen]
    for index, outcome in judge(jobs, at_once=at_once, limit=30 + 5 * taken * at_once):
        outcomes[outcome] += 1
        if outcome == "survived":
            one = chosen[index]
            survivors.append({"line": one.line, "operator": one.operator, "change": one.change()})
            print(f"  survived, line {one.line}: {one.change()}", flush=True)
    return {
        "tests": target.tests,
        "mutants": len(everything),
        "tested": len(chosen),
        "sample_seed": seed if len(chosen) < len(everything) else None,
        **outcomes,
        "survivors": sorted(survivors, key=lambda one: (one["line"], one["operator"])),
        "hash": target.hash,
        "commit": versions().get("commit"),
        "date": datetime.now(UTC).date().isoformat(),
    }


# -- the page -----------------------------------------------------------------------------------------------

HEAD = """# Mutation testing

Small mistakes are put into the code that decides results, one at a time: a minus for a plus, `<=` for `<`, one more, a
condition turned round. A mistake that no test notices shows what is not tested, or changes nothing. Written by
`make mutation` from [mutation.json](mutation.json); `scripts/mutation.yaml` names the code, its tests, and why
survivors change nothing.

```bash
make mutation                                                   # everything; installs cosmic-ray
make mutation ARGS="--only seeding masks --sample 40 --jobs 2"  # some files, 40 mistakes each, two processes
```

*Score* is what tests noticed, those that never ended included; *without explained* leaves out survivors that change
nothing, or nothing on a CPU, each with its reason below. A drawn sample is the same for everybody (`--seed 0`).
*Changed since*: the file does something else than when its mutants were run.
"""


def page(targets: Sequence[Target], results: Mapping[str, Any]) -> str:
    """The content of docs/mutation.md."""
    titles = [
        "file",
        "tested of all",
        "killed",
        "never ended",
        "survived",
        "score",
        "without explained",
        "at commit",
    ]
    lines = ["| " + " | ".join(titles) + " |", "|---|" + "---:|" * 6 + "---|"]
    changed, total = 0, dict.fromkeys(("mutants", "tested", "killed", "timeout", "survived"), 0)
    explained, rest = 0, []
    for target in targets:
        found = results.get(target.path)
        if found is None:
            lines.append(f"| `{target.path}` |" + " |" * 6 + " not run yet |")
            continue
        same = sum(one["change"] in target.explained for one in found["survivors"])
        since = "" if found["hash"] == target.hash else ", changed since"
        changed += bool(since)
        lines.append(_line(f"`{target.path}`", found, same, f"{found['commit']}, {found['date']}{since}"))
        total = {name: total[name] + found[name] for name in total}
        explained += same
        rest += [(target, one) for one in found["survivors"]]
    missing = sum(target.path not in results for target in targets)
    together = "together" + (f", {missing} of {len(targets)} files not run" if missing else "")
    lines.append(_line(together, total, explained, ""))
    lines += ["", "## Survivors", ""]
    for target, one in rest:
        reason = target.explained.get(one["change"], "**no test notices it**")
        before, after = one["change"].split(" → ", 1)
        lines.append(f"- `{target.path}`, line {one['line']}: `{before}` → `{after}`: {reason}")
    part = ", a sample" if total["tested"] < total["mutants"] else ""
    tried = f"**{total['tested']} of {total['mutants']} mistakes were tried**{part}"
    aged = f"; {changed} of {len(targets) - missing} files have changed since theirs were."
    return "\n".join([HEAD, tried + (aged if changed else "."), "", *lines, ""])


def _line(name: str, found: Mapping[str, Any], explained: int, made: str) -> str:
    tested, noticed = found["tested"], found["killed"] + found["timeout"]
    cells = [f"{tested} of {found['mutants']}", found["killed"], found["timeout"], found["survived"]]
    cells += [percent(noticed, tested), percent(noticed, tested - explained), made]
    return f"| {name} | " + " | ".join(map(str, cells)) + " |"


def percent(part: int, whole: int) -> str:
    return f"{100 * part // whole} %" if whole else "–"  # down: 100 % is all of them


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", help="files whose path holds one of these words")
    parser.add_argument("--sample", type=int, help="so many mistakes for each file; default: all")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    parser.add_argument("--page", action="store_true", help="write docs/mutation.md from what was measured")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    chosen = parse(arguments)
    results = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {}
    try:
        targets = load_targets()
        wanted: Callable[[str], bool] = lambda path: not chosen.only or any(w in path for w in chosen.only)  # noqa: E731
        if not chosen.page:
            # A process with threads cannot be forked safely.
            os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
            for name in HEAVY:
                importlib.import_module(name)
            for target in [target for target in targets if wanted(target.path)]:
                found = measure(target, sample=chosen.sample, seed=chosen.seed, at_once=chosen.jobs)
                results[target.path] = found
                with atomic_write(RESULTS) as temporary:
                    temporary.write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n")
        with atomic_write(PAGE) as temporary:
            temporary.write_text(page(targets, results))
    except (UserError, ModuleNotFoundError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(f"written: {PAGE.relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
