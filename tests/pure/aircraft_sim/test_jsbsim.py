# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test aircraft of JSBSim as flight dynamics models.

The tests cover trim, signs, wind, repeatability, isolation in a process, and every failure.
"""

import ctypes
import math
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest import approx
from tests.builders import aircraft_parameters, truth_of
from tests.conftest import REPOSITORY, refusing

from aircraft_sim.atmosphere.disturbance import AXES, Gusts
from aircraft_sim.jsbsim import jsbsim_aircraft, jsbsim_trim
from aircraft_sim.jsbsim.jsbsim_aircraft import (
    INPUTS,
    Command,
    FlightCondition,
    WindModel,
    aircraft_names,
)
from aircraft_sim.jsbsim.jsbsim_commands import engine_count
from aircraft_sim.jsbsim.jsbsim_model import JsbsimModel
from aircraft_sim.params import AircraftConfig
from aircraft_sim.plant.actuators import Actuators
from aircraft_sim.simulator import Simulator
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core import isolated
from flight_core.outcome import FlightEnded
from flight_core.vectors import FloatArray

pytestmark = pytest.mark.slow

STEP_NS = 5_000_000
CESSNA = FlightCondition("c172p", 46.3, 1219.2, STEP_NS)
C182 = FlightCondition("c182", 56.6, 1219.2, STEP_NS)
ZEROS = np.zeros(len(AXES))
NO_WIND = WindModel(Gusts(ZEROS, ZEROS, ZEROS + 1.0), None)
SECTION: dict[str, Any] = {
    "airframe": "jsbsim:c172p",
    "speed": 46.3,
    "altitude": 1219.2,
    "rate": 200.0,
    "step": 0.005,
}


def cessna(wind_model: WindModel = NO_WIND, condition: FlightCondition = CESSNA) -> JsbsimModel:
    return JsbsimModel(condition, Actuators(), wind_model)


def fly(model: JsbsimModel, u: FloatArray, duration: float) -> dict[str, FloatArray]:
    """Return truth by channel, one row for each step, with a held u."""
    rows = [model.truth(0)]
    for k in range(round(duration * 1e9) // STEP_NS):
        model.advance(k * STEP_NS, u, STEP_NS)
        rows.append(model.truth((k + 1) * STEP_NS))
    return dict(zip(model.truth_names, np.array(rows).T, strict=True))


def command(**values: float) -> FloatArray:
    return np.array([values.get(name, 0.0) for name in INPUTS])


def one_gust(axis: str, speed: float, length: float) -> WindModel:
    return WindModel(
        Gusts(ZEROS, np.array([speed * (name == axis) for name in AXES]), ZEROS + length), None
    )


@pytest.mark.parametrize(
    "condition",
    # c172p: JSBSim's own trim. c182: JSBSim's trim fails, because the engine does not run in it.
    # DHC6: JSBSim's trim does not last, because the turboprops have not settled.
    [CESSNA, C182, FlightCondition("DHC6", 66.9, 1828.8, STEP_NS)],
    ids=lambda condition: condition.name,
)
def test_trim_is_an_equilibrium_that_lasts(condition: FlightCondition) -> None:
    # JSBSim's own trim stops at 3e-4 m/s^2 and 1e-4 rad/s^2. Over 5 s without control, residuals of
    # that size give at most 1e-3 m/s, 5e-4 rad/s, and 4 mm to a few cm of altitude. DHC6 in
    # JSBSim's own trim loses 1 m/s.
    model = cessna(condition=condition)
    assert np.max(np.abs(model.trim.residuals[:3])) < 3e-3
    assert np.max(np.abs(model.trim.residuals[3:])) < 3e-4
    truth = fly(model, command(), 5.0)
    assert np.max(np.abs(truth["x.V"])) < 0.01
    assert max(np.max(np.abs(truth[f"x.{name}"])) for name in ("p", "q", "r")) < 5e-4
    assert np.max(np.abs(truth["x.altitude"])) < 0.1


@pytest.mark.parametrize(
    "name, output, sign, duration",
    [
        ("elevator", "q", -1.0, 0.2),  # nose down
        ("throttle", "V", 1.0, 1.0),  # more thrust
        ("aileron", "p", 1.0, 0.2),  # roll right
        ("rudder", "r", -1.0, 0.2),  # nose left
    ],
)
def test_positive_command_has_sign_of_table(
    name: str, output: str, sign: float, duration: float
) -> None:
    truth = fly(cessna(), command(**{name: 0.1}), duration)
    # A tenth of the travel for this long moves its own output by 0.016 (rudder) to 0.08 rad/s, or
    # 0.07 m/s.
    assert sign * truth[f"x.{output}"][-1] > 0.01
    rates = {channel: abs(truth[f"x.{channel}"][-1]) for channel in ("q", "p", "r")}
    assert output == "V" or max(rates, key=lambda channel: rates[channel]) == output


@pytest.mark.parametrize(
    "axis, state, scale",
    # A wind w along x, y, z of the flight path adds -w to airspeed, -w/V0 to sideslip, -w/V0 to
    # alpha.
    [
        ("longitudinal", "V", -1.0),
        ("lateral", "beta", -1.0 / 46.3),
        ("vertical", "alpha", -1.0 / 46.3),
    ],
)
def test_wind_acts_along_the_axes_of_trim(axis: str, state: str, scale: float) -> None:
    # The gust lasts 0.1 s: at its peak the aircraft itself has hardly moved (alpha responds at
    # about 4 1/s: a fifth).
    truth = fly(cessna(one_gust(axis, 2.0, 46.3 * 0.05)), command(), 0.05)
    peak = truth[f"gust.{axis}"][-1]
    assert peak == approx(2.0, rel=0.01)
    assert truth[f"x.{state}"][-1] == approx(scale * peak, rel=0.2)
    assert not any(truth[f"gust.{name}"].any() for name in AXES if name != axis)


def test_turbulence_acts_from_the_first_sample_on() -> None:
    turbulence = {"altitude": 1219.2, "sigma": 3.05, "seed": 1}
    simulator = Simulator(aircraft_parameters(**SECTION, turbulence=turbulence))
    simulator.sample(0, command())
    truth = truth_of(simulator)
    assert abs(truth["gust.longitudinal"]) > 0.1
    # Airspeed is the norm of ground velocity less wind; the ground velocity is 46.3 m/s along the
    # first axis.
    wind = np.array([truth[f"gust.{axis}"] for axis in AXES])
    assert 46.3 + truth["x.V"] == approx(float(np.linalg.norm([46.3, 0.0, 0.0] - wind)), rel=1e-3)


def test_actuators_act_before_the_aircraft() -> None:
    # An aileron stuck from the start has no effect. A lag of 0.1 s passes 63 % after 0.1 s.
    stuck = JsbsimModel(
        CESSNA, Actuators(stuck_at=np.array([np.inf, np.inf, 0.0, np.inf])), NO_WIND
    )
    assert np.max(np.abs(fly(stuck, command(aileron=0.1), 0.5)["x.p"])) < 1e-4
    slow = JsbsimModel(CESSNA, Actuators(lag=np.full(4, 0.1)), NO_WIND)
    assert fly(slow, command(aileron=0.1), 0.1)["actuator.aileron"][-1] == approx(
        0.1 * (1.0 - math.exp(-1.0))
    )


def with_lost_throttle(lost_at: float) -> AircraftConfig:
    return aircraft_parameters(**SECTION, actuators={"faults": [f"throttle failed {lost_at}"]})


def thrusts(model: JsbsimModel) -> list[float]:
    return [
        model._fdm[jsbsim_trim.thrust_property(engine)]
        for engine in range(engine_count(model._fdm))
    ]


@pytest.mark.parametrize(
    "condition",
    [CESSNA, FlightCondition("737", 150.0, 5000.0, STEP_NS)],
    ids=["a piston with a propeller", "two turbines"],
)
def test_lost_engines_give_no_thrust(condition: FlightCondition) -> None:
    """The thrust is computed by JSBSim.

    At throttle 0, an engine of the 737 idles with 1.1 kN. A propeller that the wind turns brakes.
    The flight goes on, although an engine that stops for another reason would end it.
    """
    model = cessna(condition=condition)
    model.retune(0, with_lost_throttle(0.5))
    assert fly(model, command(throttle=0.1), 0.5)["actuator.throttle"][-1] == 0.1
    assert min(thrusts(model)) > 0.0
    for k in range(100, 500):
        model.advance(k * STEP_NS, command(throttle=0.1), STEP_NS)
    lost = dict(zip(model.truth_names, model.truth(0), strict=True))
    assert lost["actuator.throttle"] == -model.trim.commands[list(INPUTS).index("throttle")]
    assert max(thrusts(model)) <= 0.0


def test_flight_in_another_process_agrees_to_last_bit() -> None:
    # c182 needs the solver's trim. A third process finds it, and both apply its result.
    code = (
        "from tests.pure.aircraft_sim.test_jsbsim import *\n"
        "truth = fly(cessna(condition=C182), command(aileron=0.1), 1.0)\n"
        "print(np.array(list(truth.values())).tobytes().hex())\n"
    )
    process = subprocess.run(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=True, cwd=REPOSITORY
    ).stdout
    truth = fly(cessna(condition=C182), command(aileron=0.1), 1.0)
    assert process.strip() == np.array(list(truth.values())).tobytes().hex()


def test_nothing_is_printed_and_nothing_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    # This model asks for a table as output.
    model = cessna(condition=FlightCondition("global5000", 169.8, 7620.0, STEP_NS))
    fly(model, command(), 0.1)
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr() == ("", "")


def test_hang_in_isolated_process_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isolated, "WAIT", 2.0)
    with pytest.raises(isolated.IsolatedCallError, match=r"^timed out after 2 s$"):
        isolated.call(time.sleep, 3600, timeout=1.0)


def test_computation_without_end_in_isolated_process_times_out_by_processor_time() -> None:
    before = os.times()
    with pytest.raises(
        isolated.IsolatedCallError, match=r"^timed out after 1 s of processor time$"
    ):
        isolated.call(re.match, "(a+)+$", "a" * 100 + "b", timeout=1.0)  # tries 2**100 ways
    after = os.times()
    used = (
        after.children_user + after.children_system - before.children_user - before.children_system
    )
    # Linux counts whole ticks for the limit: beside load of real-time priority 1 s where the
    # process ran for 0.6 s. The rest is what starts and ends a process.
    assert 0.5 < used < 2.5


def test_isolated_process_keeps_limit_of_processor_time_that_user_has() -> None:
    code = (
        "import resource; resource.setrlimit(resource.RLIMIT_CPU, (60, 60))\n"
        "from flight_core import isolated\n"
        "print(*(isolated.call(resource.getrlimit, resource.RLIMIT_CPU, timeout=one) for one in "
        "(30.0, 90.0)))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, check=True
    )
    # Raising the second number needs a privilege, setrlimit(2).
    assert done.stdout == "(30, 60) (60, 60)\n"


def test_crash_exception_and_exit_of_isolated_process_are_errors_here() -> None:
    with pytest.raises(isolated.IsolatedCallError, match="was killed by SIGSEGV"):
        isolated.call(ctypes.string_at, 0, timeout=120.0)
    with pytest.raises(isolated.IsolatedCallError, match=r"exited with status 1 \(ValueError: "):
        isolated.call(math.sqrt, -1.0, timeout=120.0)
    with pytest.raises(isolated.IsolatedCallError, match=r"exited with status 5"):
        isolated.call(os._exit, 5, timeout=120.0)
    assert isolated.call(math.hypot, 3.0, 4.0, timeout=120.0) == 5.0


def test_crash_of_jsbsim_ends_flight_in_one_process_with_sentence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real = isolated.call
    monkeypatch.setattr(
        isolated, "call", lambda *_, timeout, **_limits: real(ctypes.string_at, 0, timeout=timeout)
    )
    # No other test has cached the trim of this condition.
    scenario = find_scenario("jsbsim_c172p").vary(aircraft={"speed": 47.11})
    sentence = str(simulate(scenario).outcome)
    assert sentence == "jsbsim:c172p cannot be flown: JSBSim was killed by SIGSEGV"


@pytest.mark.parametrize(
    "condition, sentence",
    [
        (
            ("c172p", 20.0, 1219.2),
            "does not trim at 20 m/s and 1219.2 m: accelerations of .* are left at best",
        ),
        (
            ("dr1", 41.0, 900.0),
            (
                ".*: its model needs the property /sim/model/pushback/position-norm, which JSBSim "
                "alone "
            ),
        ),
        (("blank", 41.0, 900.0), "cannot be loaded: "),
    ],
    ids=["stalled", "property", "empty"],
)
def test_condition_without_trim_refused_in_one_sentence(
    condition: tuple[str, float, float], sentence: str
) -> None:
    with pytest.raises(FlightEnded, match=f"^jsbsim:{condition[0]} {sentence}") as error:
        # Larger steps: the search for a trim takes long.
        cessna(condition=FlightCondition(*condition, 4 * STEP_NS))
    assert "\n" not in str(error.value)


def test_property_that_does_not_exist_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    cessna()  # caches the trim found with the real table
    wrong = dict(INPUTS) | {
        "rudder": Command(
            property="fcs/ruder-cmd-norm",
            trim_property=None,
            lower=-1.0,
            upper=1.0,
            is_per_engine=False,
            positive="nose left",
        )
    }
    monkeypatch.setattr(jsbsim_aircraft, "INPUTS", wrong)
    with pytest.raises(
        FlightEnded, match=r"^jsbsim:c172p cannot be flown: it has no property fcs/ruder-cmd-norm$"
    ):
        cessna()


def test_the_ground_ends_a_flight() -> None:
    with pytest.raises(FlightEnded, match=r"^jsbsim:c172p hit the ground at t = \d"):
        fly(cessna(condition=CESSNA._replace(altitude=15.0)), command(elevator=0.3), 10.0)


@pytest.mark.parametrize(
    "changes, sentence",
    [
        ({"airframe": "jsbsim:../c172p"}, r"airframe: found 'jsbsim:../c172p', where no file is"),
        ({"speed": None}, r"speed: found none, expected the true airspeed to trim at, m/s"),
        (
            {"uncertainty": {"A": 0.1}},
            r"uncertainty: found a value, expected none: jsbsim:c172p has no matrices",
        ),
        (
            {"airframe": "osprey"},
            r"speed: found 46.3, expected none: the airframe osprey has a fixed trim",
        ),
    ],
)
def test_parameters_that_do_not_fit_are_refused(changes: dict[str, Any], sentence: str) -> None:
    with refusing(f"^aircraft.{sentence}"):
        aircraft_parameters(**SECTION | changes)


def test_without_jsbsim_aircraft_refused_in_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    aircraft_names.cache_clear()
    monkeypatch.setitem(sys.modules, "jsbsim", None)  # its import then fails
    with refusing(r"^aircraft\.airframe: the Python package jsbsim is not installed"):
        aircraft_parameters(**SECTION)
