"""Runs with demonstrations: what fits is mixed in, what does not is refused, and none is an evaluation's episode."""

import json
import shutil
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from safetensors.torch import load_file

from franka_wm.commands import main as cli
from franka_wm.data.lerobot import cache, collect, open_dataset, opening
from franka_wm.data.lerobot.mapping import FeatureMap, map_features
from franka_wm.data.lerobot.provenance import ACTIONS, other_option
from franka_wm.data.lerobot.schema import PROVENANCE
from franka_wm.errors import UserError
from franka_wm.evaluation.closed_loop import begin
from franka_wm.evaluation.protocol import held_out_seeds
from franka_wm.training import build
from franka_wm.training.check import check
from franka_wm.training.check_dataset import _check_same_views
from franka_wm.training.demos import check_demonstrations, open_demonstrations
from franka_wm.training.history import read_rows
from franka_wm.training.learner import Learner
from franka_wm.training.run import Run
from franka_wm.training.spaces import Spaces
from franka_wm.training.trainer import Trainer

if TYPE_CHECKING:
    from franka_wm.data.lerobot.source import Source

ARM = ("env=reach", "env.substeps=1", "env.episode_length=8", "seed=0", "device=cpu")


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six episodes of inverse kinematics, eight steps each."""
    root = tmp_path_factory.mktemp("demos") / "reach"
    assert cli.main(["collect", f"out={root}", "policy=ik", "episodes=6", "num_envs=3", *ARM]) == 0
    return root


@pytest.fixture(autouse=True)
def own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(cache, "default_cache_dir", lambda: tmp_path / "cache")


def test_a_run_begins_with_them_alone_and_mixes_them_in(demos: Path, train, monkeypatch) -> None:
    seen, update = [], Learner.update

    def watched(self: Learner, batch: Any, **options: Any) -> None:
        seen.append(int(batch["demonstrated"][:, 0].sum()))
        update(self, batch, **options)

    monkeypatch.setattr(Learner, "update", watched)
    shares = ("replay.demo_updates=15", "replay.demo_share=0.5", "replay.demo_share_end=0.25")
    run = train(*ARM, f"replay.demos={demos}", *shares, "evaluation.during=[]")
    assert seen == [8] * 15 + [round(8 * (0.5 - 0.25 * update / 30)) for update in range(15, 30)]
    # Ten random steps and a batch before the first update, none while they are alone, then one for ten updates.
    assert run.counters["env_steps"] == 3 * (10 + 5 + 5)


def test_a_run_without_an_environment_evaluates_nothing(demos: Path, train) -> None:
    run = train(
        "env=none", "trainer=offline", "dataset=lerobot", f"dataset.root={demos}", "dataset.workers=1"
    )
    assert run.counters["updates"] == 30 and not (run.folder.parents[1] / "evaluation.json").exists()
    assert not any("eval/" in name for row in read_rows(run) for name in row)


def test_statistics_of_observations_see_them_too(demos: Path, train) -> None:
    plain = train(*ARM, "trainer.updates=0", "evaluation.during=[]", folder=demos.parent / "plain")
    mixed = train(*ARM, f"replay.demos={demos}", "trainer.updates=0", "evaluation.during=[]")
    one, other = (load_file(run.folder / "model.safetensors")["observation_mean"] for run in (plain, mixed))
    assert not torch.allclose(one, other)


GRIPPER = (
    "env=push",
    "env.substeps=1",
    "env.episode_length=8",
    "seed=0",
    "device=cpu",
    "evaluation.during=[]",
)


@pytest.fixture(scope="module")
def pushes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four episodes of the expert, eight steps each."""
    root = tmp_path_factory.mktemp("demos") / "push"
    own = [one for one in GRIPPER if not one.startswith("evaluation")]
    assert cli.main(["collect", f"out={root}", "policy=expert", "episodes=4", "num_envs=4", *own]) == 0
    return root


def test_training_begins_along_them(pushes: Path, train, monkeypatch) -> None:
    """From their ends on at first, then everywhere."""
    parts, begun, gather = [], [], Trainer.gather
    recorded = open_dataset(pushes, window=1, batch_size=1, validation_fraction=0.0, say=lambda line: None)
    states = torch.cat([one["state"].flatten(0, 1) for one in recorded.batches(100)])

    def watched(self: Trainer) -> None:
        gather(self)
        parts.append(float(self._starts._earliest))  # pyright: ignore[reportOptionalMemberAccess]
        data = self.replay[:]
        begun.append(data["state"][data["is_init"].squeeze(-1)])

    monkeypatch.setattr(Trainer, "gather", watched)
    resets = (
        f"replay.demos={pushes}",
        "replay.demo_resets=1",
        "replay.demo_reset_updates=20",
        "trainer.updates=30",
    )
    train(*GRIPPER, *resets)
    assert parts == [1.0] * 3 + [0.5, 0.0]
    first, last = (
        (starts[:, None, :7] == states[None, :, :7]).all(-1).nonzero() for starts in (begun[0], begun[-1])
    )
    assert (len(states), len(first), len(last)) == (32, len(begun[0]), len(begun[-1]))  # each is one of them
    assert (first[:, 1] % 8 == 7).all() and not (last[:, 1] % 8 == 7).all()


def test_what_is_evaluated_never_begins_along_them(pushes: Path, train, monkeypatch) -> None:
    built = []
    make = build.make_evaluation_env
    monkeypatch.setattr(
        build, "make_evaluation_env", lambda *a, **k: built.append(make(*a, **k)) or built[-1]
    )
    train(*GRIPPER, f"replay.demos={pushes}", "replay.demo_resets=1", "trainer.updates=0")
    assert built and all(env.simulation.starts is None for env in built)


def test_none_is_an_episode_of_the_evaluation(demos: Path, settled, tmp_path: Path, monkeypatch) -> None:
    run = settled("scale=smoke", *ARM, "evaluation.episodes=64")
    (held_out,) = held_out_seeds(1)  # which evaluation plays, not the seed that its worlds are built with
    evaluated = begin(build.make_evaluation_env(run), held_out)["state"]

    def nearest(root: Path) -> torch.Tensor:
        """(episodes,): how far each begins from the nearest of the evaluation, the largest of its entries."""
        recorded = open_dataset(root, window=1, batch_size=1, validation_fraction=0.0, say=lambda line: None)
        starts = torch.cat([one["state"][one["is_init"].squeeze(-1)] for one in recorded.batches(100)])
        return (starts[:, None] - evaluated).abs().amax(-1).amin(1)

    assert nearest(demos).shape == (6,) and nearest(demos).min() > 1e-2
    monkeypatch.setattr(collect, "derive_seed", lambda *_: held_out)
    leak = tmp_path / "leak"
    assert cli.main(["collect", f"out={leak}", "policy=ik", "episodes=3", "num_envs=3", *ARM]) == 0
    assert nearest(leak).max() < 1e-5  # such a meeting would be seen


def test_those_that_are_not_finite_are_refused_before_worlds_are_built(
    demos: Path, settled, tmp_path: Path, monkeypatch
) -> None:
    damaged = tmp_path / "damaged"
    shutil.copytree(demos, damaged)
    rows = min((damaged / "data").rglob("*.parquet"))
    table = pq.read_table(rows)
    at = table.column_names.index("action")
    actions = np.array(table["action"].to_pylist(), dtype=np.float32)
    actions[3, 2] = np.nan
    column = pa.array(actions.tolist(), type=table.schema.field(at).type)
    pq.write_table(table.set_column(at, table.schema.field(at), column), rows)
    monkeypatch.setattr(build, "make_evaluation_env", lambda *_, **__: pytest.fail("built"))
    run = settled("scale=smoke", *ARM, f"replay.demos={damaged}")
    check(run)
    with pytest.raises(UserError, match="not finite") as refused:
        Run(run, tmp_path).build_environments()
    assert "\n" not in str(refused.value)


def test_short_ones_are_refused_in_a_line(demos: Path, settled) -> None:
    longer = ("replay.window=20", "env.episode_length=30")
    run = settled("scale=smoke", *ARM, *longer, f"replay.demos={demos}")
    with pytest.raises(UserError, match="no demonstration has 20 steps") as refused:
        open_demonstrations(run, Spaces.of_config(run.env.arm), None)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("shares", [(0.5, 0.0, 0), (0.25, 0.75, 0), (0.25, 0.5, 1)])
def test_as_many_as_the_batch_that_asks_for_most_are_drawn(demos: Path, settled, shares) -> None:
    """A replacement that is too small would leave windows out without a word."""
    share, end, alone = shares
    options = (f"replay.demo_share={share}", f"replay.demo_share_end={end}", f"replay.demo_updates={alone}")
    run = settled("scale=smoke", *ARM, f"replay.demos={demos}", "trainer.updates=4", *options)
    shown = open_demonstrations(run, Spaces.of_config(run.env.arm), None)
    assert shown is not None and shown.most == max(run.demo_windows(update) for update in range(5))


def test_observations_of_another_size_are_refused(demos: Path, settled) -> None:
    run = settled("scale=smoke", *ARM, f"replay.demos={demos}")
    spaces = Spaces.of_config(run.env.arm)
    larger = {key: size + (key == "state") for key, size in spaces.observation_sizes.items()}
    with pytest.raises(UserError, match=r"replay\.demos=\S+: state has size 20 there, 21 in this"):
        open_demonstrations(run, replace(spaces, observation_sizes=larger), None)


def test_episodes_without_rewards_are_refused(demos: Path, settled, monkeypatch) -> None:
    from franka_wm.data.lerobot.windows import RecordedWindows

    monkeypatch.setattr(RecordedWindows, "reward_bounds", None)
    run = settled("scale=smoke", *ARM, f"replay.demos={demos}")
    with pytest.raises(UserError, match=r"replay\.demos=\S+: these episodes have no rewards"):
        open_demonstrations(run, Spaces.of_config(run.env.arm), None)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (("dataset=lerobot", "dataset.root={demos}"), "gathers nothing to mix them with"),
        (("env.task=track",), "recorded with env.task=reach, this run has track"),
        (("env.reward=sparse",), "recorded with env.reward=dense, this run has sparse"),
        (("env.action_scale=0.05",), "recorded with env.action_scale=0.085, this run has 0.05"),
        (("env.fps=20",), r"/\S+ has 30 frames per second, the environment 20"),
        (("env=lift",), r"/\S+: its actions have 7 numbers, the environment's 8"),
        (("model=muzero", "planner=gumbel"), "learns from its own search"),
        (("replay.demo_updates=31",), "must be at most trainer.updates=30"),
        (("replay.demos={demos}/nowhere",), r"replay\.demos=\S*/nowhere: no such folder"),
        (("replay.demos=[]",), r"replay\.demos=\[\]: must be a folder"),
        (("replay.demo_share=1.5",), "replay.demo_share=1.5"),
        (("replay.demo_share=0",), r"demo_share=0: no update would see replay\.demos"),
        (("env=reach_pixels", "model=tdmpc2_pixels"), r"\S+: has no pixels, which model=\S+ reads"),
        (
            ("env.terminate_on_success=true",),
            "recorded with env.terminate_on_success=false, this run has true",
        ),
        (("replay.demo_resets=0.5",), "is for tasks with a gripper"),
        (("replay.demos=null", "replay.demo_resets=0.5"), "needs demonstrations"),
        (("replay.demos=null", "replay.demo_updates=5"), "demo_updates=5: needs demonstrations"),
        (("replay.demo_reset_updates=5",), r"needs replay\.demo_resets above 0"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_built(demos: Path, settled, changes, message) -> None:
    words = [f"replay.demos={demos}", *(one.replace("{demos}", str(demos)) for one in changes)]
    with pytest.raises(UserError, match=message) as refused:
        check(settled("scale=smoke", *ARM, *words))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            ("env.action_scale=0.05",),
            r"recorded with env.action_scale=0.085, this run has 0.05, so actions mean",
        ),
        (
            ("env.observations=[joint_target]",),
            r"dataset: state is of size 20 there, env.task=reach does not show it",
        ),
        (("env.robot=panda_meshes",), r"env.robot=embedded, this run has panda_meshes, so actions mean"),
        (("env.urdf_path=tests/arm.urdf",), r"recorded with env.urdf_path=null, this run has \S+arm.urdf"),
    ],
)
def test_data_that_mean_something_else_are_refused(demos: Path, settled, changes, message) -> None:
    words = ("scale=smoke", *ARM, "dataset=lerobot", "trainer=offline", f"dataset.root={demos}")
    check(settled(*words))
    with pytest.raises(UserError, match=message) as refused:
        check(settled(*words, *changes))
    assert "\n" not in str(refused.value)
    check(settled("scale=smoke", "env=none", "device=cpu", *words[-3:]))


def test_actions_that_would_be_scaled_are_refused_where_the_model_acts(
    demos: Path, settled, tmp_path: Path, monkeypatch
) -> None:
    words = ("scale=smoke", "device=cpu", "dataset=lerobot", "trainer=offline", f"dataset.root={demos}")
    for changes in (["dataset.normalize_actions=true"], []):
        with monkeypatch.context() as others:
            if not changes:
                others.setattr(opening, "map_features", others_features)
                with pytest.raises(UserError, match=r"replay\.demos=.*was not recorded by this package"):
                    check(settled("scale=smoke", *ARM, f"replay.demos={demos}"))
                other = ("env=dm_control", "env.name=walker", "env.task=run", f"replay.demos={demos}")
                with pytest.raises(UserError, match="only the arm has demonstrations"):
                    check(settled("scale=smoke", "device=cpu", *other))
            run = settled(*words, *ARM, *changes, "dataset.workers=1")
            with pytest.raises(UserError, match=r"would be scaled to \[−1, 1\].*use env=none") as refused:
                check(run)
            assert "\n" not in str(refused.value)
            with pytest.raises(UserError, match=r"would be scaled to"):  # also where no check was made
                build.open_recorded(run, torch.device("cpu"))
            check(settled(*words, "env=none", *changes))
            check(settled(*words, *ARM, "dataset.normalize_actions=false"))


def others_features(*given: Any, **options: Any) -> FeatureMap:
    """As if somebody else had recorded them."""
    return replace(map_features(*given, **options), ours=False)


@pytest.mark.parametrize(
    "there",
    [
        *({"camera_height": 0.7}, {"show_goal": True}, {"cameras": ["wrist", "front"]}, {"image_size": 32}),
        *({"scene": {"objects": []}}, {"scene": None, "task": "lift"}),
    ],
)
def test_a_model_that_sees_acts_where_it_sees_the_same(
    settled, tmp_path: Path, there: dict[str, Any]
) -> None:
    words = ("scale=smoke", "device=cpu", "dataset=lerobot", "trainer=offline", "dataset.root=there")
    words = (*words, "env=reach_pixels", "model=tdmpc2_pixels")
    run, source = settled(*words), cast("Source", SimpleNamespace(root=tmp_path))
    (tmp_path / PROVENANCE).parent.mkdir(parents=True)

    def recorded(**options: Any) -> None:
        written = {"sessions": [{"config": {"env": {**run.values["env"], **options}}}]}
        (tmp_path / PROVENANCE).write_text(json.dumps(written))

    recorded()
    _check_same_views(run, [("dataset.root=there", source)])
    recorded(**there)
    refused = pytest.raises(UserError, match=r"another env\.scene, so states show something else")
    with refused if "scene" in there else nullcontext():
        _check_same_views(run.changed(model={"observations": ["state"]}), [("dataset.root=there", source)])
    if "image_size" in there:  # as dataset.image_size makes it
        return _check_same_views(run, [("dataset.root=there", source)])
    other = rf"recorded with .*env\.{next(iter(there))}.*images show something else"
    with pytest.raises(UserError, match=other):
        _check_same_views(run, [("dataset.root=there", source)])
    chosen = settled(*words, "dataset.features={pixels: observation.images.front}")
    if "cameras" in there:
        _check_same_views(chosen, [("dataset.root=there", source)])
    return None


def test_ee_scale_gives_actions_of_the_tool_their_meaning() -> None:
    mine = {"action_mode": "ee_delta", "ee_scale": 0.05}

    def other(**recorded: Any) -> tuple[str, Any] | None:
        return other_option([{"config": {"env": recorded}}], mine, ACTIONS)

    assert other(action_mode="ee_delta", ee_scale=0.02) == ("ee_scale", 0.02)
    assert other(action_mode="ee_delta", ee_scale=0.05) is None
    assert other(action_mode="ee_delta") is None  # of an older dataset, which does not say it
    mine["action_mode"] = "joint_delta"  # reads it nowhere
    assert other(action_mode="joint_delta", ee_scale=0.02) is None


def test_rewards_of_another_task_are_said(demos: Path, settled, capsys) -> None:
    words = ("scale=smoke", *ARM, "dataset=lerobot", "trainer=offline", f"dataset.root={demos}")
    check(settled(*words))
    assert "recorded with" not in capsys.readouterr().out
    check(settled(*words, "env.reward=sparse"))
    assert "recorded with env.reward=dense, this run has sparse; its goals" in capsys.readouterr().out


def test_states_that_no_observation_shows_are_refused(pushes: Path, settled) -> None:
    words = (f"replay.demos={pushes}", "replay.demo_resets=0.5", "env.randomization.object_size=0.1")
    run = settled("scale=smoke", *GRIPPER, *words)
    with pytest.raises(
        UserError, match=r"this run has env\.randomization\.object_size=0.1, which no observation"
    ):
        check(run)


def test_the_runs_own_are_refused_whatever_the_dataset_says(pushes: Path, settled, tmp_path: Path) -> None:
    """Also where it says nothing: others' datasets have no provenance."""
    foreign = tmp_path / "foreign"
    shutil.copytree(pushes, foreign)
    (foreign / PROVENANCE).unlink()
    words = ("scale=smoke", *GRIPPER, f"replay.demos={foreign}", "replay.demo_resets=0.5")
    check_demonstrations(settled(*words))
    with pytest.raises(UserError, match=r"this run has env\.randomization\.object_size=0.1"):
        check_demonstrations(settled(*words, "env.randomization.object_size=0.1"))


@pytest.mark.parametrize(
    ("there", "changes", "message"),
    [
        (
            {"task": "drawer", "drawer_opening": 0.1},
            ("env=drawer", "env.action_scale=0.085"),
            "drawer_opening=0.1",
        ),
        ({"show_goal": True}, ("env=reach_pixels",), "recorded with env.show_goal=true, this run has false"),
        (
            {"cameras": ["wrist"]},
            ("env=reach_pixels",),
            r"recorded with env.cameras=\['wrist'\], this run has",
        ),
        ({"camera_height": 0.7}, ("env=reach_pixels",), "recorded with env.camera_height=0.7"),
        ({"image_size": 32}, ("env=reach_pixels",), "recorded with env.image_size=32"),
        ({"robot": "panda_meshes"}, (), "recorded with env.robot=panda_meshes"),
        ({"urdf_path": "/elsewhere/arm.urdf"}, (), "recorded with env.urdf_path=/elsewhere/arm.urdf"),
    ],
)
def test_other_rewards_and_other_images_are_refused(
    demos: Path, settled, tmp_path: Path, monkeypatch, there, changes, message
) -> None:
    """Of images where the model reads some; further cameras' have names of their own."""
    model = ("model=tdmpc2_pixels",) if "env=reach_pixels" in changes else ()
    run = settled("scale=smoke", *ARM, *changes, *model, f"replay.demos={tmp_path / 'demos'}")
    shutil.copytree(demos, tmp_path / "demos")
    own, source = Spaces.of_config(run.env.arm), SimpleNamespace(root=tmp_path / "demos")
    mapping = SimpleNamespace(ours=True, images=own.image_sizes, vectors=own.observation_sizes)
    monkeypatch.setattr(opening, "read_datasets", lambda *_, **__: ([source], [mapping]))

    def recorded(**options: Any) -> None:
        same = {**run.values["env"], **({"cameras": ["front", "side"]} if model else {})}
        written = {"sessions": [{"config": {"env": {**same, **options}}}]}
        (tmp_path / "demos" / PROVENANCE).write_text(json.dumps(written))

    recorded()
    check_demonstrations(run)
    recorded(**there)
    with pytest.raises(UserError, match=message):
        check_demonstrations(run)
    if model:
        check_demonstrations(run.changed(model={"observations": ["state"]}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (("env=lift",), r"/\S+: its actions have 7 numbers, the environment's 8"),
        (("env.fps=20",), r"/\S+ has 30 frames per second, the environment 20"),
        (("model.observations=[nothing]",), "gives no 'nothing'"),
    ],
)
def test_recorded_data_that_do_not_fit_are_refused_before_anything_is_built(
    demos: Path, settled, changes, message
) -> None:
    with pytest.raises(UserError, match=message):
        check(
            settled(
                "scale=smoke", "trainer=offline", "dataset=lerobot", f"dataset.root={demos}", *ARM, *changes
            )
        )


def test_demonstrations_of_another_scene_are_refused(pushes: Path, settled) -> None:
    """Its cubes would begin inside the table, for example."""
    words = ("scale=smoke", *GRIPPER, f"replay.demos={pushes}")
    check_demonstrations(settled(*words))
    larger = "env.scene={objects: [{name: cube, size: [0.08, 0.08, 0.08], at: [0.45, 0.0]}]}"
    with pytest.raises(UserError, match=r"replay\.demos=\S+: recorded with another env\.scene"):
        check_demonstrations(settled(*words, larger))
    check_demonstrations(
        settled(*words, "env.scene={objects: [{name: cube, size: [0.04, 0.04, 0.04], color: [0, 0, 1]}]}")
    )
