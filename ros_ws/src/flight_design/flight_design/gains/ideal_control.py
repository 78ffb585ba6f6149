# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the ideal control along a manoeuvre, for the published and for uncertain airframes."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.atmosphere.disturbance import Gusts
from aircraft_sim.plant import dynamics
from aircraft_sim.plant.dynamics import Aircraft
from aircraft_sim.sections import Gust
from aircraft_sim.uncertainty import UNIFORM, Spread, nominal_and_sampled
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.linear_loop.told import Comparison, loop_of
from flight_core.integrators import rk4
from flight_core.outcome import FlightEnded
from flight_core.parameters import require
from flight_core.vectors import Array, FloatArray
from flight_design.gains.airframe_properties import (
    fastest_zero,
    invariant_zeros,
    output_coordinates,
)
from reference_model import model
from reference_model.command import command
from reference_model.params import SIGNALS, ReferenceModelConfig
from rise_di_controller.extensions.feedforward import ZERO_REAL_PART
from rise_di_controller.law.linear_loop import LoopTiming
from rise_di_controller.params import ControllerConfig

STEP = 0.01
"""s, step of the ideal control. It resolves a gust of one second, and hidden modes up to 10 1/s, to
1e-6 of their size."""

COLUMNS = 10_000
"""Number of states, of all aircraft and steps, that are evaluated at once: a few megabytes."""

STABLE_STEP = -2.785
"""Least product of a real pole and the step with which Runge-Kutta's fourth-order method is stable.
Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, section IV.2."""


class Manoeuvre(NamedTuple):
    """The commands and gusts for which the gains are selected."""

    reference: ReferenceModelConfig
    gusts: dict[str, Gust]
    duration: float  # s


class ChannelPairing(NamedTuple):
    """Outputs and inputs in the law's order, output i paired with input i."""

    outputs: tuple[str, ...]
    inputs: tuple[str, ...]


class Effected(NamedTuple):
    """An airframe with uncertain entries, and the allocation u = T v to its effectors."""

    airframe: Airframe
    T: FloatArray  # (p, m) matrix of the allocation


class Flown(NamedTuple):
    """The aircraft that flies in a study, and its differences from the controller's parameters."""

    scenario: Scenario
    comparison: Comparison


class Study(NamedTuple):
    """Rates of the ideal control along a manoeuvre, for a nominal and N - 1 uncertain airframes.

    The channels are in the order of the nominal airframe, in SI.
    """

    airframe: Airframe
    A: FloatArray  # (N, n, n)
    B: FloatArray  # (N, n, m)
    C: FloatArray  # (m, n)
    gravity: FloatArray  # (n, n) Jacobian of f at trim
    u_dot: FloatArray  # (T, N, m) rate of the ideal control, units of u / s
    slew: FloatArray  # (m,) largest abs(u_dot) of the nominal airframe
    slew_undisturbed: FloatArray  # (m,) largest abs(u_dot) of the nominal airframe without gusts
    # (N,) whether no zero lies in the right half plane and no state overflows
    stable: NDArray[np.bool_]
    uncertainty: float
    effected: Effected | None = None  # if it is None, the entries of `airframe` are uncertain
    seed: int = 1
    spread: Spread = UNIFORM  # deviations of the entries, and of the lags
    flown: Flown | None = None  # None if the loop does not fly an aircraft yet

    def timing_of(self, controller: ControllerConfig) -> LoopTiming:
        """Return lags, delay and period of the loop.

        The timing comes from the aircraft that flies. If no aircraft flies yet, the timing comes
        from the controller's parameters.
        """
        return loop_of(controller) if self.flown is None else self.flown.comparison.timing

    @property
    def differences(self) -> list[str]:
        """Sentences on how the flying aircraft differs from the controller's parameters."""
        flown = self.flown
        return [] if flown is None else [each.sentence for each in flown.comparison.differences]

    @property
    def Omega(self) -> FloatArray:  # noqa: N802 - the paper's name
        """Omega = C B of the nominal airframe, shape (m, m), SI."""
        return np.asarray(self.C @ self.B[0])


def manoeuvre(scenario: Scenario, airframe: Airframe) -> Manoeuvre:
    """Return the commands and gusts of a scenario, for the channels and gust axes of an airframe.

    A coordinated turn is kept if the airframe has both of its channels. The turn is then flown at
    the airframe's speed. Raises ParameterError if the scenario has no command for an output.
    """
    commands = scenario.reference_model
    for name in airframe.outputs:
        require(
            name in commands.outputs,
            f"{scenario.name}: reference_model.outputs",
            ", ".join(commands.outputs),
            f"{name} too: --scenario has them",
        )
    values = commands.model_dump(exclude_none=True)
    if set(airframe.outputs) != set(commands.outputs):
        require(
            "second_order" in values,
            f"{scenario.name}: reference_model",
            "linear",
            "second_order to leave channels out",
        )
        rows = [commands.outputs.index(name) for name in airframe.outputs]
        values["outputs"] = airframe.outputs
        for key, row in values["second_order"].items():
            values["second_order"][key] = [row[i] for i in rows]
        for key in SIGNALS:
            values[key] = {
                name: signal for name, signal in values[key].items() if name in airframe.outputs
            }
    turn = commands.coordinated_turn
    if turn is not None:
        present = {turn.bank_rate, turn.turn_rate} <= set(airframe.outputs) and airframe.speed > 0.0
        values["coordinated_turn"] = (
            turn.model_dump() | {"speed": airframe.speed} if present else None
        )
    gusts = {name: gust for name, gust in scenario.aircraft.gusts.items() if name in airframe.gusts}
    reference = ReferenceModelConfig.validate_mapping(values, "reference_model")
    return Manoeuvre(reference, gusts, scenario.flight.duration)


def study_airframe(
    airframe: Airframe,
    manoeuvre: Manoeuvre,
    uncertainty: float = 0.3,
    samples: int = 100,
    seed: int = 1,
    effected: Effected | None = None,
    spread: Spread = UNIFORM,
) -> Study:
    """Compute the rates of the ideal control along a manoeuvre, for N airframes.

    The first airframe is the published one, the others are uncertain airframes.

    The ideal control keeps y on y_m. The state is x = P y_m + N eta. Here eta = H' x are the
    coordinates of the state apart from the outputs (`output_coordinates`). Then

        eta_dot = H' (I - B Omega^-1 C) (A x + f(x, t)) + H' B Omega^-1 y_m_dot
            the zero dynamics, eta(0) = 0
        u* = Omega^-1 (y_m_dot - C (A x + f)),  x_dot = A x + f + B u*
        u*_dot = Omega^-1 (y_m_ddot - C (A x_dot + f_dot)),  f_dot along (1, x_dot)

    eta is integrated by Runge-Kutta in steps of 0.01 s, and u*_dot is evaluated at the steps. Only
    f_dot and the rate of the commands u_m, which y_m_ddot contains, are central differences over
    1e-5 s. All airframes have the f of the nominal one. With `effected`, the entries of its
    airframe are uncertain, and each B is then multiplied by its T. Raises ParameterError if Omega
    is singular, or if the nominal airframe has a zero in the right half plane, because Assumption 3
    fails then. Raises FlightEnded if the ideal flight of the nominal airframe diverges. An
    uncertain airframe that diverges is marked as unstable.
    """
    drawn_airframe = airframe if effected is None else effected.airframe
    A, B = nominal_and_sampled(drawn_airframe, uncertainty, samples, seed, spread)
    if effected is not None:
        B = np.asarray(B @ effected.T)
    zeros = [fastest_zero(*pair, airframe.matrix_c()) for pair in zip(A, B, strict=True)]
    stable = np.array(zeros) <= ZERO_REAL_PART
    require(
        bool(stable[0]),
        f"airframe {airframe.name}",
        f"a zero at {zeros[0]:.3g} 1/s",
        "none in the right half plane",
    )
    # The last column is the nominal airframe in still air: the speed of its gusts is 0.
    A = np.concatenate([A, A[:1]])
    B = np.concatenate([B, B[:1]])
    # An aircraft that overflows is refused or counted as unstable below, so NumPy must not warn.
    with np.errstate(over="ignore", invalid="ignore"):
        u_dot = _ideal_rates(
            _ideal_plant(airframe, manoeuvre, A, B), _references(manoeuvre, airframe)
        )
    is_finite = np.asarray(np.isfinite(u_dot).all(axis=(0, 2)))
    if not is_finite[[0, -1]].all():
        fastest = invariant_zeros(A[0], B[0], airframe.matrix_c()).real[0]
        cause = (
            f"a zero at {fastest:.3g} 1/s is too fast for steps of {STEP:g} s"
            if fastest * STEP < STABLE_STEP
            else "the motion beside the outputs diverges"
        )
        raise FlightEnded(
            f"{airframe.name} at {airframe.speed:g} m/s: no gains are found, because {cause} while "
            "y is held on y_m; at another speed it may not be"
        )
    stable &= is_finite[:-1]
    undisturbed, slew = (np.max(np.abs(u_dot[:, column]), axis=0) for column in (-1, 0))
    return Study(
        airframe=airframe,
        A=A[:-1],
        B=B[:-1],
        C=airframe.matrix_c(),
        gravity=airframe.matrix_gravity(),
        u_dot=u_dot[:, :-1],
        slew=slew,
        slew_undisturbed=undisturbed,
        stable=stable,
        uncertainty=uncertainty,
        effected=effected,
        seed=seed,
        spread=spread,
    )


class _IdealPlant(NamedTuple):
    """N aircraft with y held on y_m: eta_dot = project (A x + f) + follow y_m_dot."""

    A: FloatArray  # (N, n, n)
    B: FloatArray  # (N, n, m)
    C: FloatArray  # (m, n)
    inverse: FloatArray  # (N, m, m) Omega^-1
    project: FloatArray  # (N, n - m, n)
    follow: FloatArray  # (N, n - m, m)
    aircraft: Aircraft  # nonlinear part f of the aircraft
    P: FloatArray  # (n, m)
    N: FloatArray  # (n, n - m)


def _times(matrices: FloatArray, columns: FloatArray) -> FloatArray:
    """Multiply each of N matrices with one column: matrix k with `columns`[..., k].

    `columns` has the shape (n, ..., N).
    """
    return np.asarray(np.einsum("Nij,j...N->i...N", matrices, columns))


def _ideal_plant(
    airframe: Airframe, manoeuvre: Manoeuvre, A: FloatArray, B: FloatArray
) -> _IdealPlant:
    """Build the plants of a study. Raises ParameterError for a singular Omega."""
    C = airframe.matrix_c()
    P, N, H = output_coordinates(C)
    Omega: FloatArray = np.einsum("ij,Njk->Nik", C, B)
    require(
        float(np.abs(np.linalg.det(Omega)).min()) > 0.0,
        "Omega",
        "a singular C B",
        "inputs that move all outputs",
    )
    inverse = np.asarray(np.linalg.inv(Omega), dtype=np.float64)
    project = np.asarray(H.T @ (np.eye(len(P)) - B @ inverse @ C), dtype=np.float64)
    follow = np.asarray(H.T @ B @ inverse)
    aircraft = _columns(airframe, manoeuvre.gusts, len(A))
    return _IdealPlant(
        A=A, B=B, C=C, inverse=inverse, project=project, follow=follow, aircraft=aircraft, P=P, N=N
    )


def _ideal_rates(
    plant: _IdealPlant, references: tuple[FloatArray, FloatArray, FloatArray]
) -> FloatArray:
    """Compute u*_dot at the steps of the integration, shape (T, N, m)."""
    y_m, y_m_dot, y_m_ddot = references
    steps = (len(y_m) + 1) // 2
    count = max(COLUMNS // len(plant.A), 1)
    eta = np.zeros((plant.N.shape[1], len(plant.A)))
    u_dot = []
    for first in range(0, steps, count):
        last = min(first + count, steps - 1)
        halves = np.arange(2 * first, 2 * last + 1)
        path = _zero_dynamics(plant, eta, halves, y_m[halves], y_m_dot[halves])
        eta = path[:, -1]
        # each stretch begins at the instant at which the previous stretch ends
        places = halves[::2][: min(count, steps - first)]
        wanted = (y_m[places].T, y_m_dot[places].T, y_m_ddot[places].T)
        u_dot.append(_rates(plant, places, wanted, path[:, : len(places)]))
    return np.concatenate(u_dot)


def _zero_dynamics(
    plant: _IdealPlant,
    eta: FloatArray,
    halves: NDArray[np.int64],
    y_m: FloatArray,
    y_m_dot: FloatArray,
) -> FloatArray:
    """Integrate eta by Runge-Kutta and return it at every step, shape (n - m, steps, N).

    `eta` is the value at the first step. `y_m` and `y_m_dot` are given every half step, and
    `halves` has the numbers of these half steps. Every second half step is the beginning of a step.
    """
    t = (STEP / 2.0 * halves)[:, None, None]
    held = y_m @ plant.P.T
    forced = dynamics.f_time(t, dynamics.wind(t, plant.aircraft), plant.aircraft)
    forced = forced + np.einsum("Nij,tj->tiN", plant.A, held)
    forced = np.einsum("Nhi,tiN->thN", plant.project, forced) + np.einsum(
        "Nhm,tm->thN", plant.follow, y_m_dot
    )
    motion = plant.project @ plant.A @ plant.N

    def eta_dot(k: float, eta: Array, _: None, __: None) -> Array:
        x = held[round(k)][:, None] + plant.N @ eta
        of_state = _times(plant.project, dynamics.f_state(x, plant.aircraft))
        return STEP / 2.0 * (_times(motion, eta) + of_state + forced[round(k)])

    path = [eta]
    for k in range(0, len(halves) - 1, 2):
        path.append(rk4(eta_dot, k, path[-1], None, None, 2) if len(eta) else eta)
    return np.stack(path, axis=1)


def _rates(
    plant: _IdealPlant,
    halves: NDArray[np.int64],
    references: tuple[FloatArray, FloatArray, FloatArray],
    eta: FloatArray,
) -> FloatArray:
    """Compute u*_dot at T instants, shape (T, N, m).

    `halves` has the instants, as numbers of half steps. Each of the references has shape (m, T),
    and eta has shape (n - m, T, N).
    """
    y_m, y_m_dot, y_m_ddot = references
    instants = np.repeat(STEP / 2.0 * halves, eta.shape[-1])
    gusts = plant.aircraft.gusts
    gusts = gusts._replace(speed=np.tile(gusts.speed, len(halves)))
    aircraft = plant.aircraft._replace(gusts=gusts)

    def f(later: float, x: FloatArray) -> FloatArray:
        columns = x.reshape(len(x), -1)
        return np.asarray(dynamics.f(instants + later, columns, aircraft)).reshape(x.shape)

    x = (plant.P @ y_m)[..., None] + np.tensordot(plant.N, eta, 1)
    free = _times(plant.A, x) + f(0.0, x)
    rate = y_m_dot[..., None] - np.tensordot(plant.C, free, 1)
    x_dot = free + _times(plant.B, _times(plant.inverse, rate))
    near = 1e-5
    later, behind = (f(step, x + step * x_dot) for step in (near, -near))
    drift_dot = _times(plant.A, x_dot) + (later - behind) / (2.0 * near)
    u_dot = _times(plant.inverse, y_m_ddot[..., None] - np.tensordot(plant.C, drift_dot, 1))
    return np.moveaxis(u_dot, 0, -1)


def _references(
    manoeuvre: Manoeuvre, airframe: Airframe
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute y_m and its two derivatives every STEP / 2, for the stages of Runge-Kutta.

    The channels are in the airframe's order, and each result has shape (2 T - 1, m).
    """
    matrices = manoeuvre.reference.model()
    profile = manoeuvre.reference.profile()
    near = 1e-5
    step = model.stepper(STEP / 2.0, matrices)
    t = STEP / 2.0 * np.arange(2 * round(manoeuvre.duration / STEP) + 1)
    u_m = command(t, profile)
    half_later = command(t + STEP / 4.0, profile)
    u_m_dot = (command(t + near, profile) - command(t - near, profile)) / (2.0 * near)
    x = np.zeros((len(t), len(matrices.A_m)))
    for k, stages in enumerate(np.concatenate([u_m[:-1], half_later[:-1], u_m[1:]], axis=1)):
        x[k + 1] = model.step(x[k], stages, step)
    x_dot = model.x_m_dot(t, x.T, u_m.T, matrices)
    x_ddot = model.x_m_dot(t, x_dot, u_m_dot.T, matrices)  # the derivative of (2)
    places = [manoeuvre.reference.outputs.index(name) for name in airframe.outputs]
    y_m, y_m_dot, y_m_ddot = (model.output(z, matrices)[places].T for z in (x.T, x_dot, x_ddot))
    return y_m, y_m_dot, y_m_ddot


def _columns(airframe: Airframe, gusts: Mapping[str, Gust], columns: int) -> Aircraft:
    """Return an aircraft whose f takes several states at once, as columns, shape (n, columns).

    The gusts of the airframe act on all columns but the last.
    """
    gust_on = np.append(np.ones(columns - 1), 0.0)
    profiles = np.array([(gust.start, gust.speed, gust.length) for gust in gusts.values()]).reshape(
        -1, 3
    )
    start, speed, length = np.split(profiles, 3, axis=1)
    directions = [airframe.gust_direction(name) for name in gusts]
    return Aircraft(
        A=airframe.matrix_a(),
        B=airframe.matrix_b(),
        C=airframe.matrix_c(),
        gravity=airframe.matrix_gravity(),
        gust_direction=np.reshape(directions, (len(gusts), len(airframe.states))).T,
        gusts=Gusts(start, speed * gust_on, length),
        speed=np.array(airframe.speed),
    )
