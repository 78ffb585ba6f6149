# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Choose the commands of an aircraft's first scenario by one rule, and write the scenario file."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from flight_analysis.closed_loop.scenario import (
    SCHEMAS,
    Scenario,
    parse_scenario_sections,
    scenario_of,
)
from flight_analysis.closed_loop.scenario_library import LIBRARY, find_scenario
from flight_analysis.linear_loop.loop_margins import scenario_model, through_allocation
from flight_core.arguments import FilePath
from flight_core.files import comment, find_file, read_file
from flight_core.parameters import require
from flight_core.scenario_file import A_SCENARIO, parse_sections
from flight_core.units import GRAVITY
from flight_design.gains import gain_yaml
from flight_design.gains.gain_selection import SOFTENING
from rise_di_controller.laws import DEFAULT, AnyLaw
from rise_di_controller.params import ControllerConfig

LICENCE = "# SPDX-FileCopyrightText: RISE-DI contributors\n# SPDX-License-Identifier: Apache-2.0\n"

RATE = 200.0  # Hz, of y and y_m
CONTROL_RATE = 100.0  # Hz, of the law
# Assumed noise of the sensors, rms of a sample: of an airspeed, m/s, and of any other output.
SPEED_NOISE = 0.05
RATE_NOISE = 0.001  # rad/s
# rad/s, largest natural frequency of the reference model, as in osprey_gust
FASTEST = {"q": 4.0, "p": 5.0, "r": 4.0}
# rad/s, largest natural frequency for an airspeed, a climb, and any other output
FASTEST_SPEED = 1.2
# natural frequency of the reference model as a fraction of the loop's bandwidth. With this fraction
# the loop follows the reference without a feedforward.
OF_BANDWIDTH = 0.5
# fraction of the authority that a command may use; the rest is for climbs, turns and gusts
OF_AUTHORITY = 1.0 / 3.0
SIZE = {"q": 0.05, "p": 0.15, "r": 0.05, "climb": 1.0}  # rad/s, m/s
HOVER = 0.15  # rad/s, size of a command of a rate if there is no airspeed
# size of a command of airspeed as a fraction of V0. The dynamic pressure then changes by 6 %, which
# the gains allow.
OF_SPEED = 0.03
LARGEST_SPEED = 2.0  # m/s, largest change of an airspeed
SEEN = 5.0  # least size of a command, as a multiple of the noise, so that its error shows
SPEEDS = {"V", "u", "climb"}  # motions that thrust moves: slow, without overshoot

# s, length of a pulse's edges, which bounds u_m_dot; short compared with the filters' response
RISE = 0.2
REST = 2.0  # s, time before the first command
TURNS = ((0.0, 1.0), (2.0, -1.0), (5.0, -1.0), (7.0, 1.0))
"""Starts, s, and directions of the pulses of a rate: the second pair restores the flight path."""
PULSE = 1.0  # s, length of a pulse of a rate
TURNS_TIME = 9.0  # s, length of the four pulses
SPEED_PULSE = 20.0  # s, length of a pulse of airspeed or climb
LAST = 20.0  # s, time after the last command, for a gust and the return to trim
# scenario whose commands and gusts serve for gains that have no scenario
COMMANDED = "osprey_servo"
# parameters that the selection of gains finds
GAINS = {"k_g", "k_d", "Lambda", "beta", "omega", "input_scale", "D"}


def sensor_noise(output: str) -> float:
    """Return the assumed noise of the sensor of an output, rms of a sample, SI."""
    return SPEED_NOISE if output in {"V", "u"} else RATE_NOISE


class Channel(NamedTuple):
    """Properties of an output, in SI, that determine the commands for this output."""

    motion: str  # q, p, r, V or climb; any other output has no size of its own
    authority: float  # largest y_dot that the input causes before it reaches its nearer end stop
    bandwidth: float  # rad/s, bandwidth of the loop, which follows from lags, delay and rate
    noise: float = 0.0  # rms per sample
    damping: float = 0.0  # 1/s, rate at which y decays without control

    @property
    def is_speed(self) -> bool:
        """Whether the output is a speed, which thrust changes."""
        return self.motion in SPEEDS

    @property
    def frequency(self) -> float:
        """Natural frequency of the reference model, rad/s.

        It is half of the bandwidth of the loop, but at most FASTEST.
        """
        return min(FASTEST.get(self.motion, FASTEST_SPEED), OF_BANDWIDTH * self.bandwidth)

    def size(self, speed: float | None) -> float:
        """Return the height of a pulse of command; `speed` is V0 in m/s, None in hover.

            height = max(min(size of the motion, reach), SEEN noise)
            reach = OF_AUTHORITY authority / (frequency / e + damping)

        A critically damped filter of second order answers a step of height A with a rate of at most
        A frequency / e, at the time 1 / frequency. To hold A at the end, the input must cause a
        y_dot of A damping. The size of a pitch rate is at most g / V0.
        """
        reach = OF_AUTHORITY * self.authority / (self.frequency / math.e + self.damping)
        return max(min(_largest(self.motion, speed), reach), SEEN * self.noise)


def _largest(motion: str, speed: float | None) -> float:
    """Return the size of a command that suits the motion, if the input has enough authority."""
    if motion in SIZE and (speed is None) and motion != "climb":
        return HOVER
    if motion == "q" and speed is not None:
        return min(SIZE["q"], GRAVITY / speed)
    if motion in SIZE:
        return SIZE[motion]
    return min(OF_SPEED * speed, LARGEST_SPEED) if motion in SPEEDS and speed else math.inf


class FirstCommands(NamedTuple):
    """The commands of an aircraft's first flight."""

    reference: dict[str, Any]  # the section reference_model
    duration: float  # s

    @property
    def gust(self) -> float:
        """Time at which the gust after the last command comes, s."""
        return self.duration - LAST / 2.0


def first_commands(
    channels: Mapping[str, Channel],
    speed: float | None,
    rate: float,
    *,
    banks: bool,
    wait: float = 0.0,
    part: float = 1.0,
) -> FirstCommands:
    """Choose the commands of a first flight: the outputs one after another, the speeds last.

    The frequency and height of each command follow from its `Channel`, and `part` multiplies the
    heights. If the aircraft `banks` to turn, the yaw rate is commanded as in a coordinated turn, g
    / V0 sin(bank). `speed` is V0, m/s, or None in hover. `rate` is the rate of the reference model,
    Hz. `wait` is the time before all commands, s.

    The reference is slower than the loop, and stays within the authority of the input. Source: K.
    J. Astrom, R. M. Murray, "Feedback Systems", 12.2 (two degrees of freedom).
    """
    names = {channel.motion: name for name, channel in channels.items()}
    turn = banks and speed is not None and {"p", "r"} <= set(names)
    t = wait + REST
    pulses: dict[str, dict[str, list[float]]] = {}
    for name, channel in sorted(channels.items(), key=lambda item: item[1].is_speed):
        height = float(f"{part * channel.size(speed):.3g}")
        if channel.is_speed:
            pulses[name] = {"start": [t], "stop": [t + SPEED_PULSE], "value": [height]}
            t += SPEED_PULSE
        elif not (turn and channel.motion == "r"):
            pulses[name] = {
                "start": [t + start for start, _ in TURNS],
                "stop": [t + start + PULSE for start, _ in TURNS],
                "value": [direction * height for _, direction in TURNS],
            }
            t += TURNS_TIME
    reference: dict[str, Any] = {
        "rate": rate,
        "outputs": list(channels),
        "second_order": {
            "natural_frequency": [round(each.frequency, 4) for each in channels.values()],
            "damping": [1.0 if each.is_speed else 0.9 for each in channels.values()],
        },
        "rise": RISE,
        "pulses": pulses,
    }
    if turn:
        rates = {"bank_rate": names["p"], "turn_rate": names["r"]}
        reference["coordinated_turn"] = rates | {"speed": speed}
    return FirstCommands(reference, t + LAST)


def unit_gains(lag: Sequence[float], delay: float) -> dict[str, Any]:
    """Return the parameters of a controller for channels with given lags and a delay, s.

    All gains are 1, because they are selected later.
    """
    ones = [1.0] * len(lag)
    return dict.fromkeys(("Lambda", "beta", "input_scale", "omega"), ones) | {
        "k_g": 1.0,
        "k_d": ones[1:],
        "D": [1] * len(lag),
        "sign": "auto",
        "softening": SOFTENING,
        "lag": list(lag),
        "delay": delay,
    }


def scenario_to_design(scenario: FilePath | Scenario) -> Scenario:
    """Load a scenario whose section controller may lack the gains.

    Missing gains are set to 1, and are selected later. The section must have the rate, channels,
    lags, delay and failsafe. Raises ParameterError if one of these is missing.
    """
    if isinstance(scenario, Scenario):
        return find_scenario(scenario)
    path = find_file(scenario, LIBRARY, "scenario", A_SCENARIO).absolute()
    sections = parse_scenario_sections(read_file(path, str(path), A_SCENARIO), path)
    controller = sections["controller"]
    outputs = controller.get("outputs")
    is_rise_di = controller.get("law", DEFAULT) == DEFAULT
    if not (is_rise_di and isinstance(outputs, list)) or GAINS & {*controller}:
        return find_scenario(scenario)
    ones = unit_gains([0.0] * len(outputs), 0.0)
    return scenario_of(path.stem, path, {**sections, "controller": {**ones, **controller}})


def scenario_to_check(scenario: FilePath | Scenario) -> Scenario:
    """Load a scenario to check its gains; a file with only the section controller is enough.

    If the file has only this section, the commands, gusts and rate limits come from the scenario
    COMMANDED. The aircraft in COMMANDED may differ from the aircraft that the controller is for.
    Raises ParameterError if the scenario is missing or invalid.
    """
    controller = controller_alone(scenario)
    if controller is None:
        return find_scenario(scenario)
    return replace(find_scenario(COMMANDED), controller=controller)


def airframe_to_check(airframe: FilePath | Airframe, flight: Scenario) -> Airframe:
    """Return the airframe for a check of gains.

    If `airframe` names a JSBSim aircraft, the result is the linear model of the JSBSim aircraft
    that the scenario flies. Raises ParameterError if the airframe has other channels than the law
    of the scenario.
    """
    flown = flight.aircraft
    law = flight.controller
    is_flown = flown.is_jsbsim and str(airframe) == flown.airframe
    frame = scenario_model(flight, law) if is_flown else load_airframe(airframe)
    own = f", as {flown.airframe} has" if flown.is_jsbsim else ""
    inputs = tuple(through_allocation(frame, law).inputs)
    channels = {"outputs": (law.outputs, frame.outputs), "inputs": (law.inputs, inputs)}
    for key, (names, present) in channels.items():
        fits = {*names} == {*present} if key == "outputs" else {*names} <= {*present}
        expected = f"the {key} {', '.join(names)} of {flight.name}{own}"
        require(fits, f"airframe {frame.name}", ", ".join(present), expected)
    return frame


def controller_alone(scenario: FilePath | Scenario) -> ControllerConfig | None:
    """Return the controller of a file that has only the section controller.

    `selection_yaml` writes such a file. Returns None for a scenario and for any other file. Raises
    ParameterError.
    """
    if isinstance(scenario, Scenario):
        return None
    path = find_file(scenario, LIBRARY, "scenario", A_SCENARIO)
    content = read_file(path, str(path), A_SCENARIO)
    sections = parse_sections(content, path, SCHEMAS, tuple(SCHEMAS))
    if sections.keys() != {"controller"}:
        return None
    return AnyLaw.validate_mapping(sections["controller"], "controller")


COMMENTS = {
    "flight.duration": "s",
    "aircraft.speed": "m/s, true airspeed in trim",
    "aircraft.altitude": "m, above sea level",
    "aircraft.commands": "the model's own properties, with their values at the command 1",
    "aircraft.rate": "Hz, y and truth",
    "aircraft.step": "s, of the integration",
    "aircraft.gusts": "1-cosine; entry in s, peak speed in m/s, distance to the peak in m",
    "aircraft.turbulence": "moderate",
    "aircraft.actuators": "deviations from trim, in the order of the inputs, SI",
    "aircraft.sensors": "rms a sample, in the order of the outputs, SI",
    "reference_model.rate": "Hz",
    "reference_model.second_order": "rad/s and 1, within half of the bandwidth of the loop",
    "reference_model.rise": "s, edge of a pulse: bounds u_m_dot",
    "reference_model.pulses": "s, s, and rad/s or m/s, within a third of the authority",
    "reference_model.coordinated_turn": "r += g/V0 sin(bank commanded)",
    "reference_model.live": "m/s: the wings are levelled when guidance is lost",
    "guidance.rate": "Hz; what is left out follows by rule: docs/guidance.md",
    "guidance.stall_speed": "m/s, the slowest airspeed at which it trims in level flight there",
    "guidance.program": "s, rad, m",
    "recorder.rate": "Hz, polling of the subscriptions",
}
"""Unit and meaning of a key of a first scenario."""

SCENARIO_YAML = gain_yaml.yaml_template("""\
{{ heading }}
{% for name, rows in sections.items() %}
{% if rows is string %}

{{ rows }}
{%- else %}

/**/{{ name }}:
  ros__parameters:
{% for key, value in rows.items() %}
{% set note = "  # " ~ comments[name ~ "." ~ key] if (name ~ "." ~ key) in comments else "" %}
{% if value is mapping and value.values() | select("mapping") | list or key == "actuators" %}
    {{ key }}:{{ note }}
{% for part, entry in value.items() %}
      {{ part }}: {{ entry | flow }}
{% endfor %}
{% else %}
    {{ key }}: {{ value | flow }}{{ note }}
{% endif %}
{% endfor %}
{% endif %}
{% endfor %}
""")


Sections = Mapping[str, Mapping[str, Any] | str]
"""Sections of a scenario by name; a text is a whole section."""


def scenario_text(heading: Iterable[str], sections: Sections) -> str:
    """Write the text of a scenario file: a heading as comments, and then the sections.

    A section may be a text, such as `gain_yaml.selection_yaml` writes, or a mapping. Empty lines of
    the heading are left out. Keys whose value is None or {} are also left out.
    """
    rows = {name: _with_values(section) for name, section in sections.items()}
    lines = LICENCE + "#\n" + comment(filter(None, heading))
    return SCENARIO_YAML.render(heading=lines.rstrip("\n"), sections=rows, comments=COMMENTS)


def _with_values(section: Mapping[str, Any] | str) -> Mapping[str, Any] | str:
    """Return a section without the keys that have no value; return a text as it is."""
    if isinstance(section, str):
        return section
    return {key: value for key, value in section.items() if value is not None and value != {}}
