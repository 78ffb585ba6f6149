# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Replay of a recorded flight: every tick of the controller computed again from the logged inputs
and compared bit by bit.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_analysis.closed_loop.scenario import Scenario, parse_scenario, parse_scenario_sections
from flight_core.arguments import FilePath
from flight_core.arithmetic import ARITHMETIC
from flight_core.fields import short_repr
from flight_core.modes import Mode
from flight_core.parameters import require
from flight_core.rates import NANOSECONDS
from flight_core.tape import Process, Signal, Tape
from flight_core.vectors import FloatArray, StampedVector
from flight_log.flight_processes import controller_starts
from flight_log.provenance import recorded_arithmetic
from flight_log.stored_messages import parameter_changes
from flight_log.tape_reader import RecordedRun, StoredFile, read_run
from rise_di_controller import feedforward, guard, internals
from rise_di_controller.control_law import TunedLaw, restored
from rise_di_controller.guard import ControllerState, GuardParams, Vanes
from rise_di_controller.laws import AnyLaw
from rise_di_controller.params import OF_NODE, ControllerConfig, as_controller

COPIED_CHANNELS = ("y_m_offset", "number", "parameters")
"""Channels of `internals` that are copied, for a tick does not compute them."""

U_PREFIXES = (
    "u.",
    "published.",
)  # prefixes of the channels of u, from `internals` and from the topic `u`
OPEN_LOOP = "open loop: the recorded aircraft did not fly this u"

SHOWN_CHANGES = 20  # of the parameters, in the notes

Change = Mapping[
    str, Any
]  # parameters of the controller by dotted name that were changed in flight at one instant


class Difference(NamedTuple):
    """A channel of a tick whose recorded and computed values differ."""

    number: int  # of the tick's sample in `internals`
    t: float  # flight time of its stamp, s
    channel: str
    recorded: float
    computed: float  # NaN where the tick computes no value

    @property
    def ulps(self) -> int | None:
        """Distance of the values in units in the last place (ULP); None for a NaN."""
        if np.isnan(self.recorded) or np.isnan(self.computed):
            return None
        return abs(_ordinal(self.computed) - _ordinal(self.recorded))


class ReplayResult(NamedTuple):
    """The N ticks of a log as recorded and as computed, in k channels: the channels of `internals`,
    then of the topic u.
    """

    names: tuple[str, ...]
    number: NDArray[np.int64]  # (N,), the channel "number"
    t: FloatArray  # (N,), s
    recorded: FloatArray  # (N, k)
    computed: FloatArray  # (N, k), NaN where nothing was computed
    checked: NDArray[np.bool_]  # (N,), whether the state before the tick is known
    other_parameters: NDArray[
        np.bool_
    ]  # (N,), whether the recorded controller had other parameters
    notes: tuple[str, ...]
    published: NDArray[np.bool_] | None = (
        None  # (N,), whether y and u of the tick are on their topics
    )

    @property
    def compared(self) -> NDArray[np.bool_]:
        """Mask of the ticks whose y, state and u are compared, shape (N,)."""
        return self.checked if self.published is None else self.checked & self.published

    def different(self) -> NDArray[np.bool_]:
        """Mask of the values with a different bit, shape (N, k)."""
        different: NDArray[np.bool_] = self.checked[:, None] & (
            _bits(self.recorded) != _bits(self.computed)
        )
        return different

    def equal(self) -> bool:
        """Whether every checked bit is equal, and recorded with these parameters."""
        return not self.different().any() and not self.other_parameters.any()

    def first(self) -> Difference | None:
        """The first difference in the first different tick, in a channel of u if possible; None
        without a difference.
        """
        different = self.different()
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
        return Difference(
            int(self.number[row]), float(self.t[row]), self.names[column], recorded, computed
        )

    def group(self, values: FloatArray, prefix: str) -> Signal:
        """The channels "prefix.name" of `recorded` or `computed`, with flight time as stamps.

        Args:
            values: `recorded` or `computed`, shape (N, k).
            prefix: Group of channels, as "u".

        Returns:
            The signal of the group, stamps in ns of flight time.
        """
        return Signal(np.round(self.t * NANOSECONDS).astype(np.int64), self.names, values).group(
            prefix
        )


def recorded_parameters(scenario: StoredFile) -> ControllerConfig:
    """The controller's section of the scenario in a log; further sections are not validated. Raises
    ParameterError.
    """
    sections = parse_scenario_sections(scenario.content, Path(scenario.name))
    return AnyLaw.validate_mapping(sections["controller"], "controller")


def recorded_scenario(run: RecordedRun | StoredFile | FilePath) -> Scenario:
    """The scenario of a run, by the run as read, by its folder, or by its scenario as stored.

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


def vary(parameters: ControllerConfig, changes: Mapping[str, Any]) -> ControllerConfig:
    """Parameters with changes by dotted name, validated; None removes a parameter. Raises
    ParameterError.
    """
    return AnyLaw.validate_mapping(parameters.changed(changes), "controller")


def replay(
    run: Tape | RecordedRun | FilePath,
    parameters: ControllerConfig | None = None,
    others: ControllerConfig | None = None,
    changes: Sequence[Change] | None = None,
) -> ReplayResult:
    """Compute every tick of `internals` again: (state, now, y, y_m) -> (state, u) by `guard.tick`.

    A tick takes y from the topic `y` at the stamp of the tick; y_m, the instant of y_m and the
    activity of the controller come from `internals`. The results are dt, mode, e, the integrals, Pi
    and u.

    The state comes from the computation of the previous tick, after a different tick from the log,
    so a tick is judged alone. After a gap the state is the logged state of the first engaged tick.
    The ticks up to the first engaged tick are not checked, nor is u_ff until the next engagement.

    Args:
        run: Folder or file of a run, a run as read, or a tape.
        parameters: Parameters of the recorded controller; None: from the log, or from the
            scenario of a simulated tape.
        others: Parameters of an open loop: the same inputs with these parameters, and the computed
            state throughout. Where the log does not begin with the flight, the law engages in the
            first tick, at the recorded u.
        changes: Parameter changes in flight, in order; None: from the log, none beside `others`. A
            tick applies the changes up to the parameters of the channel "parameters".

    Returns:
        N ticks of k channels, as recorded and as computed, shape (N, k), SI.

    Raises:
        ParameterError: `internals` has different channels or a version with fewer channels, the
            changes are invalid, or the provenance of the log names a different arithmetic.

    Examples:
        >>> tape = rise_di.simulate(rise_di.find_scenario("osprey_servo", duration=0.1))
        >>> rise_di.replay(tape).equal()
        True
    """
    if isinstance(run, Tape):
        return _replay(run, parameters, others, changes)
    read = _as_run(run)
    recorded = recorded_arithmetic(read.metadata)
    require(
        recorded == ARITHMETIC,
        "arithmetic",
        recorded,
        f"{ARITHMETIC}: a later version recorded the log",
    )
    return _replay(read, parameters, others, changes)


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
    ticks = _Ticks(tape, parameters)
    for key, names in (("outputs", "measured"), ("inputs", "inputs"), ("effectors", "effectors")):
        wanted = getattr(parameters, names)
        declared = getattr(others or parameters, names)
        require(
            declared == wanted,
            f"controller.{key}",
            ", ".join(declared),
            f"{', '.join(wanted)}, as recorded",
        )
    in_force = _ParametersInForce(others or parameters, changes)
    computed = np.full_like(ticks.values, np.nan)
    checked = np.zeros(len(ticks.number), dtype=bool)
    other_parameters = checked.copy()
    state: ControllerState | None = None
    for k in range(len(ticks.number)):
        if ticks.begins[k]:
            in_force.begin()
            state = ticks.begin()
        state = in_force.change(int(ticks.parameters[k]), int(ticks.number[k]), state)
        other_parameters[k] = in_force.digest != ticks.parameters[k]
        if state is None or (ticks.gap[k] and others is None and not ticks.begins[k]):
            if not ticks.flies[k]:
                state = None
                continue
            state = ticks.state(k, in_force.limits, in_force.law)
            if others is None:
                continue
            state = ticks.begin(state)
        state, computed[k] = ticks.tick(k, state, in_force.limits, in_force.law)
        checked[k] = True
        if others is None and computed[k].tobytes() != ticks.values[k].tobytes():
            state = ticks.state(k, in_force.limits, in_force.law, state)
    notes = (
        (() if others is None else (OPEN_LOOP,))
        + _few(in_force.notes)
        + tuple(_coverage_notes(ticks, checked))
    )
    # A tick without a y on the topic is computed from the y in `internals`; a u that is not on the
    # topic is not compared.
    missing = np.flatnonzero(~ticks.u_found)
    computed[missing, -ticks.p :] = ticks.values[missing, -ticks.p :]
    published = ticks.u_found & (ticks.y_found | ~ticks.flies)
    return ReplayResult(
        ticks.names,
        ticks.number,
        ticks.t,
        ticks.values,
        computed,
        checked,
        other_parameters,
        notes,
        published,
    )


def _recorded(
    run: Tape | RecordedRun, parameters: ControllerConfig | None, changes: Sequence[Change] | None
) -> tuple[Tape, ControllerConfig, Sequence[Change]]:
    """The tape of a run, with the parameters and the changes of the run where none are given.
    Raises ParameterError.
    """
    if isinstance(run, Tape):
        scenario = run.scenario
        controller = (
            scenario.controller
            if parameters is None and isinstance(scenario, Scenario)
            else parameters
        )
        return (
            run,
            as_controller(controller, "parameters"),
            run.changes if changes is None else changes,
        )
    controller = (
        recorded_parameters(run.scenario_file())
        if parameters is None
        else as_controller(parameters, "parameters")
    )
    return run.tape, controller, recorded_changes(run, controller) if changes is None else changes


def recorded_changes(run: RecordedRun, parameters: ControllerConfig) -> Sequence[Change]:
    """The changes in flight of the parameters of the recorded controller, in order; those of the
    tape without a log.
    """
    if run.path is None:
        return run.tape.changes
    known = {
        name: field for name, field in type(parameters).model_fields.items() if name not in OF_NODE
    }
    return parameter_changes(run.path, f"{run.namespace}/controller", known)


class _ParametersInForce:
    """The parameters in force at a tick, and the later changes."""

    def __init__(self, parameters: ControllerConfig, changes: Sequence[Change]) -> None:
        self.notes: list[str] = []
        self._first = parameters
        self._changes = list(changes)
        self.begin()

    def begin(self) -> None:
        """Restore the parameters at the start of a controller."""
        self._unmatched: set[int] = set()
        self._apply(self._first)

    def _apply(self, parameters: ControllerConfig) -> None:
        self._parameters = parameters
        self.digest = parameters.digest()
        self.law = parameters.tuned_law()
        self.limits = parameters.guard()

    def change(
        self, digest: int, number: int, state: ControllerState | None
    ) -> ControllerState | None:
        """Apply the changes up to the parameters with a digest, if any. Returns the state
        afterwards.
        """
        if digest == self.digest or digest in self._unmatched:
            return state
        steps = [self._parameters]
        for change in self._changes:
            steps.append(vary(steps[-1], change))
            if steps[-1].digest() == digest:
                break
        else:
            self._unmatched.add(digest)
            return state
        applied = self._changes[: len(steps) - 1]
        self._changes = self._changes[len(steps) - 1 :]
        changed: set[str] = set()
        for change, old, new in zip(applied, steps, steps[1:], strict=False):
            if new != old:
                changed.update(change)
        self.notes.append(f"parameters changed before tick {number}: {', '.join(sorted(changed))}")
        for step in steps[1:]:
            if step.digest() == self.digest:
                continue
            law = self.law
            limits = self.limits
            self._apply(step)
            if state is not None:
                state = guard.retune(state, law, self.law, (limits, self.limits))
        return state


class _Ticks:
    """`internals` of a log in order of the controller's ticks, and the inputs of the ticks."""

    def __init__(self, tape: Tape, parameters: ControllerConfig) -> None:
        require(
            "internals" in tape,
            "the log",
            "no sample of internals",
            "a flight with a controller that engaged",
        )
        signal = tape["internals"]
        groups = parameters.logged_groups()
        names = internals.names(groups)
        missing = [f"no {name}" for name in names if name not in signal.names]
        differences = ", ".join(
            missing + [f"also {name}" for name in signal.names if name not in names]
        )
        require(
            not differences,
            "internals",
            differences,
            "the channels of the scenario in the log, as this version records them",
        )
        values = np.column_stack([signal[name] for name in names])
        valid = np.isfinite(values).all() and np.isin(signal["mode"], list(Mode)).all()
        require(
            bool(valid),
            "internals",
            "a value that is not finite, or an unknown mode",
            "what a controller publishes",
        )
        self.m = len(parameters.inputs)
        self.p = len(parameters.effectors)
        self._allocation = parameters.guard().allocation
        # Sort by the instants of the ticks. Stamps may decrease: a late y is older than a failsafe
        # tick before it.
        now_ns = signal.stamp_ns + np.round(signal["age"] * NANOSECONDS).astype(np.int64)
        order = np.argsort(now_ns, kind="stable")
        number = signal["number"]
        self.starts = controller_starts(number[order])
        # Ticks of one controller are in the order of their numbers, whichever was stored first.
        order = np.concatenate(
            [part[np.argsort(number[part], kind="stable")] for part in np.split(order, self.starts)]
        )
        self.stamp_ns = signal.stamp_ns[order]
        self.now_ns = now_ns[order]
        self.t = tape.time("internals")[order]
        signal = Signal(self.stamp_ns, names, values[order])
        self.number = signal["number"].astype(np.int64)
        self.parameters = signal["parameters"].astype(np.int64)
        self.flies = signal["mode"] == Mode.ENGAGED
        self.begins = self.number == 1
        self.processes = tape.processes
        self.gap = np.diff(self.number, prepend=0) != 1
        self._signal = signal
        self._active = signal["mode"] != Mode.INACTIVE
        self._engages = self.flies & (signal["dt"] == 0.0)
        self._offset_ns = np.round(signal["y_m_offset"] * NANOSECONDS).astype(np.int64)
        self._groups = {name: signal.group(name).values for name in groups}
        y = self._groups["y"]
        if parameters.vanes:
            y = np.column_stack([y, self._groups["vane"]])
        self._y, self.y_found = _as_published(tape, "y", parameters.measured, self.stamp_ns, y)
        commanded = self._groups[internals.EFFECTOR if parameters.allocation is not None else "u"]
        u, self.u_found = _as_published(tape, "u", parameters.effectors, self.stamp_ns, commanded)
        self.values = np.column_stack([signal.values, u])
        self.names = (*names, *(f"published.{name}" for name in parameters.effectors))
        self._copied = [names.index(name) for name in COPIED_CHANNELS]

    def begin(self, before: ControllerState | None = None) -> ControllerState:
        """The state of a controller that was configured, with the u of a state before."""
        state = guard.initial_state(self.m, self._allocation)
        return state if before is None else state._replace(u=before.u, effectors=before.effectors)

    def state(
        self, k: int, limits: GuardParams, law: TunedLaw, computed: ControllerState | None = None
    ) -> ControllerState:
        """The recorded state after a tick. Values outside the log come from the computed state, if
        any.
        """
        row = {name: values[k] for name, values in self._groups.items()}
        law_state = restored(law.control_law, row)
        mode = Mode(int(self._signal["mode"][k]))
        u = row["u"]
        y_m = row["y_m"]
        effectors = row.get(internals.EFFECTOR)
        if computed is not None and not self.flies[k]:
            return computed._replace(
                mode=mode, law=law_state, u=u, u_free=row["u_free"], effectors=effectors
            )
        feedforward_state = None if computed is None else computed.feedforward
        if limits.nominal is not None and self._engages[k]:
            feedforward_state = feedforward.initial_state(y_m, limits.nominal)
        y = StampedVector(int(self.stamp_ns[k]), row["y"])
        logged = ControllerState(
            mode,
            law_state,
            y,
            y_m,
            u,
            row["u_free"],
            row["u_trim"],
            0,
            u,
            row["u_ff"],
            feedforward_state,
        )
        vanes = Vanes(row["vane"], row["vane_m"]) if limits.vanes else None
        return logged._replace(effectors=effectors, effectors_failsafe=effectors, vanes=vanes)

    def tick(
        self, k: int, state: ControllerState, limits: GuardParams, law: TunedLaw
    ) -> tuple[ControllerState, FloatArray]:
        """A tick: (state afterwards, row of `internals`); the row is NaN for a tick without
        output.
        """
        stamp_ns = int(self.stamp_ns[k])
        y = None
        y_m = []
        if self.flies[k]:
            y = StampedVector(stamp_ns, self._y[k])
            y_m = [StampedVector(stamp_ns, self._groups["y_m"][k])]
            if (offset_ns := int(self._offset_ns[k])) > 0:
                y_m.append(y_m[0]._replace(stamp_ns=stamp_ns + offset_ns))
        if self._engages[k] and state.mode is Mode.ENGAGED:
            state = self.begin(state)  # the controller was configured again before this tick
        # After a gap the log has the feedforward's output but not its state: only the law is
        # computed.
        only_law = (
            limits.nominal is not None and state.mode is Mode.ENGAGED and state.feedforward is None
        )
        u_ff = self._groups["u_ff"][k] if only_law else None
        vane_m = self._groups["vane_m"][k] if only_law and limits.vanes else None
        after, used = guard.tick(
            state, int(self.now_ns[k]), y, y_m, limits, law, bool(self._active[k]), u_ff, vane_m
        )
        if used is None:
            return after, np.full(len(self.names), np.nan)
        late = float(self._signal["late"][k])
        age = float(self._signal["age"][k])
        given_up = (
            self._groups[internals.GIVEN_UP][k]
            if internals.GIVEN_UP in self._groups
            else np.zeros(0)
        )
        row = internals.values(after, used, limits, late, age, 0, 0, given_up)
        row[self._copied] = self.values[k, self._copied]
        return after, np.concatenate([row, after.command])


def _as_published(
    tape: Tape, topic: str, names: Sequence[str], stamp_ns: NDArray[np.int64], otherwise: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Samples of a topic at these stamps, shape (N, m), else the values `otherwise`; and the mask
    of stamps with a sample.
    """
    matched = np.zeros(len(stamp_ns), dtype=bool)
    if topic not in tape or not set(names) <= set(tape[topic].names):
        return otherwise, matched
    published = tape[topic].values[:, [tape[topic].names.index(name) for name in names]]
    values = otherwise.copy()
    rows: dict[int, list[int]] = {}
    for row, stamp in enumerate(tape[topic].stamp_ns.tolist()):
        rows.setdefault(stamp, []).append(row)
    for k, stamp in enumerate(stamp_ns.tolist()):
        candidates = rows.get(
            stamp, []
        )  # two if a failsafe u has the stamp of a y that arrived later
        matched[k] = bool(candidates)
        if candidates and not any(
            published[row].tobytes() == values[k].tobytes() for row in candidates
        ):
            values[k] = published[candidates[0]]
    return values, matched


def _coverage_notes(ticks: _Ticks, checked: NDArray[np.bool_]) -> Iterator[str]:
    """Notes on what the log does not hold, and what was therefore not checked."""
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


def _few(notes: Sequence[str]) -> tuple[str, ...]:
    """The first notes on changes of the parameters, and how many more there are."""
    more = len(notes) - SHOWN_CHANGES
    rest = (f"parameters changed {more} more times",) if more > 0 else ()
    return (*notes[:SHOWN_CHANGES], *rest)


def _controller_at(processes: Mapping[str, Process], stamp_ns: int) -> str:
    """The name of the last controller to begin before an instant, after a comma; empty where the
    log has no name.
    """
    known = [
        (process.first_ns, name)
        for name, process in processes.items()
        if "/controller#" in name and process.first_ns is not None and process.first_ns <= stamp_ns
    ]
    return f", {max(known)[1]}," if known else ""


def _bits(values: FloatArray) -> NDArray[np.int64]:
    return np.ascontiguousarray(values).view(np.int64)


def _ordinal(value: float) -> int:
    """Index of a float64 in the ordered float64 numbers; 0 has index 0."""
    bits = int(np.float64(value).view(np.int64))
    return bits if bits >= 0 else -(bits & 0x7FFF_FFFF_FFFF_FFFF)
