# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Each effector of the scenarios with an allocation fails once at a random time, under RISE-DI, PI and the observer.

python -m benchmarks.effectors --seeds 3 --faults lost,stuck
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from benchmarks.tables import new_table, wide_console

from aircraft_sim.airframe import load_airframe
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics import best_error
from flight_campaign.statistics import score, score_units
from flight_core.outcome import COMPLETED
from flight_design.gains.gain_design import select_gains
from rise_di_controller.params import ControllerConfig

SCENARIOS = ("osprey_twin", "osprey_vtail", "x8_elevons", "examples/hexarotor/hexarotor_flight.yaml")
FAULTS = {"lost": "lost_at", "stuck": "stuck_at", "half": "weak_at", "slow": "slow_at", "loose": "loose_at"}
DURATION, FROM, TO = 22.0, 3.0, 10.0  # s: a flight at most, first and last begin of a fault
SCORE_LOST = 10.0  # a higher score is a loss of track


class Flight(NamedTuple):
    """A flight with a fault."""

    score: float  # from the begin of the fault on; infinite for an early end
    lost: tuple[str, ...]  # the outputs that have a score above SCORE_LOST alone, else the one with the largest
    beyond: float  # largest excess of u over its stops, SI
    held: float  # part of the time after the fault in which an effector is at its stop


def laws(scenario: Scenario, *, with_observer: bool) -> dict[str, ControllerConfig]:
    """RISE-DI of the scenario, the PI of the same linear gains, and RISE-DI beside an observer of the airframe, if wanted."""
    own = scenario.rise_di()
    params = own.law_params()
    common = {key: getattr(own, key) for key in ControllerConfig.model_fields}
    integral = params.Lambda + params.beta / (params.eps * params.K)
    pi = {**common, "law": "pi", "K": params.K.tolist(), "Lambda": integral.tolist(), "allocation": own.allocation}
    values = {key: value.model_dump() if hasattr(value, "model_dump") else value for key, value in pi.items()}
    found = {"RISE-DI": own, "PI": scenario.vary(controller=values).controller}
    if with_observer and load_airframe(scenario.aircraft.airframe).gusts:  # an observer estimates the wind
        found["observer"] = select_gains(scenario.aircraft.airframe, scenario, samples=10, observer=True).chosen
    return found


def with_fault(scenario: Scenario, kind: str, effector: str, seed: int) -> tuple[Scenario, float]:
    """The scenario with noise and a fault of a seed, and the begin of the fault, s."""
    names = list(scenario.aircraft.channels().inputs)
    begin = float(np.random.default_rng((seed, names.index(effector))).uniform(FROM, TO))
    times = [begin if name == effector else np.inf for name in names]
    aircraft: Mapping[str, Any] = {
        "actuators": scenario.aircraft.actuators.model_dump() | {FAULTS[kind]: times},
        "sensors": scenario.aircraft.sensors.model_dump() | {"seed": seed},
    }
    return scenario.vary(aircraft=aircraft), begin


def fly(scenario: Scenario, begin: float) -> Flight:
    """Fly a scenario with a fault."""
    tape = simulate(scenario)
    _, error = best_error(tape)
    after = (error.stamp_ns - tape.start_ns) / 1e9 >= begin
    units = score_units(error.names, scenario.aircraft.channels().outputs)
    rms = np.sqrt(np.mean(error.values[after] ** 2, axis=0))[:, None]
    limits, u = scenario.controller.effector_limits(), tape["u"].values
    excess = np.maximum(limits.lower - u, u - limits.upper).max()
    at_stop = ((u <= limits.lower) | (u >= limits.upper)).any(axis=1)
    held = at_stop[(tape["u"].stamp_ns - tape.start_ns) / 1e9 >= begin].mean()
    parts = dict(zip(error.names, (rms[:, 0] / units).tolist(), strict=True))
    lost = tuple(name for name, part in parts.items() if part > SCORE_LOST) or (max(parts, key=lambda name: parts[name]),)
    return Flight(float(score(rms, units)[0]) if tape.outcome == COMPLETED else np.inf, lost, float(excess), float(held))


def summarised(flown: Sequence[Flight]) -> dict[str, Any]:
    """The figures of the flights of one fault under one law."""
    scores = np.array([flight.score for flight in flown])
    lost = [flight for flight in flown if flight.score > SCORE_LOST]
    return {
        "flights": len(flown),
        "mean": float(scores.mean()),
        "worst": float(scores.max()),
        "lost": len(lost),
        "output": ", ".join(dict.fromkeys(name for flight in lost for name in flight.lost)),
        "held": float(np.mean([flight.held for flight in flown])),
        "beyond": max(flight.beyond for flight in flown),
    }


def shortened(name: str) -> Scenario:
    """A scenario without its gusts, which come after DURATION or hide the fault, with y at the rate of the controller."""
    scenario = find_scenario(name)
    rate = scenario.controller.rate
    flight = {"duration": min(DURATION, scenario.flight.duration)}
    aircraft = {"rate": rate, "step": 1.0 / rate, "gusts": {}}
    return scenario.vary(flight=flight, aircraft=aircraft, reference_model={"rate": rate})


def main() -> None:
    """Fly all faults and print a table a scenario."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--scenarios", default=",".join(SCENARIOS))
    parser.add_argument("--without-observer", action="store_true")
    parser.add_argument("--faults", default=",".join(FAULTS))
    parser.add_argument("--json", type=Path, help="file for the figures")
    given = parser.parse_args()
    console, rows = wide_console(), []
    for name in given.scenarios.split(","):
        scenario = shortened(name)
        controllers = laws(scenario, with_observer=not given.without_observer)
        title = f"{name}: score after the fault, mean (worst), {given.seeds} seeds"
        table = new_table(title, ("effector", "fault", *controllers), 2)
        faults = [(effector, kind) for effector in scenario.controller.effectors for kind in given.faults.split(",")]
        for effector, kind in [("none", ""), *faults]:
            cells = []
            for law, controller in controllers.items():
                flies = replace(scenario, controller=controller)
                seeds = range(1, given.seeds + 1)
                flown = [fly(*with_fault(flies, kind, effector, seed)) for seed in seeds] if kind else [fly(flies, FROM)]
                found = summarised(flown)
                rows.append({"scenario": scenario.name, "effector": effector, "fault": kind, "law": law, **found})
                lost = f", {found['lost']} lost in {found['output']}" if found["lost"] else ""
                cells.append(f"{found['mean']:.2f} ({found['worst']:.2f}){lost}")
            table.add_row(effector, kind, *cells)
            if given.json is not None:  # after each fault: a run that is stopped leaves what it has flown
                given.json.write_text(json.dumps({"seeds": given.seeds, "rows": rows}, indent=1) + "\n", encoding="utf-8")
        console.print(table)
    console.print(f"largest u beyond its end stop: {max(row['beyond'] for row in rows):.3g}")


if __name__ == "__main__":
    main()
