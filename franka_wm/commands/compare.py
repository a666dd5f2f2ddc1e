"""``franka-wm compare``: several runs side by side on one page."""

from __future__ import annotations

from pathlib import Path

import click

from franka_wm.commands.arguments import verb, word


@verb("compare")
@click.argument("runs", nargs=-1, required=True, metavar="RUN RUN …")
@word("out", "the page to write", default="compare.html")
def compare(runs: tuple[str, ...], out: str) -> None:
    """Show several runs side by side on one page."""
    from franka_wm.report.compare import compare_page
    from franka_wm.report.document import write_document
    from franka_wm.report.run import read_run

    print(write_document(compare_page([read_run(folder) for folder in runs]), Path(out)))
