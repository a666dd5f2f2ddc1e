"""What lies in a run's folder, read for people through :mod:`franka_wm.untrusted`.

    config.yaml             what was run
    .hydra/overrides.yaml   what was typed after ``train.py``
    .hydra/hydra.yaml       where configurations of the user's own are, and the preset that was chosen for `env`
    versions.json           packages and machine, as `franka_wm.versions` writes them
    evaluation.json         results, as :mod:`franka_wm.evaluation.results` describes them
    run.json                instead of config.yaml and .hydra/: of which run ``franka-wm evaluate`` wrote results here
    checkpoints/…           counters and the logged rows; without a checkpoint, rows come from ``csv/``
    video.mp4, last_frame.png, imagined.mp4, imagined.png    images
    evaluation/             what ``franka-wm evaluate`` wrote: evaluation.json, timing.json and images. Of two
                            evaluation.json that of later weights is shown first, of the same weights the one with
                            more episodes; the other is named

``timing.json`` holds {policy: {"seconds_per_decision", "worlds"}}.

All of them are optional; `franka_wm.report.page` shows what there is.
"""

import json
import math
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from franka_wm.errors import UserError
from franka_wm.evaluation.results import OF_RUN, OTHERWISE, Result, last_row, results
from franka_wm.untrusted import UntrustedFolder, check_image, check_video, values_of

SAME_BUT = ("seed", "device", "resume")
"""Runs whose configurations differ in these alone are repetitions of one another."""

IMAGES = ("video.mp4", "last_frame.png", "imagined.mp4", "imagined.png")


@dataclass(frozen=True)
class RunFiles:
    """What was found in a run's folder; empty where there was nothing.

    Attributes:
        folder: of the run.
        config: as the run saved it; interpolations are never resolved here.
        overrides: typed after ``train.py``, of Hydra's own only where configurations of the user's are.
        preset: what was chosen for ``env``, typed or by an experiment; empty where that is not known.
        versions: of packages and machine.
        results: of the run's end and of ``franka-wm evaluate``; the one that is shown first, see `results`.
        rows: logged while training, and what its end found.
        counters: of the checkpoint: ``updates``, ``env_steps``, ``seconds``.
        images: name -> path, of `IMAGES`.
        timing: policy -> ``seconds_per_decision``, ``worlds``.
        damage: why the newest checkpoint cannot be read; empty if it can, or there is none.
        elsewhere: the folder is none of a run: results of one that lies elsewhere.
        evaluated: what was typed after ``franka-wm evaluate`` for these.
    """

    folder: Path
    config: Mapping[str, Any] = field(default_factory=dict)
    overrides: list[str] = field(default_factory=list)
    preset: str = ""
    versions: Mapping[str, Any] = field(default_factory=dict)
    results: Sequence[Result] = ()
    rows: list[dict[str, float]] = field(default_factory=list)
    counters: Mapping[str, float] = field(default_factory=dict)
    images: Mapping[str, Path] = field(default_factory=dict)
    timing: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    damage: str = ""
    elsewhere: bool = False
    evaluated: Sequence[str] = ()

    @property
    def policies(self) -> Mapping[str, Mapping[str, Any]]:
        """Policies of the result that is shown: name -> numbers and intervals."""
        return self.results[0].policies if self.results else {}

    @property
    def extras(self) -> Mapping[str, Any]:
        """What was found besides the policies, by whichever looked at the weights that are shown."""
        shown = self.results[0].updates if self.results else None
        same = [one for one in self.results if one.updates == shown or None in (one.updates, shown)]
        return {name: value for one in reversed(same) for name, value in one.extras.items()}

    @property
    def otherwise(self) -> str:
        """What was planned with, in the result that is shown, where it is not what the run planned with."""
        return str(self.results[0].protocol.get(OTHERWISE, "")) if self.results else ""

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
        """Task and where its goals come from, in words of the configuration; of the suite the domain before it."""
        env = self.config.get("env") or {}
        task = " ".join(str(env[key]) for key in ("name", "task") if env.get(key)) or env.get("kind")
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
    with malformed(run):
        return _read_run(run)


def _read_run(run: Path) -> RunFiles:
    files = UntrustedFolder(run)
    config, typed, preset = _chosen(files)
    told = _told_of_run(files) if config is None else None
    if told is not None:
        config, typed, preset = told["config"], list(map(str, told["overrides"])), str(told["preset"])
    found = results(run)
    if config is None and not found:
        raise UserError(
            f"{run} holds neither config.yaml nor evaluation.json; give the folder of a run, "
            "as train.py prints it last."
        )
    rows, counters, version, damage = _history(files)
    versions = files.json("versions.json") or ({"franka_wm": version} if version else {})
    end = last_row(found, ((config or {}).get("evaluation") or {}).get("during") or ())
    numbers = end.keys() - {"env_steps", "time_s"}
    # A logger's files hold it already; a checkpoint was saved before.
    if end and not any(numbers <= row.keys() and row["updates"] == end["updates"] for row in rows):
        rows.append(end)
    return RunFiles(
        folder=run.resolve(),
        config=config or {},
        overrides=typed,
        preset=preset,
        versions=versions,
        results=found,
        rows=rows,
        counters=counters,
        images={name: path for name in IMAGES if (path := _image(files, name)) is not None},
        timing=files.json("evaluation/timing.json") or files.json("timing.json") or {},
        damage=damage,
        elsewhere=told is not None,
        evaluated=list(map(str, told["typed"])) if told is not None else [],
    )


def read_chosen(folder: str | Path) -> dict[str, Any]:
    """What a run was told: ``config``, ``overrides`` and ``preset``, as in :class:`RunFiles`.

    Raises:
        UserError: It cannot be read.
    """
    with malformed(folder):
        config, typed, preset = _chosen(UntrustedFolder(Path(folder)))
    return {"config": config or {}, "overrides": typed, "preset": preset}


def _told_of_run(files: UntrustedFolder) -> dict[str, Any] | None:
    """The run of which ``franka-wm evaluate`` wrote the results that lie here."""
    told = files.json(OF_RUN)
    return told if told is not None and {"config", "overrides", "preset", "typed"} <= told.keys() else None


def read_config(folder: str | Path) -> dict[str, object]:
    """The configuration of a run, or of the one that results here are of; empty if there is none.

    Raises:
        UserError: It cannot be read.
    """
    files = UntrustedFolder(Path(folder))
    config = _config(files)
    return config if config is not None else (_told_of_run(files) or {}).get("config") or {}


def but_for_the_seed(config: Mapping[str, object]) -> str:
    """The same for repetitions, and for nothing else; empty for an empty configuration."""
    kept = without_the_seed(config, config.get("seed"))
    if isinstance(model := kept.get("model"), Mapping):  # null is not given
        kept["model"] = {name: value for name, value in model.items() if value is not None}
    return json.dumps(kept, sort_keys=True, default=str) if kept else ""


def as_asked(config: Mapping[str, object]) -> dict[str, object]:
    """What a resumed run's model had found itself counts as not given, as in the run that it went on from."""
    kept = {name: value for name, value in config.items() if name != "derived"}
    model, derived = kept.get("model"), config.get("derived")
    if isinstance(model, Mapping) and isinstance(derived, list):
        kept["model"] = {name: None if name in derived else value for name, value in model.items()}
    return kept


def without_the_seed(config: Mapping[str, object], seed: object) -> dict[str, object]:
    """As asked, without what repetitions differ in: what is in `SAME_BUT`, and a dataset's seed that follows `seed`."""
    kept = {name: value for name, value in as_asked(config).items() if name not in SAME_BUT}
    dataset = kept.get("dataset")
    if isinstance(dataset, Mapping) and dataset.get("seed") == seed:
        kept["dataset"] = {name: value for name, value in dataset.items() if name != "seed"}
    return kept


def malformed(*folders: Path | str) -> AbstractContextManager[None]:
    """Around the use of runs' values: those of another form than documented end in one line."""
    some = [str(one) for one in folders[:3]] + [f"{len(folders) - 3} others"] * (len(folders) > 3)
    return values_of(" or ".join(some), "measure the run again.")


# -- files -----------------------------------------------------------------------------------------------


def _config(files: UntrustedFolder) -> dict[str, Any] | None:
    found = files.yaml("config.yaml")
    if found is not None and not isinstance(found, dict):
        raise UserError(
            f"{files.root / 'config.yaml'} holds no configuration; remove it or give another run."
        )
    return found


def _chosen(files: UntrustedFolder) -> tuple[dict[str, Any] | None, list[str], str]:
    """Configuration, overrides and preset of a run; None, none and empty where it has none."""
    typed, hydras = list(map(str, files.yaml(".hydra/overrides.yaml") or [])), files.yaml(".hydra/hydra.yaml")
    return _config(files), [*typed, *_searchpath(hydras)], _preset(typed, hydras)


def _searchpath(hydras: Any) -> list[str]:
    own = _entry(hydras, "hydra", "overrides", "hydra")  # most, such as the folder, are this run's alone
    return [one for one in map(str, own or []) if one.startswith("hydra.searchpath=")]


def _preset(typed: Sequence[str], hydras: Any) -> str:
    if any(one.lstrip("+").startswith("resume=") and one[-5:] != "=null" for one in typed):
        return ""  # its environment is that of the run that it goes on with, whatever Hydra chose
    return str(_entry(hydras, "hydra", "runtime", "choices", "env") or "")


def _entry(values: Any, *keys: str) -> Any:
    """What lies below the keys; None where a level is missing, or is no mapping."""
    for key in keys:
        values = values.get(key) if isinstance(values, dict) else None
    return values


def _image(files: UntrustedFolder, name: str) -> Path | None:
    """An image or video by its name, that of ``franka-wm evaluate`` first; checked, since a page will hold it."""
    path = files.path(f"evaluation/{name}") or files.path(name)
    if path is not None:
        (check_image if name.endswith(".png") else check_video)(path)
    return path


def _history(files: UntrustedFolder) -> tuple[list[dict[str, float]], dict[str, float], str | None, str]:
    """Rows, counters and the package's version, from the newest checkpoint; rows from ``csv/`` without a whole one.

    The last is why a checkpoint that is there cannot be read.
    """
    damage = ""
    checkpoints = files.below("checkpoints")
    if any(checkpoints.root.glob("*/manifest.json")):
        from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint
        from franka_wm.training.history import read_rows
        from franka_wm.training.manifest import read_manifest

        checkpoints.check_links()
        try:
            checkpoint = load_checkpoint(latest_checkpoint(files.root))
            return (
                read_rows(checkpoint),
                dict(checkpoint.counters),
                read_manifest(checkpoint.folder).written_by,
                "",
            )
        except UserError as error:
            damage = str(error)
    return csv_rows(files.below("csv/scalars").root), {}, None, damage


def csv_rows(folder: str | Path) -> list[dict[str, float]]:
    """The logged rows in a CSV logger's folder: one file for each quantity, ``updates,value`` in its lines.

    Raises:
        UserError: a line that is not two numbers.
    """
    rows: dict[float, dict[str, float]] = {}
    files = UntrustedFolder(Path(folder))
    for file in files.files("*.csv"):
        name = file.removesuffix(".csv")
        for number, line in enumerate((files.text(file) or "").splitlines(), 1):
            try:
                step, value = map(float, line.split(","))
            except ValueError as error:
                raise UserError(
                    f"{files.root / file}, line {number}: {line[:80]!r} is not `step,value`; "
                    "remove the line or the file."
                ) from error
            rows.setdefault(step, {"updates": step})[name] = value
    return [rows[step] for step in sorted(rows) if math.isfinite(step)]
