# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Replay a recorded flight by computing every tick of the controller again.

The inputs of a tick come from the log, and the results are compared with the log bit by bit.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aircraft_sim.params import AircraftConfig
from flight_analysis.closed_loop.replay_ticks import Change, ParametersInForce, Ticks
from flight_analysis.closed_loop.scenario import SCHEMAS, Scenario, parse_scenario
from flight_core.arguments import FilePath
from flight_core.arithmetic import ARITHMETIC
from flight_core.fields import short_repr
from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS
from flight_core.scenario_file import parse_sections
from flight_core.tape import Process, Signal, Tape
from flight_core.vectors import FloatArray
from flight_log.log_content import StoredFile
from flight_log.log_messages import PARAMETER
from flight_log.provenance import recorded_arithmetic
from flight_log.stored_messages import parameter_changes
from flight_log.tape_reader import RecordedRun, read_run
from rise_di_controller.controller_section import OF_NODE
from rise_di_controller.guard.guard import ControllerState
from rise_di_controller.laws import AnyLaw
from rise_di_controller.params import ControllerConfig, as_controller

# Prefixes of the channels of u, in `internals` and on the topic `u`.
U_PREFIXES = ("u.", "published.")
OPEN_LOOP = "open loop: the recorded aircraft did not fly this u"


@dataclass(frozen=True, kw_only=True)
class ReplayDifference:
    """A channel of a tick whose computed value differs from the recorded one."""

    number: int  # number of the tick's sample in `internals`
    t: float  # flight time at the stamp of the tick, s
    channel: str
    recorded: float
    computed: float  # NaN if the tick computes no value

    @property
    def ulps(self) -> int | None:
        """Distance of the computed from the recorded value in units in the last place (ULP).

        The distance is None if one of the two values is NaN.
        """
        if np.isnan(self.recorded) or np.isnan(self.computed):
            return None
        return abs(_ordinal(self.computed) - _ordinal(self.recorded))


class ReplayResult(NamedTuple):
    """The result of a replay: k channels of the N ticks of a log, as recorded and as computed.

    The channels of the topic `internals` come first, and the published u follows.
    """

    names: tuple[str, ...]
    number: NDArray[np.int64]  # the channel "number", (N,)
    t: FloatArray  # flight time, s, (N,)
    recorded: FloatArray  # (N, k)
    computed: FloatArray  # (N, k), NaN if nothing was computed
    checked: NDArray[np.bool_]  # whether the state before the tick is known, (N,)
    # whether the recorded controller had other parameters, (N,)
    other_parameters: NDArray[np.bool_]
    notes: tuple[str, ...]
    # whether y and u of the tick are on their topics, (N,)
    published: NDArray[np.bool_] | None = None

    @property
    def is_compared(self) -> NDArray[np.bool_]:
        """Mask of the ticks that are compared with the log, shape (N,).

        The state before such a tick is known, and the log has its y and u.
        """
        return self.checked if self.published is None else self.checked & self.published

    def is_different(self) -> NDArray[np.bool_]:
        """Return a mask of the computed values that differ from the log in a bit, shape (N, k)."""
        different: NDArray[np.bool_] = self.checked[:, None] & (
            _bits(self.recorded) != _bits(self.computed)
        )
        return different

    def is_equal(self) -> bool:
        """Return whether the computed ticks equal the log, and used the recorded parameters.

        Every checked tick must be equal in every bit. Ticks that were not checked do not matter.
        """
        return not self.is_different().any() and not self.other_parameters.any()

    def first(self) -> ReplayDifference | None:
        """Return the first difference in the first tick that differs, or None without a difference.

        If several channels of this tick differ, a channel of u is preferred to the others.
        """
        different = self.is_different()
        rows = np.flatnonzero(different.any(axis=1))
        if len(rows) == 0:
            return None
        row = int(rows[0])
        column = min(
            np.flatnonzero(different[row]).tolist(),
            key=lambda k: not self.names[k].startswith(U_PREFIXES),
        )
        recorded = float(self.recorded[row, column])
        computed = float(self.computed[row, column])
        return ReplayDifference(
            number=int(self.number[row]),
            t=float(self.t[row]),
            channel=self.names[column],
            recorded=recorded,
            computed=computed,
        )

    def group(self, values: FloatArray, prefix: str) -> Signal:
        """Return the channels "prefix.name" of `recorded` or `computed`, stamped with flight time.

        Args:
            values: The array `recorded` or the array `computed`, shape (N, k).
            prefix: Group of channels, such as "u".

        Returns:
            The signal of the group, with stamps in ns of flight time.
        """
        return Signal(np.round(self.t * NANOSECONDS).astype(np.int64), self.names, values).group(
            prefix
        )


def recorded_parameters(scenario: StoredFile, namespace: str | None = None) -> ControllerConfig:
    """Read the controller's parameters from the scenario of a log, or from a parameter file.

    No other section is read, so a file with only the section `controller` is enough. If the file
    has no such section for `namespace`, the section of another namespace is read. Raises
    ParameterError.
    """
    path = Path(scenario.name)
    needed = {"controller": AnyLaw}
    try:
        sections = parse_sections(scenario.content, path, needed, (), namespace)
    except ParameterError:  # the file has another namespace than the log
        sections = parse_sections(scenario.content, path, needed)
    return AnyLaw.validate_mapping(sections["controller"], "controller")


def is_controller_alone(scenario: StoredFile) -> bool:
    """Return whether a file has a section for the controller but none for an aircraft.

    Raises ParameterError if the file is no parameter file.
    """
    names = ("controller", "aircraft")
    schemas = {name: SCHEMAS[name] for name in names}
    found = parse_sections(scenario.content, Path(scenario.name), schemas, names)
    return found.keys() == {"controller"}


def recorded_scenario(run: RecordedRun | StoredFile | FilePath) -> Scenario:
    """Return the scenario of a recorded flight.

    Args:
        run: Folder or file of a run, a run as read, or a scenario as stored.

    Returns:
        The scenario of the flight.

    Raises:
        ParameterError: The run cannot be read, or has no scenario.

    Examples:
        >>> flight = rise_di.fly(rise_di.find_scenario("osprey_servo", duration=0.1))
        >>> rise_di.recorded_scenario(flight.mcap).flight.duration
        0.1
    """
    stored = run if isinstance(run, StoredFile) else _as_run(run).scenario_file()
    return parse_scenario(stored.content, Path(stored.name))


def _as_run(run: RecordedRun | FilePath) -> RecordedRun:
    return run if isinstance(run, RecordedRun) else read_run(run)


def replay(
    run: Tape | RecordedRun | FilePath,
    parameters: ControllerConfig | None = None,
    others: ControllerConfig | None = None,
    changes: Sequence[Change] | None = None,
) -> ReplayResult:
    """Compute every recorded tick again, and return the recorded and the computed values.

    The log of the ticks is the topic `internals`. A tick is (state, now, y, y_m) -> (state, u) by
    `guard.tick`. It takes y from the topic `y` at its stamp. y_m, the instant of y_m, and whether
    the controller was active come from `internals`. The results are dt, mode, e, the integrals, Pi
    and u.

    The state before a tick is the computed state after the tick before it. If that tick differs
    from the log, the state comes from the log, so that each tick is judged by itself. After a gap
    in the log, the state is the logged state of the first engaged tick. The ticks up to this one
    are not checked, and u_ff is not checked until the next engagement.

    Args:
        run: Folder or file of a run, a run as read, or a tape.
        parameters: Parameters of the recorded controller. If None, they come from the log, or from
            the scenario of a simulated tape.
        others: Parameters of another controller, which is computed in an open loop. It gets the
            recorded inputs, and its state is the computed one throughout. If the log begins later
            than the flight, the law engages in the first tick, at the recorded u.
        changes: Parameter changes in flight, in order. If None, they come from the log, but there
            are none if `others` is given. Before a tick, changes are applied until the digest of
            the parameters equals the one in the channel "parameters".

    Returns:
        The recorded and the computed values of N ticks in k channels, shape (N, k), SI.

    Raises:
        ParameterError: The topic `internals` has other channels or comes from a version with fewer
            channels, the changes are invalid, or the log was recorded with another arithmetic.

    Examples:
        >>> tape = rise_di.simulate(rise_di.find_scenario("osprey_servo", duration=0.1))
        >>> rise_di.replay(tape).is_equal()
        True
    """
    if isinstance(run, Tape):
        return _replay(run, parameters, others, changes)
    log = _as_run(run)
    log.require("internals")
    arithmetic = recorded_arithmetic(log.metadata)
    require(
        arithmetic == ARITHMETIC,
        "arithmetic",
        arithmetic,
        f"{ARITHMETIC}: a later version recorded the log",
    )
    return _replay(log, parameters, others, changes)


def _replay(
    run: Tape | RecordedRun,
    parameters: ControllerConfig | None,
    others: ControllerConfig | None,
    changes: Sequence[Change] | None,
) -> ReplayResult:
    if others is not None:
        others = as_controller(others, "others")
        changes = changes or ()
    elif changes is not None:
        listed = isinstance(changes, Sequence) and all(
            isinstance(change, Mapping) for change in changes
        )
        require(
            listed,
            "changes",
            short_repr(changes),
            "a list of changes, each a mapping of dotted names",
        )
    tape, parameters, changes = _recorded(run, parameters, changes)
    ticks = Ticks(tape, parameters)
    if others is not None:
        _require_same_channels(parameters, others)
    in_force = ParametersInForce(others or parameters, changes)
    steps = _Steps(ticks, in_force, open_loop=others is not None)
    steps.compute()
    opened = () if others is None else (OPEN_LOOP,)
    notes = (*opened, *in_force.notes(), *_coverage_notes(ticks, steps.checked))
    # If the topic `y` lacks the y of a tick, this y comes from `internals`. If the topic `u` lacks
    # the u of a tick, this u is not compared.
    missing = np.flatnonzero(~ticks.u_found)
    steps.computed[missing, -ticks.p :] = ticks.values[missing, -ticks.p :]
    return ReplayResult(
        names=ticks.names,
        number=ticks.number,
        t=ticks.t,
        recorded=ticks.values,
        computed=steps.computed,
        checked=steps.checked,
        other_parameters=steps.other_parameters,
        notes=notes,
        published=ticks.u_found & (ticks.y_found | ~ticks.flies),
    )


def _require_same_channels(recorded: ControllerConfig, others: ControllerConfig) -> None:
    """Raise ParameterError if `others` have other channels than the recorded parameters."""
    for key, names in (("outputs", "measured"), ("inputs", "inputs"), ("effectors", "effectors")):
        before = getattr(recorded, names)
        after = getattr(others, names)
        require(
            after == before,
            f"controller.{key}",
            ", ".join(after),
            f"{', '.join(before)}, as recorded",
        )


class _Steps:
    """Computes all ticks in order, each with the parameters that were in force."""

    def __init__(self, ticks: Ticks, in_force: ParametersInForce, *, open_loop: bool) -> None:
        self._ticks = ticks
        self._in_force = in_force
        self._open_loop = open_loop
        self.computed = np.full_like(ticks.values, np.nan)
        self.checked = np.zeros(len(ticks.number), dtype=bool)
        self.other_parameters = self.checked.copy()

    def compute(self) -> None:
        """Compute every tick for which the state of the controller before the tick is known."""
        ticks = self._ticks
        in_force = self._in_force
        state: ControllerState | None = None
        for k in range(len(ticks.number)):
            if ticks.begins[k]:
                in_force.begin()
                state = ticks.begin()
            state = in_force.change(int(ticks.parameters[k]), int(ticks.number[k]), state)
            self.other_parameters[k] = in_force.digest != ticks.parameters[k]
            after_gap = ticks.gap[k] and not self._open_loop and not ticks.begins[k]
            if state is None or after_gap:
                state = self._state_after_gap(k)
                if state is None or not self._open_loop:
                    continue
            state, self.computed[k] = ticks.tick(k, state, in_force.limits, in_force.law)
            self.checked[k] = True
            equal = self.computed[k].tobytes() == ticks.values[k].tobytes()
            if not equal and not self._open_loop:
                state = ticks.state(k, in_force.limits, in_force.law, state)

    def _state_after_gap(self, k: int) -> ControllerState | None:
        """Return the state with which the computation goes on at tick k, after a gap in the log.

        The log has the state after tick k but not the one before it, so the result is the recorded
        state after tick k. In an open loop, it is the state of a law that engages at tick k.
        Returns None if the recorded controller is not engaged at this tick.
        """
        if not self._ticks.flies[k]:
            return None
        state = self._ticks.state(k, self._in_force.limits, self._in_force.law)
        return self._ticks.begin(state) if self._open_loop else state


def _recorded(
    run: Tape | RecordedRun, parameters: ControllerConfig | None, changes: Sequence[Change] | None
) -> tuple[Tape, ControllerConfig, Sequence[Change]]:
    """Return the tape of a run, the controller's parameters, and their changes in flight.

    If `parameters` or `changes` are None, they are read from the run. Raises ParameterError if they
    are missing or invalid there.
    """
    if isinstance(run, Tape):
        if parameters is None and isinstance(run.scenario, Scenario):
            parameters = run.scenario.controller
        if changes is None:
            changes = run.changes
        return run, as_controller(parameters, "parameters"), changes
    if parameters is None:
        controller = recorded_parameters(run.scenario_file(), run.namespace)
    else:
        controller = as_controller(parameters, "parameters")
    if changes is None:
        changes = recorded_changes(run, controller)
    return run.tape, controller, changes


def recorded_changes(run: RecordedRun, parameters: ControllerConfig) -> Sequence[Change]:
    """Return how the parameters of the recorded controller changed in flight, in order.

    If the run has no log file, the changes come from its tape.
    """
    if run.path is None:
        return run.tape.changes
    fields = {
        name: field for name, field in type(parameters).model_fields.items() if name not in OF_NODE
    }
    return parameter_changes(run.path, f"{run.namespace}/controller", fields)


def later_aircraft(run: RecordedRun, scenario: Scenario) -> tuple[AircraftConfig, ...]:
    """Return the parameters of the simulated aircraft after each change in flight, in order."""
    node = f"{run.namespace}/aircraft"
    is_changed = any(
        each.kind == PARAMETER and each.text.startswith("aircraft:") for each in run.messages
    )
    if run.path is None or not is_changed:
        return ()
    later = []
    changes: dict[str, Any] = {}
    for change in parameter_changes(run.path, node, dict.fromkeys(AircraftConfig.tunable())):
        changes |= change
        # Each key of a gust comes as a change of its own. Only with the last of them the gust is
        # complete and valid.
        with suppress(ParameterError):
            later.append(
                AircraftConfig.validate_mapping(scenario.aircraft.changed(changes), "aircraft")
            )
    return tuple(later)


def _coverage_notes(ticks: Ticks, checked: NDArray[np.bool_]) -> Iterator[str]:
    """Yield a note on each gap of the log, and on what could therefore not be checked."""
    if len(ticks.number) and not ticks.begins[0]:
        yield f"the log begins with sample {ticks.number[0]} of internals: earlier ones are missing"
    for start in ticks.starts:
        name = _controller_at(ticks.processes, int(ticks.stamp_ns[start]))
        yield f"another controller{name} begins at t = {ticks.t[start]:.2f} s"
    steps = np.diff(ticks.number)
    gaps = np.flatnonzero(steps > 1)
    if len(gaps):
        more = f" and {len(gaps) - 1} more" if len(gaps) > 1 else ""
        missing = (steps[gaps] - 1).sum()
        yield (
            f"{missing} samples of internals are missing: a gap before t = "
            f"{ticks.t[gaps[0] + 1]:.2f} s{more}"
        )
    if unchecked := int((~checked).sum()):
        yield f"{unchecked} ticks not checked: the log does not hold the state before them"
    if unmatched := int((ticks.flies & ~ticks.y_found).sum()):
        yield f"{unmatched} ticks have no sample on the topic y: y taken from internals"
    if unmatched := int((~ticks.u_found).sum()):
        yield f"{unmatched} ticks have no sample on the topic u: what was sent is not compared"


def _controller_at(processes: Mapping[str, Process], stamp_ns: int) -> str:
    """Return the name of the controller that runs at an instant, as ", NAME," to insert in a note.

    This is the controller that began last before the instant. Returns "" if the log has no name.
    """
    begins = [
        (process.first_ns, name)
        for name, process in processes.items()
        if "/controller#" in name and process.first_ns is not None and process.first_ns <= stamp_ns
    ]
    return f", {max(begins)[1]}," if begins else ""


def _bits(values: FloatArray) -> NDArray[np.int64]:
    return np.ascontiguousarray(values).view(np.int64)


def _ordinal(value: float) -> int:
    """Return the place of a float64 among all float64 numbers in order, with 0 at place 0.

    So the difference of two places is their distance in units in the last place.
    """
    bits = int(np.float64(value).view(np.int64))
    return bits if bits >= 0 else -(bits & 0x7FFF_FFFF_FFFF_FFFF)
