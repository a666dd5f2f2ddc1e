"""``franka-wm demo``: the live page with a small trained agent that the package brings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from franka_wm.commands.view import view
from franka_wm.errors import UserError

AGENT = Path(__file__).parents[1] / "demo_agent"
"""A checkpoint without optimiser and replay; ``make demo-agent`` writes it."""

USAGE = """usage: franka-wm demo [key=value …]

The live page with a small trained agent: drag the goal, and the planner moves the arm there. Nothing is trained or
downloaded.

  port=8080  seconds=S  seed=0  device=auto  policy=NAME  rerun=FILE.rrd  env.KEY=VALUE    as for franka-wm view"""


def demo(arguments: Sequence[str]) -> None:
    """Serve the page of :func:`franka_wm.commands.view.view` with the packaged agent.

    Raises:
        UserError: Another checkpoint was named, or what ``view`` refuses.
    """
    if any(argument in ("--help", "-h") for argument in arguments):
        print(USAGE)
        return
    if any(argument.lstrip("-").startswith("checkpoint=") for argument in arguments):
        raise UserError(
            "demo: shows the agent of the package; for another one: franka-wm view checkpoint=RUN"
        )
    view([f"checkpoint={AGENT}", *arguments])
