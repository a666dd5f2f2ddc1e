"""From the real environment to a dataset: collect, export, and what the command line refuses."""

from __future__ import annotations

import json
import os
import re
import signal
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torchrl.collectors import Collector

from franka_wm.commands.collect import open_source
from franka_wm.commands.demo import AGENT
from franka_wm.commands.main import main
from franka_wm.data.lerobot.collect import gather
from franka_wm.data.lerobot.export import export_replay
from franka_wm.data.lerobot.provenance import read_provenance
from franka_wm.data.lerobot.schema import (
    ACTION,
    DONE,
    EPISODE_KEY,
    GOAL,
    IMAGE_PREFIX,
    OBJECTS,
    REWARD,
    SEED,
    STATE,
    SUCCESS,
    TARGET,
    schema_for,
)
from franka_wm.data.lerobot.terminal import read_terminals
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.errors import UserError
from franka_wm.policies.scripted import SmoothRandomPolicy
from franka_wm.seeding import derive_seed
from franka_wm.training import load as load_module

SMALL = [
    "env=reach_fixed_pixels",
    "env.image_size=16",
    "env.substeps=2",
    "env.episode_length=6",
    "device=cpu",
]
FRONT = IMAGE_PREFIX + "front"


def column(dataset, name: str) -> np.ndarray:
    return np.asarray(dataset.hf_dataset.with_format("numpy")[name][:])


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    """12 episodes of 8 worlds, twice: in two sessions."""
    out = tmp_path_factory.mktemp("collected") / "set"
    arguments = ["collect", f"out={out}", "num_envs=8", "workers=1", "seed=5", *SMALL]
    assert main([*arguments, "episodes=12"]) == 0
    assert main([*arguments, "episodes=20", "resume=true", "policy=ik"]) == 0
    return out


def test_worlds_can_be_played_again(collected, load, small_env) -> None:
    """The first state follows from the feature ``seed``, the others from the actions, the end from the side file."""
    dataset = load(collected)
    assert (dataset.num_episodes, dataset.num_frames) == (20, 120)
    seeds = column(dataset, SEED).reshape(20, 6, 3)[:, 0]
    assert len({tuple(seed) for seed in seeds}) == 20
    assert sorted(seeds[:12, 1].tolist()) == [0, 0, 1, 1, 2, 2, 3, 3, 4, 5, 6, 7]
    assert set(seeds[:12, 0]) == {derive_seed("collection", 5, 0)}
    assert set(seeds[12:, 0]) == {derive_seed("collection", 5, 12)}
    config = {"observations": ("pixels", "state", "joint_target"), "image_size": 16, "episode_length": 6}
    settings = read_provenance(collected)["sessions"][0]["config"]["env"]  # pyright: ignore[reportOptionalSubscript]
    config |= {key: settings[key] for key in ("action_scale", "limit_velocity", "substeps")}
    env = small_env(8, seed=int(seeds[0, 0]), **config)
    state, action = (column(dataset, name).reshape(20, 6, -1) for name in (STATE, ACTION))
    reward, target = column(dataset, REWARD).reshape(20, 6), column(dataset, TARGET).reshape(20, 6, 7)
    keys = column(dataset, EPISODE_KEY).reshape(20, 6)[:, 0].tolist()
    features = dataset.meta.features
    terminal = read_terminals(
        collected,
        keys=keys,
        lengths=[6] * 20,
        features={name: features[name] for name in (STATE, FRONT, GOAL)},
    )
    assert terminal.problem is None
    first = {int(world): i for i, (_, world, number) in enumerate(seeds[:12]) if number == 0}
    order = [first[world] for world in range(8)]
    step = env.reset()
    for t in range(6):
        assert np.array_equal(step["state"].numpy(), state[order, t])
        assert np.array_equal(step["joint_target"].numpy(), target[order, t])
        for world, i in enumerate(order):
            shown = dataset[6 * i + t]
            picture = (shown[FRONT].numpy() * 255).round().astype(np.uint8).transpose(1, 2, 0)
            assert np.array_equal(picture, step["pixels"][world].numpy())
        step["action"] = torch.as_tensor(action[order, t])
        after = env.step(step)["next"]
        assert np.array_equal(after["reward"][:, 0].numpy(), reward[order, t])
        step = after.select("state", "joint_target", "goal", "pixels")
    assert np.array_equal(after["state"].numpy(), terminal.values[STATE][order])
    assert np.array_equal(after["pixels"].numpy(), terminal.values[FRONT][order])
    assert np.array_equal(after["goal"].numpy(), terminal.values[GOAL][order])
    done = column(dataset, DONE).reshape(20, 6)
    assert done[:, -1].all()
    assert not done[:, :-1].any()


def test_what_is_added_is_not_drawn_again(tmp_path, load) -> None:
    words = ["collect", f"out={tmp_path}/set", "num_envs=2", "workers=0", "env=reach", *SMALL[2:]]
    for episodes in (2, 4):
        assert main([*words, f"episodes={episodes}", "resume=true"]) == 0
    actions = column(load(tmp_path / "set"), ACTION).reshape(4, 6, -1)
    assert len(np.unique(actions[:, 0], axis=0)) == 4


def test_provenance_says_how(collected) -> None:
    provenance = read_provenance(collected)
    assert provenance is not None
    assert [(s["policy"], s["episodes"], s["seed"]) for s in provenance["sessions"]] == [
        ("random", 12, 5),
        ("ik", 8, 5),
    ]
    assert provenance["sessions"][0]["config"]["env"]["image_size"] == 16
    assert provenance["sessions"][0]["versions"]["newton"]


def test_what_is_changed_for_an_agent_is_played_and_told() -> None:
    """An option of a group, too; training from the dataset asks what it was recorded with."""
    overrides = ["device=cpu", "env.action_penalty=0.5", "env.randomization.action_noise=0.1"]
    source = open_source(str(AGENT), overrides=overrides, episodes=1)
    for options in (vars(source.env.config), source.config["env"]):
        assert options["action_penalty"] == 0.5
    assert source.env.config.randomization.action_noise == 0.1
    assert source.config["env"]["randomization"]["action_noise"] == 0.1


def test_an_agent_of_several_tasks_is_refused_in_one_line(monkeypatch) -> None:
    agent = SimpleNamespace(settings=SimpleNamespace(is_arm=False, env=SimpleNamespace(kind="multitask")))
    monkeypatch.setattr(load_module, "load_agent", lambda *_, **__: agent)
    with pytest.raises(
        UserError, match=r"acts in env\.kind='multitask': datasets are gathered from the arm with one"
    ):
        open_source(str(AGENT), overrides=["device=cpu"], episodes=1)


def test_the_same_seed_gives_the_same_dataset(collected, tmp_path, load) -> None:
    out = tmp_path / "again"
    assert main(["collect", f"out={out}", "num_envs=8", "workers=0", "seed=5", "episodes=12", *SMALL]) == 0
    again, before = load(out), load(collected)
    assert np.array_equal(column(again, EPISODE_KEY), column(before, EPISODE_KEY)[: 12 * 6])


def test_steps_of_discarded_episodes_are_counted_apart(tmp_path, load, capsys) -> None:
    words = [*SMALL, "num_envs=8", "workers=0", "seed=5", "env.success_distance=0.45", "success_only=true"]
    assert main(["collect", f"out={tmp_path}/set", "episodes=8", *words]) == 0
    told = re.search(r"episodes 8/8   steps (\d+) kept, (\d+) played", capsys.readouterr().out)
    assert told is not None and int(told[1]) == load(tmp_path / "set").num_frames == 48 < int(told[2])


def test_episodes_that_lost_contacts_are_left_out_and_told(tmp_path, load, capsys, monkeypatch) -> None:
    """Others are gathered instead; where there are none, it says so instead of going on for ever."""
    steps, always, step = 0, False, FrankaEnv._step

    def losing(env, tensordict):
        nonlocal steps
        steps += 1
        after = step(env, tensordict)
        after["overflow"][0] = always or steps == 3
        return after

    monkeypatch.setattr(FrankaEnv, "_step", losing)
    arguments = ["collect", "workers=1", "env=lift", "env.substeps=2", "env.episode_length=6", "device=cpu"]
    arguments += ["num_envs=1", "episodes=2", "env.observations=[state,objects]", "policy=random"]
    assert main([*arguments, f"out={tmp_path / 'set'}"]) == 0
    assert "1 episodes lost contacts and were left out" in capsys.readouterr().out
    assert sorted(set(column(load(tmp_path / "set"), SEED)[:, 2])) == [1, 2]
    always = True
    monkeypatch.setattr("franka_wm.data.lerobot.collect.HOPELESS", 3)
    assert main([*arguments, f"out={tmp_path / 'none'}"]) == 1
    assert "all of 3 episodes lost contacts" in capsys.readouterr().err


def test_ctrl_c_leaves_a_dataset(tmp_path, load) -> None:
    source = open_source("random", overrides=SMALL, num_envs=4, episodes=100_000)

    def interrupt() -> None:  # once it is under way, however long starting takes
        ends = time.monotonic() + 60
        while not any(tmp_path.iterdir()) and time.monotonic() < ends:
            time.sleep(0.05)
        time.sleep(1.0)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    out, whole = gather(source, out=tmp_path / "set", episodes=100_000, workers=0)
    thread.join()
    assert not whole
    dataset = load(out)
    assert 0 < dataset.num_episodes < 100_000
    assert dataset.num_frames == 6 * dataset.num_episodes


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["episodes=3"], "give out="),
        (["out=x", "episodes=none"], "must be a whole number"),
        (["out=x", "episodes=0"], "at least 1"),
        (["out=x", "policy=planner", "policy=ik"], "policy= is given twice"),
        (["out=x", "format=gif"], "must be one of exact, video"),
        (["out=x", "policy=planner"], "give checkpoint="),
        (
            ["out=x", "checkpoint=."],
            "checkpoint=. goes with policy=planner or policy=policy, and here policy=random acts",
        ),
        (["out=x", "policy=smooth"], "collect: policy=smooth: this policy is called random now"),
        (["out=x", "policy=nonsense"], "random, noop, ik, expert, or the folder of a run"),
        (
            ["out=x", "env=nonsense"],
            "env=nonsense: must be one of dm_control, drawer, ",
        ),
        (["out=x", "fmt=exact"], "fmt: no such option; there are out, episodes, policy, checkpoint, format"),
        (
            ["out=x", "env.imag_size=3"],
            "env.imag_size: no such option; did you mean env.image_size?",
        ),
        (["out=x", "seed=abc"], "seed=abc: must be a whole number"),
        (["out=x", "seed=null"], "seed=None: must be a whole number"),
        (["out=x", "seed=[1"], "no viable alternative"),
        (["out=x", "collector.num_envs=many"], "collector.num_envs=many: must be a whole number"),
        (["out=x", "collector.smoothness=very"], "collector.smoothness=very: must be a number"),
        (["out=x", "policy=.", "seed=abc"], "seed=abc: must be a whole number"),
        (["out=x", "policy=.", "env.goal=[1"], "is not a value as in YAML"),
        (["out=x", "env.fps=29.97"], "whole frames"),
        (["out=x", "env.observations=[depth]"], "depth has no place"),
        (
            ["out=x", "policy=expert", "noise=1e300"],
            "noise=1e300: must be a finite number above 0, at most 2",
        ),
        (["out=x", "policy=expert"], "policy=expert: task=reach has none; env=lift has one"),
        (["out=x", "policy=ik", "env=lift"], "policy=ik: brings the tool to the goal and knows no gripper"),
        (
            ["out=x", "episodes=1000000000", "num_envs=1000000000", "device=cpu"],
            "num_envs=1000000000: at least 10000.0 GB do not fit",
        ),
        (["out=x", "rubbish"], "'rubbish': write options as name=value"),
    ],
)
def test_bad_arguments_are_one_line(arguments, says, capsys, tmp_path, monkeypatch) -> None:
    (tmp_path / "checkpoints").mkdir()  # "." is the folder of a run
    monkeypatch.chdir(tmp_path)
    assert main(["collect", *arguments]) == 1
    said = capsys.readouterr()
    error = said.err.strip()
    assert says in error and "building" not in said.out  # refused before that
    assert error.count("\n") == 0
    for noise in ("provider=", "search path", "append", "hydra.cc"):
        assert noise not in error
    assert [one.name for one in tmp_path.rglob("*")] == ["checkpoints"]  # nothing was made


# -- a replay ----------------------------------------------------------------------------------------------------


def replay_of(env, steps: int):
    """(worlds, time) with what a trainer keeps."""
    policy = SmoothRandomPolicy(7, generator=torch.Generator().manual_seed(0))
    options = {"frames_per_batch": env.num_envs * steps, "total_frames": -1, "track_traj_ids": False}
    batch = next(iter(Collector(env, policy, **options)))
    pictures = [key for key in batch.keys() if str(key).startswith(("pixels", "goal_pixels"))]  # noqa: SIM118
    keys = [key for key in ("state", "joint_target", *pictures) if key in batch.keys()]  # noqa: SIM118
    return batch.select(*keys, "action", "is_init", *(("next", k) for k in (*keys, "reward", "terminated")))


@pytest.mark.parametrize("frame_stack", [1, 3])
def test_a_replay_comes_back_bit_for_bit(tmp_path, load, small_env, frame_stack: int) -> None:
    """Of stacks, the newest picture."""
    env = small_env(
        3,
        observations=("pixels", "goal_pixels", "state", "joint_target"),
        cameras=("front", "side"),
        image_size=16,
        episode_length=7,
        frame_stack=frame_stack,
    )
    data = replay_of(env, 25)
    done = export_replay(
        data[:, 3:], config=env.config, out=tmp_path / "set", seed=9, policy="p", settings={}, workers=0
    )
    assert (done.episodes, done.frames, done.partial) == (6, 42, 6)
    dataset = load(done.out)
    terminal = read_terminals(
        done.out,
        keys=column(dataset, EPISODE_KEY).reshape(6, 7)[:, 0].tolist(),
        lengths=[7] * 6,
        features={name: dataset.meta.features[name] for name in (STATE, FRONT)},
    )
    seeds = column(dataset, SEED).reshape(6, 7, 3)[:, 0]
    for i, (world, begin) in enumerate(((0, 7), (1, 7), (2, 7), (0, 14), (1, 14), (2, 14))):
        part = data[world, begin : begin + 7]
        assert list(seeds[i]) == [9, world, -1]
        rows = slice(7 * i, 7 * i + 7)
        for name, key in ((STATE, "state"), (ACTION, "action"), (TARGET, "joint_target")):
            assert np.array_equal(column(dataset, name)[rows], part[key].numpy())
        assert np.array_equal(column(dataset, REWARD)[rows], part["next", "reward"][:, 0].numpy())
        for camera, key in (("front", "pixels"), ("side", "pixels_side"), ("goal_side", "goal_pixels_side")):
            pictures = [
                (dataset[j][IMAGE_PREFIX + camera].numpy() * 255).round() for j in range(7 * i, 7 * i + 7)
            ]
            assert np.array_equal(np.stack(pictures).transpose(0, 2, 3, 1), part[key][..., -3:].numpy())
        assert np.array_equal(terminal.values[STATE][i], part["next", "state"][-1].numpy())
        assert np.array_equal(terminal.values[FRONT][i], part["next", "pixels"][-1][..., -3:].numpy())
    np.testing.assert_allclose(column(dataset, GOAL), np.tile(env.config.goal, (42, 1)), atol=1e-6)
    assert column(dataset, SUCCESS).dtype == bool


def test_success_is_that_of_the_task(tmp_path, load) -> None:
    """Not the tool's distance to the goal, where the task is about something else; nor anything that was not kept."""
    config = FrankaConfig(task="push", substeps=2, episode_length=5, observations=("state", "objects"))
    env = FrankaEnv(config, num_envs=2, device="cpu")
    policy = SmoothRandomPolicy(8, generator=torch.Generator().manual_seed(0))
    options = {"frames_per_batch": 10, "total_frames": -1, "track_traj_ids": False}
    data = next(iter(Collector(env, policy, **options)))
    data["next", "success"][:] = torch.tensor([[0, 0, 0, 0, 1], [0, 1, 0, 0, 0]], dtype=torch.bool).unsqueeze(
        -1
    )
    far = data["next", "state"][..., 17:20]
    far[:] = 0.0  # the tool is at the goal
    keys = ("state", "objects", "goal", "reward", "terminated")
    for name, kept in (("with", (*keys, "success")), ("without", keys)):
        part = data.select("state", "objects", "goal", "action", "is_init", *(("next", key) for key in kept))
        done = export_replay(
            part, config=config, out=tmp_path / name, seed=0, policy="p", settings={}, workers=0
        )
        dataset = load(done.out)
        assert np.array_equal(column(dataset, OBJECTS), data["objects"].flatten(0, 1).numpy())
        assert (SUCCESS in dataset.features) == (name == "with")
    success = column(load(tmp_path / "with"), SUCCESS)
    assert np.array_equal(success.ravel(), data["next", "success"].numpy().ravel())


def test_a_replay_without_whole_episodes_is_refused(tmp_path, small_env) -> None:
    env = small_env(2, episode_length=50)
    with pytest.raises(UserError, match="no whole episode of 50 steps, only 2 partial"):
        export_replay(
            replay_of(env, 5),
            config=env.config,
            out=tmp_path / "set",
            seed=0,
            policy="p",
            settings={},
            workers=0,
        )
    assert list(tmp_path.iterdir()) == []


def test_export_of_a_run_without_replay_is_one_line(tmp_path, capsys) -> None:
    from omegaconf import OmegaConf

    from franka_wm.training.checkpoint import save_checkpoint

    config = OmegaConf.create({"seed": 0, "env": {"kind": "franka"}})
    save_checkpoint(tmp_path / "run", model=torch.nn.Linear(2, 2), config=config, counters={})
    assert main(["export", f"source={tmp_path / 'run'}", f"out={tmp_path / 'set'}"]) == 1
    assert "without its replay" in capsys.readouterr().err


def test_a_saved_replay_is_exported(tmp_path, load, small_env) -> None:
    from omegaconf import OmegaConf

    from franka_wm.training.checkpoint import save_checkpoint

    env = small_env(2, episode_length=5)
    config = {
        "seed": 3,
        "env": {"kind": "franka", "urdf_path": None, "episode_length": 5, "observations": ["state"]},
    }
    save_checkpoint(
        tmp_path / "run" / "checkpoints" / "latest",
        model=torch.nn.Linear(2, 2),
        config=OmegaConf.create(config),
        counters={},
        replay=replay_of(env, 12),
    )
    out = tmp_path / "set"
    assert main(["export", f"source={tmp_path / 'run'}", f"out={out}", "workers=0"]) == 0
    assert load(out).num_episodes == 4
    assert json.loads((out / "meta/franka_wm/provenance.json").read_text())["sessions"][0]["seed"] == 3


@pytest.mark.parametrize("own", [False, True], ids=["judged by distance", "judged by itself"])
def test_the_replay_of_a_run_of_an_own_task_is_exported_with_its_plugin(
    own: bool, tmp_path, load, small_env, capsys, monkeypatch
) -> None:
    from omegaconf import OmegaConf

    from franka_wm.envs.tasks import _REGISTERED
    from franka_wm.training.checkpoint import save_checkpoint

    (tmp_path / "brought_by_a_plugin.py").write_text(
        "from franka_wm.envs.tasks import Reach, register\n"
        "class Near(Reach):\n"
        "    goal_distance = True\n"
        + "    reward_and_success = lambda self, sim: None\n" * own
        + "register('near', Near)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))  # taken out again afterwards
    monkeypatch.setattr("franka_wm.envs.tasks._REGISTERED", dict(_REGISTERED))
    env = {
        "kind": "franka",
        "urdf_path": None,
        "task": "near",
        "episode_length": 5,
        "observations": ["state"],
    }
    save_checkpoint(
        tmp_path / "run" / "checkpoints" / "latest",
        model=torch.nn.Linear(2, 2),
        config=OmegaConf.create({"seed": 3, "plugins": ["brought_by_a_plugin"], "env": env}),
        counters={},
        replay=replay_of(small_env(2, episode_length=5), 12),
    )
    command = ["export", "source=run", "out=set", "workers=0"]
    assert main(command) == 1 and "plugins=[MODULE]" in capsys.readouterr().err
    assert main([*command, "plugins=[brought_by_a_plugin]"]) == 0
    dataset = load(tmp_path / "set")
    assert dataset.num_episodes == 4
    assert (SUCCESS in dataset.features) is not own, "a replay without it cannot tell how the task judged"


def test_schemas_of_several_cameras() -> None:
    from franka_wm.envs import FrankaConfig

    config = FrankaConfig(observations=("pixels", "goal_pixels", "state"), cameras=("wrist", "front"))
    schema = schema_for(config)
    assert {name: schema.sources[name] for name in schema.images} == {
        IMAGE_PREFIX + "wrist": "pixels",
        IMAGE_PREFIX + "front": "pixels_front",
        IMAGE_PREFIX + "goal": "goal_pixels",
        IMAGE_PREFIX + "goal_front": "goal_pixels_front",
    }
