"""What policies are called in options, tables and ``evaluation.json``."""

from franka_wm.errors import UserError

POLICIES = ("planner", "policy", "noop", "random", "ik", "expert")
"""The planner; the learned policy alone; doing nothing; smooth random motion; inverse kinematics with true geometry;
a task's own plan with true positions of objects."""

RENAMED = {"oracle": "ik", "smooth": "random"}
"""Names of earlier versions, which old files still hold."""


def refuse_old_name(option: str, name: object) -> None:
    """Refuse a name of an earlier version.

    Raises:
        UserError: It says the present one.
    """
    if isinstance(name, str) and name in RENAMED:
        raise UserError(f"{option}={name}: this policy is called {RENAMED[name]} now")
