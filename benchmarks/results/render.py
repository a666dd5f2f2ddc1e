"""docs/results.md and README's tables, from the files in docs/results/ alone."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.results.confirm import confirmed
from benchmarks.results.metrics import (
    DISTANCE,
    RETURN,
    SUCCESS,
    WITHIN,
    Metric,
    columns,
    mean,
    number,
    verdicts,
)
from benchmarks.results.records import BESIDE, PLACE, read
from benchmarks.results.rows import Row
from benchmarks.results.state import Record, apart, numbers, state, unmeasured
from benchmarks.results.times import company, cores, duration, grouped, machine, seconds, timed
from franka_wm.errors import UserError
from franka_wm.evaluation.intervals import percent

BEGIN, END = "<!-- results: written by `make results` -->", "<!-- end of results -->"
LEGEND = (
    "*m of n seeds*: the row declares n, and m were measured with that commit. *n at a time*: n runs at once, on one "
    "GPU, or each on a core of its own on one machine; *alone (m of n runs)*: times of those that were alone; *beside "
    "other work*: something else ran on that machine meanwhile, on the same GPU or elsewhere, as the row's text says. "
    "*missed*: what was wanted and is not reached, see docs/results.md; limits of time are of training, without start "
    "and evaluations, and of the slowest run, where the tables show the mean; a planner is worse than its policy where "
    "its mean lies beyond the policy's 95 % interval. "
    "*Other seeds*: five to ten by which nothing was chosen. "
    "Raised numbers: see below the tables."
)
"""What README says of its tables' words."""
ALIKE = (
    "Rows of learning without ¹ were measured with today's code, or with an earlier commit that docs/results.md names: "
    "then a short run on a CPU gives the same weights and episodes, bit for bit, with that code and with today's. Such "
    "a run cannot see what only a GPU or a long run shows; times are those of the commit."
)
HEAD = """# Results

Written by `make results` from the files in [results/](results), which the runs wrote themselves; no measured
number is typed by hand. `benchmarks/results/rows.yaml` declares the rows and what is wanted. `make results ROW=name`
measures one again.

`a (b – c)` over several seeds is their mean, lowest and highest. For one seed `b – c` is the 95 % interval over its
episodes: bootstrap for distances and returns, Wilson for rates. Episodes are held out: training never sees their seeds.
*Doing nothing* and *random smooth* motion are what a policy must beat; *inverse kinematics* knows the true geometry.
Where actions are discrete, a *search with the same actions* takes its place: the best pair of them by true geometry,
where the distance after the first counts a tenth.
*Planner no worse than policy*: on no seed is its mean beyond the policy's 95 % interval, on the worse side.

*n at a time*: n runs at once, on one GPU, or each on a core of its own on one machine. *beside other work*:
something else ran on that machine meanwhile, on the same GPU or elsewhere: the row's text says what. A commit with
a `+` had changes that were not committed. Where code has changed since, a short run on a CPU, with a small model and
updates that are not compiled, was made with both versions; *bit for bit* is said where it gave the same. What only a
GPU or a long run shows, it does not see; times are those of the commit that is named.
"""
MOST_FILES = 12
"""That are named where they have changed."""
POLICIES = {
    "planner": "planner",
    "policy": "policy alone",
    "noop": "doing nothing",
    "random": "random smooth",
    "ik": "inverse kinematics",
    "expert": "the task's expert",
}
DISCRETE_ORACLE = "search with the same actions"


# -- the page -----------------------------------------------------------------------------------------------


def page(rows: Mapping[str, Row], place: Path = PLACE) -> str:
    """The content of docs/results.md."""
    measured = {name: read(row, place) for name, row in rows.items()}
    states = {name: state(row, measured[name]) for name, row in rows.items()}
    single = [n for n, row in rows.items() if row.script is None and len(measured[n]) == 1]
    parts = [HEAD]
    sections = list({id(row.section): row.section for row in rows.values()}.values())
    for section in sections:
        here = [n for n, row in rows.items() if row.section is section and measured[n] and n not in single]
        if here:
            parts += [f"## {section.title}\n", *([section.text + "\n"] if section.text else [])]
            parts += [part(rows[name], measured[name], states[name], place) for name in here]
    if single:
        alone = (
            "One run each, also of rows only begun: another seed may end elsewhere, the *worst* is this one."
        )
        parts.append(f"## Single seeds\n\n{alone}\n")
        parts += [part(rows[name], measured[name], states[name], place) for name in single]
    missing = [row for name, row in rows.items() if not measured[name]]
    if missing:
        parts.append("## Not measured yet\n")
        parts += [f"- {row.section.title}, {row.title}: `make results ROW={row.name}`" for row in missing]
        parts.append("")
    return "\n".join(parts)


def part(row: Row, records: Sequence[Record], judged: tuple[str, list[str]], place: Path = PLACE) -> str:
    """One row of the page."""
    kind, reasons = judged
    lines = [f"### {row.title}" + (f": {row.model}" if row.model else ""), ""]
    if row.text:
        lines += [row.text, ""]
    lines += ["```bash", _command(row, records), "```", ""]
    if kind == "mixed":
        return "\n".join(
            [*lines, "Not shown, its runs do not belong together: " + "; ".join(reasons) + ".", ""]
        )
    lines += [_provenance(row, records), ""]
    if kind == "stale":
        lines += [_since(reasons, confirmed(row, records, place), _commit(records[0])), ""]
    if missing := unmeasured(row, records):
        one = "seed" if len(missing) == 1 else "seeds"
        lines += [
            f"**Missing: {one} {numbers(missing)}** of the {len(row.seeds)} that the row declares.",
            "",
        ]
    if row.script is not None:
        shown = [f"![{row.title}](results/{row.picture})", ""] if row.plot else []
        lines += [*shown, table(list(records[0]["rows"][0]), _cells(records[0]["rows"])), ""]
        if judgement := verdicts(row, records):
            lines += [_judged(judgement), ""]
        return "\n".join(lines)
    if judgement := verdicts(row, records):
        lines += [_judged(judgement, "so far" if missing else "yes"), ""]
    lines += [_over_seeds(records), ""]
    if len(records) > 1:
        seeds = _each_seed(row, records)
        lines += ["<details><summary>Every seed</summary>", "", seeds, "", "</details>", ""]
    return "\n".join(lines)


def _judged(judgement: Sequence[tuple[str, str, bool]], yes: str = "yes") -> str:
    cells = [[wanted, reached, yes if enough else "**no**"] for wanted, reached, enough in judgement]
    return table(["wanted", "measured", "reached"], cells)


def _since(reasons: Sequence[str], same: Record | None, commit: str) -> str:
    """What has changed since a row was measured with ``commit``, and whether a short run showed anything of it."""
    files, values = apart(reasons)
    changed = changed_told(reasons)
    if same:
        text = (
            f"Measured before changes of {changed} that change nothing a short run shows: on "
            f"{same['date']} `{same['command']}` gave the same weights and episodes with that code and with "
            f"today's, bit for bit."
        )
    else:
        text = f"**Measured before changes of {changed}.**"
    if values:
        text += f" Of the configuration: {', '.join(f'`{value}`' for value in values)}."
    if len(files) > MOST_FILES:
        return f"{text} `git diff --stat {commit.rstrip('+')}` names them."
    return text + (f" {', '.join(f'`{name}`' for name in files)}." if files else "")


def changed_told(reasons: Sequence[str]) -> str:
    """How many files changed, and how many values of the configuration."""
    files, values = apart(reasons)
    parts = [f"{len(files)} files" if len(files) > 1 else "one file"] if files else []
    if values:
        parts.append(
            f"{len(values)} values of its configuration"
            if len(values) > 1
            else "one value of its configuration"
        )
    return " and ".join(parts)


def _over_seeds(records: Sequence[Record]) -> str:
    """A line for each policy."""
    cells = []
    for policy in records[0]["policies"]:
        line = [label(policy, records[0])]
        for metric in columns(records):
            if len(records) == 1:
                line.append(_one_seed(records[0], policy, metric))
            else:
                each = [metric.of(record, policy) for record in records]
                line.append(metric.show(mean(each), min(each), max(each)))
        cells.append(line)
    return table(["policy", *(metric.title for metric in columns(records))], cells)


def label(policy: str, record: Record) -> str:
    """The policy's name; with discrete actions, those of tree search, `ik` is another one."""
    from franka_wm.planning import registry

    planner = (record["code"]["config"].get("planner") or {}).get("name")
    if policy == "ik" and planner in registry.available() and registry.is_search(planner):
        return DISCRETE_ORACLE
    return POLICIES.get(policy, policy)


def _one_seed(record: Record, policy: str, metric: Metric) -> str:
    return metric.show(*(metric.of(record, policy, bound) for bound in ("mean", "low", "high")))


def _commit(record: Record) -> str:
    """As long as it needs to be to be found, with the `+` of code that was not committed."""
    commit = str(record["commit"])
    return commit.rstrip("+")[:12] + "+" * commit.endswith("+")


def _each_seed(row: Row, records: Sequence[Record]) -> str:
    """A line for each seed: what acts, with its intervals."""
    policy = row.acting(records[0]["policies"])
    cells = []
    for record in records:
        line = [_one_seed(record, policy, metric) for metric in columns(records)]
        cells.append([str(record["seed"]), *line, duration(seconds(record)), _commit(record), record["date"]])
    titles = [metric.title for metric in columns(records)]
    return table(["seed", *titles, "training", "commit", "date"], cells)


def _command(row: Row, records: Sequence[Record]) -> str:
    """What to type; for several seeds in a loop."""
    before = f"{row.before.rstrip()}\n" if row.before else ""
    if row.script is not None:
        return before + shlex.join(row.command)
    seeds = " ".join(str(record["seed"]) for record in records)
    if len(records) == 1:
        return f"{before}{shlex.join(row.command)} seed={seeds}"
    return f"{before}for seed in {seeds}; do\n  {shlex.join(row.command)} seed=$seed\ndone"


def _provenance(row: Row, records: Sequence[Record]) -> str:
    """Machine, versions, commit, date; of runs also seeds, episodes, what training took, arguments not in the row."""
    allowed = row.section.threads
    fewer = allowed and any(record["machine"]["threads"] < allowed for record in records)
    machines = grouped(records, beside=row.beside) + (
        f" (up to {allowed} threads are allowed)" if fewer else ""
    )
    commits = ", ".join(dict.fromkeys(_commit(record) for record in records))
    dates = " – ".join(dict.fromkeys(f(record["date"] for record in records) for f in (min, max)))
    made = records[0]["versions"]
    with_what = f"{machines}; torch {made['torch']}, Newton {made['newton']}; commit {commits}, {dates}."
    if row.script is not None:
        return with_what
    timing = timed(records, beside=row.beside)
    times = [seconds(record) for record in timing]
    commands = [record["training"]["command_seconds"] for record in timing]
    spread = (mean(times), min(times), max(times)) if len(times) > 1 else (times[0],)
    whole = duration(mean(commands))
    training = records[0]["training"]
    episodes = next(iter(records[0]["policies"].values()))["episodes"]
    seeds = numbers([record["seed"] for record in records])
    typed = " or ".join(dict.fromkeys(_beside(row, record) for record in records))
    return (
        f"Seed{'s' * (len(records) > 1)} {seeds}, {episodes} episodes each. {training['updates']:,.0f} updates, "
        f"{training['env_steps']:,.0f} steps; training {duration(*spread)}{company(records, beside=row.beside)}, "
        f"the whole command {whole}. {with_what}" + (f" Run {typed}." if typed else "")
    )


def _beside(row: Row, record: Record) -> str:
    """Arguments in which the run's command differs from the row's; the seed and the device stand elsewhere."""
    typed = shlex.split(record["command"])[2:]
    more, less = (
        [a for a in some if a.split("=", 1)[0] in BESIDE and a not in others]
        for some, others in ((typed, row.words), (row.words, typed))
    )
    parts = [f"{word} `{' '.join(some)}`" for word, some in (("with", more), ("without", less)) if some]
    return " and ".join(parts)


def table(titles: Sequence[str], cells: Sequence[Sequence[str]]) -> str:
    """Markdown."""
    lines = ["| " + " | ".join(titles) + " |", "|---" * len(titles) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(line) + " |" for line in cells)])


def _cells(rows: Sequence[Mapping[str, Any]], names: Sequence[str] | None = None) -> list[list[str]]:
    def cell(value: Any) -> str:
        if value is None or value != value:  # files of earlier versions hold NaN
            return "–"
        if isinstance(value, float):
            return number(value)
        return str(value)

    return [[cell(row[name]) for name in names or row] for row in rows]


# -- README -------------------------------------------------------------------------------------------------


def readme_tables(rows: Mapping[str, Row], place: Path = PLACE) -> str:
    """README's part: the arm, other environments, speed; rows of several seeds that belong together."""
    arm, manipulation, others = [], [], []
    speed: dict[tuple[str, ...], list[list[str]]] = {}
    slow: list[str] = []
    episodes: set[int] = set()
    aged = alike = chosen = False
    for row in rows.values():
        records = read(row, place) if row.readme else []
        kind, _ = state(row, records)
        if kind in ("missing", "mixed") or (row.script is None and len(records) < 2):
            continue
        same = kind == "stale" and confirmed(row, records, place) is not None
        mark = "¹" if kind == "stale" and not same else ""
        aged, alike = aged or mark == "¹", alike or same
        if isinstance(row.readme, list):
            titles = ["machine", *row.readme]
            who = f"{machine(records[0])}{company(records, beside=row.beside)}, {records[0]['date']}{mark}"
            speed.setdefault(tuple(titles), []).extend(
                [who, *line] for line in _cells(records[0]["rows"], row.readme)
            )
            slow += _missed(row, records)
            continue
        policy = row.acting(records[0]["policies"])
        of = f" of {len(row.seeds)}" if unmeasured(row, records) else ""
        where, runs = cores(row, records), f"{len(records)}{of} seeds"
        who = row.title + " ".join([*mark, *"²" * row.chosen])
        chosen = chosen or row.chosen
        missed = "; ".join(_missed(row, records) + _missed_by_others(rows, row, place)) or "–"
        if columns(records) == [RETURN]:
            values = [RETURN.of(record, policy) for record in records]
            reached = RETURN.show(mean(values), min(values), max(values))
            wanted = f"{row.wanted['return']:g}" if "return" in row.wanted else "–"
            others.append([who, row.model, f"{where}, {runs}", reached, wanted, missed])
            continue
        timing = timed(records, beside=row.beside)
        times = mean([seconds(record) for record in timing])
        command = mean([record["training"]["command_seconds"] for record in timing])
        took = [duration(times) + company(records, beside=row.beside), f"{command / 60:.1f} min"]
        if columns(records) == [SUCCESS, RETURN]:
            values = [SUCCESS.of(record, policy) for record in records]
            expert = mean([SUCCESS.of(record, "expert") for record in records])
            found = [SUCCESS.show(mean(values)), SUCCESS.show(min(values)), SUCCESS.show(expert)]
            manipulation.append([who, row.model, f"{where}, {runs}", *took, *found, missed])
            continue
        episodes |= {summary["episodes"] for record in records for summary in record["policies"].values()}
        distance = mean([DISTANCE.of(record, policy) for record in records])
        worst = min(WITHIN["5"].of(record, policy) for record in records)
        nothing = mean([DISTANCE.of(record, "noop") for record in records])
        found = [*took, f"{distance:.1f} cm", f"{percent(worst)} %", f"{nothing:.0f} cm"]
        arm.append([who, row.model, f"{where}, {runs}", *found, missed])
    parts = []
    if arm:
        titles = ["task", "model, planner", "machine", "training", "whole command", "final distance"]
        parts += [table([*titles, "within 5 cm, worst seed", "doing nothing", "missed"], arm), ""]
        many = " or ".join(map(str, sorted(episodes)))
        parts += [
            f"*Whole command*: start, training, and the evaluation of each policy on {many} episodes, without a film. "
            "Gathering demonstrations is not counted.",
            "",
        ]
    if manipulation:
        titles = ["task", "model, planner", "machine", "training", "whole command", "success [%]"]
        parts += [table([*titles, "worst seed", "the task's expert", "missed"], manipulation), ""]
    if others:
        parts += [
            table(
                ["other environments", "model, planner", "machine", "return", "wanted", "missed"],
                others,
            ),
            "",
        ]
        parts += [
            "*Wanted*: of the control suite the mean of three seeds that TD-MPC2's authors published.",
            "",
        ]
    if parts:
        parts += [LEGEND, ""]
    if speed:
        text = (
            "*Collector*: through TorchRL's, resets included. *raw*: Newton's physics, and images where there are "
            "some, alone in one graph, without task, resets and TorchRL; measured in the same run"
        )
        parts += [f"Environment steps per second. {text}:", ""]
        parts += [line for titles, cells in speed.items() for line in (table(titles, cells), "")]
    if slow:
        parts += [f"Wanted and missed: {'; '.join(slow)}.", ""]
    if aged:
        parts += ["¹ Measured before changes of the code; docs/results.md names them.", ""]
    if chosen:
        parts += ["² A setting was chosen after runs of these seeds; docs/results.md says which.", ""]
    if alike:
        parts += [ALIKE, ""]
    return "\n".join(parts or ["Not measured yet.", ""])


def _missed(row: Row, records: Sequence[Record]) -> list[str]:
    return [f"{what}: {_briefly(found)}" for what, found, enough in verdicts(row, records) if not enough]


def _briefly(reached: str) -> str:
    """What was reached, without how it was measured."""
    return reached.split(";")[0].split(", ")[0]


def _missed_by_others(rows: Mapping[str, Row], row: Row, place: Path) -> list[str]:
    """What the row of other seeds misses: README's table shows one row of the two, and must not show the better one."""
    others = rows.get(f"{row.name}-others")
    records = read(others, place) if others else []
    if others is None or state(others, records)[0] in ("missing", "mixed"):
        return []
    judged = verdicts(others, records)
    return [f"other seeds: {what}: {_briefly(found)}" for what, found, enough in judged if not enough]


def with_tables(readme: str, tables: str, begin: str = BEGIN, end: str = END) -> str:
    """README with its tables in their place, between the lines `begin` and `end`.

    Raises:
        UserError: The place is not marked.
    """
    if readme.count(begin) != 1 or readme.count(end) != 1:
        raise UserError(f"README.md needs the lines {begin} and {end} once each, around its tables")
    before, rest = readme.split(begin)
    return f"{before}{begin}\n\n{tables}\n{end}{rest.split(end)[1]}"
