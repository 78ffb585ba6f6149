# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The `rise-di` command: what it can do.

A command's module is imported when it runs, so that --help is quick.
"""

import signal

# Until the command runs, Ctrl-C ends it without a word: its imports may take a second.
signal.signal(signal.SIGINT, signal.SIG_DFL)

import errno
import gc
import os
import sys
from collections import ChainMap
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from keyword import iskeyword
from pkgutil import resolve_name
from types import MappingProxyType
from typing import Annotated

import typer

from flight_cli.words import RiseDiCommand, RiseDiGroup, as_function, without_help_word

FAILED = 1
BAD_INPUT = 2
INTERRUPTED = 130
NICE = 10  # of a command that may run beside a flight
CONTROLS = frozenset({"--control", "--real"})  # options of a page that commands the flight
# New objects before a collection, 700 by default: a flight keeps what it makes.
GARBAGE_THRESHOLD = 100_000
REPEATED_AFTER = 0.01  # s, of an interrupt that Python ignores

GROUPS = MappingProxyType(
    {
        "Fly": {
            "fly": "Fly a scenario or a fleet over ROS 2 topics, in real time or in lockstep, "
            "or in one process.",
            "scenarios": "List the scenarios: what each flies, its aircraft and its law.",
            "guide": "Command a running guided flight: a heading, an altitude, hold, home, "
            "another route.",
            "network": "Write the profile of the middleware for nodes on several hosts, and "
            "check the network.",
        },
        "Look": {
            "runs": "List the recorded flights, the newest first, and how each ended.",
            "report": "Write the report page of a run again, compare several, export figures "
            "and data, repair a log.",
            "watch": "See a flight on a page, in the terminal or in Foxglove, live or recorded.",
            "replay": "Compute every tick of a recorded flight again and compare it with the "
            "log bit by bit.",
            "play": "Publish the topics of a recorded flight again with their timing.",
        },
        "Design": {
            "airframes": "Show airframes and what the theorem asks of each, or make one of your "
            "own that flies.",
            "gains": "Select gains for an airframe, and check every condition on them.",
            "identify": "Identify an aircraft of JSBSim with a scenario, or the model of an "
            "airframe from a log.",
            "learn": "Repeat the learner on the log of a flight, with other settings, and write "
            "the model.",
            "tune": "Identify the aircraft of an autopilot's log, and export the module with its "
            "gains.",
            "export": "Write the controller of a scenario as C99, with a proof that C and "
            "Python give the same bits.",
        },
        "Autopilot": {
            "engage": "Engage or disengage the autopilot behind a running bridge.",
            "check": "Compare the signs of a channel map with the D of the controller, its rows "
            "with releases.",
            "import": "Make a bag from the log of an autopilot: DataFlash, tlog or ULog.",
        },
        "Study": {
            "campaign": "Fly a Monte Carlo campaign of uncertain aircraft.",
            "compare": "Compare RISE-DI with other control laws on the same aircraft.",
        },
    }
)
"""What each command does, by group. The class `Name` of the module `flight_cli.name` is the
command; the module has _ after a keyword."""
COMMANDS = MappingProxyType(dict(ChainMap(*GROUPS.values())))


def _show_version(is_set: bool) -> None:
    if is_set:
        from importlib.metadata import version  # noqa: PLC0415 - --help does without

        print(f"rise-di {version('rise-di')}")
        raise typer.Exit


def _options(
    show_version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Fly, record and analyse RISE dynamic inversion."""


def application(words: Collection[str]) -> typer.Typer:
    """Build the command line with those commands that occur among the words.

    The other commands only have their name and help.
    """
    app = typer.Typer(
        cls=RiseDiGroup,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["--help", "-h"]},
        epilog="rise-di help COMMAND and rise-di COMMAND -h show the options of a command.",
    )
    app.callback()(_options)
    for group, commands in GROUPS.items():
        for name, sentence in commands.items():
            module = f"{name}_" if iskeyword(name) else name
            command: Callable[..., None] = lambda: None  # noqa: E731 - of a command that does not run
            if name in words:
                command = as_function(resolve_name(f"flight_cli.{module}:{name.capitalize()}"))
            help_text = None if name in words else sentence
            app.command(name, help=help_text, rich_help_panel=group, cls=RiseDiCommand)(command)
    return app


def _repeat_interrupt(ignored: "sys.UnraisableHookArgs") -> None:
    """Repeat a Ctrl-C that came inside a destructor or a callback of a weak reference.

    Python prints and ignores it there.
    """
    if issubclass(ignored.exc_type, KeyboardInterrupt):
        signal.signal(signal.SIGALRM, signal.default_int_handler)
        signal.setitimer(signal.ITIMER_REAL, REPEATED_AFTER)
    else:
        sys.__unraisablehook__(ignored)


def _looks_on(words: Sequence[str]) -> bool:
    """Return whether a command only looks at a flight, which then goes first.

    A page that deactivates and holds is not nice: it has to answer when the host is busy.
    """
    return words[:1] == ["watch"] and CONTROLS.isdisjoint(words)


def main() -> None:
    """Entry point: bad input is one sentence and exit status 2, Ctrl-C is quiet."""
    gc.set_threshold(GARBAGE_THRESHOLD)
    if _looks_on(sys.argv[1:]):
        with suppress(OSError):
            os.nice(NICE)
            # A batch process interrupts no node when it wakes up.
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    words = [
        *without_help_word(sys.argv[1:])[:1],
        *os.environ.get("_TYPER_COMPLETE_ARGS", os.environ.get("COMP_WORDS", "")).split(),
    ]
    try:
        app = application(words)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.unraisablehook = _repeat_interrupt
        # --help does without both
        from flight_core.outcome import FlightEnded  # noqa: PLC0415
        from flight_core.parameters import ParameterError  # noqa: PLC0415

        try:
            app(prog_name="rise-di")
        except ParameterError as error:
            print(f"error: {error}", file=sys.stderr)
            sys.exit(BAD_INPUT)
        except FlightEnded as error:
            print(f"error: {error}", file=sys.stderr)
            sys.exit(error.status)
    except ModuleNotFoundError as error:
        from flight_core.installation import missing  # noqa: PLC0415 - as above

        print(f"error: rise-di {words[0]}: {missing(str(error.name))}", file=sys.stderr)
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except OSError as error:
        if error.errno not in {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}:
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # Python writes the rest at its end
        print(
            f"error: output: cannot be written ({error.strerror}), expected a disk with space",
            file=sys.stderr,
        )
        sys.exit(FAILED)
    except Exception as error:
        # What a module in C makes of Ctrl-C: an ImportError while it loads, pybind11's TypeError.
        if not isinstance(error.__cause__, KeyboardInterrupt):
            raise
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
