"""Tasks by families, of several runs."""

from dataclasses import replace
from pathlib import Path

import pytest

from franka_wm.evaluation.results import Result
from franka_wm.report import tasks
from franka_wm.report.compare import compare_page, repetitions
from franka_wm.report.run import RunFiles, read_run
from franka_wm.report.table import Table
from franka_wm.report.tasks import task_of


def interval(mean: float) -> dict[str, float]:
    return {"mean": mean, "low": 0.9 * mean, "high": 1.1 * mean}


def run(
    task: str, family: str, policies: dict, *, env: dict | None = None, typed: str | None = None
) -> RunFiles:
    return RunFiles(
        Path(f"{task}-{family}"),
        config={"env": env or {"task": task}, "model": {"name": family}},
        overrides=[] if typed is None else [f"env={typed}"],
        results=[Result(Path("evaluation.json"), policies=policies)],
    )


def tasks_table(runs: list[RunFiles]) -> Table | None:
    return tasks.tasks_table(repetitions({str(k): one for k, one in enumerate(runs)}))


def success(rate: float, **more) -> dict:
    return {"success": interval(rate), "return": interval(3.0), **more}


def test_runs_of_one_task_and_family_share_a_cell() -> None:
    near = {"success": {"0.05": interval(0.5), "0.01": interval(0.1)}, "final_distance": interval(0.02)}
    table = tasks_table(
        [
            run("push", "tdmpc2", {"planner": success(0.9), "policy": success(0.1), "noop": success(0.0)}),
            run("push", "tdmpc2", {"planner": success(0.8)}),
            run("push", "dreamer", {"policy": success(0.7), "random": success(1.0)}),
            run("reach", "tdmpc2", {"planner": near}, typed="reach_fixed"),
            run(
                "",
                "dreamer",
                {"planner": {"return": interval(812.34)}},
                env={"name": "walker", "task": "walk"},
            ),
            run("push", "lewm", {"noop": success(1.0)}),  # nothing of its own was measured
            RunFiles(Path("empty")),
        ]
    )
    assert table is not None
    assert table.header == ["task", "dreamer", "tdmpc2"]
    assert table.rows == [
        ["push", "70 %", "85 % (80 – 90, 2 runs)"],
        ["reach_fixed", "–", "50 % within 5 cm"],
        ["walker walk", "return 812.3", "–"],
    ]


def test_a_task_of_ones_own_is_named_after_itself() -> None:
    """Not after the preset whose rate and camera it has."""
    mine = replace(run("mine", "tdmpc2", {}), overrides=["plugins=[mine]", "env=reach", "env.task=mine"])
    assert task_of(mine) == "mine"


@pytest.mark.parametrize(
    ("typed", "chosen", "said"),
    [
        ("experiment=images_fixed", "reach_fixed_pixels", "reach_fixed_pixels"),
        ("experiment=of_mine", "push", "reach (push)"),  # which changes the preset's task
        ("experiment=of_mine", "reachable", "reach (reachable)"),
        ("env=reach env.task=reach", "push", "reach"),
        ("env=kitchen", "kitchen", "kitchen"),
        ("resume=/before", "push", "reach"),  # Hydra composed the defaults, which the run then left
        ("resume=null experiment=mine", "reach_fixed_pixels", "reach_fixed_pixels"),
        ("env=reach_fixed", None, "reach_fixed"),
    ],
)
def test_a_preset_that_an_experiment_chose_is_its_name(
    typed: str, chosen: str | None, said: str, make_run
) -> None:
    hydras = make_run() / ".hydra"  # of the task reach
    (hydras / "overrides.yaml").write_text("".join(f"- {one}\n" for one in typed.split()))
    if chosen is not None:
        (hydras / "hydra.yaml").write_text(f"hydra: {{runtime: {{choices: {{env: {chosen}}}}}}}")
    assert task_of(read_run(hydras.parent)) == said


def test_what_was_measured_differently_is_not_averaged() -> None:
    table = tasks_table(
        [
            run("mine", "a", {"planner": success(0.5)}),
            run("mine", "a", {"planner": {"return": interval(2.0)}}),
            run("mine", "b", {"planner": success(0.5)}),
        ]
    )
    assert table is not None and table.rows == [["mine", "measured as % and return", "50 %"]]


def test_one_task_of_one_family_needs_no_table() -> None:
    assert tasks_table([run("push", "a", {"planner": success(0.5)})] * 2) is None
    assert tasks_table([RunFiles(Path("empty"))]) is None


def test_a_run_of_several_tasks_stands_beside_those_of_one() -> None:
    rates = {"push": interval(0.6), "lift": interval(0.25)}
    several = run("", "tdmpc2", {"planner": success(0.4, task_success=rates)}, typed="multitask")
    assert tasks_table([several]).rows == [["lift", "25 %"], ["push", "60 %"]]  # pyright: ignore[reportOptionalMemberAccess]
    table = tasks_table([several, run("push", "tdmpc2", {"planner": success(0.9)})])
    assert table is not None and table.header == ["task", "tdmpc2", "tdmpc2, multitask"]
    assert table.rows == [["lift", "–", "25 %"], ["push", "90 %", "60 %"]]


def test_runs_that_differ_in_more_than_their_seed_are_not_averaged() -> None:
    slow, fast = (run("push", "a", {"planner": success(rate)}) for rate in (0.9, 0.3))
    fast = replace(fast, folder=Path("fast"), config={**fast.config, "trainer": {"lr": 1.0}})
    again = replace(slow, folder=Path("again"), config={**slow.config, "seed": 7})
    other = run("lift", "a", {"planner": success(0.5)})
    groups = repetitions({"slow": slow, "fast": fast, "again": again, "other": other})
    table = tasks.tasks_table(groups)
    assert table is not None and table.rows[1] == ["push", "slow: 90 % (90 – 90, 2 runs); fast: 30 %"]


def test_each_task_has_a_chart_of_all_families(make_run) -> None:
    runs = [make_run(name) for name in ("a", "b", "unlogged")]
    for folder, family in zip(runs, ("tdmpc2", "dreamer", "lewm"), strict=True):
        config = folder / "config.yaml"
        config.write_text(config.read_text().replace("tdmpc2", family))
        if folder.name != "unlogged":
            (folder / "csv" / "scalars" / "eval" / "planner" / "success.csv").write_text(
                "100,0.5\n200,0.75\n"
            )
    page = compare_page([read_run(folder) for folder in runs])
    drawn = page.split("<title>success at reach_fixed while training")[1].split("</svg>")[0]
    assert "a (tdmpc2)" in drawn and "b (dreamer)" in drawn and "unlogged" not in drawn
    assert page.count("<title>success at") == 1


def test_curves_of_recorded_data_stand_beside_others_by_updates() -> None:
    """It makes no environment steps: its points would lie on one another."""
    config = {"env": {"task": "push"}, "model": {"name": "a"}}
    drawn = {}
    for name, each in (("online", 10), ("offline", 0)):
        rows = [{"env_steps": each * k, "updates": k, "eval/planner/success": k / 4} for k in range(1, 4)]
        one = run("push", name, {"planner": success(0.5)})
        drawn[name] = replace(one, rows=rows, config={**config, "model": {"name": name}})
    page = compare_page(list(drawn.values()))
    assert "environment steps" not in page and page.count(">updates<") >= 2
    page = compare_page([drawn["online"], replace(drawn["online"], folder=Path("again"))])
    assert "environment steps" in page


def test_success_over_time_is_found_for_each_task() -> None:
    """Of the planner before the policy; of several tasks at once each task's own."""
    rows = [{"env_steps": 1, "eval/policy/success": 0.1, "eval/planner/success": 0.2}]
    one = replace(run("push", "a", {"planner": success(0.5)}), rows=rows)
    assert tasks.success_over_time(one) == {"push": "eval/planner/success"}
    assert tasks.success_over_time(run("push", "a", {"planner": success(0.5)})) == {}
    rates = {"push": interval(0.6), "lift": interval(0.25)}
    rows = [{"env_steps": 1, "eval/planner/success": 0.2, "eval/policy/success_push": 0.3}]
    several = replace(run("", "a", {"planner": success(0.4, task_success=rates)}), rows=rows)
    assert tasks.success_over_time(several) == {"push": "eval/policy/success_push"}


def test_what_was_planned_otherwise_has_a_column_of_its_own() -> None:
    """Also of a folder of results alone, which has no configuration."""
    protocol = {"task": "push", "model": "tdmpc2"}
    one = run("push", "tdmpc2", {"planner": success(0.9)}, typed="push")
    others = [
        RunFiles(Path(name), results=[Result(Path("r"), protocol=told, policies={"planner": success(rate)})])
        for name, rate, told in (
            ("as_it_was", 0.7, protocol),
            ("cem", 0.5, protocol | {"planned with": "planner=cem"}),
        )
    ]
    table = tasks_table([one, *others])
    assert table is not None and table.header == ["task", "tdmpc2", "tdmpc2, planner=cem"]
    assert table.rows == [["push", "0: 90 %; 1: 70 %", "50 %"]]


def test_a_baseline_that_is_the_same_in_all_runs_is_listed_once() -> None:
    runs = [run("push", name, {"planner": success(0.5), "noop": success(0.25)}) for name in "ab"]
    page = compare_page(runs)
    baselines = page.split("Baselines")[1].split("</details>")[0]
    assert "push-a, push-b" in baselines and baselines.count(">25<") == 1
    runs[1] = run("push", "b", {"planner": success(0.5), "noop": success(0.125)})
    assert "push-a, push-b" not in compare_page(runs).split("Baselines")[1].split("</details>")[0]


def test_success_of_each_of_several_tasks_is_drawn_once() -> None:
    rates = {"push": interval(0.6), "lift": interval(0.25)}
    rows = [{"env_steps": k, "eval/planner/success_push": 0.1 * k} for k in (1, 2)]
    one = replace(run("", "a", {"planner": success(0.4, task_success=rates)}), rows=rows)
    page = compare_page([one, replace(one, folder=Path("again"), config={**one.config, "seed": 7})])
    assert page.count("<title>success at push while training") == 1
    assert "successful episodes of push [%], planner, of all runs" not in page
    still = [
        replace(one, folder=Path(name), results=[]) for name in "ab"
    ]  # running yet: without a table of tasks
    assert "<title>successful episodes of push [%], planner, of all runs while training" in compare_page(
        still
    )


def test_returns_of_different_tasks_have_charts_of_their_own() -> None:
    rows = [{"env_steps": k, "eval/planner/return": 2.0 * k} for k in (1, 2)]
    runs = [replace(run(task, "a", {"planner": success(0.5)}), rows=rows) for task in ("push", "lift")]
    page = compare_page(runs)
    for task in ("push", "lift"):
        drawn = page.split(f"<title>return of an episode, planner, of all runs of {task} while")[1].split(
            "</svg>"
        )[0]
        assert f"{task}: return of an episode" in drawn
    runs[1] = replace(runs[0], folder=Path("again"))
    assert compare_page(runs).count("<title>return of an episode, planner, of all runs while") == 1
