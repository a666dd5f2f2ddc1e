"""From configuration to parts: every preset builds, what cannot be is refused before anything is built."""

from __future__ import annotations

import copy
import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from franka_wm.errors import UserError
from franka_wm.planning import Sum
from franka_wm.training import build
from franka_wm.training.check import check
from franka_wm.training.run import Run
from franka_wm.training.settings import RunSettings
from franka_wm.training.spaces import Spaces

ROOT = Path(__file__).resolve().parents[2]


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (ROOT / "conf" / group).glob("*.yaml"))


def test_every_group_is_there() -> None:
    groups = {path.name for path in (ROOT / "conf").iterdir() if path.is_dir()}
    wanted = "env model planner collector replay trainer logger evaluation scale dataset"
    assert set(wanted.split()) <= groups
    assert {"reach", "reach_fixed", "reach_pixels", "reach_fixed_pixels"} <= set(options("env"))
    assert {"laptop", "gpu", "smoke"} <= set(options("scale"))


OTHERS = ("gym", "dm_control", "none", "multitask")
"""Environments that are not the arm."""


@pytest.mark.parametrize("name", [name for name in options("env") if name not in OTHERS])
def test_every_environment_preset(name: str, settled) -> None:
    cfg = settled(f"env={name}")
    check(cfg)
    config = cfg.env.arm
    assert ("pixels" in config.observations) == (name.endswith(("pixels", "goal_image")) or name == "franka")
    if "fixed" in name:
        assert config.goal_sampling == "fixed" and config.episode_length == 20
    elif name != "franka":
        assert config.goal_sampling == "reachable"


def test_several_tasks_at_once_need_a_world_each(settled) -> None:
    cfg = settled("env=multitask")
    check(cfg)
    assert len(cfg.env.config.tasks) == 8 and cfg.env.episode_length == 150 and not cfg.is_arm
    fewer = settled("env=multitask", "~env.tasks.peg", "env.tasks.push.episode_length=33")
    assert "peg" not in fewer.env.config.tasks and fewer.env.config.tasks["push"].episode_length == 33
    longer = cfg.env.changed(episode_length=200).config
    assert {one.episode_length for one in longer.tasks.values()} == {200}
    for option in ("collector.num_envs", "evaluation.episodes", "evaluation.during_episodes"):
        with pytest.raises(UserError, match=f"{option}=7: env=multitask has 8 tasks"):
            check(settled("env=multitask", f"{option}=7"))
    with pytest.raises(
        UserError, match=r"the shortest env\.tasks\.NAME\.episode_length=2 .* use replay\.window=2"
    ):
        check(settled("env=multitask", "env.tasks.lift.episode_length=2"))


@pytest.mark.parametrize("name", options("scale"))
def test_every_scale(name: str, settled) -> None:
    cfg = settled(f"scale={name}")
    check(cfg)
    assert cfg.values["scale"] == name
    build.make_planner(cfg, 7)


NEEDS = {  # what else an option goes with
    "collector": {"ray": ["env=gym", "env.name=Pendulum-v1", "collector.workers=2"]},
    "planner": {"mcts": ["model=muzero"], "gumbel": ["model=muzero"]},
    "model": {
        "muzero": ["planner=mcts"],
        "lewm": ["env=reach_goal_image"],
        "action_world_model": ["env=reach_goal_image"],
        "dino_wm": ["env=reach_goal_image", "pretrain=jepa"],
    },
    "objective": {"goal_image": ["env=reach_goal_image", "model=lewm"]},
}


@pytest.mark.parametrize(
    ("group", "name"),
    [
        (group, name)
        for group in (
            "collector",
            "replay",
            "trainer",
            "logger",
            "evaluation",
            "model",
            "planner",
            "objective",
        )
        for name in options(group)
    ],
)
def test_every_other_option(group: str, name: str, settled) -> None:
    if name in ("mlflow", "trackio", "ray"):  # extras
        pytest.importorskip(name)
    others = NEEDS.get(group, {}).get(name, ["env=reach_pixels"] if group == "model" else [])
    check(settled(f"{group}={name}", *others))


def test_the_default_is_to_reach_sampled_goals(settled) -> None:
    cfg = settled()
    assert cfg.env.arm.goal_sampling == "reachable" and cfg.env.arm.gravity_compensation is True
    assert cfg.evaluation.episodes >= 64 and cfg.trainer.checkpoint_replay is None


def test_environments_of_a_run(settled) -> None:
    cfg = settled(
        "env=reach_pixels", "device=cpu", "env.image_size=8", "env.substeps=1", "collector.num_envs=2"
    )
    env = build.make_env(cfg)
    assert env.num_envs == 2 and set(env.config.observations) == {"pixels", "state", "joint_target"}
    eval_env = build.make_evaluation_env(cfg, num_envs=3)
    assert eval_env.num_envs == 3 and set(eval_env.config.observations) == {"state", "joint_target"}


@pytest.mark.parametrize(
    ("override", "named"),
    [
        ("env.substeps=-1", "substeps"),
        ("env.image_size=0", "image_size"),
        ("env.observations=[pixels]", "observations"),
        ("env.observations=[depth]", "observations"),
        ("env.goal=null", "goal"),
        ("env.target_ke=stiff", "target_ke"),
        ("env.episode_length=2", "episode_length"),
        ("collector.num_envs=0", "num_envs"),
        ("collector.num_envs=2.5", "num_envs"),
        ("collector.policy=fly", "policy"),
        ("collector.policy=smooth", "policy=smooth: this policy is called random now"),
        ("evaluation.during=[oracle]", "during=oracle: this policy is called ik now"),
        ("collector.steps_per_batch=0", "steps_per_batch"),
        ("collector.seed_steps=0", "seed_steps"),
        ("+collector.calmest=0.5", "calmest"),
        (("model=lewm", "env=reach_goal_image", "model.inverse_coef=0.5", "model.history=4"), "inverse_coef"),
        ("planner.precision=float16", "float32, bfloat16"),
        ("planner.compile=maybe", "true or false"),
        ("replay.window=0", "window"),
        (("model=muzero", "planner=gumbel", "replay.window=10"), "replay.window=11"),
        (("model=muzero", "planner=gumbel", "scale=smoke", "model.n_step=3"), "replay.window=7"),
        ("replay.batch_size=-1", "batch_size"),
        ("trainer.updates=-1", "updates"),
        ("trainer.updates_per_batch=0", "updates_per_batch"),
        ("evaluation.episodes=1", "episodes"),
        ("evaluation.video_size=97", "video_size"),
        ("trainer.checkpoint_replay=8", "checkpoint_replay"),
        ("evaluation.at_steps=1000", "at_steps"),
        ("evaluation.every=60.0", "a whole number of updates"),
        ("evaluation.every=-1", "whole number of updates"),
        ("evaluation.at_steps=[1000,-5]", "at_steps"),
        (("evaluation.at_steps=[1000]", "evaluation.during=[]"), "evaluation.during=[planner]"),
        (("dataset=lerobot", "trainer=offline", "dataset.root=/tmp", "evaluation.at_steps=[9]"), "at_steps"),
        ("device=tpu", "tpu"),
    ],
)
def test_refused_before_anything_is_built(override: str | tuple[str, ...], named: str, settled) -> None:
    with pytest.raises(UserError) as caught:
        check(settled(*([override] if isinstance(override, str) else override)))
    assert named in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("model", [["model=tdmpc2"], ["model=muzero", "planner=gumbel"]])
@pytest.mark.parametrize("scale", ["laptop", "gpu"])
def test_the_range_of_values_holds_the_returns_of_long_episodes(model, scale: str, settled) -> None:
    """And is no wider than needed for short ones; a number given wins."""

    def high(*overrides: str) -> tuple[float, float]:
        cfg = settled(f"scale={scale}", *model, *overrides)
        spaces = Spaces.of_config(cfg.env.arm, discrete=cfg.is_discrete)
        assert Spaces.from_dict(spaces.as_dict()) == spaces
        built = build.make_model(cfg, spaces, "cpu")
        return built.two_hot.high, 1.0 / (1.0 - built.discount)

    short, steps = high("env.episode_length=50")
    assert math.log1p(1.01 * steps) < short < 3.3
    long, steps = high("env.episode_length=1000")
    assert math.log1p(1.01 * steps) < long and steps > 150
    assert high("env.action_penalty=1.0")[0] > short
    assert high("model.value_high=7.5")[0] == 7.5


def test_a_head_for_ends_is_there_where_episodes_terminate(settled) -> None:
    small = ("device=cpu", "env.substeps=1", "collector.num_envs=2", "objective.policy_penalty=0")
    for overrides, there in (((), False), (("env.terminate_on_success=true",), True)):
        cfg = settled(*small, *overrides)
        env = build.make_env(cfg)
        assert Spaces.of_env(env) == Spaces.of_config(env.config)
        model = build.make_model(cfg, env)
        policy = build.make_policies(model, build.make_planner(cfg, 7), env)["planner"]
        assert (model.termination_head is not None) == there
        assert (policy.objective.terminated is not None) == there
        assert (build.make_objective(cfg, model).terminated is not None) == there


def test_spaces_of_an_older_checkpoint_know_no_bounds() -> None:
    values = Spaces(observation_sizes={"state": 20}, action_dim=7, reward_bounds=(-1.0, 0.0)).as_dict()
    del values["reward_bounds"], values["terminates"]
    assert Spaces.from_dict(values).reward_bounds is None and not Spaces.from_dict(values).terminates
    for length in ("8", 8.0, 0):
        with pytest.raises(ValueError, match="episode_length is"):
            Spaces.from_dict(values | {"episode_length": length})


def test_muzero_sees_ends_and_episodes_shorter_than_its_windows(settled) -> None:
    """Else its value targets could not reach further than the shortest episode is long."""
    episodes = TensorDict({"is_init": (torch.arange(80) % 8 == 0).expand(4, 80).unsqueeze(-1)}, [4, 80])
    cfg = settled("env=gym", "model=muzero", "planner=gumbel", "collector.num_envs=4")
    check(cfg)
    assert cfg.window == cfg.model.options["unroll"] + cfg.model.options["n_step"] + 1 > 8
    assert cfg.collector.seed_steps >= cfg.window
    check(settled("env=gym", "model=muzero", "planner=gumbel", "env.episode_length=8"))
    replay = build.make_replay_buffer(cfg, torch.device("cpu"))
    replay.extend(episodes)
    assert replay.sample().batch_size == (cfg.replay.batch_size, cfg.window)
    cfg = settled("collector.num_envs=4", "replay.window=9")
    replay = build.make_replay_buffer(cfg, torch.device("cpu"))
    replay.extend(episodes)
    with pytest.raises(UserError, match="episodes of at least 9"):  # TD-MPC2 takes whole windows alone
        replay.sample()


STACKED = (
    "scale=smoke",
    "device=cpu",
    "env=reach_fixed_pixels",
    "env.frame_stack=3",
    "model=tdmpc2_pixels",
    "env.substeps=1",
)


def test_a_run_keeps_each_picture_of_a_stack_once(settled, random_actions) -> None:
    """And its model's batches have stacks; a run without has none to take apart."""
    cfg = settled(*STACKED, "collector.num_envs=4", "env.image_size=16", "env.episode_length=6")
    env = build.make_env(cfg)
    root, steps = env.reset(seed=0), []
    for action in random_actions(4, 20).unbind(1):
        step, root = env.step_and_maybe_reset(root.clone().set("action", action))
        steps.append(step.clone())
    played = torch.stack(steps, 1)
    replay = build.make_replay_buffer(cfg, torch.device("cpu"))
    replay.extend(played)
    assert replay[:]["pixels"].shape[-1] == replay[:]["next", "pixels"].shape[-1] == 3
    assert replay.sample()["pixels"].shape[-1] == 9
    time, world = torch.arange(2, 20).expand(4, 18), torch.arange(4).unsqueeze(1).expand(4, 18)
    assert torch.equal(replay.storage.get((time, world))["pixels"], played["pixels"][:, 2:])
    replay = build.make_replay_buffer(settled("collector.num_envs=4"), torch.device("cpu"))
    other = build.make_replay_buffer(settled("model=dreamer"), torch.device("cpu"))
    assert [(one.sampler.moved, one.sampler.burn_in) for one in (replay, other)] == [(False, 0), (True, 34)]
    replay.extend(played.select("state", "is_init"))
    assert len(replay) == 80 and replay.sampler.before == 0


def test_stacks_that_do_not_fit_are_refused_before_anything_is_built(settled) -> None:
    check(settled(*STACKED))
    check(settled(*STACKED, "export=lerobot", "trainer.updates=1000"))
    for overrides, says in (
        (("env.frame_stack=abc",), "frame_stack='abc': must be a whole number"),
        (("env.frame_stack=null",), "frame_stack=None: must be a whole number"),
        (("env.frame_stack=true",), "frame_stack=True: must be a whole number"),
        (
            ("env.frame_stack=64",),
            r"windows have \d steps, and 63 before them for env\.frame_stack: use at least",
        ),
        (("collector.seed_steps=1", "collector.steps_per_batch=1"), r"use at least collector\.seed_steps="),
        (
            ("replay.capacity=40",),
            r"must be at least 48 for collector\.num_envs=8: windows have 3 steps, and 2 before",
        ),
    ):
        with pytest.raises(UserError, match=says):
            check(settled(*STACKED, *overrides))


def test_planner_and_model_that_do_not_exist(settled, small_env) -> None:
    with pytest.raises(UserError, match="planner"):
        build.make_planner(settled("planner.name=crystal_ball"), 7)
    with pytest.raises(UserError, match="model"):
        build.make_model(settled("model.name=oracle_bone"), small_env(1))


def test_the_planner_computes_as_configured(settled) -> None:
    """`planner.precision` and `planner.compile` reach the policy that plans."""
    cfg = settled("scale=smoke", "planner.precision=bfloat16", "trainer.capture=false")
    env = build.make_evaluation_env(cfg, num_envs=2)
    spaces = Spaces.of_env(env)
    model = build.make_model(cfg, spaces, "cpu")
    policy = build.make_agent_policies(cfg, model, env, spaces)["planner"]
    assert policy.precision == "bfloat16" and policy.capture is False and policy.next == model.next
    cfg = cfg.changed(planner={"compile": True}, trainer={"capture": True})
    policy = build.make_agent_policies(cfg, model, env, spaces)["planner"]
    assert policy.next != model.next  # compiled
    assert policy.capture is None  # a checkpoint of a GPU acts on a CPU, too
    cfg = settled("model=muzero", "planner=gumbel", "env=gym", "planner.compile=true")
    env = build.make_evaluation_env(cfg, num_envs=2)
    model = build.make_model(cfg, spaces := Spaces.of_env(env), "cpu")
    policy = build.make_agent_policies(cfg, model, env, spaces)["planner"]
    assert policy.recurrent != model.recurrent and policy.search.kernels is None


def test_goal_pictures_of_every_camera_that_the_model_reads(settled) -> None:
    two = ("env=reach_fixed_goal_image", "env.cameras=[front,side]", "model=lewm", "planner=icem")
    cfg = settled(*two, "model.observations=[pixels,pixels_side]", "device=cpu", "env.image_size=16")
    check(cfg)
    with pytest.raises(UserError, match="reads pixels, not"):
        check(settled(*two, "model.observations=[joint_target]"))
    with pytest.raises(UserError, match="needs goal_pixels"):
        check(settled(*two, "env.observations=[pixels,state]"))
    cfg = cfg.changed(model={"patch_size": 8})
    env = build.make_evaluation_env(cfg, num_envs=2)
    model = build.make_model(cfg, env)
    objective = build.make_objective(cfg, model)
    assert objective.in_keys == ["goal_pixels", "goal_pixels_side"]
    observed = env.reset()
    goal = objective.bind(observed).goal_latent
    swapped = observed.clone().set("goal_pixels_side", observed["goal_pixels"])
    assert not torch.equal(objective.bind(swapped).goal_latent, goal)  # the second picture counts


OPTIONS_SINCE = (
    ("env", "frame_stack"),
    ("env", "mesh_detail"),
    ("collector", "noise"),
    ("collector", "planner_worlds"),
    ("replay", "hindsight"),
    ("evaluation", "at_steps"),
    ("evaluation", "during_episodes"),
    ("planner", "precision"),
    ("planner", "compile"),
)
"""Options that checkpoints of earlier versions do not have."""


def test_runs_of_before_an_option_was_there_go_on(settled, capsys) -> None:
    cfg = settled("env=reach", "device=cpu", "env.observations=[state,joint_target]")
    old = copy.deepcopy(dict(cfg.values))
    for group, key in OPTIONS_SINCE:
        del old[group][key]
    old["collector"]["calmest"] = 1.0  # gone since
    cfg = RunSettings.of(old, saved=True)
    assert "collector.calmest" in capsys.readouterr().out
    check(cfg)
    assert cfg.replay.hindsight == 0.0 and cfg.evaluation.at_steps == () and cfg.collector.noise == 0.0
    env = build.make_env(cfg, num_envs=2)
    spaces = Spaces.of_env(env)
    policies = build.make_agent_policies(cfg, build.make_model(cfg, env), env, spaces)
    assert set(policies) == {"planner", "policy", "noop", "random", "ik"}


@pytest.fixture
def hindsight(settled):
    def make(*overrides: str):
        cfg = settled("scale=smoke", "device=cpu", *overrides)
        return build.make_hindsight(cfg)

    return make


def test_hindsight_is_used_where_goals_change_and_rewards_are_known(hindsight) -> None:
    found = hindsight()
    assert found is not None and found.share == 0.5 and found.episode_length == 50
    assert hindsight("replay.hindsight=0") is None
    assert hindsight("replay.hindsight=0.25").share == 0.25


@pytest.mark.parametrize(
    "overrides",
    [
        ["env=reach_fixed"],
        ["env.task=track"],
        ["env.reward=normalized"],
        ["env.randomization.observation_noise=0.01"],
        ["model=muzero", "planner=gumbel"],
    ],
)
def test_elsewhere_hindsight_is_none_and_refused_where_it_is_asked_for(
    overrides: list[str], hindsight, settled
) -> None:
    assert hindsight(*overrides) is None
    with pytest.raises(UserError, match=r"replay\.hindsight=0\.5: .*leave it at null"):
        check(settled("scale=smoke", "device=cpu", *overrides, "replay.hindsight=0.5"))


@pytest.mark.parametrize("share", ["1.5", "-0.1", "true", "some"])
def test_a_share_that_is_none_is_refused(share: str, hindsight) -> None:
    with pytest.raises(UserError, match=r"must be a finite number of at least 0 and of at most 1, or null"):
        hindsight(f"replay.hindsight={share}")


def test_windows_of_a_run_are_relabeled(settled, tmp_path: Path) -> None:
    run = Run(settings=settled("scale=smoke", "device=cpu"), folder=tmp_path)
    replay, _ = run.build_experience(build.make_env(run.settings, num_envs=2))
    assert replay.hindsight is not None


def test_the_models_policy_explores_and_others_act_as_they_are(settled) -> None:
    cfg = settled("scale=smoke", "collector.noise=0.4", "collector.planner_worlds=2")
    policies = {name: torch.nn.Identity() for name in ("policy", "planner", "random")}
    for one in policies.values():
        one.in_keys = one.out_keys = ["action"]  # pyright: ignore[reportAttributeAccessIssue]
    found = build.explore(cfg.collector, policies, "policy")
    assert (found.noise, found.planner_worlds, found.planner) == (0.4, 2, policies["planner"])
    assert build.explore(cfg.collector, policies, "random") is policies["random"]
    assert build.explore(settled("env=reach_fixed").collector, policies, "policy") is policies["policy"]


@pytest.mark.parametrize(
    "wrong",
    [
        "collector.noise=-1",
        "collector.noise=some",
        "collector.planner_worlds=100000",
        "collector.planner_worlds=1.5",
        "collector.workers=2",
        "collector.workers=-1",
        "replay.hindsight=2",
    ],
)
def test_exploration_that_cannot_be_is_refused_before_anything_is_built(wrong: str, settled) -> None:
    with pytest.raises(UserError, match=wrong.split("=")[0]):
        check(settled("scale=smoke", "device=cpu", wrong))


def test_processes_share_the_worlds_of_other_libraries_equally(settled) -> None:
    with pytest.raises(
        UserError, match=r"collector\.workers=3: cannot share collector\.num_envs=4 worlds equally"
    ):
        check(settled("env=gym", "scale=smoke", "device=cpu", "collector.num_envs=4", "collector.workers=3"))


def test_plans_stay_near_the_policy_on_the_arm_and_are_the_published_ones_elsewhere(settled):
    spaces = Spaces(observation_sizes={"state": 20}, action_dim=7)
    for words, penalised in ((("env=reach",), True), (("env=dm_control",), False)):
        cfg = settled("scale=smoke", *words)
        objective = build.make_objective(cfg, build.make_model(cfg, spaces))
        assert isinstance(objective, Sum) == penalised
        assert penalised == (cfg.model.options["entropy_coef"] > 1e-4) == cfg.model.options["mode_targets"]
