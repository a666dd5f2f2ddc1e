"""LeRobot datasets: frames per second written, beside LeRobot's own recorder in the same run.

    python benchmarks/lerobot.py                          writing, 64 × 64, every format
    python benchmarks/lerobot.py --part collecting        an expert's episodes, beside its worlds alone
    python benchmarks/lerobot.py --part reading …         see lerobot_reading.py
    python benchmarks/lerobot.py --episodes 100 --length 60 --formats exact

Images are rendered by the environment: noise or a constant would compress like nothing that is recorded. Writing
counts from the first episode to the finished dataset, the merge and the check of decoded frames included; the start
of the writing processes, which a collection hides, is in a column of its own.

*collecting* plays the same number of episodes in three ways, in turns: given actions alone, with the expert that
decides them, and into a dataset, from the first step to the finished folder.
"""

from __future__ import annotations

import argparse
import os
import runpy
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ["HF_HUB_OFFLINE"] = "1"
sys.path.append(sys.path.pop(0))  # this folder last: `lerobot` is the package, not this file

import torch
from common import publish
from tensordict import TensorDictBase
from torchrl.collectors import Collector

from franka_wm.commands.collect import open_source
from franka_wm.data.lerobot.collect import Gatherer, gather
from franka_wm.data.lerobot.episodes import Episode, EpisodeCutter
from franka_wm.data.lerobot.provenance import describe
from franka_wm.data.lerobot.schema import FORMATS, Schema, schema_for
from franka_wm.data.lerobot.writer import DatasetWriter


def rendered(source: Gatherer, schema: Schema, count: int) -> list[Episode]:
    """So many episodes of the environment, in memory."""
    cutter, episodes = EpisodeCutter(schema, seed=0), []
    options: dict[str, Any] = {"total_frames": -1, "track_traj_ids": False, "trust_policy": True}
    collector = Collector(source.env, source.policy, frames_per_batch=source.env.num_envs * 20, **options)
    for batch in collector:
        episodes += cutter.push(batch)
        if len(episodes) >= count:
            collector.shutdown()
            return episodes[:count]
    raise RuntimeError("the collector ended")


def ours(out: Path, schema: Schema, episodes: list[Episode], workers: int) -> tuple[float, float]:
    """Seconds to start the processes, and to write."""
    frames = sum(episode.length for episode in episodes)
    begin = time.perf_counter()
    with DatasetWriter(
        out,
        schema,
        provenance=describe(policy="benchmark", seed=0, config={}),
        workers=workers,
        shard_frames=-(-frames // (4 * max(1, workers))),
    ) as writer:
        writer.start(wait=True)
        started = time.perf_counter()
        writer.add(episodes)
        writer.finish()
    return started - begin, time.perf_counter() - started


def recorder(out: Path, schema: Schema, episodes: list[Episode]) -> float:
    """Seconds of LeRobot's ``add_frame`` and ``save_episode`` for the same."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    longest = max(episode.length for episode in episodes)
    video: dict[str, Any] = {}
    if schema.format != "exact":
        from lerobot.configs.video import RGBEncoderConfig

        near = RGBEncoderConfig(vcodec="h264", pix_fmt="yuv444p", crf=0, extra_options={"bf": 0})
        video = {"streaming_encoding": True, "encoder_queue_maxsize": longest + 1}
        video |= {"rgb_encoder": near} if schema.format == "video_near_lossless" else {}
    started = time.perf_counter()
    dataset = LeRobotDataset.create(
        "benchmark/set",
        fps=schema.fps,
        features=schema.features,
        root=out,
        robot_type=schema.robot_type,
        use_videos=bool(video),
        video_backend="pyav",
        **video,
    )
    for episode in episodes:
        for t in range(episode.length):
            dataset.add_frame({key: episode.rows[key][t] for key in schema.features} | {"task": schema.task})
        dataset.save_episode()
    dataset.finalize()
    return time.perf_counter() - started


def size(folder: Path, frames: int) -> float:
    """Bytes of all files, per frame."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / frames


def writing(arguments: argparse.Namespace) -> list[dict[str, Any]]:

    torch.set_num_threads(1)
    source = open_source(
        "random",
        overrides=[
            f"env.image_size={arguments.size}",
            f"env.episode_length={arguments.length}",
            "env=reach_pixels",
        ],
        num_envs=16,
        episodes=arguments.episodes,
    )
    rows = []
    place = Path(tempfile.mkdtemp())
    try:
        for format in arguments.formats:
            schema = schema_for(source.env.config, format=format)
            episodes = rendered(source, schema, arguments.episodes)
            frames = sum(episode.length for episode in episodes)
            base = frames / recorder(place / "theirs", schema, episodes)
            row = {"format": format, "writer": "LeRobot's add_frame loop", "frames/s": base, "times": 1.0}
            rows.append(row | {"start s": 0.0, "bytes/frame": size(place / "theirs", frames)})
            for workers in (1, 2):
                start, seconds = ours(place / "ours", schema, episodes, workers)
                speed = frames / seconds
                row = {
                    "format": format,
                    "writer": f"{workers} process{'es' * (workers > 1)}",
                    "frames/s": speed,
                }
                rows.append(
                    row
                    | {"times": speed / base, "start s": start, "bytes/frame": size(place / "ours", frames)}
                )
                shutil.rmtree(place / "ours")
            shutil.rmtree(place / "theirs")
        begin = time.perf_counter()
        gather(source, out=place / "collected", episodes=arguments.episodes, workers=2)
        collected = arguments.episodes * arguments.length / (time.perf_counter() - begin)
        source.env.set_seed(0)
        begin = time.perf_counter()
        rendered(source, schema_for(source.env.config), arguments.episodes)
        alone = arguments.episodes * arguments.length / (time.perf_counter() - begin)
        for name, speed in (("stepping and rendering alone", alone), ("collect to a dataset", collected)):
            row = {"format": "exact", "writer": name, "frames/s": speed, "times": speed / alone}
            rows.append(row | {"start s": 0.0, "bytes/frame": 0.0})
    finally:
        shutil.rmtree(place)
    return rows


def collecting(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    torch.set_num_threads(1)
    source = open_source(
        "expert",
        overrides=[f"env={arguments.env}"],
        num_envs=arguments.worlds,
        episodes=arguments.episodes,
    )
    env, actions = source.env, []
    each = -(-arguments.episodes // env.num_envs)  # episodes of each world
    length = each * env.config.episode_length

    def play(decide: Callable[[TensorDictBase, int], TensorDictBase]) -> float:
        env.set_seed(0)
        now, begin = env.reset(), time.perf_counter()
        for t in range(length):
            now = env.step_and_maybe_reset(decide(now, t))[1]
        return time.perf_counter() - begin

    def note(now: TensorDictBase, _: int) -> TensorDictBase:
        actions.append(source.policy(now)["action"].clone())
        return now.set("action", actions[-1])

    def collect() -> float:
        begin = time.perf_counter()
        gather(source, out=place / "set", episodes=each * env.num_envs, workers=arguments.workers)
        seconds = time.perf_counter() - begin
        shutil.rmtree(place / "set")
        return seconds

    play(note)
    ways: dict[str, Callable[[], float]] = {
        "stepping and rendering alone": lambda: play(lambda now, t: now.set("action", actions[t])),
        "with the expert": lambda: play(lambda now, _: source.policy(now)),
        "into a dataset": collect,
    }
    place, rows = Path(tempfile.mkdtemp()), []
    try:
        for turn in range(arguments.turns):
            rates = {name: env.num_envs * length / way() for name, way in ways.items()}
            alone = rates["stepping and rendering alone"]
            for name, rate in rates.items():
                row = {"env": arguments.env, "turn": turn, "what": name, "frames/s": rate}
                rows.append(row | {"of alone": rate / alone})
                print(rows[-1], flush=True)
    finally:
        shutil.rmtree(place)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--part", choices=["writing", "collecting", "reading"], default="writing")
    parser.add_argument("--episodes", type=int, default=64)
    parser.add_argument("--length", type=int, default=60)
    parser.add_argument("--size", type=int, default=64, help="side of the images [px]")
    parser.add_argument("--env", default="lift_pixels", help="collecting: whose expert")
    parser.add_argument(
        "--worlds", type=int, default=64, help="collecting: at once, as `franka-wm collect` has them"
    )
    parser.add_argument("--workers", type=int, default=2, help="collecting: writing processes")
    parser.add_argument("--turns", type=int, default=3, help="collecting: how often")
    parser.add_argument("--formats", nargs="+", choices=list(FORMATS), default=list(FORMATS))
    parser.add_argument("--out", help="write the numbers as JSON")
    arguments, rest = parser.parse_known_args()
    if arguments.part == "reading":
        script = Path(__file__).with_name("lerobot_reading.py")
        sys.argv = [str(script), *rest, *(["--out", arguments.out] if arguments.out else [])]
        runpy.run_path(str(script), run_name="__main__")
        return
    if rest:
        parser.error(f"unknown: {' '.join(rest)}")
    measure = collecting if arguments.part == "collecting" else writing
    publish(f"{arguments.part} LeRobot datasets", measure(arguments), arguments.out)


if __name__ == "__main__":
    main()
