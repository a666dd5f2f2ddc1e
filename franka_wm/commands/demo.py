"""``franka-wm demo``: the live page with a small trained agent that the package brings."""

from __future__ import annotations

from pathlib import Path

from franka_wm.commands.arguments import verb
from franka_wm.commands.view import show, view

AGENT = Path(__file__).parents[1] / "demo_agent"
"""A checkpoint without optimiser and replay; ``make demo-agent`` writes it."""


@verb(
    "demo",
    params=[one for name, one in view.words.items() if name not in ("checkpoint", "env", "plugins")],
    others=view.others,
    shown=view.shown,
)
def demo(**options: object) -> None:
    """Show a small trained agent in the browser. Drag the goal, and the planner moves the arm there.

    Nothing is trained or downloaded. For an agent of your own: franka-wm view checkpoint=RUN.
    """
    show(checkpoint=str(AGENT), **options)
