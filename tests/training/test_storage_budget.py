"""Checkpoints whose experience is large, or does not fit on the disk."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict

from franka_wm import processes
from franka_wm.commands.entry import check_command
from franka_wm.data import memory
from franka_wm.data.image_storage import OVERFLOW
from franka_wm.data.memory import left_of_container
from franka_wm.data.replay import make_replay
from franka_wm.envs import FrankaConfig
from franka_wm.errors import UserError
from franka_wm.training import check, storage_budget
from franka_wm.training.build import make_model, make_replay_buffer
from franka_wm.training.spaces import Spaces
from franka_wm.training.trainer import Trainer


def test_size_of_what_is_filled() -> None:
    replay = make_replay(capacity=10 * 4, num_envs=4, window=2, batch_size=2, device="cpu")
    replay.extend(
        TensorDict({"x": torch.zeros(4, 5, 3), "is_init": torch.zeros(4, 5, 1, dtype=torch.bool)}, [4, 5])
    )
    assert storage_budget.filled_bytes(replay) == replay[:].bytes()


@pytest.mark.parametrize(
    ("size", "free", "last", "wanted", "why"),
    [
        (1e9, 100e9, False, None, None),
        (3e9, 100e9, False, None, "written at the end"),
        (3e9, 100e9, True, None, None),
        (9e9, 100e9, True, None, "checkpoint_replay=true keeps more than 8 GB"),
        (9e9, 100e9, False, True, "written at the end"),
        (9e9, 100e9, True, True, None),
        (3e9, 3.1e9, True, True, "WITHOUT"),
        (1e9, 1.1e9, False, None, "WITHOUT"),
    ],
)
def test_left_out(
    size: float, free: float, last: bool, wanted: bool | None, why: str | None, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr(storage_budget.shutil, "disk_usage", lambda folder: SimpleNamespace(free=free))
    said = storage_budget.reason_to_leave_out(int(size), tmp_path / "not" / "yet", last=last, wanted=wanted)
    if why is None:
        assert said is None
    else:
        assert said is not None and why in said and "\n" not in said


def test_a_replay_that_memory_cannot_hold_is_refused(monkeypatch, settled) -> None:
    """Before its first step, in one line that names what would fit; each image counts once, and each last one."""
    pictures = {
        "pixels": torch.zeros(4, 5, 8, 8, 9, dtype=torch.uint8),
        "is_init": torch.ones(4, 5, 1, dtype=torch.bool),
    }
    batch = TensorDict({**pictures, "next": TensorDict({"pixels": pictures["pixels"]}, [4, 5])}, [4, 5])
    cfg = settled("scale=smoke").changed(
        replay={"capacity": 4000},
        collector={"num_envs": 4, "seed_steps": 1000, "steps_per_batch": 2},
        trainer={"updates": 0, "updates_per_batch": 1},
    )
    for stack, image in ((1, 8 * 8 * 9), (3, 8 * 8 * 3)):
        per_step = image + 1 + image / 50
        replay = make_replay(
            capacity=4000,
            num_envs=4,
            window=2,
            batch_size=2,
            device="cpu",
            frame_stack=stack,
            stacked=["pixels"],
            episode_length=50,
        )
        monkeypatch.setattr(storage_budget, "free_memory", lambda device, most=4000 * per_step: most)
        storage_budget.fill(replay, batch, cfg)
        replay.empty()
        monkeypatch.setattr(storage_budget, "free_memory", lambda device, most=4000 * per_step - 1: most)
        with pytest.raises(UserError, match=r"at most replay\.capacity=3599 would") as caught:
            storage_budget.fill(replay, batch, cfg)
        assert "\n" not in str(caught.value) and len(replay) == 0
    short = cfg.changed(collector={"seed_steps": 999})
    storage_budget.fill(replay, batch, short)  # it never fills what it may
    with pytest.raises(UserError, match="do not fit"):  # beside a checkpoint's
        storage_budget.fill(replay, batch, short, restored=True)
    longer = cfg.changed(trainer={"updates": 30}, collector={"seed_steps": 999})
    with pytest.raises(UserError, match="do not fit"):
        storage_budget.fill(replay, batch, longer)
    storage_budget.fill(replay, batch, longer, updates=30)  # made before
    monkeypatch.setattr(storage_budget, "free_memory", lambda device: None)  # not known: not refused
    storage_budget.fill(replay, batch, cfg)


@pytest.mark.parametrize(
    "model", ["env=reach model=tdmpc2", "env=reach_pixels model=tdmpc2_pixels pretrain=vjepa"]
)
def test_a_gpu_must_have_room_for_its_part_alone(monkeypatch, settled, model: str) -> None:
    """Who starts the processes asks that of each, and not of the whole job; lines name the job's numbers."""
    words = [
        *model.split(),
        "scale=smoke",
        "device=cuda",
        "replay.capacity=4000000",
        "evaluation.video_episodes=0",
    ]
    for module in (check, storage_budget):
        monkeypatch.setattr(module, "resolve_device", lambda _: torch.device("cuda", 0))
    spaces = Spaces.of_config(settled(*words).env.arm)
    step = storage_budget._bytes(make_model(settled(*words), spaces, "meta"))
    monkeypatch.setattr(storage_budget, "free_memory", lambda device: 3e6 * step)
    refused = r"replay\.capacity=4000000\): at least {} GB{}, .*free on cuda:0"
    assert re.search(refused.format(f"{4e-3 * step:.1f}", ""), str(check_command(words)))
    assert check_command([*words, "gpus=2"]) is None
    monkeypatch.setattr(storage_budget, "free_memory", lambda device: 1.9e6 * step)
    said = refused.format(f"{2e-3 * step:.1f}", " on each of 2 GPUs")
    assert re.search(said, str(check_command([*words, "gpus=2"])))
    assert settled(*words, "gpus=2", "device=cpu").of_one_gpu().parts == 1  # all have one memory


def test_a_process_names_the_numbers_of_the_whole_job(monkeypatch, settled) -> None:
    job = ("scale=smoke", "device=cpu", "env=reach", "gpus=2")
    monkeypatch.setattr(processes, "count", lambda: 2)
    run = settled(*job, "replay.capacity=4000", "trainer.updates=10000000")
    batch = TensorDict({"x": torch.zeros(4, 5, 250)}, [4, 5])  # 1 kB a step
    replay = make_replay(capacity=2000, num_envs=4, window=2, batch_size=2, device="cpu")
    monkeypatch.setattr(storage_budget, "free_memory", lambda device: 1e6)
    said = r"=4000: .* on each of 2 processes \(1\.0 kB a step\) .*at most replay\.capacity=1800 would"
    with pytest.raises(UserError, match=said):
        storage_budget.fill(replay, batch, run)
    with pytest.raises(UserError, match=r"planner_worlds=10: .* at most collector\.num_envs=8;"):
        check.check(settled(*job, "collector.planner_worlds=10"))
    least = r"replay\.capacity=21: must be at least 32 for collector\.num_envs=8: windows have 3 steps"
    with pytest.raises(UserError, match=least):
        check.check(settled(*job, "replay.capacity=21"))


def test_what_cannot_be_allocated_is_one_line_as_well(monkeypatch, settled) -> None:
    """Where free memory is not known, or what is asked for is more than the machine has in all."""
    cfg = settled("scale=smoke").changed(
        replay={"capacity": 10**14},
        collector={"num_envs": 4, "seed_steps": 1, "steps_per_batch": 1},
        trainer={"updates": 0, "updates_per_batch": 1},
    )
    replay = make_replay(capacity=10**14, num_envs=4, window=2, batch_size=2, device="cpu")
    batch = TensorDict({"x": torch.zeros(4, 5, 3), "is_init": torch.zeros(4, 5, 1, dtype=torch.bool)}, [4, 5])
    with pytest.raises(UserError, match=r"replay\.capacity=100000000000000: .* cannot be allocated on cpu"):
        storage_budget.fill(replay, batch, cfg)


def test_free_memory_is_that_of_the_machine() -> None:
    free = storage_budget.free_memory(torch.device("cpu"))
    assert free is None or 1e7 < free < 1e14


def test_free_memory_is_no_more_than_the_container_may_use(tmp_path, monkeypatch) -> None:
    assert left_of_container(tmp_path) is None
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "memory.current").write_text("3000000\n")
    (tmp_path / "memory.stat").write_text(
        "anon 5\ninactive_file 600000\nactive_file 300000\nslab_reclaimable 100000\n"
    )
    assert left_of_container(tmp_path) is None
    (tmp_path / "memory.max").write_text("10000000\n")
    assert left_of_container(tmp_path) == 8_000_000  # what is only cached may go
    monkeypatch.setattr(memory, "left_of_container", lambda _: 8_000_000)
    if memory.free_memory("cpu") is not None:
        assert memory.free_memory("cpu") == 8_000_000


@pytest.mark.parametrize(
    ("settings", "per_step"),
    [
        # Goal images are the worlds' alone, and no transition has one.
        ("env=reach_fixed_goal_image model=lewm model.observations=[pixels,pixels_side]", 2 * 64 * 64 * 3),
        ("env=reach_pixels env.frame_stack=3 model=tdmpc2_pixels model.observations=[pixels]", 64 * 64 * 3),
        ("env=reach model=tdmpc2", 4 * FrankaConfig().state_dim),
    ],
)
def test_before_anything_is_built_experience_is_what_the_model_reads(
    settings: str, per_step: int, monkeypatch, settled
) -> None:
    run = settled(
        *settings.split(),
        *(["env.cameras=[front,side]"] if "pixels" in settings else []),
        "scale=smoke",
        "replay.capacity=1000000",
        "trainer.updates=10000000",
        "evaluation.video_episodes=0",
    )
    spaces = Spaces.of_config(run.env.arm)
    model = make_model(run, spaces, "meta")
    monkeypatch.setattr(storage_budget, "free_memory", lambda device: 1e6 * per_step + 3e7)
    storage_budget.check_memory(run, model, spaces)
    monkeypatch.setattr(storage_budget, "free_memory", lambda device: 1e6 * per_step - 1)
    with pytest.raises(UserError, match=r"replay\.capacity=1000000.*do not fit"):
        storage_budget.check_memory(run, model, spaces)


@pytest.mark.parametrize(("env", "marks"), [("lift", True), ("multitask", True), ("reach", False)])
def test_a_replay_of_worlds_with_a_scene_keeps_which_steps_lost_contacts(
    settled, env: str, marks: bool
) -> None:
    settings = settled(f"env={env}", "device=cpu", "scale=smoke", "collector.num_envs=8")
    replay = make_replay_buffer(settings, torch.device("cpu"))
    trainer = SimpleNamespace(settings=settings, _keys=["state"], _extra=[])
    assert replay.sampler.marks is (OVERFLOW in Trainer.kept.fget(trainer)) is marks


def test_a_run_that_resumes_may_go_on_from_other_worlds(settled) -> None:
    """Those that are put back may look a little different; a batch that is gathered must follow on the one before."""
    state = torch.arange(3.0).reshape(1, 3, 1).expand(4, 3, 3)
    steps = {"state": state[:, :2], "is_init": torch.zeros(4, 2, 1, dtype=torch.bool)}
    batch = TensorDict({**steps, "next": TensorDict({"state": state[:, 1:]}, [4, 2])}, [4, 2])
    for restored in (True, False):
        replay = make_replay(capacity=40, num_envs=4, window=2, batch_size=2, device="cpu")
        storage_budget.fill(replay, batch, settled("scale=smoke"), restored=restored)
        if restored:
            replay.extend(batch)
        with pytest.raises(UserError, match="must go on where the last one ended"):
            replay.extend(batch)
