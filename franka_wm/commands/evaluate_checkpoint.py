"""What ``franka-wm evaluate`` does: everything that can be said about a checkpoint, from the checkpoint alone."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from franka_wm.commands.overrides import changes
from franka_wm.console import announced, duration, program, say
from franka_wm.errors import UserError
from franka_wm.evaluation import diagnose
from franka_wm.evaluation.decoder import Imagined
from franka_wm.evaluation.open_loop import NothingToPredictError
from franka_wm.evaluation.protocol import Evaluation, describe, evaluate_agent, protocol, warn_of_cut
from franka_wm.evaluation.results import COMMAND, FILE, OF_RUN, OTHERWISE, read_result, to_json
from franka_wm.evaluation.robustness import check_shiftable, note, robustness
from franka_wm.files import atomic_write, run_of
from franka_wm.report.diagnostics import (
    diagnostic_tables,
    evaluation_markdown,
    terminal,
    timing_table,
)
from franka_wm.report.run import read_chosen
from franka_wm.report.table import evaluation_tables, markdown
from franka_wm.training.load import find_checkpoint, load_agent, own_episodes

if TYPE_CHECKING:
    from franka_wm.training.load import Agent

WORLDS = 256
"""Simulated at once, at most; more episodes are played in rounds."""

Say = Callable[[str], None]


@dataclass(frozen=True)
class Options:
    """What was asked for on the command line."""

    checkpoint: str
    out: Path
    episodes: int | None
    device: str
    open_loop: bool
    probes: bool
    robustness: bool
    overrides: tuple[str, ...] = ()
    planned_with: str = ""
    typed: tuple[str, ...] = ()


def _planning(options: Options) -> dict[str, Any]:
    """What :func:`load_agent` is told of ``planner=NAME`` and ``planner.KEY=…``, the last of several."""
    chosen = [word for word in options.overrides if word.startswith("planner=")]
    paths = [word for word in options.overrides if word.startswith("hydra.searchpath=")]
    others = [word for word in options.overrides if word not in (*chosen, *paths)]
    found: dict[str, Any] = {"planning": changes("evaluate", others)}
    if chosen:
        found |= {"planned_by": chosen[-1].removeprefix("planner="), "searchpath": paths}
    return found


def run(options: Options) -> dict[str, Any]:
    """Evaluates, prints tables, writes files; returns the content of ``evaluation.json``.

    Raises:
        UserError: The checkpoint cannot be used, or the folder not be written.
    """
    from rich.console import Console

    console = Console(width=120)
    with announced(f"loading {options.checkpoint} and building worlds"):
        found = find_checkpoint(options.checkpoint)
        episodes = own_episodes(found) if options.episodes is None else options.episodes
        agent = load_agent(
            found,
            num_envs=min(episodes, WORLDS),
            device=options.device,
            **_planning(options),
        )
    if options.robustness:
        check_shiftable(agent)
    own = run_of(agent.folder)
    within = options.out.resolve() == own / "evaluation"
    of_run = None if within or options.out.resolve() == own else _of_run(agent, options)
    with announced(f"{episodes} held-out episodes for each of {', '.join(agent.policies)}") as runs:
        report = _progress([f"{episodes} episodes of {name}" for name in agent.policies], runs)
        evaluation = evaluate_agent(agent, episodes=episodes, report=report)
    described = protocol(agent.settings, agent.env, evaluation, by=COMMAND, counters=agent.counters)
    planned = {OTHERWISE: options.planned_with} if options.planned_with else {}
    results = {
        "protocol": {"checkpoint": options.checkpoint, **described, **planned},
        "policies": evaluation.policies,
    }
    for table in evaluation_tables(evaluation.policies):
        if table.rows:
            console.print(terminal(table))
    console.print(terminal(timing_table(evaluation.seconds, evaluation.worlds)))
    more = options.open_loop or options.probes or options.robustness
    if more and _replaceable(options.out, described):
        # What took longest is kept if the rest does not end.
        results["protocol"]["diagnostics"] = "not ended"
        _write(options.out, results, _text(results, evaluation, agent), evaluation, None, of_run)
        say(f"results of the episodes: {options.out}; diagnostics follow")
    imagined = None
    if options.open_loop or options.probes:
        with announced("held-out episodes for the diagnostics"):
            held = diagnose.hold_out(agent, images=options.open_loop)
        if options.open_loop:
            imagined = _look_ahead(agent, held, evaluation, results, say)
        if options.probes:
            _look_inside(agent, held, results, say)
    if options.robustness:
        _shift(agent, min(episodes, WORLDS), results, say)
    for title, table in diagnostic_tables(results, agent.env.config).items():
        console.print(terminal(table, title))
    results["protocol"].pop("diagnostics", None)
    text = _text(results, evaluation, agent)
    _write(options.out, results, text, evaluation, None if imagined is None else imagined[0], of_run)
    say(f"results: {options.out}")
    say(
        f"a page of them: {program()} report {shlex.quote(str(options.out.parent if within else options.out))}"
    )
    return results


def _progress(parts: Sequence[str], runs: Say) -> Callable[[str, Mapping[str, Any]], None]:
    """What says of each policy how it did, how long that took, and about how long the others will take.

    Args:
        parts: What is done for each, in words.
        runs: Told which of them begins.
    """
    started = before = time.perf_counter()
    done, policies = 0, len(parts)
    runs(parts[0])

    def report(name: str, summary: Mapping[str, Any]) -> None:
        nonlocal before, done
        took, before = time.perf_counter() - before, time.perf_counter()
        done += 1
        left = (before - started) / done * (policies - done)
        more = f"; {done} of {policies}, left {duration(left)}" if done < policies else ""
        say(f"{describe(name, summary)}   ({took:.1f} s{more})")
        if done < policies:
            runs(parts[done])

    return report


def _of_run(agent: Agent, options: Options) -> dict[str, Any]:
    """What results that lie elsewhere say of their run; where they lie beside them, the run's own files do."""
    told: dict[str, Any] = {"config": {}, "overrides": [], "preset": ""}
    if (run := run_of(agent.folder)) != agent.folder:
        told = read_chosen(run)
    values = agent.settings.values
    changed = {
        group for group in ("planner", "objective") if any(w.startswith(group) for w in options.overrides)
    }
    # These have the device here, and what training found, too; a comparison would list both.
    config = {**(told["config"] or values), **{group: values[group] for group in changed}}
    return {**told, "config": config, "typed": [*options.typed]}


def _look_ahead(
    agent: Agent, held: diagnose.Held, evaluation: Evaluation, results: dict[str, object], say: Say
) -> tuple[Imagined, object, object] | None:
    say("open-loop predictions …")
    ahead: dict[str, Any]
    try:
        ahead = diagnose.open_loop(agent, held)
    except NothingToPredictError as error:
        ahead = {"not_measured": str(error)}
        say(f"warning: open loop not measured: {error}")
    results["open_loop"] = ahead
    with announced("value calibration"):
        value = results["calibration"] = diagnose.calibration(agent)
    if "not_measured" in value:
        say(f"warning: value calibration not measured: {value['not_measured']}")
    results["health"] = diagnose.health(agent, evaluation)
    imagined = diagnose.imagine(agent, held, announce=announced)
    if imagined is not None:
        ahead["decoder"] = imagined[2]
    return imagined


def _look_inside(agent: Agent, held: diagnose.Held, results: dict[str, Any], say: Say) -> None:
    say("probes and spectrum of the latents …")
    results["probes"] = diagnose.probes(held, agent.model)
    results["spectrum"], results["latents"] = diagnose.representation(held, agent.model)
    warning = results["spectrum"]["warning"]
    if warning:
        results.setdefault("health", {}).setdefault("warnings", []).append(warning)
        say(f"warning: {warning}")


def _shift(agent: Agent, episodes: int, results: dict[str, Any], say: Say) -> None:
    say("robustness: the same episodes in shifted worlds …")

    def told(case: str, found: Mapping[str, Any]) -> None:
        parts = (f"{describe(p, r).strip()} {r['verdict']}" for p, r in found.items())
        say(f"  {case}: {'   '.join(parts)}")
        for name, result in found.items():
            if cut := result.get("cut_short"):
                say(warn_of_cut(name, cut, episodes))

    results["robustness"] = robustness(agent, episodes=episodes, report=told)
    results["protocol"]["robustness episodes"] = episodes
    if note(episodes):
        results["protocol"]["robustness note"] = note(episodes)
        say(f"note: {note(episodes)}")


def _replaceable(folder: Path, described: Mapping[str, Any]) -> bool:
    """Whether what is there may go before all parts of the new results are there: nothing, or less than they have."""
    if not (folder / FILE).is_file():
        return True
    try:
        there = read_result(folder / FILE)
    except UserError:  # nobody can read it
        return True
    return "diagnostics" in there.protocol or there.updates != described.get("updates")


def _text(results: dict[str, Any], evaluation: Evaluation, agent: Agent) -> str:
    planned = results["protocol"].get(OTHERWISE)
    lines = [f"Planned with {planned}, not as the run did.\n"] if planned else []
    tables = diagnostic_tables(results, agent.env.config)
    parts = [f"### {title}\n\n{markdown(table)}" for title, table in tables.items()]
    return "\n".join([*lines, evaluation_markdown(evaluation), *parts])


def _write(
    folder: Path,
    results: dict[str, Any],
    text: str,
    evaluation: Evaluation,
    imagined: Imagined | None,
    of_run: Mapping[str, Any] | None,
) -> None:
    """Every file whole; the one that others read, last. Nothing stays of an earlier evaluation."""
    if imagined is None:
        for name in ("imagined.png", "imagined.mp4"):
            (folder / name).unlink(missing_ok=True)
    else:
        from franka_wm.video import write_png, write_video

        write_png(imagined.strip, folder / "imagined.png")
        write_video(
            imagined.frames.repeat_interleave(2, 1).repeat_interleave(2, 2), folder / "imagined.mp4", fps=5
        )
    seconds = {
        name: {"seconds_per_decision": s, "worlds": evaluation.worlds}
        for name, s in evaluation.seconds.items()
    }
    for name, content in (
        *([] if of_run is None else [(OF_RUN, to_json(of_run))]),
        ("timing.json", to_json(seconds)),
        ("evaluation.md", text),
        (FILE, to_json(results)),
    ):
        with atomic_write(folder / name) as path:
            path.write_text(content)
