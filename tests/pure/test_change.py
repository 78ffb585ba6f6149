# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The test for a change of the aircraft, in a flight with damage, and channels that keep the law of the start."""

import math

import numpy as np
import pytest

from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.design.change_test import change_test
from flight_analysis.design.innovation_filters import Actuation, recording
from flight_bringup.scenarios import find_scenario
from rise_di_controller.learning import with_channels_of
from rise_di_controller.rise_di import RiseDiConfig

pytestmark = [pytest.mark.package("flight_analysis"), pytest.mark.slow]


def test_elevator_without_effect_is_dead_and_lateral_motion_unchanged() -> None:
    flown = find_scenario("osprey_servo").vary(
        aircraft={"rate": 100.0, "step": 0.01, "gusts": {}, "turbulence": {"altitude": 100.0, "wind": 7.7}}
        | {"actuators": {"lag": [0.02, 0.1, 0.02, 0.02], "lost_at": [0.0, math.inf, math.inf, math.inf]}},
        reference_model={"rate": 100.0},
        flight={"duration": 8.0},
    )
    airframe = flown.aircraft.sampled_airframe()
    recorded = recording(simulate(flown), airframe)
    lon, lat = change_test(recorded, airframe, Actuation(np.array([0.02, 0.1, 0.02, 0.02]), 0.0), {})
    assert (lon.outputs, lon.found, lon.dead) == (("q", "V"), True, "elevator")
    assert (lat.outputs, lat.found, lat.dead) == (("p", "r"), False, "")


def law_of(controller: RiseDiConfig) -> tuple[np.ndarray, ...]:
    law = controller.law_params()
    effect = law.D * law.input_scale
    return effect * law.K, effect * law.K * law.Lambda, effect * law.beta, effect * law.beta / law.eps


def test_channels_keep_the_law_of_the_start() -> None:
    """Gains from e, its integral and the sign to u are those of each, and u_o and u_ff are 0 in the others."""
    start, designed = (find_scenario(name).rise_di() for name in ("osprey_servo", "osprey_observer"))
    bare = [True, False, False, True]  # q and V, the last channel with them
    mixed = with_channels_of(start, designed, bare, [False] * 4)
    for gain, of_start, of_designed in zip(*map(law_of, (mixed, start, designed)), strict=True):
        assert gain == pytest.approx(np.where(bare, of_start, of_designed))
    RiseDiConfig.validate_mapping(mixed.model_dump(), "controller")  # with its margins
    assert mixed.observer is not None
    assert np.any(np.reshape(mixed.observer.F, (4, -1)), axis=1).tolist() == [False, True, True, False]
    assert mixed.guard().nominal is not None
    nominal = mixed.guard().nominal
    assert nominal is not None
    assert nominal.acts is not None
    assert nominal.acts.tolist() == [0.0, 1.0, 1.0, 0.0]


def test_dead_input_is_held() -> None:
    start = find_scenario("osprey_servo").rise_di()
    mixed = with_channels_of(start, start, [True, False, False, True], [True, False, False, False])
    assert abs(law_of(mixed)[0][0]) < 1e-6 * abs(law_of(start)[0][0])
