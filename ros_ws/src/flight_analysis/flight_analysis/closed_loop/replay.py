# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A recorded flight computed again: each tick from what the log says it used, with the functions that flew, to the last bit."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_analysis.closed_loop.scenario import SCHEMAS
from flight_core.parameters import flatten, nest, require
from flight_core.rates import NANOSECONDS
from flight_core.scenario import read_sections
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray, StampedVector
from flight_log.tape_reader import StoredFile
from rise_di_controller import feedforward, guard, internals
from rise_di_controller.guard import ControllerState, GuardParams, Mode
from rise_di_controller.law import LawParams, LawState, retune
from rise_di_controller.params import ControllerParameters

GIVEN = ("y_m_offset", "number", "parameters")
"""Channels of `internals` that a tick does not compute."""

INPUTS = ("u.", "published.")
"""How channels of u are called, in `internals` and on the topic `u`."""

OPEN_LOOP = "open loop: the recorded aircraft did not fly this u"


Change = Mapping[str, Any]
"""Parameters of the controller that were changed in flight, all at once, by dotted name."""


class Difference(NamedTuple):
    """One channel of one tick."""

    number: int  # of the tick's sample in `internals`
    t: float  # flight time of its stamp, s
    channel: str
    recorded: float
    computed: float  # NaN where nothing is computed

    @property
    def ulps(self) -> int | None:
        """How many float64 lie between the two, None where one of them is not a number."""
        if np.isnan(self.recorded) or np.isnan(self.computed):
            return None
        return abs(_place(self.computed) - _place(self.recorded))


class Replayed(NamedTuple):
    """The ticks of a log, N of them, as recorded and as computed; k channels: those of `internals`, then u on its topic."""

    names: tuple[str, ...]
    number: NDArray[np.int64]  # (N,), the channel "number"
    t: FloatArray  # (N,), s
    recorded: FloatArray  # (N, k)
    computed: FloatArray  # (N, k), NaN where nothing was
    checked: NDArray[np.bool_]  # (N,), whether the state before the tick is known
    other_parameters: NDArray[np.bool_]  # (N,), whether the recorded controller flew with other ones
    notes: tuple[str, ...]

    def different(self) -> NDArray[np.bool_]:
        """Which channels differ in a bit, shape (N, k)."""
        different: NDArray[np.bool_] = self.checked[:, None] & (_bits(self.recorded) != _bits(self.computed))
        return different

    def equal(self) -> bool:
        """Whether every bit that was checked is equal, and flown with these parameters."""
        return not self.different().any() and not self.other_parameters.any()

    def first(self) -> Difference | None:
        """The first channel of the first tick that differs, one of u where one of u does; None where none does."""
        different = self.different()
        rows = np.flatnonzero(different.any(axis=1))
        if len(rows) == 0:
            return None
        row = int(rows[0])
        column = min(np.flatnonzero(different[row]).tolist(), key=lambda one: not self.names[one].startswith(INPUTS))
        recorded, computed = float(self.recorded[row, column]), float(self.computed[row, column])
        return Difference(int(self.number[row]), float(self.t[row]), self.names[column], recorded, computed)

    def group(self, values: FloatArray, prefix: str) -> Signal:
        """The channels "prefix.name" of `recorded` or `computed`; stamps are flight time."""
        return Signal(np.round(self.t * NANOSECONDS).astype(np.int64), self.names, values).group(prefix)


def recorded_parameters(scenario: StoredFile) -> ControllerParameters:
    """The controller's section of the scenario inside a log; nothing else of it is asked for. Raises ParameterError."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / scenario.name
        path.write_bytes(scenario.content)
        sections = read_sections(path, tuple(SCHEMAS))
    return ControllerParameters.validate_mapping(sections["controller"], "controller")


def vary(parameters: ControllerParameters, changes: Mapping[str, Any]) -> ControllerParameters:
    """Parameters with some changed, by dotted name, checked as a whole; None takes one away. Raises ParameterError."""
    flat = dict(flatten(parameters.model_dump()))
    for name in changes:
        flat = {key: value for key, value in flat.items() if key != name and not key.startswith(name + ".")}
    return ControllerParameters.validate_mapping(nest(flat | dict(changes)), "controller")


def replay(
    tape: Tape, parameters: ControllerParameters, others: ControllerParameters | None = None, changes: Sequence[Change] = ()
) -> Replayed:
    """Compute every tick of `internals` again: (state, now, y, y_m) -> (state, u) by `guard.tick`.

    A tick takes y from the topic `y` where it has the stamp, y_m, the instant and whether the controller was active from
    `internals`; its dt, mode, e, integrals, Pi and u are computed. The state is that computed in the tick before; it is taken
    from the log behind a gap (in the first tick that flies: of that tick, of those before it and, behind it, of u_ff until the
    next engagement nothing is checked) and behind a tick that differs, so that each tick is judged by itself.

    `others` flies the same inputs with other parameters, as an open loop: the state is the computed one throughout, and where
    the log does not begin with the flight the law engages in its first tick, from the recorded u.

    Arguments: `changes` of the parameters in flight in their order; a tick flies with those that give the parameters which
    its channel "parameters" stands for. Raises ParameterError where `internals` is not that of these parameters, or of a
    version that recorded less, and for changes that are none.
    """
    ticks = _Ticks(tape, parameters)
    for key in ("outputs", "inputs"):
        wanted, found = getattr(parameters, key), getattr(others or parameters, key)
        require(found == wanted, f"controller.{key}", ", ".join(found), f"{', '.join(wanted)}, as recorded")
    flown = _ParametersInForce(others or parameters, changes)
    computed, checked = np.full_like(ticks.values, np.nan), np.zeros(len(ticks.number), dtype=bool)
    other_parameters = checked.copy()
    state: ControllerState | None = None
    for k in range(len(ticks.number)):
        if ticks.begins[k]:
            flown.begin()
            state = guard.initial_state(ticks.m)
        state = flown.change(int(ticks.parameters[k]), int(ticks.number[k]), state)
        other_parameters[k] = flown.digest != ticks.parameters[k]
        if state is None or (ticks.gap[k] and others is None and not ticks.begins[k]):
            if not ticks.flies[k]:
                state = None
                continue
            state = ticks.state(k, flown.limits)
            if others is None:
                continue
            state = guard.initial_state(ticks.m)._replace(u=state.u)
        state, computed[k] = ticks.tick(k, state, flown.limits, flown.law)
        checked[k] = True
        if others is None and computed[k].tobytes() != ticks.values[k].tobytes():
            state = ticks.state(k, flown.limits, state)
    notes = (() if others is None else (OPEN_LOOP,)) + tuple(flown.notes) + tuple(_what_is_missing(ticks, checked))
    return Replayed(ticks.names, ticks.number, ticks.t, ticks.values, computed, checked, other_parameters, notes)


class _ParametersInForce:
    """The parameters in force, and the changes to come."""

    def __init__(self, parameters: ControllerParameters, changes: Sequence[Change]) -> None:
        self.notes: list[str] = []
        self._first, self._changes = parameters, list(changes)
        self.begin()

    def begin(self) -> None:
        """A controller begins with the parameters of its start."""
        self._in_vain: set[int] = set()
        self._take(self._first)

    def _take(self, parameters: ControllerParameters) -> None:
        self._parameters, self.digest = parameters, parameters.digest()
        self.law, self.limits = parameters.law(), parameters.guard()

    def change(self, digest: int, number: int, state: ControllerState | None) -> ControllerState | None:
        """Make the changes that lead to the parameters of a tick, where some do; the state with them."""
        if digest == self.digest or digest in self._in_vain:
            return state
        steps = [self._parameters]
        for change in self._changes:
            steps.append(vary(steps[-1], change))
            if steps[-1].digest() == digest:
                break
        else:
            self._in_vain.add(digest)
            return state
        made, self._changes = self._changes[: len(steps) - 1], self._changes[len(steps) - 1 :]
        changed = sorted(
            {name for change, old, new in zip(made, steps, steps[1:], strict=False) if new != old for name in change}
        )
        self.notes.append(f"parameters changed before tick {number}: {', '.join(changed)}")
        for step in steps[1:]:
            if step.digest() == self.digest:
                continue
            before = self.law
            self._take(step)
            if state is not None and state.law is not None:
                state = state._replace(law=retune(state.law, before, self.law))
        return state


class _Ticks:
    """`internals` of a log in the order in which its controller ticked, and what each tick used."""

    def __init__(self, tape: Tape, parameters: ControllerParameters) -> None:
        require("internals" in tape, "the log", "no sample of internals", "a flight with a controller that engaged")
        signal = tape["internals"]
        names = internals.names(parameters.outputs, parameters.inputs)
        missing = [f"no {name}" for name in names if name not in signal.names]
        found = ", ".join(missing + [f"also {name}" for name in signal.names if name not in names])
        require(not found, "internals", found, "the channels of the scenario in the log, as this version records them")
        values = np.column_stack([signal[name] for name in names])
        sound = np.isfinite(values).all() and np.isin(signal["mode"], list(Mode)).all()
        require(bool(sound), "internals", "a value that is not finite, or a mode that is none", "what a controller publishes")
        self.m = len(parameters.inputs)
        # The instant of a tick orders them: the stamp does not, for y may be older than the tick before that had none.
        now_ns = signal.stamp_ns + np.round(signal["age"] * NANOSECONDS).astype(np.int64)
        order = np.argsort(now_ns, kind="stable")
        self.stamp_ns, self.now_ns, self.t = signal.stamp_ns[order], now_ns[order], tape.time("internals")[order]
        signal = Signal(self.stamp_ns, names, values[order])
        self.number = signal["number"].astype(np.int64)
        self.parameters = signal["parameters"].astype(np.int64)
        self.flies = signal["mode"] == Mode.ENGAGED
        self.begins = self.number == 1
        self.gap = np.diff(self.number, prepend=0) != 1
        self._signal = signal
        self._active = signal["mode"] != Mode.INACTIVE
        self._engages = self.flies & (signal["dt"] == 0.0)
        self._offset_ns = np.round(signal["y_m_offset"] * NANOSECONDS).astype(np.int64)
        self._groups = {name: signal.group(name).values for name in (*internals.OUTPUT_GROUPS, *internals.INPUT_GROUPS)}
        self._y, self.y_found = _as_published(tape, "y", parameters.outputs, self.stamp_ns, self._groups["y"])
        u, _ = _as_published(tape, "u", parameters.inputs, self.stamp_ns, self._groups["u"])
        self.values = np.column_stack([signal.values, u])
        self.names = (*names, *(f"published.{name}" for name in parameters.inputs))
        self._given = [names.index(name) for name in GIVEN]

    def state(self, k: int, limits: GuardParams, computed: ControllerState | None = None) -> ControllerState:
        """The state after a tick as recorded. What is not in the log is taken from the computed one, where there is one."""
        row = {name: values[k] for name, values in self._groups.items()}
        law = LawState(row["e_0"], row["e"], row["integral_e"], row["Pi"])
        mode, u, y_m = Mode(int(self._signal["mode"][k])), row["u"], row["y_m"]
        if computed is not None and not self.flies[k]:
            return computed._replace(mode=mode, law=law, u=u, u_free=row["u_free"])
        ahead = None if computed is None else computed.feedforward
        if limits.nominal is not None and self._engages[k]:
            ahead = feedforward.initial_state(y_m, limits.nominal)
        y = StampedVector(int(self.stamp_ns[k]), row["y"])
        return ControllerState(mode, law, y, y_m, u, row["u_free"], row["u_trim"], 0, u, row["u_ff"], ahead)

    def tick(self, k: int, state: ControllerState, limits: GuardParams, law: LawParams) -> tuple[ControllerState, FloatArray]:
        """One tick: (state after it, its row of `internals`); a row of NaN where it would have said nothing."""
        stamp_ns = int(self.stamp_ns[k])
        y, y_m = None, []
        if self.flies[k]:
            y = StampedVector(stamp_ns, self._y[k])
            y_m = [StampedVector(stamp_ns, self._groups["y_m"][k])]
            if (offset_ns := int(self._offset_ns[k])) > 0:
                y_m.append(y_m[0]._replace(stamp_ns=stamp_ns + offset_ns))
        if self._engages[k] and state.mode is Mode.ENGAGED:
            state = guard.initial_state(self.m)._replace(u=state.u)  # configured anew since the tick before
        # Behind a gap the feedforward's state is not known; what it added is.
        only_law = limits.nominal is not None and state.mode is Mode.ENGAGED and state.feedforward is None
        u_trim, u_ff = state.u_trim, self._groups["u_ff"][k]
        if only_law:
            state = state._replace(u_trim=u_trim + u_ff)
        after, used = guard.tick(state, int(self.now_ns[k]), y, y_m, limits, law, bool(self._active[k]))
        if only_law:
            after = after._replace(u_trim=u_trim, u_ff=u_ff)
        if used is None:
            return after, np.full(len(self.names), np.nan)
        late, age = float(self._signal["late"][k]), float(self._signal["age"][k])
        row = internals.values(after, used, limits.limits, late, age, 0, 0)
        row[self._given] = self.values[k, self._given]
        return after, np.concatenate([row, after.u])


def _as_published(
    tape: Tape, topic: str, names: Sequence[str], stamp_ns: NDArray[np.int64], otherwise: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Samples of a topic at these stamps, shape (N, m), where it has them, and where it has."""
    found = np.zeros(len(stamp_ns), dtype=bool)
    if topic not in tape or not set(names) <= set(tape[topic].names):
        return otherwise, found
    published, values = tape[topic].values[:, [tape[topic].names.index(name) for name in names]], otherwise.copy()
    rows: dict[int, list[int]] = {}
    for row, stamp in enumerate(tape[topic].stamp_ns.tolist()):
        rows.setdefault(stamp, []).append(row)
    for k, stamp in enumerate(stamp_ns.tolist()):
        alike = rows.get(stamp, [])  # two, where u went on without a y and then answers one that came late
        found[k] = bool(alike)
        if alike and not any(published[row].tobytes() == values[k].tobytes() for row in alike):
            values[k] = published[alike[0]]
    return values, found


def _what_is_missing(ticks: _Ticks, checked: NDArray[np.bool_]) -> Iterator[str]:
    """Sentences for people: what the log does not hold, and what was therefore not checked."""
    if len(ticks.number) and not ticks.begins[0]:
        yield f"the log begins with sample {ticks.number[0]} of internals: those before it are not in it"
    steps = np.diff(ticks.number)
    for k in np.flatnonzero(steps <= 0):
        yield f"another controller begins at t = {ticks.t[k + 1]:.2f} s"
    gaps = np.flatnonzero(steps > 1)
    if len(gaps):
        where = f"a gap before t = {ticks.t[gaps[0] + 1]:.2f} s" + (f" and {len(gaps) - 1} more" if len(gaps) > 1 else "")
        yield f"{(steps[gaps] - 1).sum()} samples of internals are not in the log: {where}"
    if unchecked := int((~checked).sum()):
        yield f"{unchecked} ticks not checked, for the log does not hold the state before them"
    if without := int((ticks.flies & ~ticks.y_found).sum()):
        yield f"the y of {without} ticks is not on the topic y of the log: taken from internals"


def _bits(values: FloatArray) -> NDArray[np.int64]:
    return np.ascontiguousarray(values).view(np.int64)


def _place(value: float) -> int:
    """Place of a float64 among all of them, 0 at 0."""
    bits = int(np.float64(value).view(np.int64))
    return bits if bits >= 0 else -(bits & 0x7FFF_FFFF_FFFF_FFFF)
