# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The words of a command line: options with their help, and settings of a command by --set."""

import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from flight_core.parameters import ParameterError, require

SET = "--set"


def option(text: str, *names: str, **rules: Any) -> Any:
    """An option with its help; without `names` the name of the parameter."""
    return typer.Option(*names, help=text, **rules)


def setting(name: str, text: str, **rules: Any) -> Any:
    """An option that a user gives as --set NAME=VALUE."""
    return option(text, f"{SET} {name}", **rules)


def argument(text: str, **rules: Any) -> Any:
    """An argument with its help."""
    return typer.Argument(help=text, **rules)


WRITE = ("--write", "--output")
"""Names of the option of a file or folder to write, in every command."""

AsJson = Annotated[bool, option("Print the result as JSON, nothing else.", "--json")]
Namespace = Annotated[str, option("Namespace of the aircraft.")]
"""Options of several commands."""


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
