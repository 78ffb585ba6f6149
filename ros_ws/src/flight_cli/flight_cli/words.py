# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Declare the options and arguments of a command line, and refuse wrong ones."""

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, field, fields
from difflib import get_close_matches
from inspect import Parameter, Signature
from itertools import takewhile, zip_longest
from pathlib import Path
from pkgutil import resolve_name
from types import MappingProxyType
from typing import Annotated, Any, Protocol, get_type_hints

import typer
from rich.markup import escape
from typer.core import TyperCommand, TyperGroup
from typer.exceptions import TyperException

from flight_core.parameters import ParameterError, require

DECLARE = "declare"  # key of the function that declares a field to Typer
ALIKE = 0.85  # least similarity of a misspelt option, as of --run to --runs
ALIKE_COMMANDS = 0.6  # the same for a command, where a wrong suggestion does no harm
REQUIRED = MISSING
"""The default of a field that the user must give."""

OTHER_NAMES: Mapping[str, Sequence[str]] = MappingProxyType(
    {
        "--out": ("--output", "--runs"),
        "--outdir": ("--output", "--runs"),
        "--output": ("--runs",),
        "--html": ("--page",),
        "--samples": ("--aircraft",),
        "--jobs": ("--workers",),
        "--threads": ("--workers",),
        "--speed": ("--rate",),
        "--gui": ("--watch",),
    }
)
"""Names that options have in other tools, with the options of the same meaning here."""


class Executable(Protocol):
    """A command: a data class whose fields are the options, and whose docstring is the help."""

    def execute(self) -> None:
        """Run the command."""


def option(text: str, *names: str, default: Any = None, **rules: Any) -> Any:
    """Declare an option with its help text. If `names` is empty, it is named like the field."""
    shown = escape(text)  # so that A[q,alpha] is no markup
    return _field(
        lambda name: typer.Option(
            *(names or (f"--{name.replace('_', '-')}",)), help=shown, **rules
        ),
        default,
    )


def rare_option(text: str, *names: str, default: Any = None, **rules: Any) -> Any:
    """Declare an option that few users need, which --help lists in a separate panel."""
    return option(text, *names, default=default, rich_help_panel="More options", **rules)


def argument(text: str, default: Any = None, **rules: Any) -> Any:
    """Declare an argument with its help text."""
    return _field(lambda _: typer.Argument(help=escape(text), **rules), default)


def write_option(text: str, default: Any = None, **rules: Any) -> Any:
    """Declare the option that names a file or folder to write: --write or --output."""
    return option(text, "--write", "--output", default=default, **rules)


def json_option() -> Any:
    """Declare the option --json."""
    return option("Print the result as JSON and nothing else.", "--json", default=False)


def namespace_option() -> Any:
    """Declare the option --namespace of a command for a flight."""
    return option("Namespace of the aircraft.", default="")


def _field(declare: Callable[[str], object], default: Any) -> Any:
    """Return a data-class field that holds the declaration of an option or argument for Typer."""
    metadata = {DECLARE: declare}
    if default is REQUIRED:
        return field(metadata=metadata)
    return field(default=default, metadata=metadata)


def as_function(command: Callable[..., Executable]) -> Callable[..., None]:
    """Turn a command into a function for Typer, with the command's docstring as the help."""
    hints = get_type_hints(command)

    def execute(**values: Any) -> None:
        command(**values).execute()

    execute.__doc__ = command.__doc__
    # The options of the command's class come before those of its base class.
    words = sorted(fields(command), key=lambda word: word.name not in command.__annotations__)  # type: ignore[arg-type]
    parameters = [_parameter(word, hints[word.name]) for word in words]
    execute.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    return execute


def _parameter(declared: Field[Any], hint: Any) -> Parameter:
    """Turn a field of a command into a parameter of the function for Typer.

    A field that is declared neither as an option nor as an argument, such as `context`, only has
    its type.
    """
    default = Parameter.empty if declared.default is MISSING else declared.default
    if declared.metadata:
        hint = Annotated[hint, declared.metadata[DECLARE](declared.name)]
    return Parameter(declared.name, Parameter.KEYWORD_ONLY, default=default, annotation=hint)


def values_of(command: Executable, *names: str) -> dict[str, Any]:
    """Return the values of a command's fields by name."""
    return {name: getattr(command, name) for name in names}


def require_unused(
    command: Executable, names: Iterable[str], expected: str, found: str = ""
) -> None:
    """Check that none of these fields of a command was set.

    Raises ParameterError, which names the first one that was.
    """
    for name, value in values_of(command, *names).items():
        require(value in (None, False, "", []), name, found or f"{value}", expected)


def warn(text: str) -> None:
    """Print a line on standard error."""
    print(text, file=sys.stderr)


def _names_of(library: str) -> Callable[[str], list[str]]:
    """Return a shell completion that offers the names in a library, given as MODULE:FOLDER."""

    def complete(incomplete: str) -> list[str]:
        from flight_core.files import names_in  # noqa: PLC0415 - --help does not need it

        return [name for name in names_in(resolve_name(library)) if name.startswith(incomplete)]

    return complete


def list_of(names: Iterable[str]) -> Callable[[str], list[str]]:
    """Return a shell completion for a comma-separated list, which offers each name once."""

    def complete(incomplete: str) -> list[str]:
        before, comma, begun = incomplete.rpartition(",")
        rest = [name for name in names if name not in before.split(",")]
        return [f"{before}{comma}{name}" for name in rest if name.startswith(begun)]

    return complete


scenario_names = _names_of("flight_analysis.closed_loop.scenario_library:LIBRARY")
airframe_names = _names_of("aircraft_sim.airframes.airframe:LIBRARY")
map_names = _names_of("autopilot_bridge.params:LIBRARY")


EXPECTED: Mapping[str, str] = MappingProxyType(
    {
        "greater_than": "more than {gt:g}",
        "greater_than_equal": "{ge:g} or more",
        "less_than": "less than {lt:g}",
        "less_than_equal": "{le:g} or less",
        "finite_number": "a finite number",
    }
    | dict.fromkeys(("float_parsing", "float_type"), "a number")
    | dict.fromkeys(
        ("int_parsing", "int_type", "int_from_float", "int_parsing_size"), "a whole number"
    )
    | dict.fromkeys(("bool_parsing", "bool_type"), "true or false")
    | dict.fromkeys(("path_type", "string_type"), "a text")
)
"""What a value of the command line must be, by the type of pydantic's error."""


def refused_words(error: Any, command: str, names: Sequence[str]) -> ParameterError:
    """Turn Typer's refusal of a command line into a ParameterError with one sentence."""
    if isinstance(error, typer.BadParameter):
        return refused_value(error, command)
    option = getattr(error, "option_name", "")
    if option and "requires" not in error.format_message():
        near = get_close_matches(option, names, n=1, cutoff=ALIKE)
        mend = f"did you mean {near[0]}?" if near else f"{command} --help lists them"
        return ParameterError(f"{option} is no option of {command}: {mend}")
    return _typers_sentence(error, command)


def _typers_sentence(error: Any, command: str) -> ParameterError:
    """Turn Typer's message into a ParameterError with the form of the other refusals."""
    text = error.format_message().strip().rstrip(".")
    return ParameterError(f"{command}: {text[:1].lower()}{text[1:]}; {command} --help shows more")


def refused_value(error: typer.BadParameter, command: str) -> ParameterError:
    """Turn Typer's refusal of a value into a ParameterError with one sentence."""
    cause: Any = error.__cause__
    if cause is None or not hasattr(cause, "errors") or error.param is None:
        return _typers_sentence(error, command)
    first = cause.errors(include_url=False)[0]
    message = str(first["msg"]).removeprefix("Value error, ").removeprefix("Input should be ")
    _, is_choice, choices = message.rstrip(".").partition(" is not one of ")
    if is_choice:
        expected = f"one of {choices.replace(chr(39), '')}"
    else:
        expected = EXPECTED.get(first["type"], message).format(**first.get("ctx", {}))
    names = [name for name in error.param.opts if name.startswith("-")]
    key = names[0] if names else str(error.param.name).upper()
    return ParameterError(f"{key}: found {first['input']}, expected {expected}")


def _path(ctx: Any) -> str:
    """Return the command of a context as the user types it, beginning with rise-di."""
    names = []
    while ctx.parent is not None:
        names.append(str(ctx.info_name))
        ctx = ctx.parent
    return " ".join(["rise-di", *reversed(names)])


class RiseDiCommand(TyperCommand):
    """A command whose refusals name the option as the user types it."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words after the command. Raises ParameterError for an unknown option."""
        names = [name for each in self.get_params(ctx) for name in each.opts]
        words = [] if ctx.resilient_parsing else [*takewhile("--".__ne__, args)]
        for word, value in zip_longest(words, words[1:], fillvalue=""):
            name, equals, text = word.partition("=")
            if name.startswith("--") and name not in names:
                mend = self._mend(name, names, _path(ctx))
                raise ParameterError(f"{name} is no option of {_path(ctx)}: {mend}")
            folder = text if equals else value
            if name == "--runs" and folder.isdecimal() and not Path(folder).is_dir():
                raise ParameterError(
                    f"--runs: found {folder}, expected the folder for the logs, and no such folder "
                    "exists; a campaign has --aircraft for a number"
                )
        try:
            return super().parse_args(ctx, args)
        except TyperException as error:
            raise refused_words(error, _path(ctx), names) from None

    def _mend(self, name: str, names: Sequence[str], command: str) -> str:
        """Say what to write instead of an unknown option."""
        if name[2:] in names:
            return f"give it without a name, {command} {name[2:].upper()}"
        near = [
            *(known for known in names if known.lower() == name.lower()),
            *get_close_matches(name, names, n=1, cutoff=ALIKE),
            *(known for known in OTHER_NAMES.get(name, ()) if known in names),
        ]
        if near:
            return f"did you mean {near[0]}?"
        key = ", or set a key of the scenario, --set SECTION.KEY=VALUE" * ("--set" in names)
        return f"{command} --help lists them{key}"

    def invoke(self, ctx: Any) -> Any:
        """Call the function. A ParameterError that it raises names the option, not the field."""
        try:
            return super().invoke(ctx)
        except ParameterError as error:
            key, colon, reason = str(error).partition(":")
            words = {str(each.name): each.opts[0] for each in self.params}
            if not words.get(key, "").startswith("--"):
                raise
            raise ParameterError(f"{words[key]}{colon}{reason}") from None


def without_help_word(words: Sequence[str]) -> list[str]:
    """Replace a first word `help` of the command line by --help."""
    return [*words[1:], "--help"] if [*words[:1]] == ["help"] else [*words]


class RiseDiGroup(TyperGroup):
    """The group of all commands. It refuses a wrong command in the same way as a wrong option."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words. Raises ParameterError if an option before the command is unknown."""
        if not args:
            return super().parse_args(ctx, args)
        args = without_help_word(args)
        names = [name for each in self.get_params(ctx) for name in each.opts]
        try:
            return super().parse_args(ctx, args)
        except TyperException as error:
            raise refused_words(error, _path(ctx), names) from None

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command with a name. Raises ParameterError if there is no such command."""
        word = args[0]
        if word not in self.commands and not ctx.resilient_parsing:
            near = get_close_matches(word, self.commands, n=1, cutoff=ALIKE_COMMANDS)
            mend = f"did you mean {near[0]}?" if near else f"{_path(ctx)} --help lists them"
            raise ParameterError(f"{word} is no command of {_path(ctx)}: {mend}")
        return super().resolve_command(ctx, args)
