"""Whether a row's files belong together, and to the code as it is now."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from benchmarks.results.records import BESIDE, check_arguments, check_seed
from benchmarks.results.rows import Row
from franka_wm.errors import FrankaError
from franka_wm.report.run import SAME_BUT, without_the_seed
from franka_wm.source import differing

Record = Mapping[str, Any]


def state(row: Row, records: Sequence[Record]) -> tuple[str, list[str]]:
    """One of ``missing``, ``mixed``, ``stale``, ``part`` (seeds are missing) and ``fresh``, with the reasons."""
    if not records:
        return "missing", []
    if reasons := mixed(row, records):
        return "mixed", reasons
    if reasons := stale(records):
        return "stale", reasons
    missing = unmeasured(row, records)
    return ("part", [f"seeds {numbers(missing)} are missing"]) if missing else ("fresh", [])


def unmeasured(row: Row, records: Sequence[Record]) -> list[int]:
    """Seeds that the row declares and no run measured."""
    return sorted(set(row.seeds) - {record["seed"] for record in records}) if row.seeds else []


def mixed(row: Row, records: Sequence[Record]) -> list[str]:
    """Why these records are not one row: another command than the row's, or other code, packages or configuration."""
    reasons = []
    for record in records:
        where = f"seed {record['seed']}" if "seed" in record else "it"
        try:
            words = shlex.split(record["command"])
            check_arguments(row, words[2:], where)
            if "seed" in record:
                check_seed(row, record["seed"], where)
            if words[1] != row.command[1]:
                reasons.append(f"{where} ran {words[1]}")
        except FrankaError as error:
            reasons.append(str(error))
    first = records[0]
    files: dict[str, str] = {}
    for record in records:
        here = record["code"]["files"]
        names = [name for name in here if files.setdefault(name, here[name]) != here[name]]
        made = {**dict.fromkeys(first["versions"]), **record["versions"]}
        names += [f"{name} {value}" for name, value in made.items() if first["versions"].get(name) != value]
        names += [
            change
            for change in changes(
                *(without_the_seed(one["code"]["config"], one.get("seed")) for one in (first, record))
            )
            if not change.startswith(tuple(f"{name}{end}" for name in BESIDE for end in (" ", ".")))
        ]
        if names:
            reasons.append(f"seed {record['seed']} differs from those before it in {', '.join(names)}")
    seeds = [record["seed"] for record in records if "seed" in record]
    twice = sorted({seed for seed in seeds if seeds.count(seed) > 1})
    return reasons + [f"seed {seed} has {seeds.count(seed)} files" for seed in twice]


def stale(records: Sequence[Record]) -> list[str]:
    """What has changed since: files by name, values of the configuration that the command now makes."""
    files: dict[str, str] = {}
    for record in records:
        files |= record["code"]["files"]
    code = records[0]["code"]
    measured = {shlex.join(shlex.split(records[0]["command"])[2:]): code["config"]} if code["config"] else {}
    reasons = differing(files)
    for words, config in {**measured, **code.get("composed", {})}.items():
        now = composed(tuple(shlex.split(words)))
        if isinstance(now, str):
            reasons.append(f"its command, which is refused now: {now}")
        else:
            reasons += changes({name: value for name, value in config.items() if name not in SAME_BUT}, now)
    return reasons


@cache
def composed(typed: tuple[str, ...]) -> dict[str, Any] | str:
    """The configuration of a command, as it is now, without what repetitions differ in; or why there is none."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    from franka_wm import conf
    from franka_wm.errors import UserError

    try:
        cfg = conf.compose(*typed)
        found = OmegaConf.to_container(cfg, resolve=True)
    except (UserError, OmegaConfBaseException) as error:
        return str(error).splitlines()[0]
    assert isinstance(found, dict)
    return {str(name): value for name, value in found.items() if name not in SAME_BUT}


def changes(before: Any, after: Any, name: str = "") -> list[str]:
    """Values of a configuration that differ: ``trainer.lr 0.001 → 0.0003``."""
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        return [
            found
            for key in dict.fromkeys([*before, *after])
            for found in changes(before.get(key, "–"), after.get(key, "–"), f"{name}.{key}" if name else key)
        ]
    return [] if before == after else [f"{name} {before} → {after}"]


def apart(reasons: Sequence[str]) -> tuple[list[str], list[str]]:
    """Files, and what changed of the configuration or the command, of what `stale` found."""
    files = [reason for reason in reasons if " " not in reason]
    return files, [reason for reason in reasons if " " in reason]


def numbers(seeds: Sequence[int]) -> str:
    """``100 – 109`` for what follows one another, otherwise one by one."""
    if len(seeds) > 2 and list(seeds) == list(range(seeds[0], seeds[-1] + 1)):
        return f"{seeds[0]} – {seeds[-1]}"
    return ", ".join(map(str, seeds))
