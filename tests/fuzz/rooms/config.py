"""Every option of the configuration, with values that nobody means."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from rooms.forked import AcceptedError, NotApplicable
from rooms.odd import values

SMOKE = ["scale=smoke", "device=cpu"]
BASES = [
    [],
    ["env=reach_pixels", "model=tdmpc2_pixels", "planner=cem"],
    ["env=reach_goal_image", "model=lewm", "planner=icem"],
    ["env=reach_goal_image", "model=action_world_model", "pretrain=vjepa"],
    ["env=reach_fixed", "model=muzero", "planner=gumbel"],
    ["env=reach", "model=muzero", "planner=mcts", "export=lerobot"],
    ["env=gym", "model=tdmpc2", "planner=mppi"],
    ["env=lift", "model=tdmpc2"],
    ["env=reach_goal_image", "model=jepa", "planner=gradient"],
]
"""Groups chosen so that each option is there in one of them."""

NOT_OPTIONS = ("hydra", "plugins")  # the user's own code
TEXT_AGAIN = 8
"""One case in so many goes through Hydra's own grammar, which takes as long as the rest together."""


class Config:
    """Cases: `{"base": number, "mutations": [[option, value], …], "typed": whether through Hydra}`."""

    name = "config"
    seconds = 30.0

    def __init__(self, folder: Path) -> None:
        from omegaconf import OmegaConf

        import franka_wm.training.run  # noqa: F401  what every fork needs
        from franka_wm import conf
        from franka_wm.commands import entry  # noqa: F401

        self.composed = [conf.compose(*SMOKE, *base) for base in BASES]
        self.plain: list[Any] = [OmegaConf.to_container(cfg, resolve=True) for cfg in self.composed]
        self.options = [sorted(_options(plain)) for plain in self.plain]
        self.cases = st.integers(0, len(BASES) - 1).flatmap(self._of_base)

    def _of_base(self, base: int) -> st.SearchStrategy[dict[str, Any]]:
        one = st.tuples(st.sampled_from(self.options[base]), values).map(list)
        return st.fixed_dictionaries(
            {
                "base": st.just(base),
                "mutations": st.lists(one, min_size=1, max_size=3, unique_by=lambda m: m[0]),
                "typed": st.integers(1, TEXT_AGAIN).map(lambda k: k == 1),
            }
        )

    def use(self, case: dict[str, Any], folder: Path) -> None:
        """What `python train.py …` checks before it builds or writes anything."""
        import warnings

        from omegaconf import OmegaConf
        from omegaconf.errors import OmegaConfBaseException

        from franka_wm.conf.wrong import explain
        from franka_wm.errors import UserError
        from franka_wm.training.check import check
        from franka_wm.training.settings import RunSettings

        warnings.simplefilter("ignore")
        if case["typed"]:
            self._typed(case, folder)
        else:
            cfg = copy.deepcopy(self.composed[case["base"]])
            try:
                for option, value in case["mutations"]:
                    _update(cfg, option, value)
                OmegaConf.to_container(cfg, resolve=True)
            except OmegaConfBaseException as error:  # as commands/entry.py does
                raise UserError(explain(str(error))) from error
            if cfg.resume is not None:
                return
            check(RunSettings.of(cfg))
        self._must_not_be_here(case)

    def _typed(self, case: dict[str, Any], folder: Path) -> None:
        from franka_wm.commands.entry import check_command, check_overrides
        from franka_wm.errors import UserError

        overrides = [*SMOKE, *BASES[case["base"]], f"hydra.run.dir={folder}/run"]
        overrides += [f"{option}={_as_text(value)}" for option, value in case["mutations"]]
        try:
            check_overrides(overrides)
        except SystemExit as error:  # it has said why, in one line
            raise UserError("refused") from error
        problem = check_command(overrides)
        if problem is not None:
            raise UserError(problem)

    def _must_not_be_here(self, case: dict[str, Any]) -> None:
        for option, value in case["mutations"]:
            if any(other.startswith(f"{option}.") for other in self.options[case["base"]]):
                continue
            default = self.plain[case["base"]]
            for key in option.split("."):
                default = default[key] if isinstance(default, dict) else None
            if _surely_wrong(default, value):
                raise AcceptedError(f"{option}={value!r} (default {default!r})", option)


def _update(cfg: Any, option: str, value: Any) -> None:
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        OmegaConf.update(cfg, option, value, merge=False)
    except OmegaConfBaseException:
        raise
    except (ValueError, TypeError, IndexError) as error:  # its group is a list by now
        raise NotApplicable(str(error)) from error


def _surely_wrong(default: Any, value: Any) -> bool:
    """Whether a value cannot be meant where the default is this one."""
    if isinstance(value, float) and not math.isfinite(value):
        return True
    if isinstance(value, int) and abs(value) > 2**63:
        return True
    if isinstance(default, bool):
        return value is not None and not isinstance(value, bool)
    if isinstance(default, int | float):
        return isinstance(value, str | dict | bool)
    if isinstance(default, str):
        return isinstance(value, dict)
    return False


def _options(plain: dict[str, Any], prefix: str = "") -> list[str]:
    found = []
    for key, value in plain.items():
        if prefix == "" and key in NOT_OPTIONS:
            continue
        found.append(f"{prefix}{key}")
        if isinstance(value, dict):
            found += _options(value, f"{prefix}{key}.")
    return found


def _as_text(value: Any) -> str:
    """A value as Hydra's grammar writes it."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return "'" + value.replace("\\", "\\\\").replace("'", "\\'") + "'"
    if isinstance(value, list):
        return "[" + ",".join(map(_as_text, value)) + "]"
    if isinstance(value, dict):
        return "{" + ",".join(f"{k}: {_as_text(v)}" for k, v in value.items()) + "}"
    return repr(value)
