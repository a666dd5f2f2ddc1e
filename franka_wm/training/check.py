"""What can be refused before anything is built or written: one line each. Types and ranges: the settings themselves."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields

import torch

from franka_wm import models
from franka_wm.console import say
from franka_wm.device import missing_to_compile, resolve_device
from franka_wm.envs.external import check_external
from franka_wm.envs.external_config import ExternalConfig
from franka_wm.envs.external_ray import import_ray
from franka_wm.envs.multitask_config import MultiTaskConfig
from franka_wm.envs.start import check_robot
from franka_wm.errors import UserError
from franka_wm.models import WorldModel
from franka_wm.models.vision import ViT
from franka_wm.planning import registry
from franka_wm.planning.objectives import goal_images
from franka_wm.training import build
from franka_wm.training.check_dataset import check_dataset
from franka_wm.training.demos import check_demonstrations
from franka_wm.training.loggers import check_loggers
from franka_wm.training.settings import RunSettings
from franka_wm.training.settings.groups import ObjectiveSettings, no_such
from franka_wm.training.spaces import Spaces
from franka_wm.training.storage_budget import check_memory
from franka_wm.training.unread import say_unread, say_unseen_goal


def check(run: RunSettings) -> None:
    """What the settings ask for together, and what this machine has.

    Raises:
        UserError: One line.
    """
    device = resolve_device(run.device)
    for option, asked in (("trainer.compile", run.trainer.compile), ("planner.compile", run.planner.compile)):
        if asked and (missing := missing_to_compile(device)) is not None:
            raise UserError(
                f"{option}=true: torch.compile needs {missing}, which is not here; install it, or {option}=false"
            )
    check_loggers(run.logger.names, **run.logger.options)
    _check_windows(run)
    _check_evaluation(run)
    _check_planner(run)
    if (c := run.collector).planner_worlds > c.num_envs:
        raise UserError(
            f"collector.planner_worlds={c.planner_worlds * run.parts}: must be a whole number of at most "
            f"collector.num_envs={c.num_envs * run.parts}; 0 leaves all worlds to the policy"
        )
    _check_workers(run)
    if run.is_offline:
        check_dataset(run)
    elif run.env.kind == "none":
        raise UserError(
            "env=none: without an environment there must be data; use dataset=lerobot dataset.root=…"
        )
    elif run.actor != "policy":  # no error: files of tuned values set them
        for option, value in {"planner_worlds": c.planner_worlds * run.parts, "noise": c.noise}.items():
            if value:
                say(
                    f"collector.{option}={value:g}: is for collector.policy=policy and does nothing here, where the "
                    f"worlds act by {run.actor}"
                )
    if run.model.options.get("standardize_images") and not run.trainer.standardize:
        say("model.standardize_images=true: does nothing with trainer.standardize=false")
    _check_stored_state(run)
    _check_hindsight(run)
    _check_future(run)
    _check_objective(run)
    _check_demonstrations(run)
    _check_export(run)
    if run.pretrain.kind != "none" and "encoder_from" not in run.model.options:
        raise UserError(
            f"pretrain: model={run.model.name} takes no pretrained encoder; use action_world_model, dino_wm or "
            "tdmpc2_pixels"
        )
    given = (run.model.options.get(key) for key in ("encoder_from", "huggingface"))
    if run.model.family.pretrained and run.pretrain.kind == "none" and not any(given):
        raise UserError(
            f"model={run.model.name} needs a pretrained encoder: model.huggingface=facebook/dinov2-small, "
            "model.encoder_from=RUN, or pretrain=lejepa"
        )
    if run.pretrain.kind != "none":
        _check_first_stage(run)
    _check_parts(run)


def _check_workers(run: RunSettings) -> None:
    """Whether processes, or Ray's actors, can share the worlds."""
    workers, worlds, ray = run.collector.workers, run.collector.num_envs, run.collector.ray
    if (workers or ray) and not isinstance(run.env.config, ExternalConfig):
        given = "collector=ray" if ray else f"collector.workers={workers}"
        raise UserError(
            f"{given}: is for env=gym and env=dm_control; leave it out, since the arm's worlds are one simulator"
        )
    whole = worlds * run.parts
    if ray and not workers:
        raise UserError(
            f"collector=ray: say how many actors share the worlds: collector.workers=N, which divides "
            f"collector.num_envs={whole}; the cluster's cores, or fewer"
        )
    if workers and worlds % workers:
        raise UserError(
            f"collector.workers={workers * run.parts}: cannot share collector.num_envs={whole} worlds equally; use a "
            "number that divides them"
        )
    if ray:
        import_ray()


def _check_windows(run: RunSettings) -> None:
    """Whether windows fit into episodes, into the replay, and into what is gathered before the first update."""
    run.model.family.validate(run.model.options, window=run.window)
    shortest = run.env.shortest_episode
    if run.env.kind != "none" and shortest < run.window and not run.crosses_episodes:
        whose = "the shortest env.tasks.NAME" if run.env.kind == "multitask" else "env"
        raise UserError(
            f"{whose}.episode_length={shortest} is shorter than replay.window={run.window}; "
            f"no window would fit into an episode: use replay.window={shortest} or less"
        )
    before = run.env.frame_stack - 1  # steps whose images a window's first stack needs
    asked_for = f"windows have {run.window} steps" + (
        f", and {before} before them for env.frame_stack" if before else ""
    )
    c, capacity = run.collector, run.replay.capacity
    typed = f"replay.capacity={run.values['replay']['capacity']}"  # of all processes, as all numbers that are named
    if capacity < (steps := c.num_envs * (run.window + before + 1)):
        raise UserError(
            f"{typed}: must be at least {steps * run.parts} for collector.num_envs="
            f"{c.num_envs * run.parts}: {asked_for}, and one more must fit"
        )
    first = (-(-c.seed_steps // c.steps_per_batch) + 1) * c.steps_per_batch
    if first < run.window + before and not run.is_offline:
        raise UserError(
            f"collector.seed_steps={c.seed_steps}: before the first update each world will have made {first} steps; "
            f"{asked_for}: use at least collector.seed_steps={run.window + before}"
        )
    if capacity < c.num_envs * c.steps_per_batch:
        raise UserError(f"{typed}: smaller than one batch of the collector")
    if c.seed_updates > run.trainer.updates:
        raise UserError(
            f"collector.seed_updates={c.seed_updates}: must be at most trainer.updates={run.trainer.updates}"
        )


def _check_stored_state(run: RunSettings) -> None:
    if run.model.options.get("stored_state"):
        without = {"recorded data": run.is_offline, "demonstrations": run.replay.demos is not None}
        if not run.is_offline:
            without |= {f"steps of collector.policy={run.actor}": run.actor not in ("policy", "planner")}
        if found := [what for what, used in without.items() if used]:
            raise UserError(
                f"model.stored_state=true: {found[0]} have no memory to keep; use stored_state=false"
            )


def _check_hindsight(run: RunSettings) -> None:
    if run.replay.hindsight:
        why = "recorded data keep their goals" if run.is_offline else build.no_hindsight(run)
        if why is not None:
            raise UserError(f"replay.hindsight={run.replay.hindsight}: {why}; leave it at null")


def _check_future(run: RunSettings) -> None:
    if not run.replay.future:
        return
    if not any(run.model.options.get(key) for key in ("goal_policy_coef", "goal_steps_coef")):
        raise UserError(
            f"replay.future=true: goals an episode away are for heads that model={run.model.name} does not have here; "
            "set model.goal_policy_coef or model.goal_steps_coef above 0 (lewm, action_world_model), or leave it false"
        )
    if run.replay.demos is not None:
        raise UserError(
            "replay.future=true: does not go with replay.demos; train on the datasets, dataset.root=…"
        )


def _check_objective(run: RunSettings) -> None:
    """Options without effect; a run that goes on keeps those that it began with."""
    if run.resume is not None:
        return
    model = f"model={run.model.name}"
    if run.model.options.get("reward_head") and not run.model.family.has_value:
        raise UserError(
            f"model.reward_head=true: no objective reads it, since {model} has no value; leave it at false"
        )
    if run.is_discrete and run.objective.name != "auto":
        raise UserError(
            f"objective={run.objective.name}: {model} plans without an objective; leave it at auto"
        )
    for option, why in idle_objective_options(run).items():
        given, default = getattr(run.objective, option), getattr(ObjectiveSettings(), option)
        if given != default:
            raise UserError(f"objective.{option}={given}: {why}; leave it at {default}")


def idle_objective_options(run: RunSettings) -> dict[str, str]:
    """Options of ``objective`` that do nothing in this run, and why."""
    if run.objective_name == "goal_image":
        return {}
    idle: dict[str, str] = dict.fromkeys(("metric", "summed", "steps_weight"), "is of objective=goal_image")
    if run.is_discrete or run.objective_name is None:
        penalties = ("action_penalty", "smoothness_penalty", "policy_penalty")
        idle |= dict.fromkeys(penalties, f"model={run.model.name} plans without an objective")
    return idle


def _check_demonstrations(run: RunSettings) -> None:
    if run.replay.demos is None:
        if run.resume is not None:  # it keeps what it began with
            return
        given = {f"replay.{f.name}": (getattr(run.replay, f.name), f.default) for f in fields(run.replay)}
        given = {name: of for name, of in given.items() if name.startswith("replay.demo_")}
        given["model.imitation_coef"] = (run.model.options.get("imitation_coef", 0.0), 0.0)
        for option, (value, default) in given.items():
            if value != default:
                raise UserError(f"{option}={value}: needs demonstrations, replay.demos=FOLDER")
        return
    if run.replay.demo_reset_updates and not run.replay.demo_resets:
        raise UserError(
            f"replay.demo_reset_updates={run.replay.demo_reset_updates}: needs replay.demo_resets above 0"
        )
    if run.is_offline:
        raise UserError(
            "replay.demos: a run on recorded data gathers nothing to mix them with; add them to dataset.root"
        )
    if run.is_discrete:
        raise UserError(
            f"replay.demos: model={run.model.name} learns from its own search, not from recordings"
        )
    if run.replay.demo_updates > run.trainer.updates:
        raise UserError(
            f"replay.demo_updates={run.replay.demo_updates}: must be at most trainer.updates={run.trainer.updates}"
        )
    check_demonstrations(run)


def _check_first_stage(run: RunSettings) -> None:
    """The model that pretrains the encoder, its windows and its memory."""
    try:
        first = run.first_stage()
        _check_windows(first)
        if first.is_arm and not first.is_offline:
            spaces = Spaces.of_config(first.env.arm, discrete=first.is_discrete)
            model = sketch(first, spaces)
            if model is not None:
                check_memory(first, model, spaces)
    except UserError as error:
        raise UserError(f"pretrain: {error}") from error


def _check_evaluation(run: RunSettings) -> None:
    at_steps = list(run.evaluation.at_steps)
    if at_steps and not run.evaluation.during:
        raise UserError(
            f"evaluation.at_steps={at_steps}: nothing is evaluated while training; name policies, such as "
            "evaluation.during=[planner]"
        )
    if at_steps and run.is_offline:
        raise UserError(
            "evaluation.at_steps counts environment steps, and a run on recorded data makes none; "
            "use evaluation.every=UPDATES"
        )


def _check_planner(run: RunSettings) -> None:
    """Its options, also where the sizes of actions are not known yet."""
    if run.planner.name not in registry.available():
        raise UserError(no_such("planner", run.planner.name, registry.available()))
    if run.model.family.has_next:
        run.check_planner_fits()
    registry.validate(run.planner.name, run.planner.options)


def _check_parts(run: RunSettings) -> None:
    """Builds what costs little, where the environment's sizes are known before it is."""
    if isinstance(run.env.config, MultiTaskConfig):
        counts = {
            "collector.num_envs": run.collector.num_envs,
            "evaluation.episodes": run.evaluation.episodes,
            "evaluation.during_episodes": run.evaluation.during_episodes,
        }
        for option, count in counts.items():
            if count is not None and count < len(run.env.config.tasks):
                raise UserError(
                    f"{option}={count}: env=multitask has {(tasks := len(run.env.config.tasks))} tasks, each needs a "
                    f"world; use at least {tasks}, or leave tasks out: '~env.tasks.NAME'"
                )
    if run.is_arm:
        check_robot(run.env.arm, run.env.urdf_path)
    spaces = known_spaces(run)
    if spaces is None:
        return
    say_unseen_goal(run)
    if run.is_offline:  # the data has the sizes; what acts in the environment needs its goals
        known = run.model.observations
        return None if known is None else _check_goal_images(run, [k for k in known if "pixels" in k], spaces)
    say_unread(run, spaces)
    run = _with_encoder(run, spaces)
    model = sketch(run, spaces) or build.make_model(run, spaces)
    _check_goal_images(run, model.image_sizes, spaces)
    build.make_objective(run, model)
    if model.has_next:
        build.make_planner(run, spaces.num_actions or spaces.action_dim)
    check_memory(run, model, spaces)


def _check_goal_images(run: RunSettings, images: Iterable[str], spaces: Spaces) -> None:
    """Whether the environment shows its goal as the model reads the world; of ``images`` the model reads."""
    goals = goal_images(images).values()
    shown = goals and all(one in spaces.image_sizes for one in goals)
    if run.objective_name == "goal_image" and not shown:
        there = [*spaces.observation_sizes, *spaces.image_sizes]
        raise UserError(
            f"planning to a goal image needs goal_pixels (here are {', '.join(there)}), and a model that reads "
            f"pixels, not {[*images]}; use env=reach_goal_image or another …_goal_image (with a dataset also env=none)"
        )


def known_spaces(run: RunSettings) -> Spaces | None:
    """Those of the environment before its worlds are built; ``None`` without one."""
    config = run.env.config
    if isinstance(config, ExternalConfig):
        sizes, action_dim, num_actions = check_external(config)
        return Spaces(sizes, {}, action_dim, num_actions, config.episode_length, None, config.kind == "gym")
    if isinstance(config, MultiTaskConfig):
        return Spaces.of_tasks(config)
    return Spaces.of_config(run.env.arm, discrete=run.is_discrete) if run.is_arm else None


def _with_encoder(run: RunSettings, spaces: Spaces) -> RunSettings:
    """The run with an encoder of the shape that its first stage will have trained."""
    first = sketch(run.first_stage(), spaces) if run.pretrain.kind != "none" else None
    if first is None or not isinstance(first.encoder, ViT):
        return run
    return run.changed(model={"encoder_architecture": list(first.encoder.numbers)})


def sketch(run: RunSettings, spaces: Spaces) -> WorldModel | None:
    """The model's shapes: its constructor refuses what it would, but no weight is allocated or drawn.

    `None` for a family of one's own, whose constructor may look at values, and for one that reads weights.
    """
    reads = any(run.model.options.get(name) is not None for name in ("encoder_from", "huggingface"))
    if reads or not run.model.family.__module__.startswith(f"{models.__name__}."):
        return None
    with torch.device("meta"):
        return build.make_model(run, spaces)


def _check_export(run: RunSettings) -> None:
    if run.export.kind == "none":
        return
    from franka_wm.data.lerobot.export import check_export

    if not run.is_arm or run.is_offline:
        raise UserError("export: only what a run gathers with the arm in one task can be exported")
    check_export(run.values)
    steps = min(run.planned_steps(), run.replay.capacity // run.collector.num_envs)
    if steps < run.env.episode_length and not run.env.arm.terminate_on_success:
        raise UserError(
            f"export: each world will have gathered {steps} steps, no whole episode of {run.env.episode_length}; "
            "raise collector.seed_steps or trainer.updates, or lower env.episode_length"
        )
