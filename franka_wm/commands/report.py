"""``franka-wm report``: the page of a run."""

from __future__ import annotations

from franka_wm.commands.arguments import split_arguments, wants_help
from franka_wm.errors import UserError
from franka_wm.report.page import write_page


def report(arguments: list[str]) -> None:
    """``franka-wm report RUN [out=…]``: writes the page of a run."""
    usage = "report RUN [out=PAGE.html]"
    if wants_help(arguments, usage):
        return
    folders, options = split_arguments(arguments, {"out"}, usage)
    if len(folders) != 1:
        raise UserError(f"report needs one folder of a run, got {len(folders)}: franka-wm report outputs/RUN")
    print(write_page(folders[0], options.get("out")))
