"""The sections of a run's page. Each is a function of what the run left, and empty where that is not there."""

import math
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml
from markupsafe import Markup

from franka_wm.console import named_plugins, quoted
from franka_wm.evaluation.results import COMMAND, END, Result
from franka_wm.report import style
from franka_wm.report.bars import bars_figure
from franka_wm.report.calibration import calibration_figure
from franka_wm.report.curves import axis, panel_figure, panels, quantity
from franka_wm.report.document import (
    Section,
    card,
    cards,
    chart,
    commands,
    facts,
    folded,
    headed,
    image,
    paragraph,
    sparkline,
    table,
    video,
)
from franka_wm.report.horizon import horizon_figure
from franka_wm.report.outcome import number, plain, result
from franka_wm.report.run import RunFiles
from franka_wm.report.spectra import latent_figure, spectrum_figure
from franka_wm.report.table import Table, is_interval, nested_table

LOWEST = -1.0
"""Where the axis of probes ends at the latest: one probe far off would squeeze all others."""


def sections(run: RunFiles) -> list[Section]:
    """All sections that the run has something for, in the order in which one reads them."""
    parts: list[tuple[str, str, Callable[[RunFiles], str]]] = [
        ("result", "Result", result),
        ("curves", "Learning curves", curves),
        ("videos", "Videos", videos),
        ("imagined", "Imagined and real", imagined),
        ("horizon", "Open loop", open_loop),
        ("probes", "Probes", probes),
        ("latents", "Latent space", latents),
        ("calibration", "Value", calibration),
        ("robustness", "Robustness", robustness),
        ("health", "Training health", health),
        ("what", "What was run", what),
        ("reproduce", "Reproduce", reproduce),
    ]
    return [Section(key, title, body) for key, title, make in parts if (body := make(run))]


def warnings(run: RunFiles) -> list[str]:
    """What evaluation found wrong, in its words, and a checkpoint that cannot be read."""
    spectrum, found = run.extras.get("spectrum") or {}, run.extras.get("health") or {}
    texts = [run.damage, spectrum.get("warning"), *found.get("warnings", [])]
    return list(dict.fromkeys(str(text) for text in texts if text))


def curves(run: RunFiles) -> str:
    x = axis(run.rows)
    if x is None:
        return ""
    env = run.config.get("env") or {}
    told = run.results[0].protocol if run.results else env if env.get("task") in ("reach", "track") else {}
    success = told.get("success_distance")  # a task that judges otherwise has none, whatever its config holds
    drawn = (
        chart(
            panel_figure(run.rows, panel, x=x, success_distance=success),
            f"{quantity(panel)[0]} while training",
        )
        for panel in panels(run.rows)
    )
    last = Markup()
    if (end := _end(run)) is not None:
        fewer = (run.config.get("evaluation") or {}).get("during_episodes") or end.episodes
        fewer = min(int(fewer), end.episodes)
        before = f"; those before are over {fewer} of these" if fewer < end.episodes else ""
        last = paragraph(
            f"The last points are what the end of training measured over {end.episodes} episodes{before}."
        )
    return last + cards(*drawn)


def videos(run: RunFiles) -> str:
    film, still = run.images.get("video.mp4"), run.images.get("last_frame.png")
    if film is not None:
        end = _end(run)  # which has made the film
        policies = run.policies if end is None else end.policies
        who = f" of the {style.policy_name(style.acting(policies))}" if policies else ""
        return card(
            video(film, f"episodes{who}", poster=still),
            "The worst of the held-out episodes; the ring marks the goal.",
            kind="single",
        )
    if still is not None:
        return card(
            image(still, "last frame of the episodes"),
            "The last frame; the ring marks the goal.",
            kind="single",
        )
    return ""


def imagined(run: RunFiles) -> str:
    film, strip = run.images.get("imagined.mp4"), run.images.get("imagined.png")
    parts = [
        card(
            image(strip, "imagined frames below real ones"),
            "Above what happened, below what the model imagined from the first frame and the actions alone.",
            kind="wide strip",
        )
        if strip
        else "",
        card(video(film, "imagined beside real"), "Real and imagined, side by side.") if film else "",
    ]
    text = "A decoder, trained on the side and used by nothing else, turns latents into images."
    return paragraph(text if film or strip else "") + cards(*parts)


def open_loop(run: RunFiles) -> str:
    found = run.extras.get("open_loop")
    if not found:
        return ""
    drawn = ""
    if found.get("curves"):
        drawn = chart(
            horizon_figure(found["curves"], steps=found.get("steps"), unit=found.get("unit", "error")),
            "prediction error by steps ahead",
            "Predicted ahead from one observation, without seeing the next ones. A model that knows nothing is "
            "no better than predicting no change.",
        )
    return cards(drawn, _numbers(_scalars(found)))


def probes(run: RunFiles) -> str:
    found = run.extras.get("probes")
    if not found:
        return ""
    groups = {
        name.replace("_", " "): {
            probe.replace("_", " "): value
            for probe, value in values.items()
            if probe != "alpha" and value is not None
        }
        for name, values in found.items()
        if isinstance(values, Mapping)
    }
    groups = {name: values for name, values in groups.items() if values}
    drawn = ""
    if groups:
        low = _least(groups)
        cut = " A bar with an arrow is cut: it reaches the number there." if low < LOWEST else ""
        drawn = chart(
            bars_figure(groups, label="R² on episodes not fitted to", limits=(min(0.0, max(LOWEST, low)), 1)),
            "how well physical quantities can be read off the latents",
            f"1: read off exactly. 0: no better than the mean.{cut}",
        )
    return cards(drawn, card(table(nested_table(found, first="quantity", skip=("alpha",)))))


def latents(run: RunFiles) -> str:
    found, cloud = run.extras.get("spectrum") or {}, run.extras.get("latents") or {}
    drawn = []
    if found.get("singular_values"):
        marks = {
            name: float(found[key])
            for key, name in (("effective_rank", "effective rank"), ("rankme", "RankMe"))
            if isinstance(found.get(key), (int, float))
        }
        drawn.append(
            chart(
                spectrum_figure({"singular values": found["singular_values"]}, marks=marks),
                "singular values of the latents by rank",
                "Flat: all directions are used. Falling off at once: collapsed.",
            )
        )
    if cloud.get("points"):
        label = cloud.get("label", "")
        drawn.append(
            chart(
                latent_figure(
                    cloud["points"], cloud["quantity"], label=label, explained=cloud.get("explained")
                ),
                "latents along their two main directions",
                f"Each point is one observation, coloured by {label}." if label else "",
            )
        )
    return cards(*drawn, _numbers(_scalars(found)))


def calibration(run: RunFiles) -> str:
    found = run.extras.get("calibration")
    if not found or not found.get("predicted"):
        return ""
    drawn = chart(
        calibration_figure(found),
        "predicted value against the return that followed",
        "On the dashed line a value says exactly what will follow; above it, it is too modest.",
    )
    return cards(drawn, _numbers(_scalars(found)))


def robustness(run: RunFiles) -> str:
    found = run.extras.get("robustness")
    if not found:
        return ""
    rows, distances = {}, {}
    for change, policies in found.items():
        for policy, values in policies.items():
            rows[f"{change.replace('_', ' ')}, {style.policy_name(policy)}"] = values
            if is_interval(values.get("final_distance")):
                bars = distances.setdefault(change.replace("_", " "), {})
                bars[style.policy_name(policy)] = values["final_distance"]
    drawn = ""
    if distances:
        names = {policy for policies in found.values() for policy in policies}
        colours = {style.policy_name(name): style.policy_colour(name) for name in names}
        drawn = chart(
            bars_figure(distances, label="final distance to the goal [cm]", scale=100, colours=colours),
            "final distance under each change",
            "How far from the goal episodes end when the world is not that of training.",
        )
    return cards(drawn) + table(nested_table(rows, first="change, policy"))


def health(run: RunFiles) -> str:
    logged: dict[str, list[float]] = {}
    for row in run.rows:
        for key, value in row.items():
            if isinstance(value, (int, float)) and key not in ("env_steps", "updates", "time_s"):
                logged.setdefault(key, []).append(float(value))
    found = {k: v for k, v in (run.extras.get("health") or {}).items() if k != "warnings"}
    shown = Markup()
    if logged:
        rows = []
        for key, values in sorted(logged.items()):
            name, scale = logged_name(key)
            scaled = [scale * value for value in values]
            drawn = sparkline(scaled, name + " while training")
            rows.append([name, drawn, number(scaled[-1]), _range(scaled)])
        shown = table(Table(["logged", "over time", "last", "lowest – highest"], rows))
        if found:
            shown = folded("Everything that was logged", shown)
    return cards(_numbers(found)) + shown


def logged_name(key: str) -> tuple[str, float]:
    """What a logged quantity is called, with its unit, and the factor to that unit: as in the tables and curves."""
    *above, leaf = key.split("/")
    name, scale = quantity(leaf)
    who = [style.policy_name(one) for one in above if one != "eval"]
    return ", ".join([name, *who]), scale


def what(run: RunFiles) -> str:
    config = run.config
    planner, collector = config.get("planner") or {}, config.get("collector") or {}
    rows: list[tuple[str, Any]] = [
        ("environment", run.environment if config else None),
        ("model", (config.get("model") or {}).get("name")),
        ("planner", planner.get("variant", planner.get("name"))),
        ("worlds", collector.get("num_envs")),
        ("seed", run.seed),
        ("device", config.get("device")),
        ("scale", config.get("scale")),
    ]
    told = facts((name, plain(value)) for name, value in rows if value is not None)
    used = facts((name.replace("_", " "), plain(value)) for name, value in run.versions.items())
    text = told + headed("Made with", used)
    if config:
        text += folded("The whole configuration", commands(_as_yaml(config).split("\n")))
    return text


def _as_yaml(config: Mapping[str, Any]) -> str:
    """A configuration that others wrote, as text: OmegaConf would parse what is in it."""
    return yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True)


def reproduce(run: RunFiles) -> str:
    place, own = shlex.quote(str(_near(run.folder))), named_plugins(run.config)
    lines = []
    if run.overrides:
        again = any(one.startswith("resume=") for one in run.overrides)  # its scale is that of the first part
        words = [one for one in run.overrides if not (again and one.startswith("scale="))]
        lines += ["# train it again", f"franka-wm train {shlex.join(words)}", ""]
    if run.evaluated:
        lines += ["# evaluate it again", f"franka-wm evaluate {shlex.join(run.evaluated)}", ""]
    kind = (run.config.get("env") or {}).get("kind", "franka")
    if run.counters and kind != "none":  # there is nothing to act in
        shifted, option = (", also in shifted worlds", " robustness=true") if kind == "franka" else ("", "")
        evaluate = f"franka-wm evaluate {place}{_episodes(run)}{option}{own}"
        lines += [f"# evaluate it{shifted}", evaluate, ""]
    if run.counters and kind == "franka":
        lines += ["# watch it", f"franka-wm view checkpoint={place}{own}", ""]
    if run.counters and run.overrides:
        resume = shlex.quote(f"resume={quoted(str(_near(run.folder)))}")
        lines += ["# go on with it", f"franka-wm train {resume}{own}", ""]
    lines += ["# this page", f"franka-wm report {place}"]
    return commands(lines)


# -- texts -----------------------------------------------------------------------------------------------


def _scalars(values: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers and intervals among the entries; curves and texts are shown elsewhere."""
    return {k: v for k, v in values.items() if isinstance(v, (int, float)) or is_interval(v)}


def _numbers(values: Mapping[str, Any]) -> str:
    """Names and numbers on a card."""
    rows = [(name.replace("_", " ").replace("/", " / "), plain(value)) for name, value in values.items()]
    return card(facts(rows)) if rows else ""


def _range(values: list[float]) -> str:
    finite = [v for v in values if math.isfinite(v)]
    return f"{number(min(finite))} – {number(max(finite))}" if finite else "–"


def _least(groups: Mapping[str, Mapping[str, Any]]) -> float:
    """The lowest value."""
    return min(
        float((v["mean"] if isinstance(v, Mapping) else v) or 0)
        for group in groups.values()
        for v in group.values()
    )


def _episodes(run: RunFiles) -> str:
    """As many as it was evaluated over by the command, if it was."""
    episodes = [one.episodes for one in run.results if one.protocol.get("by") == COMMAND]
    return f" episodes={episodes[0]}" if episodes else ""


def _end(run: RunFiles) -> Result | None:
    """What the end of training measured."""
    return next((one for one in run.results if one.protocol.get("by") == END), None)


def _near(folder: Path) -> Path:
    """Relative to where one is, where that is shorter to type."""
    here = Path.cwd()
    return folder.relative_to(here) if folder.is_relative_to(here) else folder
