"""Checkpoints: exact after a round trip."""

import functools
import itertools
import json
import random
import threading
from collections.abc import Callable
from dataclasses import FrozenInstanceError
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from tensordict import TensorDict
from torch import Tensor, nn

from franka_wm import processes
from franka_wm.errors import UserError
from franka_wm.training.checkpoint import latest_checkpoint, load_checkpoint, save_checkpoint
from franka_wm.training.shards import add_part, own_experience, own_moment, save_together
from franka_wm.training.tree import read_tree, write_tree
from small_checkpoint import Small, save, some_replay, train


def test_weights_buffers_and_config_come_back(tmp_path: Path) -> None:
    model = Small()
    train(model, torch.optim.SGD(model.parameters(), lr=0.1), 3)
    config = {"lr": 1e-3, "steps": [1, 2], "folder": {"path": str(tmp_path)}, "none": None}
    counters = {"env_steps": 12_345_678_901, "updates": 7, "time_s": 0.1 + 0.2}
    path = save_checkpoint(tmp_path / "a", model=model, config=config, counters=counters)
    assert path == (tmp_path / "a").resolve()

    checkpoint = load_checkpoint(tmp_path / "a")
    assert checkpoint.counters == counters
    assert checkpoint.model_name == "Small"
    assert checkpoint.config == config
    restored = Small()
    weight = restored.first.weight
    checkpoint.load_model(restored)
    assert restored.first.weight is weight  # in place: an optimizer or a captured graph keeps its tensors
    assert restored.tied.weight is restored.second.weight
    assert int(restored.norm.num_batches_tracked) == 3
    x = torch.randn(4, 20)
    assert torch.equal(restored.eval()(x), model.eval()(x))


ADAMS: dict[str, Callable[[list[nn.Parameter]], torch.optim.Optimizer]] = {
    "adam": lambda p: torch.optim.Adam(p, lr=3e-3, betas=(0.8, 0.99)),
    "adamw amsgrad": lambda p: torch.optim.AdamW(p, lr=3e-3, weight_decay=0.1, amsgrad=True),
    "adam fused": lambda p: torch.optim.Adam(p, lr=3e-3, fused=True),
    "adam tensor lr": lambda p: torch.optim.Adam(p, lr=torch.tensor(3e-3), foreach=False),
    "adamw groups": lambda p: torch.optim.AdamW([{"params": p[:2], "lr": 1e-4}, {"params": p[2:]}]),
    "sgd momentum": lambda p: torch.optim.SGD(p, lr=1e-2, momentum=0.9),
}


@pytest.mark.parametrize("kind", ADAMS)
def test_training_goes_on_bit_for_bit(tmp_path: Path, kind: str) -> None:
    model = Small()
    optimizer = ADAMS[kind](list(model.parameters()))
    train(model, optimizer, 4)
    optimizer.param_groups[0]["lr"] = optimizer.param_groups[0]["lr"] * 0.5  # as a schedule does
    save(tmp_path / "a", model, optimizer=optimizer)
    train(model, optimizer, 5)

    torch.manual_seed(99)
    resumed = Small()
    resumed_optimizer = ADAMS[kind](list(resumed.parameters()))
    checkpoint = load_checkpoint(tmp_path / "a")
    checkpoint.load_model(resumed)
    checkpoint.load_optimizer(resumed_optimizer)
    checkpoint.restore_rng()
    train(resumed, resumed_optimizer, 5)
    for (name, a), b in zip(model.state_dict().items(), resumed.state_dict().values(), strict=True):
        if isinstance(a, Tensor):
            assert torch.equal(a, b), name
    state, again = optimizer.state_dict(), resumed_optimizer.state_dict()
    assert state["state"].keys() == again["state"].keys()
    for index, entries in state["state"].items():
        for name, value in entries.items():
            other = again["state"][index][name]
            assert type(value) is type(other)
            if isinstance(value, Tensor):
                assert torch.equal(value, other)
                assert value.dtype == other.dtype
    assert [g["lr"] for g in state["param_groups"]] == [g["lr"] for g in again["param_groups"]]


def test_execution_flags_are_the_ones_of_the_new_optimizer(tmp_path: Path) -> None:
    model = Small()
    fused = torch.optim.Adam(model.parameters(), lr=1e-3, fused=True)
    train(model, fused, 2)
    save(tmp_path / "a", model, optimizer=fused)
    plain = torch.optim.Adam(model.parameters(), lr=torch.tensor(5.0), foreach=False)
    rate = plain.param_groups[0]["lr"]
    load_checkpoint(tmp_path / "a").load_optimizer(plain)
    group = plain.param_groups[0]
    assert (group["fused"], group["foreach"]) == (None, False)
    assert group["lr"] is rate  # a captured graph reads this tensor
    assert float(rate) == pytest.approx(1e-3)
    train(model, plain, 1)


def test_options_are_those_of_the_new_optimizer(tmp_path: Path) -> None:
    """A resumed run may change its weight decay; what it says in its configuration is what it trains with."""
    model = Small()
    first = torch.optim.AdamW(model.parameters(), lr=1e-3, weight_decay=0.04)
    train(model, first, 2)
    save(tmp_path / "a", model, optimizer=first)
    other = torch.optim.AdamW(model.parameters(), lr=1.0, weight_decay=0.5)
    load_checkpoint(tmp_path / "a").load_optimizer(other)
    assert (other.param_groups[0]["weight_decay"], other.param_groups[0]["lr"]) == (0.5, 1e-3)
    moments = [next(iter(one.state.values()))["exp_avg"] for one in (first, other)]
    assert torch.equal(*moments)


def test_all_generators_go_on_where_they_were(tmp_path: Path) -> None:
    def draw() -> list[float]:
        return [random.random(), float(np.random.normal()), float(torch.randn(())), random.gauss(0, 1)]

    np.random.normal()  # leaves a cached second value, which is part of the state
    save(tmp_path / "a")
    first = draw()
    assert draw() != first
    load_checkpoint(tmp_path / "a").restore_rng()
    assert draw() == first


def test_replay_comes_back_entry_by_entry(tmp_path: Path) -> None:
    replay = some_replay()
    # What a half-filled buffer hands over: a view of a larger storage.
    save(tmp_path / "a", replay=replay[:3])
    restored = load_checkpoint(tmp_path / "a").replay()
    assert restored is not None
    assert restored.batch_size == (3, 4)
    assert set(restored.keys(True, True)) == set(replay.keys(True, True))
    for key, value in replay[:3].items(True, True):
        assert restored[key].dtype == value.dtype
        assert torch.equal(restored[key], value)
    elsewhere = load_checkpoint(tmp_path / "a").replay("meta")
    assert elsewhere is not None and elsewhere["state"].is_meta
    size = (tmp_path / "a" / "replay.safetensors").stat().st_size
    assert size < 1.2 * replay[:3].bytes() + 2000  # not the whole storage


def test_what_was_not_saved_is_none(tmp_path: Path) -> None:
    save(tmp_path / "a")
    checkpoint = load_checkpoint(tmp_path / "a")
    assert checkpoint.replay() is None
    assert checkpoint.extra() is None
    with pytest.raises(UserError, match="without an optimizer"):
        checkpoint.load_optimizer(torch.optim.Adam(Small().parameters()))


def test_a_checkpoint_without_random_numbers_is_of_one_process(root: Path) -> None:
    """As the package's own agent is."""
    checkpoint = load_checkpoint(root / "franka_wm" / "demo_agent")
    assert checkpoint.processes == 1 and checkpoint.replay() is None


def test_a_checkpoint_is_not_changed(tmp_path: Path) -> None:
    save(tmp_path / "a")
    with pytest.raises(FrozenInstanceError):
        load_checkpoint(tmp_path / "a").counters = {}  # type: ignore[misc]


def test_extra_keeps_types(tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(4)
    extra = {
        "generator": generator.get_state(),
        "t": (1, [2.5, None, True]),
        "ids": {3: "a", "x/y": float("inf")},
    }
    save(tmp_path / "a", extra=extra)
    restored = load_checkpoint(tmp_path / "a").extra()
    assert restored is not None
    assert torch.equal(restored.pop("generator"), extra["generator"])
    assert restored == {k: v for k, v in extra.items() if k != "generator"}
    assert isinstance(restored["t"], tuple)


def test_tensors_whose_places_read_alike_stay_apart(tmp_path: Path) -> None:
    save(
        tmp_path / "a",
        extra={
            "1": torch.zeros(1),
            1: torch.ones(1),
            "a/b": torch.full((1,), 2.0),
            "a": {"b": torch.full((1,), 3.0)},
        },
    )
    restored = load_checkpoint(tmp_path / "a").extra()
    assert restored is not None
    assert [float(x) for x in (restored["1"], restored[1], restored["a/b"], restored["a"]["b"])] == [
        0,
        1,
        2,
        3,
    ]


def test_what_needs_pickle_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="extra/thing is a object"):
        save(tmp_path / "a", extra={"thing": object()})
    with pytest.raises(TypeError, match="counter env_steps is a Tensor"):
        save_checkpoint(
            tmp_path / "a",
            model=Small(),
            config={},
            counters={"env_steps": torch.tensor(1)},  # type: ignore[dict-item]
        )
    assert list(tmp_path.iterdir()) == []


def test_no_pickle_is_written_or_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_args, **_kwargs):
        raise AssertionError("pickle")

    for name in ("load", "save"):
        monkeypatch.setattr(torch, name, forbidden)
    monkeypatch.setattr("pickle.dumps", forbidden)
    monkeypatch.setattr("pickle.loads", forbidden)
    model = Small()
    optimizer = torch.optim.Adam(model.parameters())
    train(model, optimizer, 1)
    save(tmp_path / "a", model, optimizer=optimizer, replay=some_replay(), extra={"x": torch.ones(2)})
    checkpoint = load_checkpoint(tmp_path / "a")
    checkpoint.load_model(model)
    checkpoint.load_optimizer(optimizer)
    checkpoint.restore_rng()
    checkpoint.replay()
    kinds = {p.suffix for p in (tmp_path / "a").iterdir()}
    assert kinds == {".json", ".safetensors", ".yaml"}


def test_latest_is_the_one_written_last(tmp_path: Path) -> None:
    save(tmp_path / "run" / "checkpoints" / "z_first", step=1)
    last = save(tmp_path / "run" / "checkpoints" / "a_last", step=2)
    (tmp_path / "run" / "videos").mkdir()
    (tmp_path / "run" / "log.csv").write_text("")
    assert latest_checkpoint(tmp_path / "run") == last
    assert latest_checkpoint(last) == last
    best = save(tmp_path / "run" / "best", step=3)
    assert latest_checkpoint(tmp_path / "run") == best
    for nothing in (tmp_path / "run" / "videos", tmp_path / "not there"):
        with pytest.raises(UserError, match="no checkpoint in"):
            latest_checkpoint(nothing)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_captured_optimizer_goes_on_on_the_gpu_and_on_the_cpu(tmp_path: Path) -> None:
    def build(device: str, **flags) -> tuple[Small, torch.optim.Adam]:
        model = Small().to(device)
        return model, torch.optim.Adam(model.parameters(), lr=1e-3, **flags)

    model, optimizer = build("cuda", capturable=True, fused=True)
    train(model, optimizer, 3)
    save(tmp_path / "a", model, optimizer=optimizer)
    draws = torch.randn(4, device="cuda")
    train(model, optimizer, 3)
    checkpoint = load_checkpoint(tmp_path / "a")
    resumed, again = build("cuda", capturable=True, fused=True)
    checkpoint.load_model(resumed)
    checkpoint.load_optimizer(again)
    checkpoint.restore_rng()
    assert torch.equal(torch.randn(4, device="cuda"), draws)
    train(resumed, again, 3)
    assert torch.equal(resumed.first.weight, model.first.weight)
    assert all(state["step"].is_cuda for state in again.state.values())
    on_cpu, cpu_optimizer = build("cpu")
    checkpoint.load_model(on_cpu)
    checkpoint.load_optimizer(cpu_optimizer)
    train(on_cpu, cpu_optimizer, 1)


def test_parts_of_several_processes_are_one_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = some_replay(), some_replay()
    moments = [{"worlds": {"state": {"q": torch.full((6, 2), float(k))}}} for k in range(2)]

    def other() -> None:
        torch.manual_seed(7)
        add_part(tmp_path / "a", 1, replay=second, moment=moments[1])
        torch.manual_seed(8)

    save(tmp_path / "a", Small(), replay=first, extra={"moment": moments[0]}, others=other)
    found = load_checkpoint(tmp_path / "a")
    whole = found.replay()
    assert found.processes == 2 and whole is not None
    assert torch.equal(whole["state"], torch.cat((first["state"], second["state"])))
    part = found.replay(rank=1)
    assert part is not None and torch.equal(part["pixels"], second["pixels"])
    found.restore_rng(1)
    drawn = torch.rand(3)
    torch.manual_seed(7)
    assert torch.equal(drawn, torch.rand(3))
    # As many processes as before have their own; others divide the worlds anew, in their order.
    monkeypatch.setattr("franka_wm.processes.count", lambda: 3)
    monkeypatch.setattr("franka_wm.processes.rank", lambda: 1)
    own = own_experience(found, torch.device("cpu"))
    assert own is not None and torch.equal(own["state"], whole["state"][4:8])
    assert torch.equal(found.moment()["worlds"]["state"]["q"], moments[0]["worlds"]["state"]["q"])
    assert own_moment(found)["worlds"]["state"]["q"][:, 0].tolist() == [0.0, 0.0, 1.0, 1.0]
    (
        tmp_path / "a" / "replay.safetensors"
    ).unlink()  # of the first process: the last of three has no need of it
    monkeypatch.setattr("franka_wm.processes.rank", lambda: 2)
    own = own_experience(found, torch.device("cpu"))
    assert own is not None and torch.equal(own["state"], whole["state"][8:])


@pytest.mark.parametrize("count", [1, 2, 3, 4])
@pytest.mark.parametrize("saved", [1, 2, 3, 4])
def test_any_number_of_processes_goes_on_with_the_worlds_of_any_other(
    saved: int, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All in their order, none twice; and nobody reads a part that only others need, which may be large."""
    worlds, read = torch.arange(12), []
    parts = [TensorDict({"x": x}, x.shape) for x in worlds.chunk(saved)]

    def replay(device: torch.device, which: int | range) -> TensorDict:
        read.append([which] if isinstance(which, int) else [*which])
        return TensorDict.cat([parts[k] for k in read[-1]])

    def moment(k: int) -> dict[str, Any]:
        return {"worlds": {"state": {"x": parts[k]["x"]}, "carry": parts[k]["x"]}, "policies": k}

    checkpoint: Any = SimpleNamespace(processes=saved, replay=replay, moment=moment)
    monkeypatch.setattr(processes, "count", lambda: count)
    for rank, mine in enumerate(worlds.chunk(count)):
        monkeypatch.setattr(processes, "rank", lambda rank=rank: rank)
        experience, stood = own_experience(checkpoint, torch.device("cpu")), own_moment(checkpoint)
        assert experience is not None and torch.equal(experience["x"], mine)
        assert read[-1] == sorted({int(x) // (12 // saved) for x in mine})
        assert torch.equal(stood["worlds"]["state"]["x"], mine) and torch.equal(
            stood["worlds"]["carry"], mine
        )
        assert stood.get("policies") == (rank if saved == count else None)  # drew for other worlds


def test_another_number_of_processes_goes_on_with_the_first_ones_windows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Recorded data have no worlds, and no experience of a run."""
    checkpoint: Any = SimpleNamespace(
        processes=3,
        replay=lambda *_: None,
        moment=lambda k: {"windows": f"a{k}", "validation": f"b{k}", "other": k},
    )
    monkeypatch.setattr(processes, "count", lambda: 2)
    monkeypatch.setattr(processes, "rank", lambda: 1)
    assert own_experience(checkpoint, torch.device("cpu")) is None
    assert own_moment(checkpoint) == {"windows": "a0", "validation": "b0"}


@pytest.mark.parametrize("lost", ["rng1.json", "moment1.safetensors", "replay1.safetensors", None])
def test_a_checkpoint_without_the_part_of_another_process_is_not_made(
    lost: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its disk may be another one, or it may be late: then the first waits. The manifest knows how many have saved."""
    place, waits = tmp_path / "a", itertools.count()
    model, counters = Small(), {"updates": 1}

    def arrive() -> None:  # at the first of them the folder is there
        if next(waits) == 0:
            add_part(place, 1, replay=some_replay(), moment={})
            if lost is not None:
                (tmp_path / "a.writing" / lost).rename(tmp_path / lost)

    monkeypatch.setattr(processes, "count", lambda: 2)
    monkeypatch.setattr(processes, "wait", arrive)
    monkeypatch.setattr(processes, "SOON", 0.3)
    common: Any = {"model": model, "config": {}, "counters": counters, "extra": {}, "moment": {}}
    if lost is not None:
        with pytest.raises(UserError, match=f"process 0 does not see {lost}, which process 1 has written"):
            save_together(place, replay=some_replay(), **common)
        assert [*tmp_path.glob("a*")] == []
        waits = itertools.count()
        late = threading.Timer(0.1, lambda: (tmp_path / lost).rename(tmp_path / "a.writing" / lost))
        monkeypatch.setattr(processes, "wait", lambda: (arrive(), late.start() if not late.ident else None))
        monkeypatch.setattr(processes, "SOON", 30.0)
    save_together(place, replay=some_replay(), **common)
    assert load_checkpoint(place).processes == 2
    manifest = json.loads((place / "manifest.json").read_text())
    assert manifest.pop("processes") == 2
    (place / "manifest.json").write_text(json.dumps(manifest))  # as earlier versions did
    assert load_checkpoint(place).processes == 2
    (place / "manifest.json").write_text(json.dumps(manifest | {"processes": 3}))
    with pytest.raises(UserError, match=r"damaged: manifest\.json"):
        load_checkpoint(place)


def test_parts_that_do_not_fit_together_are_damage(tmp_path: Path) -> None:
    narrow = some_replay()[:, :3]
    others = functools.partial(add_part, tmp_path / "a", 1, replay=narrow, moment={})
    save(tmp_path / "a", Small(), replay=some_replay(), others=others)
    with pytest.raises(UserError, match="is damaged: one of its replays"):
        load_checkpoint(tmp_path / "a").replay()


def test_what_is_read_lies_where_torch_would_put_it(tmp_path: Path) -> None:
    """Products of tensors that begin elsewhere may round otherwise: a resumed run would not be the same."""
    tree = {f"x{k}": torch.arange(k + 1, dtype=torch.float32) for k in range(9)}
    write_tree(tmp_path, "odd", tree)
    read = read_tree(tmp_path, "odd")
    assert isinstance(read, dict) and all(torch.equal(read[key], tree[key]) for key in tree)
    assert [key for key, x in read.items() if x.data_ptr() % 64] == []
    plain = load_file(tmp_path / "odd.safetensors")
    assert any(x.data_ptr() % 64 for x in plain.values())
