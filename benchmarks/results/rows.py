"""The rows that rows.yaml declares."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import yaml

from franka_wm.errors import UserError

DECLARED = Path(__file__).with_name("rows.yaml")
WANTED = (
    "minutes",
    "distance_cm",
    "within_5cm",
    "within_2.5cm",
    "within_1cm",
    "success",
    "success_of",
    "return",
)


@dataclass(frozen=True)
class Section:
    """Rows of one kind of machine.

    Attributes:
        title: of its part of the page.
        arguments: of ``train.py``, before those of each row.
        threads: of a run on CPU cores; ``None`` on a GPU.
        text: what holds for all of its rows.
    """

    title: str
    arguments: str = ""
    threads: int | None = None
    text: str = ""


@dataclass(frozen=True)
class Row:
    """One command and its seeds, or one benchmark. The fields are those of rows.yaml, which explains them."""

    name: str
    section: Section
    title: str
    arguments: str = ""
    before: str = ""
    model: str = ""
    policy: str = ""
    seeds: tuple[int, ...] = ()
    wanted: Mapping[str, Any] = field(default_factory=dict)
    goals: list[dict[str, Any]] = field(default_factory=list)
    script: str | None = None
    text: str = ""
    readme: bool | list[str] = False
    plot: Mapping[str, str] | None = None
    beside: bool = False
    chosen: bool = False
    headline: bool = False

    @property
    def words(self) -> list[str]:
        """The arguments of ``train.py`` or the benchmark, one by one."""
        return shlex.split(f"{self.section.arguments} {self.arguments}")

    @property
    def command(self) -> list[str]:
        """What is typed, without the seed."""
        return ["python", self.script or "train.py", *self.words]

    def acting(self, policies: Mapping[str, Any]) -> str:
        """The policy that a run is about, of those that were evaluated."""
        names = (self.policy, "planner", "policy", next(iter(policies)))
        return next(name for name in names if name in policies)

    @property
    def picture(self) -> str:
        """Where a benchmark's picture lies in the folder of the results."""
        return f"{self.name}/plot.svg"

    @property
    def prepares(self) -> list[tuple[list[str], str]]:
        """The arguments of each ``franka-wm`` that makes what the runs read, and the folder that it makes."""
        found = []
        for line in self.before.splitlines():
            words = shlex.split(line)
            made = [word.removeprefix("out=") for word in words if word.startswith("out=")]
            if words[:1] != ["franka-wm"] or len(made) != 1:
                raise UserError(f"row {self.name}: before must be commands of franka-wm with out=FOLDER")
            found.append((words[1:], made[0]))
        return found


def load_rows(path: Path = DECLARED) -> dict[str, Row]:
    """The declared rows by name, in the order of the page.

    Raises:
        UserError: An entry that is not one.
    """
    declared = yaml.safe_load(path.read_text())
    sections = {
        name: Section(**_known(Section, entry, f"{path.name}: section {name}"))
        for name, entry in declared["sections"].items()
    }
    rows = {}
    for name, entry in declared["rows"].items():
        where = f"{path.name}: row {name}"
        entry = _known(Row, entry, where)
        if entry.get("section") not in sections:
            raise UserError(f"{where}: section must be one of {', '.join(sections)}")
        if unknown := set(entry.get("wanted", {})) - set(WANTED):
            raise UserError(
                f"{where}: wanted has no {', '.join(sorted(unknown))}; it has {', '.join(WANTED)}"
            )
        for goal in entry.get("goals", ()):
            if "script" not in entry or not isinstance(goal, dict) or not any(map(is_bound, goal.values())):
                raise UserError(
                    f"{where}: goals are of a benchmark, each columns of its lines and COLUMN: ≥ N or ≤ N, not {goal}"
                )
        if ("script" in entry) == ("seeds" in entry):
            raise UserError(f"{where}: needs either seeds, of train.py, or the script of a benchmark")
        first, last = entry.pop("seeds", (0, -1))
        section = sections[entry.pop("section")]
        rows[name] = Row(name=name, section=section, seeds=tuple(range(first, last + 1)), **entry)
    place = {id(section): k for k, section in enumerate(sections.values())}
    return dict(sorted(rows.items(), key=lambda item: place[id(item[1].section)]))


def is_bound(value: object) -> bool:
    """Whether a goal's entry says what is to be reached: ``≥ N`` or ``≤ N``."""
    return isinstance(value, str) and re.fullmatch(r"[≥≤] \d+(\.\d+)?", value) is not None


def choose(rows: Mapping[str, Row], name: str) -> Row:
    """The row of this name.

    Raises:
        UserError: There is none.
    """
    if name not in rows:
        raise UserError(f"no row {name!r}; there are {', '.join(rows)}")
    return rows[name]


def _known(kind: type, entry: Mapping[str, Any], where: str) -> dict[str, Any]:
    names = {one.name for one in fields(kind)} - {"name"}
    if unknown := set(entry) - names:
        raise UserError(
            f"{where}: no entry {', '.join(sorted(unknown))}; there are {', '.join(sorted(names))}"
        )
    return dict(entry)
