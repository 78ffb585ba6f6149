# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Run the `rise-di` command, and list its subcommands.

The module of a command is imported only when the command runs, so that --help is quick.
"""

import signal

# Until the command runs, Ctrl-C ends it without a message, because its imports may take a second.
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
from typing import Annotated, Any

import typer

from flight_cli.words import RiseDiCommand, RiseDiGroup, as_function, without_help_word
from flight_core.scheduling import compute_in_one_thread

FAILED = 1
BAD_INPUT = 2
INTERRUPTED = 130
NICE = 10  # niceness of a command that may run during a flight
CONTROLS = frozenset({"--control", "--real"})  # options with which a page commands the flight
# Number of new objects before Python collects garbage, which is 700 by default. A flight keeps the
# objects that it makes, so frequent collections would find nothing.
GARBAGE_THRESHOLD = 100_000
REPEATED_AFTER = 0.01  # time after which an interrupt that Python ignored is repeated, s

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
            "airframes": "Show airframes and whether they meet the assumptions of the theorem, or "
            "make one of your own that flies.",
            "gains": "Select gains for an airframe, check the gains of a scenario, or bound them "
            "for every aircraft.",
            "identify": "Identify an aircraft of JSBSim or behind a bridge, and write a scenario "
            "for it, or identify an airframe from a log.",
            "learn": "Run the learner again on the log of a flight, with other settings if you "
            "like, and write the model.",
            "tune": "Identify an aircraft from the log of its autopilot, and export a module with "
            "gains for it.",
            "export": "Write the controller of a scenario as C99, with a proof that C and "
            "Python give the same bits.",
        },
        "Autopilot": {
            "engage": "Engage or disengage the autopilot behind a running bridge.",
            "check": "Compare the signs of a channel map with the D of the controller, or its rows "
            "with releases of an autopilot.",
            "import": "Make a bag from the log of an autopilot: DataFlash, tlog or ULog.",
        },
        "Study": {
            "campaign": "Fly a Monte Carlo campaign of uncertain aircraft.",
            "compare": "Compare RISE-DI with other control laws on the same aircraft.",
        },
    }
)
"""What each command does, by group.

The command `name` is the class `Name` of the module `flight_cli.name`. If the name is a keyword of
Python, the name of the module ends with an underscore.
"""
VERBS = MappingProxyType(
    {
        "gains": {
            "select": "Select gains by Theorem 1 and by the engineering procedure.",
            "check": "Check the gains of a scenario, of any law: margins and conditions.",
            "guarantee": "Prove what holds for every aircraft within --uncertainty.",
        },
        "identify": {
            "jsbsim": "Linearise an aircraft of JSBSim, and write a scenario that flies it.",
            "log": "Identify A and B of an airframe from the log of a flight.",
            "bridge": "Excite the aircraft behind a channel map, and write a scenario that flies "
            "it.",
        },
    }
)
"""The commands that are groups, and what each of their verbs does. For example, `rise-di gains
check` is the class `Check` of the module `flight_cli.gains`."""
COMMANDS = MappingProxyType(dict(ChainMap(*GROUPS.values())))


def _show_version(is_set: bool) -> None:
    if is_set:
        from importlib.metadata import version  # noqa: PLC0415 - --help does not need it

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


def _group(**rules: Any) -> typer.Typer:
    """Return an empty group of commands for Typer."""
    return typer.Typer(
        cls=RiseDiGroup,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["--help", "-h"]},
        **rules,
    )


def application(words: Collection[str]) -> typer.Typer:
    """Build the command line with the commands that occur among the words.

    All other commands only get a name and a help text.
    """
    app = _group(
        epilog="rise-di help COMMAND and rise-di COMMAND -h show the options of a command."
    )
    app.callback()(_options)
    for group, commands in GROUPS.items():
        for name, sentence in commands.items():
            module = f"{name}_" if iskeyword(name) else name
            verbs = VERBS.get(name, {})
            # For a command without verbs, the module has the command itself.
            target = _group() if verbs else app
            for verb, meaning in (verbs or {name: sentence}).items():
                command: Callable[..., None] = lambda: None  # noqa: E731 - not called
                if name in words:
                    command = as_function(resolve_name(f"flight_cli.{module}:{verb.capitalize()}"))
                target.command(
                    verb,
                    help=None if name in words else meaning,
                    rich_help_panel=None if verbs else group,
                    cls=RiseDiCommand,
                )(command)
            if verbs:
                app.add_typer(target, name=name, help=sentence, rich_help_panel=group)
    return app


def _repeat_interrupt(ignored: "sys.UnraisableHookArgs") -> None:
    """Repeat a Ctrl-C that came inside a destructor or a callback of a weak reference.

    In such places, Python only prints the interrupt and goes on.
    """
    if issubclass(ignored.exc_type, KeyboardInterrupt):
        signal.signal(signal.SIGALRM, signal.default_int_handler)
        signal.setitimer(signal.ITIMER_REAL, REPEATED_AFTER)
    else:
        sys.__unraisablehook__(ignored)


def _is_onlooker(words: Sequence[str]) -> bool:
    """Return whether a command only shows a flight and so should yield its CPU time to it.

    A page with buttons that deactivate the law, or that command a hold, does not yield, because it
    has to answer when the host is busy.
    """
    return words[:1] == ["watch"] and CONTROLS.isdisjoint(words)


def main() -> None:
    """Run a command of the command line.

    Bad input ends with a sentence and exit status 2. Ctrl-C ends without a traceback.
    """
    gc.set_threshold(GARBAGE_THRESHOLD)
    compute_in_one_thread()
    if _is_onlooker(sys.argv[1:]):
        with suppress(OSError):
            os.nice(NICE)
            # Run as a batch process, which does not interrupt a node when it wakes up.
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    words = [
        *without_help_word(sys.argv[1:])[:1],
        *os.environ.get("_TYPER_COMPLETE_ARGS", os.environ.get("COMP_WORDS", "")).split(),
    ]
    try:
        app = application(words)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.unraisablehook = _repeat_interrupt
        # These imports are not at the top of the file, because --help does not need them.
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
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # for the output that Python writes at its end
        print(
            f"error: output: cannot be written ({error.strerror}), expected a disk with space",
            file=sys.stderr,
        )
        sys.exit(FAILED)
    except Exception as error:
        # While it loads, a module in C turns Ctrl-C into an ImportError, and pybind11 into a
        # TypeError.
        if not isinstance(error.__cause__, KeyboardInterrupt):
            raise
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
