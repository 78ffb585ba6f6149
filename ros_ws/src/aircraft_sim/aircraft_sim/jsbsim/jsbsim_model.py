# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The flight dynamics model of an aircraft of JSBSim, in six degrees of freedom.

It flies around a trim point like the linear aircraft.
"""

import math

import jsbsim
import numpy as np

from aircraft_sim import pose
from aircraft_sim.atmosphere import turbulence
from aircraft_sim.atmosphere.disturbance import AXES, one_minus_cosine
from aircraft_sim.atmosphere.wind_field import body_axes
from aircraft_sim.ground import touch
from aircraft_sim.jsbsim import jsbsim_trim
from aircraft_sim.jsbsim.jsbsim_aircraft import INPUTS, OUTPUTS, STATES, FlightCondition, WindModel
from aircraft_sim.jsbsim.jsbsim_commands import command_paths, engine_count, settle
from aircraft_sim.params import AircraftConfig
from aircraft_sim.plant import actuators
from aircraft_sim.plant.actuators import Actuators
from aircraft_sim.plant.plant import DIVERGENCE_LIMIT
from aircraft_sim.vanes import ANGLES
from flight_core.outcome import FlightEnded
from flight_core.rates import divide, seconds
from flight_core.units import FOOT
from flight_core.vectors import FloatArray

CLIMB = "velocities/h-dot-fps"
POSE = (
    ("attitude/phi-rad", 1.0),
    ("attitude/theta-rad", 1.0),
    ("attitude/psi-rad", 1.0),
    ("position/h-sl-ft", FOOT),
    ("velocities/v-north-fps", FOOT),
    ("velocities/v-east-fps", FOOT),
    (CLIMB, FOOT),
    ("aero/beta-rad", 1.0),
)
"""Properties of the pose other than the position, with the SI value of their units."""

THROTTLE = list(INPUTS).index("throttle")

LEAST_FUEL = 1.0
"""Fuel in all tanks, lb. If an engine stops with less than this, it is out of fuel."""


class JsbsimModel:
    """An aircraft of JSBSim behind its actuators, in trim at t = 0.

    The class is a `simulator.FlightDynamicsModel`. A step of the integration, from t_k to t_k + dt,
    is

        position+ = actuators.apply_faults(t_k, position, actuators.step(position, u, dt))
        wind+     = gusts(t_k + dt) + turbulence.wind(z+) + wind of the place
        commands  = trim + actuators.effect(t_k, position+), then JSBSim runs

    The components of the wind are along the heading, to the right and down.

    If the throttle of an engine is lost, the throttle is 0, and the engine has no fuel or no
    ignition.

    JSBSim integrates the forces of the previous step, and then computes the forces for the new
    commands and the new wind. So commands and wind act one step later. JSBSim gets the actuator
    positions at the instant t_k + dt, because it computes the forces at this instant. The mean
    positions over the step would be half a step too old.

    An isolated process tries the aircraft first. Raises FlightEnded if the aircraft has no trim, or
    if it crashes or hangs the process.
    """

    def __init__(
        self, condition: FlightCondition, actuator_model: Actuators, wind_model: WindModel
    ) -> None:
        self.condition = condition
        self._fdm, self.trim = jsbsim_trim.trimmed_fdm(
            condition, jsbsim_trim.trim_solution(condition)
        )
        engines = engine_count(self._fdm)
        # For each input: the nodes of its properties, with their values in trim and at the command
        # 1.
        self._commands = [
            [
                (node := self._node(path), node.get_double_value(), at_one)
                for path, at_one in command_paths(command, engines)
            ]
            for command in map(condition.commands().__getitem__, condition.inputs())
        ]
        self._wind_nodes = [self._node(path) for path in jsbsim_trim.WIND]
        self._state_nodes = [
            (self._node(quantity.property), quantity.si) for quantity in STATES.values()
        ]
        self._heading, self._height, self._contact = (
            self._node(path)
            for path in (jsbsim_trim.HEADING, jsbsim_trim.HEIGHT, jsbsim_trim.CONTACT)
        )
        # The number and the running flag of each engine that can stop. An electric engine has no
        # flag.
        running = {i + 1: self._node(jsbsim_trim.running_property(i)) for i in range(engines)}
        self._engines = {
            number: node for number, node in running.items() if node.get_double_value()
        }
        self._are_engines_cut = False
        self._fuel, self._climb = self._node(jsbsim_trim.FUEL), self._node(CLIMB)
        self._structure = [self._node(path) for path in jsbsim_trim.structure_contacts(self._fdm)]
        inputs = condition.inputs()
        self._no_thrust = np.where(
            [INPUTS[name].is_per_engine for name in inputs],
            -self.trim.commands[: len(inputs)],
            0.0,
        )
        self._actuator_model = actuator_model._replace(no_thrust=self._no_thrust)
        self._wind_model = wind_model
        if wind_model.turbulence is None:
            self._z = None
        else:
            self._z = turbulence.initial_state(wind_model.turbulence)
        self._position = np.zeros(len(inputs))
        self._altitude = self._node("position/h-sl-ft")
        self._position_ground = np.zeros(2)  # m to the north and to the east of the start
        self._apply_wind(self._wind(0))
        # Make one step here, so that the wind at t = 0 acts from t = 0 on.
        settle(self._fdm, seconds(condition.step_ns))
        self._x = self._deviations()
        self._pose_nodes = [(self._node(path), si) for path, si in POSE]
        self._velocity = self._ground_velocity()
        self.truth_names = (
            *(f"x.{name}" for name in STATES),
            *(f"gust.{name}" for name in AXES),
            *(f"actuator.{name}" for name in inputs),
        )

    def advance(self, t_ns: int, u: FloatArray, duration_ns: int) -> None:
        """Fly from t to t + duration with u held, shape (m,), deviations from trim.

        Raises FlightEnded if JSBSim fails, an engine stops or the aircraft touches the ground.
        """
        step_ns = self.condition.step_ns
        model = self._actuator_model
        sink = -FOOT * self._climb.get_double_value()
        dt = seconds(step_ns)
        steps = divide(duration_ns, step_ns, "step", "the duration")
        filters = self._wind_model.turbulence
        normals = () if filters is None else turbulence.normals(t_ns // step_ns, steps, filters)
        for k in range(steps):
            t = seconds(t_ns + k * step_ns)
            position = actuators.step(
                self._position, u, dt, actuators.in_force(t, self._position, model)
            )
            self._position = actuators.apply_faults(t, self._position, position, model)
            deviations = actuators.effect(t, self._position, model).tolist()
            for nodes, deviation in zip(self._commands, deviations, strict=True):
                for node, value, at_one in nodes:
                    node.set_double_value(value + at_one * deviation)
            self._cut_engines(model.lost_at is not None and bool(t >= model.lost_at[THROTTLE]))
            if filters is not None:
                self._z = turbulence.step(self._z, normals[k], filters)
            after_ns = t_ns + (k + 1) * step_ns
            air = self._wind_model
            blows = air.turbulence is not None or air.over_place is not None
            if blows or air.gusts.speed.any():
                self._apply_wind(self._wind(after_ns))
            try:
                self._fdm.run()
            except jsbsim.BaseError as error:
                title = self.condition.title
                after = seconds(after_ns)
                raise FlightEnded(
                    f"{title} failed at t = {after:.2f} s: {jsbsim_trim.error_text(error)}"
                ) from None
        self._x = self._deviations()
        before = self._velocity
        self._velocity = self._ground_velocity()
        self._position_ground = self._position_ground + seconds(duration_ns) / 2.0 * (
            before + self._velocity
        )
        self._require_flight(t_ns + duration_ns, sink)

    def _require_flight(self, t_ns: int, sink: float) -> None:
        """Check that the aircraft has not touched the ground and that its engines run.

        `sink` is the sink rate, m/s. Raises FlightEnded if not.
        """
        if self._height.get_double_value() < 0.0 or abs(self._contact.get_double_value()) > 0.0:
            is_on_wheels = not any(node.get_double_value() for node in self._structure)
            raise touch(self.condition.title, t_ns, sink, is_on_wheels=is_on_wheels)
        if stopped := [
            str(number) for number, node in self._engines.items() if not node.get_double_value()
        ]:
            why = ", out of fuel" if self._fuel.get_double_value() < LEAST_FUEL else ""
            raise FlightEnded(
                f"{self.condition.title}: engine {', '.join(stopped)} stopped at t = "
                f"{seconds(t_ns):.2f} s{why}"
            )

    def y(self) -> FloatArray:
        """Return [q, V, p, r], deviations from trim, shape (4,)."""
        return self._x[: len(OUTPUTS)]

    def air_angles(self, t_ns: int) -> FloatArray:
        """Return alpha and beta relative to the air, as deviations from trim, rad, shape (2,).

        The alpha and beta of JSBSim are relative to the air.
        """
        return self._x[[list(STATES).index(name) for name in ANGLES]]

    def truth(self, t_ns: int) -> FloatArray:
        """Return the values in the order of `truth_names`."""
        return np.concatenate([self._x, self._wind(t_ns), self._position])

    def pose(self) -> FloatArray:
        """Return the pose relative to the air mass, in the order of `channels.POSE`.

        The values are absolute, in SI. The position is integrated from the velocity by the
        trapezoidal rule.
        """
        phi, theta, psi, altitude, *velocity, beta = (
            node.get_double_value() * si for node, si in self._pose_nodes
        )
        return np.array(
            [phi, theta, pose.wrapped(psi), *self._position_ground, altitude, *velocity, beta]
        )

    def _ground_velocity(self) -> FloatArray:
        return np.array([node.get_double_value() * si for node, si in self._pose_nodes[4:6]])

    def has_diverged(self) -> bool:
        """Return whether a state is not finite, or has a component above DIVERGENCE_LIMIT."""
        return not bool(np.all(np.abs(self._x) < DIVERGENCE_LIMIT))

    def retune(self, t_ns: int, parameters: AircraftConfig) -> None:
        """Use the actuator faults and the gusts of `parameters` from t on."""
        self._actuator_model = parameters.actuator_model()._replace(no_thrust=self._no_thrust)
        self._wind_model = self._wind_model._replace(gusts=parameters.gust_arrays(AXES))

    def _cut_engines(self, cut: bool) -> None:
        """Stop the engines if `cut`, as a fault demands; otherwise start them again.

        An engine that stops here does not end the flight.
        """
        if cut == self._are_engines_cut:
            return
        jsbsim_trim.cut_engines(self._fdm, cut)
        self._are_engines_cut = cut
        self._engines = {}  # an engine that was cut off may need more than one step to run again

    def _deviations(self) -> FloatArray:
        return (
            np.array([node.get_double_value() * si for node, si in self._state_nodes])
            - self.trim.states
        )

    def _node(self, path: str) -> jsbsim.FGPropertyNode:
        node = self._fdm.get_property_manager().get_node(path)
        # the trim has checked that the property exists
        if node is None:
            raise FlightEnded(f"{self.condition.title} cannot be flown: it has no property {path}")
        return node

    def _wind(self, t_ns: int) -> FloatArray:
        """Return the wind along AXES at t, (3,), m/s.

        The turbulence must have been advanced to t.
        """
        gusts = one_minus_cosine(
            np.array(seconds(t_ns)), self._wind_model.gusts, np.array(self.condition.speed)
        )
        filters = self._wind_model.turbulence
        if (over_place := self._wind_model.over_place) is not None:
            altitude = self._altitude.get_double_value() * FOOT
            north, east = self._position_ground.tolist()
            here = over_place.at(seconds(t_ns), north, east, altitude)
            gusts = gusts + body_axes(0.0, 0.0, self._heading.get_double_value()) @ here
        return np.asarray(gusts if filters is None else gusts + turbulence.wind(self._z, filters))

    def _apply_wind(self, wind: FloatArray) -> None:
        along, right, down = (wind / FOOT).tolist()
        heading = self._heading.get_double_value()
        north = math.cos(heading)
        east = math.sin(heading)
        for node, value in zip(
            self._wind_nodes,
            (along * north - right * east, along * east + right * north, down),
            strict=True,
        ):
            node.set_double_value(value)
