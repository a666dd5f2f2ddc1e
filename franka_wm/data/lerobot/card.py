"""The page that a published dataset or model shows: what it is, how it came about, how to use it."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, metadata
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from huggingface_hub import DatasetCard, DatasetCardData, ModelCard, ModelCardData

from franka_wm.data.lerobot.decode import video_frames
from franka_wm.data.lerobot.paths import without_paths
from franka_wm.data.lerobot.provenance import read_provenance
from franka_wm.data.lerobot.schema import OWN_FOLDER, PROVENANCE
from franka_wm.data.lerobot.source import Source, read_source
from franka_wm.data.lerobot.terminal import TERMINAL_FOLDER
from franka_wm.errors import UserError
from franka_wm.untrusted import linked_json, values_of

IMAGE = f"{OWN_FOLDER}/episode.gif"
_CITATION = """```bibtex
@software{franka_wm,
  title  = {franka_wm: latent world models of a simulated Franka arm},
  author = {franka_wm contributors},
  year   = {2026},
}
```"""


FILM = "video.mp4"
"""Video of a published model's episodes, in its folder."""
VISUALIZER = "https://huggingface.co/spaces/lerobot/visualize_dataset?path="
"""LeRobot's page that plays the episodes of a public dataset."""

UNITS = {
    "observation.state": "rad, rad/s, m (and quaternions)",
    "observation.environment_state": "m",
    "action": "−1 to 1",
    "joint_positions": "rad",
    "tool_position": "m",
    "joint_target": "rad",
    "objects": "m, quaternions, m/s, rad/s",
    "timestamp": "s",
}
"""Unit of each feature that has one, in datasets of this project."""


def _project() -> str:
    """The project's name; a link where the installed package knows its address."""
    with contextlib.suppress(PackageNotFoundError):
        for entry in metadata("franka-wm").get_all("Project-URL") or []:
            label, _, address = entry.partition(", ")
            if label == "Source":
                return f"[franka_wm]({address})"
    return "franka_wm"


def dataset_card(root: Path, *, repo_id: str, license: str) -> str:
    """README.md of a dataset.

    Args:
        root: The dataset.
        repo_id: Where it goes.
        license: Identifier, as the Hub knows them (``apache-2.0``, ``cc-by-4.0``, …).
    """
    info = linked_json(root / "meta" / "info.json")
    provenance = read_provenance(root)
    try:
        task, gathered = (
            ("", "") if provenance is None else (provenance["schema"]["task"], _gathered(provenance))
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{root / PROVENANCE} is not a provenance of franka_wm ({error!r}); copy the dataset again"
        ) from error
    robot = f"of `{info['robot_type']}`" if info.get("robot_type") else "of a robot"
    own = "A [LeRobot](https://github.com/huggingface/lerobot) dataset (v3.0)"
    settings = cite = ""
    tags = ["LeRobot"]
    if provenance is not None:
        robot = f"of a simulated {info.get('robot_type')} arm"
        own += f", gathered with {_project()} in NVIDIA Newton"
        settings = f"\n\nSettings in full: [{PROVENANCE}]({PROVENANCE})."
        cite = f"\n## Citation\n\n{_CITATION}\n"
        tags += ["franka", "simulation", "world-model"]
    rows = "Row t is (o_t, a_t, and what followed a_t)."
    if (root / TERMINAL_FOLDER).is_dir():
        rows += (
            " The observation after the last action of each episode is in\n"
            f"`{TERMINAL_FOLDER}`, found by `episode_key`."
        )
    head = DatasetCardData(
        license=license,
        task_categories=["robotics"],
        tags=tags,
        configs=[{"config_name": "default", "data_files": "data/*/*.parquet"}],
    )
    units = {name: UNITS.get(name, "") for name in info["features"]} if provenance is not None else {}
    image = f"\n![One episode]({IMAGE})\n" if (root / IMAGE).is_file() else ""
    table = "\n".join(
        f"| `{name}` | {one['dtype']} | {tuple(one['shape'])} | {units.get(name, '')} | {_names(one.get('names'))} |"
        for name, one in info["features"].items()
    )
    text = f"""
# {repo_id.split("/")[-1]}

{info["total_episodes"]} episodes, {info["total_frames"]} steps at {info["fps"]} Hz {robot}.
{f"{task} " if task else ""}{own}.
{image}
## How it was gathered

{gathered or "Not recorded."}{settings}

## Use it

Watch the episodes, once the dataset is public: [visualizer]({VISUALIZER}{repo_id}).

```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("{repo_id}")
```

```bash
franka-wm train dataset=lerobot trainer=offline env=none dataset.repo_id={repo_id}   # a world model
```

## What a row holds

{rows}

| feature | dtype | shape | unit | names |
|---|---|---|---|---|
{table}

## License

{license}
{cite}"""
    return str(DatasetCard(f"---\n{head}\n---\n{text}"))


def _gathered(provenance: Mapping[str, Any]) -> str:
    return "\n".join(
        f"- {one['episodes']} episodes by `{one['policy']}`, seed {one['seed']}, {one['date']}, "
        f"franka-wm {one['versions'].get('franka-wm')}:\n\n  ```bash\n  {one['command']}\n  ```"
        for one in without_paths(provenance["sessions"])
    )


def _names(names: Any) -> str:
    if not isinstance(names, list):
        return ""
    names = [str(name) for name in names]
    return ", ".join(names) if len(names) <= 7 else f"{names[0]}, … {names[-1]} ({len(names)})"


def make_image(root: Path, out: Path, *, frames: int = 60, side: int = 320) -> None:
    """The first episode as an endless animation (.gif) at its own pace; nothing without images.

    Args:
        root: The dataset.
        out: Where the image goes.
        frames: At most so many, evenly spaced.
        side: Larger images are thinned out to at most this width and height [px].
    """
    import torch

    from franka_wm.video import write_gif

    source = read_source(root)
    kinds = {
        name: feature["dtype"]
        for name, feature in source.features.items()
        if feature["dtype"] in ("image", "video")
    }
    if not kinds:
        return
    name, kind = next(iter(kinds.items()))
    with values_of(str(root), "copy or download the dataset again"):
        episode = _first_episode(source, name, kind)
    every, thin = -(-len(episode) // frames), -(-max(episode.shape[1:3]) // side)
    shown = torch.from_numpy(np.ascontiguousarray(episode[::every, ::thin, ::thin]))
    out.parent.mkdir(parents=True, exist_ok=True)
    write_gif(shown, out, max(1, round(source.fps / every)))


def _first_episode(source: Source, name: str, kind: str) -> np.ndarray:
    """(T, H, W, 3) uint8."""
    import pyarrow.parquet as pq

    from franka_wm.data.lerobot.png import decode_image

    if kind == "image":
        data = source.data_path(*source.data_files[0].tolist())
        group = pq.ParquetFile(data).read_row_group(0, columns=[name, "episode_index"])
        rows = zip(group[name].to_pylist(), group["episode_index"].to_pylist(), strict=True)
        return np.stack([decode_image(cell["bytes"]) for cell, episode in rows if episode == 0])
    video = source.video_path(name, *source.video_files[name][0].tolist())
    frames = islice(video_frames(video), int(source.lengths[0]))
    return np.stack([frame.to_ndarray(format="rgb24") for frame, _ in frames])


def model_card(folder: Path, *, repo_id: str, license: str, acting: str | None = "planner") -> str:
    """README.md of a trained model.

    Args:
        folder: The files that are published; has ``config.yaml`` and ``counters.json``, and ``evaluation.md`` if it
            was evaluated.
        repo_id: Where it goes.
        license: Identifier.
        acting: The policy that its use shows; ``None`` for an encoder alone, which has none.
    """
    from omegaconf import DictConfig, OmegaConf

    cfg = OmegaConf.load(folder / "config.yaml")
    if not isinstance(cfg, DictConfig):
        raise UserError(f"{folder / 'config.yaml'} is not a configuration")
    counters = linked_json(folder / "counters.json")
    evaluation = folder / "evaluation.md"
    table = evaluation.read_text(encoding="utf-8") if evaluation.is_file() else "Not evaluated."
    if acting is None and evaluation.is_file():
        table = f"An encoder does not act: these policies need no model.\n\n{table}"
    if (folder / FILM).is_file():
        place = f"https://huggingface.co/{repo_id}/resolve/main/{FILM}"
        table = f'<video src="{place}" autoplay loop muted controls></video>\n\n{table}'
    head = ModelCardData(
        license=license,
        library_name="franka_wm",
        tags=[
            "encoder" if acting is None else "world-model",
            *(["robotics", "franka"] if cfg.env.kind in ("franka", "multitask") else []),
            str(cfg.model.name),
        ],
    )
    name = cfg.model.name
    what = f"An encoder ({name}) for images" if acting is None else f"A latent world model ({name})"
    recorded = (cfg.get("dataset") or {}).get("kind", "none") != "none"
    seen = " on recorded episodes" if recorded else f", {counters.get('env_steps', 0):,} environment steps"
    text = f"""
# {repo_id.split("/")[-1]}

{what} of {_world(cfg.env)}, trained with {_project()}:
{counters.get("updates", 0):,} updates{seen}, seed {cfg.seed}.

## Evaluation

{table}

## Use it

```python
{_use(None if cfg.env.kind == "none" else acting, repo_id)}
```

Weights are safetensors, everything else is JSON and YAML; nothing is unpickled or executed. The configuration is in
[config.yaml](config.yaml).

## License

{license}

## Citation

{_CITATION}
"""
    return str(ModelCard(f"---\n{head}\n---\n{text}"))


def _world(env: Any) -> str:
    """What a model is a model of."""
    if env.kind == "franka":
        return "a simulated Franka arm"
    if env.kind == "multitask":
        return f"a simulated Franka arm in {len(env.tasks)} tasks ({', '.join(map(str, env.tasks))})"
    if env.kind == "none":
        return "recorded episodes"
    named = [str(env[key]) for key in ("name", "task") if env.get(key)]
    return f"`{' '.join([str(env.kind), *named])}`"


def _use(acting: str | None, repo_id: str) -> str:
    if acting is None:  # or nothing to act in
        return f'from franka_wm.training.load import load_model\n\nmodel = load_model("hf:{repo_id}")'
    return (
        "from franka_wm.training.load import load_agent\n\n"
        f'agent = load_agent("hf:{repo_id}")\n'
        f'rollout = agent.env.rollout(50, agent.policies["{acting}"])'
    )
