"""What lies in a run's folder, read for people: nothing is executed or unpickled, and nothing is needed twice.

    config.yaml             what was run
    .hydra/overrides.yaml   what was typed after ``train.py``
    versions.json           packages and machine, as `franka_wm.report.versions` writes them
    evaluation.json         results; see below
    checkpoints/…           counters and the logged rows; without a checkpoint, rows come from ``csv/``
    video.mp4, last_frame.png, imagined.mp4, imagined.png, masks.png    pictures
    evaluation/             what ``franka-wm evaluate`` wrote: evaluation.json, timing.json and pictures; they stand
                            for those above, which training wrote, since they rest on more episodes

``evaluation.json`` is an object whose entries are policies (``planner``, ``noop``, …), or one with those under
``policies``. A policy holds numbers and intervals (``{"mean", "low", "high"}``). Beside the policies there may be

    open_loop     {"curves": {name: {"mean": [H], "low": [H], "high": [H]}}, "steps": [H], "unit": text,
                   "rank_correlation": number or interval}
    probes        {quantity: {probe: R² or interval or null}}
    spectrum      {"singular_values": [D], "effective_rank", "rankme", "feature_std", "mean_cosine", …, "warning"}
    latents       {"points": [[x, y], …], "quantity": [N], "label": text, "explained": [2]}
    calibration   {"predicted": [B], "true": [B], "low": [B], "high": [B], "count": [B]}
    robustness    {change: {policy: {metric: number or interval}}}
    health        {name: number}, and "warnings": [text]
    protocol      {name: text or number}: how it was evaluated

``timing.json`` holds {policy: {"seconds_per_decision", "worlds"}}.

A number that is not known is null. All of them are optional; `franka_wm.report.page` shows what there is.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from franka_wm.errors import UserError

SAME_BUT = ("seed", "device", "resume")
"""Runs whose configurations differ in these alone are repetitions of one another."""

EXTRAS = (
    "open_loop",
    "probes",
    "spectrum",
    "latents",
    "calibration",
    "robustness",
    "health",
    "protocol",
)
"""Entries of ``evaluation.json`` that are not policies."""

PICTURES = ("video.mp4", "last_frame.png", "imagined.mp4", "imagined.png", "masks.png")


@dataclass(frozen=True)
class RunFiles:
    """What was found in a run's folder; empty where there was nothing.

    Attributes:
        folder: of the run.
        config: resolved configuration.
        overrides: typed after ``train.py``.
        versions: of packages and machine.
        policies: name -> numbers and intervals.
        extras: entries of `EXTRAS`.
        rows: logged while training.
        counters: of the checkpoint: ``updates``, ``env_steps``, ``seconds``.
        pictures: name -> path, of `PICTURES`.
        timing: policy -> ``seconds_per_decision``, ``worlds``.
    """

    folder: Path
    config: Mapping[str, Any] = field(default_factory=dict)
    overrides: list[str] = field(default_factory=list)
    versions: Mapping[str, Any] = field(default_factory=dict)
    policies: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    extras: Mapping[str, Any] = field(default_factory=dict)
    rows: list[dict[str, float]] = field(default_factory=list)
    counters: Mapping[str, float] = field(default_factory=dict)
    pictures: Mapping[str, Path] = field(default_factory=dict)
    timing: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The folder's name, with its parent's where a run is called only by the time it started."""
        return (
            f"{self.folder.parent.name}/{self.folder.name}"
            if self.folder.name[:2].isdigit()
            else self.folder.name
        )

    @property
    def seed(self) -> int | None:
        return self.config.get("seed")

    @property
    def environment(self) -> str:
        """Task and where its goals come from, in words of the configuration."""
        env = self.config.get("env") or {}
        task = env.get("task") or env.get("name") or env.get("kind")
        if task is None:
            return "unknown environment"
        goals = env.get("goal_sampling")
        return f"{task}, {goals} goal" if goals else str(task)

    @property
    def model(self) -> str:
        return str((self.config.get("model") or {}).get("name", "unknown model"))


def read_run(folder: str | Path) -> RunFiles:
    """Read everything that a run, or ``franka-wm evaluate``, left in a folder.

    Raises:
        UserError: no such folder, nothing of a run in it, or a file that cannot be read.
    """
    run = Path(folder)
    if not run.is_dir():
        raise UserError(f"{run} is not a folder; give the folder of a run, as train.py prints it last.")
    config = _yaml(run / "config.yaml")
    # The command's own evaluation first; then what the end of training found.
    places = [place for place in (run / "evaluation", run) if place.is_dir()]
    source = next((p / "evaluation.json" for p in places if (p / "evaluation.json").is_file()), None)
    evaluation = None if source is None else _json(source)
    timing = next((found for place in places if (found := _json(place / "timing.json"))), {})
    if config is None and evaluation is None:
        raise UserError(
            f"{run} holds neither config.yaml nor evaluation.json; give the folder of a run, "
            "as train.py prints it last."
        )
    rows, counters, version = _history(run)
    versions = _json(run / "versions.json") or ({"franka_wm": version} if version else {})
    policies, extras = split_evaluation(evaluation or {}, source=source or run)
    return RunFiles(
        folder=run.resolve(),
        config=config or {},
        overrides=[str(one) for one in _yaml(run / ".hydra" / "overrides.yaml") or []],
        versions=versions,
        policies=policies,
        extras=extras,
        rows=rows,
        counters=counters,
        pictures={name: p / name for p in reversed(places) for name in PICTURES if (p / name).is_file()},
        timing=timing,
    )


def read_config(folder: str | Path) -> dict[str, Any]:
    """The configuration of a run; empty if it has none.

    Raises:
        UserError: It cannot be read.
    """
    return _yaml(Path(folder) / "config.yaml") or {}


def but_for_the_seed(config: Mapping[str, Any]) -> str:
    """The same for repetitions, and for nothing else; empty for an empty configuration."""
    kept = {name: value for name, value in config.items() if name not in SAME_BUT}
    return json.dumps(kept, sort_keys=True, default=str) if kept else ""


def split_evaluation(
    evaluation: Mapping[str, Any], *, source: str | Path = "evaluation.json"
) -> tuple[dict[str, Mapping[str, Any]], dict[str, Any]]:
    """The policies of an ``evaluation.json``, and the entries of `EXTRAS`; see the module's docstring.

    Raises:
        UserError: an entry that is neither.
    """
    extras = {name: evaluation[name] for name in EXTRAS if evaluation.get(name)}
    policies = evaluation.get("policies")
    if policies is None:
        policies = {name: value for name, value in evaluation.items() if name not in EXTRAS}
        # Whatever else stands beside the policies is not one: a policy was played, so it has a return.
        policies = {name: v for name, v in policies.items() if isinstance(v, Mapping) and "return" in v}
    if not isinstance(policies, Mapping) or not all(isinstance(v, Mapping) for v in policies.values()):
        raise UserError(f"{source}: `policies` must hold an object for each policy; evaluate the run again.")
    return dict(policies), extras


# -- files -----------------------------------------------------------------------------------------------


def _json(path: Path) -> Any:
    if not path.is_file():
        return None
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read ({error}); remove it or evaluate the run again.") from error
    if not isinstance(found, dict):
        raise UserError(f"{path} holds no object; remove it or evaluate the run again.")
    return found


def _yaml(path: Path) -> Any:
    if not path.is_file():
        return None
    try:
        return OmegaConf.to_container(OmegaConf.load(path), resolve=True)
    except (OSError, yaml.YAMLError, OmegaConfBaseException, UnicodeDecodeError) as error:
        raise UserError(f"{path} cannot be read ({error}); remove it or give another run.") from error


def _history(run: Path) -> tuple[list[dict[str, float]], dict[str, float], str | None]:
    """Rows, counters and the package's version, from the newest checkpoint; rows from ``csv/`` without one."""
    if any((run / "checkpoints").glob("*/manifest.json")):
        from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint

        checkpoint = load_checkpoint(latest_checkpoint(run))
        rows = (checkpoint.extra() or {}).get("rows") or []
        manifest = json.loads((checkpoint.folder / "manifest.json").read_text())
        return list(rows), dict(checkpoint.counters), manifest.get("franka_wm")
    return csv_rows(run / "csv" / "scalars"), {}, None


def csv_rows(folder: str | Path) -> list[dict[str, float]]:
    """The logged rows in a CSV logger's folder: one file for each quantity, ``updates,value`` in its lines.

    Raises:
        UserError: a line that is not two numbers.
    """
    rows: dict[float, dict[str, float]] = {}
    for path in sorted(Path(folder).rglob("*.csv")):
        name = path.relative_to(folder).with_suffix("").as_posix()
        for number, line in enumerate(path.read_text().splitlines(), 1):
            try:
                step, value = map(float, line.split(","))
            except ValueError as error:
                raise UserError(
                    f"{path}, line {number}: {line!r} is not `step,value`; remove the line or the file."
                ) from error
            rows.setdefault(step, {"updates": step})[name] = value
    return [rows[step] for step in sorted(rows) if math.isfinite(step)]
