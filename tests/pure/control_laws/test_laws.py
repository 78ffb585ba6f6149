# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The control laws of the controller through their one protocol.

The tests are of engagement, limits, retuning, replay, observer and refusals.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from importlib.metadata import EntryPoint, EntryPoints
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.closed_loop import PROTOTYPE_SERVO
from tests.conftest import REPOSITORY, refusing
from tests.other_laws import COMMON, OWN_LAW, SECTIONS, example_installed
from tests.pure.flight_analysis.test_replay import BUSY, equal

from aircraft_sim.airframes.airframe import load_airframe
from control_laws import lqg
from control_laws.catalogue import LAWS
from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.simulate import simulate
from flight_core.modes import Mode
from flight_core.parameters import ParameterError
from flight_core.vectors import FloatArray, StampedVector
from flight_design.gains.gain_selection import with_feedforward
from flight_design.gains.observer_gains import gains_by_rule
from flight_design.gains.observer_selection import model_for, with_aircraft_observer
from rise_di_controller import laws
from rise_di_controller.controller import Controller
from rise_di_controller.extensions.observer import ObserverParams, ObserverState
from rise_di_controller.guard import guard, retuning
from rise_di_controller.guard.guard import ControllerState, GuardParams
from rise_di_controller.law.control_law import Measurements, TunedLaw, field_names, fields, restored
from rise_di_controller.law.law import gain
from rise_di_controller.law.linear_loop import linear_law
from rise_di_controller.law.saturation import Limits
from rise_di_controller.laws import AnyLaw
from rise_di_controller.params import ControllerConfig

# as the campaigns set it, also where they are not loaded
jax.config.update("jax_enable_x64", True)  # type: ignore[no-untyped-call]

AIRFRAME = load_airframe("osprey")
SERVO = PROTOTYPE_SERVO.vary(
    flight={"duration": 2.0},
    aircraft={
        "rate": 100.0,
        "step": 0.005,
        "gusts": {"vertical": {"start": 1.0, "speed": 10.12, "length": 15.24}},
    },
    reference_model={"rate": 100.0, "pulses": BUSY},
)
MS, DT = 1_000_000, 0.01  # ns; s, the period of the controller
NOISE = np.array([0.0017, 0.0017, 0.0017, 0.03])  # of osprey_servo


@pytest.fixture(scope="module", autouse=True)
def _example(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with example_installed(tmp_path_factory.mktemp("installed")):
        yield


@cache
def sections() -> dict[str, dict[str, Any]]:
    """Sections of a controller by a name.

    With "observer" in the name it is the observer for osprey_servo by rule, with 20 ms of margin.
    """
    rise = SERVO.rise_di()
    leading = with_feedforward(rise, AIRFRAME).model_dump()
    gains = gains_by_rule(model_for(AIRFRAME, rise, NOISE), tuple(AIRFRAME.gusts), speed=25.0)
    observed = with_aircraft_observer(rise, AIRFRAME, [gains], NOISE, 0.02).controller.model_dump()
    extended = {key: observed[key] for key in ("feedforward", "observer")}
    pi = SECTIONS["pi"]
    l1 = SECTIONS["l1"]
    return {
        "rise_di": rise.model_dump(),
        "rise_di, implicit": rise.model_dump() | {"sign": "implicit"},
        "pi": pi,
        "l1": l1,
        "l1, feedforward": l1 | {"feedforward": leading["feedforward"]},
        "pid": SECTIONS["pid"],
        "own": SECTIONS.get("own", {}),
        "lqg, observer": COMMON | extended | {"law": "lqg"},
        "rise_di, observer": observed,
        "pi, observer": pi | extended | {"K": gains.K.tolist(), "Lambda": gains.Lambda.tolist()},
    }


NAMES = (
    "rise_di",
    "rise_di, implicit",
    "pi",
    "l1",
    "l1, feedforward",
    "pid",
    *(["own"] if OWN_LAW else []),
)
OBSERVED = ("lqg, observer", "rise_di, observer", "pi, observer")
EVERY_LAW = pytest.mark.parametrize("name", [*NAMES, *OBSERVED])


def controller(name: str, **changes: Any) -> ControllerConfig:
    return (
        AnyLaw.validate_mapping(sections()[name] | changes, "controller")
        if changes
        else valid(name)
    )


@cache
def valid(name: str) -> ControllerConfig:
    return AnyLaw.validate_mapping(sections()[name], "controller")


@cache
def prepared(parameters: ControllerConfig) -> tuple[GuardParams, TunedLaw]:
    return parameters.guard(), parameters.tuned_law()


def at(y: Any, **others: Any) -> Measurements:
    """Measurements of four channels; what is not given is 0."""
    zero = np.zeros(4)
    fields = {"y_m": zero, "y_m_dot": zero, "u_trim": zero, "u_before": zero} | others
    return Measurements(y + zero, **{key: value + zero for key, value in fields.items()})


def sample(ms: float, value: Any) -> StampedVector:
    return StampedVector(round(ms * MS), value + np.zeros(4))


def tick(
    parameters: ControllerConfig, state: ControllerState, ms: float, y: Any, y_m: Any = 0.0
) -> ControllerState:
    """The state after a tick with fresh y and y_m."""
    return guard.tick(
        state, round(ms * MS), sample(ms, y), [sample(ms, y_m)], *prepared(parameters)
    )[0]


def random_flight(law: TunedLaw, size: float, ticks: int = 20) -> tuple[Any, Measurements]:
    """A state of a law after some ticks without limits, and the measurements of the last one."""
    generator = np.random.default_rng(1)
    measurements = at(size * generator.standard_normal(4))
    state = law.control_law.engage(measurements, law.params)
    for _ in range(ticks):
        y, y_m, y_m_dot, u_trim = size * generator.standard_normal((4, 4))
        measurements = Measurements(
            y=y, y_m=y_m, y_m_dot=y_m_dot, u_trim=u_trim, u_before=measurements.u_before
        )
        state, u = law.control_law.step(state, measurements, np.float64(DT), law.params)
        measurements = measurements._replace(u_before=u)
    return state, measurements


def bits(state: Any) -> dict[str, bytes]:
    return {name: np.asarray(value).tobytes() for name, value in fields(state).items()}


# Engagement, limits, retuning


def first_change(name: str, parameters: Any, e: FloatArray, u: FloatArray) -> FloatArray:
    """The largest change of u in the first tick after an engagement at a constant error.

    It comes by the gains alone.
    """
    law = name.partition(",")[0]
    if law == "lqg":
        return np.zeros(4)
    scale = np.array(parameters.input_scale)
    # the filter releases -K e; the pole of the adaptation leaves dt / 2 of Omega u unestimated
    if law == "l1":
        decay = 1.0 - np.exp(-np.array(parameters.bandwidth) * DT)
        Omega = np.reshape(parameters.Omega, (4, 4))
        change = np.array(parameters.K) * np.abs(e) + DT / 2.0 * (np.abs(Omega) @ np.abs(u))
        return np.asarray(np.abs(np.linalg.inv(Omega)) @ (decay * change))
    K = (
        gain(np.array(parameters.k_g), np.array(parameters.k_d))
        if law == "rise_di"
        else np.array(parameters.K)
    )
    sign = DT * np.array(parameters.beta) if law == "rise_di" else 0.0
    return np.asarray(scale * (K * np.array(parameters.Lambda) * np.abs(e) * DT + sign))


@EVERY_LAW
@pytest.mark.parametrize("size", [1e-6, 1e6])
def test_law_engages_without_jump_at_any_error(name: str, size: float) -> None:
    parameters = controller(name, lower=None, upper=None)
    u = np.array([0.1, -0.2, 0.3, -0.4])
    e = size * np.array([1.0, -2.0, 3.0, -4.0])
    begin = tick(parameters, guard.initial_state(4)._replace(u=u), 0, e)
    assert begin.u.tolist() == begin.u_trim.tolist() == u.tolist()
    after = tick(parameters, begin, 10, e)
    observed = np.zeros(4) if parameters.observer is None else np.abs(after.law.u_o)
    # 1e-12 of u and of K e, which the law subtracts again, is rounding
    rounding = 1e-12 * (np.abs(u) + 1e3 * np.abs(e) * np.array(parameters.input_scale))
    assert (np.abs(after.u - u) <= first_change(name, parameters, e, u) + observed + rounding).all()


@EVERY_LAW
def test_limits_that_are_not_reached_change_no_bit(name: str) -> None:
    law = controller(name).tuned_law()
    state, measurements = random_flight(law, 0.05)
    wide = Limits(np.full(4, -1e3), np.full(4, 1e3), np.full(4, 1e3 / DT))
    after, u = law.control_law.step(state, measurements, np.float64(DT), law.params)
    limited_state, u_free, u_limited = law.control_law.limited(
        state, measurements, np.float64(DT), law.params, wide
    )
    assert u.tobytes() == u_free.tobytes() == u_limited.tobytes()
    assert bits(after) == bits(limited_state)


@EVERY_LAW
def test_limits_hold_for_any_error(name: str) -> None:
    """The limits of magnitude and rate hold for any error."""
    parameters = controller(name, lower=[-0.02] * 4, upper=[0.01] * 4, slew=[0.05] * 4)
    # u_o of lqg is 0.6 of the limits within 0.1 s: 0.09 /s
    generator = np.random.default_rng(1)
    state = guard.initial_state(4)
    us = [np.zeros(4)]
    for k in range(300):
        state = tick(
            parameters,
            state,
            10 * k,
            generator.standard_normal(4) * 10.0 ** generator.integers(-3, 2),
        )
        us.append(state.u)
    u = np.array(us)
    assert u.min() >= -0.02
    assert u.max() <= 0.01
    # reached, and kept
    assert np.abs(np.diff(u, axis=0)).max() == pytest.approx(0.05 * DT, rel=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_no_integral_winds_up_in_saturation(name: str) -> None:
    parameters = controller(name, lower=[-0.02] * 4, upper=[0.02] * 4, slew=[0.1] * 4)
    state = guard.initial_state(4)
    for k in range(500):
        state = tick(parameters, state, 10 * k, 0.5)
    earlier = fields(state.law)
    for k in range(500, 1000):
        state = tick(parameters, state, 10 * k, 0.5)
    assert state.u == pytest.approx([-0.02] * 4, rel=1e-12)
    # the slowest filter is l1's, 4 rad/s: 5 s leave exp(-20) of a change
    for group, value in fields(state.law).items():
        assert_allclose(value, earlier[group], rtol=1e-7, err_msg=group)
    # so u leaves its limit with the first sample of the other sign, as fast as it may
    assert tick(parameters, state, 10_000, -0.5).u == pytest.approx(
        [-0.02 + 0.1 * DT] * 4, rel=1e-9
    )


RETUNED: dict[str, dict[str, Any]] = {
    "rise_di": {"k_g": 2.0, "Lambda": [1.0, 2.0, 3.0, 4.0], "beta": [1.0] * 4, "softening": 4.0},
    "pi": {"K": [1.0, 2.0, 3.0, 4.0], "Lambda": [1.0, 0.0, 3.0, 4.0]},
    "l1": {
        "K": [1.0, 2.0, 3.0, 4.0],
        "bandwidth": [5.0] * 4,
        "Omega": np.diag([40.0, 60.0, 9.0, 5.0]).ravel().tolist(),
    },
    "pid": {
        "K": [1.0, 2.0, 3.0, 4.0],
        "Lambda": [1.0, 0.0, 3.0, 4.0],
        "lead": [0.1] * 4,
        "filter_time": [0.1] * 4,
    },
    "lqg": {},
    "own": {"input_scale": [0.01, 0.02, 0.05, 0.1]},  # a parameter of every law
}


@EVERY_LAW
def test_new_parameters_leave_u_as_it_is(name: str) -> None:
    law = controller(name).tuned_law()
    # l1 with another Omega has another u_r: its measurements have y_m_dot = 0
    changes = RETUNED[name.partition(",")[0]]
    if name in OBSERVED:
        changes = {
            key: (0.1 * np.array(value)).tolist()
            for key, value in changes.items()
            if key in {"K", "Lambda", "beta"}
        }
    new = controller(name, **changes).tuned_law()
    state, measurements = random_flight(law, 1e-3)
    measurements = measurements._replace(y_m_dot=np.zeros(4))
    if name in OBSERVED:  # no innovation, so that the observer has nothing to add
        state = state._replace(
            z=law.params.H.T @ (measurements.y - measurements.y_m), sigma=np.ones(1)
        )
        state = state._replace(u_o=-law.params.F @ state.z)
    after = law.control_law.retune(state, law.params, new.params)
    # a tick of no time shows u: its filters and integrals do not move; 1e-12 s moves them by 1e-12
    # of their rates
    _, u = law.control_law.step(state, measurements, np.float64(1e-12), law.params)
    _, u_new = new.control_law.step(after, measurements, np.float64(1e-12), new.params)
    assert_allclose(u_new, u, rtol=1e-8, atol=1e-10)


# Flight and replay


@EVERY_LAW
def test_every_law_flies_and_replays(name: str) -> None:
    """Replay equals the flight to the last bit."""
    scenario = replace(SERVO, controller=controller(name))
    tape = simulate(scenario)
    result = replay(tape, scenario.controller)
    assert equal(result), result.first()
    assert (len(result.number), result.notes) == (201, ())
    log = tape["internals"]
    assert set(log["mode"]) == {Mode.ENGAGED}
    # the commands are 0.1 rad/s to 0.4 rad/s and 1.5 m/s, the gust is 10 m/s; a lost aircraft has
    # errors of several rad/s
    assert (np.abs(log.group("e").values).max(axis=0) < [0.2, 0.2, 0.2, 1.0]).all()
    of_law = [
        group for group in field_names(scenario.controller.tuned_law().control_law) if group != "e"
    ]
    assert all(log.group(group).values.any() for group in of_law)  # the log holds its state


def test_only_gains_change_in_flight() -> None:
    """Neither the law nor its channels change in flight.

    The models do so by a learner alone, of RISE-DI.
    """
    assert {"K", "Lambda", "lead", "filter_time", "upper", "hold"} <= controller("pid").tunable()
    for name in (*NAMES, *OBSERVED):
        assert not controller(name).tunable() & {"law", "outputs", "D", "rate", "learn"}
        models = {"feedforward", "observer"} if controller(name).law == "rise_di" else set()
        assert not controller(name).tunable() & {"feedforward", "observer"}
        assert controller(name).learned() == models


def test_another_law_or_observer_refused_in_flight() -> None:
    controller_of_pi = Controller(controller("pi"))
    for name in ("rise_di", "pid", "pi, observer"):
        expected = (
            r"controller\.law: found \w+, expected the law and the observer that fly: "
            r"these change at a restart"
        )
        with refusing(expected):
            controller_of_pi.retune(controller(name))


# The linear model of a law


@EVERY_LAW
def test_linear_model_predicts_step_of_law(name: str) -> None:
    law = controller(name).tuned_law()
    linear = linear_law(law, 4, DT)
    generator = np.random.default_rng(1)
    state = law.control_law.engage(at(0.0), law.params)
    if isinstance(state, ObserverState):
        state = state._replace(sigma=np.ones(1))
    z = np.concatenate([*fields(state).values()]) * 0.0
    for _ in range(50):
        y = 1e-9 * generator.standard_normal(4)  # inside every softened or implicit sign
        state, u = law.control_law.step(state, at(y), np.float64(DT), law.params)
        predicted = linear.C @ z + linear.D @ y
        z = linear.A @ z + linear.B @ y
        assert_allclose(u, predicted, rtol=1e-6, atol=1e-6 * np.abs(predicted).max())


def responses(name: str, parameters: Any, z: complex) -> FloatArray:
    """The transfer matrix from y to u at z, worked out by hand."""
    T = DT
    K = np.array(
        parameters.K if hasattr(parameters, "K") else gain(np.array(1.0), np.array(parameters.k_d))
    )
    if name == "l1":
        Omega = np.reshape(parameters.Omega, (4, 4))
        decay = 1.0 - np.exp(-np.array(parameters.bandwidth) * T)
        # and a pole of 1 1/s in the adaptation
        low_pass = np.diag(decay / (1.0 - (1.0 - decay) / z) / (np.exp(T) - 1.0))
        # u = -Omega^-1 (K y + F ((1 - 1/z) y - T / z Omega u))
        return np.asarray(
            -np.linalg.solve(
                (np.eye(4) - low_pass * T / z) @ Omega, np.diag(K) + low_pass * (1.0 - 1.0 / z)
            )
        )
    series = 1.0 + np.array(parameters.Lambda) * T / 2.0 * (z + 1.0) / (z - 1.0)
    if name == "pid":
        share = 1.0 - np.exp(-T / np.array(parameters.filter_time))
        series = series + np.array(parameters.lead) * share / T * (z - 1.0) / (z - 1.0 + share)
    if name == "rise_di":
        lag = np.array(parameters.lag) + 1.5 * T + parameters.delay
        # beta / (eps K) is 1 / (softening lag)
        series = series + T / (parameters.softening * lag) * z / (z - 1.0)
    return np.diag(-np.array(parameters.input_scale) * np.array(parameters.D) * K * series)


@pytest.mark.parametrize("name", ["rise_di", "pi", "l1", "pid"])
def test_linear_model_has_frequency_response_of_law(name: str) -> None:
    parameters = controller(name)
    A, B, C, D = linear_law(parameters.tuned_law(), 4, DT)
    for omega in (0.1, 1.0, 10.0, 100.0):  # rad/s
        z = np.exp(1j * omega * DT)
        transfer = C @ np.linalg.solve(z * np.eye(len(A)) - A, B) + D
        assert_allclose(transfer, responses(name, parameters, z), rtol=1e-6, atol=1e-9)


@EVERY_LAW
def test_a_state_is_restored_from_its_fields(name: str) -> None:
    law = controller(name).tuned_law()
    state, _ = random_flight(law, 0.05)
    values = fields(state)
    assert tuple(values) == field_names(law.control_law)
    again = restored(law.control_law, {**values, "u_free": np.zeros(4)})  # a log has more groups
    assert type(again) is type(state)
    assert bits(again) == bits(state)


# Arrays of NumPy and of JAX


@EVERY_LAW
def test_law_is_same_under_jax(name: str) -> None:
    """A law gives the same under NumPy and JAX, and over many aircraft."""
    law = controller(name).tuned_law()

    def column(value: Any) -> Any:
        return value[:, None] if np.ndim(value) == 1 else value

    params = jax.tree.map(column, law.params)
    generator = np.random.default_rng(1)
    looks = [
        Measurements(*(0.05 * generator.standard_normal((4, 3)) for _ in range(5)))
        for _ in range(5)
    ]
    limits = Limits(*(np.full((4, 1), value) for value in (-0.1, 0.1, 1.0)))
    many = law.control_law.engage(looks[0], params)
    compiled = jax.tree.map(jax.numpy.asarray, many)
    singles = [
        law.control_law.engage(Measurements(*(signal[:, k] for signal in looks[0][:5])), law.params)
        for k in range(3)
    ]
    limited_step = jax.jit(
        lambda state, measurements: law.control_law.limited(state, measurements, DT, params, limits)
    )
    row = Limits(*(limit[:, 0] for limit in limits))
    for measurements in looks:
        many, _, u = law.control_law.limited(many, measurements, np.float64(DT), params, limits)
        compiled, _, by_jax = limited_step(compiled, measurements)
        assert_allclose(by_jax, u, rtol=1e-9, atol=1e-12)  # the order of additions differs
        for k in range(3):
            one = Measurements(*(value[:, k] for value in measurements[:5]))
            singles[k], _, of_one = law.control_law.limited(
                singles[k], one, np.float64(DT), law.params, row
            )
            assert_allclose(u[:, k], of_one, rtol=1e-9, atol=1e-12)


# The observer


class Matrices(NamedTuple):
    """Those of an observer."""

    Phi: FloatArray
    Gamma: FloatArray
    H: FloatArray
    L: FloatArray
    F: FloatArray


def matrices(parameters: ControllerConfig) -> Matrices:
    nominal = parameters.nominal()
    assert parameters.observer is not None
    assert nominal is not None
    return Matrices(*parameters.observer.matrices(nominal))


def test_observer_is_kalman_filter_with_linear_feedback() -> None:
    generator = np.random.default_rng(1)
    s = 6
    m = 2
    wide = np.full(2, np.inf)
    Phi, Gamma, L, F = (
        0.3 * generator.standard_normal(shape) for shape in ((s, s), (s, m), (s, m), (m, s))
    )
    H = np.eye(m, s)
    params = ObserverParams(
        law=lqg.LqgParams(),
        Phi=Phi,
        Gamma=Gamma,
        H=H,
        L=L,
        F=F,
        limits=Limits(-wide, wide, wide),
        fade_rate=np.float64(2.0),
    )
    law = controller("lqg, observer").tuned_law().control_law
    zero = np.zeros(m)
    e = generator.standard_normal((60, m))
    state = law.engage(
        Measurements(y=e[0], y_m=zero, y_m_dot=zero, u_trim=zero, u_before=zero), params
    )
    x = np.concatenate([e[0], np.zeros(s - m)])  # the outputs are the first states
    u = zero
    for k, error in enumerate(e):
        state, commanded = law.step(
            state,
            Measurements(y=error, y_m=zero, y_m_dot=zero, u_trim=zero, u_before=u),
            np.float64(DT),
            params,
        )
        x = x + L @ (error - H @ x)  # measurement update
        u = -min(1.0, (k + 1) * DT * 2.0) * (F @ x)
        assert_allclose(commanded, u, rtol=1e-9, atol=1e-12)
        x = Phi @ x + Gamma @ u  # time update
        assert_allclose(state.z, x, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", OBSERVED)
def test_a_re_engagement_restarts_the_observer(name: str) -> None:
    parameters = controller(name)
    state = guard.initial_state(4)
    for k in range(100):
        state = tick(parameters, state, 10 * k, 1e-3 * np.sin(k / 5.0))
    law = parameters.tuned_law()
    old = sample(990, 0.0)
    after, _ = guard.tick(state, 1300 * MS, old, [old], parameters.guard(), law)
    assert after.mode is Mode.HOLD
    assert bits(after.law) == bits(state.law)  # nothing is estimated from what is not measured
    again = tick(parameters, after, 1310, [0.01, 0.02, -0.01, 0.1])
    assert again.u.tolist() == state.u.tolist() == again.u_trim.tolist()
    H = matrices(parameters).H
    assert again.law.z.tolist() == (H.T @ [0.01, 0.02, -0.01, 0.1]).tolist()
    assert not again.law.u_o.any()
    assert again.law.sigma.tolist() == [0.0]


@pytest.mark.parametrize("name", OBSERVED)
def test_observer_with_other_matrices_restarts_without_jump(name: str) -> None:
    parameters = controller(name)
    state = guard.initial_state(4)
    e = 1e-3 * np.array([1.0, -1.0, 2.0, -2.0])
    for k in range(50):
        state = tick(parameters, state, 10 * k, e)
    weaker = [0.9 * gain for gain in sections()[name]["observer"]["F"]]
    new = controller(name, observer=sections()[name]["observer"] | {"F": weaker})
    after = retuning.retune_state(state, parameters.tuned_law(), new.tuned_law())
    assert state.law.u_o.any()
    assert_allclose(after.u_trim, state.u_trim + state.law.u_o, rtol=1e-12)
    assert after.law.z.tolist() == (matrices(new).H.T @ e).tolist()
    assert not after.law.u_o.any()
    assert after.law.sigma.tolist() == [0.0]
    # the next tick changes u by what the law integrates in a tick and by one hundredth of the new
    # u_o
    next_tick = tick(new, after, 500, e)
    assert (
        np.abs(next_tick.u - state.u)
        <= first_change(name, parameters, e, state.u) + np.abs(next_tick.law.u_o) + 1e-12
    ).all()
    assert np.abs(next_tick.law.u_o).max() < 0.02 * np.abs(matrices(new).F @ after.law.z).max()


# Refusals


def refused(sentence: str, values: dict[str, Any]) -> None:
    with pytest.raises(ParameterError) as error:
        AnyLaw.validate_mapping(values, "controller")
    assert str(error.value).startswith(sentence), str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_page_names_every_registered_law_and_parameters() -> None:
    page = (REPOSITORY / "docs" / "laws.md").read_text()
    for name in laws.names():
        own_section = (
            []
            if name in {"lqi", "indi", "mackunis"}
            else set(laws.schema(name).model_fields) - set(ControllerConfig.model_fields)
        )
        for word in (name, *own_section):
            assert f"`{word}`" in page, word


def test_unregistered_law_refused() -> None:
    """The sentence lists the registered laws."""
    registered = "excitation, indi, l1, lqg, lqi, mackunis, pi, pid, rise_di"
    refused(
        f"controller.law: found 'adrc', expected a registered law: {registered}",
        COMMON | {"law": "adrc"},
    )
    refused("controller.law: found ['pi'], expected a registered law", COMMON | {"law": ["pi"]})


def test_law_of_more_than_y_refused() -> None:
    topics = "expected a law of y and y_m: the topics have no more"
    refused(
        f"controller.law: found 'lqi', which needs the full state, {topics}",
        COMMON | {"law": "lqi"},
    )
    refused(
        f"controller.law: found 'indi', which needs the positions of the actuators, {topics}",
        COMMON | {"law": "indi"},
    )
    refused(
        f"controller.law: found 'mackunis', which needs the derivative of y, {topics}",
        COMMON | {"law": "mackunis"},
    )


def test_compared_laws_are_those_that_a_scenario_names() -> None:
    """The excitation controls nothing, and `pid` is a package of an example."""
    assert {law.law for law in LAWS.values()} == {*laws.names()} - {"excitation", "pid"}


def test_entry_point_that_is_no_law_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    values = {
        "absent": ["absent_package.law:Parameters"],
        "function": ["control_laws.pi:params_of"],
        "twice": ["control_laws.pi:PiConfig", "control_laws.l1:L1Config"],
    }
    entries = EntryPoints(
        EntryPoint(name, value, laws.GROUP) for name, targets in values.items() for value in targets
    )
    monkeypatch.setattr(laws, "_registered", lambda: entries)
    for name, sentence in {
        "absent": "found 'absent', which cannot be loaded (No module named 'absent_package'), "
        "expected an installed package",
        "function": "found 'function', registered as <function params_of",
        "twice": "found 'twice', registered as control_laws.l1:L1Config and as "
        "control_laws.pi:PiConfig, expected one",
    }.items():
        refused(f"controller.law: {sentence}", COMMON | {"law": name})


def test_a_parameter_of_another_law_is_refused() -> None:
    pi = sections()["pi"]
    refused(
        "controller.beta: found a parameter of rise_di, expected those of pi: K, Lambda",
        pi | {"beta": [1.0] * 4},
    )
    refused("controller.K: unknown key", sections()["rise_di"] | {"K": [1.0] * 4})


@pytest.mark.parametrize(
    "name, changes, sentence",
    [
        (
            "pi",
            {"K": [1.0] * 3},
            "controller.K: found 3 values, expected 4, one for each of q, p, r, V",
        ),
        ("l1", {"Omega": [1.0] * 16}, "controller.Omega: found a matrix without a D ("),
        (
            "pid",
            {"filter_time": [0.0] * 4},
            "controller.filter_time[0]: found 0.0, expected greater than 0",
        ),
        (
            "lqg, observer",
            {"observer": None},
            (
                "controller.observer: found none, expected a section: the observer is the feedback "
                "of lqg"
            ),
        ),
    ],
)
def test_invalid_parameter_of_law_refused(
    name: str, changes: dict[str, Any], sentence: str
) -> None:
    refused(sentence, sections()[name] | changes)


def test_an_invalid_observer_is_refused() -> None:
    values = sections()["pi, observer"]
    observer = values["observer"]
    states = list(observer["states"])
    s = len(observer["states"])

    def observed(**changes: Any) -> dict[str, Any]:
        return values | {"observer": observer | changes}

    refused(
        "controller.observer: found no feedforward beside it, expected that section too",
        values | {"feedforward": None},
    )
    refused(
        f"controller.observer.Phi: found {s} values, expected {s * s}: {s} rows of {s}",
        observed(Phi=[1.0] * s),
    )
    others = [states[1], states[0], *states[2:]]
    refused("controller.observer.states: found x.alpha, x.V, x.q", observed(states=others))
    unstable = np.reshape(observer["Phi"], (s, s)) + 2.0 * np.eye(s)
    refused(
        "controller.observer.L: found a spectral radius of ",
        observed(Phi=unstable.ravel().tolist()),
    )
    refused(
        "controller.observer.F: found a spectral radius of ",
        observed(F=[-3.0 * gain for gain in observer["F"]]),
    )
    refused(
        "controller.observer.margin: found a nominal loop that is unstable with u ",
        observed(margin=0.2),
    )


def test_unfit_feedforward_refused() -> None:
    """A nominal model with a different D is refused.

    So is a model with a zero in the right half plane.
    """
    values = sections()["pi, observer"]
    B = np.reshape(values["feedforward"]["B"], (-1, 4))
    negative = values | {"feedforward": values["feedforward"] | {"B": (-B).ravel().tolist()}}
    refused(
        "controller.feedforward.B: found a C B with D = [-1, -1, -1, -1], expected D = [1, 1, "
        "1, 1]",
        negative,
    )
    A = np.reshape(values["feedforward"]["A"], (len(B), len(B))).copy()
    hidden = values["feedforward"]["states"].index("alpha")
    A[hidden, hidden] += 20.0  # w diverges by itself
    growing = values | {"feedforward": values["feedforward"] | {"A": A.ravel().tolist()}}
    refused("controller.feedforward.A: found zero dynamics with an eigenvalue at ", growing)


def test_digest_depends_on_law() -> None:
    """Logs of versions without the key law keep the digest."""
    digests = {name: controller(name).digest() for name in (*NAMES, *OBSERVED)}
    assert len(set(digests.values())) == len(digests)
    section = AnyLaw.validate_mapping(sections()["rise_di"] | {"law": "rise_di"}, "controller")
    without_name = {key: value for key, value in sections()["rise_di"].items() if key != "law"}
    assert section.digest() == AnyLaw.validate_mapping(without_name, "controller").digest()
