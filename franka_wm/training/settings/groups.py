"""The groups of a run's settings: each option declared once, with what it may be.

What an option means stands beside its value in ``conf/``. All but the arm's configuration is read without torch and the
simulator, so that what is wrong is answered before they load.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from franka_wm import conf, models
from franka_wm.envs.config import FrankaConfig
from franka_wm.envs.external_config import ExternalConfig, external_config
from franka_wm.envs.multitask_config import MultiTaskConfig, multi_task_config
from franka_wm.errors import UserError
from franka_wm.options import (
    OF_ONES_OWN,
    PRECISIONS,
    choice,
    flag,
    is_whole,
    read,
    real,
    several,
    text,
    value,
    whole,
    whole_rule,
)
from franka_wm.policies.names import POLICIES

SCHEDULES = ("constant", "cosine")
"""How the learning rate goes on after the warm-up."""

MODELS_OWN = "the model's own"
MOST_UPDATES = 10**12
"""Most updates of a run: a thousand a second for thirty years."""


def _is_names(given: object) -> bool:
    many = given if isinstance(given, list | tuple) else [given]
    return bool(many) and all(isinstance(one, str) and one for one in many)


_A_FOLDER, _A_NAME = "a folder or a list of them", "USER/NAME or a list of them"


@dataclass(frozen=True)
class CollectorSettings:
    """Who gathers experience, in how many worlds."""

    policy: str = choice("auto", of=("auto", *POLICIES))
    num_envs: int = whole(least=1, most=10**6)
    steps_per_batch: int = whole(least=1, most=10**6)
    seed_steps: int = whole(least=1)
    seed_updates: int = whole(0, least=0, most=MOST_UPDATES)
    smoothness: float = real(0.7, least=0, below=1)
    noise: float = real(0.0, least=0, most=2, unit="units of the action")
    planner_worlds: int = whole(0, least=0)
    workers: int = whole(0, least=0)
    ray: bool = flag(False)


@dataclass(frozen=True)
class ReplaySettings:
    """What is kept of the experience."""

    capacity: int = whole(least=1)
    batch_size: int = whole(least=1)
    window: int | None = whole(None, least=1, null=MODELS_OWN)
    hindsight: float | None = real(0.0, least=0, most=1, null="half, where goals can be exchanged")
    future: bool = flag(False)
    demos: str | tuple[str, ...] | None = value(None, fits=_is_names, wanted=_A_FOLDER, null="none")
    demo_share: float = real(0.5, least=0, most=1)
    demo_share_end: float | None = real(None, least=0, most=1, null="demo_share to the end")
    demo_updates: int = whole(0, least=0, most=MOST_UPDATES)
    demo_resets: float = real(0.0, least=0, most=1)
    demo_reset_updates: int = whole(0, least=0, most=MOST_UPDATES)


@dataclass(frozen=True)
class TrainerSettings:
    """How much and how fast is learned."""

    updates: int = whole(least=0, most=MOST_UPDATES)
    updates_per_batch: int = whole(least=1)
    lr: float | None = real(None, above=0, null=MODELS_OWN)
    grad_clip: float = real(20.0, above=0)
    capture: bool | None = flag(None, null="on CUDA")
    compile: bool = flag(False)
    precision: str = choice("float32", of=PRECISIONS)
    onednn: bool = flag(False)
    schedule: str | None = choice(None, of=SCHEDULES, null=MODELS_OWN)
    warmup: int | None = whole(None, least=0, unit="updates", null=MODELS_OWN)
    log_every: float = real(10.0, above=0, unit="seconds")
    checkpoint_every: float = real(120.0, above=0, unit="seconds")
    checkpoint_replay: bool | None = flag(None, null="up to 8 GB")
    standardize: bool = flag(True)


@dataclass(frozen=True)
class EvaluationSettings:
    """How the result is judged."""

    episodes: int = whole(least=2, most=10**6)
    during: tuple[str, ...] = several((), each=choice(of=POLICIES), example="[planner,policy]")
    during_episodes: int | None = whole(None, least=2, null="all")
    every: int | None = whole(None, least=1, unit="updates", null="an eighth of trainer.updates")
    at_steps: tuple[int, ...] = several((), each=whole(least=1), example="[50000,100000]")
    video_episodes: int = whole(0, least=0)
    video_size: int = whole(256, least=16, most=4096, even=True, unit="pixels")


@dataclass(frozen=True)
class ObjectiveSettings:
    """What the planner maximises."""

    name: str = choice("auto", of=("auto", "reward_value", "goal_image"))
    metric: str = choice("l2", of=("l2", "l1", "cosine"))
    summed: bool = flag(True)
    steps_weight: float = real(0.0, least=0)
    action_penalty: float = real(0.0, least=0)
    smoothness_penalty: float = real(0.0, least=0)
    policy_penalty: float = real(0.0, least=0)


@dataclass(frozen=True)
class ExportSettings:
    """What of the replay becomes a dataset."""

    kind: str = choice("none", of=("none", "lerobot"))
    out: str | None = text(None, null="in the run's folder")
    format: str = text("exact")
    workers: int = whole(2, least=1)
    repo_id: str | None = text(None, null="not published")


def _is_mapping(given: object) -> bool:
    return isinstance(given, Mapping)


def _is_size(given: object) -> bool:
    sides = given if isinstance(given, list | tuple) else [given, given]
    return len(sides) == 2 and all(is_whole(side) and side >= 1 for side in sides)


@dataclass(frozen=True)
class DatasetSettings:
    """Recorded episodes to learn from; ``options`` are :func:`franka_wm.data.lerobot.open_dataset`'s."""

    kind: str = choice(of=("none", "lerobot"))
    root: str | tuple[str, ...] | None = value(None, fits=_is_names, wanted=_A_FOLDER, null="repo_id instead")
    repo_id: str | tuple[str, ...] | None = value(None, fits=_is_names, wanted=_A_NAME, null="root instead")
    features: Mapping[str, Any] | None = value(
        None, fits=_is_mapping, wanted="{pixels: FEATURE, state: [FEATURE, …]}", null="by convention"
    )
    image_size: int | tuple[int, ...] | None = value(
        None, fits=_is_size, wanted="a whole number of pixels or [height,width]", null="as recorded"
    )
    validation_fraction: float = real(0.1, least=0, below=1)
    seed: int = whole(0, least=0)
    normalize_actions: bool | None = flag(None, null="unless this package recorded them")
    cache_dir: str | None = text(None, null="~/.cache/franka_wm/datasets")
    in_memory: bool | None = flag(None, null="where there is room")
    workers: int | None = whole(None, least=1, null="all cores")

    @property
    def options(self) -> dict[str, Any]:
        """Arguments of ``open_dataset``."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "kind"}


def no_such(group: str, name: str, known: Iterable[str]) -> str:
    """One line about a model or planner that is not there: as one chooses it, ``GROUP=NAME``, whatever named it.

    Args:
        known: Those that there are; a preset may be one of them with other settings.
    """
    there = sorted({*conf.presets(group), *known})
    if name in there:
        return f"{group}.name={name}: write {group}={name}, which sets more than a name"
    return f"{group}={name}: must be one of {', '.join(there)}{OF_ONES_OWN}"


@dataclass(frozen=True)
class _Learning:
    """The part of a model's entries that is about its training."""

    name: str = text()
    observations: tuple[str, ...] | None = several(
        None, each=text(), null="every vector", example="[pixels,state]"
    )
    window: int = whole(least=1)
    lr: float = real(above=0)
    schedule: str = choice("constant", of=SCHEDULES)
    warmup: float = real(0.0, least=0, most=1)


@dataclass(frozen=True)
class ModelSettings:
    """A family, how it is trained, and ``options`` for its constructor."""

    name: str
    observations: tuple[str, ...] | None
    window: int
    lr: float
    schedule: str
    warmup: float
    options: Mapping[str, Any]

    @classmethod
    def of(cls, values: Mapping[str, Any], prefix: str = "model") -> ModelSettings:
        """Reads one; an unknown family is a ``UserError``."""
        training = {f.name for f in fields(_Learning)}
        read_first = read(_Learning, {k: v for k, v in values.items() if k in training}, prefix)
        if read_first.name not in models.available():
            raise UserError(no_such(prefix, read_first.name, models.available()))
        options = {key: value for key, value in values.items() if key not in training}
        return cls(**vars(read_first), options=options)

    @property
    def family(self) -> type[models.WorldModel]:
        """The class."""
        return models.family(self.name)


@dataclass(frozen=True)
class _Computing:
    """The part of a planner's entries that is for the policy around it: how the model computes."""

    name: str = text()
    precision: str = choice("float32", of=PRECISIONS)
    compile: bool = flag(False)


@dataclass(frozen=True)
class PlannerSettings:
    """A planner, how the model computes while it plans, and ``options`` for its constructor."""

    name: str
    precision: str
    compile: bool
    options: Mapping[str, Any]

    @property
    def label(self) -> str:
        """What a result says it was planned by: of a tree search, which one."""
        return str(self.options.get("variant", self.name))

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> PlannerSettings:
        """Reads one; the planner's own options are checked where it is built."""
        policy = {f.name for f in fields(_Computing)}
        read_first = read(_Computing, {k: v for k, v in values.items() if k in policy}, "planner")
        options = {key: value for key, value in values.items() if key not in policy}
        return cls(**vars(read_first), options=options)


def _merged(values: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """``values`` with ``changes``, mappings in them likewise."""
    groups = {
        k for k, new in changes.items() if isinstance(new, Mapping) and isinstance(values.get(k), Mapping)
    }
    return {**values, **{k: _merged(values[k], new) if k in groups else new for k, new in changes.items()}}


@dataclass(frozen=True)
class EnvSettings:
    """The environment: ``franka`` or ``multitask`` with its config, another library's with its own, or ``none``."""

    kind: str
    config: FrankaConfig | MultiTaskConfig | ExternalConfig | None
    urdf_path: str | None = None
    frame_stack: int = 1
    values: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> EnvSettings:
        """Reads one; what is wrong is said by the config that it makes."""
        kind = values.get("kind")
        if kind == "franka":
            own = {k: v for k, v in values.items() if k not in ("kind", "urdf_path")}
            whole_rule(least=1).check("env.frame_stack", own.get("frame_stack", 1))
            config = FrankaConfig.from_mapping(own)
            return cls(kind, config, values.get("urdf_path"), config.frame_stack, values)
        if kind == "none":
            frames = values.get("frame_stack", 1)
            whole_rule(least=1).check("env.frame_stack", frames)
            return cls(kind, None, None, frames, values)
        if kind == "multitask":
            return cls(kind, multi_task_config(values), values=values)
        return cls(str(kind), external_config(values), values=values)

    def changed(self, **changes: Any) -> EnvSettings:
        """The same with other values of its fields, where there are several tasks in each of them.

        Of a mapping, such as ``randomization``, what is not named stays: as an override of Hydra's changes it.
        """
        if changes and isinstance(self.config, MultiTaskConfig):
            changes = {"tasks": {name: _merged(one, changes) for name, one in self.values["tasks"].items()}}
        return EnvSettings.of(_merged(self.values, changes)) if changes else self

    @property
    def arm(self) -> FrankaConfig:
        """The arm's config, where the environment is the arm."""
        assert isinstance(self.config, FrankaConfig), self.kind
        return self.config

    @property
    def episode_length(self) -> int:
        """Steps, at most; 0 without an environment."""
        return 0 if self.config is None else self.config.episode_length

    @property
    def shortest_episode(self) -> int:
        """Steps, at most, of the task with the shortest episodes; 0 without an environment."""
        if isinstance(self.config, MultiTaskConfig):
            return min(one.episode_length for one in self.config.tasks.values())
        return self.episode_length

    @property
    def marks_overflow(self) -> bool:
        """Whether a step says that contacts were lost in it: some task has a scene."""
        tasks = self.config.tasks.values() if isinstance(self.config, MultiTaskConfig) else [self.config]
        return any(isinstance(one, FrankaConfig) and one.resolved_scene is not None for one in tasks)

    @property
    def label(self) -> str:
        """The arm's task, or the name of another library's environment, of the suite's with its task."""
        if isinstance(self.config, FrankaConfig):
            return self.config.task
        return self.config.label if isinstance(self.config, ExternalConfig) else self.kind


@dataclass(frozen=True)
class PretrainSettings:
    """A first stage."""

    kind: str = choice("none", of=("none", "encoder"))
    model: Mapping[str, Any] | None = value(None, fits=_is_mapping, wanted="a model's options", null="none")
    updates: int = whole(0, least=0)


@dataclass(frozen=True)
class LoggerSettings:
    """Loggers by name, and options for each."""

    names: tuple[str, ...]
    options: Mapping[str, Mapping[str, Any]]
