# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compare controllers on the identified aircraft for `rise-di tune`, and find the best.

Each controller flies the commands of the scenario in calm air and in gusts. The autopilot's loop
flies them as well, for comparison.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.outcome import COMPLETED
from flight_core.parameters import ParameterError
from flight_core.rates import period_ns
from flight_core.tape import Tape
from flight_core.vectors import FloatArray
from flight_design.gains.feedforward_model import with_feedforward, with_states_of
from flight_design.gains.gain_design import check_gains, select_gains
from flight_design.identification.own_loop import OwnLoop
from rise_di_controller.rise_di_config import RiseDiConfig

CALM, GUSTS = "calm", "gusts"
TURBULENCE: Mapping[str, float] = MappingProxyType({"altitude": 5.0, "wind": 5.0})
"""Turbulence of a wind of 5 m/s near the ground, which has 0.5 m/s rms along the vertical axis."""
ROLLING = {"amplitude": 0.7, "frequency": 5.0}
"""A rotation of the air about the roll axis as a sine: its amplitude, rad/s, and its frequency,
rad/s. The rms is 0.5 rad/s, and 1 / frequency is 0.2 s."""
SAMPLES = 60  # number of uncertain aircraft
LEAST = 0.05  # uncertainty of an entry that the log does not show, and the least one of a search
DELAY_MARGIN = 0.01  # with the observer, s, as in examples/px4_airplane/rates_observer.yaml
FORMER = "as in the scenario"
Report = Callable[[str], None]


class Candidate(NamedTuple):
    """A controller that competes to become the module."""

    name: str
    scenario: Scenario  # scenario with this controller and the identified aircraft
    origin: str  # source of the gains; "" for the scenario
    shortfall: str  # a sentence on margins that fall short; "" if none do
    rms: Mapping[str, FloatArray]  # rms of y - y_m by air, (m,); infinite if the flight ends early

    @property
    def score(self) -> float:
        """The geometric mean of the rms errors of the outputs, rad/s.

        The rms error of an output is taken over all kinds of air together, so air with larger
        errors has more weight. In the geometric mean, an equal relative change has the same weight
        in each output.
        """
        in_all = np.sqrt(np.mean(np.square(list(self.rms.values())), axis=0))
        return float(np.exp(np.mean(np.log(in_all))))


class Selectors(NamedTuple):
    """The data and options by which candidates are selected and judged."""

    airframe: Airframe  # the identified airframe
    flight: Scenario  # scenario of the log, with the identified airframe
    # file of the aircraft that flies: the airframe, with the bank angle if it is a fixed wing
    aircraft: Path
    uncertainty: float  # uncertainty of A and B, for the search of gains
    entries: Mapping[str, float]  # uncertainty of each entry that the log shows, for the margins
    lead: Callable[[RiseDiConfig], RiseDiConfig]  # gives a feedforward the lead of the module
    calm: bool  # whether only flights in calm air are judged, without an observer
    accept: bool  # whether gains with too small margins are accepted
    weights: Path | None
    report: Report

    @property
    def airs(self) -> dict[str, dict[str, Any]]:
        """The kinds of air in which candidates fly, as parameters of the section aircraft."""
        airs: dict[str, dict[str, Any]] = {CALM: {}}
        if self.airframe.gusts and not self.calm:
            airs[GUSTS] = {"turbulence": dict(TURBULENCE)}
            if "p" in self.airframe.states:
                # The air rotates, so p_dot changes by -A[p, p] times the rate of the air.
                row = self.airframe.index("p")
                damping = abs(float(self.airframe.matrix_a()[row, row]))
                rolling = ROLLING | {"amplitude": damping * ROLLING["amplitude"]}
                airs[GUSTS]["sines"] = {"p": rolling}
        return airs


def candidates(selectors: Selectors) -> list[Candidate]:
    """Return the candidates, first the scenario's controller and then selected ones.

    A selection that fails is reported and left out. Raises ParameterError if all of them fail.
    """
    flight, airframe = selectors.flight, selectors.airframe
    former = flight.rise_di()
    found = {FORMER: (former, "")}
    # The feedforward knows what the scenario's feedforward knows beyond the airframe, such as the
    # bank.
    beyond = airframe
    if former.feedforward is not None:
        beyond = with_states_of(airframe, former.feedforward)
    if former.feedforward is not None and former.observer is None:
        of_aircraft = selectors.lead(with_feedforward(former, beyond))
        found["its gains, feedforward of this aircraft"] = of_aircraft, ""
    options: dict[str, dict[str, Any]] = {"without an observer": {}}
    observer = {"observer": True, "margin": DELAY_MARGIN}
    if not selectors.calm:
        options["observer by a rule"] = observer
        if selectors.weights is not None:
            # The gains are accepted here, because the margins of all candidates are judged below.
            as_read = {"weights": selectors.weights, "accept": True}
            options[f"observer of {selectors.weights.name}"] = observer | as_read
    reasons = []
    for number, (name, choice) in enumerate(options.items(), 1):
        selectors.report(f"gains {number} of {len(options)}: {name}")
        try:
            selection = select_gains(
                airframe,
                flight,
                uncertainty=selectors.uncertainty,
                samples=SAMPLES,
                feedforward=True,
                **({"accept": selectors.accept} | choice),
            )
        except ParameterError as error:
            reasons.append(f"{name}: {error}")
            selectors.report(reasons[-1])
            continue
        chosen = selection.chosen
        if chosen.observer is None:
            chosen = with_feedforward(chosen, beyond)
        found[name] = selectors.lead(chosen), selection.origin
    if len(reasons) == len(options):
        raise ParameterError("; ".join(reasons))
    return [
        _judged(selectors, name, controller, origin) for name, (controller, origin) in found.items()
    ]


def best_of(found: Sequence[Candidate], *, accept: bool) -> Candidate:
    """Return the candidate with the least score among those whose margins suffice.

    With `accept`, candidates whose margins do not suffice are included. Raises ParameterError, with
    the shortfall of the best candidate, if no margins suffice.
    """
    by_score = sorted(found, key=lambda candidate: candidate.score)
    enough = [candidate for candidate in by_score if accept or not candidate.shortfall]
    if not enough:
        short = f"{by_score[0].name}: {by_score[0].shortfall}"
        expected = "--accept, which writes them all the same, or --calm"
        raise ParameterError(f"gains: found {short}, expected {expected}")
    return enough[0]


def rms_of_own_loop(own: OwnLoop, selectors: Selectors) -> dict[str, FloatArray]:
    """Return the rms of y - y_m under the autopilot's own loop, (m,), for each kind of air."""
    flight, airframe = selectors.flight, load_airframe(str(selectors.aircraft))
    controller = flight.rise_di()
    errors = {}
    for air, changes in selectors.airs.items():
        tape = _flown(selectors, flight, changes)
        y_m = tape["y_m"]
        length = y_m.stamp_ns[-1] - tape.start_ns
        stamps = tape.start_ns + np.arange(0, length, period_ns(controller.rate, "rate"))
        setpoints = [np.interp(stamps, y_m.stamp_ns, y_m[name]) for name in controller.outputs]
        truth = tape["truth"]
        forces = [np.interp(stamps, truth.stamp_ns, truth[f"f.{name}"]) for name in airframe.states]
        rows = [airframe.outputs.index(name) for name in controller.outputs]
        error = own.flown(
            flight,
            airframe,
            np.column_stack(setpoints),
            np.array(flight.aircraft.sensors.noise)[rows],
            np.column_stack(forces),
        )
        errors[air] = _root_mean_square(error)
    return errors


def _judged(selectors: Selectors, name: str, controller: RiseDiConfig, origin: str) -> Candidate:
    """Fly a controller in each kind of air, and compare its margins with the requirement.

    The margins are the worst ones of aircraft in the box that the guarantee bounds.
    """
    scenario = selectors.flight.vary(controller=controller)
    selectors.report(f"flying in {' and in '.join(selectors.airs)}: {name}")
    rms = {
        air: _error(_flown(selectors, scenario, changes), selectors.airframe)
        for air, changes in selectors.airs.items()
    }
    answer = check_gains(
        selectors.airframe,
        scenario,
        uncertainty=LEAST,
        samples=SAMPLES,
        entries=selectors.entries,
        as_told=True,
    )
    short = [row.sentence(controller.outputs) for row in answer.unmet]
    return Candidate(
        name=name, scenario=scenario, origin=origin, shortfall="; ".join(short), rms=rms
    )


def _flown(selectors: Selectors, scenario: Scenario, air: Mapping[str, Any]) -> Tape:
    """Simulate a scenario with the airframe file `aircraft` in one kind of air."""
    return simulate(scenario.vary(aircraft={"airframe": str(selectors.aircraft), **air}))


def _error(tape: Tape, airframe: Airframe) -> FloatArray:
    """Return the rms of the true y - y_m of a flight, (m,), or infinity if it ended early."""
    truth, y_m = tape["truth"], tape["y_m"]
    rows = [airframe.outputs.index(name) for name in y_m.names]
    if tape.outcome != COMPLETED:
        return np.full(len(rows), np.inf)
    states = np.column_stack([truth[f"x.{state}"] for state in airframe.states])
    y = states @ airframe.matrix_c()[rows].T
    wanted = [np.interp(truth.stamp_ns, y_m.stamp_ns, y_m[name]) for name in y_m.names]
    return _root_mean_square(y - np.column_stack(wanted))


def _root_mean_square(e: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(e**2, axis=0)))
