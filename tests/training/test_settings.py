"""Every documented option refuses other types and values out of range, in one line that says what is allowed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from typing import Any

import pytest
from omegaconf import OmegaConf

from franka_wm import models
from franka_wm.conf import FOLDER, KNOWN, compose
from franka_wm.errors import UserError
from franka_wm.planning import registry
from franka_wm.training.build import make_model, make_objective, make_planner
from franka_wm.training.settings import RunSettings
from franka_wm.training.settings.run import GROUPS, plain
from franka_wm.training.spaces import Spaces

OUT_OF_RANGE = {
    "seed": [-1],
    "gpus": [0],
    "env.frame_stack": [0],
    "env.episode_length": [0],
    "collector.policy": ["judge"],
    "collector.num_envs": [0],
    "collector.steps_per_batch": [0],
    "collector.seed_steps": [0],
    "collector.seed_updates": [-1],
    "collector.smoothness": [-0.1, 1.0],
    "collector.noise": [-0.1, 2.1],
    "collector.planner_worlds": [-1],
    "collector.workers": [-1],
    "collector.ray": ["some"],
    "replay.capacity": [0],
    "replay.batch_size": [0],
    "replay.window": [0],
    "replay.hindsight": [-0.1, 1.1],
    "replay.demos": [3, [3]],
    "replay.demo_share": [-0.1, 1.1],
    "replay.demo_share_end": [-0.1, 1.1],
    "replay.demo_updates": [-1],
    "replay.demo_resets": [-0.1, 1.5],
    "replay.demo_reset_updates": [-1, 0.5],
    "trainer.updates": [-1],
    "trainer.updates_per_batch": [0],
    "trainer.lr": [0.0, -1.0],
    "trainer.grad_clip": [0.0],
    "trainer.precision": ["float16"],
    "trainer.schedule": ["linear"],
    "trainer.warmup": [-1],
    "trainer.log_every": [0.0],
    "trainer.checkpoint_every": [0.0],
    "evaluation.episodes": [1],
    "evaluation.during": [["oracel"], "planner"],
    "evaluation.during_episodes": [1],
    "evaluation.every": [0],
    "evaluation.at_steps": [[0], [1.5], 1000],
    "evaluation.video_episodes": [-1],
    "evaluation.video_size": [14, 97],
    "objective.name": ["reward"],
    "objective.metric": ["l3"],
    "objective.steps_weight": [-1.0],
    "objective.action_penalty": [-1.0],
    "objective.smoothness_penalty": [-1.0],
    "objective.policy_penalty": [-1.0],
    "export.kind": ["hdf5"],
    "export.workers": [0],
    "dataset.kind": ["hdf5"],
    "dataset.validation_fraction": [-0.1, 1.0],
    "dataset.workers": [0],
    "dataset.image_size": [0, [1, 2, 3]],
    "pretrain.kind": ["model"],
    "pretrain.updates": [-1],
    "model.window": [0],
    "model.lr": [0.0],
    "model.schedule": ["linear"],
    "model.warmup": [-0.1, 1.1],
    "planner.precision": ["float16"],
}
"""Option → values of the right type that it cannot have."""


@cache
def values() -> Mapping[str, Any]:
    """All groups, with the options of a dataset, an export and a first stage."""
    found = compose("dataset=lerobot", "export=lerobot", "pretrain=jepa", "model=lewm", "scale=laptop")
    return OmegaConf.to_container(found, resolve=True)  # type: ignore[return-value]


def changed(option: str, value: Any) -> dict[str, Any]:
    group, _, name = option.rpartition(".")
    new = {key: dict(one) if isinstance(one, dict) else one for key, one in values().items()}
    (new[group] if group else new)[name] = value
    return new


def refused(option: str, value: Any) -> str:
    with pytest.raises(UserError) as caught:
        RunSettings.of(changed(option, value))
    return str(caught.value)


def declared() -> list[tuple[str, str]]:
    """(option, what it must be) of every group that is declared as a whole."""
    return [
        (f"{group}.{one.name}", one.metadata["rule"].wanted)
        for group, cls in GROUPS.items()
        for one in fields(cls)
    ]


def wrong_types(wanted: str) -> list[Any]:
    """Values that no option of this kind takes."""
    always = [{"a": 1}]
    if "number" in wanted:
        return [*always, "some", True, math.nan, math.inf, *([2.5] if "finite" not in wanted else [])]
    return [*always, 3, 1.5] if not wanted.startswith("{") and "options" not in wanted else [3, "some"]


def test_every_documented_option_is_declared() -> None:
    documented = {f"{group}.{name}" for group in GROUPS for name in values()[group]}
    assert documented == {option for option, _ in declared()}


@pytest.mark.parametrize(("option", "wanted"), declared())
def test_other_types_are_refused(option: str, wanted: str) -> None:
    for value in wrong_types(wanted):
        said = refused(option, value)
        assert said.startswith(f"{option}=") and f"must be {wanted}" in said and "\n" not in said, (
            value,
            said,
        )


@pytest.mark.parametrize(("option", "value"), [(o, v) for o, wrong in OUT_OF_RANGE.items() for v in wrong])
def test_values_out_of_range_are_refused(option: str, value: Any) -> None:
    said = refused(option, value)
    assert option.removeprefix("env.") in said and "must be" in said and "\n" not in said


def test_every_bounded_option_is_tried_out_of_range() -> None:
    bounded = {
        option
        for option, wanted in declared()
        if any(word in wanted for word in ("least", "most", "above", "below", "one of"))
    }
    assert bounded - {"dataset.seed"} <= set(OUT_OF_RANGE)


@pytest.mark.parametrize("option", ["trainer.updates", "collector.num_envs", "model.window", "dataset.kind"])
def test_null_is_refused_where_it_means_nothing(option: str) -> None:
    assert refused(option, None).startswith(f"{option}=None: must be ")


def test_a_configuration_of_something_else_is_one_line() -> None:
    with pytest.raises(UserError, match="the configuration has no device"):
        RunSettings.of({"seed": 0}, saved=True)


def test_an_option_that_does_not_exist_names_the_nearest() -> None:
    said = refused("collector.num_env", 3)
    assert said.startswith("collector.num_env: there is no such option") and "collector.num_envs" in said


def test_what_stands_at_the_top_of_a_configuration() -> None:
    """All of conf/config.yaml, and nothing else; a checkpoint may hold more, of another version."""
    values = plain(compose("scale=smoke"))
    assert set(values) == set(KNOWN)
    with pytest.raises(UserError, match=r"trianer: there is no such option; did you mean trainer\?"):
        RunSettings.of({**values, "trianer": {}})
    RunSettings.of({**values, "trianer": {}}, saved=True)
    with pytest.raises(UserError, match="did you mean trainer"):  # collect, view
        compose("+trianer.updates=3")
    with pytest.raises(UserError, match=r"seed=\d+: must be .* below 2\*\*63"):
        RunSettings.of({**values, "seed": 2**63})


def test_what_a_saved_run_says_of_old_options(capsys) -> None:
    run = RunSettings.of(changed("collector.calmest", 0.5), saved=True)
    assert "collector.calmest" in capsys.readouterr().out and "calmest" not in run.values["collector"]


# -- models and planners: types by the constructor's annotations ------------------------------------------------


@pytest.mark.parametrize(
    ("group", "file"),
    [
        (group, path.stem)
        for group in ("model", "planner")
        for path in sorted((FOLDER / group).glob("*.yaml"))
    ],
)
def test_options_of_models_and_planners_refuse_other_types(group: str, file: str) -> None:
    run = RunSettings.of(compose(f"{group}={file}", "scale=laptop"))
    part = getattr(run, group)
    tried = 0
    for name, value in part.options.items():
        if not isinstance(value, bool | int | float):
            continue
        tried += 1
        for wrong in (
            "some",
            [1],
            3 if isinstance(value, bool) else True,
            *([2.5] if type(value) is int else []),
        ):
            with pytest.raises(UserError) as caught:
                if group == "model":
                    part.family.validate({**part.options, name: wrong})
                else:
                    registry.validate(part.name, {name: wrong})
            assert str(caught.value).startswith(f"{group}.{name}={wrong!r}: must be "), wrong
    assert tried >= 3


def test_a_planner_option_that_does_not_exist() -> None:
    with pytest.raises(UserError, match=r"planner\.num_sample: .*planner\.num_samples"):
        registry.validate("mppi", {"num_sample": 3})
    with pytest.raises(ValueError, match=r"did you mean mppi\?"):
        registry.planner("mpi")


def test_a_tree_search_has_one_precision() -> None:
    run = RunSettings.of(compose("model=muzero", "planner=gumbel", "env=gym", "+planner.precision=bfloat16"))
    with pytest.raises(UserError, match=r"planner\.precision: tree search computes in float32"):
        make_planner(run, 2)


def test_a_tree_search_is_called_by_its_kind() -> None:
    for name, label in [("gumbel", "gumbel"), ("mcts", "puct"), ("mppi", "mppi"), ("cem", "cem")]:
        family = "muzero" if label in ("gumbel", "puct") else "tdmpc2"
        assert RunSettings.of(compose(f"model={family}", f"planner={name}")).planner.label == label


def test_a_bound_of_a_count_has_all_its_digits() -> None:
    with pytest.raises(UserError, match=r"planner\.num_samples=2000000: .* and of at most 1000000$"):
        registry.validate("mppi", {"num_samples": 2_000_000})


def test_settings_are_what_several_options_make_of_them() -> None:
    run = RunSettings.of(compose("model=lewm", "env=reach_goal_image", "scale=laptop"))
    assert (run.window, run.learning_rate, run.schedule, run.warmup) == (3, 5.0e-4, "cosine", 80)
    assert (run.actor, run.objective_name, run.evaluation_period) == ("random", "goal_image", 1000)
    other = run.changed(replay={"window": 5}, trainer={"lr": 1.0, "schedule": "constant", "warmup": 7})
    assert (other.window, other.learning_rate, other.schedule, other.warmup) == (5, 1.0, "constant", 7)
    assert run.values["replay"]["window"] is None, "the first is as it was"
    assert RunSettings.of(run.values) == run


@pytest.mark.parametrize(
    ("words", "label"),
    [
        (("env=dm_control", "env.name=walker", "env.task=run"), "walker run"),
        (("env=gym",), "CartPole-v1"),
        (("env=push",), "push"),
        (("env=multitask",), "multitask"),
    ],
)
def test_a_task_is_named_with_its_domain(words: tuple[str, ...], label: str) -> None:
    """The suite has several tasks of one walker."""
    assert RunSettings.of(compose("scale=smoke", *words)).env.label == label


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (
            ["gpus=2", "replay.batch_size=7"],
            "replay.batch_size=7: 2 GPUs cannot share it; use a multiple of 2",
        ),
        (["gpus=3"], "collector.num_envs=8: 3 GPUs cannot share it"),
        (["gpus=4", "collector.planner_worlds=2"], "collector.planner_worlds=2: 4 GPUs cannot share it"),
    ],
)
def test_what_several_gpus_cannot_share_is_refused(overrides: list[str], says: str) -> None:
    with pytest.raises(UserError, match=says):
        RunSettings.of(compose("scale=smoke", *overrides))


def test_a_process_has_its_part_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    cfg = compose("scale=smoke", "device=cpu", "gpus=2")
    whole = RunSettings.of(cfg)
    monkeypatch.setattr("franka_wm.processes.count", lambda: 2)
    own = RunSettings.of(cfg)
    for name in ("num_envs", "batch_size", "capacity"):
        group = "collector" if name == "num_envs" else "replay"
        assert 2 * getattr(getattr(own, group), name) == getattr(getattr(whole, group), name)
    assert own.values == whole.values  # what checkpoints hold is of all
    assert own.changed(seed=1).collector.num_envs == own.collector.num_envs


def test_processes_share_the_demonstrations_of_a_batch(settled, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many in all as one process has: a tenth of eight is one, though a tenth of two is none."""
    words = ("env=lift", "scale=smoke", "device=cpu", "replay.demos=there", "replay.batch_size=8")
    words += (
        "replay.demo_share=0.1",
        "replay.demo_share_end=0.9",
        "trainer.updates=100",
        "replay.demo_updates=3",
    )
    one = settled(*words)
    monkeypatch.setattr("franka_wm.processes.count", lambda: 4)
    found = []
    for rank in range(4):
        monkeypatch.setattr("franka_wm.processes.rank", lambda rank=rank: rank)
        own = settled(*words, "gpus=4")
        found.append([own.demo_windows(update) for update in (0, 3, 25, 50, 100)])
        assert max(found[-1]) <= own.replay.batch_size
    whole = [one.demo_windows(update) for update in (0, 3, 25, 50, 100)]
    assert [sum(each) for each in zip(*found, strict=True)] == whole == [8, 1, 2, 4, 7]


def test_each_gpu_has_worlds_of_every_task(settled) -> None:
    """Eight tasks on two GPUs; four worlds on each, or seven and a half tasks, are refused before anything is built."""
    few = ("env=multitask", "gpus=2", "replay.batch_size=8")
    for worlds in (8, 24):
        with pytest.raises(UserError, match=f"collector.num_envs={worlds}: .* use a multiple of 16"):
            settled(*few, f"collector.num_envs={worlds}")
    settled(*few, "collector.num_envs=32")


def test_plans_are_for_returns_unless_the_family_has_no_value_but_goal_images(monkeypatch) -> None:
    family = models.family("tdmpc2")
    for has_value, has_goal, chosen in (
        (True, True, "reward_value"),
        (False, True, "goal_image"),
        (False, False, "reward_value"),  # refused then, naming what is missing
    ):
        monkeypatch.setattr(family, "has_value", has_value)
        monkeypatch.setattr(family, "has_goal", has_goal)
        run = RunSettings.of(compose("model=tdmpc2"))
        assert run.objective_name == chosen
    model = make_model(run, Spaces({"state": 3}, {}, 7, 0, 50))
    with pytest.raises(
        UserError, match="objective=reward_value: TDMPC2 has no value; goal_image needs encode_goal"
    ):
        make_objective(run, model)
