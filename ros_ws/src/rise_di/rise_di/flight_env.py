# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Offer the aircraft of a scenario as environments of gymnasium.

The agent takes the place of the controller, and a step is a tick of it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aircraft_sim.uncertainty import gust_directions, sampled_matrices
from flight_analysis.closed_loop.scenario import Scenario, as_scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.stations import (
    AircraftStation,
    FlightLoop,
    ReferenceStation,
    Topics,
)
from flight_campaign.batch.campaign_course import HOLD, build_course
from flight_campaign.statistics import LOSS_OF_TRACK_SCORE, score_units
from flight_core.arguments import as_count, as_number
from flight_core.installation import require_package
from flight_core.known_keys import unknown_keys
from flight_core.outcome import End, FlightEnded, Outcome
from flight_core.parameters import require
from flight_core.plausible import largest
from flight_core.rates import nanoseconds
from flight_core.vectors import FloatArray, StampedVector, as_array
from rise_di.environment_ids import register

require_package("gymnasium")
import gymnasium  # noqa: E402 - an extra

# Bound of an action that the controller does not limit, SI. It is 57 deg, or a thrust equal to the
# weight.
UNLIMITED = 1.0


@dataclass(frozen=True, kw_only=True)
class _Channels:
    """The spaces of actions and observations of an aircraft, and the units of the score."""

    action: gymnasium.spaces.Space[FloatArray]
    observation: gymnasium.spaces.Space[FloatArray]
    units: FloatArray  # unit of the error of each output, (m,)


def _channels(scenario: Scenario) -> _Channels:
    """Return the spaces of actions u and of observations, which are y followed by y_m.

    u has the controller's limits. An aircraft beyond the bounds of y and y_m is lost.
    """
    controller = scenario.controller
    limits = controller.effector_limits()
    low, high = (
        np.where(np.isfinite(limit), limit, sign * UNLIMITED)
        for limit, sign in ((limits.lower, -1), (limits.upper, 1))
    )
    beyond = np.tile(largest(controller.outputs), 2)
    return _Channels(
        action=gymnasium.spaces.Box(low, high, dtype=np.float64),
        observation=gymnasium.spaces.Box(-beyond, beyond, dtype=np.float64),
        units=score_units(controller.outputs, scenario.aircraft.channels().outputs),
    )


def _without_models(scenario: Scenario) -> Scenario:
    """Return the scenario with only the law itself, which the agent replaces.

    Feedforward, observer, schedule and learner are left out, because an agent does not use them.
    """
    models = ("feedforward", "observer", "schedule", "learn")
    return scenario.vary(
        controller={
            key: None for key in models if getattr(scenario.controller, key, None) is not None
        }
    )


BY_TICK = frozenset(
    {
        *("airframe", "rate", "step", "inertial_coupling", "kinematics", "wind"),
        *(f"gusts.*.{key}" for key in ("start", "speed", "length", "every")),
        *(f"turbulence.{key}" for key in ("altitude", "wind", "sigma", "rotary", "seed")),
        *(f"bias.*.{key}" for key in ("start", "value", "rise")),
        *(f"sines.*.{key}" for key in ("amplitude", "frequency", "phase")),
        *(f"actuators.{key}" for key in ("lag", "lower", "upper", "rate", "dead_zone", "faults")),
        "actuators.delay",
        *(f"sensors.{key}" for key in ("bias", "drift", "noise", "quantisation", "seed")),
        *(f"uncertainty.{key}" for key in ("A", "B", "seed", "number", "entries", "parts")),
        *("uncertainty.distribution", "uncertainty.wind"),
        *(f"start.{key}" for key in ("north", "east", "heading")),
        *(f"pose.{key}" for key in ("rate", "delay", "bias", "drift", "noise", "seed")),
        *("max_age", "hold", "ramp"),
        *("start_time", "lockstep", "control_rate", "duration", "recorded"),
    }
)
"""Keys of the aircraft for which samples can be skipped. With only these keys, the flight and the
sample at a tick do not depend on whether the samples before this tick were measured."""


def _is_newest_last(scenario: Scenario) -> bool:
    """Return whether it suffices to measure the last sample of y before each tick.

    This suffices if the section of the aircraft sets only keys in BY_TICK, and if the controller
    has no vanes. Otherwise each sample must be measured.
    """
    aircraft = scenario.aircraft
    return not unknown_keys(aircraft, BY_TICK) and not scenario.controller.vanes


def _actions(values: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Return the inputs of a step as an array.

    Raises ParameterError if the shape is wrong, or if a value is not finite.
    """
    expected = f"finite numbers of shape {shape}"
    u = as_array(values, "action", expected)
    require(u.shape == shape and bool(np.isfinite(u).all()), "action", f"shape {u.shape}", expected)
    return u


class FlightEnv(gymnasium.Env[FloatArray, FloatArray]):
    """The simulator and the reference model of a scenario, for an agent that gives u.

    The observation is y followed by y_m, shape (2 m,), as deviations from trim in SI. The outputs
    are in the order of the controller, and y is the newest sample that has arrived.

    The action is u, shape (p,), as a deviation from trim in SI. It is in the order of the
    controller's inputs, or of the effectors of its allocation, and within their limits.

    The reward of a step is -T sum_i abs(y_i - y_m_i) / unit_i, with the period T of the controller.
    The unit unit_i of the score is 10 mrad/s (20 mrad/s for p) or 0.1 m/s. If the aircraft
    diverges, the episode terminates and costs LOSS_OF_TRACK_SCORE for each second that is left. The
    end of the flight's duration truncates the episode.

    `info` has the error y - y_m, shape (m,). At the end it also has the outcome, as a sentence.

    Args:
        scenario: The aircraft, the reference model, and the rate, the channels and the limits of
            the controller. Guidance is left out.
        uncertainty: A fraction, 0 to 1, or None. With a fraction, every reset draws noise,
            turbulence, and an aircraft whose A and B are off by up to this fraction. The entries
            and the distribution come from `aircraft.uncertainty`. With None, every episode has the
            aircraft, the noise and the turbulence of the scenario.
        render_mode: With "ansi", `render` returns a line of t, y and y_m. With None, it returns
            nothing.

    Raises:
        ParameterError: gymnasium is missing, an aircraft of JSBSim has an uncertainty, or an output
            has no score.

    Examples:
        >>> env = rise_di.FlightEnv(rise_di.find_scenario("osprey_servo", duration=0.1))
        >>> observation, info = env.reset(seed=1)
        >>> observation, reward, terminated, truncated, info = env.step(np.zeros(4))
        >>> observation.shape
        (8,)
    """

    metadata = {"render_modes": ["ansi"]}  # noqa: RUF012 - as gymnasium declares it

    def __init__(
        self,
        scenario: Scenario,
        uncertainty: float | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.scenario = as_scenario(scenario)
        require(render_mode in (None, "ansi"), "render_mode", render_mode, "ansi or None")
        self.render_mode = render_mode
        self._uncertainty = (
            None if uncertainty is None else as_number(uncertainty, "uncertainty", 0.0, 1.0)
        )
        controller = scenario.controller
        require(
            not (scenario.aircraft.is_jsbsim and uncertainty),
            "uncertainty",
            uncertainty,
            "0: JSBSim has no A and B",
        )
        self.outputs = controller.outputs
        self.inputs = controller.effectors
        channels = _channels(scenario)
        self.action_space = channels.action
        self.observation_space = channels.observation
        self._units = channels.units
        self.metadata = {**self.metadata, "render_fps": controller.rate}
        self._period = 1.0 / controller.rate
        self._period_ns = nanoseconds(self._period)
        self._k = -1
        self._ticks = nanoseconds(scenario.flight.duration) // self._period_ns

    @property
    def t(self) -> float:
        """Time of the present observation, s. Raises ParameterError before the first episode."""
        require(self._k >= 0, "t", "no episode", "reset() first")
        return self._k * self._period

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Put the aircraft into trim at t = 0.

        The same seed gives the same aircraft, noise and turbulence.

        Args:
            seed: Seed of the draws. With None the draws go on.
            options: Not used, but required by gymnasium.

        Returns:
            The observation, shape (2 m,), SI, and `info`.
        """
        super().reset(seed=seed, options=options)
        self._y = np.zeros(len(self.outputs))
        self._topics = Topics(recorded=False)
        self._topics.advertise("u", self.inputs)
        self._topics.subscribe("y", self._take_y, self.outputs)
        self._topics.subscribe("y_m", self._take_y_m, self.outputs)
        reference = ReferenceStation(self.scenario.reference_model, self._topics, self._period_ns)
        every_ns = self._period_ns if _is_newest_last(self.scenario) else None
        aircraft = AircraftStation(self._drawn().aircraft, self._topics, every_ns)
        self._loop = FlightLoop([reference, aircraft])
        self._k = 0
        self._loop.run(0)
        return self._observed(), {"error": self._error()}

    def render(self) -> str | None:
        """Return a line of text with t, y and y_m, SI, in the mode "ansi", else None."""
        if self.render_mode is None:
            return None
        rows = zip(self.outputs, self._y, self._y_m, strict=True)
        texts = [f"{name} {y:+.4f} of {y_m:+.4f}" for name, y, y_m in rows]
        return f"t {self.t:.2f} s  {'  '.join(texts)}\n"

    def _take_y(self, sample: StampedVector, _t_ns: int) -> None:
        self._y = sample.value

    def _take_y_m(self, sample: StampedVector, _t_ns: int) -> None:
        self._y_m = sample.value

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Hold u for a period.

        Args:
            action: u, shape (p,), SI, deviation from trim.

        Returns:
            The observation (2 m,), the reward, whether the episode is terminated or truncated, and
            `info`.

        Raises:
            ParameterError: No episode runs, or the action is not p finite numbers.
        """
        require(0 <= self._k < self._ticks, "step", "a step outside an episode", "reset() first")
        u = _actions(action, (len(self.inputs),))
        self._topics.publish(
            "u", StampedVector(self._k * self._period_ns, u), self._k * self._period_ns
        )
        self._k += 1
        try:
            self._loop.run(self._k * self._period_ns)
        except FlightEnded as error:
            remaining = (self._ticks - self._k + 1) * self._period
            self._k = self._ticks
            return (
                self._observed(),
                -LOSS_OF_TRACK_SCORE * remaining,
                True,
                False,
                {"error": self._error(), "outcome": str(error)},
            )
        e = self._error()
        is_over = self._k >= self._ticks
        info: dict[str, Any] = {"error": e}
        if is_over:
            info["outcome"] = str(Outcome(End.COMPLETED))
        reward = -self._period * float(np.sum(np.abs(e) / self._units))
        return self._observed(), reward, False, is_over, info

    def _error(self) -> FloatArray:
        """Return the error y - y_m, (m,)."""
        return self._y - self._y_m

    def _drawn(self) -> Scenario:
        """Return the episode's scenario, drawn by the generator of the environment."""
        if self._uncertainty is None:
            return self.scenario
        number, seed = (int(value) for value in self.np_random.integers(0, 2**31, 2))
        aircraft: dict[str, Any] = {
            "sensors": self.scenario.aircraft.sensors.model_dump() | {"seed": seed}
        }
        if not self.scenario.aircraft.is_jsbsim:
            uncertainty = {"A": self._uncertainty, "B": self._uncertainty, "number": number}
            aircraft["uncertainty"] = self.scenario.aircraft.uncertainty.model_dump() | uncertainty
        if self.scenario.aircraft.turbulence is not None:
            aircraft["turbulence"] = self.scenario.aircraft.turbulence.model_dump() | {"seed": seed}
        return self.scenario.vary(aircraft=aircraft)

    def _observed(self) -> FloatArray:
        space = self.observation_space
        observed = np.concatenate([self._y, self._y_m])
        return np.clip(observed, space.low, space.high)  # type: ignore[attr-defined]


class FlightVectorEnv(gymnasium.vector.VectorEnv[FloatArray, FloatArray, NDArray[Any]]):
    """N uncertain aircraft of a scenario that follow the same commands, in compiled code.

    Observations have the shape (N, 2 m), actions (N, p) and rewards (N,), with rows like those of
    FlightEnv. The aircraft share the commands, the wind and the noise of the sensors, and their
    flights end together. Every `reset` draws N aircraft. If an aircraft diverges, it terminates.
    The next step then starts the same aircraft from trim, at the present time of the flight. The
    step after the end of the flight draws N aircraft again, as in `AutoresetMode.NEXT_STEP`.

    Args:
        scenario: As for FlightEnv, but the airframe must have matrices.
        num_envs: Number N of aircraft.
        uncertainty: Largest relative deviation of the entries of A and B of an aircraft, 0 to 1.

    Raises:
        ParameterError: gymnasium is missing, or a campaign cannot fly the scenario, for example an
            aircraft of JSBSim.

    Examples:
        >>> env = rise_di.FlightVectorEnv(rise_di.find_scenario("osprey_servo", duration=0.1), 2)
        >>> observations, info = env.reset(seed=1)
        >>> observations.shape
        (2, 8)
    """

    metadata = {"render_modes": [], "autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP}  # noqa: RUF012 - as above

    def __init__(self, scenario: Scenario, num_envs: int, uncertainty: float = 0.3) -> None:
        from flight_campaign.batch import batch, batch_matrices  # noqa: PLC0415 - JAX, a second to load

        self.scenario = as_scenario(scenario)
        self.num_envs = as_count(num_envs, "num_envs", 1)
        self._uncertainty = as_number(uncertainty, "uncertainty", 0.0, 1.0)
        plain = _without_models(self.scenario)
        self._course = build_course(plain)
        self._vehicle = batch.vehicle(plain)
        self._assemble = batch_matrices.assemble
        self._stepper = batch.FleetStepper
        channels = _channels(self.scenario)
        self.single_action_space = channels.action
        self.single_observation_space = channels.observation
        self.action_space = gymnasium.vector.utils.batch_space(
            self.single_action_space, self.num_envs
        )
        self.observation_space = gymnasium.vector.utils.batch_space(
            self.single_observation_space, self.num_envs
        )
        self._units = channels.units[:, None]
        self._largest = largest(scenario.controller.outputs)[:, None]
        self._k = 0
        self._last = 0
        self._y, self._ended = (
            np.zeros((len(self._units), self.num_envs)),
            np.zeros(self.num_envs, dtype=bool),
        )

    @property
    def t(self) -> float:
        """Time of the present observations, s. Raises ParameterError before the first episode."""
        require(self._last > 0, "t", "no episode", "reset() first")
        return self._k * self._course.period

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
        """Draw N aircraft in trim at t = 0. The same seed draws the same aircraft.

        Args:
            seed: Seed of the draws. With None the draws go on.
            options: Not used, but required by gymnasium.

        Returns:
            The observations, shape (N, 2 m), SI, and an empty mapping.

        Raises:
            ParameterError: `seed` is a list or negative.
        """
        seed = None if seed is None else as_count(seed, "seed", 0)
        super().reset(seed=seed, options=options)
        return self._begin(), {}

    def step(
        self, actions: FloatArray
    ) -> tuple[FloatArray, FloatArray, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Hold u for a period.

        Args:
            actions: u, shape (N, p), SI, deviations from trim.

        Returns:
            The observations (N, 2 m), the rewards (N,), which flights are terminated (N,) or
            truncated (N,), and `info`.

        Raises:
            ParameterError: No episode has begun, the shape is wrong, or a value is not finite.
        """
        u = _actions(actions, (self.num_envs, len(self._vehicle.inputs)))
        require(self._last > 0, "step", "a step before an episode", "reset() first")
        none = np.zeros(self.num_envs, dtype=bool)
        if self._last == self._k:
            return self._begin(), np.zeros(self.num_envs), none, none, {}
        self._flights.advance(u.T)
        self._k += 1
        started = self._ended
        if started.any():
            self._flights.restart(started)
            self._y = np.where(started, 0.0, self._y)
        y, y_m = self._sense()
        self._ended = ~self._flights.bounded | (np.abs(y) > self._largest).any(axis=0)
        remaining = (self._last - self._k + 1) * self._course.period
        reward = -self._course.period * np.sum(np.abs(y - y_m) / self._units, axis=0)
        reward = np.where(
            self._ended, -LOSS_OF_TRACK_SCORE * remaining, np.where(started, 0.0, reward)
        )
        truncated = ~self._ended if self._k == self._last else none
        info = {"error": (y - y_m).T, "_error": np.ones(self.num_envs, dtype=bool)}
        return self._observed(y, y_m), reward, self._ended, truncated, info

    def _begin(self) -> FloatArray:
        """Draw N aircraft, put them into trim, and return the observations."""
        aircraft = self.scenario.aircraft
        part = self._uncertainty
        airframe = aircraft.nominal_airframe()
        seed = int(self.np_random.integers(0, 2**31))
        A, B = sampled_matrices(
            airframe, part, part, seed, 0, self.num_envs, aircraft.uncertainty.spread()
        )
        directions = gust_directions(airframe, A, aircraft.uncertainty.wind)
        vehicle = self._assemble(A, B, aircraft.plant(), self._course, gust_directions=directions)
        self._flights = self._stepper(vehicle, self._vehicle, self._course)
        self._k = 0
        self._last = self._flights.ticks - 1
        self._y, self._ended = np.zeros_like(self._y), np.zeros_like(self._ended)
        return self._observed(*self._sense())

    def _sense(self) -> tuple[FloatArray, FloatArray]:
        """Return the newest y that has arrived, and y_m."""
        y, _ = self._flights.sense()
        if self._course.segments.phase[self._k] != HOLD:
            self._y = y
        return self._y, np.broadcast_to(self._course.segments.y_m[self._k][:, None], y.shape)

    def _observed(self, y: FloatArray, y_m: FloatArray) -> FloatArray:
        # The NaN of a diverged aircraft is replaced by the bound.
        known = np.nan_to_num(np.concatenate([y, y_m]), nan=np.inf)
        beyond = np.tile(self._largest, (2, 1))
        return np.asarray(np.clip(known, -beyond, beyond).T)


def make_flight(
    scenario: str = "osprey_servo", duration: float | None = None, **options: Any
) -> FlightEnv:
    """Make the environment rise_di/Flight-v0 of a scenario, with the options of FlightEnv."""
    return FlightEnv(find_scenario(scenario, duration), **options)


def make_flights(
    num_envs: int,
    scenario: str = "osprey_servo",
    duration: float | None = None,
    **options: Any,
) -> FlightVectorEnv:
    """Make N aircraft of rise_di/Flight-v0, with the options of FlightVectorEnv."""
    return FlightVectorEnv(find_scenario(scenario, duration), num_envs, **options)


register()
