# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Six-degree-of-freedom aircraft of JSBSim, flown around a trim point like any other aircraft of the stack.

JSBSim speaks feet and normalised commands from stop to stop; u, y and truth are deviations from trim in SI. What stands for
what, with unit and sign, is in the tables INPUTS and STATES, nowhere else.
"""

import difflib
import math
import os
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import jsbsim
import numpy as np

from aircraft_sim import actuators, guarded, turbulence
from aircraft_sim.actuators import Actuators
from aircraft_sim.airframe import Unit
from aircraft_sim.disturbance import AXES, Gusts, one_minus_cosine
from aircraft_sim.plant import DIVERGENCE_LIMIT
from aircraft_sim.turbulence import Turbulence
from flight_core.outcome import FlightEnded
from flight_core.parameters import require
from flight_core.rates import divide, nanoseconds, seconds
from flight_core.units import SI_PER_UNIT
from flight_core.vectors import FloatArray

PREFIX = "jsbsim:"
"""What an airframe of JSBSim begins with in a scenario, as in jsbsim:c172p."""

FOOT = SI_PER_UNIT["ft/s"]  # m, and m/s per ft/s


class Command(NamedTuple):
    """One input: a normalised command of JSBSim, unit 1."""

    property: str
    trim_property: str | None  # where the trim leaves a part of its own; JSBSim limits the sum of both
    lower: float  # end stops of the whole command
    upper: float
    each_engine: bool
    positive: str  # what a positive value does, in the models that follow JSBSim's convention


class Quantity(NamedTuple):
    """One state: a property of JSBSim, and what one of its units is in SI."""

    property: str
    si: float
    unit: Unit | None  # as people read it, of outputs


INPUTS: Mapping[str, Command] = {
    "elevator": Command("fcs/elevator-cmd-norm", "fcs/pitch-trim-cmd-norm", -1.0, 1.0, False, "nose down"),
    "throttle": Command("fcs/throttle-cmd-norm", None, 0.0, 1.0, True, "more thrust"),
    "aileron": Command("fcs/aileron-cmd-norm", "fcs/roll-trim-cmd-norm", -1.0, 1.0, False, "roll right"),
    "rudder": Command("fcs/rudder-cmd-norm", "fcs/yaw-trim-cmd-norm", -1.0, 1.0, False, "nose left"),
}

STATES: Mapping[str, Quantity] = {
    "q": Quantity("velocities/q-rad_sec", 1.0, "rad/s"),  # FRD body axes, nose up +
    "V": Quantity("velocities/vt-fps", FOOT, "m/s"),  # true airspeed
    "p": Quantity("velocities/p-rad_sec", 1.0, "rad/s"),  # roll right +
    "r": Quantity("velocities/r-rad_sec", 1.0, "rad/s"),  # nose right +
    "alpha": Quantity("aero/alpha-rad", 1.0, None),
    "theta": Quantity("attitude/theta-rad", 1.0, None),
    "beta": Quantity("aero/beta-rad", 1.0, None),
    "phi": Quantity("attitude/phi-rad", 1.0, None),
    "altitude": Quantity("position/h-sl-ft", FOOT, None),
}
"""What `truth` has as x.*, deviations from trim: the outputs in the order of y, then the rest."""

OUTPUTS: Mapping[str, Unit] = {name: one.unit for name, one in STATES.items() if one.unit is not None}

HEADING, HEIGHT, CONTACT = "attitude/psi-rad", "position/h-agl-ft", "forces/fbz-gear-lbs"

WIND = ("atmosphere/wind-north-fps", "atmosphere/wind-east-fps", "atmosphere/wind-down-fps")

RESIDUALS: Mapping[str, float] = {
    "udot-ft_sec2": FOOT,
    "vdot-ft_sec2": FOOT,
    "wdot-ft_sec2": FOOT,
    "pdot-rad_sec2": 1.0,
    "qdot-rad_sec2": 1.0,
    "rdot-rad_sec2": 1.0,
}
"""Accelerations that trim makes vanish, with what one is in SI."""

FROZEN: Mapping[str, float] = {
    "simulation/integrator/rate/rotational": 0.0,  # which scheme integrates: none
    "simulation/integrator/rate/translational": 0.0,
    "simulation/integrator/position/rotational": 0.0,
    "simulation/integrator/position/translational": 0.0,
    "propulsion/fuel_freeze": 1.0,
}
"""What makes flight stand still while engines and flight control systems run."""

MIXTURE = 0.9  # of piston engines: rich
SETTLE, SPIN_UP = 10.0, 30.0  # s of frozen flight: for engines that run, and for those that have just been started
START = np.array([0.05, 0.7, 0.0, 0.0, 0.0, 0.0])  # alpha (rad), throttle, pitch trim, aileron, rudder (1), bank (rad)
SCALE = np.array([0.1, 0.5, 0.5, 0.5, 0.5, 0.1])  # what they are scaled with for the solver
TOLERANCE = np.array([0.02, 0.02, 0.02, 0.002, 0.002, 0.002])  # m/s^2, rad/s^2: a tenth of a degree of attitude

PROBE_TIME = 2.0  # s of flight that the guarded process tries
PROBE_SIZE = 0.02  # by how much it moves each command
TIMEOUT = 30.0  # s for it all; whatever trims needs less than one


class FlightCondition(NamedTuple):
    """An aircraft of JSBSim in a flight condition: level, straight, gear up, engines running, heading north, no wind."""

    name: str  # of the aircraft, without PREFIX
    speed: float  # true airspeed, m/s
    altitude: float  # above sea level, m
    step_ns: int  # of the integration

    @property
    def title(self) -> str:
        """As sentences name it."""
        return f"{PREFIX}{self.name}"


Recipe = tuple[float, ...] | None
"""How an aircraft comes into trim: the unknowns of frozen flight, scaled, or None where JSBSim's own trim does it.

Found once, in a process of its own; following it leads to the same bits anywhere.
"""


class Trim(NamedTuple):
    """What trim came to."""

    commands: FloatArray  # (4,) whole commands in the order of INPUTS
    lower: FloatArray  # (4,) end stops as deviations from them
    upper: FloatArray  # (4,)
    states: FloatArray  # (9,) in the order of STATES, SI
    residuals: FloatArray  # (6,) accelerations that are left, in the order of RESIDUALS, SI


class WindModel(NamedTuple):
    """What blows, by the AXES of the wind."""

    gusts: Gusts
    turbulence: Turbulence | None  # of one step; None in calm air


@cache
def aircraft_names() -> tuple[str, ...]:
    """Names of all aircraft that come with JSBSim."""
    library = Path(jsbsim.get_default_root_dir()) / "aircraft"
    return tuple(sorted(path.parent.name for path in library.glob("*/*.xml") if path.stem == path.parent.name))


def require_aircraft(airframe: str) -> str:
    """Name of the aircraft in "jsbsim:NAME". Raises ParameterError with the names there are, the closest first."""
    name = airframe.removeprefix(PREFIX)
    near = difflib.get_close_matches(name, aircraft_names(), n=1, cutoff=0.4)
    listed = f"{', '.join(aircraft_names())}"
    require(
        name in aircraft_names(),
        "airframe",
        f"{airframe!r}",
        f"{PREFIX}{near[0]} perhaps, or {PREFIX} and another of {listed}" if near else f"{PREFIX} and one of {listed}",
    )
    return name


class _Log(jsbsim.FGLogger):
    """Keeps JSBSim off the console, and what it complained of last."""

    def __init__(self) -> None:
        super().__init__()
        self.last = ""
        self._level = jsbsim.LogLevel.BULK
        self._message = ""

    def set_level(self, level: jsbsim.LogLevel) -> None:
        self._level, self._message = level, ""

    def file_location(self, filename: str, line: int) -> None:
        pass

    def message(self, message: str) -> None:
        self._message += message

    def format(self, format: jsbsim.LogFormat) -> None:  # noqa: A002 - the name is JSBSim's
        pass

    def flush(self) -> None:
        if self._level in {jsbsim.LogLevel.ERROR, jsbsim.LogLevel.FATAL}:
            self.last = " ".join(self._message.split())


class JsbsimVehicle:
    """An aircraft of JSBSim behind its actuators, in trim at t = 0.

    A step of the integration, from t_k to t_k + dt:

        position+ = actuators.step(position, u, dt), or what a fault leaves of it
        wind+     = gusts(t_k + dt) + turbulence.wind(z+), along the heading, to the right of it and down
        commands  = trim + position+, then JSBSim runs

    JSBSim moves on with the forces that it found a step before, then finds those of the new commands and the new wind: both act
    one step later. Raises FlightEnded where the aircraft does not trim, crashes or hangs, each tried in another process first.
    """

    def __init__(self, point: FlightCondition, moves: Actuators, air: WindModel) -> None:
        self.point = point
        self._fdm, self.trim = _follow(point, recipe(point))
        paths = [_paths(one, _engines(self._fdm)) for one in INPUTS.values()]
        self._commands = [[self._node(path) for path in group] for group in paths]
        self._at_trim = [[node.get_double_value() for node in nodes] for nodes in self._commands]
        self._wind_nodes = [self._node(path) for path in WIND]
        self._state_nodes = [(self._node(one.property), one.si) for one in STATES.values()]
        self._heading, self._height, self._contact = (self._node(path) for path in (HEADING, HEIGHT, CONTACT))
        self._engines = [self._node(_running(i)) for i in range(_engines(self._fdm))]
        self._moves, self._air = moves, air
        self._still = air.turbulence is None and not air.gusts.speed.any()
        self._z = None if air.turbulence is None else turbulence.initial_state(air.turbulence)
        self._position = np.zeros(len(INPUTS))
        self._apply_wind(self._wind(0))
        _settle(self._fdm, seconds(point.step_ns))  # one step, so that the aircraft feels the wind of t = 0 from t = 0 on
        self._x = self._deviations()
        self.truth_names = (
            *(f"x.{name}" for name in STATES),
            *(f"gust.{name}" for name in AXES),
            *(f"actuator.{name}" for name in INPUTS),
        )

    def advance(self, t_ns: int, u: FloatArray, duration_ns: int) -> None:
        """From t to t + duration with the command u held, shape (4,), deviations from trim.

        Raises FlightEnded where JSBSim gives up, an engine stops or the aircraft touches the ground.
        """
        step_ns = self.point.step_ns
        dt, steps = seconds(step_ns), divide(duration_ns, step_ns, "step", "the duration")
        air = self._air.turbulence
        normals = () if air is None else turbulence.normals(t_ns // step_ns, steps, air.seed)
        for k in range(steps):
            moved = actuators.step(self._position, u, dt, self._moves)
            self._position = actuators.fail(seconds(t_ns + k * step_ns), self._position, moved, self._moves)
            for nodes, values, deviation in zip(self._commands, self._at_trim, self._position.tolist(), strict=True):
                for node, value in zip(nodes, values, strict=True):
                    node.set_double_value(value + deviation)
            if air is not None:
                self._z = turbulence.step(self._z, normals[k], air)
            after_ns = t_ns + (k + 1) * step_ns
            if not self._still:
                self._apply_wind(self._wind(after_ns))
            try:
                self._fdm.run()
            except jsbsim.BaseError as error:
                raise FlightEnded(f"{self.point.title} gave up at t = {seconds(after_ns):.2f} s: {_reason(error)}") from None
        self._x = self._deviations()
        now = f"at t = {seconds(t_ns + duration_ns):.2f} s"
        if self._height.get_double_value() < 0.0 or abs(self._contact.get_double_value()) > 0.0:
            raise FlightEnded(f"{self.point.title} hit the ground {now}")
        if stopped := [str(i + 1) for i, node in enumerate(self._engines) if not node.get_double_value()]:
            raise FlightEnded(f"{self.point.title}: engine {', '.join(stopped)} stopped {now}")

    def y(self) -> FloatArray:
        """[q, V, p, r], deviations from trim, shape (4,)."""
        return self._x[: len(OUTPUTS)]

    def truth(self, t_ns: int) -> FloatArray:
        """Values in the order of `truth_names`."""
        return np.concatenate([self._x, self._wind(t_ns), self._position])

    def diverged(self) -> bool:
        """Whether a state is not finite, or above DIVERGENCE_LIMIT in any component."""
        return not bool(np.all(np.abs(self._x) < DIVERGENCE_LIMIT))

    def _deviations(self) -> FloatArray:
        return np.array([node.get_double_value() * si for node, si in self._state_nodes]) - self.trim.states

    def _node(self, path: str) -> jsbsim.FGPropertyNode:
        node = self._fdm.get_property_manager().get_node(path)
        if node is None:  # _loaded has looked for it
            raise FlightEnded(f"{self.point.title} cannot be flown: it has no property {path}")
        return node

    def _wind(self, t_ns: int) -> FloatArray:
        """Wind along AXES in m/s, shape (3,), at the instant that the turbulence has come to."""
        gusts = one_minus_cosine(np.array(seconds(t_ns)), self._air.gusts, np.array(self.point.speed))
        air = self._air.turbulence
        return np.asarray(gusts if air is None else gusts + turbulence.wind(self._z, air))

    def _apply_wind(self, wind: FloatArray) -> None:
        along, right, down = (wind / FOOT).tolist()
        heading = self._heading.get_double_value()
        north, east = math.cos(heading), math.sin(heading)
        for node, value in zip(
            self._wind_nodes, (along * north - right * east, along * east + right * north, down), strict=True
        ):
            node.set_double_value(value)


@cache
def recipe(point: FlightCondition) -> Recipe:
    """Find the trim and fly for 2 s in a process of its own: whatever crashes or hangs there ends in a sentence here.

    Raises FlightEnded.
    """
    try:
        unknowns = guarded.call(try_out, *point, timeout=TIMEOUT)
    except guarded.Crashed as error:
        raise FlightEnded(f"{point.title} cannot be flown: JSBSim {error}") from None
    return None if unknowns is None else tuple(unknowns)


def try_out(name: str, speed: float, altitude: float, step_ns: int) -> Recipe:
    """Find the trim, follow it, and fly with each command moved a little; what `recipe` runs. Raises FlightEnded."""
    point = FlightCondition(name, speed, altitude, step_ns)
    found = _search(point)
    fdm, _ = _follow(point, found)
    try:
        for one in INPUTS.values():
            for path in _paths(one, _engines(fdm)):
                fdm[path] += PROBE_SIZE if fdm[path] < one.upper - PROBE_SIZE else -PROBE_SIZE
            for _ in range(nanoseconds(PROBE_TIME) // step_ns // len(INPUTS)):
                fdm.run()
    except jsbsim.BaseError as error:
        raise FlightEnded(f"{point.title} cannot be flown: {_reason(error)}") from None
    return found


def sideslip_zero(point: FlightCondition) -> float:
    """Rate at which sideslip decays (negative) or grows while p and r are held in trim, 1/s: a zero of the aircraft.

        beta_dot V = Y_beta beta + Y_u u,  0 = N_beta beta + N_u u  ->  beta_dot = (Y_beta - Y_u N_u^-1 N_beta) beta / V

    with Y the side acceleration, N those of p and r, u aileron and rudder, by central differences in frozen flight; gravity
    aside, which ties bank to it much more slowly. Positive, Assumption 3 does not hold. Raises FlightEnded.
    """
    found = recipe(point)

    def derivative(name: str, step: float) -> FloatArray:
        ends = []
        for sign in (1.0, -1.0):
            fdm, _ = _follow(point, found)
            if name == "beta":
                fdm[WIND[1]] -= sign * step * point.speed / FOOT  # wind from the right
            else:
                fdm[INPUTS[name].property] += sign * step
            _settle(fdm, 0.5)  # flight control systems answer, engines hardly
            ends.append(_residuals(fdm)[[1, 3, 5]])
        return np.asarray((ends[0] - ends[1]) / (2.0 * step))

    beta, u = derivative("beta", 0.01), np.column_stack([derivative(name, 0.05) for name in ("aileron", "rudder")])
    return float(beta[0] - u[0] @ np.linalg.solve(u[1:], beta[1:])) / point.speed


def _running(engine: int) -> str:
    return f"propulsion/engine[{engine}]/set-running"


def _engines(fdm: jsbsim.FGFDMExec) -> int:
    return int(fdm.get_propulsion().get_num_engines())


def _properties(engines: int) -> list[str]:
    """Every property that is read or written in flight."""
    commands = [path for one in INPUTS.values() for path in _paths(one, engines)]
    trims = [one.trim_property for one in INPUTS.values() if one.trim_property is not None]
    states = [one.property for one in STATES.values()]
    residuals = [f"accelerations/{name}" for name in RESIDUALS]
    running = [_running(i) for i in range(engines)]
    return [*commands, *trims, *states, *WIND, HEADING, HEIGHT, CONTACT, *residuals, *running, *FROZEN]


def _paths(command: Command, engines: int) -> list[str]:
    return [f"{command.property}[{i}]" for i in range(engines)] if command.each_engine else [command.property]


def _reason(error: jsbsim.BaseError) -> str:
    """What JSBSim says, on one line; mostly it misses a property that a flight simulator around it would have made."""
    text = " ".join(str(error).split())
    missing = re.search(r"The property (\S+) does not exist", text)
    return text if missing is None else f"its model needs the property {missing[1]}, which JSBSim alone does not have"


# Trim


def _search(point: FlightCondition) -> Recipe:
    """The way into trim: level, straight, sideslip 0, the wings banked as far as that takes.

    JSBSim's own trim comes first. It takes engines and flight control systems for settled, so they are given time in frozen
    flight: everything runs but position, velocity and attitude. Where it fails, or what it found does not last, the six
    unknowns (alpha, throttle, pitch trim, aileron, rudder, bank) are solved for in frozen flight, where everything is settled.
    Raises FlightEnded with one sentence where there is no trim.
    """
    fdm = _loaded(point)
    try:
        if _own_trim(fdm):
            return None
        unknowns = _solve(fdm)
        fdm, _ = _follow(point, unknowns)
    except jsbsim.BaseError as error:
        problem = _reason(error)
    else:
        if _at_rest(fdm):
            return unknowns
        problem = _what_is_left(fdm)
    raise FlightEnded(f"{point.title} does not trim at {point.speed:g} m/s and {point.altitude:g} m: {problem}")


def _follow(point: FlightCondition, way: Recipe) -> tuple[jsbsim.FGFDMExec, Trim]:
    """The aircraft where the recipe leads. Raises FlightEnded where it cannot be loaded."""
    fdm = _loaded(point)
    if way is None:
        _own_trim(fdm)
    else:
        _start_engines(fdm)
        _place(fdm, np.array(way))
        _settle(fdm, SPIN_UP)
    states = np.array([fdm[one.property] * one.si for one in STATES.values()])
    return fdm, Trim(*_commanded(fdm), states, _residuals(fdm))


def _loaded(point: FlightCondition) -> jsbsim.FGFDMExec:
    log = _Log()
    jsbsim.set_logger(log)  # of this thread
    fdm = jsbsim.FGFDMExec(None)
    fdm.set_debug_level(0)
    fdm.set_output_path(os.devnull)  # some models write tables into the working folder before they can be told not to
    try:
        loaded = fdm.load_model(point.name)
    except jsbsim.BaseError as error:
        raise FlightEnded(f"{point.title} cannot be loaded: {_reason(error)}") from None
    if not loaded:
        raise FlightEnded(f"{point.title} cannot be loaded: {log.last or 'JSBSim does not say why'}")
    fdm.disable_output()
    fdm.set_dt(seconds(point.step_ns))
    manager, engines = fdm.get_property_manager(), _engines(fdm)
    if not engines:
        raise FlightEnded(f"{point.title} has no engine, so nothing to fly V with: no {INPUTS['throttle'].property}[0]")
    for path in _properties(engines):  # JSBSim would make up a property that it does not have
        if not manager.hasNode(path):
            raise FlightEnded(f"{point.title} cannot be flown: it has no property {path}")
    fdm["ic/h-sl-ft"], fdm["ic/vt-fps"] = point.altitude / FOOT, point.speed / FOOT
    fdm["ic/gamma-deg"] = fdm["ic/psi-true-deg"] = 0.0
    fdm["gear/gear-cmd-norm"] = fdm["gear/gear-pos-norm"] = 0.0  # up
    for i in range(engines):
        fdm[f"fcs/mixture-cmd-norm[{i}]"] = MIXTURE
        fdm[f"fcs/throttle-cmd-norm[{i}]"] = START[1]
        fdm[f"fcs/advance-cmd-norm[{i}]"] = 1.0  # propellers at fine pitch
    return fdm


def _own_trim(fdm: jsbsim.FGFDMExec) -> bool:
    """JSBSim's trim, and whether it lasts."""
    fdm.run_ic()
    fdm["propulsion/set-running"] = -1  # all engines
    try:
        fdm.do_trim(jsbsim.TrimMode.FULL)
    except jsbsim.TrimFailureError:
        return False
    _settle(fdm, SETTLE)
    return _at_rest(fdm)


def _solve(fdm: jsbsim.FGFDMExec) -> tuple[float, ...]:
    """The root of the accelerations of frozen flight, as far as one was found: unknowns x = START + (scaled - 1) SCALE."""
    from scipy.optimize import fsolve  # noqa: PLC0415 - a sixth of a second, which other aircraft need not wait for

    def accelerations(scaled: FloatArray) -> FloatArray:
        _place(fdm, scaled)
        _settle(fdm, SETTLE)
        return _residuals(fdm)

    _start_engines(fdm)
    # Differences over a thousandth of the scales: engines settle to better than that.
    scaled, *_ = fsolve(accelerations, np.ones(len(START)), epsfcn=1e-6, xtol=1e-6, maxfev=100, full_output=True)
    return tuple(scaled.tolist())


def _start_engines(fdm: jsbsim.FGFDMExec) -> None:
    _place(fdm, np.ones(len(START)))
    fdm["propulsion/set-running"] = -1  # all engines
    _settle(fdm, SPIN_UP)


def _place(fdm: jsbsim.FGFDMExec, scaled: FloatArray) -> None:
    alpha, throttle, pitch_trim, aileron, rudder, bank = (START + (scaled - 1.0) * SCALE).tolist()
    fdm["ic/alpha-rad"], fdm["ic/gamma-deg"], fdm["ic/phi-rad"] = alpha, 0.0, bank
    fdm.run_ic()
    for i in range(_engines(fdm)):
        fdm[f"fcs/throttle-cmd-norm[{i}]"] = throttle
    fdm["fcs/pitch-trim-cmd-norm"], fdm["fcs/elevator-cmd-norm"] = pitch_trim, 0.0
    fdm["fcs/aileron-cmd-norm"], fdm["fcs/rudder-cmd-norm"] = aileron, rudder


def _settle(fdm: jsbsim.FGFDMExec, duration: float) -> None:
    """Frozen flight: all runs but position, velocity, attitude and the fuel."""
    usual = {path: fdm[path] for path in FROZEN}
    for path, value in FROZEN.items():
        fdm[path] = value
    for _ in range(round(duration / fdm.get_delta_t())):
        fdm.run()
    for path, value in usual.items():
        fdm[path] = value


def _residuals(fdm: jsbsim.FGFDMExec) -> FloatArray:
    return np.array([fdm[f"accelerations/{name}"] * si for name, si in RESIDUALS.items()])


def _at_rest(fdm: jsbsim.FGFDMExec) -> bool:
    """Whether hardly any acceleration is left, with every command inside its stops."""
    _, lower, upper = _commanded(fdm)
    inside = bool(np.all(lower <= 0.0) and np.all(upper >= 0.0))
    return inside and bool(np.all(np.abs(_residuals(fdm)) <= TOLERANCE))


def _what_is_left(fdm: jsbsim.FGFDMExec) -> str:
    stopped = [str(i + 1) for i in range(_engines(fdm)) if not fdm[_running(i)]]
    if stopped:
        return f"engine {', '.join(stopped)} cannot be started"
    linear, angular = np.abs(_residuals(fdm)).reshape(2, 3).max(axis=1)
    _, lower, upper = _commanded(fdm)
    beyond = [name for name, low, high in zip(INPUTS, lower, upper, strict=True) if not low <= 0.0 <= high]
    at_stops = f", with {' and '.join(beyond)} beyond the stops" if beyond else ""
    return f"accelerations of {linear:.2g} m/s^2 and {angular:.2g} rad/s^2 are left at best{at_stops}"


def _commanded(fdm: jsbsim.FGFDMExec) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Whole commands, with what the trim holds of them, and how far down and up they can be moved from there, all (4,)."""
    own = np.array([fdm[_paths(one, 1)[0]] for one in INPUTS.values()])
    trim = np.array([0.0 if one.trim_property is None else fdm[one.trim_property] for one in INPUTS.values()])
    lower, upper = (np.array([getattr(one, key) for one in INPUTS.values()]) for key in ("lower", "upper"))
    return own + trim, lower - np.minimum(own, own + trim), upper - np.maximum(own, own + trim)
