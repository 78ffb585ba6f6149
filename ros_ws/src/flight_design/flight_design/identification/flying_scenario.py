# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write a scenario for an aircraft with identified channels: gains, commands and margins."""

from typing import Any, NamedTuple

import numpy as np
import yaml

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.uncertainty import nominal_and_sampled
from autopilot_bridge.params import ChannelMap
from flight_analysis.linear_loop.loop_margins import (
    LoopMargins,
    law_order,
    linear_loop,
    loop_margins,
)
from flight_core.outcome import Refusal
from flight_core.vectors import FloatArray
from flight_design.gains import gain_selection, gain_yaml, ideal_control
from flight_design.gains.feedforward_model import with_feedforward
from flight_design.gains.first_scenario import (
    Channel,
    FirstCommands,
    first_commands,
    scenario_text,
    unit_gains,
)
from flight_design.gains.gain_conditions import bandwidths
from flight_design.gains.gain_selection import LoopSetting
from flight_design.gains.ideal_control import ChannelPairing, Manoeuvre, Study
from flight_design.gains.requirement import (
    REQUIREMENT,
    Candidate,
    Requirement,
    reason_against_margins,
    within_requirement,
)
from flight_design.identification.bridge_identification import (
    RATE,
    WAIT,
    IdentifiedChannels,
    airframe_yaml,
    bridge_sections,
    channel_pairs,
    controller_values,
    motions,
)
from reference_model.params import ReferenceModelConfig
from rise_di_controller.law.law import Sign
from rise_di_controller.law.linear_loop import LoopTiming
from rise_di_controller.rise_di_config import RiseDiConfig

# s, least time that u takes from trim to its limit; it bounds beta from below
FULL_RANGE_TIME = 1.0
# relative deviation of the uncertain aircraft whose phase margin counts
UNCERTAINTY = 0.3
SAMPLES = 20
# largest sensitivity of a channel's loop with its integral gain. It leaves a gain margin of 2 and a
# phase margin of 29 deg.
MAX_SENSITIVITY = 2.0
# Shares of the wanted integral gain that are tried.
INTEGRALS = np.append(np.geomspace(1.0, 0.01, 40), 0.0)


class Flyable(NamedTuple):
    """A controller for an identified aircraft, and the files for its flight."""

    controller: RiseDiConfig
    # s, delay margin of the loop around the identified channels with lags and delay; None if the
    # sign is not softened
    delay_margin: float | None
    lack: Refusal | None  # the required margins that the loop lacks
    airframe: str  # text of the airframe file
    scenario: str  # text of the scenario file


def flying_scenario(
    channel_map: ChannelMap,
    channels: IdentifiedChannels,
    speed: float | None,
    airframe_file: str,
    requirement: Requirement = REQUIREMENT,
) -> Flyable:
    """Select gains for identified channels, and write the texts of the airframe and the scenario.

    The bandwidths follow from lag, delay and rate by the engineering procedure, for y_dot = Omega
    u. The integral gains follow from damping and stiffness. Bandwidths and integral gains are
    lowered until the loop around the identified channels meets `requirement`. The model of the
    feedforward is the airframe in coordinated turns without sideslip.
    """
    identified = _Identified(channel_map, channels, speed)
    commands = identified.commands()
    reference = ReferenceModelConfig.validate_mapping(commands.reference, "reference_model")
    manoeuvre = Manoeuvre(reference, {}, commands.duration)
    source = "identified in flight"
    flying = ideal_control.study_airframe(identified.airframe(source), manoeuvre, samples=1)
    studied = identified.of_integrators(manoeuvre)
    studied = studied._replace(slew=np.maximum(flying.slew, identified.reach / FULL_RANGE_TIME))
    selection = gain_selection.gain_sets(studied, identified.setting(requirement))
    controller, margins = _within_margins(
        _with_integrals(selection.chosen, identified.pairing, channels, identified.loop),
        flying,
        requirement,
    )
    turning = identified
    if reference.coordinated_turn is not None:
        turning = identified._replace(channels=_without_sideslip(channels, identified.pairing))
    model = turning.airframe("identified in flight, without sideslip")
    controller = with_feedforward(controller, model)
    heading = [
        f"The aircraft behind the map {channel_map.name}, with gains from its identified response.",
        gain_yaml.margins_sentence(controller, margins),
    ]
    text = scenario_text(heading, bridge_sections(airframe_file, commands, controller))
    lack = delay = None
    if margins is not None:
        lack = reason_against_margins(margins, requirement, controller.outputs)
        delay = margins.delay
    return Flyable(
        controller=controller,
        delay_margin=delay,
        lack=lack,
        airframe=identified.airframe_text(source),
        scenario=text,
    )


class _Identified(NamedTuple):
    """The identified channels of a channel map, and the trim speed, m/s, or None in hover."""

    channel_map: ChannelMap
    channels: IdentifiedChannels
    speed: float | None

    @property
    def pairing(self) -> ChannelPairing:
        """Outputs, each with the input that drives it."""
        return channel_pairs(self.channel_map)[0]

    @property
    def loop(self) -> LoopTiming:
        """Timing of the loop.

        The delay of the loop is the least delay of all channels. If the delay of a channel is
        longer, the difference is added to its lag.
        """
        channels = self.channels
        delay = float(np.min(channels.delay))
        return LoopTiming(channels.lag + channels.delay - delay, delay, 1.0 / RATE)

    @property
    def products(self) -> dict[str, float]:
        """Crossover frequency times lag of each channel's loop, rad, by output."""
        motion_by_output = motions(self.channel_map).items()
        return {
            name: gain_selection.CROSSOVER_LAG_PRODUCTS[motion] for name, motion in motion_by_output
        }

    @property
    def reach(self) -> FloatArray:
        """The smaller of the two limits of each input, (m,)."""
        rows = [self.channel_map.inputs[name] for name in self.pairing.inputs]
        return np.array([min(-row.lower, row.upper) for row in rows])

    def commands(self) -> FirstCommands:
        """Return commands by `first_commands` that the loop can follow, beginning after WAIT."""
        crossover = bandwidths(self.loop, np.array(list(self.products.values())))
        authority = np.abs(np.diag(self.channels.Omega)) * self.reach
        channels = {
            name: Channel(
                motion=motion,
                authority=float(authority[i]),
                bandwidth=float(crossover[i]),
                damping=max(float(self.channels.damping[i]), 0.0),
            )
            for i, (name, motion) in enumerate(motions(self.channel_map).items())
        }
        return first_commands(channels, self.speed, RATE, banks=True, wait=WAIT)

    def airframe_text(self, source: str) -> str:
        """Write the airframe file as text."""
        return airframe_yaml(self.channel_map, self.pairing, self.channels, self.speed, source)

    def airframe(self, source: str) -> Airframe:
        """Return the airframe."""
        return Airframe.validate_mapping(yaml.safe_load(self.airframe_text(source)), "airframe")

    def of_integrators(self, manoeuvre: Manoeuvre) -> Study:
        """Study the ideal control of y_dot = Omega u along the first second of a manoeuvre.

        One second suffices for the `slew`. Only the gain set of Theorem 1 would need the rest of
        the manoeuvre, and this gain set is not used.
        """
        none = np.zeros_like(self.channels.damping)
        channels = self.channels._replace(damping=none, stiffness=none, zero=none)
        integrators = self._replace(channels=channels).airframe("none")
        short = manoeuvre._replace(duration=1.0)
        return ideal_control.study_airframe(integrators, short, samples=1)

    def setting(self, requirement: Requirement) -> LoopSetting:
        """Return the loop for which gains are selected. All its gains are 1 until the selection."""
        loop = self.loop
        lag = loop.lag.tolist()
        channels = controller_values(self.channel_map, self.pairing)
        base = RiseDiConfig.validate_mapping(channels | unit_gains(lag, loop.delay), "controller")
        lags = dict(zip(self.pairing.inputs, lag, strict=True))
        return LoopSetting(
            base=base,
            rate=RATE,
            lag=lags,
            delay=loop.delay,
            rate_limit={},
            crossover_lag_products=self.products,
            requirement=requirement,
        )


def _within_margins(
    controller: RiseDiConfig, study: Study, requirement: Requirement
) -> tuple[RiseDiConfig, LoopMargins | None]:
    """Lower the integral gains and bandwidths of a controller until its loop has the margins.

    The loop is around the airframe of a study. Returns the controller and the margins. A lower
    bandwidth is a smaller input scale, and the K of (22) stays. Without the softened sign, the
    controller does not change, and the margins are None.
    """
    if controller.sampled_sign() is not Sign.SOFT:
        return controller, None
    airframe = study.airframe
    A, B = nominal_and_sampled(airframe, UNCERTAINTY, SAMPLES, 1)
    _, columns = law_order(airframe, controller)

    def build(slower: FloatArray, lower: FloatArray) -> Candidate[RiseDiConfig]:
        ones = np.ones(len(controller.outputs))
        changes: dict[str, FloatArray] = {
            "Lambda": np.array(controller.Lambda) / (slower * lower) * ones,
            "softening": np.array(controller.softening) * (slower * lower) * ones,
            "input_scale": np.array(controller.input_scale) / lower * ones,
            "omega": np.array(controller.omega) / lower * ones,
            "beta": np.array(controller.beta) * lower * ones,  # keep the rate of u
        }
        values = controller.model_dump() | {key: value.tolist() for key, value in changes.items()}
        config = RiseDiConfig.validate_mapping(values, "controller")
        return Candidate(config, linear_loop(config, airframe, A, B))

    candidate = within_requirement(build, requirement, study.u_dot[:, 0][:, columns])
    return candidate.controller, loop_margins(candidate.loop)


def _without_sideslip(channels: IdentifiedChannels, pairing: ChannelPairing) -> IdentifiedChannels:
    """Return the channels with the model of the channel r reduced to its damping.

    The stiffness of r is N_beta, which acts in straight flight. In a coordinated turn, beta_dot =
    -r + g / V phi is 0, so the stiffness does not act. A rudder that worked against the stiffness
    would make the aircraft skid.
    """
    turns = np.array([name == "r" for name in pairing.outputs])
    damping = np.where(turns, channels.damping - channels.zero, channels.damping)
    return channels._replace(
        damping=damping,
        stiffness=np.where(turns, 0.0, channels.stiffness),
        zero=np.where(turns, 0.0, channels.zero),
    )


def _with_integrals(
    controller: RiseDiConfig,
    pairing: ChannelPairing,
    channels: IdentifiedChannels,
    loop: LoopTiming,
) -> RiseDiConfig:
    """Choose the integral gains of a controller from the models of the channels.

    The slope of the softened sign is 1 / (softening total lag). Lambda plus this slope is the
    integral gain of the PI law K (s + integral) / s. For a first-order channel the integral gain is
    the damping, so that the loop becomes K / s. In a channel with stiffness, y returns to trim
    under a constant u, so the channel needs a larger integral gain. The sensitivity must stay below
    MAX_SENSITIVITY. The crossover belongs to the loop around y_dot = Omega u. Source: K. J. Astrom,
    T. Hagglund, "Advanced PID Control", 2006, 6.5 (lambda tuning), 4.6 (largest sensitivity).
    """
    places = [pairing.outputs.index(name) for name in controller.outputs]
    params = controller.law_params()
    crossover = params.K * params.input_scale * np.abs(np.diag(channels.Omega)[places])
    sign_slope = 1.0 / (np.broadcast_to(controller.softening, (len(places),)) * loop.total[places])
    Lambda = [
        max(float(least), _integral(channels, i, float(K), float(loop.total[i])) - float(slope))
        for least, i, K, slope in zip(controller.Lambda, places, crossover, sign_slope, strict=True)
    ]
    return RiseDiConfig.validate_mapping(controller.model_dump() | {"Lambda": Lambda}, "controller")


def _integral(channels: IdentifiedChannels, i: int, crossover: float, total_lag: float) -> float:
    """Return the integral gain of a channel, 1/s, for a loop with `crossover`, rad/s.

    The wanted gain is multiplied by the factors in INTEGRALS, one after another, until the
    sensitivity is below MAX_SENSITIVITY.
    """
    omega = np.geomspace(0.1, 1e3, 400) * crossover

    def response(omega: Any) -> Any:
        """Return the frequency response of the model times K, without the delay."""
        s = 1j * omega
        return (
            crossover
            * (s + channels.zero[i])
            / (s**2 + channels.damping[i] * s + channels.stiffness[i])
        )

    gain = crossover * np.sqrt(max(0.0, abs(response(crossover)) ** -2 - 1.0))
    delayed = response(omega) * np.exp(-1j * omega * total_lag)
    safe = (
        integral
        for integral in gain * INTEGRALS
        if np.min(np.abs(1.0 + delayed * (1.0 - 1j * integral / omega))) > 1.0 / MAX_SENSITIVITY
    )
    return float(next(safe, 0.0))
