# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the reference model and its commands against closed forms and an exact simulation."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pytest import approx
from scipy.integrate import quad
from scipy.signal import StateSpace, chirp, lsim
from tests.closed_loop import reference_outputs
from tests.conftest import refusing

from flight_core.integrators import rk4
from flight_core.vectors import FloatArray
from reference_model import model
from reference_model.command import command
from reference_model.params import SIGNALS, ReferenceModelConfig


def parameters(**changes: object) -> ReferenceModelConfig:
    values = {
        "rate": 500.0,
        "outputs": ["q", "p", "r"],
        "second_order": {"natural_frequency": [4.0, 5.0, 4.0], "damping": [0.9, 0.9, 1.0]},
        "rise": 0.1,
    }
    return ReferenceModelConfig.validate_mapping(values | changes, "reference_model")


PULSES = {
    "q": {"start": [1.0, 3.0], "stop": [2.0, 4.0], "value": [0.1, -0.2]},
    "p": {"start": [1.0], "stop": [2.5], "value": [0.4]},
}


def test_pulse_rises_holds_and_falls_over_edges() -> None:
    profile = parameters(pulses=PULSES).profile()
    at = [float(command(t, profile)[0]) for t in (0.9, 1.0, 1.05, 1.1, 1.9, 2.05, 2.2, 3.5, 9.0)]
    assert at == approx([0.0, 0.0, 0.05, 0.1, 0.1, 0.05, 0.0, -0.2, 0.0], abs=1e-12)


@pytest.mark.equation(2)
@given(t=st.floats(0, 10), dt=st.floats(1e-6, 1e-3))
def test_commands_have_a_bounded_derivative(t: float, dt: float) -> None:
    # Equation (2) requires a bounded u_m_dot: the slope of an edge is value / rise, and edges do
    # not overlap here.
    profile = parameters(pulses=PULSES).profile()
    change = np.abs(command(t + dt, profile) - command(t, profile))
    assert (change <= np.array([0.2, 0.4, 0.0]) / 0.1 * dt + 1e-12).all()


def test_coordinated_turn_follows_integral_of_bank_rate() -> None:
    turn = {"bank_rate": "p", "turn_rate": "r", "speed": 25.0}
    sines = {"p": {"amplitude": 0.3, "frequency": 2.0, "phase": 0.4}}
    profile = parameters(pulses=PULSES, sines=sines, coordinated_turn=turn).profile()
    for t in (0.7, 1.05, 2.0, 5.0):
        edges = [1.0, 1.1, 2.5, 2.6] if t > 2.6 else None
        bank, _ = quad(lambda s: float(command(s, profile)[1]), 0.0, t, points=edges, limit=200)
        # r = g / V0 sin(phi) is the turn rate without sideslip
        assert float(command(t, profile)[2]) == approx(9.81 / 25.0 * math.sin(bank), abs=1e-8)


CHIRP = {
    "amplitude": 0.2,
    "start": 1.0,
    "stop": 6.0,
    "first_frequency": 2.0,
    "last_frequency": 12.0,
}


@pytest.mark.parametrize(("first", "last"), [(2.0, 12.0), (12.0, 2.0), (0.5, 60.0)])
def test_chirp_is_that_of_scipy_between_start_and_stop(first: float, last: float) -> None:
    chirps = {"q": CHIRP | {"first_frequency": first, "last_frequency": last}}
    t = np.linspace(1.0, 6.0, 701)
    # scipy's is a cosine of a phase in degrees, with frequencies in Hz
    expected = 0.2 * chirp(
        t - 1.0, first / (2.0 * np.pi), 5.0, last / (2.0 * np.pi), method="linear", phi=-90.0
    )
    assert command(t, parameters(chirps=chirps).profile())[:, 0] == approx(expected, abs=1e-12)


def test_chirp_begins_at_zero_and_ends_at_next_zero_without_a_step() -> None:
    profile = parameters(chirps={"q": CHIRP}).profile()
    t = np.linspace(0.0, 8.0, 80_001)
    u_m = command(t, profile)[:, 0]
    # the phase at 6 s is 35 rad, and the next multiple of pi 12 pi, at 12 rad/s
    end = 6.0 + (12.0 * np.pi - 35.0) / 12.0
    assert (u_m[(t <= 1.0) | (t >= end)] == 0.0).all()
    assert abs(command(end - 1e-3, profile)[0]) > 1e-3
    # u_m_dot is at most the amplitude times the largest frequency
    assert np.abs(np.diff(u_m)).max() <= 0.2 * 12.0 * 1e-4 + 1e-12


def test_doublet_is_a_pulse_and_its_opposite() -> None:
    doublets = {"q": {"start": [1.0], "width": [0.5], "value": [0.1]}}
    t = np.linspace(0.0, 3.0, 301)
    corners = [0.0, 1.0, 1.1, 1.5, 1.6, 2.0, 2.1, 3.0]
    expected = np.interp(t, corners, [0.0, 0.0, 0.1, 0.1, -0.1, -0.1, 0.0, 0.0])
    u_m = command(t, parameters(doublets=doublets).profile())[:, 0]
    assert u_m == approx(expected, abs=1e-15)


def test_ramp_ends_at_a_held_value_and_ramps_add_up() -> None:
    ramps = {"q": {"start": [1.0, 5.0], "stop": [3.0, 6.0], "value": [0.4, -0.1]}}
    profile = parameters(ramps=ramps).profile()
    at = [float(command(t, profile)[0]) for t in (1.0, 2.0, 3.0, 4.0, 5.5, 6.0, 1e6)]
    assert at == approx([0.0, 0.2, 0.4, 0.4, 0.35, 0.3, 0.3], abs=1e-15)


def test_recorded_command_is_interpolated_and_its_last_value_held() -> None:
    times = [0.0, 0.02, 0.5, 0.7]
    values = [0.1, -0.2, 0.3, 0.25]
    recorded = {"q": {"time": times, "value": values}}
    t = np.linspace(0.0, 1.0, 173)
    u_m = command(t, parameters(recorded=recorded).profile())[:, 0]
    assert u_m == approx(np.interp(t, times, values), abs=1e-15)


def test_signals_of_a_channel_add_up_and_turn_follows_their_integral() -> None:
    turn = {"bank_rate": "p", "turn_rate": "r", "speed": 25.0}
    signals = {
        "pulses": PULSES["p"],
        "doublets": {"start": [0.5], "width": [0.8], "value": [0.3]},
        "ramps": {"start": [2.0], "stop": [4.0], "value": [-0.2]},
        "sines": {"amplitude": 0.1, "frequency": 2.0, "phase": 0.4},
        "chirps": CHIRP,
        "recorded": {"time": [0.0, 1.0, 3.0], "value": [0.0, 0.3, -0.1]},
    }
    assert tuple(signals) == SIGNALS
    alone = [parameters(**{key: {"p": signal}}).profile() for key, signal in signals.items()]
    together = {key: {"p": signal} for key, signal in signals.items()}
    profile = parameters(**together, coordinated_turn=turn).profile()
    for t in (0.7, 1.05, 2.0, 5.0, 6.1, 8.0):
        rates = [float(command(t, each)[1]) for each in alone]
        assert float(command(t, profile)[1]) == approx(sum(rates), abs=1e-15)
        # the corners of the lines and the end of the chirp, where quad needs to stop
        corners = [0.5, 0.6, 1.0, 1.1, 1.3, 1.4, 2.0, 2.1, 2.2, 2.5, 2.6, 3.0, 4.0, 6.0, 6.22492596]
        before = [corner for corner in corners if corner < t]
        bank, _ = quad(lambda s: float(command(s, profile)[1]), 0.0, t, points=before, limit=400)
        # r = g / V0 sin(phi) is the turn rate without sideslip
        assert float(command(t, profile)[2]) == approx(9.81 / 25.0 * math.sin(bank), abs=1e-8)


def test_edges_are_those_of_pulses_doublets_and_ramps() -> None:
    params = parameters(
        pulses={"q": {"start": [1.0], "stop": [2.0], "value": [0.1]}},
        doublets={"q": {"start": [4.0], "width": [0.5], "value": [0.3]}},
        ramps={"p": {"start": [2.0], "stop": [4.0], "value": [-0.2]}},
        chirps={"p": CHIRP},
    )
    spans = {name: [(e.start, e.stop) for e in edges] for name, edges in params.edges().items()}
    q = [(1.0, 1.1), (2.0, 2.1), (4.0, 4.1), (4.5, 4.6), (5.0, 5.1)]
    assert spans == {"q": q, "p": [(2.0, 4.0)], "r": []}


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"doublets": {"q": {"start": [1.0], "width": [0.0], "value": [1.0]}}}, "greater than 0"),
        (
            {"doublets": {"q": {"start": [1.0], "width": [0.5, 0.5], "value": [1.0]}}},
            "doublets.q.width: found 2 values, expected 1, one for each of doublet 1",
        ),
        (
            {"ramps": {"q": {"start": [2.0], "stop": [2.0], "value": [1.0]}}},
            r"ramps.q.stop\[0\]: found 2.0, expected later than start\[0\] = 2 s",
        ),
        ({"chirps": {"q": CHIRP | {"stop": 1.0}}}, "later than start = 1 s"),
        (
            {"chirps": {"q": CHIRP | {"last_frequency": 2.0}}},
            "last_frequency: found 2.0, expected a value other than first_frequency",
        ),
        ({"chirps": {"x": CHIRP}}, "chirps.x: found channel 'x', expected one of q, p, r"),
        ({"recorded": {"q": {}}}, "recorded.q.time: found 0 values, expected at least 2, or a"),
        ({"recorded": {"q": {"time": [1.0, 2.0], "value": [0.0, 0.0]}}}, "expected 0: the start"),
        (
            {"recorded": {"q": {"time": [0.0, 2.0, 2.0], "value": [0.0, 0.0, 0.0]}}},
            r"time\[2\]: found 2.0, expected later than time\[1\] = 2 s",
        ),
    ],
)
def test_commands_beyond_their_bounds_refused(changes: dict[str, object], sentence: str) -> None:
    with refusing(sentence):
        parameters(**changes)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"time,value\n0,0.1\n", "recorded.q.time: found 1 values, expected at least 2"),
        (b"t,q\n0,0.1\n1,2\n", "found t,q, expected a CSV file whose first line is time,value"),
        (b"", "found no line, expected a CSV file"),
        (b"time,value\n0,0.1\n1,x\n", "stick.csv: row 2: found 1,x, expected two numbers"),
        (b"time,value\n0,0.1\n1\n", "stick.csv: row 2: found 1, expected two numbers"),
        (b"time,value\n0,0.1\n1,nan\n", r"recorded.q.value\[1\]: found nan, expected a finite"),
        (b"time,value\n0,\xff\n", "stick.csv: cannot be read"),
        (None, r"recorded.q.file: .*stick.csv: cannot be read \(No such file or directory\)"),
    ],
)
def test_files_that_are_no_recorded_command_refused(
    tmp_path: Path, content: bytes | None, sentence: str
) -> None:
    file = tmp_path / "stick.csv"
    if content is not None:
        file.write_bytes(content)
    with refusing(sentence):
        parameters(recorded={"q": {"file": str(file)}})


def simulate(params: ReferenceModelConfig, duration: float, dt: float) -> FloatArray:
    return reference_outputs(params.model(), params.profile(), dt, round(duration / dt))


@pytest.mark.equation(2)
def test_equation_2_agrees_with_exact_linear_simulation() -> None:
    params = parameters(pulses=PULSES)
    matrices = params.model()
    profile = params.profile()
    t = np.arange(0, 3001) * 0.002
    u_m = command(t, profile)  # piecewise linear with knots on the grid: lsim is exact for it
    _, exact, _ = lsim(StateSpace(matrices.A_m, matrices.B_m, matrices.C, np.zeros((3, 3))), u_m, t)  # type: ignore[call-overload]
    assert simulate(params, 6.0, 0.002) == approx(exact, abs=1e-9)


def test_step_is_one_runge_kutta_step_of_equation_2() -> None:
    params = parameters(pulses=PULSES)
    matrices = params.model()
    profile = params.profile()
    dt = 0.05
    x_m = np.linspace(-0.2, 0.3, 6)

    def x_dot(t: float, x: FloatArray, _: None, params: model.ReferenceMatrices) -> FloatArray:
        return np.asarray(model.x_m_dot(t, x, command(t, profile), params))

    # PULSES change u_m within this step; the two differ by rounding only.
    u_m = np.concatenate([command(1.0 + part * dt, profile) for part in (0.0, 0.5, 1.0)])
    one_step = rk4(x_dot, 1.0, x_m, None, matrices, dt)
    assert model.step(x_m, u_m, model.stepper(dt, matrices)) == approx(
        one_step, rel=1e-14, abs=1e-15
    )


def test_general_form_and_second_order_form_are_same_model() -> None:
    same = parameters().model()
    A_m = same.A_m.ravel().tolist()
    B_m = same.B_m.ravel().tolist()
    linear = {"states": ["q", "q_rate", "p", "p_rate", "r", "r_rate"], "A_m": A_m, "B_m": B_m}
    for general_matrix, matrix in zip(
        parameters(second_order=None, linear=linear).model(), same, strict=True
    ):
        assert (general_matrix == matrix).all()


def test_rate_at_which_runge_kutta_steps_diverge_refused() -> None:
    # 1 + z + z^2/2 + z^3/6 + z^4/24 = 1 at z = -2.785, here a pole of 278.5 1/s at 100 Hz.
    def first_order(pole: float) -> ReferenceModelConfig:
        linear = {"states": ["q"], "A_m": [-pole], "B_m": [pole]}
        return parameters(rate=100.0, outputs=["q"], second_order=None, linear=linear)

    assert first_order(278.0).model().A_m.tolist() == [[-278.0]]
    with refusing(r"reference_model.rate: found 100 Hz, expected a higher one: the"):
        first_order(279.0)
