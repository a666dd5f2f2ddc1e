"""A task of one's own is judged by its own success, return and measures, in everything that a run shows."""

from __future__ import annotations

import importlib
import json
from types import ModuleType
from typing import Any

import pytest
import torch
from tensordict import NestedKey, TensorDict

from franka_wm.commands.main import main
from franka_wm.envs import FrankaConfig, FrankaEnv
from franka_wm.envs.tasks import Reach, TorchTask, Track
from franka_wm.errors import UserError
from franka_wm.evaluation import diagnose, robustness
from franka_wm.evaluation.closed_loop import play_episodes, success_distance, summarize
from franka_wm.evaluation.protocol import (
    Evaluation,
    describe,
    evaluate_policies,
    numbers_to_log,
    protocol,
    thresholds,
)
from franka_wm.evaluation.results import END, last_row, score
from franka_wm.evaluation.robustness import verdict_of_success
from franka_wm.policies.scripted import IKPolicy, NoopPolicy, SmoothRandomPolicy
from franka_wm.report.compare import compare_page
from franka_wm.report.curves import axis, panel_figure, panels, plot_learning_curves
from franka_wm.report.diagnostics import evaluation_markdown, robustness_table
from franka_wm.report.page import page
from franka_wm.report.run import read_run
from franka_wm.report.seeds import seeds_table
from tests.conftest import SMALL

LENGTH = 10


@pytest.fixture(scope="module", autouse=True)
def example() -> ModuleType:
    """Imported here: forks that begin before any test shall not know what it registers."""
    return importlib.import_module("examples.add_a_task")


@pytest.fixture(scope="module")
def env(example: ModuleType) -> FrankaEnv:
    """Episodes that end at a success go on into others, whose height must not be taken for theirs."""
    config = FrankaConfig(**SMALL, pose_noise=0.6, episode_length=LENGTH, terminate_on_success=True)
    return FrankaEnv(config, num_envs=6, device="cpu", task=example.RaiseTool(config))


@pytest.fixture(scope="module")
def found(env: FrankaEnv) -> Evaluation:
    oracle = IKPolicy(env.kinematics, env.config)
    random = SmoothRandomPolicy(generator=torch.Generator().manual_seed(0))
    return evaluate_policies(env, {"planner": random, "ik": oracle, "noop": NoopPolicy()})


def test_success_and_measures_at_the_true_end(env: FrankaEnv, example: ModuleType) -> None:
    """Played by hand: the height of the last observation of each world's first episode."""
    episodes = play_episodes(env, SmoothRandomPolicy(generator=torch.Generator().manual_seed(3)), seed=2)
    policy = SmoothRandomPolicy(generator=torch.Generator().manual_seed(3))
    observation, height, success = env.reset(seed=2), torch.full((6,), torch.nan), torch.zeros(6)
    for _ in range(LENGTH):
        step, observation = env.step_and_maybe_reset(policy(observation))
        ended = step["next", "done"].squeeze(-1) & height.isnan()
        height = torch.where(ended, step["next", "state"][:, 16], height)
        success = torch.where(ended, step["next", "success"].squeeze(-1).float(), success)
    assert torch.equal(episodes["measures", "height [m]"], height)
    assert torch.equal(episodes["success"], success) and 0 < success.sum() < 6
    assert torch.equal(episodes["success"], (height >= example.HEIGHT).float())
    assert episodes["success_once"].sum() >= success.sum()
    assert not {"final_distance", "closest_distance"} & set(episodes.keys())


def test_reach_is_judged_by_distances_as_ever(small_env) -> None:
    """Its own success is to be within success_distance, which is among the thresholds."""
    reach = small_env(6, episode_length=LENGTH, goal_sampling="reachable", success_distance=0.3)
    assert success_distance(reach) == 0.3 and thresholds(reach) == [0.3, 0.05, 0.025, 0.01]
    evaluation = evaluate_policies(reach, {"noop": NoopPolicy()})
    rows, told = evaluation.episodes["noop"], evaluation.policies["noop"]
    assert torch.equal(rows["success"], (rows["final_distance"] < 0.3).float()) and rows["success"].sum() > 0
    assert list(told["success"]) == ["0.3", "0.05", "0.025", "0.01"] and "measures" not in told
    assert told["success"]["0.3"]["mean"] == rows["success"].mean()


def test_a_subclass_of_reach_that_judges_otherwise_is_judged_by_itself(example: ModuleType) -> None:
    class Otherwise(Reach):
        def reward_and_success(self, sim) -> None: ...

    class Near(Otherwise):
        goal_distance = True

    config = FrankaConfig()
    assert Reach(config).goal_distance and Track(config).goal_distance and Near(config).goal_distance
    assert not (Otherwise(config).goal_distance or example.RaiseTool(config).goal_distance)
    assert Reach(config).success_distance == Track(config).success_distance == config.success_distance
    assert Otherwise(config).success_distance is Near(config).success_distance is None


class Never(TorchTask):
    """A goal that is reached at once, and never counts."""

    goal_distance = True

    def goal(self, draws: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(draws[:, :3]) + draws.new_full((3,), 0.4)

    def reward(self, state: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return -state[..., 17:20].norm(dim=-1)

    def success(self, state: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(state[..., 0], dtype=torch.bool)


def test_a_task_about_a_distance_that_judges_otherwise_shows_both(settled, tmp_path) -> None:
    """How near the tool came, and the task's own success: not how many came within 5 cm."""
    config = FrankaConfig(**SMALL, episode_length=40)
    env = FrankaEnv(config, num_envs=4, device="cpu", task=Never(config))
    found = evaluate_policies(env, {"planner": IKPolicy(env.kinematics, env.config), "noop": NoopPolicy()})
    planner = found.policies["planner"]
    assert planner["final_distance"]["mean"] < 0.02, "inverse kinematics would be counted within 5 cm"
    assert planner["success"]["mean"] == planner["success_once"]["mean"] == 0.0
    assert "success 0 %, final distance" in describe("planner", planner)
    assert evaluation_markdown(found).startswith("| policy | final distance [cm] | success [%] | return |")
    assert numbers_to_log(env, {"noop": NoopPolicy()})["eval/noop/success"] == 0.0
    assert score(found.policies) == 0.0
    table = seeds_table([found.policies])
    assert "final distance [cm] | success [%]" in table and "within" not in table
    run = tmp_path / "run"
    run.mkdir()
    (run / "config.yaml").write_text("env: {success_distance: 0.05}\nevaluation: {during: [planner]}\n")
    told = protocol(settled("scale=smoke", "env=reach"), env, found, by=END, counters={"updates": 9})
    (run / "evaluation.json").write_text(json.dumps({"protocol": told, "policies": found.policies}))
    text = page(read_run(run))
    assert "success at" not in text and "as the task judges" in text
    assert diagnose._reaches(env)
    episodes = found.episodes["planner"]
    compared = robustness._compared(episodes, episodes, success_distance(env))
    assert set(compared) == {"return", "success", "return_change", "verdict"}


@pytest.mark.parametrize(("task", "marked"), [("reach", True), ("box", False)])
def test_a_run_that_is_not_evaluated_marks_the_distance_of_reach_alone(task, marked, tmp_path) -> None:
    (tmp_path / "config.yaml").write_text(f"env: {{task: {task}, success_distance: 0.05}}\n")
    logged = tmp_path / "csv" / "scalars" / "eval" / "planner" / "final_distance.csv"
    logged.parent.mkdir(parents=True)
    logged.write_text("100,0.3\n200,0.2\n")
    text = page(read_run(tmp_path))
    assert "final distance to the goal" in text and ("success: 5 cm" in text) is marked


def test_a_goal_set_by_hand_on_the_live_page_is_judged_by_the_task() -> None:
    from franka_wm.live.session import Session

    config = FrankaConfig(**SMALL)
    env = FrankaEnv(config, num_envs=1, device="cpu", task=Never(config))
    session = Session(env, {"noop": NoopPolicy()}, policy="noop")
    assert not session.set_goal(tuple(session.frame().tool.tolist())).success


def test_no_distance_is_shown_anywhere(env: FrankaEnv, found: Evaluation) -> None:
    assert success_distance(env) is None and thresholds(env) == []
    for summary_ in found.policies.values():
        assert {"success", "success_once", "return", "measures", "episodes"} <= set(summary_)
        assert "final_distance" not in summary_ and set(summary_["success"]) == {"mean", "low", "high"}
    text = evaluation_markdown(found)
    assert text.startswith("| policy | success [%] | height [m] | return | episodes |")
    assert "distance [cm]" not in text and "once [%]" in text
    assert describe("planner", found.policies["planner"]).startswith("  planner: success ")
    numbers = numbers_to_log(env, {"noop": NoopPolicy()})
    assert set(numbers) == {f"eval/noop/{name}" for name in ("success", "return", "height_m")}
    assert numbers["eval/noop/height_m"] == found.policies["noop"]["measures"]["height [m]"]["mean"]


def test_pages_curves_and_summaries_show_it(env: FrankaEnv, found: Evaluation, tmp_path, capsys) -> None:
    protocol = {"by": END, "updates": 20, "env_steps": 200, "training_seconds": 1.0}
    for k in range(2):
        run = tmp_path / f"run{k}"
        run.mkdir()
        (run / "config.yaml").write_text(
            f"env: {{task: raise_tool}}\nevaluation: {{during: [planner]}}\nseed: {k}\n"
        )
        (run / "evaluation.json").write_text(json.dumps({"protocol": protocol, "policies": found.policies}))
    read = read_run(tmp_path / "run0")
    last = last_row(read.results, ["planner"])
    mean = found.policies["planner"]["measures"]["height [m]"]["mean"]
    assert last["eval/planner/height_m"] == mean and last["env_steps"] == 200
    assert read.rows == [last] and "height_m" in panels(read.rows)
    assert panel_figure(read.rows, "height_m") is not None
    assert panel_figure(read.rows, "final_distance") is None
    text = page(read)
    assert "height [m]" in text and "success" in text and "final distance" not in text
    assert "as the task judges" in text
    assert "height [m]" in compare_page([read_run(tmp_path / f"run{k}") for k in range(2)])
    assert main(["summary", str(tmp_path / "run0"), str(tmp_path / "run1")]) == 0
    assert "| policy | success [%] | return | height [m] |" in capsys.readouterr().out
    assert "final distance" not in seeds_table([found.policies])
    assert axis(read.rows) == "env_steps"
    assert plot_learning_curves(read.rows, tmp_path / "curves.png").stat().st_size > 1000


def test_what_a_shift_breaks_is_said_by_success() -> None:
    before = torch.zeros(100, dtype=torch.bool)
    before[:50] = True
    after = before.clone()
    assert verdict_of_success(after, before) == "holds"
    after[:20] = False
    assert verdict_of_success(after, before) == "worse"
    after[:40] = False
    assert verdict_of_success(after, before) == "breaks"
    assert verdict_of_success(after, torch.zeros(100, dtype=torch.bool)) == "never worked"
    interval = {"mean": 0.5, "low": 0.4, "high": 0.6}
    row = {"return": interval, "success": interval, "return_change": None, "verdict": ""}
    table = robustness_table({"as trained": {"planner": row}}, 0.05)
    assert table.header == ["shift", "policy", "return", "change", "success [%]", "verdict"]


@pytest.mark.parametrize(
    ("given", "said"), [(torch.zeros(6, 1), r"\(6, 1\)"), (3.0, "3.0")], ids=["a column", "a number"]
)
def test_a_measure_of_another_shape_is_named(given: object, said: str, env: FrankaEnv, monkeypatch) -> None:
    monkeypatch.setattr(env.simulation.task, "measures", lambda sim: {"height [m]": given})
    line = rf"RaiseTool\.measures gave 'height \[m\]' as {said}; it must be a tensor \(6,\), one number for each world"
    with pytest.raises(UserError, match=line):
        play_episodes(env, NoopPolicy(), seed=2)


def test_measures_that_are_no_dictionary_are_named(env: FrankaEnv, monkeypatch) -> None:
    monkeypatch.setattr(env.simulation.task, "measures", lambda sim: [1.0])
    with pytest.raises(UserError, match=r"RaiseTool\.measures gave list; it must give a dictionary, such as"):
        play_episodes(env, NoopPolicy(), seed=2)


def test_a_measure_that_does_not_apply_to_an_episode_is_left_out_there() -> None:
    measures = {"a": torch.tensor([2.0, torch.nan, 4.0]), "b": torch.full((3,), torch.nan)}
    found: Any = summarize(TensorDict({"measures": measures}, batch_size=[3]))
    assert found["measures"].keys() == {"a"} and found["measures"]["a"]["mean"] == 3.0


@pytest.mark.parametrize(
    ("name", "mend", "odd"), [("return", "reward", torch.nan), (("measures", "a"), "measures", torch.inf)]
)
def test_what_is_not_finite_is_named(name: NestedKey, mend: str, odd: float) -> None:
    episodes = TensorDict({"return": torch.zeros(3), "measures": {"a": torch.zeros(3)}}, batch_size=[3])
    episodes[name] = torch.tensor([0.0, torch.inf, odd])
    label = name if isinstance(name, str) else name[-1]
    with pytest.raises(UserError, match=rf"^{label}: not finite in 2 of 3 episodes; mend the task's {mend}"):
        summarize(episodes)
