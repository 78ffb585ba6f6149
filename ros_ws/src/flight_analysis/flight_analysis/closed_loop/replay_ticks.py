# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read a recorded controller's ticks, their inputs, and the parameters in force at each."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flight_core.modes import Mode
from flight_core.parameters import require
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray, StampedVector
from flight_log.flight_processes import controller_starts
from rise_di_controller import internals
from rise_di_controller.extensions import feedforward
from rise_di_controller.guard import guard, retuning
from rise_di_controller.guard.guard import ControllerState, GuardParams, VaneReadings
from rise_di_controller.law.control_law import TunedLaw, restored
from rise_di_controller.laws import AnyLaw
from rise_di_controller.params import ControllerConfig

COPIED_CHANNELS = ("y_m_offset", "number", "parameters")
"""Channels of `internals` that are copied, because a tick does not compute them."""


# Parameters of the controller, by dotted name, that changed at one instant in flight.
Change = Mapping[str, Any]


def vary(parameters: ControllerConfig, changes: Mapping[str, Any]) -> ControllerConfig:
    """Return the parameters with some values changed, validated.

    `changes` has the new values by dotted name, such as observer.L. The value None removes a
    parameter. Raises ParameterError if a changed value is invalid.
    """
    return AnyLaw.validate_mapping(parameters.changed(changes), "controller")


class ParametersInForce:
    """The parameters of a recorded controller at a tick, and the changes that are still to come."""

    def __init__(self, parameters: ControllerConfig, changes: Sequence[Change]) -> None:
        # numbers of ticks, by the names of the changed values
        self._changed: dict[str, list[int]] = {}
        self._first = parameters
        self._changes = list(changes)
        self.begin()

    def begin(self) -> None:
        """Restore the parameters with which each controller starts."""
        self._unmatched: set[int] = set()
        self._apply(self._first)

    def _apply(self, parameters: ControllerConfig) -> None:
        self._parameters = parameters
        self.digest = parameters.digest()
        self.law = parameters.tuned_law()
        self.limits = parameters.guard()

    def notes(self) -> tuple[str, ...]:
        """Return one note for each set of parameters that changed together in flight."""
        return tuple(
            f"parameters changed before tick {numbers[0]}"
            + (f" and {len(numbers) - 1:,} later ones" if len(numbers) > 1 else "")
            + f": {names}"
            for names, numbers in self._changed.items()
        )

    def change(
        self, digest: int, number: int, state: ControllerState | None
    ) -> ControllerState | None:
        """Apply the next changes until the parameters have the digest that the log has for a tick.

        `digest` is the digest in the log, and `number` is the number of the tick. Returns the
        state, adapted to the new parameters. If none of the changes leads to the digest in the log,
        no change is applied, and the state is returned as it is.
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
        names: set[str] = set()
        for change, old, new in zip(applied, steps, steps[1:], strict=False):
            if new != old:
                names.update(change)
        self._changed.setdefault(", ".join(sorted(names)), []).append(number)
        for step in steps[1:]:
            if step.digest() == self.digest:
                continue
            law = self.law
            limits = self.limits
            self._apply(step)
            if state is not None:
                state = retuning.retune_state(state, law, self.law, (limits, self.limits))
        return state


class Ticks:
    """The samples of the topic `internals` in the order of the ticks, with their inputs."""

    def __init__(self, tape: Tape, parameters: ControllerConfig) -> None:
        groups = parameters.logged_groups()
        names = internals.names(groups)
        signal = _checked_internals(tape, names)
        self.m = len(parameters.inputs)
        self.p = len(parameters.effectors)
        self._allocation = parameters.guard().allocation
        # In logs of an earlier version stamps can decrease, because a late y was older than the
        # failsafe u that was published before it.
        now_ns = signal.stamp_ns + np.round(signal["age"] * NANOSECONDS).astype(np.int64)
        order, self.starts = _tick_order(now_ns, signal["number"])
        self.stamp_ns = signal.stamp_ns[order]
        self.now_ns = now_ns[order]
        self.t = tape.time("internals")[order]
        signal = Signal(self.stamp_ns, names, signal.values[order])
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
        """Return the initial state of a controller.

        If the state `before` is given, the initial state has the u of `before`.
        """
        state = guard.initial_state(self.m, self._allocation)
        return state if before is None else state._replace(u=before.u, effectors=before.effectors)

    def state(
        self, k: int, limits: GuardParams, law: TunedLaw, computed: ControllerState | None = None
    ) -> ControllerState:
        """Return the recorded state after tick k.

        Values that the log lacks come from the state `computed`, if it is given.
        """
        row = {name: values[k] for name, values in self._groups.items()}
        law_state = restored(law.control_law, row)
        mode = Mode(int(self._signal["mode"][k]))
        u = row["u"]
        y_m = row["y_m"]
        effectors = row.get(internals.EFFECTOR)
        if computed is not None and not self.flies[k]:
            return computed._replace(
                mode=mode,
                law=law_state,
                u=u,
                u_free=row["u_free"],
                effectors=effectors,
                stamp_ns=int(self.stamp_ns[k]),
                tick_ns=int(self.now_ns[k]),
            )
        feedforward_state = None if computed is None else computed.feedforward
        if limits.nominal is not None and self._engages[k]:
            feedforward_state = feedforward.initial_state(y_m, limits.nominal)
        y = StampedVector(int(self.stamp_ns[k]), row["y"])
        logged = ControllerState(
            mode=mode,
            law=law_state,
            y=y,
            y_m=y_m,
            u=u,
            u_free=row["u_free"],
            u_trim=row["u_trim"],
            failsafe_start_ns=0,
            u_failsafe=u,
            u_ff=row["u_ff"],
            feedforward=feedforward_state,
            stamp_ns=int(self.stamp_ns[k]),
            tick_ns=int(self.now_ns[k]),
        )
        vanes = VaneReadings(row["vane"], row["vane_m"]) if limits.vanes else None
        return logged._replace(effectors=effectors, effectors_failsafe=effectors, vanes=vanes)

    def tick(
        self, k: int, state: ControllerState, limits: GuardParams, law: TunedLaw
    ) -> tuple[ControllerState, FloatArray]:
        """Compute tick k, and return the state after it and the values of its channels.

        The attribute `names` has the names of these channels. If the tick has no output, all values
        are NaN.
        """
        stamp_ns = int(self.stamp_ns[k])
        y = None
        y_m = []
        if not self.flies[k] and stamp_ns == state.stamp_ns:
            # The controller stands by at the same stamp as before. So its last y was older than
            # this stamp, and did not engage the law.
            y = StampedVector(stamp_ns - 1, self._y[k])
            y_m = [StampedVector(stamp_ns - 1, self._groups["y_m"][k])]
        elif self.flies[k]:
            y = StampedVector(stamp_ns, self._y[k])
            y_m = [StampedVector(stamp_ns, self._groups["y_m"][k])]
            if (offset_ns := int(self._offset_ns[k])) > 0:
                y_m.append(y_m[0]._replace(stamp_ns=stamp_ns + offset_ns))
        if self._engages[k] and state.mode is Mode.ENGAGED:
            # Only the law has engaged again, as in `Controller.restart`. The guard keeps its state.
            state = state._replace(mode=Mode.WAITING)
        # After a gap, the log has the output of the feedforward but not its state, so that only
        # the law is computed.
        only_law = (
            limits.nominal is not None and state.mode is Mode.ENGAGED and state.feedforward is None
        )
        u_ff = self._groups["u_ff"][k] if only_law else None
        vane_m = self._groups["vane_m"][k] if only_law and limits.vanes else None
        after, inputs = guard.tick(
            state, int(self.now_ns[k]), y, y_m, limits, law, bool(self._active[k]), u_ff, vane_m
        )
        if inputs is None:
            return after, np.full(len(self.names), np.nan)
        late = float(self._signal["late"][k])
        age = float(self._signal["age"][k])
        if internals.GIVEN_UP in self._groups:
            given_up = self._groups[internals.GIVEN_UP][k]
        else:
            given_up = np.zeros(0)
        row = internals.values(
            after, inputs, limits, late, age, number=0, parameters=0, given_up=given_up
        )
        row[self._copied] = self.values[k, self._copied]
        return after, np.concatenate([row, after.command])


def _checked_internals(tape: Tape, names: Sequence[str]) -> Signal:
    """Return the topic `internals` with the channels `names`, in this order.

    Raises ParameterError if the topic has other channels, or values that no controller publishes.
    """
    require(
        "internals" in tape,
        "the log",
        "no sample of internals",
        "a flight with a controller that engaged",
    )
    signal = tape["internals"]
    differences = [f"no {name}" for name in names if name not in signal.names]
    differences += [f"also {name}" for name in signal.names if name not in names]
    require(
        not differences,
        "internals",
        ", ".join(differences),
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
    return Signal(signal.stamp_ns, tuple(names), values)


def _tick_order(
    now_ns: NDArray[np.int64], number: FloatArray
) -> tuple[NDArray[np.int64], list[int]]:
    """Order the ticks by their instants, and find where each controller starts.

    Returns the order, and the starts as indices into this order. The ticks of one controller are in
    the order of their numbers, even if they were stored in another order.
    """
    order = np.argsort(now_ns, kind="stable")
    starts = controller_starts(number[order])
    parts = np.split(order, starts)
    ordered = [part[np.argsort(number[part], kind="stable")] for part in parts]
    return np.concatenate(ordered), starts


def _as_published(
    tape: Tape, topic: str, names: Sequence[str], stamp_ns: NDArray[np.int64], otherwise: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return the samples of a topic at N stamps, (N, m), and a mask of the stamps with a sample.

    A stamp without a sample gets its row of the argument `otherwise`.
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
        # A stamp has two samples if a failsafe u has the stamp of a y that arrived later.
        candidates = rows.get(stamp, [])
        matched[k] = bool(candidates)
        if candidates and not any(
            published[row].tobytes() == values[k].tobytes() for row in candidates
        ):
            values[k] = published[candidates[0]]
    return values, matched
