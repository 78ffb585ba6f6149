# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the linearisation of an aircraft of JSBSim against JSBSim's own and against its flight."""

import jsbsim
import numpy as np
import pytest
from pytest import approx
from scipy.linalg import expm

from aircraft_sim.airframes.airframe import AIRPLANE_STATES, check_identities
from aircraft_sim.jsbsim import jsbsim_linearization
from aircraft_sim.jsbsim.jsbsim_aircraft import STATES as JSBSIM_STATES
from aircraft_sim.jsbsim.jsbsim_aircraft import FlightCondition
from aircraft_sim.jsbsim.jsbsim_linearization import Linearization, linearize
from aircraft_sim.jsbsim.jsbsim_trim import trim_solution, trimmed_fdm
from flight_core.outcome import FlightEnded
from flight_core.rates import nanoseconds
from flight_core.units import FOOT
from flight_core.vectors import FloatArray

pytestmark = pytest.mark.slow

STEP = nanoseconds(0.005)
CONDITIONS = {
    "c172p": FlightCondition("c172p", 46.3, 1219.2, STEP),
    "737": FlightCondition("737", 154.333, 6096.0, STEP),
}
NAMES = {  # of JSBSim's linearisation, with the SI value of their units
    "V": ("Vt", FOOT),
    "alpha": ("Alpha", 1.0),
    "q": ("Q", 1.0),
    "theta": ("Theta", 1.0),
    "beta": ("Beta", 1.0),
    "p": ("P", 1.0),
    "r": ("R", 1.0),
    "phi": ("Phi", 1.0),
}
ENTRIES = (
    *(("alpha", "alpha"), ("alpha", "q"), ("q", "alpha"), ("q", "q"), ("theta", "q")),
    *(("beta", "beta"), ("beta", "r"), ("beta", "phi"), ("V", "theta")),
    *(("p", "beta"), ("p", "p"), ("p", "r"), ("r", "beta"), ("r", "p"), ("r", "r"), ("phi", "p")),
)


@pytest.fixture(scope="module", params=CONDITIONS)
def linear(request: pytest.FixtureRequest) -> Linearization:
    return linearize(CONDITIONS[request.param])


def jacobian(linear: Linearization) -> FloatArray:
    """Return A with gravity."""
    return linear.airframe.matrix_a() + linear.airframe.matrix_gravity()


def test_a_is_that_of_jsbsims_own_linearisation(linear: Linearization) -> None:
    # FGLinearization has steps of its own, and starts the engines again: 3 % and 0.01 SI
    fdm, _ = trimmed_fdm(linear.condition, trim_solution(linear.condition))
    own = jsbsim.FGLinearization(fdm)
    places = list(own.x_names)
    A = jacobian(linear)
    for into, by in ENTRIES:
        (row, unit), (column, per) = NAMES[into], NAMES[by]
        known = own.system_matrix[places.index(row), places.index(column)] * unit / per
        result = A[list(AIRPLANE_STATES).index(into), list(AIRPLANE_STATES).index(by)]
        assert result == approx(known, rel=0.03, abs=0.01), (into, by)


def test_effects_are_those_of_jsbsims_own_linearisation(linear: Linearization) -> None:
    # It differences by smaller steps: the largest effect of all sizes, which counts, is above it by
    # up to the spread.
    fdm, _ = trimmed_fdm(linear.condition, trim_solution(linear.condition))
    own = jsbsim.FGLinearization(fdm)
    names = {"q": "DeCmd", "p": "DaCmd", "r": "DrCmd"}
    for j, output in enumerate(linear.airframe.outputs):
        if output in names:
            row = list(own.x_names).index(output.upper())
            known = own.input_matrix[row, list(own.u_names).index(names[output])]
            result = linear.Omega[j, j]
            assert result == approx(known, rel=0.15)
            assert result * linear.spread[j] == approx(known, rel=0.03)


@pytest.mark.parametrize("rate", ["q", "p", "r"])
def test_flight_after_a_kick_follows_the_linear_aircraft(linear: Linearization, rate: str) -> None:
    # JSBSim flies free for 2 s after 0.02 rad/s: what is left out, altitude, engine and products of
    # states, is below 6 % of the peak of each state that the kick moves.
    fdm, trim = trimmed_fdm(linear.condition, trim_solution(linear.condition))
    jsbsim_linearization._set_rate(fdm, trim, rate, 0.02)
    states_of_flight = []
    for _ in range(400):
        fdm.run()
        states_of_flight.append([fdm[key.property] * key.si for key in JSBSIM_STATES.values()])
    deviations = np.array(states_of_flight) - trim.states
    x = np.zeros(len(AIRPLANE_STATES))
    x[list(AIRPLANE_STATES).index(rate)] = 0.02
    step = expm(jacobian(linear) * 0.005)
    predicted = []
    for _ in range(400):
        x = step @ x
        predicted.append(x)
    after = ("alpha", "q", "theta") if rate == "q" else ("beta", "p", "r", "phi")
    for name in after:
        known = deviations[:, list(JSBSIM_STATES).index(name)]
        result = np.array(predicted)[:, list(AIRPLANE_STATES).index(name)]
        scale = np.max(np.abs(known))
        # A state that the kick hardly moves shows rounding.
        if scale > 1e-3:
            assert np.max(np.abs(result - known)) < 0.06 * scale, name


def test_airframe_has_the_identities_of_physics(linear: Linearization) -> None:
    check_identities(linear.airframe)


def test_surfaces_act_a_step_later_and_engines_take_seconds(linear: Linearization) -> None:
    lags = dict(zip(linear.condition.inputs(), linear.lag.tolist(), strict=True))
    for name in ("elevator", "aileron", "rudder"):
        assert lags[name] == approx(0.005, abs=1e-3)
    assert 0.3 < lags["throttle"] < 2.0


def test_an_input_without_effect_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def still(condition: FlightCondition, _: object, name: str, __: float) -> FloatArray:
        return np.zeros((10, len(AIRPLANE_STATES)))

    monkeypatch.setattr(jsbsim_linearization, "_response", still)
    with pytest.raises(FlightEnded, match=r"^jsbsim:737: q does not respond to elevator within"):
        linearize(CONDITIONS["737"])


def test_lag_and_effect_of_a_first_order_input(monkeypatch: pytest.MonkeyPatch) -> None:
    # x_dot = effect (1 - exp(-t / T)): the area above the response is T, and JSBSim's step is
    # added.
    T = 0.08

    def lagged(condition: FlightCondition, _: object, name: str, size: float) -> FloatArray:
        t = 0.005 * np.arange(400)
        response = np.zeros((len(t), len(AIRPLANE_STATES)))
        effects = {"elevator": ("q", -3.0), "aileron": ("p", 5.0), "rudder": ("r", -1.0)}
        output, effect = effects.get(name, ("V", 2.0))
        response[:, list(AIRPLANE_STATES).index(output)] = effect * size * (1.0 - np.exp(-t / T))
        # An even part cancels.
        return response + 0.3 * size**2

    monkeypatch.setattr(jsbsim_linearization, "_response", lagged)
    result = linearize(CONDITIONS["737"])
    assert np.diag(result.Omega) == approx([-3.0, 2.0, 5.0, -1.0], rel=1e-3)
    assert result.lag == approx([T + 0.005] * 4, abs=0.004)
    assert result.spread == approx(np.ones(4))
