"""All settings of a run, read once, and what follows from several of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal

from omegaconf import DictConfig, OmegaConf

from franka_wm.conf import refuse_unknown
from franka_wm.console import say
from franka_wm.envs.multitask_config import MultiTaskConfig
from franka_wm.errors import UserError
from franka_wm.options import is_whole, read, unknown
from franka_wm.policies.names import POLICIES, refuse_old_name
from franka_wm.training.settings.groups import (
    CollectorSettings,
    DatasetSettings,
    EnvSettings,
    EvaluationSettings,
    ExportSettings,
    LoggerSettings,
    ModelSettings,
    ObjectiveSettings,
    PlannerSettings,
    PretrainSettings,
    ReplaySettings,
    TrainerSettings,
    no_such,
)


def plain(cfg: DictConfig | Mapping[str, Any]) -> dict[str, Any]:
    """A configuration, or a part of one, as plain values; ``${…}`` are resolved."""
    values: Any = OmegaConf.to_container(cfg, resolve=True) if isinstance(cfg, DictConfig) else cfg
    return dict(values)


GROUPS = {
    "collector": CollectorSettings,
    "replay": ReplaySettings,
    "trainer": TrainerSettings,
    "evaluation": EvaluationSettings,
    "objective": ObjectiveSettings,
    "export": ExportSettings,
    "dataset": DatasetSettings,
    "pretrain": PretrainSettings,
}


@dataclass(frozen=True)
class RunSettings:
    """All of a run.

    Attributes:
        values: What ``config.yaml`` of the run's folder and of its checkpoints holds; plain.
        seed: All random numbers come from it.
        device: ``auto``, ``cpu``, ``cuda``, ``cuda:K``.
        resume: The run or the checkpoint that it goes on from.
        gpus: How many processes learn together, one for each GPU. In each of them worlds, batch and capacity are its
            part of what ``values`` holds for all.
        parts: Number of processes that share the run, where these are one's; 1: they are of all together.
    """

    values: Mapping[str, Any]
    seed: int
    device: str
    resume: str | None
    gpus: int
    env: EnvSettings
    model: ModelSettings
    planner: PlannerSettings
    objective: ObjectiveSettings
    collector: CollectorSettings
    replay: ReplaySettings
    trainer: TrainerSettings
    evaluation: EvaluationSettings
    logger: LoggerSettings
    dataset: DatasetSettings
    export: ExportSettings
    pretrain: PretrainSettings
    parts: int = 1

    @classmethod
    def of(cls, cfg: DictConfig | Mapping[str, Any], *, saved: bool = False) -> RunSettings:
        """Reads a configuration: what this process has of it, where several learn together.

        Args:
            cfg: Hydra's, or what a checkpoint holds.
            saved: It is a checkpoint's: options that no longer exist are said and left out, not refused.

        Raises:
            UserError: One line that names the option and what is allowed.
        """
        settings = cls.whole(cfg, saved=saved)
        shared = settings._shared(settings.gpus)  # refused here, wherever the run will be
        from franka_wm import processes  # here: it imports torch

        if processes.count() == 1:
            return settings
        return shared if shared.device == "cpu" else replace(shared, device=str(processes.own_gpu()))

    @classmethod
    def whole(cls, cfg: DictConfig | Mapping[str, Any], *, saved: bool = False) -> RunSettings:
        """Reads a configuration as that of all processes together; see :meth:`of`.

        The environment's comes last: the arm's imports torch and the simulator.
        """
        values = plain(cfg)
        missing = [name for name in ("seed", "device", "env", "model", "planner") if name not in values]
        if missing:
            raise UserError(f"the configuration has no {missing[0]}; it is not one of a run of this package")
        if not saved:
            refuse_unknown(values)
        for name in (*GROUPS, "env", "model", "planner", "logger"):
            if not isinstance(values.get(name, {}), Mapping):
                raise UserError(f"{name}={values[name]!r}: must be a group of options")
        refuse_old_name("collector.policy", values.get("collector", {}).get("policy"))
        for name in _listed(values.get("evaluation", {}).get("during")):
            refuse_old_name("evaluation.during", name)
        groups = {}
        for name, group in GROUPS.items():
            given = values.get(name, {})  # checkpoints of earlier versions lack some
            if saved:
                given = values[name] = _without_unknown(given, group, name)
            groups[name] = read(group, given, name)
        if not is_whole(values["seed"]) or values["seed"] < 0:
            raise UserError(f"seed={values['seed']!r}: must be a whole number of at least 0 and below 2**63")
        loggers = dict(values.get("logger", {}))
        names = loggers.pop("names", ())
        if not isinstance(names, list | tuple):
            raise UserError(f"logger.names={names!r}: must be a list such as [csv,tensorboard]")
        gpus = values.get("gpus", 1)  # earlier versions had one
        if not is_whole(gpus) or gpus < 1:
            raise UserError(f"gpus={gpus!r}: must be a whole number of at least 1")
        return cls(
            values=values,
            seed=values["seed"],
            device=values["device"],
            resume=values.get("resume"),
            gpus=gpus,
            model=ModelSettings.of(values["model"]),
            planner=PlannerSettings.of(values["planner"]),
            logger=LoggerSettings(tuple(names), loggers),
            env=EnvSettings.of(values["env"]),
            **groups,
        )

    def changed(self, **changes: Any) -> RunSettings:
        """The same with other values: ``changed(seed=3, model={"encoder_from": …})``; groups are merged."""
        merged = {
            name: {**self.values[name], **change} if isinstance(change, Mapping) else change
            for name, change in changes.items()
        }
        return self._read_again({**self.values, **merged})

    def first_stage(self) -> RunSettings:
        """The run that pretrains the encoder; its checkpoints resume the whole run, not the stage alone."""
        return self._read_again(
            {
                **self.values,
                "whole_run": self.values,
                "model": self.pretrain.model,
                "trainer": {**self.values["trainer"], "updates": self.pretrain.updates},
                # For the goals, and the policy, of the second stage.
                "replay": {**self.values["replay"], "future": False, "demo_updates": 0},
                "collector": {**self.values["collector"], "seed_updates": 0},
                "export": {**self.values["export"], "kind": "none"},
            }
        )

    def _read_again(self, values: Mapping[str, Any]) -> RunSettings:
        """Other values, of as many processes as these are one's."""
        found = RunSettings.of(values, saved=True)
        return found if found.parts == self.parts else found._shared(self.parts)

    def of_one_gpu(self) -> RunSettings:
        """What one of its processes has: what must fit into its GPU. On the CPU all have one memory."""
        return self._shared(self.gpus) if self.parts == 1 and self.device != "cpu" else self

    @property
    def on_each(self) -> str:
        """Says in a message that its number is one process's, where what it names is of all."""
        return f" on each of {self.parts} {self._parts_are}" if self.parts > 1 else ""

    @property
    def _parts_are(self) -> str:
        return "processes" if self.device == "cpu" else "GPUs"

    def _shared(self, parts: int) -> RunSettings:
        """What one of so many processes has of the whole run."""
        c, r, what = self.collector, self.replay, self._parts_are
        divided = {"collector.num_envs": c.num_envs, "replay.batch_size": r.batch_size}
        divided |= {"collector.planner_worlds": c.planner_worlds, "collector.workers": c.workers}
        for name, value in divided.items():
            if value % parts:
                raise UserError(f"{name}={value}: {parts} {what} cannot share it; use a multiple of {parts}")
        if parts > 1 and isinstance(self.env.config, MultiTaskConfig) and not self.is_offline:
            tasks = len(self.env.config.tasks)
            if c.num_envs % (parts * tasks):
                raise UserError(
                    f"collector.num_envs={c.num_envs}: on each of {parts} {what} as many worlds must have each of the "
                    f"{tasks} tasks; use a multiple of {parts * tasks}"
                )
        return replace(
            self,
            collector=replace(
                c,
                num_envs=c.num_envs // parts,
                planner_worlds=c.planner_worlds // parts,
                workers=c.workers // parts,
            ),
            replay=replace(r, batch_size=r.batch_size // parts, capacity=r.capacity // parts),
            parts=parts,
        )

    # -- what follows from several options ------------------------------------------------------------------

    @property
    def is_arm(self) -> bool:
        """Whether the environment is the arm, not one of another library."""
        return self.env.kind == "franka"

    @property
    def is_offline(self) -> bool:
        """Whether experience comes from recorded data."""
        return self.dataset.kind != "none"

    @property
    def is_discrete(self) -> bool:
        """Whether the model chooses among discrete actions."""
        return self.model.family.discrete

    @property
    def of_recorded(self) -> dict[str, Any]:
        """What the model, and the arm that it is to act in, ask of recorded data: arguments of ``read_datasets``."""
        family, arm = self.model.family, self.env.arm if self.is_arm else None
        rewarded = family.has_value or self.model.options.get("reward_head")
        return {
            "keys": self.model.observations,
            "rewards_for": f"model={self.model.name}" if rewarded else None,
            "fps": arm and arm.fps,
            "action_dim": arm and arm.action_dim,
        }

    @property
    def crosses_episodes(self) -> bool:
        """Whether the model's loss takes windows that go on past the end of an episode."""
        return self.model.family.cross_episode

    @property
    def window(self) -> int:
        """Transitions of a training window."""
        return self.model.window if self.replay.window is None else self.replay.window

    @property
    def burn_in(self) -> int:
        """Steps in front of a training window, from which a memory begins."""
        return self.model.options.get("burn_in", 0)

    def demo_windows(self, update: int) -> int:
        """How many windows of this process's batch are demonstrations at this update: its part of the job's."""
        r, total = self.replay, self.trainer.updates
        if r.demos is None:
            return 0
        if update < r.demo_updates:
            return r.batch_size
        end = r.demo_share if r.demo_share_end is None else r.demo_share_end
        share = r.demo_share + (end - r.demo_share) * min(1.0, update / max(1, total))
        whole = round(self.parts * r.batch_size * share)
        if self.parts == 1:
            return whole
        from franka_wm import processes  # here: it imports torch

        return processes.own_part(whole)[1]

    def demo_starts_from(self, update: int) -> float:
        """From which part of demonstrations on episodes begin at this update: the end at first, then all of them."""
        over = self.replay.demo_reset_updates
        return max(0.0, 1.0 - update / over) if over else 0.0

    @property
    def learning_rate(self) -> float:
        """The trainer's, or the model's own."""
        return self.model.lr if self.trainer.lr is None else self.trainer.lr

    @property
    def schedule(self) -> str:
        """The trainer's, or the model's own."""
        return self.model.schedule if self.trainer.schedule is None else self.trainer.schedule

    @property
    def warmup(self) -> int:
        """Updates over which the learning rate rises."""
        return (
            round(self.model.warmup * self.trainer.updates)
            if self.trainer.warmup is None
            else self.trainer.warmup
        )

    @property
    def evaluation_period(self) -> int:
        """Updates between evaluations while training: ``evaluation.every``, or an eighth of the run."""
        every = self.evaluation.every
        return max(1, -(-self.trainer.updates // 8)) if every is None else every

    @property
    def learner_options(self) -> dict[str, Any]:
        """Arguments of the learner."""
        names = ("grad_clip", "capture", "compile", "precision")
        return {name: getattr(self.trainer, name) for name in names} | {
            "lr": self.learning_rate,
            "total_updates": self.trainer.updates,
            "schedule": self.schedule,
            "warmup": self.warmup,
        }

    @property
    def objective_name(self) -> Literal["reward_value", "goal_image"] | None:
        """What the planner maximises; ``None`` for a family that does not plan by an objective."""
        name: Any = self.objective.name
        if name != "auto":
            return name
        family = self.model.family
        if family.discrete or not family.has_next:
            return None
        return "reward_value" if family.has_value or not family.has_goal else "goal_image"

    @property
    def told_beside_image(self) -> list[str]:
        """What tells a model that plans to goal images where the goal is without them."""
        if self.objective_name != "goal_image" or not self.is_arm or self.env.arm.fixed_goal:
            return []
        read = [
            f"{key} in model.observations"
            for key in ("state", "goal")
            if key in (self.model.observations or ())
        ]
        return read + ["env.show_goal=true"] * self.env.arm.show_goal

    @cached_property
    def actor(self) -> str:
        """The name of the policy that gathers experience, by ``collector.policy``.

        Raises:
            UserError: The model's family does not have it.
        """
        policy, family = self.collector.policy, self.model.family
        towards_goals = bool(family.has_goal_policy and self.model.options.get("goal_policy_coef"))
        there = {"planner": family.has_next, "policy": family.has_policy or towards_goals}
        searched = bool(family.replay_keys)  # the loss needs what the search found
        if policy == "auto":
            if searched:
                return "planner"
            if family.has_policy:
                return "policy"
            # A planner without a policy's candidates takes far longer to decide than the worlds to step, and a model
            # that is given goals by their images can learn from any motion.
            return "planner" if self.objective_name == "reward_value" else "random"
        if not there.get(policy, True) or (searched and policy != "planner"):
            fitting = ["planner"] if searched else [one for one in POLICIES if there.get(one, True)]
            why = "cannot plan" if policy == "planner" else "has no policy"
            why = "learns from its own search" if searched else why
            more = ", or model.goal_policy_coef above 0" * (policy == "policy" and family.has_goal_policy)
            raise UserError(
                f"collector.policy={policy}: model={self.model.name} {why}; "
                f"must be one of {', '.join(['auto', *fitting])}{more}"
            )
        return policy

    def check_planner_fits(self) -> None:
        """Whether the planner is one for the actions of the model.

        Raises:
            UserError: It is for the other kind, or no planner has this name.
        """
        from franka_wm.planning import registry  # here: it imports torch

        name, discrete = self.planner.name, self.is_discrete
        if name not in registry.available():
            raise UserError(no_such("planner", name, registry.available()))
        if registry.is_search(name) == discrete:
            return
        fitting = [one for one in registry.available() if registry.is_search(one) == discrete]
        fitting += ["gumbel"] if discrete else []  # mcts with other settings: a name in conf/planner alone
        typed = "gumbel" if self.planner.options.get("variant") == "gumbel" else name
        raise UserError(
            f"planner={typed}: model={self.model.name} has {'discrete' if discrete else 'continuous'} actions; "
            f"use planner={' or '.join(fitting)}"
        )

    @property
    def updates_alone(self) -> int:
        """So many updates at the start see the first steps, or demonstrations, and nothing is gathered meanwhile."""
        return max(self.collector.seed_updates, 0 if self.replay.demos is None else self.replay.demo_updates)

    def planned_steps(self, updates: int = 0) -> int:
        """Steps that each world will make until the end of the run, at most, after so many ``updates``."""
        c, t = self.collector, self.trainer
        first = max(updates, self.updates_alone)  # from here on each batch of updates follows one of steps
        batches = math.ceil(t.updates / t.updates_per_batch) - math.ceil(first / t.updates_per_batch)
        return c.seed_steps + (max(batches, 0) + (updates < first)) * c.steps_per_batch


def _listed(names: Any) -> Any:
    return names if isinstance(names, list | tuple) else [names]


def _without_unknown(values: Mapping[str, Any], group: type, name: str) -> dict[str, Any]:
    known = {f.name for f in fields(group)}
    for gone in sorted(set(values) - known):
        say(f"{unknown(f'{name}.{gone}', sorted(known)).split(';')[0]} any more: it is left out")
    return {key: value for key, value in values.items() if key in known}
