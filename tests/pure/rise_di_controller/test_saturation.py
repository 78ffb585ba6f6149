# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test flights in saturation: the effect of anti-windup and of a rate limit.

Without saturation they have no effect.

The servos are those of scenario osprey_servo, without noise, and one actuator has tighter stops. In
a "guarded" flight the controller has the stops as its limits. In an "unguarded" one only the
actuators have them, and the integrals wind up. Everything is sampled at 100 Hz and integrated in
steps of 5 ms. The results are within 2 % of those at 500 Hz and 2 ms, in a fifth of the time.
"""

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
from tests.closed_loop import CALM_SERVO, error

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.tape import Tape
from flight_core.vectors import FloatArray

pytestmark = pytest.mark.slow

DEG = math.pi / 180.0
GUSTS = find_scenario("osprey_servo").aircraft.model_dump()["gusts"]
SERVO = CALM_SERVO.vary(reference_model={"pulses": {}})
INPUTS = list(SERVO.aircraft.load()[0].inputs)  # the order of the actuators; the law has its own
UNGUARDED: dict[str, Any] = {"lower": None, "upper": None, "slew": None}


def with_stops(name: str, stop: float, *, guarded: bool) -> Scenario:
    """Return the scenario with the stops of one actuator at -stop and stop.

    `guarded` says whether the controller has these limits, too.
    """
    actuators = SERVO.aircraft.actuators.model_dump()
    # all stops are symmetric
    lower = dict(zip(INPUTS, actuators["lower"], strict=True)) | {name: -stop}
    limits = np.array([lower[key] for key in SERVO.controller.inputs])
    stops = {"lower": [*lower.values()], "upper": [-value for value in lower.values()]}
    return SERVO.vary(
        aircraft={"actuators": actuators | stops},
        controller={"lower": limits.tolist(), "upper": (-limits).tolist()}
        if guarded
        else UNGUARDED,
    )


def pulse(start: float, stop: float, value: float) -> dict[str, list[float]]:
    return {"start": [start], "stop": [stop], "value": [value]}


def state(tape: Tape, name: str) -> FloatArray:
    return tape["truth"].group("x")[name]


def last_beyond(t: FloatArray, values: FloatArray, bound: float) -> float:
    """Return the last instant at which abs(values) is above a bound."""
    return float(t[np.abs(values) > bound].max())


@cache
def pulse_flight(
    name: str, stop: float, duration: float, channel: str, *edges: float, guarded: bool
) -> Tape:
    """Return a flight with tighter stops of one actuator and one pulse on a channel."""
    pulses = {channel: pulse(*edges)}
    scenario = with_stops(name, stop, guarded=guarded)
    return simulate(
        scenario.vary(flight={"duration": duration}, reference_model={"pulses": pulses})
    )


# Aileron +-3 deg: p 0.6 rad/s from 1 s to 3 s, a flight of 12 s. 0.6 rad/s needs about 5 deg.
P_END = 3.0


def aileron_flight(*, guarded: bool) -> Tape:
    return pulse_flight("aileron", 3 * DEG, 12.0, "p", 1.0, P_END, 0.6, guarded=guarded)


@pytest.mark.parametrize(
    "guarded, wrong_way, recovered, commanded",
    [
        # Measured 0.0422 rad/s, 0.58 s, 5.3 deg. The prototype, with unknown timing: conditional
        # integration 0.041, 0.65 s, 5.7 deg; back-calculation 0.058, 0.65 s, 6.3 deg.
        pytest.param(True, (0.0, 0.0423), (0.0, 0.65), (0.0, 5.7), id="guarded"),
        # Measured 0.381 rad/s, 1.96 s, 53 deg. The prototype: 0.377, 1.98 s, 58 deg.
        pytest.param(False, (0.3, 0.5), (1.8, 2.2), (30.0, 90.0), id="unguarded"),
    ],
)
def test_aileron_recovery_after_a_saturated_roll_command(
    guarded: bool,
    wrong_way: tuple[float, float],
    recovered: tuple[float, float],
    commanded: tuple[float, float],
) -> None:
    # e is negative while p is commanded. A positive e afterwards is the effect of the integrals.
    # "recovered" is the time until e stays within 5 % of the pulse. Without anti-windup the error
    # is nine times as large and lasts three times as long.
    tape = aileron_flight(guarded=guarded)
    e = error(tape)["p"]
    t = tape.time("truth")
    assert wrong_way[0] <= e[t > P_END].max() <= wrong_way[1]
    assert recovered[0] <= last_beyond(t, e, 0.03) - P_END <= recovered[1]
    assert commanded[0] <= np.abs(tape["internals"]["u_free.aileron"]).max() / DEG <= commanded[1]


def test_anti_windup_loses_bank_that_saturated_ailerons_missed() -> None:
    # The integral of e_p is the bank error, so anti-windup loses bank: measured -0.49 rad, and
    # -0.02 rad without anti-windup, where the wound-up integral restores the bank afterwards.
    # Attitude needs an outer loop.
    deficits = {}
    for guarded in (True, False):
        tape = aileron_flight(guarded=guarded)
        deficits[guarded] = state(tape, "phi")[-1] - np.trapezoid(
            tape["y_m"]["p"], tape.time("y_m")
        )
    assert -0.6 < deficits[True] < -0.3
    assert abs(deficits[False]) < 0.1


# Elevator +-3 deg: the vertical gust of the scenario at 2 s, of 1.2 s, a flight of 8 s. Without
# stops it needs 4.5 deg.


# A slow rudder: the lateral gust of the scenario at 2 s, a flight of 10 s. It needs 46 deg/s.
@cache
def rudder_flight(rate_deg: float, *, limited: bool = False, sign: str = "auto") -> Tape:
    actuators = SERVO.aircraft.actuators.model_dump()
    rate = [
        rate_deg * DEG if key == "rudder" else old
        for key, old in zip(INPUTS, actuators["rate"], strict=True)
    ]
    slew = [rate[INPUTS.index(key)] for key in SERVO.controller.inputs] if limited else None
    return simulate(
        SERVO.vary(
            flight={"duration": 10.0},
            aircraft={
                "actuators": actuators | {"rate": rate},
                "gusts": {"lateral": GUSTS["lateral"] | {"start": 2.0}},
            },
            controller={"slew": slew, "sign": sign},
        )
    )


def end_of_r(tape: Tape) -> float:
    """Return the largest error of r in the last 3 s.

    They begin 3.8 s after the end of the gust.
    """
    return float(np.abs(error(tape)["r"][tape.time("truth") > 7.0]).max())


@pytest.mark.parametrize("rate_deg", [40.0, 30.0])
def test_controller_with_rate_limit_has_no_limit_cycle(rate_deg: float) -> None:
    # The command keeps the rate limit, so the actuator follows it. At 40 deg/s, where the limit of
    # the actuator alone causes no limit cycle, the error in the gust is 0.083 rad/s instead of
    # 0.073; at 30 it is 0.22 instead of a limit cycle of 0.42.
    tape = rudder_flight(rate_deg, limited=True)
    commanded = np.abs(np.diff(tape["u"]["rudder"])).max() / 0.01 / DEG
    assert commanded <= rate_deg * (1.0 + 1e-9)
    assert end_of_r(tape) < 0.002
    assert np.abs(error(tape)["r"]).max() < {40.0: 0.09, 30.0: 0.25}[rate_deg]
