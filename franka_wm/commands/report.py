"""``franka-wm report``: the page of a run."""

from __future__ import annotations

import click

from franka_wm.commands.arguments import verb, word
from franka_wm.commands.compare import check_page


@verb("report")
@click.argument("run", metavar="RUN")
@word("out", "another place for the page", metavar="PAGE.html")
def report(run: str, out: str | None) -> None:
    """Write a run's page. It is report.html, one self-contained file."""
    check_page("report", out)
    from franka_wm.report.page import write_page

    print(write_page(run, out))
