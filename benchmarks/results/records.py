"""What one run measured, as a small JSON file: docs/results/ROW/seed-S.json, or run.json of a benchmark.

The code and configuration that it was measured with are those of all seeds, as a rule. They stand once in
docs/results/code/HASH.json, which the files name.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from benchmarks.results.rows import Row
from franka_wm.errors import UserError
from franka_wm.evaluation.results import END, read_result, to_json
from franka_wm.files import atomic_write
from franka_wm.policies.names import RENAMED
from franka_wm.report.run import SAME_BUT, read_config
from franka_wm.source import ROOT
from franka_wm.versions import PACKAGES

PLACE = ROOT / "docs" / "results"
CODE, CONFIRMED = "code", "confirmed"
BESIDE = ("logger", "evaluation.video_episodes", "trainer.checkpoint_replay")
"""Arguments that a run may have beside its row's, or lack: they change none of its numbers but times."""
FREE = ("seed", "device", *BESIDE)
"""What a run may say otherwise than its row."""


def record_run(row: Row, folder: Path, *, jobs: int, commit: str | None = None) -> dict[str, Any]:
    """What a finished run of ``train.py`` left in its folder.

    Args:
        row: The row that it is a seed of.
        folder: The run's.
        jobs: How many runs shared the machine: its GPU, or its cores.
        commit: Of the code, where the run could not tell.

    Raises:
        UserError: It did not finish, was resumed or evaluated again in its place, is not a run of this row and one of
            its seeds, or ran on another kind of machine.
    """
    versions, finished, found = (
        read_json(folder / f"{name}.json") for name in ("versions", "finished", "evaluation")
    )
    config = read_config(folder)
    if not versions or not finished or not found:
        raise UserError(f"{folder}: not the folder of a run that finished; results need the whole run")
    if config.get("resume"):
        raise UserError(f"{folder}: a run that was resumed; results need runs in one piece")
    check_seed(row, config["seed"], folder)
    typed = overrides(folder)
    check_arguments(row, typed, folder)
    check_machine(row, versions, folder)
    result = read_result(folder / "evaluation.json")
    if (by := result.protocol.get("by")) != END:
        raise UserError(f"{folder}: evaluation.json is by {by}; results need what the run's own end found")
    kept = {name: value for name, value in config.items() if name not in SAME_BUT}
    return {
        "row": row.name,
        "seed": config["seed"],
        "command": shlex.join(["python", "train.py", *typed]),
        **_made_with(versions, jobs, commit),
        "training": _training(folder) | {"command_seconds": finished["seconds"]},
        "protocol": result.protocol,
        "policies": result.policies,
        "code": {"files": finished["source"], "config": kept},
    }


def record_benchmark(row: Row, file: Path, *, jobs: int = 1, commit: str | None = None) -> dict[str, Any]:
    """What a benchmark wrote with ``--out``.

    Args:
        row: The row that it measures.
        file: What it wrote.
        jobs: How many runs shared the GPU or the cores, itself included.
        commit: Of the code, where the run could not tell.

    Raises:
        UserError: The file is not one of a benchmark, was made with other arguments, or on another kind of machine.
    """
    found = read_json(file)
    if not found or not {"machine", "rows"} <= set(found) or "source" not in found["machine"]:
        raise UserError(f"{file}: not what a benchmark wrote with --out")
    check_machine(row, found["machine"], file)
    check_script(row, found["machine"].get("command"), file)
    return {
        "row": row.name,
        "command": shlex.join(row.command),
        **_made_with(found["machine"], jobs, commit),
        "rows": found["rows"],
        "code": {"files": found["machine"]["source"], "config": {}, "composed": found.get("composed", {})},
    }


def check_arguments(row: Row, typed: Sequence[str], where: Any) -> None:
    """Refuses a run whose command is not the row's.

    Raises:
        UserError: It says which arguments differ.
    """
    wanted, given = (
        {a for a in some if a.split("=", 1)[0] not in FREE} for some in (map(str, row.words), map(str, typed))
    )
    if wanted != given:
        apart = [f"without {a}" for a in sorted(wanted - given)] + [
            f"with {a}" for a in sorted(given - wanted)
        ]
        raise UserError(f"{where}: not a run of {row.name}, started {', '.join(apart)}")


def check_seed(row: Row, seed: Any, where: Any) -> None:
    """Refuses a run of a seed that the row does not declare: its means would be of other runs than it says.

    Raises:
        UserError: It says which are declared.
    """
    if row.seeds and seed not in row.seeds:
        raise UserError(f"{where}: seed {seed} is none of {row.name}'s, {row.seeds[0]} – {row.seeds[-1]}")


def check_script(row: Row, typed: Sequence[str] | None, where: Any) -> None:
    """Refuses a benchmark whose command, as far as its file says it, is not the row's.

    Raises:
        UserError: It says what it was made by.
    """
    if typed is None:  # of an earlier version
        return
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--out")
    given = [f"benchmarks/{Path(typed[0]).name}", *parser.parse_known_args(typed[1:])[1]]
    if given != [row.script, *row.words]:
        raise UserError(f"{where}: not a measurement of {row.name}, made by {shlex.join(given)}")


def check_machine(row: Row, versions: Mapping[str, Any], where: Any) -> None:
    """Refuses numbers of a GPU for a row of CPU cores, and the other way round.

    Fewer threads than the row's are accepted, because its time is then harder to keep. The pages say so.

    Raises:
        UserError: It says what the row is of.
    """
    on_cpu, cores = versions["device"] == "cpu", row.section.threads
    if cores is None and on_cpu:
        raise UserError(f"{where}: ran on a CPU, and {row.name} is measured on a GPU")
    if cores is not None and not (on_cpu and versions["threads"] <= cores):
        ran = f"with {versions['threads']} threads" if on_cpu else f"on {versions['device']}"
        raise UserError(
            f"{where}: ran {ran}, and {row.name} is measured with at most {cores} threads on CPU cores"
        )


def overrides(folder: Path) -> list[str]:
    """What was typed after ``train.py``, as Hydra keeps it.

    Raises:
        UserError: It is not there.
    """
    file = folder / ".hydra" / "overrides.yaml"
    if not file.is_file():
        raise UserError(f"{file} is missing; results need the whole folder of a run")
    return [str(one) for one in yaml.safe_load(file.read_text())]


def write(record: Mapping[str, Any], place: Path = PLACE) -> Path:
    """The record as a file of its row, and its code beside the rows; whole or not at all."""
    code, key = _code_text(record["code"]), code_key(record["code"])
    name = f"seed-{record['seed']}" if "seed" in record else "run"
    path = place / record["row"] / f"{name}.json"
    with atomic_write(place / CODE / f"{key}.json") as temporary:
        temporary.write_text(code)
    with atomic_write(path) as temporary:
        temporary.write_text(to_json({**record, "code": key}))
    return path


def code_key(code: Mapping[str, Any]) -> str:
    """The name of the file of a record's code: equal for equal code alone."""
    return hashlib.sha256(_code_text(code).encode()).hexdigest()[:12]


def _code_text(code: Mapping[str, Any]) -> str:
    return json.dumps(code, indent=1, sort_keys=True) + "\n"


def read(row: Row, place: Path = PLACE) -> list[dict[str, Any]]:
    """The row's records by seed, each with its code; none if it was not measured.

    Raises:
        UserError: A file that is damaged.
    """
    found = []
    for path in (place / row.name).glob("*.json"):
        record = read_json(path)
        assert record is not None  # it was listed
        if "policies" in record:
            record["policies"] = {RENAMED.get(name, name): one for name, one in record["policies"].items()}
        code = read_json(place / CODE / f"{record['code']}.json")
        if code is None:
            raise UserError(f"{path}: its code, {CODE}/{record['code']}.json, is missing; measure it again")
        found.append(record | {"code": code})
    return sorted(found, key=lambda record: record.get("seed", 0))


def read_json(file: Path) -> dict[str, Any] | None:
    """The object in a file; ``None`` if there is no file.

    Raises:
        UserError: There is something else in it.
    """
    if not file.is_file():
        return None
    try:
        found = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"{file} cannot be read ({error}); measure it again") from error
    if not isinstance(found, dict):
        raise UserError(f"{file} holds no object; measure it again")
    return found


def prune(place: Path = PLACE) -> None:
    """Removes the code that no record names any more, and confirmations of records that are gone."""
    kept = [path for path in place.glob("*/*.json") if path.parent.name not in (CODE, CONFIRMED)]
    named = {(read_json(path) or {}).get("code") for path in kept}
    for path in (place / CODE).glob("*.json"):
        if path.stem not in named:
            path.unlink()
    for path in (place / CONFIRMED).glob("*.json"):
        records = [read_json(one) or {} for one in (place / path.stem).glob("*.json")]
        commits = {str(record.get("commit")).removesuffix("+") for record in records}
        if (read_json(path) or {}).get("measured") not in commits:
            path.unlink()


def _made_with(versions: Mapping[str, Any], jobs: int, commit: str | None) -> dict[str, Any]:
    gpu = versions.get("device", "cpu") != "cpu"
    machine = {"processor": versions["processor"], "cores": versions["cores"], "threads": versions["threads"]}
    return {
        "commit": versions.get("commit") or commit,
        "date": versions["started"][:10],
        "machine": machine | {"gpu": versions["device"] if gpu else None, "jobs": jobs},
        "versions": {name: versions[name] for name in ("python", *PACKAGES) if name in versions},
    }


def _training(folder: Path) -> dict[str, float]:
    """Counters of the run and, where it had one, its first stage."""
    found = read_json(folder / "checkpoints" / "latest" / "counters.json")
    first = read_json(folder / "pretrained" / "checkpoints" / "latest" / "counters.json")
    if found is None:
        raise UserError(f"{folder}: no checkpoint; results need the whole folder of a run")
    if first is not None:
        found |= {f"pretraining_{name}": value for name, value in first.items()}
    return found
