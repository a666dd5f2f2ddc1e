"""From a resolved configuration to the parts of a run. The configuration stops here: parts get plain values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from inspect import signature
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torchrl.data import ReplayBuffer

from franka_wm import models, planning
from franka_wm.console import say
from franka_wm.data.hindsight import Hindsight
from franka_wm.data.replay import make_replay
from franka_wm.device import resolve_device
from franka_wm.envs import FrankaConfig, FrankaEnv, TransformedFrankaEnv
from franka_wm.envs.config import ACTION_MODES
from franka_wm.envs.discretize import DiscreteActions
from franka_wm.errors import UserError
from franka_wm.planning import registry
from franka_wm.policies import ExploringPolicy, ModelPolicy, PlannerPolicy, SearchPolicy
from franka_wm.policies.names import POLICIES, refuse_old_name
from franka_wm.policies.planner import PRECISIONS
from franka_wm.policies.scripted import (
    DiscreteOraclePolicy,
    DiscretePolicy,
    NoopPolicy,
    OraclePolicy,
    RandomMovesPolicy,
    SmoothRandomPolicy,
)
from franka_wm.seeding import derive_seed, evaluation_seed
from franka_wm.training.spaces import Spaces


def actor(cfg: DictConfig) -> str:
    """The name of the policy that gathers experience, by ``collector.acts``.

    Raises:
        UserError: No such policy, or one that the model's family does not have.
    """
    acts = cfg.collector.acts
    refuse_old_name("collector.acts", acts)
    if acts != "auto" and acts not in POLICIES:
        raise UserError(f"collector.acts={acts!r}: must be one of auto, {', '.join(POLICIES)}")
    family = models.family(cfg.model.name)
    there = {"planner": family.has_next, "policy": family.has_policy}
    searched = bool(family.replay_keys)  # the loss needs what the search found
    if acts == "auto":
        if searched:
            return "planner"
        if there["policy"]:
            return "policy"
        # A planner without a policy's candidates takes far longer to decide than the worlds to step, and a model that
        # is given goals by their pictures can learn from any motion.
        return "planner" if objective_name(cfg) == "reward_value" else "random"
    if not there.get(acts, True) or (searched and acts != "planner"):
        fitting = "planner" if there["planner"] else "random"
        raise UserError(f"collector.acts={acts}: model={cfg.model.name} cannot; use collector.acts={fitting}")
    return acts


def plain(node: Any) -> dict[str, Any]:
    """A configuration node as a plain dict."""
    return dict(OmegaConf.to_container(node, resolve=True)) if isinstance(node, DictConfig) else dict(node)  # type: ignore[arg-type]


# -- environments -------------------------------------------------------------------------------------------


def is_arm(cfg: DictConfig) -> bool:
    """Whether the environment is the arm, not one of another library."""
    return cfg.env.kind == "franka"


def make_env(cfg: DictConfig, *, num_envs: int | None = None, seed: int | None = None, **changes: Any) -> Any:
    """The environment that ``cfg.env`` describes; ``changes`` override fields of its config.

    For a model that chooses among moves, the arm's actions are numbers of moves. Its episodes are those of training
    unless ``seed`` says otherwise.
    """
    values = plain(cfg.env) | changes
    worlds = int(cfg.collector.num_envs if num_envs is None else num_envs)
    start = derive_seed("training", cfg.seed) if seed is None else seed
    if not is_arm(cfg):
        from franka_wm.envs.external import ExternalEnv, external_config

        return ExternalEnv(
            external_config(values), num_envs=worlds, device=resolve_device(cfg.device), seed=start
        )
    del values["kind"]
    urdf_path = values.pop("urdf_path")
    config = FrankaConfig.from_mapping(values)
    env = FrankaEnv(config, num_envs=worlds, device=cfg.device, seed=start, urdf_path=urdf_path)
    return TransformedFrankaEnv(env, DiscreteActions(config.action_dim)) if is_discrete(cfg) else env


def make_evaluation_env(cfg: DictConfig, *, num_envs: int | None = None, **changes: Any) -> Any:
    """The same task for evaluation: with what ``ik`` reads, and the pictures that the model reads."""
    num_envs = cfg.evaluation.episodes if num_envs is None else num_envs
    if is_arm(cfg):
        read = model_keys(cfg) or []
        goal = ["goal_pixels"] if plans_to_pictures(cfg) else []
        pictures = [o for o in cfg.env.observations if o not in ("state", "joint_target")]
        used = [o for o in pictures if any(key == o or key.startswith(f"{o}_") for key in [*read, *goal])]
        changes = {"observations": [*used, "state", "joint_target"]} | changes
    return make_env(cfg, num_envs=num_envs, seed=evaluation_seed(cfg.seed), **changes)


# -- models -------------------------------------------------------------------------------------------------


NOT_FOR_MODELS = ("name", "observations", "window", "lr", "schedule", "warmup")
"""Entries of ``conf/model`` that are about a family's training, not for its constructor."""


def window(cfg: DictConfig) -> int:
    """Transitions of a training window: ``replay.window``, or what the model asks for."""
    return cfg.model.window if cfg.replay.window is None else cfg.replay.window


def crosses_episodes(cfg: DictConfig) -> bool:
    """Whether the model's loss takes windows that go on past the end of an episode."""
    return models.family(cfg.model.name).cross_episode


def learning_rate(cfg: DictConfig) -> float:
    """``trainer.lr``, or the model's own."""
    return cfg.model.lr if cfg.trainer.lr is None else cfg.trainer.lr


def schedule(cfg: DictConfig) -> tuple[str, int]:
    """``trainer.schedule`` and ``trainer.warmup`` [updates], or the model's own; constant where neither says."""
    kind = cfg.model.get("schedule", "constant") if cfg.trainer.schedule is None else cfg.trainer.schedule
    warmup = cfg.model.get("warmup", 0.0)
    if cfg.trainer.warmup is not None:
        return kind, cfg.trainer.warmup
    return kind, round(warmup * cfg.trainer.updates)


def model_keys(cfg: DictConfig) -> list[str] | None:
    """The observations that ``cfg.model`` names; ``None``: every vector that there is."""
    keys = cfg.model.get("observations")
    return None if keys is None else list(keys)


def is_discrete(cfg: DictConfig) -> bool:
    """Whether the model chooses among moves."""
    try:
        return models.family(cfg.model.name).discrete
    except ValueError as error:
        raise UserError(f"model.name: {error}") from error


def make_model(cfg: DictConfig, surroundings: Any, device: torch.device | str | None = None) -> Any:
    """The world model that ``cfg.model`` names.

    Args:
        surroundings: :class:`Spaces`, or an environment.
        device: The environment's if there is one.
    """
    if not isinstance(surroundings, Spaces):
        device = surroundings.device if device is None else device
        surroundings = Spaces.of_env(surroundings)
    values = {key: value for key, value in plain(cfg.model).items() if key not in NOT_FOR_MODELS}
    name = cfg.model.name
    spaces = surroundings.only(model_keys(cfg), f"model={name}")
    models.family(name).validate(values)
    discrete = is_discrete(cfg)
    if discrete and not spaces.num_actions:
        raise UserError(f"model={name} chooses among moves; this environment's actions are continuous")
    if not discrete and not spaces.action_dim:
        raise UserError(
            f"model={name} needs continuous actions, here are {spaces.num_actions} moves; try model=muzero"
        )
    actions = {"num_actions": spaces.num_actions} if discrete else {"action_dim": spaces.action_dim}
    sizes: dict[str, Any] = {"observation_sizes": spaces.observation_sizes}
    if spaces.image_sizes:
        sizes["image_sizes"] = spaces.image_sizes
    known = {"reward_bounds": spaces.reward_bounds, "terminates": spaces.terminates}
    takes = signature(models.family(name)).parameters
    further = {key: value for key, value in known.items() if key in takes}
    try:
        model = models.make(
            name, **sizes, **actions, episode_length=spaces.episode_length, **further, **values
        )
    except (TypeError, ValueError, ModuleNotFoundError) as error:
        raise UserError(f"model={name}: {error}") from error
    return model.to(device)


# -- planners and policies ----------------------------------------------------------------------------------


OF_THE_POLICY = ("precision", "compile")
"""Entries of ``conf/planner`` that are not for the planner but for the policy around it: how the model computes."""


def make_planner(cfg: DictConfig, actions: int) -> Any:
    """The planner that ``cfg.planner`` names.

    Args:
        actions: Size of a continuous action, or the number of moves.
    """
    values = {key: value for key, value in plain(cfg.planner).items() if key not in OF_THE_POLICY}
    name = values.pop("name")
    precision, compiled = cfg.planner.get("precision", "float32"), cfg.planner.get("compile", False)
    if precision not in PRECISIONS:
        raise UserError(f"planner.precision={precision!r}: must be one of {', '.join(PRECISIONS)}")
    if not isinstance(compiled, bool):
        raise UserError(f"planner.compile={compiled!r}: must be true or false")
    discrete = is_discrete(cfg)
    try:
        if registry.is_search(name) != discrete:
            fitting = [one for one in registry.available() if registry.is_search(one) == discrete]
            fitting += (
                ["gumbel"] if discrete else []
            )  # mcts with other settings: a name in conf/planner alone
            what = "chooses among moves" if discrete else "has continuous actions"
            typed = "gumbel" if values.get("variant") == "gumbel" else name
            raise UserError(
                f"planner={typed}: model={cfg.model.name} {what}; use planner={' or '.join(fitting)}"
            )
        for key, value in values.items():
            counts = key in ("horizon", "iterations") or key.startswith("num_")
            if counts and (isinstance(value, bool) or not isinstance(value, int)):
                raise UserError(f"planner.{key}={value!r}: must be a whole number")
        return registry.make(name, **values, **{"num_actions" if discrete else "action_dim": actions})
    except (TypeError, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"planner={name}: {error}") from error


def plans_to_pictures(cfg: DictConfig) -> bool:
    """Whether the planner's goal is a picture."""
    return objective_name(cfg) == "goal_image"


def goal_pictures(keys: Iterable[str]) -> dict[str, str]:
    """Key of a picture that a model reads → that of the same camera's picture of the goal."""
    return {key: f"goal_{key}" for key in keys}


def objective_name(cfg: DictConfig) -> str | None:
    """``reward_value``, ``goal_image``, or ``None`` for a family that does not plan by an objective."""
    name = cfg.objective.name
    if name != "auto":
        return name
    family = models.family(cfg.model.name)
    if family.discrete or not family.has_next:
        return None
    return "reward_value" if family.has_value else "goal_image"


def make_objective(cfg: DictConfig, model: Any) -> Any:
    """What the planner maximises, by ``cfg.objective``."""
    o = cfg.objective
    name = objective_name(cfg)
    if name is None:
        return None
    if name == "reward_value":
        try:
            chosen: Any = planning.RewardPlusValue.of(model)
        except ValueError as error:
            raise UserError(f"objective=reward_value: {error}; use objective=goal_image") from error
    elif name == "goal_image":
        if not model.has_goal:
            raise UserError(
                f"objective=goal_image: model={cfg.model.name} has no encode_goal; use objective=reward_value"
            )
        chosen = planning.GoalImage(
            model.encode_goal,
            embed=model.embed,
            goals=goal_pictures(model.image_sizes),
            metric=o.metric,
            summed=o.summed,
        )
    else:
        raise UserError(f"objective.name={name!r}: must be auto, reward_value or goal_image")
    parts: list[tuple[float, Any]] = [(1.0, chosen)]
    if o.action_penalty:
        parts.append((1.0, planning.ActionPenalty(o.action_penalty)))
    if o.get("policy_penalty"):
        if not model.has_policy:
            raise UserError(
                f"objective.policy_penalty: model={cfg.model.name} has no policy; use objective.policy_penalty=0"
            )
        parts.append(
            (1.0, planning.PolicyPenalty(partial(model.policy, deterministic=True), o.policy_penalty))
        )
    if o.smoothness_penalty:
        parts.append((1.0, planning.Smoothness(o.smoothness_penalty)))
    return chosen if len(parts) == 1 else planning.Sum(parts)


def make_policies(
    model: Any,
    planner: Any,
    env: Any,
    *,
    seed: int = 0,
    smoothness: float = 0.7,
    objective: Any = None,
    capture: bool | None = None,
    precision: str = "float32",
    compile: bool = False,
) -> dict[str, Any]:
    """Every policy that can act or be compared, by name.

    ``planner`` and ``policy`` where the model has what they need; ``noop`` and ``random`` (smooth random:
    first-order autoregressive); for the arm ``ik``, inverse kinematics with true geometry, or a search over pairs
    of moves. ``capture``,
    ``precision`` and ``compile``: of the planner's, see :class:`~franka_wm.policies.PlannerPolicy`.
    """
    policies: dict[str, Any] = {}
    discrete = not env.action_spec.dtype.is_floating_point
    if discrete:
        policies["planner"] = SearchPolicy.for_model(model, planner, capture=capture)
    elif model.has_next:
        policies["planner"] = PlannerPolicy.for_model(
            model, planner, objective=objective, capture=capture, precision=precision, compile=compile
        )
    if model.has_policy:
        policies["policy"] = ModelPolicy.for_model(model)
    return policies | make_scripted_policies(env, seed=seed, smoothness=smoothness)


def make_scripted_policies(env: Any, *, seed: int = 0, smoothness: float = 0.7) -> dict[str, Any]:
    """Policies that need no model: ``noop``, ``random`` and, for the arm, ``ik``."""
    generator = torch.Generator(device=env.device).manual_seed(seed)
    discrete = not env.action_spec.dtype.is_floating_point
    arm = isinstance(env, (FrankaEnv, TransformedFrankaEnv))
    if discrete and not arm:
        return {"random": RandomMovesPolicy(env.action_dim, generator=generator)}
    size = env.config.action_dim if arm else env.action_dim
    scripted: dict[str, Any] = {
        "noop": NoopPolicy(size),
        "random": SmoothRandomPolicy(size, smoothness=smoothness, generator=generator),
    }
    if discrete:
        moves: Any = env.transform
        scripted = {name: DiscretePolicy(policy, moves.table) for name, policy in scripted.items()}
        scripted["ik"] = DiscreteOraclePolicy(env.kinematics, env.config, moves.table)
    elif arm:
        scripted["ik"] = OraclePolicy(env.kinematics, env.config)
    return scripted


def make_agent_policies(
    cfg: DictConfig, model: Any, env: Any, spaces: Spaces, *, purpose: str = "evaluation"
) -> dict[str, Any]:
    """Planner, objective and policies by the configuration; none without an environment to act in.

    Those that gather experience and those that are evaluated must not be the same objects: a random policy has a
    generator and a last action of its own.

    Args:
        env: Where they act.
        purpose: ``training`` or ``evaluation``; random policies of each draw other numbers.
    """
    if env is None:
        return {}
    planner = make_planner(cfg, spaces.num_actions or spaces.action_dim) if model.has_next else None
    return make_policies(
        model,
        planner,
        env,
        seed=derive_seed("policies", cfg.seed, purpose),
        smoothness=cfg.collector.smoothness,
        objective=make_objective(cfg, model),
        capture=None if cfg.trainer.capture else cfg.trainer.capture,  # true asks for what CUDA does anyway
        **{key: cfg.planner[key] for key in OF_THE_POLICY if key in cfg.planner},
    )


def check_exploration(cfg: DictConfig) -> None:
    """Refuses what ``cfg.collector`` cannot ask for.

    Raises:
        UserError: A value out of range, or planner worlds where another policy than the model's own acts.
    """
    noise, worlds = cfg.collector.get("noise", 0.0), cfg.collector.get("planner_worlds", 0)
    if isinstance(noise, bool) or not isinstance(noise, int | float) or not 0.0 <= noise <= 2.0:
        raise UserError(f"collector.noise={noise!r}: must be a number from 0 to 2, in units of the action")
    if isinstance(worlds, bool) or not isinstance(worlds, int) or not 0 <= worlds <= cfg.collector.num_envs:
        raise UserError(
            f"collector.planner_worlds={worlds!r}: must be a whole number of at most "
            f"collector.num_envs={cfg.collector.num_envs}; 0 leaves all worlds to the policy"
        )


def explore(cfg: DictConfig, policies: Mapping[str, Any], name: str) -> Any:
    """The policy that gathers experience; the model's own explores as ``cfg.collector`` says, others as they are."""
    noise, worlds = cfg.collector.get("noise", 0.0), cfg.collector.get("planner_worlds", 0)
    if name != "policy" or not (noise or worlds):
        return policies[name]
    return ExploringPolicy(
        policies[name], noise=noise, planner=policies.get("planner"), planner_worlds=worlds
    )


# -- experience ---------------------------------------------------------------------------------------------


def frame_stack(cfg: DictConfig) -> int:
    """Pictures in each observation of one, of the arm's or of recordings.

    Raises:
        UserError: It is no whole number of at least 1.
    """
    count = cfg.env.get("frame_stack", 1) if is_arm(cfg) or cfg.env.kind == "none" else 1
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise UserError(f"env.frame_stack={count!r}: must be a whole number of at least 1")
    return count


HINDSIGHT = 0.5
"""Share of windows that ``replay.hindsight=null`` relabels, where that can be done."""


def hindsight_share(cfg: DictConfig) -> float | None:
    """``replay.hindsight``: a share, or ``None`` where it is left to the task.

    Raises:
        UserError: It is no share, or asked for on recorded data.
    """
    share = cfg.replay.get("hindsight", 0.0)  # checkpoints of earlier versions have none
    if share is None:
        return None
    if isinstance(share, bool) or not isinstance(share, int | float) or not 0.0 <= share <= 1.0:
        raise UserError(f"replay.hindsight={share!r}: must be a share from 0 to 1, or null")
    if share and is_offline(cfg):
        raise UserError(f"replay.hindsight={share}: recorded data keep their goals; leave it at null")
    return share


def make_hindsight(cfg: DictConfig, env: Any) -> Hindsight | None:
    """Goals in hindsight for the share of windows that ``cfg.replay.hindsight`` asks for; ``None``: for none.

    Raises:
        UserError: The share is none, or it is asked for where goals cannot be exchanged.
    """
    share = hindsight_share(cfg)
    if share == 0:
        return None
    why = no_hindsight(cfg, env)
    if why is not None:
        if share is not None:
            raise UserError(f"replay.hindsight={share}: {why}; leave it at null")
        return None
    arm = _arm(env)
    assert arm is not None and arm.simulation.task.relabel is not None
    share = HINDSIGHT if share is None else share
    say(f"hindsight: {100 * share:.0f} % of the windows get a goal that their episode reached later")
    return Hindsight(
        arm.simulation.task.relabel, achieved, share=share, episode_length=arm.config.episode_length
    )


def no_hindsight(cfg: DictConfig, env: Any) -> str | None:
    """Why windows cannot be given other goals, or gain nothing from them; ``None``: they can."""
    arm = _arm(env)
    if arm is None or is_discrete(cfg):
        return "only the arm with continuous actions has goals to exchange"
    config, keys = arm.config, model_keys(cfg)
    if not arm.simulation.task.relabels():
        return f"env.task={config.task} does not say what another goal changes (Task.relabel)"
    if config.reward == "normalized" or config.randomization.observation_noise:
        return "rewards of another goal are exact without observation noise and with reward=dense or sparse alone"
    if config.goal_sampling == "fixed":
        return "there is one goal (env.goal_sampling=fixed)"
    if "state" not in config.observations:
        return "it reads where the tool was from state; add it to env.observations"
    if keys is not None and not {"state", "goal"} & set(keys):
        return f"model={cfg.model.name} does not read where the goal is"
    if config.show_goal or any("goal_pixels" in key for key in keys or ()):
        return "images show the recorded goal"
    return None


def _arm(env: Any) -> FrankaEnv | None:
    while env is not None and not isinstance(env, FrankaEnv):
        env = getattr(env, "base_env", None)
    return env


def achieved(state: torch.Tensor) -> torch.Tensor:
    """Place of the tool [m]: (…, 20) → (…, 3)."""
    return state[..., 14:17]


def make_replay_buffer(
    cfg: DictConfig, device: torch.device, hindsight: Hindsight | None = None
) -> ReplayBuffer:
    """The replay buffer that ``cfg.replay`` describes; it keeps each image of a stack once."""
    pictures = ["pixels", *(f"pixels_{camera}" for camera in cfg.env.get("cameras", []))]
    return make_replay(
        capacity=cfg.replay.capacity,
        num_envs=cfg.collector.num_envs,
        window=window(cfg),
        batch_size=cfg.replay.batch_size,
        device=device,
        cross_episode=crosses_episodes(cfg),
        frame_stack=frame_stack(cfg),
        stacked=pictures if frame_stack(cfg) > 1 else (),
        hindsight=hindsight,
    )


def is_offline(cfg: DictConfig) -> bool:
    """Whether experience comes from recorded data."""
    return cfg.dataset.kind != "none"


def open_recorded(cfg: DictConfig, device: torch.device) -> tuple[Any, Any]:
    """Training and validation windows of the datasets that ``cfg.dataset`` names.

    The second is ``None`` where no episode is long enough for validation.
    """
    from franka_wm.data.lerobot import open_dataset

    values = plain(cfg.dataset)
    kind = values.pop("kind")
    if kind != "lerobot":
        raise UserError(f"dataset.kind={kind!r}: must be none or lerobot")
    train = open_dataset(
        **values,
        window=window(cfg),
        batch_size=cfg.replay.batch_size,
        device=device,
        keys=model_keys(cfg),
        frame_stack=frame_stack(cfg),
    )
    if is_arm(cfg):  # what is learned will act there
        train.check(fps=cfg.env.fps, action_dim=ACTION_MODES[cfg.env.action_mode])
    return train, train.validation()
