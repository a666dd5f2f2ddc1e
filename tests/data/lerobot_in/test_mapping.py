"""Which feature becomes which entry: by convention, by name, and what is refused."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from franka_wm.data.lerobot.mapping import map_features
from franka_wm.data.lerobot.schema import PROVENANCE
from franka_wm.data.lerobot.source import Source, read_source
from franka_wm.errors import UserError

VECTOR = {"dtype": "float32", "shape": [2], "names": None}
PICTURE = {"dtype": "image", "shape": [8, 10, 3], "names": ["height", "width", "channels"]}
OURS = {
    "seed": {"dtype": "int64", "shape": [3]},
    "episode_key": {"dtype": "int64", "shape": [1]},
    "joint_target": {"dtype": "float32", "shape": [7]},
    "observation.environment_state": {"dtype": "float32", "shape": [3]},
}


def source(features: dict) -> Source:
    """Metadata only."""
    return Source(Path("/data/x"), {"fps": 10, "features": features}, *[np.zeros(1)] * 2, {}, {})


def test_by_convention() -> None:
    mapping = map_features(
        source(
            {
                "observation.images.goal": PICTURE,
                "observation.images.top": PICTURE,
                "observation.images.hand": {**PICTURE, "shape": [3, 8, 10], "names": ["channels", "height", "width"]},
                "observation.images.depth": {**PICTURE, "shape": [8, 10, 1], "info": {"is_depth_map": True}},
                "observation.state": VECTOR,
                "observation.environment_state": VECTOR,
                "observation.arm.left": VECTOR,
                "observation.map": {"dtype": "float32", "shape": [4, 4]},
                "observation.words": {"dtype": "string", "shape": [1]},
                "action": VECTOR,
                "next.reward": {"dtype": "float32", "shape": [1]},
                "timestamp": {"dtype": "float32", "shape": [1]},
                "note": VECTOR,
            }
        )
    )  # fmt: skip
    assert mapping.images == {
        "goal_pixels": ("observation.images.goal", (8, 10, 3)),
        "pixels": ("observation.images.top", (8, 10, 3)),
        "pixels_hand": ("observation.images.hand", (8, 10, 3)),
    }
    assert {key: size for key, (_, size) in mapping.vectors.items()} == {
        "state": 2,
        "environment_state": 2,
        "arm_left": 2,
    }
    assert mapping.action == (("action",), 2) and not mapping.discrete and not mapping.ours
    assert mapping.after == {"reward": "next.reward"}
    notes = " ".join(mapping.notes)
    assert all(name in notes for name in ("depth", "observation.map", "observation.words"))


def test_a_dataset_of_this_package() -> None:
    mapping = map_features(source({"observation.state": VECTOR, "action": VECTOR, **OURS}))
    assert mapping.ours
    assert set(mapping.vectors) == {"state", "goal", "joint_target"}


def test_an_image_is_called_what_it_was_called_when_recorded(tmp_path: Path) -> None:
    """Also where the first camera is not there; of older datasets, and of others, the first image is ``pixels``."""
    wrist = "observation.images.wrist"
    data = source({wrist: PICTURE, "action": VECTOR, **OURS})
    assert map_features(data).images == {"pixels": (wrist, (8, 10, 3))}
    (tmp_path / PROVENANCE).parent.mkdir(parents=True)
    data = replace(data, root=tmp_path)
    for said, key in (
        ({"sources": {wrist: "pixels_wrist"}}, "pixels_wrist"),
        ({"sources": {wrist: "action"}}, "pixels"),
        (None, "pixels"),
    ):
        (tmp_path / PROVENANCE).write_text(json.dumps({"sessions": [], "schema": said}))
        assert map_features(data).images == {key: (wrist, (8, 10, 3))}
    (tmp_path / PROVENANCE).write_text(json.dumps({"schema": {"sources": [3]}}))
    with pytest.raises(UserError, match="another form than was written"):
        map_features(data)
    others = {name: one for name, one in data.features.items() if name != "seed"}
    assert not map_features(replace(data, info={"fps": 10, "features": others})).ours


def test_discrete_actions() -> None:
    mapping = map_features(source({"observation.state": VECTOR, "action": {"dtype": "int64", "shape": [1]}}))
    assert mapping.discrete


def test_without_a_reward_what_learns_from_it_is_refused() -> None:
    features = {"observation.state": VECTOR, "points": {"dtype": "float32", "shape": [1]}, "action": VECTOR}
    assert any("no reward" in note for note in map_features(source(features)).notes)
    with pytest.raises(UserError, match=r"no reward, which model=tdmpc2 learns from.*points") as error:
        map_features(source(features), rewards_for="model=tdmpc2")
    assert "\n" not in str(error.value)
    named = {"state": "observation.state", "reward": "points"}
    assert map_features(source(features), features=named, rewards_for="x").after == {"reward": "points"}


def test_only_what_is_needed() -> None:
    features = {"observation.images.top": PICTURE, "observation.state": VECTOR, "action": VECTOR}
    mapping = map_features(source(features), keys=["state"])
    assert not mapping.images and set(mapping.vectors) == {"state"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"keys": ["pixels"]},
            "no 'pixels'.* observations there: state.*observation.state, words, map, action",
        ),
        ({"features": {"state": "observation.pose"}}, "no such feature; there are observation.state"),
        ({"features": {"state": "words"}}, "must be a vector of numbers; it is string"),
        ({"features": {"state": "map"}}, r"it is float32 \(4, 4\)"),
        ({"features": {"state": 3}}, "a feature's name, or a list of names"),
        ({"features": {"is_init": "observation.state"}}, "cannot have this name"),
        ({"features": {"state": "observation.state", "reward": "action"}}, "single number per row"),
        ({"features": {"reward": "next.reward"}}, "no observation that can be used"),
        ({"image_size": 0}, "must be a number of pixels"),
        ({"image_size": [3, 4, 5]}, "must be a number of pixels"),
    ],
)
def test_refused(options: dict, message: str) -> None:
    features = {
        "observation.state": VECTOR,
        "words": {"dtype": "string", "shape": [1]},
        "map": {"dtype": "float32", "shape": [4, 4]},
        "action": VECTOR,
        "next.reward": {"dtype": "float32", "shape": [1]},
    }
    with pytest.raises(UserError) as error:
        map_features(source(features), **options)
    assert re.search(message, str(error.value)), error.value
    assert "\n" not in str(error.value)


def test_no_actions() -> None:
    with pytest.raises(UserError, match=r"features\.action=action"):
        map_features(source({"observation.state": VECTOR}))


def test_named_and_joined(pictures: Path, foreign, opened: Callable) -> None:
    """Two vectors as one state, one of two cameras, and the values are those recorded."""
    windows = opened(
        pictures,
        features={
            "pixels": "observation.images.side",
            "state": ["observation.gripper", "observation.joints"],
            "terminated": "next.done",
        },
    )
    assert windows.observation_sizes == {"state": 3} and windows.image_sizes == {"pixels": (32, 32, 3)}
    for batch in windows.batches(1):
        for step in batch[0]:
            gripper, episode, frame = (int(v) for v in step["state"])
            assert gripper == frame % 2
            assert np.array_equal(step["pixels"], foreign.picture(episode, frame, 1))
            last = frame == (5, 4, 7)[episode] - 1
            assert bool(step["next", "terminated"]) == last


def test_resized(pictures: Path, opened: Callable) -> None:
    windows = opened(pictures, image_size=16)
    assert windows.image_sizes["pixels"] == (16, 16, 3)
    small, large = windows.windows(torch.arange(4)), opened(pictures).windows(torch.arange(4))
    averaged = large["pixels"].float().unflatten(2, (16, 2)).unflatten(4, (16, 2)).mean((3, 5))
    assert (small["pixels"].float() - averaged).abs().mean() < 1.5
    assert opened(pictures, image_size=(8, 24)).image_sizes["pixels"] == (8, 24, 3)


def test_terminated_where_it_is_not_recorded(foreign, tmp_path: Path, opened: Callable) -> None:
    """Done with success: an end; done alone: cut off by time. Only the first episode ends with success."""
    root = foreign.make_foreign(tmp_path / "a", pictures=False)
    batch = next(opened(root, window=1).batches(100))
    assert not batch["next", "terminated"].any()  # the last action of an episode is in no window here
    batch = next(
        opened(root, window=1, features={"joints": "observation.joints", "terminated": "next.done"}).batches(
            9
        )
    )
    assert batch["next", "terminated"].shape == (9, 1, 1)
    root = foreign.make_foreign(tmp_path / "b", pictures=False, after=())
    batch = next(opened(root).batches(4))
    assert set(batch["next"].keys()) == {"joints", "gripper"}


def test_metadata(pictures: Path) -> None:
    read = read_source(pictures)
    assert read.lengths.tolist() == [5, 4, 7] and read.fps == 10
