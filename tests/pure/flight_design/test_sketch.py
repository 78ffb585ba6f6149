# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the rough model without an airframe file, and the learner that begins with it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from tests.conftest import refusing

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_design.identification.innovation_filters import (
    Actuation,
    FlightData,
    blocks,
    filter_model,
)
from flight_design.identification.sketch import sketch, sketched
from flight_design.learning.learner import Learner
from flight_design.learning.scenario_learner import learner, that_learns

OUTPUTS = ("q", "V", "p", "r")
INPUTS = ("elevator", "throttle", "aileron", "rudder")
# Omega_ii of docs/evidence/tables/experiments-jsbsim_omega.csv, true airspeed, m/s: light, fighter,
# airliner
STEPS = {
    "c172p": ((-8.47, 3.31, 6.37, -0.901), 46.3),
    "f16": ((-3.42, 11.1, 12.2, -0.627), 154.3),
    "B747": ((-0.315, 2.23, 0.341, -0.155), 180.1),
}


@pytest.mark.parametrize("name", STEPS)
def test_sketch_has_the_modes_of_an_aircraft(name: str) -> None:
    Omega, speed = STEPS[name]
    frame = sketch(name, np.diag(Omega), OUTPUTS, INPUTS, speed)
    modes = np.linalg.eigvals(frame.matrix_a() + frame.matrix_gravity())
    oscillations = sorted(abs(mode) for mode in modes if mode.imag > 0.1 and mode.real < 0.0)
    # short period and Dutch roll, rad/s: MIL-F-8785C has both between 0.4 and 10 in these flight
    # phases
    assert len(oscillations) == 2
    assert 0.4 < oscillations[0] < oscillations[1] < 10.0
    # the spiral may grow slowly: 20 s to double are 0.035 1/s
    assert max(mode.real for mode in modes) < 0.1


def test_parts_of_sketch_do_not_couple() -> None:
    Omega, speed = STEPS["c172p"]
    frame = sketch("c172p", np.diag(Omega) + 0.01, OUTPUTS, INPUTS, speed)
    still = FlightData(0.01, np.linspace(0.0, 0.09, 10), np.zeros((10, 4)), np.zeros((10, 4)))
    parts = blocks(filter_model(frame, Actuation(np.full(4, 0.02), 0.0), still))
    assert sorted([frame.outputs[i] for i in part.outputs] for part in parts) == [
        ["V"],
        ["p", "r"],
        ["q"],
    ]


def test_learner_begins_with_feedforward() -> None:
    scenario = find_scenario("jsbsim_c172p_learn")
    controller = scenario.rise_di()
    make = learner(scenario)
    assert make is not None
    assert isinstance(make(controller), Learner)
    assert controller.observer is not None
    assert controller.observer.part == 0.0
    assert controller.feedforward is not None
    frame = sketched("c172p", controller, 46.3)
    assert_array_equal(frame.matrix_a().ravel(), controller.feedforward.A)
    assert_array_equal(frame.matrix_b().ravel(), controller.feedforward.B)
    # wind is the aircraft relative to the air: a gust to the right is a sideslip from the left
    assert_allclose(frame.gust_direction("lateral")[[5, 6]], -frame.matrix_a()[[5, 6], 4] / 46.3)


def test_sketch_of_other_channels_is_refused() -> None:
    with refusing("expected q, V, p, r"):
        sketch("kite", np.eye(2), ("q", "p"), ("elevator", "aileron"), 20.0)
    with refusing(r"controller\.feedforward: found none"):
        sketched("c172p", find_scenario("jsbsim_c172p").controller, 46.3)


def test_law_alone_learns_from_its_signs_and_sizes() -> None:
    """The rough model is Omega = diag(D omega / input_scale) of the law.

    No entry of the airframe file is read.
    """
    scenario = find_scenario("osprey_servo")
    learning = that_learns(scenario)
    law = scenario.rise_di()
    rough = sketched("osprey", learning.rise_di(), scenario.aircraft.channels().speed)
    rows = [rough.index(name) for name in law.outputs]
    columns = [list(rough.inputs).index(name) for name in law.inputs]
    Omega = rough.matrix_b()[rows][:, columns]
    assert_allclose(Omega, np.diag(np.array(law.D) * law.omega / law.input_scale))
    observer = learning.rise_di().observer
    assert observer is not None
    assert observer.part == 0.0  # the law alone flies until a model is learned
