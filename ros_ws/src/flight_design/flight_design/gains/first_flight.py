# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A first scenario for an airframe: commands, actuators, noise, and gusts of a size that fits the
aircraft.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from aircraft_sim.airframe import Airframe
from flight_core.parameters import require
from flight_core.units import ANGLE, ANGULAR_RATE, GRAVITY, SPEED, quantity
from flight_design.gains import gain_yaml
from flight_design.gains.channel_signs import MAX_COUPLING
from flight_design.gains.effectors import Effectors, LawInputs, design_allocation
from rise_di_controller.decomposition import search
from rise_di_controller.model_sections import AllocationConfig

# s, servos and engine of a light aircraft, assumed
SURFACE_LAG = 0.05
ENGINE_LAG = 0.3
# rad, rad/s: 20 deg, 57 deg/s, assumed
STOP = 0.35
SURFACE_RATE = 1.0
# m/s^2, rad/s^2: what the end stop of another input gives, assumed
AUTHORITY = {SPEED: 0.3 * GRAVITY, ANGULAR_RATE: 2.0}
USED = 0.4  # part of the authority that the edge of a command takes at most
NOISE = {"V": 0.05, "u": 0.05}  # m/s; 0.001 rad/s of a rate
SPEEDS = {"V", "u"}  # outputs that a throttle moves slowly
SOFTENING = 2.75  # 1, width of the softened sign in total lags, that of the shipped scenarios
RATE = 200.0  # Hz, of y and y_m
# rad/s, natural frequency of the reference model at most
FASTEST = {"q": 3.0, "p": 4.0, "r": 2.0, "V": 1.2}
LAG_PRODUCT = 0.18  # 1, natural frequency times the lag of the input at most

SCENARIO_YAML = gain_yaml.yaml_template("""\
# The airframe {{ airframe.name }} at {{ airframe.speed | digits(6) }} m/s: commands on every channel, servos, noise\
{{ ", gusts" if gusts }}.
# Lags, end stops, rates and noise are assumed: put those of your aircraft here, then select the gains again:
# rise-di gains {{ path | line }} --scenario {{ scenario | line }} --write gains.yaml

/**/flight:
  ros__parameters: {duration: 40.0}        # s

/**/aircraft:
  ros__parameters:
    airframe: {{ path | flow }}
    rate: {{ rate | flow }}                        # Hz, y and truth
    step: {{ step | flow }}                       # s, of the integration
{% if gusts %}
    gusts:                             # 1-cosine; entry in s, peak speed in m/s, distance to the peak in m
{% for axis, gust in gusts.items() %}
      {{ axis }}: {{ gust | flow }}
{% endfor %}
{% endif %}
    actuators:                         # {{ inputs | join(", ") }}, from trim, SI
{% for key, values in actuators.items() %}
      {{ key }}: {{ values | flow }}
{% endfor %}
    sensors: {noise: {{ noise | flow }}, seed: 1}  # {{ outputs | join(", ") }}, rms, SI

/**/reference_model:
  ros__parameters:
    rate: {{ rate | flow }}                        # Hz
    outputs: {{ outputs | flow }}
    second_order:                      # rad/s and 1
      natural_frequency: {{ frequency | flow }}
      damping: {{ damping | flow }}
    rise: 0.2                          # s, edge of a pulse
    pulses:                            # s, s, and SI
{% for name, pulse in pulses.items() %}
      {{ name }}: {{ pulse | flow }}
{% endfor %}
{% if turn %}
    coordinated_turn: {{ turn | flow }}  # r += g/V0 sin(bank commanded)
{% endif %}

/**/recorder:
  ros__parameters: {rate: 100.0}

{{ controller }}""")  # noqa: E501 - a text as it is written


def scenario_text(
    airframe: Airframe,
    path: str,
    scenario: str,
    controller: str,
    lag: Sequence[float],
    size: float = 1.0,
) -> str:
    """A scenario file for the airframe in `path`, with the text of the section controller; `size`
    multiplies the commands.

    Commands move V by 3 % of the trim speed, q by 0.05 rad/s, p by 0.2 rad/s, less where the edge
    of a command would take more than USED of the input's authority. Gusts have 3 % of the trim
    speed.
    """
    inputs = list(airframe.inputs)
    outputs = list(airframe.outputs)
    V0 = airframe.speed
    stops = _stops(airframe)
    channels = _channels(airframe, lag)
    # a bank turns an aeroplane
    banks = {"p", "r"} <= set(outputs) and bool({"beta", "v"} & set(airframe.states))
    turn = {"bank_rate": "p", "turn_rate": "r", "speed": V0} if banks else None
    commanded = [name for name in outputs if not (name == "r" and turn)]  # turns command r
    crosswise = [axis for axis in airframe.gusts if axis != "longitudinal"]
    gusts = {
        axis: {"start": 32.0 + 3.0 * k, "speed": round(0.03 * V0, 2), "length": round(0.5 * V0, 1)}
        for k, axis in enumerate(crosswise)
    }
    return SCENARIO_YAML.render(
        airframe=airframe,
        path=path,
        scenario=scenario,
        rate=RATE,
        step=1.0 / RATE,
        gusts=gusts,
        inputs=inputs,
        outputs=outputs,
        actuators={
            "lag": list(lag),
            "lower": [-stop for stop in stops],
            "upper": stops,
            "rate": _rates(airframe),
        },
        noise=[NOISE.get(output, 0.001) for output in outputs],
        frequency=[channels[output].frequency for output in outputs],
        damping=[1.0 if output in SPEEDS else 0.9 for output in outputs],
        pulses=_pulses({name: channels[name] for name in commanded}, V0, size),
        turn=turn,
        controller=controller,
    )


class _Channel(NamedTuple):
    """A channel of the reference model."""

    authority: float  # y_dot that the input gives at its stop
    frequency: float  # rad/s, natural, of the reference model


def _channels(airframe: Airframe, lag: Sequence[float]) -> dict[str, _Channel]:
    """The channels by output."""
    outputs = list(airframe.outputs)
    if len(airframe.inputs) > len(outputs):
        _, law = _distributed(airframe, lag)
        authority = law.upper
        lags = law.lag.tolist()
    else:
        paired = pairing(airframe)
        response = np.abs(airframe.matrix_c() @ airframe.matrix_b())[range(len(outputs)), paired]
        authority = response * np.array(_stops(airframe))[list(paired)]
        lags = [lag[j] for j in paired]
    return {
        output: _Channel(
            float(reach), min(FASTEST.get(output, 1.2), LAG_PRODUCT / max(seconds, 1e-3))
        )
        for output, reach, seconds in zip(outputs, authority, lags, strict=True)
    }


def _pulses(channels: Mapping[str, _Channel], V0: float, size: float) -> dict[str, Any]:
    """Commands by output, one after another: a pulse of V, a pulse each way of the rest."""
    amplitude = {"q": 0.05, "p": 0.2, "V": 0.03 * V0, "u": 0.03 * V0, "r": 0.03}
    start = 2.0
    pulses: dict[str, Any] = {}
    for output, channel in channels.items():
        reachable = USED * channel.authority / channel.frequency
        value = float(f"{size * min(amplitude.get(output, reachable), reachable):.3g}")
        if output in SPEEDS:
            pulses[output] = {"start": [start], "stop": [start + 8.0], "value": [value]}
            start += 4.0
        else:
            pulses[output] = {
                "start": [start, start + 4.0],
                "stop": [start + 2.0, start + 6.0],
                "value": [value, -value],
            }
            start += 3.0
    return pulses


def _surfaces(airframe: Airframe) -> list[bool]:
    return [quantity(channel.unit).dimension == ANGLE for channel in airframe.inputs.values()]


def _stops(airframe: Airframe) -> list[float]:
    """The end stop of each input: STOP of a surface, of another input what gives AUTHORITY on the
    output that it moves.
    """
    Omega = np.abs(airframe.matrix_c() @ airframe.matrix_b())
    authorities = np.array(
        [
            AUTHORITY.get(quantity(unit).dimension, 1.0)
            for unit in airframe.units_of_outputs().values()
        ]
    )
    moved = np.argmax(Omega / authorities[:, None], axis=0).tolist()
    if len(airframe.inputs) == len(airframe.outputs):
        for i, j in enumerate(pairing(airframe)):
            moved[j] = i
    return [
        STOP if surface else float(f"{authorities[i] / max(Omega[i, j], 1e-9):.3g}")
        for j, (surface, i) in enumerate(zip(_surfaces(airframe), moved, strict=True))
    ]


def _rates(airframe: Airframe) -> list[float]:
    return [
        SURFACE_RATE if surface else stop
        for surface, stop in zip(_surfaces(airframe), _stops(airframe), strict=True)
    ]


def _distributed(airframe: Airframe, lag: Sequence[float]) -> tuple[AllocationConfig, LawInputs]:
    """The allocation of an airframe with more inputs than outputs."""
    stops = np.array(_stops(airframe))
    return design_allocation(
        airframe, Effectors(-stops, stops, np.array(_rates(airframe)), np.array(lag))
    )


def default_lags(airframe: Airframe) -> tuple[float, ...]:
    """Lags of the inputs, s: a servo for an angle, an engine for the rest."""
    return tuple(SURFACE_LAG if surface else ENGINE_LAG for surface in _surfaces(airframe))


def placeholder(airframe: Airframe, lag: Sequence[float]) -> str:
    """A section controller with gains of 1, for the selection of gains."""
    allocation = None
    m = len(airframe.outputs)
    if len(airframe.inputs) > m:
        config, law = _distributed(airframe, lag)
        allocation = config.model_dump(exclude_none=True)
        inputs = list(law.names)
        lags = law.lag.tolist()
    else:
        paired = pairing(airframe)
        inputs = [list(airframe.inputs)[j] for j in paired]
        lags = [lag[j] for j in paired]
    require(
        m > 1,
        "inputs",
        inputs[0],
        "two inputs or more: add a thrust with --set thrust, or a second control",
    )
    values: Mapping[str, Any] = {
        "rate": 100.0,
        "outputs": list(airframe.outputs),
        "inputs": inputs,
        "D": [1] * m,
        "k_g": 1.0,
        "k_d": [1.0] * (m - 1),
        **dict.fromkeys(("Lambda", "beta", "input_scale", "omega"), [1.0] * m),
        "sign": "auto",
        "lag": lags,
        "delay": 0.003,
        "softening": SOFTENING,
        "max_age": 0.1,
        "hold": 0.5,
        "ramp": 2.0,
        **({} if allocation is None else {"allocation": allocation}),
    }
    lines = [f"    {key}: {gain_yaml.yaml_flow(value, 10)}" for key, value in values.items()]
    return "\n".join(["/**/controller:", "  ros__parameters:", *lines, ""])


def pairing(airframe: Airframe) -> tuple[int, ...]:
    """The input of each output, as the smallest change that gives D = I within MAX_COUPLING, else
    in their order.
    """
    best = search(airframe.matrix_c() @ airframe.matrix_b(), MAX_COUPLING)
    if best is None:
        return tuple(range(len(airframe.outputs)))
    return tuple(j for _, j in sorted(zip(best.outputs, best.inputs, strict=True)))
