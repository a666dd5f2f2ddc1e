"""A LeRobot dataset of the arm: its metadata, its columns, single cells, whole files, terminal observations."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from rooms.checkpoint import WHOLE, _mutate
from rooms.forked import NotApplicable
from rooms.odd import leaves, mutation

CELLS = [
    None,
    "abc",
    float("nan"),
    float("inf"),
    -1,
    0,
    1,
    10**9,
    2**62,
    -(2**62),
    0.5,
    [],
    [1.0],
    [None],
    [[1.0]],
    True,
    b"x",
]
NAMES = ["", "action", "a/b", "../x", "observation.images.x", "x" * 300, "next.reward", "\u0000", "index"]
PATHS = [
    "data/{chunk_index:0999999999d}.parquet", "{chunk_index:>99999999999}", "{nothing}", "{0}", "../{file_index}",
    "/etc/passwd", "{chunk_index.__class__}", "{chunk_index!r:>1000000000}", "data", "{", "", "{chunk_index:s}",
    "\u0000", "{file_index:03d}" * 500,
]  # fmt: skip
KINDS = ("drop", "rename", "text", "null", "float", "twice")


class Dataset:
    """Cases: `{"mutations": [[kind, file, …], …]}`."""

    name = "dataset"
    seconds = 30.0

    def __init__(self, folder: Path) -> None:
        from franka_wm.data.lerobot.opening import open_dataset

        self.source = _recorded(folder / "recorded")
        self.open = open_dataset
        self.files = sorted(
            p.relative_to(self.source).as_posix() for p in self.source.rglob("*") if p.is_file()
        )
        self.tables = [name for name in self.files if name.endswith(".parquet")]
        info = json.loads((self.source / "meta" / "info.json").read_text())
        self.use({"mutations": []}, folder / "once")
        number = st.integers(0, 40)
        table = st.sampled_from(self.tables)
        self.cases = st.fixed_dictionaries(
            {
                "mutations": st.lists(
                    st.one_of(
                        mutation(list(leaves(info))).map(lambda m: ["json", "meta/info.json", *m]),
                        mutation(list(leaves(info))).map(lambda m: ["json", "meta/info.json", *m]),
                        st.tuples(
                            st.just("json"),
                            st.just("meta/info.json"),
                            st.just(["data_path"]),
                            st.sampled_from(PATHS),
                        ).map(list),
                        st.tuples(st.just("column"), table, number, st.sampled_from(KINDS)).map(list),
                        st.tuples(st.just("cell"), table, number, number, st.integers(0, len(CELLS) - 1)).map(
                            list
                        ),
                        st.tuples(st.just("cell"), table, number, number, st.integers(0, len(CELLS) - 1)).map(
                            list
                        ),
                        st.tuples(
                            st.just("rows"), table, st.sampled_from(["none", "double", "last"]), st.just(0)
                        ).map(list),
                        st.tuples(st.just("cut"), st.sampled_from(self.files), st.integers(0, 5000)).map(
                            list
                        ),
                        st.tuples(
                            st.just("byte"),
                            st.sampled_from(self.files),
                            st.integers(0, 5000),
                            st.integers(0, 255),
                        ).map(list),
                        st.tuples(st.just("whole"), st.sampled_from(self.files), st.sampled_from(WHOLE)).map(
                            list
                        ),
                        st.tuples(st.just("gone"), st.sampled_from(self.files), st.just(0)).map(list),
                    ),
                    min_size=1,
                    max_size=3,
                )
            }
        )

    def use(self, case: dict[str, Any], folder: Path) -> None:
        """As training opens it: decoded once, windows drawn, which must be finite."""
        root = folder / "dataset"
        shutil.copytree(self.source, root)
        for kind, name, *rest in case["mutations"]:
            path = root / name
            if not path.is_file():
                raise NotApplicable("gone")
            if kind == "gone":
                path.unlink()
            elif kind == "byte":
                _mutate("header", path, rest)
            elif kind in ("column", "cell", "rows"):
                _change_table(kind, path, rest)
            else:
                _mutate(kind, path, rest)
        windows = self.open(
            root,
            window=3,
            batch_size=64,
            split="all",
            workers=0,
            cache_dir=folder / "cache",
            say=lambda line: None,
        )
        for _ in range(3):
            batch = windows.sample()
            for key, value in batch.items(True, True):
                assert not value.is_floating_point() or bool(value.isfinite().all()), f"{key} is not finite"


def _change_table(kind: str, path: Path, rest: list[Any]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(path)
    except (pa.ArrowException, OSError) as error:
        raise NotApplicable(str(error)) from error
    if not table.num_columns or not table.num_rows:
        raise NotApplicable("empty")
    try:
        if kind == "rows":
            table = {
                "none": lambda: table.slice(0, 0),
                "double": lambda: pa.concat_tables([table, table]),
                "last": lambda: table.slice(0, table.num_rows - 1),
            }[rest[0]]()
        elif kind == "column":
            table = _change_column(table, rest[0] % table.num_columns, rest[1])
        else:
            at = rest[0] % table.num_columns
            column = table.column(at).to_pylist()
            value = CELLS[rest[2]]
            old = column[rest[1] % len(column)]
            if isinstance(old, list) and old and not isinstance(value, list):
                value = [value, *old[1:]]
            column[rest[1] % len(column)] = value
            changed = pa.array(column)
            if pa.types.is_integer(changed.type) or pa.types.is_floating(changed.type):
                changed = changed.cast(table.column(at).type) if rest[1] % 2 else changed
            table = table.set_column(at, table.column_names[at], changed)
        pq.write_table(table, path)
    except (pa.ArrowException, OverflowError, TypeError, ValueError, AttributeError) as error:
        raise NotApplicable(str(error)) from error


def _change_column(table: Any, at: int, how: str) -> Any:
    import pyarrow as pa

    name, column = table.column_names[at], table.column(at)
    if how == "drop":
        return table.remove_column(at)
    if how == "rename":
        return table.rename_columns(
            [NAMES[at % len(NAMES)] if k == at else n for k, n in enumerate(table.column_names)]
        )
    if how == "twice":
        return table.append_column(name, column)
    if how == "text":
        return table.set_column(at, name, pa.array(["text"] * table.num_rows))
    if how == "null":
        return table.set_column(at, name, pa.nulls(table.num_rows, column.type))
    return table.set_column(at, name, pa.array([0.5] * table.num_rows))


def _recorded(folder: Path) -> Path:
    """Nine episodes of six steps: pictures bit for bit, vectors, terminal observations."""
    import torch
    from torchrl.collectors import Collector

    from franka_wm.data.lerobot.episodes import EpisodeCutter
    from franka_wm.data.lerobot.provenance import describe
    from franka_wm.data.lerobot.schema import schema_for
    from franka_wm.data.lerobot.writer import DatasetWriter
    from franka_wm.envs import FrankaConfig, FrankaEnv
    from franka_wm.policies.scripted import SmoothRandomPolicy

    arm: dict[str, Any] = {
        "substeps": 2,
        "goal_sampling": "reachable",
        "observations": ("pixels", "state", "joint_target"),
        "image_size": 16,
        "episode_length": 6,
    }
    config = FrankaConfig(**arm)
    env = FrankaEnv(config, num_envs=3, device="cpu", seed=1)
    policy = SmoothRandomPolicy(7, generator=torch.Generator().manual_seed(0))
    collector = Collector(env, policy, frames_per_batch=60, total_frames=60, track_traj_ids=False)
    batch = next(iter(collector)).clone()
    collector.shutdown()
    schema = schema_for(config, format="exact")
    session = describe(policy="smooth", seed=1, config={"env": {**arm, "kind": "franka"}})
    with DatasetWriter(folder, schema, provenance=session, workers=1) as writer:
        writer.add(EpisodeCutter(schema, seed=1).push(batch))
        writer.finish()
    return folder
