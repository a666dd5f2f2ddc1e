"""``franka-wm VERB``: each verb is a line in :data:`VERBS`, and a file that is imported when it is asked for."""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Any

import click

from franka_wm.commands.arguments import verb
from franka_wm.errors import REFUSALS, FrankaError, machine_refused
from franka_wm.interrupt import INTERRUPTED
from franka_wm.options import did_you_mean
from franka_wm.version import __version__

VERBS = {
    "list": "franka_wm.commands.listing:show_list",
    "train": "franka_wm.commands.main:train",
    "evaluate": "franka_wm.commands.evaluate:evaluate",
    "summary": "franka_wm.commands.summary:summary",
    "report": "franka_wm.commands.report:report",
    "compare": "franka_wm.commands.compare:compare",
    "view": "franka_wm.commands.view:view",
    "demo": "franka_wm.commands.demo:demo",
    "collect": "franka_wm.commands.collect:collect",
    "export": "franka_wm.commands.export:export",
    "publish": "franka_wm.commands.publish:publish",
    "bench": "franka_wm.commands.bench:bench",
}

USAGE = 2


class Verbs(click.Group):
    """The verbs, in their order."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> Any:
        if cmd_name not in VERBS:
            return None
        module, name = VERBS[cmd_name].split(":")
        return getattr(import_module(module), name)

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        if args[0] not in VERBS and not ctx.resilient_parsing:
            near = did_you_mean(args[0], list(VERBS))
            raise click.UsageError(f"no verb {args[0]!r}; choose from {', '.join(VERBS)}, or --help{near}")
        return super().resolve_command(ctx, args)


@click.group(
    cls=Verbs,
    help="A simulated Franka arm, world models of it, and planners over them.",
    context_settings={"help_option_names": ["--help", "-h"], "max_content_width": 110},
    options_metavar="VERB …",
    subcommand_metavar="",
    epilog="franka-wm VERB --help says more.",
)
@click.version_option(__version__, message="franka-wm %(version)s")
def program() -> None:
    """The command; its verbs do the work."""


@verb("train", raw="[group=choice …] [key=value …]", add_help_option=False)
def train(arguments: list[str]) -> None:
    """Train an agent; the same as python train.py."""
    from franka_wm.commands.train import command

    command(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Runs one verb.

    Args:
        arguments: Without the program's name; the command line's if not given.

    Returns:
        Exit status: 0, 1 for bad input inside a verb, 2 for a verb that does not exist, 130 after Ctrl-C.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    arguments = ["--help"] if arguments in ([], ["help"]) else arguments
    try:
        status = program.main(arguments, prog_name="franka-wm", standalone_mode=False) or 0
        sys.stdout.flush()  # here, where a closed pipe is caught, and not at exit
        return status
    except FrankaError as error:
        complain(str(error))
        return 1
    except click.UsageError as error:
        complain(error.format_message())
        return USAGE
    except click.Abort:
        return INTERRUPTED
    except BrokenPipeError:  # … | head
        # What Python would still flush at exit goes nowhere instead of into a traceback.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except REFUSALS as error:
        refused = machine_refused(error)
        if refused is None:
            raise
        complain(refused)
        return 1


def complain(message: str) -> None:
    """Say what is wrong, in one line."""
    print(f"error: {message}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
