# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Trim an aircraft of JSBSim, in an isolated process."""

import os
import re
import tempfile
from functools import cache
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import jsbsim
import numpy as np

from aircraft_sim.jsbsim.jsbsim_aircraft import (
    INPUTS,
    RESIDUALS,
    STATES,
    FlightCondition,
    NamedProperties,
    Trim,
    foreign_model,
    root,
)
from aircraft_sim.jsbsim.jsbsim_commands import (
    FROZEN,
    command_paths,
    commands_and_limits,
    engine_count,
    hysteresis_of,
    residuals,
    sentence_without_effect,
    set_command,
    settle,
    without_effect,
)
from aircraft_sim.jsbsim.jsbsim_files import model_files
from flight_core import isolated
from flight_core.notes import note
from flight_core.outcome import FlightEnded
from flight_core.parameters import ParameterError
from flight_core.rates import nanoseconds, seconds
from flight_core.units import FOOT
from flight_core.vectors import FloatArray

HEADING = "attitude/psi-rad"
HEIGHT = "position/h-agl-ft"
CONTACT = "forces/fbz-gear-lbs"
FUEL = "propulsion/total-fuel-lbs"

WIND = ("atmosphere/wind-north-fps", "atmosphere/wind-east-fps", "atmosphere/wind-down-fps")

MIXTURE = 0.9  # mixture of piston engines: rich
BOTH_MAGNETOS = 3.0  # ignition of piston engines; 0 is off, 1 left, 2 right
SETTLE = 10.0  # s of frozen flight in which running engines settle
SPIN_UP = 30.0  # s of frozen flight in which engines settle that have just been started
# SETTLE and SPIN_UP for a propeller that is slow to reach its speed, such as one of an electric
# engine with a time constant of 10 s.
SLOW_SETTLE = 80.0
SLOW_SPIN_UP = 300.0

ATTEMPTS = (
    (SETTLE, SPIN_UP, 0.0),
    (SLOW_SETTLE, SLOW_SPIN_UP, 0.0),
    (SETTLE, SPIN_UP, 1.0),
    (SLOW_SETTLE, SLOW_SPIN_UP, 1.0),
)
"""Attempts of the solver, in order: the settling times of running and of started engines, s, and
the fraction of the pitch trim that the elevator provides. A model without a property for the trim
needs 1."""

# If accelerations of up to this multiple of TOLERANCE remain, the engine may not have settled yet.
# Larger ones have another cause.
NEAR = 100.0
FAR = 1e6  # multiple of TOLERANCE that replaces accelerations that are not finite
IDLE = 0.01  # throttle below which a running engine may give no thrust

# First guess of the unknowns: alpha (rad), throttle, pitch trim, aileron, rudder (1), bank (rad).
START = np.array([0.05, 0.7, 0.0, 0.0, 0.0, 0.0])
SCALE = np.array([0.1, 0.5, 0.5, 0.5, 0.5, 0.1])  # scales of these unknowns for the solver
# Bounds of these unknowns.
LOWEST = (-0.5, 0.0, -1.0, -1.0, -1.0, -0.5)
HIGHEST = (0.5, 1.0, 1.0, 1.0, 1.0, 0.5)
# m/s^2, rad/s^2, largest accelerations in trim. A tenth of a degree of attitude causes as much.
TOLERANCE = np.array([0.02, 0.02, 0.02, 0.002, 0.002, 0.002])

AXES_OF_RESIDUALS = ("forward", "sideways", "up or down", "in roll", "in pitch", "in yaw")
NEIGHBOURS = ((0.9, 1.0), (1.1, 1.0), (0.75, 1.0), (1.35, 1.0), (1.0, 0.5), (0.75, 0.5))
"""Factors on speed and altitude to try if a condition has no trim, by distance."""

PROBE_TIME = 2.0  # s, length of the test flight in the isolated process
PROBE_SIZE = 0.02  # change of each command in the test flight
# s of processor time for trim and test flight; every aircraft that trims needs less than 1 s.
TIMEOUT = 30.0
NEAR_TIMEOUT = 3.0  # s of processor time for a condition near one that has no trim

TrimSolution = tuple[float, ...] | None
"""The scaled unknowns that the solver found, and then the spin-up time and the elevator's fraction
from ATTEMPTS. None if the trim function of JSBSim succeeded, which gives the same bits everywhere.
"""


class _Log(jsbsim.FGLogger):
    """A logger that keeps JSBSim's messages off the console.

    `last` has the last two errors, because the second one often says only where the first one
    occurred.
    """

    def __init__(self) -> None:
        super().__init__()
        self.last: tuple[str, ...] = ()
        self._level = jsbsim.LogLevel.BULK
        self._message = ""

    def set_level(self, level: jsbsim.LogLevel) -> None:
        self._level = level
        self._message = ""

    def file_location(self, filename: str, line: int) -> None:
        pass

    def message(self, message: str) -> None:
        self._message += message

    def format(self, format: jsbsim.LogFormat) -> None:  # noqa: A002 - the name is JSBSim's
        pass

    def flush(self) -> None:
        if self._level in {jsbsim.LogLevel.ERROR, jsbsim.LogLevel.FATAL}:
            self.last = (*self.last[-1:], " ".join(self._message.split()).rstrip("."))


class Unbalanced(NamedTuple):
    """What the solver returns if it reaches no trim: a sentence on the remaining accelerations."""

    sentence: str


class NotBalanced(FlightEnded):
    """Raised if the solver does not reach a trim; a condition nearby may have a trim."""


@cache
def trim_solution(condition: FlightCondition, timeout: float = TIMEOUT) -> TrimSolution:
    """Find the trim and make a short test flight in an isolated process.

    JSBSim may crash or hang in this process, which raises FlightEnded.
    """
    try:
        foreign = foreign_model(condition.name) is not None
        unknowns = isolated.call(solve_and_probe, *condition, timeout=timeout, foreign=foreign)
    except isolated.IsolatedCallError as error:
        raise FlightEnded(f"{condition.title} cannot be flown: JSBSim {error}") from None
    if isinstance(unknowns, Unbalanced):
        raise NotBalanced(unknowns.sentence)
    return None if unknowns is None else tuple(unknowns)


def solve_and_probe(
    name: str,
    speed: float,
    altitude: float,
    step_ns: int,
    named: tuple[tuple[str, NamedProperties], ...] = (),
) -> TrimSolution | Unbalanced:
    """Find and apply the trim, and make a test flight with each command changed by PROBE_SIZE.

    If the solver does not reach a trim, returns Unbalanced. Raises FlightEnded for other failures.
    """
    condition = FlightCondition(
        name=name, speed=speed, altitude=altitude, step_ns=step_ns, named=named
    )
    solution = _solve_trim(condition)
    if isinstance(solution, Unbalanced):
        return solution
    fdm, _ = trimmed_fdm(condition, solution)
    try:
        for command in condition.commands().values():
            for path, at_one in command_paths(command, engine_count(fdm)):
                size = (
                    PROBE_SIZE if fdm[path] / at_one < command.upper - PROBE_SIZE else -PROBE_SIZE
                )
                fdm[path] += at_one * size
            for _ in range(nanoseconds(PROBE_TIME) // step_ns // len(INPUTS)):
                fdm.run()
    except jsbsim.BaseError as error:
        raise FlightEnded(f"{condition.title} cannot be flown: {error_text(error)}") from None
    return solution


def trimmed_fdm(
    condition: FlightCondition, solution: TrimSolution
) -> tuple[jsbsim.FGFDMExec, Trim]:
    """Load the aircraft and put it into a trim that was found before.

    Raises FlightEnded if the aircraft cannot be loaded.
    """
    fdm = _load(condition)
    if solution is None:
        _jsbsim_trim(fdm, condition)
    else:
        *unknowns, spin_up, by_elevator = solution
        _start_engines(fdm, condition)
        _set_unknowns(fdm, condition, np.array(unknowns), by_elevator)
        settle(fdm, spin_up)
    states = np.array([fdm[quantity.property] * quantity.si for quantity in STATES.values()])
    return fdm, Trim(
        *commands_and_limits(fdm, condition.commands().values()), states, residuals(fdm)
    )


def structure_contacts(fdm: jsbsim.FGFDMExec) -> list[str]:
    """Return the properties that are 1 while the structure, and not a wheel, touches the ground."""
    catalog = fdm.query_property_catalog("contact/unit")
    lines = catalog.splitlines() if isinstance(catalog, str) else catalog
    return [line.split()[0] for line in lines if "/WOW" in line]


def running_property(engine: int) -> str:
    """Return the name of the property that is 1 while an engine runs.

    JSBSim never sets this property to 1 for an electric engine.
    """
    return f"propulsion/engine[{engine}]/set-running"


def thrust_property(engine: int) -> str:
    """Return the name of the property that has the thrust of an engine, lbf."""
    return f"propulsion/engine[{engine}]/thrust-lbs"


def cut_engines(fdm: jsbsim.FGFDMExec, cut: bool) -> None:
    """Cut off the fuel of all turbines and turboprops, and the ignition of all pistons.

    If `cut` is false, fuel and ignition are switched on again. An electric engine and a rocket need
    no such switch, because they stop at throttle 0. A turbine idles and gives thrust there.
    """
    fdm["propulsion/cutoff_cmd"] = float(cut)
    fdm["propulsion/magneto_cmd"] = 0.0 if cut else BOTH_MAGNETOS


def error_text(error: jsbsim.BaseError) -> str:
    """Return the message of an error of JSBSim on a single line.

    Most often it says that a property is missing which a flight simulator around JSBSim would
    provide.
    """
    text = " ".join(str(error).split())
    missing = re.search(r"The property (\S+) does not exist", text)
    if missing is None:
        return text
    return f"its model needs the property {missing[1]}, which JSBSim alone does not have"


def _solve_trim(condition: FlightCondition) -> TrimSolution | Unbalanced:
    """Find the trim in level, straight flight without sideslip, with the bank that this needs.

    The trim function of JSBSim comes first. It assumes settled engines and flight control systems,
    so they get time in frozen flight, where everything runs except position, velocity and attitude.
    If the function finds no trim, or none that lasts, a solver finds the six unknowns (alpha,
    throttle, pitch trim, aileron, rudder, bank) in frozen flight, where everything has settled.
    Raises FlightEnded with one sentence if there is no trim. Returns Unbalanced if the solver does
    not reach a trim.
    """
    fdm = _load(condition)
    try:
        if not condition.named and _jsbsim_trim(fdm, condition):
            return None
        _require_effect(condition)
        nearest = np.inf
        residual = np.inf
        problem: str | Unbalanced | None = None
        for settling, spin_up, by_elevator in ATTEMPTS:
            if spin_up == SLOW_SPIN_UP and residual > NEAR:
                continue
            solution = (
                *_solve_accelerations(fdm, condition, settling, by_elevator),
                spin_up,
                by_elevator,
            )
            attempt, _ = trimmed_fdm(condition, solution)
            if _is_trimmed(attempt, condition):
                return solution
            residual = float(np.max(np.abs(residuals(attempt)) / TOLERANCE))
            if residual < nearest or problem is None:
                nearest = residual
                problem = _trim_failure(attempt, condition)
            # If the solver ends far from a trim, it may leave numbers that are not finite.
            fdm = _load(condition)
    except jsbsim.BaseError as error:
        problem = error_text(error)
    begin = (
        f"{condition.title} does not trim at {condition.speed:g} m/s and {condition.altitude:g} m: "
    )
    end = hysteresis_of(foreign_model(condition.name))
    if isinstance(problem, Unbalanced):
        return Unbalanced(f"{begin}{problem.sentence}{end}")
    raise FlightEnded(f"{begin}{problem}{end}")


def _require_effect(condition: FlightCondition) -> None:
    """Check that elevator and throttle have an effect, because else no trim can be found.

    Raises FlightEnded if one has none.
    """
    fdm = _load(condition)
    commands = condition.commands()
    _start_engines(fdm, condition)
    still = without_effect(fdm, commands)
    if {"elevator", "throttle"} & set(still):
        sentence = sentence_without_effect(fdm, commands, still, foreign_model(condition.name))
        raise FlightEnded(f"{condition.title} cannot be flown: {sentence}")


def _load(condition: FlightCondition) -> jsbsim.FGFDMExec:
    with tempfile.TemporaryDirectory() as folder:
        try:
            fdm = _loaded(foreign_model(condition.name), condition.name, Path(folder))
        except (ParameterError, jsbsim.BaseError, OSError) as error:
            reason = error_text(error) if isinstance(error, jsbsim.BaseError) else str(error)
            raise FlightEnded(f"{condition.title} cannot be loaded: {reason}") from None
    fdm.disable_output()
    fdm.set_dt(seconds(condition.step_ns))
    manager = fdm.get_property_manager()
    engines = engine_count(fdm)
    if not engines:
        raise FlightEnded(
            f"{condition.title} has no engine to control V with: no "
            f"{INPUTS['throttle'].property}[0]"
        )
    # JSBSim would create a property that does not exist.
    for path in _properties(condition, engines):
        if not manager.hasNode(path):
            raise FlightEnded(f"{condition.title} cannot be flown: it has no property {path}")
    fdm["ic/h-sl-ft"] = condition.altitude / FOOT
    fdm["ic/vt-fps"] = condition.speed / FOOT
    fdm["ic/gamma-deg"] = fdm["ic/psi-true-deg"] = 0.0
    fdm["gear/gear-cmd-norm"] = fdm["gear/gear-pos-norm"] = 0.0  # up
    for i in range(engines):
        fdm[f"fcs/mixture-cmd-norm[{i}]"] = MIXTURE
        fdm[f"fcs/throttle-cmd-norm[{i}]"] = START[1]
        fdm[f"fcs/advance-cmd-norm[{i}]"] = 1.0  # propellers at fine pitch
    return fdm


def _loaded(foreign: Path | None, name: str, folder: Path) -> jsbsim.FGFDMExec:
    """Load a model of the package by its name, or a foreign model as a copy in `folder`.

    Raises ParameterError, OSError and BaseError.
    """
    log = _Log()
    # Each thread has its own logger.
    jsbsim.set_logger(log)
    fdm = jsbsim.FGFDMExec(str(root() if foreign is None else folder))
    fdm.set_debug_level(0)
    # Some models write tables into the working folder while they load.
    fdm.set_output_path(os.devnull)
    if foreign is not None:
        files = model_files(foreign)
        fdm.set_aircraft_path(str(files.write(folder).parent))
        if files.left_out:
            note(
                f"{foreign.name}: left out {', '.join(files.left_out)}: a foreign model opens "
                "no socket and writes no file"
            )
    if not fdm.load_model(name if foreign is None else foreign.stem, foreign is None):
        raise ParameterError("; ".join(log.last) or "JSBSim gives no reason")
    return fdm


def _properties(condition: FlightCondition, engines: int) -> list[str]:
    """List every property that is read or written in flight."""
    inputs = condition.commands().values()
    commands = [
        path
        for path, _ in chain.from_iterable(command_paths(command, engines) for command in inputs)
    ]
    trims = [command.trim_property for command in inputs if command.trim_property is not None]
    states = [quantity.property for quantity in STATES.values()]
    residuals = [f"accelerations/{name}" for name in RESIDUALS]
    running = map(running_property, range(engines))
    thrusts = map(thrust_property, range(engines))
    return [
        *commands,
        *trims,
        *states,
        *WIND,
        HEADING,
        HEIGHT,
        CONTACT,
        *residuals,
        *running,
        *thrusts,
        *FROZEN,
    ]


def _jsbsim_trim(fdm: jsbsim.FGFDMExec, condition: FlightCondition) -> bool:
    """Apply the trim function of JSBSim, and return whether it succeeds and lasts."""
    fdm.run_ic()
    fdm["propulsion/set-running"] = -1  # all engines
    try:
        fdm.do_trim(jsbsim.TrimMode.FULL)
    except jsbsim.TrimFailureError:
        return False
    settle(fdm, SETTLE)
    return _is_trimmed(fdm, condition)


def _solve_accelerations(
    fdm: jsbsim.FGFDMExec, condition: FlightCondition, settling: float, by_elevator: float
) -> tuple[float, ...]:
    """Find the trim at which accelerations vanish after `settling` s of frozen flight.

    The unknowns are x = START + (scaled - 1) SCALE, and the result is `scaled`. `by_elevator` is
    the share of the pitch trim that the command of the elevator sets instead of the trim property.
    If `by_elevator` is not 0, the search stays within LOWEST and HIGHEST.
    """
    from scipy.optimize import fsolve, least_squares  # noqa: PLC0415 - a sixth of a second, which other aircraft do not need

    def accelerations(scaled: FloatArray) -> FloatArray:
        _set_unknowns(fdm, condition, scaled, by_elevator)
        settle(fdm, settling)
        return residuals(fdm)

    _start_engines(fdm, condition)
    # The unknowns stay inside the stops even if an input has no effect, as in a flying wing without
    # a rudder.
    if by_elevator:

        def weighted(scaled: FloatArray) -> FloatArray:
            return np.asarray(
                np.nan_to_num(accelerations(scaled) / TOLERANCE, nan=FAR, posinf=FAR, neginf=-FAR)
            )

        low, high = (1.0 + (np.array(end) - START) / SCALE for end in (LOWEST, HIGHEST))
        steps = np.full(len(START), 1e-3)
        fit = least_squares(
            weighted, np.ones(len(START)), bounds=(low, high), diff_step=steps, max_nfev=40
        )
        return tuple(fit.x.tolist())
    # The solver takes differences of a thousandth of SCALE. An engine that has not quite settled
    # changes the accelerations by less than such a difference does.
    scaled, *_ = fsolve(
        accelerations, np.ones(len(START)), epsfcn=1e-6, xtol=1e-6, maxfev=100, full_output=True
    )
    return tuple(scaled.tolist())


def _start_engines(fdm: jsbsim.FGFDMExec, condition: FlightCondition) -> None:
    _set_unknowns(fdm, condition, np.ones(len(START)))
    fdm["propulsion/set-running"] = -1  # all engines
    settle(fdm, SPIN_UP)


def _set_unknowns(
    fdm: jsbsim.FGFDMExec, condition: FlightCondition, scaled: FloatArray, by_elevator: float = 0.0
) -> None:
    alpha, throttle, pitch_trim, aileron, rudder, bank = (START + (scaled - 1.0) * SCALE).tolist()
    fdm["ic/alpha-rad"] = alpha
    fdm["ic/gamma-deg"] = 0.0
    fdm["ic/phi-rad"] = bank
    fdm["ic/beta-rad"] = 0.0  # a change of alpha in a bank leaves some sideslip
    fdm.run_ic()
    commands = condition.commands()
    set_command(fdm, commands["throttle"], throttle)
    trim = commands["elevator"].trim_property
    by_elevator = 1.0 if trim is None else by_elevator
    if trim is not None:
        fdm[trim] = (1.0 - by_elevator) * pitch_trim
    set_command(fdm, commands["elevator"], by_elevator * pitch_trim)
    set_command(fdm, commands["aileron"], aileron)
    set_command(fdm, commands["rudder"], rudder)


def _is_trimmed(fdm: jsbsim.FGFDMExec, condition: FlightCondition) -> bool:
    """Return whether the accelerations are within TOLERANCE and all commands inside the stops."""
    _, lower, upper = commands_and_limits(fdm, condition.commands().values())
    inside = bool(np.all(lower <= 0.0) and np.all(upper >= 0.0))
    return inside and bool(np.all(np.abs(residuals(fdm)) <= TOLERANCE))


def _trim_failure(fdm: jsbsim.FGFDMExec, condition: FlightCondition) -> str | Unbalanced:
    """Say why there is no trim: an engine does not start, or accelerations remain."""
    engines = range(engine_count(fdm))
    paths = command_paths(condition.commands()["throttle"], len(engines))
    idle = [fdm[path] < IDLE * at_one for path, at_one in paths]
    idle += idle[-1:] * (len(engines) - len(idle))  # one property can stand for several engines
    stopped = [
        str(i + 1)
        for i in engines
        if not (fdm[running_property(i)] or idle[i]) and fdm[thrust_property(i)] <= 0.0
    ]
    if stopped and not _is_startable(condition):
        return f"engine {', '.join(stopped)} cannot be started"
    accelerations = residuals(fdm)
    axis = AXES_OF_RESIDUALS[int(np.argmax(np.abs(accelerations) / TOLERANCE))]
    linear, angular = np.abs(accelerations).reshape(2, 3).max(axis=1)
    _, lower, upper = commands_and_limits(fdm, condition.commands().values())
    stopped_inputs = [
        name for name, low, high in zip(INPUTS, lower, upper, strict=True) if not low <= 0.0 <= high
    ]
    at_stops = f", with {' and '.join(stopped_inputs)} beyond the stops" if stopped_inputs else ""
    idle_text = f"; engine {', '.join(stopped)} gives no thrust there" if stopped else ""
    return Unbalanced(
        f"accelerations of {linear:.2g} m/s^2 and {angular:.2g} rad/s^2 are left at best, most "
        f"{axis}{at_stops}{idle_text}"
    )


def _is_startable(condition: FlightCondition) -> bool:
    """Return whether every engine starts at sea level at half of the speed.

    An engine that gives thrust has started, too.
    """
    fdm = _load(condition._replace(speed=0.5 * condition.speed, altitude=0.0))
    _start_engines(fdm, condition)
    return all(
        fdm[running_property(i)] or fdm[thrust_property(i)] > 0.0 for i in range(engine_count(fdm))
    )


def nearest_trim(condition: FlightCondition) -> str | None:
    """Say at which speed and altitude nearby the aircraft has a trim, or return None.

    The conditions of NEIGHBOURS are tried in order.
    """
    for speed, altitude in NEIGHBOURS:
        near = condition._replace(
            speed=speed * condition.speed, altitude=altitude * condition.altitude
        )
        try:
            trim_solution(near, NEAR_TIMEOUT)
        except FlightEnded:
            continue
        return f"it trims at {near.speed:.4g} m/s and {near.altitude:.4g} m"
    return None
