# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Summarise a flight: compute the metrics for `summary.json` and the tables.

The units and columns of the tables are in `summary_rows`.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import numpy as np

from aircraft_sim.params import AircraftConfig
from flight_analysis.closed_loop.scenario import Scenario, as_scenario
from flight_analysis.linear_loop.delay_margin import delay_margin
from flight_analysis.linear_loop.told import FlightFacts
from flight_analysis.metrics.by_part import errors_by_part, inputs_by_part
from flight_analysis.metrics.controller_log import saturation_shares, sign_switches
from flight_analysis.metrics.errors import TRUE_ERROR, best_error, noise_floor, tracking_error
from flight_analysis.metrics.settling import settling_bands, settling_times
from flight_analysis.metrics.transients import Air, Transient, TransientKind
from flight_analysis.report.account import (
    Account,
    Commands,
    account,
    account_of_json,
)
from flight_analysis.report.display_units import (
    UNITLESS,
    DisplayUnit,
    display_unit,
    display_units,
    format_seconds,
    in_order,
)
from flight_analysis.report.disturbances import air_of, transients
from flight_analysis.report.flown_models import FlownController
from flight_analysis.report.flown_reference import reason_not_compared
from flight_analysis.report.guided import guidance_notices, guidance_summary
from flight_analysis.report.model_spans import errors_by_model
from flight_analysis.report.sample_counts import WHOLE, is_last_to_end, is_simulated
from flight_analysis.report.shortfalls import judge
from flight_analysis.report.starvation import BUSY
from flight_analysis.report.timing import (
    AgeMetrics,
    LatencyMetrics,
    TickMetrics,
    age_metrics,
    latency_metrics,
    tick_metrics,
)
from flight_analysis.report.tracking import saturation_notes
from flight_core.modes import Mode
from flight_core.outcome import End, Outcome
from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS, period_ns
from flight_core.tape import Tape, as_tape, refusal_note
from flight_log.bag import COMPARED
from flight_log.clock import SINCE_EPOCH_NS
from flight_log.log_messages import LogMessage


class RecordedFlight(NamedTuple):
    """A recorded flight, with its tape, its scenario and its summary.

    Its name is the name of the run. Figures, tables, exports and comparisons are made from it.
    """

    name: str
    scenario: Scenario | None  # None for an imported flight
    tape: Tape
    summary: dict[str, Any]  # the result of `summarise` or of `summarise_imported`
    si_units: Mapping[str, str] = {}  # units by channel of an imported flight
    # the parameters in use, one set after each change; empty if they never changed
    controllers: tuple[FlownController, ...] = ()
    later_aircraft: tuple[AircraftConfig, ...] = ()  # the aircraft after each change in flight
    messages: tuple[LogMessage, ...] = ()

    @property
    def period_ns(self) -> int:
        """The period of the controller's ticks, ns.

        For an imported flight it is the median interval between samples of u.
        """
        if self.scenario is None:
            return max(int(np.median(np.diff(self.tape["u"].stamp_ns))), 1)
        return period_ns(self.scenario.controller.rate, "controller.rate")

    @property
    def units(self) -> dict[str, DisplayUnit]:
        """The units that tables and figures use, by channel of y and u."""
        if self.scenario is None:
            known = {name: display_unit(unit) for name, unit in self.si_units.items()}
            inputs = self.tape["u"].names if "u" in self.tape else ()
            return {**known, **{name: UNITLESS for name in inputs if name not in known}}
        return display_units(self.scenario)

    @property
    def message_times(self) -> list[float]:
        """The flight times of the messages of the log, s."""
        return [(message.stamp_ns - self.tape.start_ns) / NANOSECONDS for message in self.messages]

    @property
    def gusts(self) -> dict[str, tuple[float, float]]:
        """The start and the end of each gust of the scenario, s."""
        if self.scenario is None or not is_simulated(self.tape):
            return {}
        return self.scenario.gust_windows()


def labels(flights: Sequence[RecordedFlight]) -> list[str]:
    """Return a label for each flight: its name, with a number if two names are equal."""
    names = [flight.name for flight in flights]
    return [
        f"{name} ({k})" if names.count(name) > 1 else name for k, name in enumerate(names, start=1)
    ]


def common_units(flights: Sequence[RecordedFlight]) -> dict[str, DisplayUnit]:
    """Return the units by channel, taken from the first flight with this channel."""
    by_channel: dict[str, DisplayUnit] = {}
    for flight in reversed(flights):
        by_channel |= flight.units
    return by_channel


def summarise(
    tape: Tape,
    scenario: Scenario | None = None,
    outcome: Outcome | None = None,
    flight_account: Account | None = None,
) -> dict[str, Any]:
    """Return the metrics of a flight, SI, as a dict that JSON can hold.

    The keys are explained in docs/log.md, section Figures.

    Args:
        tape: A flight with y and y_m.
        scenario: The scenario of the flight. If None, it is the scenario on the tape. The tape of a
            log has no scenario, so this argument is needed.
        outcome: How the flight ended. If None, it is the outcome on the tape.
        flight_account: The account of the whole flight, if the tape is only a part of it.

    Returns:
        The metrics by key.

    Raises:
        ParameterError: The tape has no y and y_m, or no scenario is known.

    Examples:
        >>> tape = rise_di.simulate(rise_di.find_scenario("osprey_servo", duration=0.1))
        >>> rise_di.summarise(tape)["outcome"]["sentence"]
        'completed'
    """
    scenario = _flown_scenario(tape, scenario)
    outcome = tape.outcome if outcome is None else outcome
    _require_topics(tape)
    flight_account = account(tape, scenario, outcome) if flight_account is None else flight_account
    not_compared = reason_not_compared(tape, scenario)
    events = transients(scenario, tape, follows_scenario=not_compared is None)
    air = air_of(scenario, tape)
    flight_account = flight_account._replace(commands=_commands(tape, events, flight_account.end))
    ticks = None
    if "internals" in tape:
        ticks = tick_metrics(tape, period_ns(scenario.controller.rate, "controller.rate"))
    age = age_metrics(tape)
    is_real_time = tape.start_ns > SINCE_EPOCH_NS
    if is_real_time and not is_last_to_end(tape, "internals"):
        flight_account = _with_late_ticks(flight_account, ticks, scenario)
    busy = flight_account.busy
    busy_notes = [busy] if busy else []
    summary = empty_summary(scenario, judge(outcome, tape, scenario, flight_account)) | {
        "duration": _duration(tape, flight_account),
        "error": best_error(tape)[0],
        "air": air,
        "errors": _in_order(_errors(tape, events, air), scenario),
        "inputs": _in_order(_inputs(tape, events, air), scenario),
        "transients": [
            asdict(settling.transient) | {"until": settling.until, "settling": settling.time}
            for settling in settling_times(tape, events)
        ],
        "ticks": _finite(ticks),
        "latency": _finite(latency_metrics(tape)),
        "age_of_u": _finite(age),
        "guidance": guidance_summary(tape, scenario.guidance),
        "models": [
            {**span._asdict(), "rms": _in_order(span.rms, scenario)}
            for span in errors_by_model(tape)
        ],
        "account": flight_account.as_json(),
        "notes": [
            *busy_notes,
            *late_u_notes(scenario, age),
            *(note for note in tape.notes if note != busy),
            *saturation_notes(tape),
            *([] if not_compared is None else [not_compared.note()]),
            *mode_notes(tape, flight_account.over(*FIGURES["ticks"])),
            *vane_notes(tape),
            *guidance_notices(tape, scenario.guidance),
        ],
    }
    return {key: finite_or_null(value) for key, value in summary.items()}


def _flown_scenario(tape: Tape, scenario: Scenario | None) -> Scenario:
    """Return `scenario` or, if it is None, the tape's scenario. Raises ParameterError if none."""
    of_flight = as_tape(tape).scenario if scenario is None else scenario
    require(
        of_flight is not None,
        "scenario",
        "no scenario for the tape of a log",
        "one as the second argument, such as recorded_scenario(run)",
    )
    return as_scenario(of_flight)


def _require_topics(tape: Tape) -> None:
    """Check that a tape has y and y_m. Raises ParameterError if one of them is missing."""
    for topic in ("y", "y_m"):
        unset = " with a stamp" if topic in tape.recording and tape.recording[topic].unset else ""
        refusal = f" ({refusal_note(topic, tape.refused[topic])})" if topic in tape.refused else ""
        lack = f"no sample of {topic}{unset}{refusal}"
        require(topic in tape, "the log", lack, "a flight with y and y_m")


def _finite(metrics: TickMetrics | LatencyMetrics | AgeMetrics | None) -> dict[str, Any] | None:
    """Return metrics by name, or None if one of them is not finite."""
    return metrics._asdict() if metrics is not None and np.isfinite(metrics).all() else None


def summarise_imported(tape: Tape, source: Mapping[str, str]) -> dict[str, Any]:
    """Return the metrics of an imported log, whose flight was flown by another controller.

    The result has metrics of y and u about trim, and the numbers of samples by topic. Such a flight
    has no reference y_m, so it has no error. `source` is the content of the metadata record
    IMPORTED, which `rise-di import` writes.
    """
    flight_account = account(tape, None)
    deviations = {}
    for key, topic in (("outputs", "y"), ("inputs", "u")):
        by_channel = inputs_by_part(tape, (), topic=topic)
        deviations[key] = {
            name: {"whole": asdict(parts["whole"])} for name, parts in by_channel.items()
        }
    summary = (
        empty_summary(None, Outcome(End.IMPORTED))
        | deviations
        | {"duration": flight_account.end, "account": flight_account.as_json()}
    )
    summary |= {
        "source": dict(source),
        "notes": [*filter(None, [source.get(COMPARED)]), *flight_account.notes(), *tape.notes],
    }
    return {key: finite_or_null(value) for key, value in summary.items()}


def summarise_own(tape: Tape, law: str, log: str, outcome: Outcome) -> dict[str, Any]:
    """Return the metrics of a flight of a user's own aircraft, which the log does not describe.

    The errors are computed from the measured y. Nothing is judged, because there is no model of the
    aircraft.
    """
    source = {"log": log, "kind": f"the user's own aircraft, flown by the law {law}"}
    summary = summarise_imported(tape, source) | {"outcome": outcome.as_json()}
    if not {"y", "y_m"} <= tape.signals.keys():
        return summary
    with_error = replace(tape, signals={**tape.signals, "e": tracking_error(tape)})
    by_channel = inputs_by_part(with_error, (), topic="e")
    deviations = {name: {"whole": asdict(parts["whole"])} for name, parts in by_channel.items()}
    return summary | {key: finite_or_null(value) for key, value in {"e": deviations}.items()}


def late_u_notes(scenario: Scenario, age: AgeMetrics | None) -> list[str]:
    """Return a note, in a list, if u at the aircraft is much older than `controller.delay`.

    There is a note from one period more on. The linear loop is computed with `controller.delay`,
    and any further delay uses up the delay margin of this loop, which the note states. Without a
    linear model there is no note.
    """
    controller = scenario.controller
    if age is None or age.mean - controller.delay < 1.0 / controller.rate:
        return []
    from flight_analysis.linear_loop.loop_margins import scenario_loop  # noqa: PLC0415 - loads SciPy, which few flights need

    # the loop has the delay for which the gains are made, and the margin adds to it
    told = FlightFacts(is_simulated=False)
    try:
        linear = scenario_loop(scenario, controller, flight=told)
    except ParameterError:  # no linear model
        return []
    margin = delay_margin(linear.nominal, linear.law, linear.loop)
    late = age.mean - controller.delay
    return [
        (
            f"u is {1e3 * age.mean:.1f} ms old at the aircraft, which is {1e3 * late:.1f} ms more "
            f"than the gains are made for: {'more than' if late > margin else 'within'} their "
            f"delay margin of {1e3 * margin:.1f} ms; see rise-di gains select --delay"
        )
    ]


def _commands(tape: Tape, events: Sequence[Transient], end: float) -> Commands:
    commands = [event.start for event in events if event.kind is TransientKind.COMMAND]
    targets = sum(
        tape.recording[topic].found for topic in ("target", "route") if topic in tape.recording
    )
    steps_with_commands = (
        int(np.count_nonzero(tape["guidance"]["given"])) if "guidance" in tape else 0
    )
    return Commands(
        given=len(commands),
        flown=sum(start <= end for start in commands),
        targets=targets,
        taken=steps_with_commands,
    )


def command_results(summary: Mapping[str, Any]) -> str:
    """Say how many commands of a flight were flown, if not all, and how many targets were given.

    An example is "8 of 24 commands flown". Returns "" if all commands were flown and no targets
    were given.
    """
    flight_account = account_of_json(summary)
    if flight_account is None or flight_account.commands is None:
        return ""
    commands = flight_account.commands
    if commands.flown < commands.given:
        part = coverage_suffix(summary, "commands")
        parts = [f"{commands.flown} of {commands.given} commands flown{part}"]
    else:
        parts = []
    if commands.targets:
        parts.append(
            f"{commands.targets} targets and routes given, guidance took commands in "
            f"{commands.taken} steps"
        )
    return "; ".join(parts)


STANDS_STILL = 5.0  # s; a vane that stands still longer at the end of a flight is named


def _with_late_ticks(
    flight_account: Account, ticks: TickMetrics | None, scenario: Scenario
) -> Account:
    """Return the account with a sentence on the busy host if too many ticks had no new y.

    The host is to blame for these ticks if the log lacks nothing that the host did send, if the
    sensor of y drops no samples, and if y comes from this package, about as often as the controller
    ticks or more often. In any other case the account is returned as it is.
    """
    log_complete = (
        not (flight_account.over("y", "internals") and not flight_account.busy)
        and not flight_account.lacks
        and not scenario.aircraft.sensors.dropout
    )
    y = flight_account.topics.get("y")
    rated = (
        y is not None
        and y.is_of_stack
        and y.expected is not None
        and y.expected >= (1.0 - BUSY) * flight_account.end * scenario.controller.rate
    )
    if ticks is None or not log_complete or not rated or ticks.without_new_y <= BUSY * ticks.ticks:
        return flight_account
    late = f"{ticks.without_new_y} ticks without a new y"
    if flight_account.busy:
        reason = f"; {flight_account.busy}"
    else:
        reason = ": this host is too busy; see docs/faults.md"
    return flight_account._replace(busy=f"{late}{reason}")


def _duration(tape: Tape, flight_account: Account) -> float | None:
    """Return the flight time of the last y, s.

    If the log lacks some samples of y, this is the end of the flight. Without any y, it is None.
    """
    if not len(tape["y"].stamp_ns):
        return None
    return flight_account.end if flight_account.over("y") else float(tape.time("y")[-1])


FIGURES = {
    "errors": ("y", "y_m", "internals", "u_m", "guidance"),
    "inputs": ("u", "internals", "u_m", "guidance"),
    "ticks": ("internals",),
    "guidance": ("guidance",),
    "commands": ("y", "u"),
    "latency": ("y", "u"),
    "age_of_u": ("u",),
}
"""Topics from which each table is made, besides `truth` for a true error. They have the values of
the table, or show the parts of the flight."""


def coverage_suffix(summary: Mapping[str, Any], table: str) -> str:
    """Say which part of the flight a table covers, as in ", over 49 % of truth".

    Returns "" if the table covers the whole flight.
    """
    flight_account = account_of_json(summary)
    truth = ("truth",) if table == "errors" and summary["error"] == TRUE_ERROR else ()
    part = "" if flight_account is None else flight_account.over(*truth, *FIGURES[table])
    return f", {part}" if part else ""


def is_in_host_time(summary: Mapping[str, Any]) -> bool:
    """Return whether the stamps are times of the host's clock. Only then are delays measured."""
    return bool(summary["flight"]) and summary["flight"]["start_ns"] > SINCE_EPOCH_NS


def time_flown(summary: Mapping[str, Any]) -> str:
    """Say how long the flight was, and which part of it the table of errors covers."""
    return f"{format_seconds(summary['duration'])} flown{coverage_suffix(summary, 'errors')}"


def engagement_notes(engagements: Sequence[Mapping[str, Any]], *, is_y_engaged: bool) -> list[str]:
    """Return sentences on the engagements of a flight that a bridge connected to an autopilot.

    `is_y_engaged` says whether a sample of y lies in an engagement. If none does, the summary has
    the metrics of the whole flight.
    """
    if not engagements:
        return ["never engaged: the figures are of an aircraft that this controller did not fly"]
    sentences = []
    for engagement in engagements:
        if engagement["stop"] is None:
            end = "the end of the log"
        else:
            end = f"{engagement['stop']:.1f} s: {engagement['reason']}"
        sentences.append(f"engaged from {engagement['start']:.1f} s to {end}")
    return [
        *sentences,
        (
            "the figures are of the "
            f"{'engaged time alone' if is_y_engaged else 'whole flight: no y while engaged'}"
        ),
    ]


def mode_notes(tape: Tape, part: str) -> list[str]:
    """Return a note, in a list, if over 1 % of the ticks had another mode than ENGAGED.

    The ticks from the first engagement on are examined. `part` says which part of the ticks the log
    has, as in "over 49 % of internals", or is "" if the log has all ticks.
    """
    if "internals" not in tape:
        return []
    is_engaged = (mode := tape["internals"]["mode"]) == Mode.ENGAGED
    ticks = mode[np.argmax(is_engaged) :]
    if not is_engaged.any() or np.mean(ticks == Mode.ENGAGED) >= WHOLE:
        return []
    others = [state for state in Mode if state is not Mode.ENGAGED and state in ticks]
    modes = ", ".join(f"{state.name} in {np.mean(ticks == state):.0%}" for state in others)
    over = f", {part}" if part else ""
    return [
        (
            f"the controller was {modes} of the ticks{over}: the figures include these ticks, in "
            "which u was held or at trim"
        )
    ]


def vane_notes(tape: Tape) -> list[str]:
    """Return a sentence for each vane that stands still at the end of a flight.

    A vane measures angle of attack or sideslip for an observer.
    """
    if "internals" not in tape:
        return []
    measures = tape["internals"].group("vane_measures")
    t = tape.time("internals")
    notes = []
    for name in measures.names:
        in_use = np.flatnonzero(measures[name] != 0.0)
        since = float(t[in_use[-1]] if len(in_use) else t[0])
        if t[-1] - since > STANDS_STILL:
            notes.append(
                f"vane {name} stands still from t = {since:.1f} s on and is left out: frozen, "
                "or in calm air"
            )
    return notes


def empty_summary(scenario: Scenario | None, outcome: Outcome) -> dict[str, Any]:
    """Return the summary of a flight that ended before its first sample."""
    return {
        "scenario": None if scenario is None else scenario.name,
        "outcome": outcome.as_json(),
        "flight": None,
        "duration": None,
        "air": None,
        "error": None,
        "errors": {},
        "inputs": {},
        "transients": [],
        "ticks": None,
        "latency": None,
        "age_of_u": None,
        "guidance": None,
        "models": [],
        "account": None,
        "notes": [],
    }


def _errors(tape: Tape, events: Sequence[Transient], air: Air) -> dict[str, Any]:
    bands = settling_bands(tape)
    floors = noise_floor(tape)
    switches = sign_switches(tape)
    figures = {}
    for channel, parts in errors_by_part(tape, events, air=air).items():
        figures[channel] = {part: asdict(figures_of) for part, figures_of in parts.items()} | {
            "bound": parts[Air.CALM].max if air is Air.CALM else None,
            "band": bands[channel],
            "floor": floors[channel],
            "sign_switches": switches.get(channel),
        }
    return figures


def _in_order(by_channel: Mapping[str, Any], scenario: Scenario) -> dict[str, Any]:
    """Sort values by channel in the order of the controller."""
    return {name: by_channel[name] for name in in_order(by_channel, display_units(scenario))}


def _inputs(tape: Tape, events: Sequence[Transient], air: Air) -> dict[str, Any]:
    saturation = saturation_shares(tape)
    figures: dict[str, Any] = {}
    for name, parts in inputs_by_part(tape, events, air=air).items():
        by_part: dict[str, Any] = {part: asdict(effort) for part, effort in parts.items()}
        figures[name] = by_part | {"limited": saturation.get(name)}
    return figures


def finite_or_null(value: Any) -> Any:
    """Return a value that JSON can hold, with None in place of NaN and infinity, at any depth.

    Metrics are NaN if their part of the flight has no samples, and infinite after an overflow.
    """
    if isinstance(value, Mapping):
        return {key: finite_or_null(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite_or_null(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
