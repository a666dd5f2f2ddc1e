"""Verbs and their options, declared once: click commands whose options are words, ``name=value``, as Hydra has them.

@verb("evaluate")
@word("checkpoint", "a run's folder, or hf:user/name", metavar="FOLDER", required=True)
@word("episodes", "per policy", whole(2), 100)
def evaluate(checkpoint: str, episodes: int) -> None:

``--name=value``, ``--name value`` and, for true or false, ``--name`` are taken, too. click brings types and completion.
Nothing heavy is imported here or at the top of a verb's file: arguments are checked first.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import click

from franka_wm.errors import UserError
from franka_wm.options import no_such_option

FLAG = click.BOOL

TYPED = "typed"
"""What of click's context holds a verb's arguments as they were typed."""


class _Real(click.FloatRange):
    """A finite number."""

    def convert(self, value: Any, param: Any, ctx: Any) -> float:
        number = super().convert(value, param, ctx)
        return number if math.isfinite(number) else self.fail("not finite", param, ctx)


def whole(least: int = 0, most: int | None = None) -> click.IntRange:
    """A whole number from ``least`` to ``most``."""
    return click.IntRange(least, most)


def real(above: float, most: float | None = None) -> click.FloatRange:
    """A finite number above ``above``, at most ``most``."""
    return _Real(min=above, min_open=True, max=most)


def wanted(kind: click.ParamType) -> str:
    """What a value must be, in words."""
    if isinstance(kind, click.Choice):
        return f"one of {', '.join(kind.choices)}"
    if isinstance(kind, click.IntRange):
        most = "" if kind.max is None else f", at most {kind.max}"
        return f"a whole number of at least {kind.min}{most}"
    if isinstance(kind, click.FloatRange):
        most = "" if kind.max is None else f", at most {kind.max:g}"
        return f"a finite number above {kind.min:g}{most}"
    return "true or false"


class Word(click.Option):
    """An option that is written, shown and refused as ``name=value``."""

    def type_cast_value(self, ctx: click.Context, value: Any) -> Any:
        try:
            return super().type_cast_value(ctx, value)
        except click.BadParameter as error:
            raise UserError(f"{ctx.info_name}: {self.name}={value}: must be {wanted(self.type)}") from error

    def get_help_record(self, ctx: click.Context) -> tuple[str, str]:
        shown = self.metavar or (str(self.default).lower() if self.type is FLAG else self.default)
        of = f"; {wanted(self.type)}" if isinstance(self.type, click.Choice) else ""
        return f"{self.name}={shown}", f"{self.help}{of}"


class Verb(click.Command):
    """A command of words.

    Args:
        others: What other words, overrides of a configuration, begin with; they come as ``overrides``. ``None``: there
            are none.
        shown: How the help shows those, and what it says of them.
        raw: The usage of a verb that reads its arguments itself; all come as ``arguments``.
        first: The word whose name may be left out: a bare argument is its value.
    """

    def __init__(
        self,
        *args: Any,
        others: str | tuple[str, ...] | None = None,
        shown: tuple[str, str] = ("", ""),
        raw: str = "",
        first: str | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(*args, **settings)
        self.raw, self.first = raw, first
        self.words = {str(one.name): one for one in self.params if isinstance(one, Word)}
        self.others, self.shown = others, shown
        if others is not None:
            self.params.append(click.Argument(["overrides"], nargs=-1, metavar=f"[{shown[0]} …]"))

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if self.raw and not (self.add_help_option and args[:1] in (["--help"], ["-h"])):
            ctx.params["arguments"] = args
            return args
        ctx.meta[TYPED] = list(args)
        if not args and any(one.required for one in self.params) and not ctx.resilient_parsing:
            click.echo(ctx.get_help())
            ctx.exit(2)
        try:
            rest = super().parse_args(ctx, list(self._as_options(args)))
        except click.MissingParameter as error:
            one = error.param
            what = one and one.make_metavar(ctx)
            if isinstance(one, Word):
                what = f"{one.name}={one.metavar or '…'} ({one.help})"
            raise UserError(f"{self.name}: give {what}; all options: franka-wm {self.name} --help") from error
        except click.UsageError as error:
            raise UserError(f"{self.name}: {error.format_message()}") from error
        for word in ctx.params.get("overrides", ()):
            if "=" not in word:
                raise UserError(
                    f"{self.name}: {word!r}: write options as name=value; all of them: franka-wm {self.name} --help"
                )
        return rest

    def _as_options(self, args: Sequence[str]) -> Iterator[str]:
        """Words as click's options; what is neither a word nor an option stays as it is."""
        seen: set[str] = set()
        awaited = False  # the value of the option before, `--name value`
        for argument in args:
            if awaited:
                awaited = False
                yield argument
                continue
            if self.first and self.first not in seen and not argument.startswith("-") and "=" not in argument:
                argument = f"{self.first}={argument}"
            dashed = argument.startswith("--")
            name, equals, value = argument.removeprefix("--").partition("=")
            name = name.replace("-", "_") if dashed else name
            if argument == "--help":
                yield argument
            elif name in self.words and (equals or dashed):
                if name in seen:
                    raise UserError(f"{self.name}: {name}= is given twice")
                if equals and not value:
                    raise UserError(f"{self.name}: {argument}: a value is missing")
                seen.add(name)
                value = "true" if not equals and self.words[name].type is FLAG else value
                awaited = not value
                yield f"--{name}={value}" if value else f"--{name}"
            elif dashed or (equals and not self._is_other(argument) and not Path(argument).exists()):
                raise UserError(f"{self.name}: {no_such_option(name, [*self.words, *self._others()])}")
            else:
                yield argument

    def _others(self) -> list[str]:
        """What other words look like."""
        beginnings = [self.others] if isinstance(self.others, str) else self.others or ()
        return [one if one.endswith("=") else f"{one}KEY" for one in beginnings]

    def _is_other(self, argument: str) -> bool:
        return self.others is not None and argument.startswith(self.others)

    def format_usage(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        needed = [f"{one.name}={one.metavar}" for one in self.words.values() if one.required]
        more = ["[name=value …]"] if len(needed) < len(self.words) else []
        arguments = [one.make_metavar(ctx) for one in self.params if isinstance(one, click.Argument)]
        overrides = [] if self.others is None else [arguments.pop()]
        raw = [self.raw] if self.raw else []
        pieces = [*raw, *arguments, *needed, *more, *overrides]
        formatter.write_usage(ctx.command_path, " ".join(pieces), prefix="usage: ")

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        rows = [one.get_help_record(ctx) for one in self.words.values()]
        rows += [self.shown] if self.others is not None else []
        formatter.write_paragraph()
        with formatter.indentation():
            formatter.write_dl([*rows, ("--help", "print this")])


def word(
    name: str,
    help: str,
    kind: click.ParamType | type = str,
    default: Any = None,
    *,
    metavar: str | None = None,
    required: bool = False,
) -> Callable[[Any], Any]:
    """Declare an option of a verb.

    Args:
        name: As it is written before ``=``, and as the verb's function takes it.
        help: What it is, in a line.
        kind: Its values: text, ``FLAG``, :func:`whole`, :func:`real` or ``click.Choice``.
        default: Without it; ``None`` reaches the function as such.
        metavar: What the help shows as its value where there is no default.
        required: Whether it must be given.
    """
    given: dict[str, Any] = {} if required else {"default": default}  # for click also None is a default
    return click.option(
        f"--{name}", name, cls=Word, type=kind, help=help, metavar=metavar, required=required, **given
    )


def plugins(function: Callable[..., Any]) -> Callable[..., Any]:
    """Declare ``plugins=[MODULE,…]`` of a verb: modules of the user's own, imported before it runs.

    What a run was trained with is never imported by itself: its folder may be a stranger's.
    """

    @functools.wraps(function)
    def importing(plugins: str | None, **options: Any) -> Any:
        if plugins is not None:
            from franka_wm.training.run import import_plugins

            import_plugins(listed(plugins))
        return function(**options)

    text = "modules of your own to import first, where the run was trained with tasks or models of yours"
    return word("plugins", text, metavar="[MODULE,…]")(importing)


def listed(text: str) -> list[str]:
    """The entries of ``[A,B]``, or of ``A,B``."""
    return [one.strip() for one in text.strip("[]").split(",") if one.strip()]


def check_run(verb: str, option: str, folder: str) -> None:
    """Whether a run's folder is there, asked before anything heavy is imported.

    Raises:
        UserError: It is not.
    """
    # A checkpoint has another name for a moment while a newer one takes its place: see training/checkpoint.py.
    places = (folder, f"{folder.rstrip('/')}.old")
    if not folder.startswith("hf:") and not any(Path(one).is_dir() for one in places):
        raise UserError(
            f"{verb}: {option}={folder}: no such folder; give that of a run, as train.py prints it last"
        )
    place = Path(folder)
    if (place / "meta" / "info.json").is_file():
        raise UserError(f"{verb}: {option}={folder}: is a dataset; give the folder of a run")
    if place.is_dir() and not any((place / one).exists() for one in ("checkpoints", "manifest.json")):
        if any((one / "manifest.json").is_file() for one in place.iterdir()):  # a run's folder of checkpoints
            return
        runs = sorted(one.name for one in place.iterdir() if (one / "checkpoints").is_dir())
        if runs and runs != ["pretrained"]:  # a run that ended in its first stage
            raise UserError(f"{verb}: {option}={folder}: holds runs; give one of {', '.join(runs)}")
        if not runs:
            raise UserError(
                f"{verb}: {option}={folder}: is no run's folder; give one as train.py prints it last"
            )


def verb(name: str, **settings: Any) -> Callable[[Any], Verb]:
    """Make a function a verb; the first paragraphs of its docstring, up to a form feed, are its help."""
    context = {"max_content_width": 110, "help_option_names": ["--help", "-h"]}
    return click.command(name, cls=Verb, context_settings=context, **settings)
