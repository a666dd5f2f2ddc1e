"""``franka-wm compare``: several runs side by side on one page."""

from __future__ import annotations

from pathlib import Path

from franka_wm.commands.arguments import split_arguments, wants_help
from franka_wm.report.compare import FILE, compare_page
from franka_wm.report.document import write_document
from franka_wm.report.run import read_run


def compare(arguments: list[str]) -> None:
    """``franka-wm compare RUN RUN … [out=compare.html]``: writes a page that shows runs side by side."""
    usage = "compare RUN RUN … [out=compare.html]"
    if wants_help(arguments, usage):
        return
    folders, options = split_arguments(arguments, {"out"}, usage)
    text = compare_page([read_run(folder) for folder in folders])
    print(write_document(text, Path(options.get("out", FILE))))
