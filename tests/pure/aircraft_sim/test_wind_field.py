# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Wind shear and microburst: closed forms, and what a wind that changes along the flight does."""

import math
from typing import Any

import numpy as np
import pytest
from pytest import approx

from aircraft_sim.atmosphere.wind_field import Log, Microburst, Power, Table, WindField
from aircraft_sim.params import AircraftConfig
from aircraft_sim.simulator import Simulator
from flight_core.channels import POSE
from flight_core.parameters import ParameterError
from flight_core.vectors import FloatArray

OSPREY = {"airframe": "osprey", "rate": 100.0, "step": 0.01, "kinematics": "euler"}
CESSNA = {"airframe": "jsbsim:c172p", "speed": 50.0, "altitude": 500.0}
LOG = {"law": "log", "ground": -50.0, "reference": 10.0, "roughness": 0.1}
BURST = Microburst(north=100.0, east=-50.0, radius=600.0, speed=12.0, height=40.0)


def config(**values: Any) -> AircraftConfig:
    return AircraftConfig.validate_mapping(OSPREY | values, "aircraft")


@pytest.mark.parametrize(
    "height, factor", [(10.0, 1.0), (1.0, 0.5), (100.0, 1.5), (0.1, 0.0), (-3.0, 0.0)]
)
def test_log_law_over_three_decades(height: float, factor: float) -> None:
    """ln(h / 0.1) / ln(10 / 0.1): a decade is half of the wind at 10 m."""
    assert Log(10.0, 0.1).factor(height) == approx(factor, abs=1e-15)


def test_power_law_and_table() -> None:
    assert Power(10.0, 1.0 / 7.0).factor(1280.0) == approx(2.0)  # 128 = 2^7
    assert Power(10.0, 0.5).factor(-1.0) == 0.0
    table = Table((0.0, 100.0), (0.0, -8.0), (2.0, 4.0))
    at = WindField((0.0, 0.0), 300.0, table).at
    assert at(9.0, 9.0, 325.0) == (-2.0, 2.5, 0.0)
    assert at(9.0, 9.0, 1000.0) == (-8.0, 4.0, 0.0)


def test_air_of_a_microburst_keeps_its_volume() -> None:
    """The divergence of the wind by central differences is 0."""
    step = 0.01
    for place in ([400.0, 100.0, 30.0], [100.0, -50.0, 200.0], [-900.0, 300.0, 80.0]):
        divergence = 0.0
        # The last component counts down.
        for k, sign in enumerate((1.0, 1.0, -1.0)):
            ahead, behind = (np.array(place) + side * step * np.eye(3)[k] for side in (1.0, -1.0))
            change = BURST.wind(*ahead)[k] - BURST.wind(*behind)[k]
            divergence += sign * change / (2.0 * step)
        assert abs(divergence) < 1e-8  # of 0.08 1/s; rounding of the differences is 1e-9


def test_largest_outflow_of_a_microburst_is_at_its_height() -> None:
    """12 m/s at 40 m, at 1.12 radii of the centre; on the ground nothing, above the centre down."""
    places = [(r, z) for r in np.linspace(0.0, 2000.0, 401) for z in np.linspace(0.0, 300.0, 151)]
    outflow = [BURST.wind(100.0 + r, -50.0, z)[0] for r, z in places]
    r, z = places[int(np.argmax(outflow))]
    assert max(outflow) == approx(12.0, rel=1e-4)
    assert (r, z) == (approx(1.1209 * 600.0, abs=5.0), approx(40.0, abs=2.0))
    assert BURST.wind(700.0, 0.0, 0.0) == approx([0.0, 0.0, 0.0], abs=1e-12)
    assert BURST.wind(100.0, -50.0, 200.0)[2] > 0.0


def flown(aircraft: AircraftConfig, samples: int, u: FloatArray) -> FloatArray:
    """Rows of y, pose and truth.gust."""
    simulator = Simulator(aircraft)
    rows = []
    for number in range(samples):
        simulator.sample(number, u)
        truth = dict(zip(simulator.truth_names, simulator.truth(), strict=True))
        gusts = [value for name, value in truth.items() if name.startswith("gust.")]
        rows.append([*simulator._model.y(), *simulator.pose(), *gusts])
    return np.array(rows)


@pytest.mark.parametrize("base", [OSPREY, OSPREY | CESSNA | {"kinematics": "linear"}])
def test_level_flight_in_a_shear_is_that_in_the_wind_of_its_height(base: dict[str, Any]) -> None:
    """Trim holds the altitude for a second within centimetres.

    At 50 m above the ground the wind is that of the log law, ln(500) / ln(100) of 4 m/s.
    """
    above = (base.get("altitude") or 0.0) - 50.0
    shear = LOG | {"ground": above}
    wind = 4.0 * math.log(500.0) / math.log(100.0)
    u = np.zeros(4)
    sheared = flown(config(**base, shear=shear, wind=[0.0, 4.0]), 100, u)
    steady = flown(config(**base, wind=[0.0, wind]), 100, u)
    assert sheared == approx(steady, abs=0.02)
    assert steady[-1, 4 + POSE.index("v_east")] == approx(wind, abs=0.1)


def test_aircraft_that_climbs_into_a_head_wind_gains_airspeed_and_keeps_its_ground_speed() -> None:
    """Through a layer of a metre the head wind rises by 5 m/s.

    Over a short time the velocity over ground stays: the airspeed gains the wind. The weight and
    the drag take a part meanwhile, which the same flight without wind shows.
    """
    layer = {"law": "table", "ground": 0.0, "height": [0.2, 1.2], "east": [0.0, 0.0]}
    u = np.array([0.2, 0.0, 0.0, 0.0])  # nose up
    often: dict[str, Any] = {"rate": 1000.0, "step": 0.001}
    calm = flown(config(**often), 1200, u)
    into = flown(config(**often, shear=layer | {"north": [0.0, -5.0]}), 1200, u)
    altitude = 4 + POSE.index("altitude")
    assert calm[:, altitude].max() > 0.5
    inside = np.flatnonzero(into[:, altitude] > 0.21)
    first = inside[0]
    last = inside[0] + 80  # ms
    gained = (into[last, 1] - into[first, 1]) - (calm[last, 1] - calm[first, 1])
    head = 5.0 * (into[last, altitude] - into[first, altitude])
    assert head > 0.5
    assert gained == approx(head, rel=0.1)
    north = 4 + POSE.index("v_north")
    assert into[last, north] == approx(calm[last, north], abs=0.1 * head)


def test_start_heading_turns_the_flight_and_not_the_wind() -> None:
    """Towards the centre of a microburst from the south and from the west, 1000 m away.

    By symmetry the same outflow is against the flight.
    """
    burst = {"ground": -40.0, "north": 0.0, "east": 0.0, "radius": 600.0, "speed": 12.0}
    winds = []
    for north, east, heading in ((0.0, -1000.0, math.pi / 2.0), (-1000.0, 0.0, 0.0)):
        start = {"north": north, "east": east, "heading": heading}
        rows = flown(config(microburst=burst | {"height": 40.0}, start=start), 300, np.zeros(4))
        winds.append(rows[:, -3:])
    assert abs(winds[0][-1]).max() > 0.1
    assert winds[0] == approx(winds[1], abs=1e-9)


@pytest.mark.parametrize(
    "section, sentence",
    [
        ({"shear": LOG | {"roughness": 20.0}}, "shear.reference: found 10 m, expected more than"),
        ({"shear": LOG | {"exponent": 0.2}}, "shear.exponent: found a value, expected none beside"),
        ({"shear": {"law": "power", "ground": 0.0}}, "shear.exponent: found none, expected a val"),
        (
            {"shear": LOG, "microburst": {"ground": 0.0} | dict(BURST._asdict())},
            "microburst.ground: found 0 m, expected -50 m, as in shear",
        ),
        (
            {
                "shear": {
                    "law": "table",
                    "ground": 0.0,
                    "height": [0.0, 9.0],
                    "north": [0.0, 0.0],
                    "east": [1.0, 2.0],
                },
                "wind": [1.0, 0.0],
            },
            "wind: found [1.0, 0.0], expected 0 beside shear.law table",
        ),
    ],
)
def test_wind_field_that_cannot_be_is_refused(section: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError) as error:
        config(**section)
    assert str(error.value).startswith(f"aircraft.{sentence}")
