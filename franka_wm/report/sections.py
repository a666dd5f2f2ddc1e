"""The sections of a run's page. Each is a function of what the run left, and empty where that is not there."""

import math
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from franka_wm.report import style
from franka_wm.report.bars import bars_figure
from franka_wm.report.calibration import calibration_figure
from franka_wm.report.curves import PANELS, panel_figure
from franka_wm.report.document import (
    Section,
    card,
    cards,
    chart,
    commands,
    facts,
    folded,
    picture,
    scrolling,
    sparkline,
    tiles,
    video,
    warning,
)
from franka_wm.report.horizon import horizon_figure
from franka_wm.report.run import RunFiles
from franka_wm.report.spectra import latent_figure, spectrum_figure
from franka_wm.report.table import Table, evaluation_tables, html, is_interval, nested_table

SHOWN = ("planner", "policy")
"""Whose results stand at the top of the page, the first that there is."""


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


def headline(run: RunFiles) -> str:
    """Warnings, and the numbers one looks for first."""
    values: list[tuple[str, str, str]] = []
    shown = next((name for name in SHOWN if name in run.policies), None)
    if shown is not None:
        values += _outcome(run.policies[shown], style.policy_name(shown))
    for name, key, write in (
        ("environment steps", "env_steps", _count),
        ("updates", "updates", _count),
        ("training", "seconds", _duration),
    ):
        if key in run.counters:
            values.append((name, write(float(run.counters[key])), ""))
    return "".join(map(warning, warnings(run))) + (tiles(values) if values else "")


def warnings(run: RunFiles) -> list[str]:
    """What evaluation found wrong, in its words."""
    spectrum, found = run.extras.get("spectrum") or {}, run.extras.get("health") or {}
    texts = [spectrum.get("warning"), *found.get("warnings", [])]
    return list(dict.fromkeys(str(text) for text in texts if text))


def result(run: RunFiles) -> str:
    if not run.policies:
        return ""
    outcome, motion = evaluation_tables(run.policies)
    pictures = []
    success = _success(run.policies)
    if success:
        groups = {
            style.centimetres(distance): {
                style.policy_name(policy): rates[distance]
                for policy, rates in success.items()
                if distance in rates
            }
            for distance in sorted({d for rates in success.values() for d in rates}, key=float, reverse=True)
        }
        colours = {style.policy_name(name): style.policy_colour(name) for name in run.policies}
        pictures.append(
            chart(
                bars_figure(
                    groups, label="successful episodes [%]", scale=100, limits=(0, 100), colours=colours
                ),
                "share of episodes that ended within 5, 2.5 and 1 cm of the goal",
                "Share of episodes that ended this close to the goal; whiskers are 95 % intervals.",
            )
        )
    for key, label, scale, note in (
        ("final_distance", "final distance to the goal [cm]", 100.0, "Shorter is better."),
        ("return", "return of an episode", 1.0, "Further to the right is better."),
    ):
        values = {
            style.policy_name(name): {"": one[key]}
            for name, one in run.policies.items()
            if is_interval(one.get(key))
        }
        if values:
            colours = {style.policy_name(name): style.policy_colour(name) for name in run.policies}
            drawn = bars_figure(values, label=label, scale=scale, colours=colours)
            pictures.append(chart(drawn, f"{label} of every policy", note))
            break  # the return says the same where there is a distance
    protocol = run.extras.get("protocol") or {}
    described = facts((name.replace("_", " "), _plain(value)) for name, value in protocol.items())
    tables = scrolling(html(outcome)) + cards(*pictures)
    if motion.rows:
        tables += "<h3>On the way</h3>" + scrolling(html(motion))
    if run.timing:
        rows = [
            [style.policy_name(name), f"{1000 * one['seconds_per_decision']:.2f}", f"{one['worlds']:g}"]
            for name, one in run.timing.items()
        ]
        header = ["policy", "one decision for all worlds [ms]", "worlds"]
        tables += folded("Time per decision", scrolling(html(Table(header, rows))))
    return tables + (folded("How it was evaluated", described) if described else "")


def curves(run: RunFiles) -> str:
    x = next((key for key in ("env_steps", "updates") if any(key in row for row in run.rows)), None)
    if x is None:
        return ""
    success = (run.config.get("env") or {}).get("success_distance")
    drawn = (
        chart(
            panel_figure(run.rows, panel, x=x, success_distance=success),
            f"{panel.replace('_', ' ')} while training",
        )
        for panel in PANELS
    )
    return cards(*drawn)


def videos(run: RunFiles) -> str:
    film, still = run.pictures.get("video.mp4"), run.pictures.get("last_frame.png")
    if film is not None:
        return card(
            video(film, "episodes of the planner", poster=still),
            "Episodes that training never saw; the ring marks the goal.",
            kind="single",
        )
    if still is not None:
        return card(
            picture(still, "last frame of the episodes"),
            "The last frame; the ring marks the goal.",
            kind="single",
        )
    return ""


def imagined(run: RunFiles) -> str:
    film, strip = run.pictures.get("imagined.mp4"), run.pictures.get("imagined.png")
    parts = [
        card(
            picture(strip, "imagined frames below real ones"),
            "Above what happened, below what the model imagined from the first frame and the actions alone.",
            kind="wide strip",
        )
        if strip
        else "",
        card(video(film, "imagined beside real"), "Real and imagined, side by side.") if film else "",
    ]
    masks = run.pictures.get("masks.png")
    parts.append(
        card(picture(masks, "what the masks hide"), "What the masks hide.", kind="single") if masks else ""
    )
    text = "<p>A decoder, trained on the side and used by nothing else, turns latents into pictures.</p>"
    return (text if film or strip else "") + cards(*parts) if any(parts) else ""


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
        drawn = chart(
            bars_figure(groups, label="R² on episodes not fitted to", limits=(min(0.0, _least(groups)), 1)),
            "how well physical quantities can be read off the latents",
            "1: read off exactly. 0: no better than the mean.",
        )
    return cards(drawn, card(scrolling(html(nested_table(found, first="quantity", skip=("alpha",))))))


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
    return cards(drawn) + scrolling(html(nested_table(rows, first="change, policy")))


def health(run: RunFiles) -> str:
    logged: dict[str, list[float]] = {}
    for row in run.rows:
        for key, value in row.items():
            if isinstance(value, (int, float)) and key not in ("env_steps", "updates", "time_s"):
                logged.setdefault(key, []).append(float(value))
    found = {k: v for k, v in (run.extras.get("health") or {}).items() if k != "warnings"}
    table = ""
    if logged:
        rows = "".join(
            f'<tr><th scope="row">{key}</th><td>{sparkline(values, key + " while training")}</td>'
            f"<td>{_number(values[-1])}</td><td>{_range(values)}</td></tr>"
            for key, values in sorted(logged.items())
        )
        head = (
            '<th scope="col">logged</th><th scope="col">over time</th><th scope="col">last</th>'
            '<th scope="col">lowest – highest</th>'
        )
        table = scrolling(f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>")
        if found:
            table = folded("Everything that was logged", table)
    return cards(_numbers(found)) + table


def what(run: RunFiles) -> str:
    config = run.config
    planner, collector = config.get("planner") or {}, config.get("collector") or {}
    rows: list[tuple[str, Any]] = [
        ("environment", run.environment if config else None),
        ("model", (config.get("model") or {}).get("name")),
        ("planner", planner.get("name")),
        ("worlds", collector.get("num_envs")),
        ("seed", run.seed),
        ("device", config.get("device")),
        ("scale", config.get("scale")),
    ]
    told = facts((name, _plain(value)) for name, value in rows if value is not None)
    used = facts((name.replace("_", " "), _plain(value)) for name, value in run.versions.items())
    text = told + (f"<h3>Made with</h3>{used}" if used else "")
    if config:
        text += folded(
            "The whole configuration", commands(OmegaConf.to_yaml(OmegaConf.create(dict(config))).split("\n"))
        )
    return text


def reproduce(run: RunFiles) -> str:
    from franka_wm.cli import VERBS

    place = shlex.quote(str(_near(run.folder)))
    lines = []
    if run.overrides:
        lines += ["# train it again", f"python train.py {shlex.join(run.overrides)}", ""]
    if run.counters and "evaluate" in VERBS:
        lines += [
            "# evaluate it, also in shifted worlds",
            f"franka-wm evaluate checkpoint={place}{_episodes(run)} robustness=true",
            "",
        ]
    if run.counters and "view" in VERBS:
        lines += ["# watch it", f"franka-wm view checkpoint={place}", ""]
    if run.counters and run.overrides:
        lines += ["# go on with it", f"python train.py resume={place}", ""]
    lines += ["# this page", f"franka-wm report {place}"]
    return commands(lines)


# -- texts -----------------------------------------------------------------------------------------------


def _outcome(values: Mapping[str, Any], who: str) -> list[tuple[str, str, str]]:
    out = []
    distance = values.get("final_distance") or {}
    if is_interval(distance) and None not in distance.values():
        digits = 0 if distance["mean"] >= 0.1 else 2  # [m]; shown in cm
        mean, low, high = (f"{100 * distance[k]:.{digits}f}" for k in ("mean", "low", "high"))
        out.append(("final distance", f"{mean} cm", f"{low} – {high}, {who}"))
    rates = _success({who: values}).get(who, {})
    if rates:
        widest = max(rates, key=float)
        rate = rates[widest]
        out.append(
            (
                f"success at {style.centimetres(widest)}",
                f"{100 * rate['mean']:.0f} %",
                f"{100 * rate['low']:.0f} – {100 * rate['high']:.0f}, {values.get('episodes', '?')} episodes",
            )
        )
    return out


def _success(policies: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """policy -> distance [m] -> interval, of the rates at the end of an episode."""
    out = {}
    for policy, values in policies.items():
        rates = values.get("success_end", values.get("success"))
        if isinstance(rates, Mapping):
            kept = {d: rate for d, rate in rates.items() if is_interval(rate)}
            if kept and not is_interval(rates):
                out[policy] = kept
    return out


def _scalars(values: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers and intervals among the entries; curves and texts are shown elsewhere."""
    return {k: v for k, v in values.items() if isinstance(v, (int, float)) or is_interval(v)}


def _numbers(values: Mapping[str, Any]) -> str:
    """Names and numbers on a card."""
    rows = [(name.replace("_", " ").replace("/", " / "), _plain(value)) for name, value in values.items()]
    return card(facts(rows)) if rows else ""


def _plain(value: Any) -> str:
    if is_interval(value):
        return f"{_number(value['mean'])} ({_number(value['low'])} – {_number(value['high'])})"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_plain(one)}" for name, one in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(map(_plain, value))
    return "–" if value is None else str(value)


def _number(value: float | None) -> str:
    return f"{value:.4g}" if value is not None and math.isfinite(value) else "not finite"


def _range(values: list[float]) -> str:
    finite = [v for v in values if math.isfinite(v)]
    return f"{_number(min(finite))} – {_number(max(finite))}" if finite else "–"


def _least(groups: Mapping[str, Mapping[str, Any]]) -> float:
    """The lowest value, but not below −1: one probe far off would squeeze all others."""
    low = min(
        float((v["mean"] if isinstance(v, Mapping) else v) or 0)
        for group in groups.values()
        for v in group.values()
    )
    return max(-1.0, low)


def _count(number: float) -> str:
    for size, suffix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if number >= size:
            return f"{number / size:.3g}{suffix}"
    return f"{number:.0f}"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _episodes(run: RunFiles) -> str:
    """As many as it was evaluated over by the command, if it was."""
    episodes = (run.extras.get("protocol") or {}).get("episodes")
    return f" episodes={episodes}" if isinstance(episodes, int) else ""


def _near(folder: Path) -> Path:
    """Relative to where one is, where that is shorter to type."""
    here = Path.cwd()
    return folder.relative_to(here) if folder.is_relative_to(here) else folder
