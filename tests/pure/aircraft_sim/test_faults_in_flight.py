# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test faults of the simulated aircraft that begin in flight.

They are compared with an aircraft that has them in its scenario.
"""

import math
from typing import Any

import numpy as np
import pytest
from tests.conftest import refusing

from aircraft_sim.params import AircraftConfig
from aircraft_sim.simulator import Simulator
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.vectors import FloatArray

SAMPLES, CHANGE = 400, 201  # at 500 Hz; the number of the first sample after the change
BEGIN = (CHANGE - 1) / 500.0
NEVER = math.inf
GUST = {"start": 0.5, "speed": 4.0, "length": 3.0}


def flown(before: AircraftConfig, after: AircraftConfig) -> FloatArray:
    """Rows of y and truth of a flight with another set from BEGIN on; u rolls and pitches."""
    simulator = Simulator(before)
    rows = []
    for number in range(SAMPLES):
        if number == CHANGE:
            simulator.retune(after)
        arrived = simulator.sample(
            number, 0.01 * np.sin(0.1 * number) * np.array([1.0, 0.0, -1.0, 1.0])
        )
        y = arrived[-1].value if arrived else np.full(len(simulator.outputs), np.nan)
        rows.append(np.concatenate([y, simulator.truth()]))
    return np.array(rows)


def varied(scenario: Scenario, **values: Any) -> AircraftConfig:
    return scenario.vary(aircraft=values).aircraft


THRUST = {"osprey_gust": "thrust", "jsbsim_c172p": "throttle"}


@pytest.mark.parametrize("name", THRUST)
@pytest.mark.parametrize(
    "sentences",
    [
        ("elevator stuck {}", "aileron stuck {}"),
        ("elevator lost {}",),
        ("elevator weak {}",),
        ("thrust failed {}",),
        ("thrust weak {}",),
        ("elevator slow {}",),
        ("elevator loose {}",),
        ("elevator hard_over {} upper",),
        (),
    ],
    ids=lambda sentences: " ".join(sentences) or "gust",
)
def test_fault_that_begins_now_is_one_that_was_scheduled(
    name: str, sentences: tuple[str, ...]
) -> None:
    def section(begin: float) -> dict[str, Any]:
        if not sentences:
            return {"gusts": {"vertical": GUST}}
        faults = [text.format(begin).replace("thrust", THRUST[name]) for text in sentences]
        return {"actuators": {"upper": [0.1] * 4, "faults": faults}}

    now = section(0.0)
    scheduled = section(BEGIN)
    scenario = find_scenario(name).vary(
        aircraft={
            "gusts": {},
            "rate": 500.0,
            "step": 0.002,
            "actuators": {"upper": [0.1] * 4} if sentences else {},
        }
    )
    still = scenario.aircraft
    changed = flown(still, varied(scenario, **now))
    whole = flown(varied(scenario, **scheduled), varied(scenario, **scheduled))
    # Bytes do not agree: a lag of 0 s gives -0.0 for a command of 0.
    assert np.array_equal(changed, whole, equal_nan=True)
    assert not np.array_equal(changed, flown(still, still), equal_nan=True)


def test_sensor_errors_begin_and_end_between_two_samples(osprey_gust: Scenario) -> None:
    still = osprey_gust.aircraft
    bias = flown(still, varied(osprey_gust, sensors={"bias": [0.1, 2.0, 0.0, 0.0]})) - flown(
        still, still
    )
    assert not bias[:CHANGE].any()
    assert bias[CHANGE:, :4] == pytest.approx(np.tile([0.1, 2.0, 0.0, 0.0], (SAMPLES - CHANGE, 1)))
    lost = np.isnan(flown(still, varied(osprey_gust, sensors={"dropout": 0.5}))[:, 0])
    assert not lost[:CHANGE].any()
    assert 0.4 < lost[CHANGE:].mean() < 0.6  # 199 draws: 0.1 is 2.8 standard deviations


def test_gust_changes_neither_past_nor_gust_that_acts(osprey_gust: Scenario) -> None:
    scenario = osprey_gust.vary(aircraft={"gusts": {"vertical": GUST | {"start": 0.3}}})
    with refusing(r"gusts\.lateral\.start: found 0\.1 s, expected at least t = 0\.4 s"):
        flown(scenario.aircraft, varied(scenario, gusts={"lateral": GUST | {"start": 0.1}}))
    with refusing(
        r"gusts\.vertical: found a change of a gust that acts, expected one after its end"
    ):
        flown(scenario.aircraft, varied(scenario, gusts={"vertical": GUST}))


def test_drift_that_is_scheduled_in_flight_is_one_of_the_scenario(osprey_gust: Scenario) -> None:
    ice = {"duration": 0.2, "A": 0.3, "B": 0.3}
    never, later = (
        varied(osprey_gust, drift=ice | {"start": start}) for start in (NEVER, BEGIN + 0.1)
    )
    assert flown(never, later).tobytes() == flown(later, later).tobytes()
    with refusing(r"drift\.start: found 0\.1 s, expected at least t = 0\.4 s"):
        flown(never, varied(osprey_gust, drift=ice | {"start": 0.1}))
    with refusing(r"^drift: found a change of a drift that acts, expected one before its start"):
        flown(varied(osprey_gust, drift=ice | {"start": 0.1}), later)


def test_faults_may_change_in_flight_and_nothing_else() -> None:
    names = AircraftConfig.tunable()
    assert {
        "actuators.faults",
        "sensors.noise",
        "gusts.lateral.start",
        "drift.start",
    } <= names
    assert not names & {
        "airframe",
        "rate",
        "step",
        "actuators",
        "actuators.lag",
        "sensors",
        "sensors.delay",
        "gusts",
        "drift.A",
    }
