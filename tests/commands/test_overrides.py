"""Overrides that are wrong, in one line."""

from __future__ import annotations

import pytest

from franka_wm.commands import entry

FLAGS = "; python train.py --hydra-help lists the flags\n"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--seed", "3"], "--seed 3: no such flag; options have no dashes, write seed=3"),
        (["env=reach", "--seed=3"], "--seed=3: no such flag; options have no dashes, write seed=3"),
        (
            ["--env.fps", "20", "model=dreamer", "--seed", "-1", "--fast"],
            "--env.fps 20 --seed -1 --fast: no such flag; options have no dashes, write env.fps=20 seed=-1",
        ),
        # Hydra's parser would take it for --experimental-rerun.
        (
            ["--experiment", "images"],
            "--experiment images: no such flag; options have no dashes, write experiment=images",
        ),
        (["--fast", "env=reach", "--faster"], "unrecognized arguments: --fast --faster"),
    ],
)
def test_options_with_dashes_are_told_how_to_be_written(words: list[str], said: str, capsys) -> None:
    with pytest.raises(SystemExit):
        entry._run(lambda: pytest.fail("begun"), words)
    assert capsys.readouterr().err == f"error: {said}{FLAGS}"
