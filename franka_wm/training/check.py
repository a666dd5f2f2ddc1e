"""What can be refused before anything is built or written: one line each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from omegaconf import DictConfig, ListConfig

from franka_wm import models
from franka_wm.device import resolve_device
from franka_wm.envs import FrankaConfig
from franka_wm.envs.franka import check_robot
from franka_wm.errors import UserError
from franka_wm.policies.names import POLICIES, refuse_old_name
from franka_wm.training import build
from franka_wm.training.learner import PRECISIONS, SCHEDULES
from franka_wm.training.loggers import check_loggers
from franka_wm.training.room import planned_steps
from franka_wm.training.spaces import Spaces

METRICS = ("l2", "l1", "cosine")


def check(cfg: DictConfig) -> None:
    """What can be refused before anything is built."""
    resolve_device(cfg.device)
    window = build.window(cfg)
    during = cfg.evaluation.get("during_episodes")  # checkpoints of earlier versions have none
    numbers: Mapping[str, tuple[Any, float]] = {
        "collector.num_envs": (cfg.collector.num_envs, 1),
        "collector.steps_per_batch": (cfg.collector.steps_per_batch, 1),
        "collector.seed_steps": (cfg.collector.seed_steps, 1),
        "replay.capacity": (cfg.replay.capacity, 1),
        "replay.batch_size": (cfg.replay.batch_size, 1),
        "replay.window": (window, 1),
        "trainer.updates": (cfg.trainer.updates, 0),
        "trainer.updates_per_batch": (cfg.trainer.updates_per_batch, 1),
        "trainer.warmup": (build.schedule(cfg)[1], 0),
        "evaluation.episodes": (cfg.evaluation.episodes, 2),
        **({"evaluation.during_episodes": (during, 2)} if during is not None else {}),
        "evaluation.video_episodes": (cfg.evaluation.video_episodes, 0),
        "evaluation.video_size": (cfg.evaluation.video_size, 16),
    }
    for name, (value, least) in numbers.items():
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise UserError(f"{name}={value!r}: must be a whole number of at least {least}")
    build.check_exploration(cfg)
    build.hindsight_share(cfg)
    if cfg.evaluation.video_size % 2:
        raise UserError(
            f"evaluation.video_size={cfg.evaluation.video_size}: must be even, video codecs want it"
        )
    if cfg.collector.get("calmest", 1.0) != 1.0:  # of a run of before it was taken out
        raise UserError(
            f"collector.calmest={cfg.collector.calmest!r}: this option is gone; start the run anew without it"
        )
    models.family(cfg.model.name).validate(build.plain(cfg.model), window=window)
    if not build.is_offline(cfg):
        build.actor(cfg)
    short = cfg.env.kind != "none" and cfg.env.episode_length < window
    if short and not build.crosses_episodes(cfg):
        raise UserError(
            f"env.episode_length={cfg.env.episode_length} is shorter than replay.window={window}; "
            "no window would fit into an episode"
        )
    for name, value in (("seed", cfg.seed),):
        if isinstance(value, bool) or not isinstance(value, int):
            raise UserError(f"{name}={value!r}: must be a whole number")
    for name, value in (
        ("trainer.lr", build.learning_rate(cfg)),
        ("trainer.grad_clip", cfg.trainer.grad_clip),
    ):
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
            raise UserError(f"{name}={value!r}: must be above 0")
    if cfg.trainer.checkpoint_replay not in (None, True, False):
        raise UserError(
            f"trainer.checkpoint_replay={cfg.trainer.checkpoint_replay!r}: must be true, false, or null (up to 8 GB)"
        )
    for name, value in (
        ("trainer.log_every", cfg.trainer.log_every),
        ("trainer.checkpoint_every", cfg.trainer.checkpoint_every),
    ):
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
            raise UserError(f"{name}={value!r}: must be a number of seconds above 0")
    every = cfg.evaluation.every
    if every is not None and (isinstance(every, bool) or not isinstance(every, int) or every < 1):
        raise UserError(
            f"evaluation.every={every!r}: must be a whole number of updates of at least 1 (it no longer counts "
            "seconds), or null: an eighth of trainer.updates"
        )
    _check_at_steps(cfg)
    if not 0 <= cfg.collector.smoothness < 1:
        raise UserError(f"collector.smoothness={cfg.collector.smoothness}: must be at least 0 and below 1")
    before = build.frame_stack(cfg) - 1  # steps whose pictures a window's first stack needs
    asked = f"windows have {window} steps" + (
        f", and {before} before them for env.frame_stack" if before else ""
    )
    if cfg.replay.capacity < (steps := cfg.collector.num_envs * (window + before + 1)):
        raise UserError(
            f"replay.capacity={cfg.replay.capacity}: must be at least {steps} for collector.num_envs="
            f"{cfg.collector.num_envs}: {asked}, and one more must fit"
        )
    c = cfg.collector
    first = (-(-c.seed_steps // c.steps_per_batch) + 1) * c.steps_per_batch
    if first < window + before and not build.is_offline(cfg):
        raise UserError(
            f"collector.seed_steps={c.seed_steps}: before the first update each world will have made {first} steps; "
            f"{asked}: use at least collector.seed_steps={window + before}"
        )
    if cfg.replay.capacity < cfg.collector.num_envs * cfg.collector.steps_per_batch:
        raise UserError(f"replay.capacity={cfg.replay.capacity}: smaller than one batch of the collector")
    for name in cfg.evaluation.during:
        refuse_old_name("evaluation.during", name)
    _check_names("evaluation.during", cfg.evaluation.during, POLICIES)
    chosen = {
        "precision": (cfg.trainer.precision, PRECISIONS),
        "schedule": (build.schedule(cfg)[0], SCHEDULES),
    }
    for name, (value, known) in chosen.items():
        if value not in known:
            raise UserError(f"trainer.{name}={value!r}: must be one of {', '.join(known)}")
    options = build.plain(cfg.logger)
    check_loggers(options.pop("names"), **options)
    _check_export(cfg)
    if build.is_offline(cfg):
        _check_dataset(cfg)
    elif cfg.env.kind == "none":
        raise UserError(
            "env=none: without an environment there must be data; use dataset=lerobot dataset.root=…"
        )
    check_pretrain(cfg)
    if cfg.objective.metric not in METRICS:
        raise UserError(f"objective.metric={cfg.objective.metric!r}: must be one of {', '.join(METRICS)}")
    spaces = _spaces(cfg)
    if spaces is not None:
        model = build.make_model(cfg, spaces, "cpu")
        if build.objective_name(cfg) == "goal_image":
            goals = build.goal_pictures(model.image_sizes).values()
            if not goals or any(goal not in spaces.image_sizes for goal in goals):
                raise UserError(
                    "planning to a goal image needs goal_pixels among env.observations="
                    f"{list(cfg.env.observations)}, and a model that reads pixels, not {model.observation_keys}; "
                    "use env=reach_goal_image or reach_fixed_goal_image"
                )
        build.make_objective(cfg, model)
        if model.has_next:
            build.make_planner(cfg, spaces.num_actions or spaces.action_dim)


def _spaces(cfg: DictConfig) -> Spaces | None:
    """What the model will be built for; ``None`` where only the environment or the dataset itself can tell."""
    if not build.is_arm(cfg):
        values = build.plain(cfg.env)
        if values["kind"] != "none":
            from franka_wm.envs.external import check_external, external_config

            check_external(external_config(values))
        return None
    values = build.plain(cfg.env)
    del values["kind"]
    urdf_path = values.pop("urdf_path")
    config = FrankaConfig.from_mapping(values)
    check_robot(config, urdf_path)
    return None if build.is_offline(cfg) else Spaces.of_config(config, discrete=build.is_discrete(cfg))


def _check_export(cfg: DictConfig) -> None:
    if cfg.export.kind == "none":
        return
    from franka_wm.data.lerobot.export import check_export

    if not build.is_arm(cfg) or build.is_offline(cfg):
        raise UserError("export: only what a run gathers with the arm can be exported")
    check_export(build.plain(cfg))
    steps = min(planned_steps(cfg), cfg.replay.capacity // cfg.collector.num_envs)
    if steps < cfg.env.episode_length and not cfg.env.terminate_on_success:
        raise UserError(
            f"export: each world will have gathered {steps} steps, no whole episode of {cfg.env.episode_length}; "
            "raise collector.seed_steps or trainer.updates, or lower env.episode_length"
        )


def _check_dataset(cfg: DictConfig) -> None:
    if build.is_discrete(cfg):
        raise UserError(
            f"dataset={cfg.dataset.kind}: model={cfg.model.name} learns from its own search, not from recordings"
        )
    if cfg.dataset.kind != "lerobot":
        raise UserError(f"dataset.kind={cfg.dataset.kind!r}: must be none or lerobot")
    if (cfg.dataset.root is None) == (cfg.dataset.repo_id is None):
        raise UserError("dataset=lerobot: give dataset.root=FOLDER or dataset.repo_id=USER/NAME, one of them")
    if cfg.dataset.root is not None:
        from franka_wm.data.lerobot.source import read_source

        roots = [cfg.dataset.root] if isinstance(cfg.dataset.root, str) else list(cfg.dataset.root)
        for root in roots:
            read_source(root)


def _check_at_steps(cfg: DictConfig) -> None:
    at_steps = cfg.evaluation.get("at_steps", [])  # checkpoints of earlier versions have none
    whole = isinstance(at_steps, (list, ListConfig)) and all(
        isinstance(steps, int) and not isinstance(steps, bool) and steps > 0 for steps in at_steps
    )
    if not whole:
        raise UserError(
            f"evaluation.at_steps={at_steps}: must be a list of whole numbers above 0, such as [50000,100000]"
        )
    if len(at_steps) and not cfg.evaluation.during:
        raise UserError(
            f"evaluation.at_steps={at_steps}: nothing is evaluated while training; name policies, such as "
            "evaluation.during=[planner]"
        )
    if len(at_steps) and build.is_offline(cfg):
        raise UserError(
            "evaluation.at_steps counts environment steps, and a run on recorded data makes none; "
            "use evaluation.every=UPDATES"
        )


def _check_names(option: str, names: Any, known: Sequence[str]) -> None:
    unknown = [name for name in names if name not in known]
    if unknown:
        raise UserError(f"{option}: no {unknown[0]!r}; choose from {', '.join(known)}")


def check_pretrain(cfg: Any) -> None:
    """What can be refused before a run.

    Raises:
        UserError: The model takes no pretrained encoder.
    """
    if cfg.pretrain.kind == "none":
        return
    if cfg.pretrain.kind != "encoder":
        raise UserError(f"pretrain.kind={cfg.pretrain.kind!r}: must be none or encoder")
    if "encoder_from" not in cfg.model:
        raise UserError(
            f"pretrain: model={cfg.model.name} takes no pretrained encoder; use action_world_model or tdmpc2_pixels"
        )
