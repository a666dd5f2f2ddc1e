"""Tests leave no task, model or planner behind for those that run after them in the same process."""

from franka_wm.envs import tasks


def test_a_task_that_a_test_registers_and_removes_others() -> None:
    tasks.register("left_behind", tasks.Reach)
    tasks.TASKS.remove("reach")


def test_is_not_there_for_the_next_one() -> None:
    assert "left_behind" not in tasks._REGISTERED and "left_behind" not in tasks.TASKS
    assert "reach" in tasks.TASKS
