"""From settings to the parts of a run: environments, models, planners, policies, experience."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from inspect import signature
from typing import TYPE_CHECKING, Any, cast

import torch
from tensordict.nn import TensorDictModuleBase

from franka_wm import models, planning, processes
from franka_wm.console import say
from franka_wm.data.demonstrations import Demonstrations
from franka_wm.data.future import FutureFrames
from franka_wm.data.hindsight import Hindsight
from franka_wm.data.lerobot.windows import RecordedWindows
from franka_wm.data.replay import WindowReplay, make_replay
from franka_wm.device import missing_to_compile, resolve_device
from franka_wm.envs import Environment, FrankaEnv, MultiTaskEnv, TransformedFrankaEnv
from franka_wm.envs.discretize import DiscreteActions
from franka_wm.envs.external import ExternalEnv
from franka_wm.envs.external_config import ExternalConfig
from franka_wm.envs.multitask_config import MultiTaskConfig
from franka_wm.envs.tasks import make_task
from franka_wm.envs.transformed import arm_of
from franka_wm.errors import UserError, place
from franka_wm.planning import registry
from franka_wm.planning.base import Planner
from franka_wm.planning.mcts import MCTS
from franka_wm.planning.objectives import Objective, goal_images
from franka_wm.policies import ExploringPolicy, ModelPolicy, PlannerPolicy, SearchPolicy
from franka_wm.policies.expert import ExpertPolicy, TaskwisePolicy
from franka_wm.policies.scripted import (
    DiscreteIKPolicy,
    DiscretePolicy,
    IKPolicy,
    NoopPolicy,
    RandomDiscretePolicy,
    SmoothRandomPolicy,
)
from franka_wm.seeding import derive_seed, evaluation_seed
from franka_wm.training.settings import CollectorSettings, RunSettings
from franka_wm.training.spaces import Spaces

if TYPE_CHECKING:
    from franka_wm.models.base import WorldModel

# -- environments -------------------------------------------------------------------------------------------


def make_env(
    run: RunSettings,
    *,
    num_envs: int | None = None,
    seed: int | None = None,
    first_world: int = 0,
    workers: int = 0,
    ray: bool = False,
    **changes: object,
) -> Environment:
    """The environment that ``run.env`` describes; ``changes`` override fields of its config.

    For a model of discrete actions the arm takes numbers of rows of a table. Its episodes are those of training
    unless ``seed`` says otherwise. Other libraries' differ by the seed alone; ``workers`` (``ray``: actors) share them.
    """
    described = run.env.changed(**changes)
    worlds = run.collector.num_envs if num_envs is None else num_envs
    start = derive_seed("training", run.seed) if seed is None else seed
    if isinstance(described.config, MultiTaskConfig):
        many: Any = {"num_envs": worlds, "seed": start, "first_world": first_world}
        return MultiTaskEnv(described.config, device=run.device, **many)
    if isinstance(described.config, ExternalConfig):
        shared: Any = {"workers": workers, "ray": ray, "device": resolve_device(run.device)}
        return ExternalEnv(described.config, num_envs=worlds, seed=start, **shared)
    config = described.arm
    env = FrankaEnv(
        config,
        num_envs=worlds,
        device=run.device,
        seed=start,
        first_world=first_world,
        urdf_path=described.urdf_path,
    )
    moves = DiscreteActions(config.action_dim, gripper=config.has_gripper)
    return TransformedFrankaEnv(env, moves) if run.is_discrete else env


def make_evaluation_env(run: RunSettings, *, num_envs: int | None = None, **changes: Any) -> Environment:
    """The same task for evaluation, with :func:`evaluation_changes`."""
    num_envs = run.evaluation.episodes if num_envs is None else num_envs
    changes = evaluation_changes(run, changes)
    return make_env(run, num_envs=num_envs, seed=evaluation_seed(run.seed), **changes)


def evaluation_changes(run: RunSettings, changes: Mapping[str, Any]) -> dict[str, Any]:
    """``changes`` of the arm's config, and what ``ik`` and ``expert`` read, and the images that the model reads."""
    if not run.is_arm:
        return dict(changes)
    read = run.model.observations or ()
    goal = ("goal_pixels",) if run.objective_name == "goal_image" else ()
    arm = run.env.arm
    vectors = ["state", "joint_target"] + ["objects"] * (arm.object_dim > 0)
    vectors += ["contacts"] * (arm.contact_dim > 0)
    images = [o for o in arm.observations if o not in vectors]
    used = [o for o in images if any(key == o or key.startswith(f"{o}_") for key in (*read, *goal))]
    return {"observations": [*used, *vectors], **changes}


# -- models -------------------------------------------------------------------------------------------------


def make_model(
    run: RunSettings, spaces: Spaces | Environment, device: torch.device | str | None = None
) -> WorldModel:
    """The world model that ``run.model`` names.

    Args:
        spaces: :class:`Spaces`, or an environment.
        device: The environment's if there is one.
    """
    if not isinstance(spaces, Spaces):
        device = spaces.device if device is None else device
        spaces = Spaces.of_env(spaces)
    name, values = run.model.name, run.model.options
    spaces = spaces.only(run.model.observations, f"model={name}")
    run.model.family.validate(values)
    discrete = run.is_discrete
    if discrete and not spaces.num_actions:
        raise UserError(f"model={name} has discrete actions; this environment's actions are continuous")
    if not discrete and not spaces.action_dim:
        raise UserError(
            f"model={name} needs continuous actions, here are {spaces.num_actions} discrete ones; try model=muzero"
        )
    actions = {"num_actions": spaces.num_actions} if discrete else {"action_dim": spaces.action_dim}
    sizes: dict[str, Any] = {"observation_sizes": spaces.observation_sizes}
    if spaces.image_sizes:
        sizes["image_sizes"] = spaces.image_sizes
    known = {name: getattr(spaces, name) for name in ("reward_bounds", "terminates", "action_masks")}
    takes = signature(run.model.family).parameters
    further = {key: value for key, value in known.items() if key in takes}
    try:
        model = models.make(
            name, **sizes, **actions, episode_length=spaces.episode_length, **further, **values
        )
    except (TypeError, ValueError, ModuleNotFoundError) as error:
        raise UserError(f"model={name}: {error}{place(error)}") from error
    return model.to(device)


# -- planners and policies ----------------------------------------------------------------------------------


def make_planner(run: RunSettings, actions: int) -> Planner | MCTS:
    """The planner that ``run.planner`` names.

    Args:
        actions: Size of a continuous action, or how many discrete actions there are.
    """
    name, values, discrete = run.planner.name, run.planner.options, run.is_discrete
    try:
        run.check_planner_fits()
        if discrete and run.planner.precision != "float32":
            raise UserError("planner.precision: tree search computes in float32; leave it out")
        registry.validate(name, values)
        return registry.make(name, **values, **{"num_actions" if discrete else "action_dim": actions})
    except (TypeError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"planner={name}: {error}{place(error)}") from error


def make_objective(run: RunSettings, model: WorldModel) -> Objective | None:
    """What the planner maximises, by ``run.objective``."""
    o, name = run.objective, run.objective_name
    if name is None:
        return None
    if name == "reward_value":
        try:
            chosen: Objective = planning.RewardPlusValue.of(model)
        except ValueError as error:
            raise UserError(f"objective=reward_value: {error}; goal_image needs encode_goal") from error
    else:
        if not model.has_goal:
            raise UserError(
                f"objective=goal_image: model={run.model.name} has no encode_goal; use objective=reward_value"
            )
        if o.steps_weight and not model.has_goal_steps:
            raise UserError(f"objective.steps_weight={o.steps_weight}: needs model.goal_steps_coef above 0")
        chosen = planning.GoalImage(
            model.encode_goal,
            embed=model.embed,
            goals=goal_images(model.image_sizes),
            metric=o.metric,  # pyright: ignore[reportArgumentType]  # one of its choices
            summed=o.summed,
            steps=model.goal_steps if o.steps_weight else None,
            steps_weight=o.steps_weight,
        )
    parts: list[tuple[float, Objective]] = [(1.0, chosen)]
    masked = getattr(model, "masked", None)
    if o.action_penalty:
        parts.append((1.0, planning.ActionPenalty(o.action_penalty, masked)))
    if o.policy_penalty:
        if model.has_policy:
            own = planning.PolicyPenalty(partial(model.policy, deterministic=True), o.policy_penalty, masked)
        elif model.has_goal_policy and isinstance(chosen, planning.GoalImage):
            towards = partial(model.goal_policy, deterministic=True)
            own = planning.GoalPolicyPenalty(towards, chosen, o.policy_penalty)
        else:
            raise UserError(f"objective.policy_penalty: model={run.model.name} has no policy; leave it at 0")
        parts.append((1.0, own))
    if o.smoothness_penalty:
        parts.append((1.0, planning.Smoothness(o.smoothness_penalty, masked)))
    return chosen if len(parts) == 1 else planning.Sum(parts)


def make_policies(
    model: WorldModel,
    planner: Planner | MCTS | None,
    env: Environment,
    *,
    seed: int = 0,
    smoothness: float = 0.7,
    objective: Objective | None = None,
    capture: bool | None = None,
    precision: str = "float32",
    compile: bool = False,
) -> dict[str, TensorDictModuleBase]:
    """Every policy that can act or be compared, by name.

    ``planner`` and ``policy`` where the model has what they need; ``noop`` and ``random`` (smooth random:
    first-order autoregressive); for the arm ``ik``, inverse kinematics with true geometry, or a search over pairs
    of discrete actions. ``capture``, ``precision``, ``compile``: see :class:`~franka_wm.policies.PlannerPolicy`.
    """
    policies: dict[str, TensorDictModuleBase] = {}
    discrete = not env.action_spec.dtype.is_floating_point
    if discrete:
        search = cast(MCTS, planner)
        policies["planner"] = SearchPolicy.for_model(model, search, capture=capture, compile=compile)
    elif model.has_next:
        policies["planner"] = PlannerPolicy.for_model(
            model,
            cast(Planner, planner),
            objective=objective,
            capture=capture,
            precision=precision,
            compile=compile,
        )
    goals = {*goal_images(model.image_sizes).values()}
    if model.has_policy or (model.has_goal_policy and set() < goals <= {*env.observation_spec.keys()}):
        policies["policy"] = ModelPolicy.for_model(model, capture=capture)
    return policies | make_scripted_policies(env, seed=seed, smoothness=smoothness)


def make_scripted_policies(
    env: Environment, *, seed: int = 0, smoothness: float = 0.7
) -> dict[str, TensorDictModuleBase]:
    """Policies that need no model: ``noop``, ``random`` and, for the arm, ``ik``; with a gripper ``expert``.

    Of several tasks at once ``expert`` is each task's own, or ``ik``. Where actions are poses, there is a ``noop``
    if they are continuous and of one task alone.
    """
    generator = torch.Generator(device=env.device).manual_seed(seed)
    discrete = not env.action_spec.dtype.is_floating_point
    arm = arm_of(env)
    if discrete and arm is None:
        return {"random": RandomDiscretePolicy(env.action_dim, generator=generator)}
    size = env.action_dim if arm is None else arm.config.action_dim
    scripted: dict[str, TensorDictModuleBase] = {
        "noop": NoopPolicy(size) if arm is None else NoopPolicy.of(arm),
        "random": SmoothRandomPolicy(size, smoothness=smoothness, generator=generator),
    }
    arms = env.envs.values() if isinstance(env, MultiTaskEnv) else [arm] * discrete
    if any(one is not None and one.config.action_mode == "joint_position" for one in arms):
        del scripted["noop"]
    if isinstance(env, MultiTaskEnv):
        own = {name: make_scripted_policies(one) for name, one in env.envs.items()}
        able = {
            name: found[by]
            for name, found in own.items()
            for by in ("ik", "expert")
            if by in found and {*found[by].in_keys} <= {*env.envs[name].observation_spec.keys()}
        }
        if len(able) == len(own):
            scripted["expert"] = TaskwisePolicy(env, able)
    if arm is None:
        return scripted
    if discrete:
        numbered: Any = env.transform
        scripted = {name: DiscretePolicy(policy, numbered.table) for name, policy in scripted.items()}
        if not arm.config.has_gripper:
            scripted["ik"] = DiscreteIKPolicy(arm.kinematics, arm.config, numbered.table)
    elif arm.config.has_gripper:
        task = arm.simulation.task
        fits = arm.config.gravity_compensation and arm.config.action_mode != "ee_delta"
        if task.expert is not None and fits:
            scripted["expert"] = ExpertPolicy(task, arm.kinematics, arm.config)
    else:
        scripted["ik"] = IKPolicy(arm.kinematics, arm.config)
    return scripted


def make_agent_policies(
    run: RunSettings,
    model: WorldModel,
    env: Environment | None,
    spaces: Spaces,
    *,
    purpose: str = "evaluation",
) -> dict[str, TensorDictModuleBase]:
    """Planner, objective and policies by the configuration; none without an environment to act in.

    Those that gather experience and those that are evaluated must not be the same objects: a random policy has a
    generator and a last action of its own.

    Args:
        env: Where they act.
        purpose: ``training`` or ``evaluation``; random policies of each draw other numbers.
    """
    if env is None:
        return {}
    planner = make_planner(run, spaces.num_actions or spaces.action_dim) if model.has_next else None
    compile = run.planner.compile
    if compile and (missing := missing_to_compile(env.device)) is not None:  # a checkpoint of another machine
        say(f"planner.compile: {missing} is not here; it plans without, more slowly")
        compile = False
    return make_policies(
        model,
        planner,
        env,
        seed=derive_seed(
            "policies", run.seed, purpose, *(processes.parts() if purpose == "training" else ())
        ),
        smoothness=run.collector.smoothness,
        objective=make_objective(run, model),
        capture=None if run.trainer.capture else run.trainer.capture,  # true asks for what CUDA does anyway
        precision=run.planner.precision,
        compile=compile,
    )


def explore(
    collector: CollectorSettings, policies: Mapping[str, TensorDictModuleBase], name: str
) -> TensorDictModuleBase:
    """The policy that gathers experience; the model's own explores as ``collector`` says, others as they are."""
    noise, worlds = collector.noise, collector.planner_worlds
    if name != "policy" or not (noise or worlds):
        return policies[name]
    return ExploringPolicy(
        policies[name], noise=noise, planner=policies.get("planner"), planner_worlds=worlds
    )


# -- experience ---------------------------------------------------------------------------------------------


HINDSIGHT = 0.5
"""Share of windows that ``replay.hindsight=null`` relabels, where that can be done."""


def make_hindsight(run: RunSettings) -> Hindsight | None:
    """Goals in hindsight for the share of windows that ``run.replay.hindsight`` asks for; ``None``: for none."""
    share = run.replay.hindsight
    if share == 0 or no_hindsight(run) is not None:
        return None
    task = make_task(run.env.arm)
    assert task.relabel is not None
    share = HINDSIGHT if share is None else share
    say(f"hindsight: {100 * share:.0f} % of the windows get a goal that their episode reached later")
    return Hindsight(
        task.relabel,
        achieved=task.achieved,
        reads=task.relabel_reads,
        share=share,
        episode_length=run.env.episode_length,
    )


def no_hindsight(run: RunSettings) -> str | None:
    """Why windows cannot be given other goals, or gain nothing from them; ``None``: they can."""
    if not run.is_arm or run.is_discrete:
        return "only the arm with continuous actions has goals to exchange"
    config, keys = run.env.arm, run.model.observations
    task = make_task(config)
    if not task.relabels():
        return f"env.task={config.task} does not say what another goal changes (Task.relabel)"
    noise = config.randomization.observation_noise or config.randomization.object_noise
    if config.reward == "normalized" or noise:
        return "rewards of another goal are exact without observation noise and with reward=dense or sparse alone"
    if config.fixed_goal:
        return "there is one goal (env.goal_sampling=fixed)"
    for key in task.relabel_reads:
        if key not in config.observations:
            return f"it reads {key}; add it to env.observations"
    if keys is not None and not {"state", "goal"} & set(keys):
        return f"model={run.model.name} does not read where the goal is"
    if config.show_goal or any("goal_pixels" in key for key in keys or ()):
        return "images show the recorded goal"
    return None


def make_replay_buffer(
    run: RunSettings,
    device: torch.device,
    hindsight: Hindsight | None = None,
    demonstrations: Demonstrations | None = None,
) -> WindowReplay:
    """The replay buffer that ``run.replay`` describes; it keeps each image once."""
    cameras = run.env.arm.cameras if run.is_arm else ()
    return make_replay(
        capacity=run.replay.capacity,
        num_envs=run.collector.num_envs,
        window=run.window,
        batch_size=run.replay.batch_size,
        device=device,
        cross_episode=run.crosses_episodes,
        moved=run.model.family.moved_windows,
        burn_in=run.burn_in,
        frame_stack=run.env.frame_stack,
        stacked=("pixels", *(f"pixels_{camera}" for camera in cameras)) if run.env.frame_stack > 1 else (),
        hindsight=hindsight,
        future=FutureFrames(episode_length=run.env.episode_length) if run.replay.future else None,
        demonstrations=demonstrations,
        episode_length=run.env.shortest_episode,
        marks=run.env.marks_overflow,
    )


def open_recorded(run: RunSettings, device: torch.device) -> tuple[RecordedWindows, RecordedWindows | None]:
    """Training and validation windows of the datasets that ``run.dataset`` names.

    The second is ``None`` where no episode is long enough for validation.
    """
    from franka_wm.data.lerobot import open_dataset

    train = open_dataset(
        **run.dataset.options,
        window=run.window,
        batch_size=run.replay.batch_size,
        device=device,
        frame_stack=run.env.frame_stack,
        future=run.replay.future,
        burn_in=run.burn_in,
        **run.of_recorded,
    )
    return train, train.validation()
