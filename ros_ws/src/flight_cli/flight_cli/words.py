# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The words of a command line: settings of a command by --set, and the new name of a removed
command or option.
"""

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

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


AsJson = Annotated[bool, option("Print the result as JSON, nothing else.", "--json")]
Namespace = Annotated[str, option("Namespace of the aircraft.")]
"""Options of several commands."""
GONE = MappingProxyType(
    {
        "airframe": "rise-di airframes FILE --write FOLDER",
        "check-map": "rise-di check MAP --definitions FOLDER",
        "check-signs": "rise-di check MAP",
        "fleet": "rise-di fly FILE",
        "flightgear": "rise-di watch --flightgear HOST:PORT",
        "guidance": "rise-di guide, as in: rise-di guide hold",
        "repair": "rise-di report RUN --repair",
        "target": "rise-di guide, as in: rise-di guide heading=90",
        "check --bag": "--run",
        "campaign --resume": "rise-di campaign FOLDER",
        "fly --composed": "--set composed",
        "fly --one-process": "--lockstep --set composed",
        "identify --log": "rise-di identify RUN",
        "identify --output": "--write",
        "layouts --fleet": "rise-di layouts FILE",
        "watch --control-real": "--control --set real",
    }
)
"""The new name of a removed command, or of a removed option of a command."""


class Command(TyperCommand):
    """A command with settings beside options, and a sentence for a removed option."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words after the name. Raises ParameterError for a removed option and an unknown
        setting.
        """
        return super().parse_args(ctx, [*_joined(self.name or "", args, self._spellings())])

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


class Commands(TyperGroup):
    """Commands by name, and a sentence for a removed command."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command of the first word. Raises ParameterError for a removed command."""
        require(args[0] not in GONE, args[0], "a command that is gone", GONE.get(args[0], ""))
        return super().resolve_command(ctx, args)


def _joined(command: str, args: Sequence[str], spellings: Mapping[str, str]) -> Iterator[str]:
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
            for key in settings & {name, f"route.{name}"} if option.startswith("--") else ():
                require(False, option, "an option that is gone", f"{SET} {key}")
            require(
                f"{command} {option}" not in GONE,
                option,
                "an option that is gone",
                GONE.get(f"{command} {option}", ""),
            )
            yield word
