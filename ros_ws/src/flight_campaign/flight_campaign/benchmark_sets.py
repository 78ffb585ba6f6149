# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The sets of flights of the public benchmark, a version of which never changes: aircraft, winds,
faults and seeds.

A set is a scenario of the stack with changes. `Sets.digest` covers all that a law flies through,
and no gains.
"""

import hashlib
import json
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from aircraft_sim.airframe import load_airframe
from aircraft_sim.turbulence import MODERATE
from flight_analysis.closed_loop.scenario import Scenario

VERSION = 1
UNCERTAINTY = 0.3  # of each entry of A and B
# Hz of y, y_m and u; s of the integration, as in a comparison of laws
RATE = 100.0
STEP = 0.005
# s: when the inputs lose half of their effect; after which the commands begin again
DAMAGE = 60.0
REPEAT = 60.0
DAMAGED = ("elevator", "aileron")
RELEASE_LENGTH = 40  # hex digits of a commit

FRAME = (
    "rate",
    "outputs",
    "inputs",
    "D",
    "input_scale",
    "lag",
    "delay",
    "max_age",
    "hold",
    "ramp",
    "lower",
    "upper",
)
"""Keys of the section `controller` that every law gets: channels, signs, scales and limits of the
inputs, and the failsafe."""


class FlightSet(NamedTuple):
    """Flights that a score is the mean of."""

    title: str
    scenario: str  # of the stack
    changes: Mapping[str, Mapping[str, Any]] = MappingProxyType({})  # of its sections
    turbulent: bool = False  # moderate turbulence in place of gusts
    fleet: bool = True  # uncertain aircraft; else the aircraft of the scenario alone
    late: float = 0.0  # s, delay of u
    edges: tuple[float, ...] = ()  # s, at which a window of the score ends and the next begins
    damaged: bool = False
    divisor: int = 1  # a part of the aircraft flies: a mission takes three times as long

    def aircraft(self, count: int) -> int:
        """Number of aircraft of the set in a benchmark of `count`."""
        return -(-count // self.divisor) if self.fleet else 1


SETS: dict[str, FlightSet] = {
    "gusts": FlightSet("gusts", "osprey_servo"),
    "turbulence": FlightSet("turbulence", "osprey_servo", turbulent=True),
    "late": FlightSet("gusts, u 20 ms late", "osprey_servo", late=0.02),
    "damage": FlightSet(
        "turbulence, at 60 s elevator and aileron at half effect",
        "osprey_servo",
        {"flight": {"duration": DAMAGE + REPEAT}},
        turbulent=True,
        edges=(10.0, 20.0, 30.0, 60.0, 70.0, 90.0),
        damaged=True,
    ),
    "mission": FlightSet("a route in light turbulence and wind", "osprey_route", divisor=4),
    "jsbsim_c172p": FlightSet("c172p of JSBSim, a gust", "jsbsim_c172p", fleet=False),
    "jsbsim_f16": FlightSet("f16 of JSBSim, a gust", "jsbsim_f16", fleet=False),
}
SCENARIOS = tuple(sorted({flight_set.scenario for flight_set in SETS.values()}))
# windows of the damage with the same commands
BEFORE = "30-60"
AFTER = "90-120"


def seed_of(name: str, release: str, what: str) -> int:
    """A seed: the first 63 bits of the SHA-256 of "rise-di benchmark VERSION RELEASE SET WHAT"."""
    text = f"rise-di benchmark {VERSION} {release} {name} {what}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


class Sets:
    """The sets of a run: the scenarios of the stack by name, and the hash that fresh seeds come
    from, "" for the fixed ones.
    """

    def __init__(self, scenarios: Mapping[str, Scenario], release: str = "") -> None:
        self.release = release
        self._scenarios = scenarios

    def scenario(self, name: str) -> Scenario:
        """The scenario of a set, with the gains of the stack."""
        return _flown(name, self._scenarios[SETS[name].scenario], self.release)

    def airframes(self) -> list[str]:
        """The airframes of all sets."""
        return sorted({scenario.aircraft.airframe for scenario in self._scenarios.values()})

    def digest(self) -> str:
        """SHA-256 of the sets of this version: sections, frames, airframes, the fixed seeds and the
        rules of a score.
        """
        content = {}
        for name, flight_set in SETS.items():
            scenario = _flown(name, self._scenarios[flight_set.scenario], "")
            sections = {
                key: getattr(scenario, key)
                for key in ("flight", "aircraft", "reference_model", "guidance")
            }
            described = {
                key: section and section.model_dump(mode="json", exclude_defaults=True)
                for key, section in sections.items()
            }
            _as_published(described["aircraft"]["actuators"], scenario)
            content[name] = {
                **described,
                "controller": frame(scenario),
                "airframe": _airframe(scenario) if flight_set.fleet else None,
                "rules": [
                    UNCERTAINTY,
                    flight_set.late,
                    flight_set.edges,
                    flight_set.divisor,
                    seed_of(name, "", "aircraft"),
                ],
            }
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _flown(name: str, scenario: Scenario, release: str) -> Scenario:
    flight_set = SETS[name]
    aircraft: dict[str, Any] = {
        "sensors": scenario.aircraft.sensors.model_dump()
        | {"seed": seed_of(name, release, "noise")}
    }
    if scenario.aircraft.turbulence is not None:
        air = scenario.aircraft.turbulence.model_dump() | {
            "seed": seed_of(name, release, "turbulence")
        }
        aircraft["turbulence"] = air
    if flight_set.turbulent:
        aircraft |= {
            "gusts": {},
            "turbulence": MODERATE | {"seed": seed_of(name, release, "turbulence")},
        }
    if flight_set.damaged:
        actuators = scenario.aircraft.actuators.model_dump()
        hit = [key for key in scenario.aircraft.channels().inputs if key in DAMAGED]
        aircraft["actuators"] = actuators | {"faults": [f"{key} weak {DAMAGE:g}" for key in hit]}
        scenario = scenario.vary(reference_model={"pulses": _repeated(scenario)})
    if flight_set.fleet:
        aircraft |= {"rate": RATE, "step": STEP}
        scenario = scenario.vary(
            aircraft=aircraft, reference_model={"rate": RATE}, controller={"delay": 0.0}
        )
    else:
        scenario = scenario.vary(aircraft=aircraft)
    return scenario.vary(**flight_set.changes) if flight_set.changes else scenario


def _repeated(scenario: Scenario) -> dict[str, Any]:
    """The commands of a scenario, and again REPEAT later."""
    pulses = scenario.reference_model.model_dump()["pulses"]
    for pulse in pulses.values():
        for key, later in (("start", REPEAT), ("stop", REPEAT), ("value", 0.0)):
            pulse[key] = [*pulse[key], *(number + later for number in pulse[key])]
    return dict(pulses)


def frame(scenario: Scenario) -> dict[str, Any]:
    """The parameters of the controller that every law gets."""
    values = scenario.controller.model_dump()
    return {key: values[key] for key in FRAME}


def _as_published(actuators: dict[str, Any], scenario: Scenario) -> None:
    """Replace the faults of a described section by the lists of the version that was published."""
    if actuators.pop("faults", None):
        begins = scenario.aircraft.actuator_model().weak_at
        actuators["weak_at"] = np.asarray(begins).tolist()


def _airframe(scenario: Scenario) -> dict[str, Any]:
    """The airframe as the sets fly it: no thrust is lost and no gust turns the aircraft, so what an
    airframe states of both is left out.
    """
    airframe = load_airframe(scenario.aircraft.airframe).model_dump(
        mode="json", exclude_defaults=True
    )
    for described in airframe["inputs"].values():
        described.pop("no_thrust", None)
    airframe.pop("span", None)
    return airframe
