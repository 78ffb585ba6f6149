# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Build the head of a flight's page: name, time, verdict, and a tile for each output."""

import shlex
from collections.abc import Mapping
from datetime import datetime
from typing import Any

import numpy as np

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario, scenarios
from flight_analysis.report import guided
from flight_analysis.report.display_units import (
    NO_UNIT,
    DisplayUnit,
    aligned_numbers,
    format_seconds,
    in_order,
    plain_number,
)
from flight_analysis.report.page import Colour, Step, Tile, Verdict
from flight_analysis.report.sample_counts import is_simulated
from flight_analysis.report.summary import RecordedFlight, command_results
from flight_core.outcome import STATUS_HOST, Aim, End
from flight_guidance.guidance_state import Lateral
from flight_log.clock import SINCE_EPOCH_NS

# ---- Title


def title_of(flight: RecordedFlight) -> str:
    """Return the title of a flight: its scenario, or the log from which it was imported."""
    if flight.scenario is not None:
        return flight.scenario.name
    return str(flight.summary["source"]["log"])


def meta_lines(flight: RecordedFlight, scenario: Scenario) -> list[str]:
    """Return the lines below the title: date, airframe, law, duration, speed, pace and run."""
    is_known = is_simulated(flight.tape) or "engagements" in flight.summary
    aircraft = scenario.aircraft.airframe if is_known else "an aircraft outside of the scenario"
    parts = [
        f"{aircraft}, control law {scenario.controller.law}",
        f"{format_seconds(flight.summary['duration'])} flown",
    ]
    distance = guided.distance(flight.tape)
    if distance is not None:
        parts.append(f"{distance / 1e3:.2f} km over ground")
    # The aircraft of the scenario has the trim speed.
    speed = guided.top_speed(flight.tape, scenario.aircraft.channels().speed)
    if speed is not None and is_known:
        parts.append(f"at most {speed:.1f} m/s")
    parts.append(pace(flight))
    when = started(flight)
    return [" · ".join([*([when] if when else []), *parts]), f"run {flight.name}"]


def started(flight: RecordedFlight) -> str:
    """Return the date and time at which a flight began, as text, or "" if the log lacks them."""
    start = (flight.summary["flight"] or {}).get("started")
    try:
        return f"{datetime.fromisoformat(start):%-d %b %Y, %H:%M} UTC" if start else ""
    except ValueError:
        return ""


def pace(flight: RecordedFlight) -> str:
    """Say whether a flight was in real time, in simulated time, or by the clock of a simulator."""
    if flight.tape.is_by_clock:
        return "by /clock"
    if flight.tape.start_ns > SINCE_EPOCH_NS:
        return "in real time"
    has_nodes = bool((flight.summary["account"] or {}).get("processes"))
    return "in simulated time, over topics" if has_nodes else "in simulated time, in one process"


# ---- Verdict

FLOWN = ("aircraft", "reference_model", "controller", "guidance")
"""Sections of a scenario that determine a flight, apart from its length."""

FILE_MODEL = "file"  # name of the model from the file, which a learner can fly as well
NEXT = {
    Aim.ERROR: "Ask whether its loop is stable, and with what margins:",
    Aim.LOG: "Fly it in lockstep, where no message is late or lost:",
}
"""The next step for the gravest shortfall. For other shortfalls, the next step is to look at the
flight again."""


def verdict_of(flight: RecordedFlight, scenario: Scenario) -> Verdict:
    """Return the verdict on a flight: a headline, a colour, more text, and the next step.

    The next step is the command that the user should try after this flight.
    """
    outcome = flight.summary["outcome"]
    sentence = f"{outcome['sentence'][:1].upper()}{outcome['sentence'][1:]}."
    injected = _injected(scenario)
    texts = [injected, command_results(flight.summary)]
    name = scenario_argument(flight, scenario)
    if outcome["status"] == STATUS_HOST:
        headline = "No finding about the law."
        texts = [sentence, injected]
        colour = Colour.HOST
        step = Step(
            sentence="Fly the same without the clock:", command=f"rise-di fly {name} --lockstep"
        )
    elif outcome["status"] == 0:
        # If a flight went well, errors that wind or noise excuses are only a detail.
        end = outcome["reason"] or outcome["end"]
        headline = f"{end[:1].upper()}{end[1:]}."
        within = "The error of every output stayed within what is allowed"
        texts = [
            within if outcome["errors"] else "",
            _route_text(flight),
            _models_text(flight),
            *texts,
        ]
        colour = Colour.GOOD
        step = Step(
            sentence="Check that the log reproduces every u, bit by bit:",
            command=f"rise-di replay {run_argument(flight)}",
        )
    else:
        # The shortfalls come first, because a flight that completed can still fall short.
        end, _, worst = sentence.partition("; ")
        headline = worst.removeprefix("worst: ") or sentence
        # If the sentence begins with the name of an output, such as q, its first letter stays
        # small.
        if headline.split()[0] not in scenario.controller.outputs:
            headline = f"{headline[:1].upper()}{headline[1:]}"
        if worst:
            texts.insert(0, end)
        colour = Colour.BAD
        step = Step(
            sentence="See the flight again:", command=f"rise-di watch {run_argument(flight)}"
        )
        if not injected:
            step = _next_step(outcome, scenario, name, step)
    return Verdict(
        headline=headline,
        colour=colour,
        text=" ".join(f"{text.rstrip('.')}." for text in texts if text),
        details=[
            *outcome["details"],
            *(each["sentence"] for each in outcome["allowances"] if outcome["status"] == 0),
        ],
        step=step,
    )


def _next_step(outcome: Mapping[str, Any], scenario: Scenario, name: str, otherwise: Step) -> Step:
    """Return the step that the user should try after a flight that falls short.

    The step is chosen by the gravest shortfall. `name` is the argument that stands for the scenario
    in commands. If no step is known for this shortfall, the result is the argument `otherwise`.
    """
    order = list(Aim)
    aims = sorted((Aim(each["aim"]) for each in outcome["shortfalls"]), key=order.index)
    gravest = aims[0] if aims else None
    if gravest is Aim.ERROR and not scenario.aircraft.is_jsbsim:
        return Step(sentence=NEXT[gravest], command=gains_command("check", scenario, name))
    if gravest is Aim.LOG:
        return Step(sentence=NEXT[gravest], command=f"rise-di fly {name} --lockstep")
    if outcome["end"] == End.NEVER_FLEW:
        return Step(sentence="See what the nodes say:", command=f"rise-di fly {name} --verbose")
    return otherwise


def _route_text(flight: RecordedFlight) -> str:
    """Say how a guided flight followed its route. Returns "" if it had no route."""
    legs = (flight.summary["guidance"] or {}).get("legs") or ()
    if not legs:
        return ""
    flown = sum(leg["result"] == guided.LegResult.FLOWN for leg in legs)
    on_last = (
        ", the last not to its end" if legs[-1]["result"] == guided.LegResult.NOT_ENDED else ""
    )
    text = f"It flew {flown} of the {len(legs)} legs that it began{on_last}"
    log = flight.tape.signals.get("guidance")
    if log is None:
        return text
    # Only the time on a leg of the route counts, after the aircraft has joined the leg.
    is_on_leg = (log["mode.lateral"] == Lateral.ROUTE) & (log["joining"] == 0.0)
    beside = np.abs(log["xtrack"][is_on_leg])
    finite = beside[np.isfinite(beside)]
    return f"{text}, at most {np.max(finite):.0f} m beside them" if len(finite) else text


def _models_text(flight: RecordedFlight) -> str:
    """Say how many learned models were used. Returns "" for a flight that did not learn."""
    if not flight.summary["models"]:
        return ""
    count = len(learned_spans(flight))
    if not count:
        return "No model of the aircraft that was learned in flight was used"
    used = "model of the aircraft, learned in flight, was used"
    if count > 1:
        used = "models of the aircraft, learned in flight, were used"
    return f"{count} {used}"


def learned_spans(flight: RecordedFlight) -> list[Mapping[str, Any]]:
    """Return the spans of time in which the law used a model that was learned in flight.

    Spans before the first learned model are left out, and spans with the model of the airframe
    file.
    """
    _, *later = flight.summary["models"]
    return [span for span in later if span["name"] != FILE_MODEL]


def _injected(scenario: Scenario) -> str:
    """Say which actuator faults the scenario injects, because they can explain an error."""
    faults = scenario.aircraft.actuators.read_faults()
    parts = [
        f"{fault.subject}{f' ({fault.extent})' if fault.extent else ''} at t = {fault.at:g} s"
        for fault in faults
    ]
    return f"The scenario injects: {', '.join(parts)}" if parts else ""


def scenario_argument(flight: RecordedFlight, scenario: Scenario) -> str:
    """Return the command argument that names the scenario of a flight, to fly it again.

    If the flight had the parameters of a shipped scenario, the argument is the scenario's name. If
    not, it is the file in the folder of the run that has the parameters of the flight.
    """
    if scenario.name in scenarios():
        shipped = find_scenario(scenario.name)
        if all(getattr(shipped, key) == getattr(scenario, key) for key in FLOWN):
            return scenario.name
    return shlex.quote(f"runs/{flight.name}/parameters.yaml")


def gains_command(verb: str, scenario: Scenario, name: str) -> str:
    """Return the command `rise-di gains VERB` for the gains of a scenario.

    `name` is the argument that stands for the scenario in commands.
    """
    return f"rise-di gains {verb} {shlex.quote(scenario.aircraft.airframe)} --scenario {name}"


def run_argument(flight: RecordedFlight) -> str:
    """Return the command argument that names the run of a flight: its folder."""
    return shlex.quote(f"runs/{flight.name}")


# ---- Tiles

NAMES = {"q": "pitch rate q", "p": "roll rate p", "r": "yaw rate r", "V": "airspeed V"}
"""Names of outputs in words."""


def tiles_of(flight: RecordedFlight) -> list[Tile]:
    """Return a tile with the rms error of each output.

    A tile compares the error in the worst part of the flight with the error allowed there. If the
    errors were not judged, the tile has the error over the whole flight. Errors are not judged if a
    flight ended early, or if the host starved the nodes of processor time.
    """
    units = flight.units
    outcome = flight.summary["outcome"]
    worst = {figures["output"]: figures for figures in outcome.get("errors", ())}
    if worst and outcome["status"] != STATUS_HOST:
        return [
            _judged_tile(worst[name], units.get(name, NO_UNIT)) for name in in_order(worst, units)
        ]
    tiles = []
    for name, parts in (flight.summary["errors"] or flight.summary.get("e", {})).items():
        unit = units.get(name, NO_UNIT)
        rms = parts["whole"]["rms"]
        if rms is not None:
            value = plain_number(rms * unit.factor, 3)
            text = f"over {format_seconds(flight.summary['duration'])}, not judged"
            shown = NAMES.get(name, name)
            tiles.append(Tile(name=shown, value=value, unit=f"{unit.unit} rms error", text=text))
    return tiles


def _judged_tile(figures: Mapping[str, Any], unit: DisplayUnit) -> Tile:
    rms, allowed = aligned_numbers(figures["rms"] * unit.factor, figures["allowed"] * unit.factor)
    length = figures["stop"] - figures["start"]
    when = f"t = {figures['start']:.0f} to {figures['stop']:.0f} s"
    part = figures["rms"] / figures["allowed"]
    limit = f"{part:.1f} times the {allowed}" if part > 1.0 else allowed
    return Tile(
        name=f"{NAMES.get(figures['output'], figures['output'])}, worst {length:.0f} s",
        value=rms,
        unit=f"{unit.unit} rms error",
        text=f"{limit} allowed; {when}",
        part=part,
        has_limit=True,
    )
