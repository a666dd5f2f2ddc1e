"""Overrides that are wrong, in one line."""

from __future__ import annotations

import pytest

from franka_wm.commands import entry
from franka_wm.commands.overrides import compose, values
from franka_wm.errors import UserError
from franka_wm.training.run import import_plugins
from franka_wm.training.settings import RunSettings

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
        (["--fast", "-m", "seed=1,2"], "unrecognized arguments: --fast"),
        (["-1x"], "unrecognized arguments: -1x"),
    ],
)
def test_options_with_dashes_are_told_how_to_be_written(words: list[str], said: str, capsys) -> None:
    with pytest.raises(SystemExit):
        entry._run(lambda: pytest.fail("begun"), words)
    assert capsys.readouterr().err == f"error: {said}{FLAGS}"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["env.task_options.height=1"], "height: no such option; task=reach has none; leave them out"),
        (["env=lift", "env.task_options.a=1"], "a: no such option; task=lift has none; leave them out"),
        (
            ["env.task=raise_tool", "env.task_options.hight=1"],
            "hight: no such option; task=raise_tool has height=0.75",
        ),
        (
            ["env.task=raise_tool", "env.task_options.height=0.8"],
            "height: the preset does not name it; write +env.task_options.height=0.8; task=raise_tool has height=0.75",
        ),
        (
            ["env.task=nope", "env.task_options.height=1"],
            "height: no such option; did you mean env.task_options?",
        ),
        (["env=gym", "env.task_options.height=1"], "height: no such option; there are env, model"),
    ],
)
def test_an_unknown_option_of_a_task_names_those_that_it_has(
    words: list[str], said: str, registries_as_before: None
) -> None:
    with pytest.raises(UserError) as refused:
        compose(["plugins=[examples.add_a_task]", *words])
    assert str(refused.value).startswith(f"env.task_options.{said}")


def test_an_option_of_a_task_that_the_preset_does_not_name_can_be_added(registries_as_before: None) -> None:
    words = ["plugins=[examples.add_a_task]", "env.task=raise_tool", "+env.task_options.height=0.8"]
    import_plugins(["examples.add_a_task"])
    assert RunSettings.of(compose([*words, "scale=smoke"])).env.arm.task_options == {"height": 0.8}


@pytest.mark.parametrize("first", ["env.bogus=1", "env.task_options.height=1"])
def test_of_two_wrong_overrides_the_first_is_told(first: str) -> None:
    """To name what there is the others are composed, of which one is wrong, too."""
    with pytest.raises(UserError, match=f"^{first.partition('=')[0]}: no such option$"):
        compose([first, "nope=3"])


@pytest.mark.parametrize(
    ("override", "found"),
    [
        ("device=cpu,cuda:1", ["cpu", "cuda:1"]),
        ("device=choice(cuda:0,cuda:1)", ["cuda:0", "cuda:1"]),
        ("++device='cuda:0'", ["cuda:0"]),
        ("seed=3", []),
    ],
)
def test_all_values_of_a_list(override: str, found: list[str]) -> None:
    assert values(["env=lift", override], "device") == found
