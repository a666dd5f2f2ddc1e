"""What was measured of a run: its ``evaluation.json`` files, which of them is shown, and the point of the curves it is.

A run may be judged more than once: at the end of training, into ``RUN/evaluation.json``, and by ``franka-wm evaluate``,
into ``RUN/evaluation/evaluation.json``. Both have the same form, an object with

    protocol      {name: text or number}: how it was measured: ``by`` whom, ``episodes``, ``updates``, ``env_steps``,
                  ``training_seconds``, ``task``, ``model``, ``planner``, ``seed``, ``device``, ``hardware``
    policies      {policy: {quantity: number or interval}}; an interval is ``{"mean", "low", "high"}``

Quantities are those of :func:`franka_wm.evaluation.closed_loop.summarize`. Of the command there may be more:

    open_loop     {"curves": {name: {"mean": [H], "low": [H], "high": [H]}}, "steps": [H], "unit": text,
                   "rank_correlation": number or interval}
    probes        {quantity: {probe: R² or interval or null}}
    spectrum      {"singular_values": [D], "effective_rank", "rankme", "feature_std", "mean_cosine", …, "warning"}
    latents       {"points": [[x, y], …], "quantity": [N], "label": text, "explained": [2]}
    calibration   {"predicted": [B], "true": [B], "low": [B], "high": [B], "count": [B]}
    robustness    {change: {policy: {metric: number or interval}}}
    health        {name: number}, and "warnings": [text]

A number that is not known is null.

Where the command writes elsewhere than into the run's folder, ``run.json`` beside it says of which run it is:
``config``, as it was evaluated, ``overrides``, what was typed after ``train.py``, ``preset``, that of ``env``, and
``typed``, what was typed after ``franka-wm evaluate``.
"""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from franka_wm.errors import UserError
from franka_wm.policies.names import RENAMED
from franka_wm.untrusted import UntrustedFolder

FILE, OF_RUN = "evaluation.json", "run.json"
OTHERWISE = "planned with"
"""Key of a protocol: settings of the planner that are not the run's, given to ``franka-wm evaluate``."""
END, COMMAND = "the end of training", "franka-wm evaluate"
"""Who measured, as ``protocol`` says under ``by``."""

SHOWN = ("planner", "policy")
"""Whose results count for a run, the first that there is."""

EXTRAS = ("open_loop", "probes", "spectrum", "latents", "calibration", "robustness", "health")


@dataclass(frozen=True)
class Result:
    """The content of one ``evaluation.json``.

    Attributes:
        path: of the file.
        protocol: how it was measured.
        policies: name -> numbers and intervals.
        extras: entries of `EXTRAS`.
    """

    path: Path
    protocol: Mapping[str, Any] = field(default_factory=dict)
    policies: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    extras: Mapping[str, Any] = field(default_factory=dict)

    @property
    def episodes(self) -> int:
        """Per policy."""
        return max((int(one.get("episodes", 0)) for one in self.policies.values()), default=0)

    @property
    def updates(self) -> float | None:
        """After how many updates of the weights, where it says so."""
        found = self.protocol.get("updates")
        return found if isinstance(found, (int, float)) and not isinstance(found, bool) else None

    @property
    def told(self) -> str:
        """Who measured it, over how many episodes, after how many updates."""
        after = "" if self.updates is None else f" after {self.updates:,.0f} updates"
        return f"{self.protocol.get('by', self.path.name)}, {self.episodes} episodes{after}"


def results(folder: str | Path) -> list[Result]:
    """All results in a run's folder: of the latest weights first, of the same weights the one with most episodes.

    Of equal ones the command's comes first, which says more. Where one does not say how many updates its weights had,
    episodes alone count.

    Raises:
        UserError: a file that cannot be read, or is of an older form.
    """
    run = UntrustedFolder(Path(folder))
    found = [_result(run, name) for name in (f"evaluation/{FILE}", FILE) if run.path(name)]
    known = all(one.updates is not None for one in found)
    return sorted(found, key=lambda one: ((known and one.updates) or 0, one.episodes), reverse=True)


def read_result(path: str | Path) -> Result:
    """One ``evaluation.json``.

    Raises:
        UserError: it cannot be read, or is of an older form.
    """
    return _result(UntrustedFolder(Path(path).parent), Path(path).name)


def _result(folder: UntrustedFolder, name: str) -> Result:
    path = folder.root / name
    found = folder.json(name)
    if found is None:
        raise UserError(f"{path} is missing; measure the run: franka-wm evaluate RUN")
    protocol, policies = found.get("protocol"), found.get("policies")
    if not isinstance(protocol, Mapping) or not isinstance(policies, Mapping):
        raise UserError(
            f"{path} is of an older form, without `protocol` and `policies`; remove it and measure again: "
            "franka-wm evaluate RUN"
        )
    if not all(isinstance(one, Mapping) for one in policies.values()):
        raise UserError(f"{path}: `policies` must hold an object for each policy; measure the run again")
    extras = {name: found[name] for name in EXTRAS if found.get(name)}
    policies = {RENAMED.get(str(name), str(name)): one for name, one in policies.items()}
    return Result(path, dict(protocol), policies, extras)


def point(
    policies: Mapping[str, Mapping[str, Any]], *, success_distance: float | None = None
) -> dict[str, float]:
    """A point of the learning curves: the means of a table, by the names that they are logged and drawn with.

    Args:
        policies: name -> summary.
        success_distance: of the several that count as success, the task's own [m].

    Returns:
        ``eval/POLICY/QUANTITY``: ``final_distance`` [m], ``success``, ``return``, of several tasks at once
        ``success_TASK``, and the task's own measures; what there is.
    """
    numbers = {}
    for name, summary in policies.items():
        success = summary.get("success") or {}
        found = {
            "final_distance": summary.get("final_distance"),
            "success": success if "mean" in success else success.get(f"{success_distance or 0:g}"),
            "return": summary.get("return"),
            **{f"success_{loggable(key)}": one for key, one in (summary.get("task_success") or {}).items()},
            **{loggable(key): value for key, value in (summary.get("measures") or {}).items()},
        }
        numbers |= {f"eval/{name}/{key}": value["mean"] for key, value in found.items() if value is not None}
    return numbers


def score(policies: Mapping[str, Mapping[str, Any]]) -> float | None:
    """How well a run did, in one number, for a search over options; higher is better.

    Of the planner, or of the policy where there is no planner: the share of episodes [0, 1] that end in success where
    the task itself judges it; minus the mean final distance [m] where the goal is a place; else the mean return.
    """
    summary = next((policies[name] for name in SHOWN if name in policies), None)
    if summary is None:
        return None
    success = summary.get("success") or {}
    if "mean" in success:
        return success["mean"]
    return -summary["final_distance"]["mean"] if "final_distance" in summary else summary["return"]["mean"]


def loggable(name: str) -> str:
    """A name that every logger takes: ``height [m]`` → ``height_m``."""
    return re.sub(r"[^\w.-]+", "_", name).strip("_")


def last_row(found: Sequence[Result], during: Sequence[str]) -> dict[str, float]:
    """The last point of the curves, as the end of training measured it; empty where it did not.

    Args:
        found: of `results`.
        during: the policies that have curves.
    """
    result = next((one for one in found if one.protocol.get("by") == END), None)
    if result is None:
        return {}
    drawn = {name: one for name, one in result.policies.items() if name in during}
    numbers = point(drawn, success_distance=result.protocol.get("success_distance"))
    places = {"env_steps": "env_steps", "updates": "updates", "time_s": "training_seconds"}
    placed = {name: result.protocol[key] for name, key in places.items() if key in result.protocol}
    return numbers | placed if numbers else {}


def to_json(value: object) -> str:
    """JSON; what is not a finite number becomes null, since JSON has no word for it."""

    def clean(x: object) -> object:
        if isinstance(x, Mapping):
            return {str(key): clean(one) for key, one in x.items()}
        if isinstance(x, (list, tuple)):
            return [clean(one) for one in x]
        return None if isinstance(x, float) and not math.isfinite(x) else x

    return json.dumps(clean(value), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
