# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The aircraft of a scenario as an environment of gymnasium: the agent takes the place of the controller, a tick a step."""

from typing import Any

import numpy as np

from aircraft_sim.simulator import Simulator
from flight_analysis.closed_loop.scenario import Scenario, as_scenario
from flight_campaign.statistics import LOSS_OF_TRACK_SCORE, score_units
from flight_core.arguments import as_number
from flight_core.installation import require_package
from flight_core.outcome import FlightEnded
from flight_core.parameters import require
from flight_core.rates import nanoseconds
from flight_core.vectors import FloatArray, select
from reference_model.reference import Reference

require_package("gymnasium")
import gymnasium  # noqa: E402 - an extra

UNLIMITED = 1.0  # SI, bound of an action that the controller does not limit: 57 deg, or the weight as thrust


class FlightEnv(gymnasium.Env[FloatArray, FloatArray]):
    """Simulator and reference model of a scenario; the agent gives u.

    Observation: y then y_m, shape (2 m,), SI, deviations from trim, outputs in the order of the controller; the newest y that
    has arrived. Action: u, shape (m,), SI, deviation from trim, in the order of the controller's inputs, within its limits.
    Reward of a step: -T sum_i abs(y_i - y_m_i) / unit_i, T the period of the controller and unit_i the unit of the score,
    10 mrad/s (p 20) or 0.1 m/s. An aircraft that diverges terminates the episode: LOSS_OF_TRACK_SCORE for each second left.
    The end of the flight's duration truncates the episode.

    Args:
        scenario: The aircraft, the reference model, and rate, channels and limits of the controller. Guidance is left out.
        uncertainty: Every reset draws noise, turbulence, and an aircraft whose A and B are off by up to this fraction, 0 to 1.
            None: every episode has the aircraft, the noise and the turbulence of the scenario.

    Raises ParameterError without gymnasium, for an aircraft of JSBSim with an uncertainty, and for an output without a score.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - as gymnasium declares it

    def __init__(self, scenario: Scenario, uncertainty: float | None = None) -> None:
        self.scenario = as_scenario(scenario)
        self._uncertainty = None if uncertainty is None else as_number(uncertainty, "uncertainty", 0.0, 1.0)
        controller, channels = scenario.controller, scenario.aircraft.channels()
        require(not (scenario.aircraft.is_jsbsim and uncertainty), "uncertainty", uncertainty, "0: JSBSim has no A and B")
        self.outputs, self.inputs = controller.outputs, controller.effectors
        self._units = score_units(self.outputs, channels.outputs)
        limits = controller.effector_limits()
        low, high = (
            np.where(np.isfinite(limit), limit, sign * UNLIMITED) for limit, sign in ((limits.lower, -1), (limits.upper, 1))
        )
        self.action_space = gymnasium.spaces.Box(low, high, dtype=np.float64)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2 * len(self.outputs),), np.float64)
        self._period = 1.0 / controller.rate
        self._ticks = nanoseconds(scenario.flight.duration) // nanoseconds(self._period)
        self._samples = round(scenario.aircraft.rate / controller.rate)
        self._references = round(scenario.reference_model.rate / controller.rate)

    @property
    def t(self) -> float:
        """Time of the present observation, s."""
        return self._k * self._period

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[FloatArray, dict[str, Any]]:
        """Trim at t = 0. A seed repeats the aircraft, the noise and the turbulence of an episode."""
        super().reset(seed=seed, options=options)
        self._simulator = Simulator(self._drawn().aircraft)
        self._reference, self._k = Reference(self.scenario.reference_model), 0
        self._y = np.zeros(len(self.outputs))
        self._advance(np.zeros(len(self.inputs)))
        return self._observed(), {}

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, dict[str, Any]]:
        """Hold u for a period. Raises ParameterError after the end, and ChannelError for an action that is not finite."""
        require(self._k < self._ticks, "step", "a step after the end of the flight", "reset() first")
        self._k += 1
        try:
            self._advance(np.asarray(action, dtype=np.float64))
        except FlightEnded as error:
            left = (self._ticks - self._k + 1) * self._period
            self._k = self._ticks
            return self._observed(), -LOSS_OF_TRACK_SCORE * left, True, False, {"outcome": str(error)}
        observed = self._observed()
        e = observed[: len(self._y)] - observed[len(self._y) :]
        return observed, -self._period * float(np.sum(np.abs(e) / self._units)), False, self._k >= self._ticks, {}

    def _drawn(self) -> Scenario:
        """The scenario of the episode, drawn by the generator of the environment."""
        if self._uncertainty is None:
            return self.scenario
        number, seed = (int(value) for value in self.np_random.integers(0, 2**31, 2))
        aircraft: dict[str, Any] = {"sensors": self.scenario.aircraft.sensors.model_dump() | {"seed": seed}}
        if self._uncertainty:
            aircraft["uncertainty"] = {"A": self._uncertainty, "B": self._uncertainty, "number": number}
        if self.scenario.aircraft.turbulence is not None:
            aircraft["turbulence"] = self.scenario.aircraft.turbulence.model_dump() | {"seed": seed}
        return self.scenario.vary(aircraft=aircraft)

    def _advance(self, u: FloatArray) -> None:
        """The aircraft to the present tick, u held since the last tick."""
        held = select(self._simulator.inputs, self.inputs, u)
        for number in range(max(self._samples * (self._k - 1) + 1, 0), self._samples * self._k + 1):
            for sample in self._simulator.sample(number, held):
                self._y = select(self.outputs, self._simulator.outputs, sample.value)

    def _observed(self) -> FloatArray:
        y_m = self._reference.sample(self._references * self._k)
        return np.concatenate([self._y, select(self.outputs, self.scenario.reference_model.outputs, y_m)])
