"""``franka-wm compare``: several runs side by side on one page."""

from __future__ import annotations

from pathlib import Path

import click

from franka_wm.commands.arguments import verb, word
from franka_wm.errors import UserError
from franka_wm.files import unwritable


@verb("compare")
@click.argument("runs", nargs=-1, required=True, metavar="RUN RUN …|SWEEP")
@word("out", "the page to write", default="compare.html")
def compare(runs: tuple[str, ...], out: str) -> None:
    """Show several runs side by side on one page.

    Of a sweep, runs that have not been evaluated yet, or failed, are named and left out.
    """
    check_page("compare", out)
    for one in runs:
        if not Path(one).is_dir():
            raise UserError(f"{one} is not a folder; give the folder of a run, as train.py prints it last.")
    from franka_wm.report.compare import compare_page
    from franka_wm.report.document import write_document
    from franka_wm.report.run import read_run
    from franka_wm.report.seeds import evaluated

    found = [read_run(run) for folder in runs for run in evaluated(folder, print)]
    print(write_document(compare_page(found), Path(out)))


def check_page(verb: str, out: str | None) -> None:
    """Whether a page can be written there, asked before anything is read.

    Raises:
        UserError: The name does not end in .html, or the folder is not writable.
    """
    if out is None:
        return
    if not out.lower().endswith(".html"):
        raise UserError(f"{verb}: out={out}: the page must end in .html")
    if (why := unwritable(Path(out).parent)) is not None:
        raise UserError(f"{verb}: out={out}: {why}; choose another place")
