"""A checkpoint of a run, its JSON, YAML and tensors changed, with sizes and checksums made right again."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any

import yaml
from hypothesis import strategies as st

from rooms.forked import NotApplicable
from rooms.kills import command, train
from rooms.odd import changed, leaves, mutation

RUN = [
    "scale=smoke", "device=cpu", "env.episode_length=12", "env.substeps=2", "collector.num_envs=4",
    "evaluation.episodes=2", "evaluation.video_episodes=1", "evaluation.video_size=32", "trainer.updates=20",
]  # fmt: skip
TREES = ("extra.json", "rng.json", "optimizer.json", "replay.json", "counters.json")
TENSORS = ("model", "optimizer", "replay", "extra", "rng")
WHOLE = [
    "", "[]", "null", "{}", "0", "[" * 100_000, "NaN", '["dict", 3]', '["tensor", "nowhere"]',
    "a: &a [1]\nb: *a\n", "\u0000",
]  # fmt: skip
HOW = ("nan", "inf", "zeros", "flat", "longer", "dtype", "drop", "add", "empty", "big")


def smoke_run(folder: Path) -> Path:
    """A finished run of twenty updates."""
    run = folder / "run"
    ended = command(train(*RUN, f"hydra.run.dir={run}"), run, seconds=400)
    assert ended.status == 0, ended.said
    return run


class Checkpoint:
    """Cases: `{"mutations": [[kind, file, …], …]}`."""

    name = "checkpoint"
    seconds = 40.0

    def __init__(self, folder: Path) -> None:
        from franka_wm.training.checkpoint import load_checkpoint
        from franka_wm.training.settings import RunSettings

        self.source = smoke_run(folder) / "checkpoints" / "latest"
        self.settings = RunSettings.of(load_checkpoint(self.source).config, saved=True)
        self.trainer = _trainer(self.settings, folder / "again")
        config = yaml.safe_load((self.source / "config.yaml").read_text())
        trees = {name: json.loads((self.source / name).read_text()) for name in (*TREES, "manifest.json")}
        names = st.sampled_from([*TREES, "manifest.json", "config.yaml"])
        self.cases = st.fixed_dictionaries(
            {
                "mutations": st.lists(
                    st.one_of(
                        *[
                            mutation(list(leaves(tree))).map(lambda m, name=name: ["json", name, *m])
                            for name, tree in trees.items()
                        ],
                        *[mutation(list(leaves(config))).map(lambda m: ["yaml", "config.yaml", *m])] * 4,
                        st.tuples(
                            st.just("tensor"),
                            st.sampled_from(TENSORS),
                            st.integers(0, 400),
                            st.sampled_from(HOW),
                        ).map(list),
                        st.tuples(
                            st.just("header"),
                            st.sampled_from(TENSORS),
                            st.integers(0, 3000),
                            st.integers(0, 255),
                        ).map(list),
                        st.tuples(
                            st.just("cut"), st.sampled_from(TENSORS), st.integers(0, 5000), st.just(0)
                        ).map(list),
                        st.tuples(st.just("whole"), names, st.sampled_from(WHOLE), st.just(0)).map(list),
                    ),
                    min_size=1,
                    max_size=3,
                )
            }
        )

    def use(self, case: dict[str, Any], folder: Path) -> None:
        """The model alone, as `evaluate` loads it; then as `resume=` goes on, one update further."""
        import torch

        from franka_wm.training.check import check
        from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint
        from franka_wm.training.load import load_model
        from franka_wm.training.resume import restore
        from franka_wm.training.settings import RunSettings

        self._damaged(folder / "latest", case["mutations"])
        model = load_model(folder, device="cpu")
        assert all(
            bool(x.isfinite().all()) for x in model.state_dict().values() if isinstance(x, torch.Tensor)
        )
        checkpoint = load_checkpoint(latest_checkpoint(folder))
        settings = RunSettings.of(checkpoint.config, saved=True)
        check(settings)
        if settings.values != self.settings.values:
            return
        trainer = self.trainer
        restore(trainer, checkpoint)
        trainer.gather()
        trainer.learner.update(trainer.replay.sample())
        trainer.require_finite(weights=True)

    def _damaged(self, folder: Path, mutations: list[Any]) -> None:
        shutil.copytree(self.source, folder, copy_function=os.link)
        last = []
        for kind, file, *rest in mutations:
            path = folder / (file if kind in ("json", "yaml", "whole") else f"{file}.safetensors")
            if file == "manifest.json":
                last.append((kind, path, rest))
            else:
                _mutate(kind, path, rest)
        manifest = json.loads((folder / "manifest.json").read_text())
        for name in manifest["files"]:
            content = (folder / name).read_bytes()
            manifest["files"][name] = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        _write(folder / "manifest.json", json.dumps(manifest).encode())
        for kind, path, rest in last:
            _mutate(kind, path, rest)


def _mutate(kind: str, path: Path, rest: list[Any]) -> None:
    if kind == "json":
        _write(path, json.dumps(changed(_read_json(path), *rest)).encode())
    elif kind == "yaml":
        try:
            _write(path, yaml.safe_dump(changed(yaml.safe_load(path.read_text()), *rest)).encode())
        except yaml.YAMLError as error:
            raise NotApplicable(str(error)) from error
    elif kind == "whole":
        _write(path, rest[0].encode())
    elif kind == "cut":
        _write(path, path.read_bytes()[: rest[0]])
    elif kind == "header":
        content = bytearray(path.read_bytes())
        if not content:
            raise NotApplicable("nothing in it")
        content[rest[0] % min(len(content), 3000)] = rest[1]
        _write(path, bytes(content))
    else:
        _change_tensor(path, *rest)


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except (ValueError, RecursionError) as error:
        raise NotApplicable(str(error)) from error


def _change_tensor(path: Path, number: int, how: str) -> None:
    import torch
    from safetensors.torch import load_file, save_file

    try:
        tensors = load_file(path)
    except Exception as error:
        raise NotApplicable(str(error)) from error
    if not tensors:
        raise NotApplicable("no tensors")
    name = sorted(tensors)[number % len(tensors)]
    x = tensors[name].clone()
    if how in ("nan", "inf"):
        if not x.is_floating_point() or not x.numel():
            raise NotApplicable("no float")
        x.view(-1)[0] = float(how)
    makers = {
        "zeros": lambda: torch.zeros_like(x),
        "flat": lambda: x.reshape(-1),
        "longer": lambda: torch.cat([x.reshape(-1), x.reshape(-1)]),
        "dtype": lambda: x.to(torch.float64 if x.dtype != torch.float64 else torch.int32),
        "empty": lambda: x.new_zeros(0),
        "big": lambda: torch.full_like(x, 100) if x.dtype != torch.bool else ~x,
    }
    if how == "drop":
        del tensors[name]
    elif how == "add":
        tensors["another"] = x
    else:
        tensors[name] = makers[how]() if how in makers else x
    content = path.with_suffix(".new")
    save_file({k: v.contiguous() for k, v in tensors.items()}, content)
    content.replace(path)


def _write(path: Path, content: bytes) -> None:
    path.unlink()  # it may be a link to the file that all cases share
    path.write_bytes(content)


def _trainer(settings: Any, folder: Path) -> Any:
    """As train.py makes it."""
    from franka_wm.device import resolve_device
    from franka_wm.training import build
    from franka_wm.training.learner import Learner
    from franka_wm.training.spaces import Spaces
    from franka_wm.training.trainer import Trainer

    env = build.make_env(settings)
    env.step_and_maybe_reset(env.rand_action(env.reset()))
    spaces = Spaces.of_env(env)
    model = build.make_model(settings, spaces, resolve_device("cpu"))
    hindsight = build.make_hindsight(settings)
    return Trainer(
        env=env,
        learner=Learner(model, **settings.learner_options),
        replay=build.make_replay_buffer(settings, env.device, hindsight),
        policies=build.make_agent_policies(settings, model, env, spaces, purpose="training"),
        actor=settings.actor,
        settings=settings,
        folder=folder,
        loggers=[],
        evaluate=None,
        spaces=spaces,
    )
