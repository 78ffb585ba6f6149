# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""From a channel map to gains without a model: the scenario of an experiment, and a scenario that flies its aircraft.

The experiment excites one input after another, open loop. `identify_response` estimates Omega, lags and delays from its log.
The airframe of both scenarios is y_dot = Omega u: nothing else is known of the aircraft.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import yaml

from aircraft_sim.airframe import Airframe
from aircraft_sim.jsbsim_aircraft import OUTPUTS
from autopilot_bridge.params import ChannelMap
from control_laws.excitation import ExcitationParameters
from flight_analysis.design import gain_selection
from flight_analysis.design.gain_conditions import bandwidths
from flight_analysis.design.gain_selection import ChannelPairing, LoopSetting, Manoeuvre, Selection
from flight_analysis.design.identification import SOFTENING, reference_parameters
from flight_analysis.design.response_identification import Response
from flight_core.parameters import ParameterError, require
from flight_core.vectors import FloatArray
from reference_model.params import ReferenceModelParameters
from rise_di_controller.linear_loop import Loop
from rise_di_controller.rise_di import RiseDiParameters

RATE = 100.0  # Hz, of law and reference model by default

AMPLITUDE = 0.2  # of the smaller limit of an input, by default
WIDTH, PERIOD, BAND = 0.25, 6.0, (0.3, 3.0)  # s, s, Hz: of the excitation of an input that turns the aircraft
SPEED_WIDTH, SPEED_PERIOD, SPEED_BAND = 1.0, 12.0, (0.1, 0.8)  # the same of thrust: engines take longer
PAUSE = 1.5  # s, between the inputs

REFERENCE_BANDWIDTH = 0.5  # of the loop: the reference model's natural frequency per bandwidth of a channel, at most
MAX_NATURAL_FREQUENCY: Mapping[str, float] = {"q": 4.0, "p": 5.0, "r": 4.0, "V": 1.2}  # rad/s, those of `osprey_servo`
FULL_RANGE_TIME = 1.0  # s: u may cross from trim to its limit in that time, which bounds beta from below
MAX_AGE, HOLD, RAMP = 0.3, 0.5, 2.0  # s, failsafe of the controller; the bridge's own ages are shorter
WAIT = 30.0  # s before the first command of the flight: the time to engage


def channel_pairs(channel_map: ChannelMap) -> tuple[ChannelPairing, FloatArray]:
    """Outputs and the inputs that drive them by the motions of the map, and the sign of each effect, (m,).

    Raises ParameterError for an output that no input drives, or that the reference model does not know.
    """
    driven: dict[str, tuple[str, int]] = {}
    for name, row in channel_map.inputs.items():
        output, sign = row.motion
        other = driven.setdefault(output, (name, sign))
        require(other[0] == name, f"map {channel_map.name}: inputs", f"{other[0]} and {name} both for {output}", "one of them")
    for name, measured in channel_map.outputs.items():
        require(name in OUTPUTS, f"map {channel_map.name}: outputs", name, f"some of {', '.join(OUTPUTS)}")
        require(name in driven, f"map {channel_map.name}: inputs", f"none that moves {name}", "one input for each output")
        require(
            measured.motion == (name, 1), f"map {channel_map.name}: outputs.{name}", "the opposite sign", "the stack's signs"
        )
    outputs = tuple(channel_map.outputs)
    inputs = tuple(driven[name][0] for name in outputs)
    return ChannelPairing(outputs, inputs), np.array([float(driven[name][1]) for name in outputs])


class Experiment(NamedTuple):
    """The files of an experiment."""

    airframe: str  # text of the airframe file: signs alone
    scenario: str  # text of the scenario file
    controller: ExcitationParameters


def experiment(channel_map: ChannelMap, speed: float, amplitude: float, airframe_file: str, wait: float = WAIT) -> Experiment:
    """The experiment of a channel map: every input at `amplitude` of its smaller limit; `speed` in trim, m/s."""
    pairing, sign = channel_pairs(channel_map)
    rows = [channel_map.inputs[name] for name in pairing.inputs]
    thrust = [name == "V" for name in pairing.outputs]
    m, lowest = len(rows), [SPEED_BAND[0] if one else BAND[0] for one in thrust]
    controller = ExcitationParameters.validate_mapping(
        _controller(channel_map, pairing)
        | {
            "law": "excitation",
            "D": [int(one) for one in sign],
            "input_scale": [1.0] * m,
            "lag": [0.0] * m,
            "delay": 0.0,
            "amplitude": [amplitude * min(-row.lower, row.upper) for row in rows],
            "width": [SPEED_WIDTH if one else WIDTH for one in thrust],
            "period": [SPEED_PERIOD if one else PERIOD for one in thrust],
            "lowest": lowest,
            "highest": [SPEED_BAND[1] if one else BAND[1] for one in thrust],
            "pause": PAUSE,
        },
        "controller",
    )
    none = {"rate": RATE, "outputs": list(pairing.outputs), "rise": 0.1}
    none["second_order"] = {"natural_frequency": [1.0] * m, "damping": [1.0] * m}
    heading = f"Experiment on the aircraft behind the map {channel_map.name}: each input is excited by itself, open loop."
    return Experiment(
        airframe_yaml(channel_map, pairing, np.diag(sign), speed, "signs of the channel map; sizes not known"),
        scenario_text(heading, airframe_file, wait + controller.duration, none, controller.model_dump(exclude_defaults=True)),
        controller,
    )


def flying_scenario(
    channel_map: ChannelMap, response: Response, speed: float, airframe_file: str
) -> tuple[Selection, str, str]:
    """Gains for an identified response, and the texts of the airframe and of the scenario that fly it.

    The bandwidths follow from lag, delay and rate by the engineering procedure. Raises ParameterError for a response that was
    refused in a channel, and for signs that contradict those of the map.
    """
    pairing, sign = channel_pairs(channel_map)
    if refused := "; ".join(filter(None, response.refusal)):
        raise ParameterError(refused)
    Omega, effects = response.Omega, np.diag(response.Omega)
    for name, output, effect, expected in zip(pairing.inputs, pairing.outputs, effects, sign, strict=True):
        opposite = f"{output}_dot that {'falls' if effect < 0.0 else 'rises'} with {name}"
        require(effect * expected > 0.0, f"map {channel_map.name}: inputs.{name}", opposite, "the opposite: change `sign`")
    delay = float(np.max(response.delay))
    products = np.array([gain_selection.CROSSOVER_LAG_PRODUCTS[name] for name in pairing.outputs])
    loop = Loop(response.lag, delay, 1.0 / RATE)
    bandwidth = dict(zip(pairing.outputs, bandwidths(loop, products).tolist(), strict=True))
    rows = {name: channel_map.inputs[name] for name in pairing.inputs}
    authority = abs(float(Omega[pairing.outputs.index("V"), pairing.outputs.index("V")])) if "V" in pairing.outputs else 1.0
    throttle = rows[pairing.inputs[pairing.outputs.index("V")]] if "V" in pairing.outputs else next(iter(rows.values()))
    commands = _commands(pairing.outputs, bandwidth, speed, authority * min(-throttle.lower, throttle.upper))
    airframe = airframe_yaml(channel_map, pairing, Omega, speed, "step responses identified in flight; A is not known")
    frame = Airframe.validate_mapping(yaml.safe_load(airframe), "airframe")
    manoeuvre = Manoeuvre(ReferenceModelParameters.validate_mapping(commands, "reference_model"), {}, WAIT + 60.0)
    studied = gain_selection.study_airframe(frame, manoeuvre, samples=5)
    range_rate = np.array([min(-row.lower, row.upper) / FULL_RANGE_TIME for row in rows.values()])
    studied = studied._replace(slew=np.maximum(studied.slew, range_rate))
    lag = dict(zip(pairing.inputs, response.lag.tolist(), strict=True))
    ones = [1.0] * len(pairing.inputs)
    base = RiseDiParameters.validate_mapping(
        _controller(channel_map, pairing)
        | dict.fromkeys(("Lambda", "beta", "input_scale", "omega"), ones)
        | {"k_g": 1.0, "k_d": ones[1:], "D": [1] * len(ones), "sign": "auto", "softening": SOFTENING}
        | {"lag": list(lag.values()), "delay": delay},
        "controller",
    )
    selection = gain_selection.select_gains(studied, LoopSetting(base, RATE, lag, delay, {}))
    heading = f"The aircraft behind the map {channel_map.name}, with gains from its identified response."
    chosen = selection.engineering.controller.model_dump(exclude_defaults=True)
    return selection, airframe, scenario_text(heading, airframe_file, manoeuvre.duration, commands, chosen)


def _controller(channel_map: ChannelMap, pairing: ChannelPairing) -> dict[str, Any]:
    """Parameters of the controller that follow from the map."""
    rows = [channel_map.inputs[name] for name in pairing.inputs]
    limits = {"lower": [row.lower for row in rows], "upper": [row.upper for row in rows]}
    common = {"rate": RATE, "outputs": list(pairing.outputs), "inputs": list(pairing.inputs)}
    return common | limits | {"max_age": MAX_AGE, "hold": HOLD, "ramp": RAMP}


def _commands(outputs: Sequence[str], bandwidth: Mapping[str, float], speed: float, authority: float) -> dict[str, Any]:
    """The manoeuvre of `reference_parameters` after WAIT, by a reference model that the loop can follow."""
    commands = reference_parameters(speed, authority)
    frequency = dict(zip(commands["outputs"], commands["second_order"]["natural_frequency"], strict=True))
    damping = dict(zip(commands["outputs"], commands["second_order"]["damping"], strict=True))
    limit = {name: min(MAX_NATURAL_FREQUENCY[name], REFERENCE_BANDWIDTH * bandwidth[name]) for name in outputs}
    pulses = {
        name: pulse | {key: [WAIT + t for t in pulse[key]] for key in ("start", "stop")}
        for name, pulse in commands["pulses"].items()
        if name in outputs
    }
    turns = commands["coordinated_turn"] if {"p", "r"} <= set(outputs) else None
    return commands | {
        "rate": RATE,
        "outputs": list(outputs),
        "second_order": {
            "natural_frequency": [round(min(frequency[name], limit[name]), 4) for name in outputs],
            "damping": [damping[name] for name in outputs],
        },
        "rise": 0.5,
        "pulses": pulses,
        "coordinated_turn": turns,
    }


def airframe_yaml(channel_map: ChannelMap, pairing: ChannelPairing, Omega: FloatArray, speed: float, source: str) -> str:
    """The text of the airframe y_dot = Omega u, Omega (m, m) in the order of the pairing, in units of the map's channels."""
    values = {
        "name": f"{channel_map.name}_aircraft",
        "source": source,
        "speed": float(speed),
        "states": {name: OUTPUTS[name] for name in pairing.outputs},
        "inputs": {name: {"unit": "1", "positive": channel_map.inputs[name].positive} for name in pairing.inputs},
        "outputs": list(pairing.outputs),
        "A": np.zeros_like(Omega).tolist(),
        "B": [[float(f"{value:.4g}") for value in row] for row in Omega],
    }
    Airframe.validate_mapping(values, "airframe")
    return yaml.safe_dump(values, sort_keys=False, default_flow_style=None, width=128)


def scenario_text(
    heading: str, airframe_file: str, duration: float, commands: Mapping[str, Any], controller: Mapping[str, Any]
) -> str:
    """The text of a scenario."""
    sections = {
        "flight": {"duration": float(duration)},
        "aircraft": {"airframe": airframe_file, "rate": RATE, "step": 1.0 / RATE},
        "reference_model": {key: value for key, value in commands.items() if value is not None},
        "controller": _plain(controller),
        "recorder": {"rate": 100.0},
    }
    body = {f"/**/{name}": {"ros__parameters": values} for name, values in sections.items()}
    return f"# {heading}\n" + yaml.safe_dump(body, sort_keys=False, default_flow_style=None, width=128)


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """Lists for tuples, numbers with six digits."""

    def plain(value: Any) -> Any:
        if isinstance(value, (list, tuple)):
            return [plain(one) for one in value]
        return float(f"{value:.6g}") if isinstance(value, float) else value

    return {key: plain(value) for key, value in values.items() if value is not None}
