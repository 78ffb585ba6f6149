# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The words of a command line: options with their help, and settings of a command by --set."""

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, field, fields
from inspect import Parameter, Signature
from typing import Annotated, Any, Protocol, get_type_hints

import typer
from typer.core import TyperCommand

from flight_core.parameters import ParameterError, require

SET = "--set"
DECLARE = "declare"  # key of what declares a field to Typer
REQUIRED = MISSING
"""The default of a field without a default."""


class Executable(Protocol):
    """A command: a data class of the words, with the help as docstring."""

    def execute(self) -> None:
        """Do what the command does."""


def option(text: str, *names: str, default: Any = None, **rules: Any) -> Any:
    """An option of a command, with help; without `names` by the name of the field."""
    return _field(
        lambda name: typer.Option(*(names or (f"--{name.replace('_', '-')}",)), help=text, **rules),
        default,
    )


def setting(text: str, name: str = "", default: Any = None, **rules: Any) -> Any:
    """A setting, --set NAME=VALUE; without `name` by the name of the field."""
    return _field(
        lambda own_name: typer.Option(f"{SET} {name or own_name}", help=text, **rules), default
    )


def argument(text: str, default: Any = None, **rules: Any) -> Any:
    """An argument of a command, with help."""
    return _field(lambda _: typer.Argument(help=text, **rules), default)


def write_option(text: str) -> Any:
    """The option of a file or folder to write: --write, or --output as of `import`."""
    return option(text, "--write", "--output")


def json_option() -> Any:
    """The option --json."""
    return option("Print the result as JSON, nothing else.", "--json", default=False)


def namespace_option() -> Any:
    """The option --namespace of a command for a flight."""
    return option("Namespace of the aircraft.", default="")


def _field(declare: Callable[[str], object], default: Any) -> Any:
    """A field with a declaration for Typer."""
    metadata = {DECLARE: declare}
    if default is REQUIRED:
        return field(metadata=metadata)
    return field(default=default, metadata=metadata)


def as_function(command: Callable[..., Executable]) -> Callable[..., None]:
    """The function for Typer: a parameter a field, the help of the class."""
    hints = get_type_hints(command)

    def execute(**values: Any) -> None:
        command(**values).execute()

    execute.__doc__ = command.__doc__
    # the command's own words before those of its base
    words = sorted(fields(command), key=lambda word: word.name not in command.__annotations__)  # type: ignore[arg-type]
    parameters = [_parameter(word, hints[word.name]) for word in words]
    execute.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    return execute


def _parameter(declared: Field[Any], hint: Any) -> Parameter:
    """The parameter of a function for a field; a field without words is of Typer's own."""
    default = Parameter.empty if declared.default is MISSING else declared.default
    if declared.metadata:
        hint = Annotated[hint, declared.metadata[DECLARE](declared.name)]
    return Parameter(declared.name, Parameter.KEYWORD_ONLY, default=default, annotation=hint)


def values_of(command: Executable, *names: str) -> dict[str, Any]:
    """Fields of a command by name."""
    return {name: getattr(command, name) for name in names}


def require_unused(
    command: Executable, names: Iterable[str], expected: str, found: str = ""
) -> None:
    """Raise ParameterError for the first used field."""
    for name, value in values_of(command, *names).items():
        require(value in (None, False, "", []), name, found or f"{value}", expected)


def warn(text: str) -> None:
    """Print a line on standard error."""
    print(text, file=sys.stderr)


class Command(TyperCommand):
    """A command with settings beside options."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words after the name. Raises ParameterError for an unknown setting."""
        return super().parse_args(ctx, [*_joined(args, self._spellings())])

    def invoke(self, ctx: Any) -> Any:
        """Call the function. Raises ParameterError with the spelling of the option for the key."""
        try:
            return super().invoke(ctx)
        except ParameterError as error:
            key, colon, reason = str(error).partition(":")
            spellings = self._spellings()
            if (spelling := spellings.get(key.removeprefix("--").replace("-", "_"), key)) == key:
                raise
            raise ParameterError(f"{spelling}{colon}{reason}") from None

    def _spellings(self) -> dict[str, str]:
        """The spelling of the options by name without --: `--set rate` for a setting."""
        options = (parameter for parameter in self.params if parameter.param_type_name == "option")
        return {
            option.opts[0]
            .removeprefix(f"{SET} ")
            .removeprefix("--")
            .replace("-", "_"): option.opts[0]
            for option in options
        }


def _joined(args: Sequence[str], spellings: Mapping[str, str]) -> Iterator[str]:
    """The words, a setting joined to a single word; further words of --set stay where the command
    has this option.
    """
    settings = {name for name, spelling in spellings.items() if spelling.startswith(f"{SET} ")}
    words = iter(args)
    for word in words:
        option, equals, value = word.partition("=")
        if word == "--":
            yield from (word, *words)
        elif option == SET and (text := value if equals else next(words, None)) is not None:
            key, *rest = text.split("=", 1)
            if key.replace("-", "_") in settings:
                yield "=".join((f"{SET} {key.replace('-', '_')}", *rest))
            else:
                known = ", ".join(sorted(settings)) or "no settings"
                require("set" in spellings, SET, repr(text), f"one of {known}")
                yield from (SET, text)
        else:
            name = option.removeprefix("--").replace("-", "_")
            spelled = settings & {name, f"route.{name}"} if option.startswith("--") else set()
            require(not spelled, option, "no option", f"{SET} {min(spelled, default='')}")
            yield word
