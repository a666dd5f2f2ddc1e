"""Why training broke: rewards that it learned from come first, wherever they were."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from franka_wm.errors import UserError
from franka_wm.training.broken import beyond_bounds
from franka_wm.training.trainer import Trainer


def steps(*rewards: float) -> TensorDict:
    return TensorDict({"next": {"reward": torch.tensor(rewards)[:, None]}}, batch_size=[len(rewards)])


def broken(
    folder: Path,
    settings: Any,
    *,
    learned: bool,
    drawn: TensorDict,
    kept: TensorDict,
    filled: int | None = None,
) -> str:
    learner = SimpleNamespace(broken=lambda: ["loss"], updates=3, lr=1e-3, grad_clip=20.0)
    filled = len(kept) if filled is None else filled
    replay = SimpleNamespace(storage=SimpleNamespace(_storage=kept, _len_along_dim0=filled))
    given = {
        "learner": learner, "folder": folder, "settings": settings, "env": object(), "replay": replay, "_batch": drawn,
        "model": SimpleNamespace(has_reward=learned, has_value=False),
    }  # fmt: skip
    with pytest.raises(UserError) as caught:
        Trainer.require_finite(SimpleNamespace(**given))  # type: ignore[arg-type]
    return str(caught.value)


def test_a_reward_of_a_batch_before_is_found_in_the_replay(settled, tmp_path: Path) -> None:
    fine, odd, settings = steps(0.0, 1.0), steps(0.0, torch.nan, 1.0), settled("env=reach", "scale=smoke")
    line = broken(tmp_path, settings, learned=True, drawn=fine, kept=odd)
    assert "1 of 3 rewards not finite at update 3; mend the reward of reach" in line
    assert "lower trainer.lr" in broken(tmp_path, settings, learned=True, drawn=fine, kept=fine)
    # What was never written holds whatever the memory held.
    assert "lower trainer.lr" in broken(tmp_path, settings, learned=True, drawn=fine, kept=odd, filled=1)
    assert "lower trainer.lr" in broken(
        tmp_path, settings, learned=False, drawn=odd, kept=odd
    )  # it reads none


def test_a_first_stage_that_breaks_names_its_own_option(settled, tmp_path: Path) -> None:
    words = (
        "env=reach_goal_image",
        "model=action_world_model",
        "planner=cem",
        "pretrain=jepa",
        "scale=smoke",
    )
    learner = SimpleNamespace(broken=lambda: ["loss"], updates=3, lr=1e-3, grad_clip=20.0)
    jepa = SimpleNamespace(has_reward=False, has_value=False)
    for more, names in (((), "pretrain.model.lr"), (("trainer.lr=1e-3",), "trainer.lr")):
        stage = settled(*words, "device=cpu", *more).first_stage()
        with pytest.raises(UserError, match=rf"; lower {names} \(0\.001\)"):
            given = {
                "learner": learner,
                "folder": tmp_path,
                "settings": stage,
                "_batch": None,
                "env": None,
                "model": jepa,
            }
            Trainer.require_finite(SimpleNamespace(**given))  # type: ignore[arg-type]


@pytest.mark.parametrize(("reward", "warns"), [(-3.0, True), (0.5, False), (torch.nan, False), (3.0, True)])
def test_rewards_beyond_their_bounds_are_warned_of_unless_the_run_breaks_by_them(
    reward: float, warns: bool
) -> None:
    model: Any = SimpleNamespace(has_reward=True, has_value=True)
    seen = steps(0.0, reward)
    assert bool(beyond_bounds(model, seen, (-1.0, 1.0))) == warns
    assert not beyond_bounds(model, seen, None) and not beyond_bounds(model, None, (-1.0, 1.0))
    model.has_reward = model.has_value = False
    assert not beyond_bounds(model, seen, (-1.0, 1.0))
