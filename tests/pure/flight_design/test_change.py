# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test how a loss of effect is found in a flight with damage.

The channels of a damaged part keep the initial law.
"""

from functools import cache

import numpy as np
import pytest

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.jsbsim.jsbsim_aircraft import FlightCondition
from aircraft_sim.jsbsim.jsbsim_linearization import linearize
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.rates import nanoseconds
from flight_design.identification.innovation_filters import Actuation, FlightData, recording
from flight_design.identification.sketch import ROUGH
from flight_design.learning.change_test import LOSS, change_test
from flight_design.learning.part_checks import change_sentence
from rise_di_controller.learning.learned_channels import with_channels_of
from rise_di_controller.rise_di_config import RiseDiConfig

pytestmark = pytest.mark.slow


ACTUATION = Actuation(np.array([0.02, 0.1, 0.02, 0.02]), 0.0)
FAULTS = ["elevator lost 0", "aileron weak 0"]


@pytest.fixture(scope="module")
def damaged() -> tuple[FlightData, Airframe]:
    """Return a flight without elevator and with half of the aileron, and the undamaged aircraft.

    The flight lasts 8 s in light turbulence, with a bank.
    """
    scenario = find_scenario("osprey_servo").vary(
        aircraft={
            "rate": 100.0,
            "step": 0.01,
            "gusts": {},
            "turbulence": {"altitude": 100.0, "wind": 7.7},
        }
        | {"actuators": {"lag": ACTUATION.lag.tolist(), "faults": FAULTS}},
        reference_model={
            "rate": 100.0,
            "pulses": {"p": {"start": [3.0, 5.0], "stop": [4.0, 6.0], "value": [0.2, -0.2]}},
        },
        flight={"duration": 8.0},
    )
    airframe = scenario.aircraft.sampled_airframe()
    return recording(simulate(scenario), airframe), airframe


def test_lost_elevator_is_dead_and_weak_aileron_changed(
    damaged: tuple[FlightData, Airframe],
) -> None:
    lon, lat = change_test(*damaged, ACTUATION)
    assert (lon.outputs, lon.is_found, lon.dead) == (("q", "V"), True, "elevator")
    assert (lat.outputs, lat.is_found, lat.dead) == (("p", "r"), True, "")
    # the fault's own factor, and that of no fault, within half of the least loss that is a change
    assert lat.left["aileron"] == pytest.approx(0.5, abs=LOSS / 2.0)
    assert lat.left["rudder"] == pytest.approx(1.0, abs=LOSS / 2.0)
    assert change_sentence(lat).startswith("p and r changed, log-likelihood ")
    assert change_sentence(lat).endswith(
        f": aileron has {100 * lat.left['aileron']:.0f} % of its effect"
    )


@pytest.mark.parametrize("model, found", [(0.6, False), (0.72, True)])
def test_loss_within_what_a_model_may_err_is_no_change(
    damaged: tuple[FlightData, Airframe], model: float, *, found: bool
) -> None:
    """Half of the effect is left, and the model has most of the loss.

    Compared with the model, 17 and 31 % are missing.
    """
    recorded, airframe = damaged
    B = airframe.matrix_b() * np.array([1.0, 1.0, model, 1.0])
    flown = airframe.with_matrices(airframe.matrix_a(), B, np.ones((len(B), len(airframe.gusts))))
    _, lat = change_test(recorded, flown, ACTUATION)
    assert lat.is_found is found


@cache
def cessna() -> Airframe:
    """Return JSBSim's own linearisation of the c172p."""
    return linearize(FlightCondition("c172p", 46.3, 1219.2, nanoseconds(0.005))).airframe


@pytest.mark.parametrize("fault, dead", [("", ""), ("rudder stuck 4", "rudder")])
def test_surface_of_jsbsim_is_dead_beside_the_disturbances_of_its_learner(
    fault: str, dead: str
) -> None:
    """The model is JSBSim's own linearisation, and the turbulence is moderate.

    The disturbances that stand for the errors of a sketch must not hide a lost surface.
    """
    linear = cessna()
    scenario = find_scenario("jsbsim_c172p").vary(
        aircraft={
            "rate": 100.0,
            "sensors": {"noise": [0.002, 0.1, 0.002, 0.002]},
            "turbulence": {"altitude": 100.0, "wind": 7.7},
            "actuators": {"faults": [fault] if fault else []},
        },
        reference_model={
            "rate": 100.0,
            "pulses": {"p": {"start": [3.0, 5.0], "stop": [4.0, 6.0], "value": [0.2, -0.2]}},
        },
        flight={"duration": 8.0},
    )
    controller = scenario.rise_di()
    lag = dict(zip(controller.inputs, controller.lag, strict=True))
    actuation = Actuation(np.array([lag[name] for name in linear.inputs]), 0.0)
    recorded = recording(simulate(scenario), linear)
    (change,) = change_test(recorded, linear, actuation, drift=ROUGH.drift)
    assert (change.is_found, change.dead) == (bool(dead), dead)


@pytest.mark.parametrize(
    "fault, dead", [("aileron hard_over 1 upper", "aileron"), ("aileron weak 1 -0.5", "")]
)
def test_surface_jammed_off_centre_is_dead_and_a_reversed_one_is_not(fault: str, dead: str) -> None:
    """A surface jammed at 5 deg is dead, although u goes to its stop of 30 deg.

    A reversed effect with the ratio of these angles looks alike, and is not dead.
    """
    jam, stop = np.radians(5.0), np.radians(30.0)
    stops = {"lower": [-stop] * 4, "upper": [stop, stop, jam if dead else stop, stop]}
    scenario = find_scenario("osprey_servo").vary(
        aircraft={
            "rate": 100.0,
            "step": 0.01,
            "gusts": {},
            "turbulence": {"altitude": 100.0, "wind": 7.7},
            "actuators": {"lag": ACTUATION.lag.tolist(), "faults": [fault], **stops},
        },
        reference_model={"rate": 100.0},
        flight={"duration": 5.0},
    )
    airframe = scenario.aircraft.sampled_airframe()
    recorded = recording(simulate(scenario), airframe)
    last = recorded._replace(t=recorded.t[-400:], y=recorded.y[-400:], u=recorded.u[-400:])
    _, lat = change_test(last, airframe, ACTUATION)
    assert (lat.is_found, lat.dead) == (True, dead)
    expected = -jam / stop if dead else -0.5
    assert lat.left["aileron"] == pytest.approx(expected, abs=0.05)


def test_reversed_aileron_is_no_dead_one(damaged: tuple[FlightData, Airframe]) -> None:
    """The model has the aileron the wrong way round.

    So the aileron has -100 % of the model's effect, and it moves p.
    """
    recorded, airframe = damaged
    B = airframe.matrix_b() * np.array([1.0, 1.0, -0.5, 1.0])
    flown = airframe.with_matrices(airframe.matrix_a(), B, np.ones((len(B), len(airframe.gusts))))
    _, lat = change_test(recorded, flown, ACTUATION)
    assert (lat.is_found, lat.dead) == (True, "")
    assert lat.left["aileron"] == pytest.approx(-1.0, abs=LOSS / 2.0)


def law_of(controller: RiseDiConfig) -> tuple[np.ndarray, ...]:
    law = controller.law_params()
    effect = law.D * law.input_scale
    return (
        effect * law.K,
        effect * law.K * law.Lambda,
        effect * law.beta,
        effect * law.beta / law.eps,
    )


def test_channels_keep_the_law_of_the_start() -> None:
    """Each channel has the gains from e, its integral and the sign to u of its own law.

    u_o and u_ff are 0 in the channels of the initial law.
    """
    start, designed = (
        find_scenario(name).rise_di() for name in ("osprey_servo", "osprey_observer")
    )
    bare = [True, False, False, True]  # q and V, the last channel with them
    mixed = with_channels_of(start, designed, bare, [False] * 4)
    for gain, of_start, of_designed in zip(*map(law_of, (mixed, start, designed)), strict=True):
        assert gain == pytest.approx(np.where(bare, of_start, of_designed))
    RiseDiConfig.validate_mapping(mixed.model_dump(), "controller")  # with its margins
    assert mixed.observer is not None
    assert np.any(np.reshape(mixed.observer.F, (4, -1)), axis=1).tolist() == [
        False,
        True,
        True,
        False,
    ]
    assert mixed.guard().nominal is not None
    nominal = mixed.guard().nominal
    assert nominal is not None
    assert nominal.acts is not None
    assert nominal.acts.tolist() == [0.0, 1.0, 1.0, 0.0]


def test_dead_input_is_held() -> None:
    start = find_scenario("osprey_servo").rise_di()
    mixed = with_channels_of(start, start, [True, False, False, True], [True, False, False, False])
    assert abs(law_of(mixed)[0][0]) < 1e-6 * abs(law_of(start)[0][0])
