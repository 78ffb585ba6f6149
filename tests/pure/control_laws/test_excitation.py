# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the excitation of an identification against closed forms.

It applies doublets and a multisine to one input after the other.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pytest import approx

from control_laws import excitation
from control_laws.excitation import ExcitationConfig, multisine
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.parameters import ParameterError
from flight_core.vectors import FloatArray
from flight_view.control import gains_of

pytestmark = pytest.mark.slow

TIMETABLE: dict[str, Any] = {
    "amplitude": [0.02, 0.02, 0.02, 0.06],  # rad and 1
    "width": [0.25, 0.25, 0.25, 1.0],
    "period": [6.0, 6.0, 6.0, 10.0],
    "lowest": [0.3, 0.3, 0.3, 0.1],
    "highest": [3.0, 3.0, 3.0, 0.8],
    "pause": 1.5,
}
DT = 1e-3  # s


def controller(**changes: Any) -> ExcitationConfig:
    servo = find_scenario("osprey_servo").controller
    common = (
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
    values = (
        {key: getattr(servo, key) for key in common} | {"law": "excitation"} | TIMETABLE | changes
    )
    return ExcitationConfig.validate_mapping(values, "controller")


@pytest.fixture(scope="module")
def excited() -> FloatArray:
    """Return the excitation at steps of DT, (T, m), in units of the amplitude."""
    params = controller()
    arrays = params.law_params()
    return np.array([excitation.signal(k * DT, arrays) for k in range(round(params.duration / DT))])


def flight(duration: float, **changes: Any) -> Scenario:
    calm = find_scenario("osprey_servo", duration).vary(
        aircraft={"gusts": {}, "rate": 200.0, "step": 0.005},
        reference_model={"pulses": {}, "coordinated_turn": None, "rate": 200.0},
    )
    return replace(calm, controller=controller(**changes))


def test_live_page_offers_no_gains_of_timetable() -> None:
    assert gains_of(controller()) == {}


def test_inputs_are_excited_in_turn(excited: FloatArray) -> None:
    """At most one input is excited at a time, and none in a pause."""
    active = excited != 0.0
    assert active.sum(axis=1).max() == 1
    assert not active[: round(1.5 / DT)].any()
    assert not active[-round(1.4 / DT) :].any()


def test_excitation_lasts_as_long_as_parameters_say() -> None:
    # a pause, then for each input 8 widths, a period and a pause: 1.5 + 3 (2 + 6 + 1.5) + 8 + 10 +
    # 1.5
    assert controller().duration == approx(49.5)


def test_doublets_and_multisine_have_no_mean(excited: FloatArray) -> None:
    # The second integral of the doublets alone is -3 w^2: 1 of the first, -4 of the second, which
    # is twice as wide.
    u = excited[:, 0]
    assert abs(u.sum() * DT) < 2.0 * DT
    doublets = u[round(1.5 / DT) : round(3.5 / DT)]
    assert np.cumsum(doublets).sum() * DT**2 == approx((1.0 - 4.0) * 0.25**2, rel=0.02)


def test_multisine_has_band_alone_and_low_peak() -> None:
    # Schroeder's phases keep the crest factor of a flat band near 1.7; that of cosines in phase
    # would be sqrt(2 h) = 5.8.
    harmonic, phase, part = multisine(6.0, 0.3, 3.0)
    assert harmonic[0] / 6.0 == approx(0.3, abs=1.0 / 12.0)
    assert harmonic[-1] / 6.0 == approx(3.0, abs=1.0 / 6.0)
    t = np.arange(6000) / 6000.0
    u = (part * np.sin(2.0 * np.pi * np.outer(t, harmonic) + phase)).sum(axis=1)
    assert np.max(np.abs(u)) == approx(1.0, rel=0.02)
    assert 1.0 / np.sqrt(np.mean(u**2)) < 2.2
    spectrum = np.abs(np.fft.rfft(u)) / 3000.0
    outside = np.delete(spectrum, harmonic.astype(int))
    np.testing.assert_allclose(spectrum[harmonic.astype(int)], part, rtol=1e-6)
    assert outside.max() < 1e-9


def test_flight_commands_timetable_whatever_y_does() -> None:
    tape = simulate(flight(12.0))  # the first input, and the begin of the second
    u = tape["u"]
    params = controller().law_params()
    t = (u.stamp_ns - u.stamp_ns[0]) * 1e-9
    order = [u.names.index(name) for name in controller().inputs]
    expected = np.array([params.amplitude * excitation.signal(instant, params) for instant in t])
    differs = np.abs(u.values[:, order] - expected) > 1e-9
    # only at an edge, where the law's sum of periods rounds to the other side
    assert differs.any(axis=1).mean() < 0.01
    assert np.abs(tape["y"]["q"]).max() > 0.02  # rad/s: the aircraft answers


def test_limits_act_on_the_excitation() -> None:
    slow = simulate(flight(4.0, slew=[0.01, 0.01, 0.01, 0.01]))  # the first doublet
    steps = np.abs(np.diff(slow["u"]["elevator"]))
    assert steps.max() <= 0.01 * 0.01 * (1.0 + 1e-9)  # 0.01 1/s at 100 Hz


@pytest.mark.parametrize(
    "changes, sentence",
    [
        ({"amplitude": [0.02, 0.02, 0.02]}, "controller.amplitude: found 3 values, expected 4"),
        (
            {"amplitude": [0.9, 0.02, 0.02, 0.06]},
            "controller.amplitude[0]: found 0.9, expected at most 0.523599, the limits of",
        ),
        (
            {"lowest": [4.0, 0.3, 0.3, 0.1]},
            "controller.lowest[0]: found 4.0, expected at most highest[0] = 3 Hz",
        ),
        (
            {"highest": [60.0, 3.0, 3.0, 0.8]},
            "controller.highest[0]: found 60.0, expected below half the rate of the law, 50 Hz",
        ),
    ],
)
def test_timetable_that_cannot_be_flown_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError) as error:
        controller(**changes)
    assert str(error.value).startswith(sentence)
