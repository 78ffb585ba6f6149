# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters of steering: the limits and gains of guidance for an aircraft.

A parameter that a file leaves out follows by rule from the reference model, the throttle and the
speeds.
"""

import math
from typing import Annotated, Any, Literal

from flight_core.channels import RATES_AND_SPEED, vertical
from flight_core.fields import Field
from flight_core.parameters import (
    Names,
    NodeConfig,
    NonNegative,
    Number,
    Numbers,
    Positive,
    Positives,
    Rate,
    RateOrZero,
)
from flight_core.units import GRAVITY
from flight_guidance import reach
from flight_guidance.guidance_state import MULTICOPTER, CommandLimits, MulticopterParams
from flight_guidance.multicopter import multicopter_rules
from flight_guidance.steering import protection
from flight_guidance.steering.attitude import (
    BANDWIDTH_RATIO,
    HEADING_RATIO,
    AttitudeParams,
    load_slope,
)
from flight_guidance.steering.lateral import PathParams, least_period, least_radius
from flight_guidance.steering.vertical import VerticalParams, path_lag

BY_RULE = ("outputs", "natural_frequency", "speed", "throttle_authority", "roll_authority")
FLOOR_FRACTION = 0.8
"""Ratio of the speed floor to the trim speed if no stall speed is known."""

FASTEST_ROLL = 0.35
"""Largest roll rate by rule, rad/s: 20 deg/s."""

ALTITUDE_GAIN = 0.2
"""Gain k_h, 1/s, for an aircraft whose flight path follows the pitch within two seconds."""

ALPHA_TIME = 2.0
"""Time constant of the angle of attack, s, for such an aircraft."""

TURN_LEAD = 2.4
"""r leads the bank by this number divided by the natural frequency of r in the reference model. 1.8
is for the lag of the model at a damping of 0.9, the rest for the lag that the sideslip causes when
the osprey rolls."""

MODEL_LAG = 2.0
"""If r does not lead the bank, a turn lags the bank by this number divided by the natural frequency
of r in the reference model, or of p without a rudder. This is the lag of the reference model at a
damping of 1."""

SPEED_STEP = 1.0
"""The command of the airspeed changes by this much, m/s, in no less than BANDWIDTH_RATIO / w, where
w is the natural frequency of V in the reference model."""

RUDDERLESS = 1.5
"""Factor on the period of path following without a rudder, because then no lead compensates the lag
of the turn. With the factor 1, the X8 had a limit cycle, and with 1.4 it had none."""

STEEPEST = 0.1
"""Largest climb and sink rate by rule, as a fraction of the trim speed."""


class SteeringConfig(NodeConfig):
    """Parameters of steering, from which the constants in the equations of guidance follow."""

    rate: Rate = Field(default=50.0, description="rate at which u_m is published, Hz")
    start_time: float = Field(
        default=0.0,
        ge=-1,
        le=1e10,
        description="system time of t = 0, s since the epoch; 0: at once; -1: by topic `start`",
    )
    y_rate: RateOrZero = Field(default=0.0, description="rate of y in lockstep, Hz")
    authority_rate: RateOrZero = Field(
        default=0.0, description="rate of `authority`, Hz; 0 without a learner"
    )
    outputs: Names = Field(default=RATES_AND_SPEED, description="commands u_m, in any order")
    natural_frequency: Positives = Field(
        description="natural frequencies of the reference model, rad/s; a run has them in its"
        " `parameters.yaml`"
    )
    speed: Positive = Field(description="trim speed V0, m/s; airspeed is speed + V")
    throttle_authority: tuple[Positive, ...] = Field(
        default=(), description="deceleration and acceleration by throttle from trim, m/s^2"
    )
    roll_authority: Positive | None = Field(
        default=None, description="roll acceleration of full aileron, rad/s^2"
    )
    stall_speed: Positive | None = Field(default=None, description="V_s, true airspeed, m/s")
    speed_limit: Positive | None = Field(default=None, description="largest true airspeed, m/s")
    ceiling: Number | None = Field(default=None, description="largest altitude, m, as in `pose`")
    altitude_floor: Number | None = Field(
        default=None, description="least altitude, m, as in `pose`"
    )
    wind: NonNegative = Field(default=0.0, description="largest wind, m/s")
    drag: Positive | None = Field(
        default=None,
        description="for a multicopter: g tan(tilt) / V in steady flight, 1/s; none: an airplane",
    )

    bank: Annotated[float, Field(gt=0, le=math.radians(60.0))] = Field(
        default=math.radians(30.0), description="largest bank phi_max, rad"
    )
    roll_rate: Positive | None = Field(
        default=None,
        description="largest rate of the bank p_max, rad/s",
    )
    load: Positive = Field(default=0.3, description="largest change of the load factor by pitch")
    pitch: Annotated[Numbers, Field(min_length=2, max_length=2)] = Field(
        default=(math.radians(-15.0), math.radians(25.0)),
        description="least and largest pitch, rad",
    )
    climb: Positive | None = Field(default=None, description="largest climb rate, m/s")
    sink: Positive | None = Field(default=None, description="largest sink rate, m/s")
    acceleration: Positive = Field(
        default=1.0, description="permitted vertical acceleration, m/s^2"
    )
    altitude_gain: Positive | None = Field(
        default=None, description="k_h, climb rate per altitude error, 1/s"
    )
    alpha_time: Positive | None = Field(
        default=None, description="time constant of the estimated angle of attack, s"
    )
    sideslip_gain: NonNegative | None = Field(
        default=None, description="k_beta, yaw rate per sideslip, 1/s, with beta in `pose`"
    )
    period: Positive | None = Field(default=None, description="period of path following, s")
    damping: Annotated[float, Field(ge=0.5, le=1.0)] = Field(
        default=0.8, description="damping ratio of path following"
    )
    capture: Annotated[float, Field(gt=0, le=math.pi / 2.0)] = Field(
        default=math.radians(60.0), description="largest angle at which a path is approached, rad"
    )
    radius: Positive | None = Field(
        default=None, description="radius of fillets and of the last orbit, m"
    )
    profile: Literal["slope", "step"] = Field(
        default="slope", description="altitude changes along a leg, or at its start"
    )
    max_age: Annotated[float, Field(gt=0, le=1e6)] = Field(
        default=0.2, description="age at which y and pose are stale, s"
    )
    hold: Annotated[float, Field(ge=0, le=1e6)] = Field(
        default=10.0, description="how long dead reckoning replaces a stale pose, s"
    )
    origin: Annotated[Numbers, Field(min_length=3, max_length=3)] | None = Field(
        default=None,
        description="latitude, longitude (deg) and height above WGS84 (m) of the origin",
    )

    def by_rule(self) -> list[tuple[str, Any]]:
        """Return parameters that can come from other sections of the scenario, with values.

        Parameters without a value are left out.
        """
        return [(name, getattr(self, name)) for name in BY_RULE if getattr(self, name)]

    def _floor(self) -> float:
        if self.stall_speed is None:
            return FLOOR_FRACTION * self.speed
        return protection.speed_floor(self.stall_speed)

    def _stall_speed(self) -> float:
        """Return the stall speed V_s, m/s. If it is unknown, derive it from the speed floor."""
        return self._floor() / protection.FLOOR

    def _largest_speed(self) -> float:
        return self.speed_limit or protection.FASTEST * self.speed

    def altitudes(self) -> tuple[float, float]:
        """Return the least and the largest altitude, m."""
        return (
            -math.inf if self.altitude_floor is None else self.altitude_floor,
            math.inf if self.ceiling is None else self.ceiling,
        )

    def largest_roll_rate(self) -> float:
        """Return the largest roll rate p_max, rad/s.

        By rule it is FASTEST_ROLL, but less if 0.4 w p_max would exceed a third of the authority.
        0.4 w p_max is the largest p_m_dot after a step, and w is the natural frequency of the
        reference for p.
        """
        frequency = self._frequency()["p"]
        authority = math.inf if self.roll_authority is None else self.roll_authority
        return self.roll_rate or min(FASTEST_ROLL, reach.roll_rate(authority, frequency))

    def k_beta(self) -> float:
        """Compute k_beta = min(0.5, k_chi V0 d / s), 1/s.

        A lateral gust of s = 1.5 m/s then turns a held heading by d = 1 deg.
        """
        if self.sideslip_gain is not None:
            return self.sideslip_gain
        return min(0.5, self._k_chi() * self.speed * math.radians(1.0) / 1.5)

    def _k_chi(self) -> float:
        return self._frequency()["p"] / BANDWIDTH_RATIO / HEADING_RATIO

    def least_period(self) -> float:
        """Return the least period of path following, s."""
        factor = 1.0 if "r" in self.outputs else RUDDERLESS
        return factor * least_period(self.speed, self.bank, self.largest_roll_rate())

    def least_radius(self) -> float:
        """Return the least radius of fillets and orbits, m."""
        return least_radius(self.speed, self.wind, self.bank)

    def climb_limits(self) -> tuple[float, float]:
        """Return the largest climb and sink rate, m/s.

        By rule the climb rate is 0.7 a V0 / g and the sink rate 0.5 a V0 / g, where a is the
        authority of the throttle. Both are at most a tenth of V0. The rest of the throttle holds
        the airspeed. If this rest is too small, `protection.climb_range` reduces the climb.
        """
        steepest = STEEPEST * self.speed
        down, up = self.throttle_authority or (math.inf, math.inf)
        climb, sink = reach.climb_rates(down, up, self.speed)
        return self.climb or min(climb, steepest), self.sink or min(sink, steepest)

    def guidance_constants(self) -> dict[str, Any]:
        """Return the constants in the equations of guidance, by field of `GuidanceParams`."""
        if self.drag is not None:
            return self._multicopter_constants(self.drag)
        frequency = self._frequency()
        lowest, highest = self.altitudes()
        climb, sink = self.climb_limits()
        # without a rudder the turn follows the bank
        yaw = frequency.get("r", frequency["p"])
        lead = TURN_LEAD / yaw if "r" in frequency else 0.0
        turn = GRAVITY * math.tan(self.bank) / self.speed
        roll_rate = self.largest_roll_rate()
        slew = {
            "p": frequency["p"] * roll_rate,
            "q": frequency["q"] * (self.load * GRAVITY / self.speed + turn * math.sin(self.bank)),
            "r": yaw * turn,
            "V": SPEED_STEP * frequency["V"] / BANDWIDTH_RATIO,
        }
        return {
            "k_chi": self._k_chi(),
            "attitude": AttitudeParams(
                k_phi=frequency["p"] / BANDWIDTH_RATIO,
                k_theta=frequency["q"] / BANDWIDTH_RATIO,
                roll_rate=roll_rate,
                load=self.load,
                # until the first step, at which the angle of attack in trim is known
                n_alpha=load_slope(0.0),
                k_beta=self.k_beta(),
                turn_lead=lead,
            ),
            "vertical": self._vertical(climb, sink),
            "path": PathParams(self.period or self.least_period(), self.damping, self.capture),
            "limits": CommandLimits(
                bank=self.bank,
                least_pitch=self.pitch[0],
                largest_pitch=self.pitch[1],
                floor=self._floor(),
                stall_speed=self._stall_speed(),
                radius=self.least_radius(),
                largest_speed=self._largest_speed(),
                lowest=lowest,
                highest=highest,
            ),
            "slew": tuple(slew[name] for name in self.outputs),
            "turn_lag": max(MODEL_LAG / yaw - lead, 0.0),
        }

    def _frequency(self) -> dict[str, float]:
        """Return the natural frequency of the reference model by output, rad/s."""
        return dict(zip(self.outputs, self.natural_frequency, strict=True))

    def _gains(self, drag: float) -> MulticopterParams:
        return multicopter_rules.gains(
            self._frequency(), self.bank, drag, self.roll_authority or math.inf
        )

    def _multicopter_constants(self, drag: float) -> dict[str, Any]:
        """Return the constants for a multicopter, by field of `GuidanceParams`."""
        gains = self._gains(drag)
        frequency = self._frequency()
        lowest, highest = self.altitudes()
        climbs = vertical(self.outputs)
        rates = {"p": gains.tilt_rate, "q": gains.tilt_rate, "r": gains.yaw_rate}
        rates[climbs] = self.acceleration / frequency[climbs]
        climb = self.climb or multicopter_rules.CLIMB * self.speed
        sink = self.sink or multicopter_rules.SINK * self.speed
        gain = self.altitude_gain or frequency[climbs] / BANDWIDTH_RATIO
        return {
            "k_chi": 0.0,
            "attitude": AttitudeParams(
                k_phi=gains.k_tilt,
                k_theta=gains.k_tilt,
                roll_rate=gains.tilt_rate,
                load=0.0,
                n_alpha=0.0,
                k_beta=0.0,
            ),
            "vertical": VerticalParams(
                k_h=gain, acceleration=self.acceleration, climb=climb, sink=sink, alpha_time=0.0
            ),
            "path": PathParams(0.0, self.damping, self.capture),
            "limits": CommandLimits(
                bank=self.bank,
                least_pitch=-self.bank,
                largest_pitch=self.bank,
                floor=0.0,
                stall_speed=0.0,
                radius=0.0,
                largest_speed=self._largest_speed(),
                lowest=lowest,
                highest=highest,
            ),
            "slew": tuple(frequency[name] * rates[name] for name in self.outputs),
            "channels": MULTICOPTER,
            "multicopter": gains,
        }

    def _vertical(self, climb: float, sink: float) -> VerticalParams:
        """Return the parameters of the altitude loop.

        T is the time constant of the angle of attack's estimate. If the lag T_L of the flight path
        is known, the rule requires T >= T_L and k_h <= 0.4 / T_L. The flight path then has a
        damping of at least 0.5, and the altitude a gain margin of 2.5 by Routh's criterion.
        """
        lag = path_lag(self.stall_speed, self.speed) if self.stall_speed else 0.0
        gain = min(ALTITUDE_GAIN, 0.4 / lag) if lag else ALTITUDE_GAIN
        time = self.alpha_time or max(ALPHA_TIME, lag)
        return VerticalParams(
            k_h=self.altitude_gain or gain,
            acceleration=self.acceleration,
            climb=climb,
            sink=sink,
            alpha_time=time,
        )
