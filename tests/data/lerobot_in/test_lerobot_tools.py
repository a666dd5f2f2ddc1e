"""What people run on a LeRobot dataset, on one that was written here: LeRobot's own command-line tools."""

from __future__ import annotations

import importlib.util
import json
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_tools import Tools

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def tools(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Tools]:
    """LeRobot's programs, offline and away from the user's own data."""
    home = tmp_path_factory.mktemp("home")
    homes = {"HF_HOME": str(home / "hf"), "HF_LEROBOT_HOME": str(home / "lerobot")}
    programs = Tools(os.environ | homes | {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"})
    yield programs
    programs.close()


@pytest.fixture
def tool(tools: Tools, tmp_path: Path) -> Callable[..., str]:
    """Runs one of them in the test's folder; what it said."""
    return partial(tools, tmp_path)


def states(windows: Any) -> np.ndarray:
    """The states that windows start with, in order."""
    return np.concatenate([batch["state"][:, 0] for batch in windows.batches()])


def test_edit_dataset(exact: Any, tool: Callable, tmp_path: Path, opened: Callable) -> None:
    """info, split, delete_episodes, merge; and what comes out can be trained on."""
    here = ("--repo_id=me/reach", f"--root={exact.root}")
    edit = "lerobot-edit-dataset"
    said = tool(edit, *here, "--operation.type=info")
    assert "Total episode: 9" in said and "Total frame(Actual Count): 54(54)" in said
    splits = '{"train": [0, 1, 2, 3, 4, 5], "val": [6, 7, 8]}'
    tool(
        edit,
        *here,
        f"--new_root={tmp_path / 'split'}",
        "--operation.type=split",
        f"--operation.splits={splits}",
    )
    whole = opened(exact.root, window=1, keys=["state", "pixels"])
    part = opened(tmp_path / "split" / "val", window=1, keys=["state", "pixels"])
    # Their tools drop our side files: of 6 actions the last is left out, and it is said.
    assert len(part.episodes) == 3 and len(part) == 3 * 5
    assert any("no terminal observation" in note for note in part.notes)
    wanted = states(whole).reshape(9, 6, 20)
    assert np.array_equal(states(part).reshape(3, 5, 20), wanted[6:, :5])
    tool(
        edit,
        *here,
        "--new_repo_id=me/less",
        f"--new_root={tmp_path / 'less'}",
        "--operation.type=delete_episodes",
        "--operation.episode_indices=[1, 5]",
    )
    less = opened(tmp_path / "less", window=1, keys=["state", "pixels"])
    kept = np.delete(wanted, [1, 5], 0)[:, :5]
    assert np.array_equal(states(less).reshape(7, 5, 20), kept)
    tool(
        edit,
        "--new_repo_id=me/both",
        f"--new_root={tmp_path / 'both'}",
        "--operation.type=merge",
        "--operation.repo_ids=['me/less', 'me/val']",
        f"--operation.roots=['{tmp_path / 'less'}', '{tmp_path / 'split' / 'val'}']",
    )
    both = opened(tmp_path / "both", window=1, keys=["state", "pixels"])
    assert np.array_equal(states(both).reshape(10, 5, 20), np.concatenate([kept, wanted[6:, :5]]))
    pictures = {tuple(b["state"][0, 0].tolist()): b["pixels"] for b in whole.batches(1)}
    for batch in both.batches(1):
        assert np.array_equal(batch["pixels"], pictures[tuple(batch["state"][0, 0].tolist())])


def test_dataset_viz(exact: Any, tool: Callable, tmp_path: Path) -> None:
    if importlib.util.find_spec("rerun") is None:
        pytest.skip("lerobot-dataset-viz needs rerun-sdk: pip install 'franka-wm[rerun]'")
    options = ("--episode-index=0", "--save=1", f"--output-dir={tmp_path}", "--num-workers=0")
    tool("lerobot-dataset-viz", "--repo-id=me/reach", f"--root={exact.root}", *options)
    (recording,) = tmp_path.glob("*.rrd")
    assert recording.stat().st_size > 10_000


SMALL_ACT = (
    "--policy.pretrained_backbone_weights=null",
    "--policy.chunk_size=4",
    "--policy.n_action_steps=4",
    "--policy.dim_model=64",
    "--policy.n_heads=2",
    "--policy.dim_feedforward=64",
    "--policy.n_encoder_layers=1",
)


SMALL_TDMPC = ("--policy.n_gaussian_samples=16", "--policy.n_pi_samples=4", "--policy.n_elites=4")
RENAME = '--rename_map={"observation.images.front": "observation.image"}'


@pytest.mark.parametrize(
    ("kind", "options"), [("act", SMALL_ACT), ("tdmpc", SMALL_TDMPC)], ids=["act", "tdmpc"]
)
def test_train_and_evaluate(kind: str, options: tuple, exact: Any, tool: Callable, tmp_path: Path) -> None:
    """Two steps of lerobot-train on an export; lerobot-eval of the result on the arm that it was recorded with."""
    if importlib.util.find_spec("accelerate") is None:
        pytest.skip("lerobot-train needs its extra: pip install 'franka-wm[lerobot-train]'")
    out = tmp_path / kind
    tool(
        "lerobot-train",
        "--dataset.repo_id=me/reach",
        f"--dataset.root={exact.root}",
        f"--policy.type={kind}",
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        "--num_workers=0",
        "--batch_size=2",
        "--steps=2",
        "--save_freq=2",
        "--env_eval_freq=0",
        f"--output_dir={out}",
        *options,
    )
    policy = out / "checkpoints" / "last" / "pretrained_model"
    inputs = json.loads((policy / "config.json").read_text())["input_features"]
    assert set(inputs) == {"observation.images.front", "observation.state", "observation.environment_state"}
    acting: tuple[str, ...] = ()
    if kind == "tdmpc":
        # LeRobot 0.6's TD-MPC trains on a camera of any name, but acts only on one called observation.image: it keeps
        # the picture under that name and looks for it under the camera's. Renaming it in the policy is the way around.
        config = policy / "config.json"
        config.write_text(config.read_text().replace("observation.images.front", "observation.image"))
        acting = (RENAME,)
    tool(
        "lerobot-eval",
        f"--policy.path={policy}",
        "--policy.device=cpu",
        "--env.discover_packages_path=franka_wm.data.lerobot_env",
        "--env.type=franka_wm",
        f"--env.dataset={exact.root}",
        "--env.device=cpu",
        "--eval.batch_size=2",
        "--eval.n_episodes=2",
        "--eval.use_async_envs=false",
        f"--output_dir={tmp_path / 'evaluation'}",
        *acting,
    )
    result = json.loads((tmp_path / "evaluation" / "eval_info.json").read_text())
    overall = result["overall"]
    assert overall["n_episodes"] == 2 and np.isfinite(overall["avg_sum_reward"])
    # Six steps of −tanh(distance): between six metres away and on the spot.
    assert -6 < overall["avg_sum_reward"] < 0
