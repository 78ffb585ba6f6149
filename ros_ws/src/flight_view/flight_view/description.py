# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Describe a scenario for the page, apart from the samples, ready for JSON."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from enum import IntEnum
from typing import Any, NamedTuple

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.report.display_units import NO_UNIT, display_units
from flight_analysis.report.disturbances import command_edges
from flight_analysis.report.guided import mission_drawing
from flight_analysis.report.model_spans import ModelSpan, model_names
from flight_analysis.report.summary_rows import model_rows
from flight_core.modes import Mode
from flight_core.rates import NANOSECONDS
from flight_guidance import guidance_state
from flight_guidance.params import GuidanceConfig
from flight_guidance.routes.route_file import Waypoint

KINDS: dict[str, type[IntEnum]] = {
    "": Mode,
    "mode": guidance_state.GuidanceMode,
    "mode.lateral": guidance_state.Lateral,
    "mode.vertical": guidance_state.Vertical,
}
MODES = {channel: {str(int(mode)): mode.name for mode in kind} for channel, kind in KINDS.items()}
"""Names of the modes of the controller and of guidance, by channel and number."""


class ParameterTicks(NamedTuple):
    """Successive ticks with the same parameters of the controller."""

    digest: float
    start_ns: int
    stop_ns: int
    ticks: int  # number of engaged ticks
    squares: Mapping[str, float]  # sums of e^2 over the engaged ticks, by output


def rms_by_model(
    spans: Sequence[ParameterTicks],
    start_ns: int,
    scenario: Scenario | None,
    proposed_ns: Sequence[int],
) -> dict[str, Any]:
    """Return a table of the measured rms errors for each model: its headings and its rows.

    The errors follow from the ticks of a flight, and the models from the stamps at which they were
    proposed.
    """
    first_ns: dict[float, int] = {}
    for span in spans:
        first_ns.setdefault(span.digest, span.start_ns)
    digests = list(first_ns)
    names = model_names(list(first_ns.values()), proposed_ns)
    ends_ns = [*(span.start_ns for span in spans[1:]), spans[-1].stop_ns]
    rows_of_spans = []
    for span, stop_ns in zip(spans, ends_ns, strict=True):
        start, stop = ((stamp_ns - start_ns) / NANOSECONDS for stamp_ns in (span.start_ns, stop_ns))
        if span.ticks:
            rms = {name: math.sqrt(square / span.ticks) for name, square in span.squares.items()}
            model = digests.index(span.digest)
            rows_of_spans.append(
                ModelSpan(name=names[model], model=model, start=start, stop=stop, rms=rms)._asdict()
            )
    units = {} if scenario is None else display_units(scenario)
    headings, rows = model_rows(rows_of_spans, dict.fromkeys(spans[0].squares, NO_UNIT) | units)
    return {"headings": ["", *headings], "rows": rows}


def _finite_or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None


def scenario_description(scenario: Scenario) -> dict[str, Any]:
    """Return what the page shows of a scenario.

    The result has units, effects of positive inputs, limits, gusts, commands and the route. Raises
    ParameterError if the airframe cannot be read.
    """
    controller = scenario.controller
    guidance = scenario.guidance
    limits = controller.effector_limits()
    bounds = zip(controller.effectors, limits.lower.tolist(), limits.upper.tolist(), strict=True)
    waypoints = () if guidance is None else guidance.waypoints()
    return {
        "scenario": controller.summary(),
        "duration": scenario.flight.duration,
        "units": {name: asdict(unit) for name, unit in display_units(scenario).items()},
        "positive": scenario.aircraft.channels().positive,
        "limits": {name: [*map(_finite_or_none, pair)] for name, *pair in bounds},
        "gusts": [[name, *window] for name, window in scenario.gust_windows().items()],
        "commands": [[edge.name, edge.start, edge.stop] for edge in command_edges(scenario)],
        "speed": scenario.aircraft.channels().speed,
        **({"route": []} if guidance is None else mission(guidance, waypoints)),
    }


def mission(guidance: GuidanceConfig, waypoints: Sequence[Waypoint]) -> dict[str, Any]:
    """Return what the map shows of a route: the content of `mission_drawing`, and the waypoints.

    A waypoint has north, east and altitude in m. Raises ParameterError if the route cannot be
    flown.
    """
    drawing = mission_drawing(guidance, [guidance.plan(waypoints)] if waypoints else [])
    return drawing | {"waypoints": [[*waypoint.point, waypoint.altitude] for waypoint in waypoints]}
