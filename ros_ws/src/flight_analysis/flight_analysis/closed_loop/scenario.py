# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A scenario: a file with the parameters of every node, validated by section and as a whole."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.params import AircraftConfig
from aircraft_sim.pose import every
from flight_core.arguments import FilePath, as_instance, as_path
from flight_core.channels import RATES_AND_SPEED, VERTICAL, WITHOUT_RUDDER, vertical
from flight_core.fields import Field, short_repr
from flight_core.files import dump_yaml, is_file, read_file
from flight_core.parameters import Config, ParameterError, one_of, require, require_channels
from flight_core.rates import NANOSECONDS, nanoseconds, period_ns
from flight_core.scenario_file import A_SCENARIO, Sections, parse_sections
from flight_guidance.fence.zones import clearance_text
from flight_guidance.params import GuidanceConfig
from flight_recorder.params import RecorderConfig
from reference_model.params import ReferenceModelConfig
from rise_di_controller.law.decomposition import DecompositionError, signs
from rise_di_controller.laws import AnyLaw
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig

STOP_TOLERANCE = 1e-3  # relative, because files give limits and end stops with few digits

ParameterOverrides = dict[str, str | float | bool | list[str] | list[float]]
"""Parameters of one node by name, which replace values of its section in the scenario."""


class FlightConfig(Config):
    """The section `flight` of a scenario: how to run the flight."""

    duration: Annotated[float, Field(gt=0, le=1e6)] = Field(description="how long to fly, s")
    lockstep: bool = Field(
        default=False,
        description="fly in lockstep, as fast as the machine allows, instead of in real time",
    )
    use_sim_time: bool = Field(
        default=False,
        description="fly by the /clock of a simulator; any section of a node may also ask for it",
    )


@dataclass(frozen=True)
class Scenario:
    """A scenario file, read and validated.

    Examples:
        >>> scenario = rise_di.find_scenario("osprey_servo")
        >>> scenario.vary(controller={"beta": [2.0, 2.0, 1.0, 1.0]}).rise_di().beta
        (2.0, 2.0, 1.0, 1.0)
    """

    name: str
    path: Path
    flight: FlightConfig
    aircraft: AircraftConfig
    reference_model: ReferenceModelConfig
    controller: ControllerConfig
    recorder: RecorderConfig
    guidance: GuidanceConfig | None = None  # if None, reference_model generates the commands

    @classmethod
    def from_parts(cls, name: str, **sections: Mapping[str, Any] | Config) -> "Scenario":
        """Create a scenario without a file.

        The sections are flight, aircraft, reference_model and controller. The sections recorder and
        guidance are optional. A section is a mapping of parameters, or a parameter set. Lists may
        be arrays. Without `recorder`, the recorder has its defaults.

        Args:
            name: Name of the scenario.
            sections: Parameters, or a parameter set, by section.

        Returns:
            The scenario, validated.

        Raises:
            ParameterError: A section or a value is invalid.
        """
        required = [key for key in SCHEMAS if key not in OPTIONAL]
        missing = [key for key in required if key not in sections]
        unknown = [key for key in sections if key not in SCHEMAS]
        expected = (
            f"the sections {', '.join(required)}, and "
            f"{' or '.join(key for key in SCHEMAS if key not in required)}"
        )
        require(not missing, name, f"no section {', '.join(missing)}", expected)
        require(not unknown, name, f"a section {', '.join(unknown)}", expected)
        values = {
            key: part.model_dump() if isinstance(part, Config) else part
            for key, part in sections.items()
        }
        return scenario_of(name, Path(f"{name}.yaml"), values)

    def vary(self, **sections: Mapping[str, Any] | Config) -> "Scenario":
        """Return a copy with parameters replaced, as in scenario.vary(controller={"rate": 200.0}).

        A section is a mapping of new parameters, or a whole parameter set, such as the `controller`
        of a second scenario. Lists may be arrays. If the `law` changes, the gains of the former law
        are dropped. The copy is validated. If the scenario has no section of guidance, your changes
        are added to the parameters that `guidance_by_rule` computes.

        Args:
            sections: New parameters, or a whole parameter set, by section.

        Returns:
            The copy.

        Raises:
            ParameterError: A section or a value is invalid.
        """
        varied = replace(
            self, **{name: self._varied(name, changes) for name, changes in sections.items()}
        )
        check_together(varied)
        return varied

    def _varied(self, name: str, changes: Mapping[str, Any] | Config) -> Any:
        """Return a section of the scenario with changes, validated."""
        schema = SCHEMAS.get(name)
        if schema is None:
            if owners := self.sections_with(name):
                expected = f"it in a section: vary({owners[0]}={{{name!r}: ...}})"
            else:
                expected = one_of(tuple(SCHEMAS), name)
            raise ParameterError(f"{name}: found no such section, expected {expected}")
        if isinstance(changes, ControllerConfig if schema is AnyLaw else schema):
            return schema.validate_mapping(changes.model_dump(), name)
        if not isinstance(changes, Mapping):
            raise ParameterError(
                f"{name}: found {short_repr(changes)}, expected a mapping of its parameters"
            )
        return schema.validate_mapping({**self._values(name, changes), **changes}, name)

    def sections_with(self, name: str) -> list[str]:
        """Return the sections that have a parameter of this name.

        Args:
            name: Name of a parameter, such as k_g.

        Returns:
            Names of sections. The list is empty if no section has such a parameter.
        """
        return [key for key in SCHEMAS if name in getattr(getattr(self, key), "model_fields", ())]

    def _values(self, name: str, changes: Mapping[str, Any]) -> dict[str, Any]:
        """Return the parameters of a section, to which the caller then adds `changes`.

        If `changes` has another law, the gains of the present law are left out. If guidance is
        asked for and the scenario has no such section, `guidance_by_rule` gives the parameters.
        """
        section: Config | None = getattr(self, name)
        if section is None:
            return guidance_by_rule(self.aircraft, self.reference_model, self.controller)
        values = section.model_dump()
        if isinstance(section, ControllerConfig) and changes.get("law", section.law) != section.law:
            return {key: values[key] for key in ControllerConfig.model_fields}
        return values

    def rise_di(self) -> RiseDiConfig:
        """Return the parameters of a controller with RISE-DI.

        Raises ParameterError if the controller has another law.
        """
        if not isinstance(self.controller, RiseDiConfig):
            expected = "rise_di, which has the gains of (20) to (22)"
            raise ParameterError(
                f"{self.name}: found the law {self.controller.law}, expected {expected}"
            )
        return self.controller

    def has_learner(self) -> bool:
        """Return whether the controller learns its models, A and B, in flight."""
        return isinstance(self.controller, RiseDiConfig) and self.controller.learn is not None

    def gust_windows(self) -> dict[str, tuple[float, float]]:
        """Return the times at which each gust starts and ends, s, by the name of the gust.

        A gust of length H starts when the aircraft enters it, and ends 2 H / V0 later. From the
        second time on, a repeated gust has a number after its name.
        """
        speed = self.aircraft.channels().speed
        windows = {}
        for name, gust in self.aircraft.gusts.items():
            # `every` is infinite for a single gust, so `again` is 0
            again = (self.flight.duration - gust.start) / gust.every
            entries = gust.start + gust.every * np.arange(1.0, max(math.ceil(again), 1))
            for number, entry in enumerate([gust.start, *entries.tolist()], 1):
                label = name if number == 1 else f"{name} {number}"
                windows[label] = (entry, entry + 2.0 * gust.length / speed)
        return windows


def as_scenario(value: object) -> Scenario:
    """Return the value if it is a Scenario, or raise ParameterError if it is not."""
    return as_instance(
        value, Scenario, "scenario", "a Scenario, as find_scenario and recorded_scenario return one"
    )


SCHEMAS: dict[str, type[Config]] = {
    "flight": FlightConfig,
    "aircraft": AircraftConfig,
    "reference_model": ReferenceModelConfig,
    "controller": AnyLaw,
    "recorder": RecorderConfig,
    "guidance": GuidanceConfig,
}
OPTIONAL = ("recorder", "guidance")
"""Sections that a file may leave out.

If `recorder` is missing, the recorder has its defaults. If `guidance` is missing, the flight has no
guidance.
"""


def load_scenario(path: FilePath, *, with_route: bool = True) -> Scenario:
    """Read and validate a scenario file. Raises ParameterError if it is invalid.

    If `with_route` is False, guidance's route and its program of targets are left out before the
    validation, because the flight will take another route.
    """
    path = as_path(path, "scenario", A_SCENARIO)
    content = read_file(path, str(path), A_SCENARIO)
    if with_route:
        return parse_scenario(content, path)
    sections = parse_scenario_sections(content, path)
    remaining = {
        key: value
        for key, value in sections.get("guidance", {}).items()
        if key not in {"route", "program"}
    }
    return scenario_of(
        path.stem, path, {**sections, **({"guidance": remaining} if "guidance" in sections else {})}
    )


def parse_scenario(content: bytes, path: Path) -> Scenario:
    """Parse and validate a scenario, given the content of its file.

    Raises ParameterError if the content is no valid scenario.
    """
    return scenario_of(path.stem, path, parse_scenario_sections(content, path))


def scenario_of(name: str, path: Path, sections: Mapping[str, Mapping[str, Any]]) -> Scenario:
    """Build and validate a scenario from the values of its sections.

    Raises ParameterError if a value is not permitted, or if the sections do not fit together.
    """
    parameters: dict[str, Any] = {
        key: schema.validate_mapping(sections.get(key, {}), key)
        for key, schema in SCHEMAS.items()
        if key != "guidance"
    }
    scenario = Scenario(name=name, path=path, **parameters)
    check_together(scenario)
    # If guidance is by rule, its numbers follow from the other sections.
    return scenario.vary(guidance=sections["guidance"]) if "guidance" in sections else scenario


def parse_scenario_sections(content: bytes, path: Path, namespace: str | None = None) -> Sections:
    """Parse the sections of a scenario file, without validating their values.

    Raises ParameterError if the content is no parameter file, or lacks a section. `namespace` is
    the namespace of the nodes, as in `parse_sections`. `find_files` finds the files that the
    sections name.
    """
    sections = parse_sections(content, path, SCHEMAS, OPTIONAL, namespace)
    find_files(sections, path)
    return sections


def find_files(sections: Sections, path: Path) -> None:
    """Replace the paths in the sections of a parameter file by paths at which the files exist.

    A section can name an airframe file and recorded commands. If such a path, relative to the
    working folder, leads to no file, it is tried relative to the folder of the parameter file. If
    that fails, its bare file name is tried in the folder of the parameter file. A path stays as it
    is if no file is found.
    """
    recorded = sections.get("reference_model", {}).get("recorded")
    signals = recorded.values() if isinstance(recorded, Mapping) else ()
    aircraft = sections.get("aircraft", {})
    files = [(aircraft, "airframe", ".yaml"), *((part, "file", "") for part in signals)]
    for part, key, ending in files:
        file = part.get(key) if isinstance(part, dict) else None
        if isinstance(file, str) and file.endswith(ending) and not is_file(Path(file)):
            candidates = (path.parent.absolute() / name for name in (file, Path(file).name))
            part[key] = str(next(filter(is_file, candidates), file))


def guidance_by_rule(
    aircraft: AircraftConfig, reference: ReferenceModelConfig, controller: ControllerConfig
) -> dict[str, Any]:
    """Compute the parameters of guidance that follow from the other sections.

    For RISE-DI, they include the authority of throttle and of aileron: the largest effect of the
    input, abs(Omega_ii) u. Here Omega_ii = omega / input_scale, and u is the limit of this input as
    a deviation from trim. For a controller without these numbers, the result has no authorities.
    Raises ParameterError if the reference model or the aircraft does not suit guidance.
    """
    key = "reference_model.second_order"
    channels = aircraft.channels()
    if reference.second_order is None:
        raise ParameterError(
            f"{key}: found linear, expected second_order: guidance needs its bounds on y_m_ddot"
        )
    climbs = vertical(reference.outputs)
    required = [name for name in RATES_AND_SPEED if name != "V"] if climbs else WITHOUT_RUDDER
    missing = [name for name in required if name not in reference.outputs]
    require(
        not missing,
        "guidance",
        f"an aircraft without {', '.join(missing)}",
        f"one with {', '.join(WITHOUT_RUDDER)}, or p, q, r and {' or '.join(VERTICAL)}",
    )
    values: dict[str, Any] = {
        "outputs": reference.outputs,
        "natural_frequency": reference.second_order.natural_frequency,
    }
    if not climbs:
        values["speed"] = channels.speed
    if isinstance(controller, RiseDiConfig) and controller.lower and controller.upper:

        def effect(i: int) -> float:
            return controller.omega[i] / controller.input_scale[i]

        at_p = controller.outputs.index("p")
        if not climbs:
            at_v = controller.outputs.index("V")
            values["throttle_authority"] = tuple(
                abs(limits[at_v]) * effect(at_v) for limits in (controller.lower, controller.upper)
            )
        values["roll_authority"] = min(-controller.lower[at_p], controller.upper[at_p]) * effect(
            at_p
        )
    return values


def scenario_yaml(
    scenario: Scenario, overrides: Mapping[str, Mapping[str, Any]] | None = None
) -> str:
    """Write a scenario file as text with every parameter, defaults included.

    `overrides` replace parameters by section. A parameter is left out if its value is None or
    empty, because such a value is its default.

    Args:
        scenario: The scenario to write.
        overrides: New values of parameters by section and name.

    Returns:
        The text, YAML.

    Raises:
        ParameterError: `scenario` is no Scenario.

    Examples:
        >>> text = rise_di.scenario_yaml(rise_di.find_scenario("osprey_servo"))
        >>> "controller:" in text
        True
    """
    as_scenario(scenario)
    sections = {}
    for name, schema in SCHEMAS.items():
        section: Config | None = getattr(scenario, name)
        if section is None:
            continue
        merged = schema.validate_mapping(
            section.model_dump() | dict((overrides or {}).get(name, {})), name
        )
        # The start time is known only when all nodes run. `truth` holds it.
        sections[f"/**/{name}"] = {
            "ros__parameters": _yaml_values(merged.model_dump(exclude={"start_time"}))
        }
    return dump_yaml(sections)


def _yaml_values(values: Any) -> Any:
    """Return the values with lists in place of tuples.

    An item of a mapping is left out if its value is None, or an empty text, list or mapping.
    """
    if isinstance(values, Mapping):
        converted = {key: _yaml_values(value) for key, value in values.items()}
        return {key: value for key, value in converted.items() if value not in (None, "", [], {})}
    return [_yaml_values(value) for value in values] if isinstance(values, tuple) else values


def check_together(scenario: Scenario) -> None:
    """Raise ParameterError if the channels and rates of the sections do not fit together."""
    channels = scenario.aircraft.channels()
    controller = scenario.controller
    reference = scenario.reference_model
    airframe = f"the airframe {scenario.aircraft.airframe}"
    effectors = (
        "controller.inputs" if controller.allocation is None else "controller.allocation.effectors"
    )
    require_channels(
        effectors, controller.effectors, tuple(channels.inputs), f"the channels of {airframe}"
    )
    unknown = [name for name in controller.outputs if name not in channels.outputs]
    expected = f"some of the outputs of {airframe}: {', '.join(channels.outputs)}"
    require(not unknown, "controller.outputs", ", ".join(controller.outputs), expected)
    missing = [name for name in controller.vanes if name not in channels.outputs]
    require(
        not missing,
        "controller.observer.vanes.channels",
        ", ".join(controller.vanes),
        "channels in aircraft.vanes.channels",
    )
    require_channels(
        "reference_model.outputs",
        reference.outputs,
        controller.outputs,
        "the outputs in controller.outputs",
    )
    control_ns = period_ns(controller.rate, "controller.rate")
    for key, rate in (
        ("aircraft.rate", scenario.aircraft.rate),
        ("reference_model.rate", reference.rate),
    ):
        divides = control_ns % period_ns(rate, key) == 0
        require(
            divides,
            key,
            f"{rate:g} Hz",
            f"a whole multiple of controller.rate ({controller.rate:g} Hz)",
        )
    if scenario.guidance is not None:
        _check_guidance(scenario, scenario.guidance)


def limits_beyond_stops(scenario: Scenario) -> tuple[str, ...]:
    """Return a warning for each limit of the controller that is beyond the actuator's end stop.

    With such a limit, the anti-windup starts too late, because the actuator saturates before u
    does.
    """
    controller = scenario.controller
    actuators = scenario.aircraft.actuators
    section = "controller" if controller.allocation is None else "controller.allocation"
    sentences = []
    for key, sign in (("lower", -1.0), ("upper", 1.0)):
        stops = dict(
            zip(
                scenario.aircraft.channels().inputs,
                getattr(actuators, key),
                strict=bool(getattr(actuators, key)),
            )
        )
        limits = dict(
            zip(
                controller.effectors,
                getattr(controller.effector_limits(), key).tolist(),
                strict=True,
            )
        )
        for name, stop in stops.items():
            limit = limits.get(name, sign * math.inf)
            if sign * limit > sign * stop + STOP_TOLERANCE * abs(stop):
                sentences.append(
                    f"{section}.{key} of {name}: found {limit:g}, expected the end stop "
                    f"{stop:g} or less far out"
                )
    return tuple(sentences)


def require_guidable(scenario: Scenario) -> None:
    """Check that guidance can fly a scenario. Raises ParameterError if it cannot.

    Guidance cannot fly if a bank does not turn the simulated airframe, or if the flight begins
    outside a fence. Do not call this for a flight with a real autopilot behind the bridge, because
    the airframe that flies there is not in the scenario.
    """
    aircraft = scenario.aircraft
    guidance = scenario.guidance
    if guidance is None:
        return
    kinematics = "euler" if guidance.drag is None else "thrust"
    turns = {"euler": "a bank turns the aircraft", "thrust": "a tilt accelerates the multicopter"}
    require(
        aircraft.is_jsbsim or aircraft.kinematics == kinematics,
        "aircraft.kinematics",
        f"{aircraft.kinematics!r} beside guidance",
        f"{kinematics}: {turns[kinematics]}",
    )
    start = aircraft.start
    inside = guidance.fence_clearance(start.north, start.east)
    position = (
        f"the start {clearance_text(inside)}, at north {start.north:g} m, east {start.east:g} m"
    )
    require(inside >= 0.0, "guidance.fence", position, "a start inside")


def _check_guidance(scenario: Scenario, guidance: GuidanceConfig) -> None:
    reference = scenario.reference_model
    aircraft = scenario.aircraft
    rule = guidance_by_rule(aircraft, reference, scenario.controller)
    for key in [key for key in ("speed", "outputs", "natural_frequency") if key in rule]:
        value = getattr(guidance, key)
        require(
            value == rule[key],
            f"guidance.{key}",
            value,
            f"{rule[key]}, as the other sections have it",
        )
    levels = (
        f"the trim speed {guidance.speed:g} m/s, by which the wings are levelled when "
        "guidance is lost"
    )
    require(
        reference.live.speed is not None or guidance.drag is not None,
        "reference_model.live.speed",
        "none beside guidance",
        levels,
    )
    require(
        guidance.drag is None or not scenario.has_learner(),
        "controller.learn",
        "a section beside the guidance of a multicopter",
        "none: its limits do not follow a learned model",
    )
    pose_ns = every(aircraft.rate) * period_ns(aircraft.rate, "aircraft.rate")
    period = period_ns(guidance.rate, "guidance.rate")
    slowest = (
        f"more than {1.0 / reference.live.max_age:g} Hz: the reference model ends a u_m "
        "older than live.max_age"
    )
    require(
        period < nanoseconds(reference.live.max_age),
        "guidance.rate",
        f"{guidance.rate:g} Hz",
        slowest,
    )
    for what, part_ns in (
        ("pose", pose_ns),
        ("y_m", period_ns(reference.rate, "reference_model.rate")),
    ):
        rate = f"a whole fraction of the rate of {what} ({NANOSECONDS / part_ns:g} Hz)"
        require(period % part_ns == 0, "guidance.rate", f"{guidance.rate:g} Hz", rate)


def opposite_signs(scenario: Scenario) -> tuple[str, ...]:
    """Return a warning if D contradicts the signs of C B in the airframe file.

    With wrong signs the law drives y away from y_m. If there is an allocation, or no airframe file,
    nothing is compared.
    """
    controller = scenario.controller
    aircraft = scenario.aircraft
    if aircraft.is_jsbsim or controller.allocation is not None:
        return ()
    airframe = load_airframe(aircraft.airframe)
    rows = [airframe.outputs.index(name) for name in controller.outputs]
    columns = [list(airframe.inputs).index(name) for name in controller.inputs]
    Omega = (airframe.matrix_c() @ airframe.matrix_b())[np.ix_(rows, columns)]
    try:
        expected = signs(Omega).astype(int).tolist()
    except DecompositionError as error:
        return (f"controller.inputs: {error}",)
    if expected == list(controller.D):
        return ()
    return (f"controller.D: found {list(controller.D)}, expected {expected}, the signs of C B",)
