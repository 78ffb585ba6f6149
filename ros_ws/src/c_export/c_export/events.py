# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Record the calls of a controller as events, with the state after each tick.

The calls come from flights with faults, or from a log.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from c_export.constants import exportable, sizes
from flight_analysis.closed_loop.replay import recorded_changes, recorded_parameters
from flight_analysis.closed_loop.replay_ticks import vary
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.modes import Mode
from flight_core.outcome import Refusal
from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS
from flight_core.text import printable
from flight_core.vectors import ChannelError, FloatArray, StampedVector
from flight_log.tape_reader import RecordedRun
from rise_di_controller import internals
from rise_di_controller.controller import Controller, ControlOutput
from rise_di_controller.guard import guard
from rise_di_controller.guard.guard import SAMPLE_BUFFER_SIZE, TickInputs
from rise_di_controller.law.control_law import fields
from rise_di_controller.rise_di_config import RiseDiConfig

START, TAKE_Y, TAKE_Y_M, TICK, RETUNE, RESTART, GUARD_TICK, LOAD, TAKE_U_M, STEP_REFERENCE = range(
    10
)
# The integer `refused` has a bit for each of the last 20 samples since the last tick, which is 1 if
# the controller refused the sample.
REFUSALS = 1 << 20
INTEGERS = (
    "published",
    "refused",
    "mode",
    "has_law",
    "y_stamp_ns",
    "failsafe_start_ns",
    "hold_ns",
    "ramp_ns",
    "stamp_ns",
)


NOTHING = np.zeros(0)


class Recording(NamedTuple):
    """The calls of a controller or a reference model as events, with its state after each tick.

    The T ticks and their states are computed by the Python code.
    """

    name: str
    names: tuple[str, ...]  # names of the integers and the reals
    events: NDArray[np.void]  # events, of the type `event_type`
    integers: NDArray[np.int64]  # (T, i)
    reals: FloatArray  # (T, w), of which the first are u or y_m
    loaded: FloatArray = NOTHING  # states before the ticks, which the event LOAD loads

    @property
    def ticks(self) -> int:
        """Number of ticks."""
        return len(self.integers)


def event_type(m: int) -> np.dtype[np.void]:
    """Return the struct `event` of proof.c as a NumPy type."""
    integers = [(name, np.int64) for name in ("kind", "now_ns", "stamp_ns", "flag", "offset_ns")]
    return np.dtype([*integers, ("y", np.float64, m), ("y_m", np.float64, m)])


def real_groups(controller: RiseDiConfig) -> dict[str, int]:
    """Return the size of each group of reals in a state, by name, in the order of proof.c."""
    dimensions = sizes(controller)
    m, p, n, s = dimensions.m, dimensions.p, dimensions.n, dimensions.s
    groups = dict.fromkeys(("u", "u_free", "u_trim", "u_ff", "u_failsafe"), m)
    groups |= {"effectors": p, "effectors_failsafe": p} if p else {}
    groups |= dict.fromkeys(("y", "y_m", "e_0", "e", "integral_e", "Pi"), m)
    groups |= {"scale": m} if dimensions.has_schedule else {}
    groups |= {"z": s, "u_o": m, "sigma": 1} if s else {}
    groups |= (
        {"feedforward.x": n, "feedforward.u": m, "feedforward.dt": 1, "feedforward.ticks": 1}
        if n
        else {}
    )
    groups |= {"feedforward.u_0": m} if n else {}
    return groups | {"output.y": m, "output.y_m": m, "output.y_m_offset": 1, "output.dt": 1}


def state_names(controller: RiseDiConfig) -> tuple[str, ...]:
    """Return a name for each integer and each real of a state."""
    return (*INTEGERS, *numbered(real_groups(controller)))


def numbered(groups: Mapping[str, int]) -> Iterator[str]:
    """Yield a name for each value of the groups, such as u[0], u[1], ..."""
    for group, count in groups.items():
        yield from (f"{group}[{i}]" for i in range(count))


@dataclass(frozen=True)
class GuardSample:
    """The y and y_m that a tick of the guard uses, with their stamps."""

    stamp_ns: int
    y: FloatArray
    y_m: FloatArray  # y_m at the stamp
    offset_ns: int = 0  # stamp of the newest y_m minus stamp of the sample


class Recorder(Controller):
    """A controller that records its calls as events, and its state after each tick.

    `sets` are the parameter sets from which `retune_to` chooses. The recorder starts with the first
    set. `before_tick` is called before each tick with the recorder and the instant. It returns
    whether the controller is active. The controller keeps the last `samples` samples of y, and as
    many of y_m.
    """

    def __init__(
        self,
        sets: Sequence[RiseDiConfig],
        before_tick: Callable[["Recorder", int], bool] = lambda recorder, now_ns: True,
        samples: int = SAMPLE_BUFFER_SIZE,
    ) -> None:
        self._kept = samples
        self._reset(sets[0])
        self.sets = sets
        self._before_tick = before_tick
        self.silent: frozenset[str] = frozenset()  # topics, y or y_m, whose samples get lost
        self._events: list[tuple[Any, ...]] = []
        self._integers: list[tuple[int, ...]] = []
        self._reals: list[FloatArray] = []
        self._refused = 0
        self._none = np.zeros(len(sets[0].outputs))
        self._names = state_names(sets[0])
        self._add(START)

    def _reset(self, parameters: RiseDiConfig) -> None:
        super().__init__(parameters)
        self._y = deque(maxlen=self._kept)
        self._y_m = deque(maxlen=self._kept)

    def _add(
        self,
        kind: int,
        now_ns: int = 0,
        stamp_ns: int = 0,
        flag: int = 0,
        offset_ns: int = 0,
        y: Any = None,
        y_m: Any = None,
    ) -> None:
        values = (self._none if value is None else value for value in (y, y_m))
        self._events.append((kind, now_ns, stamp_ns, flag, offset_ns, *values))

    def begin(self) -> None:
        """Begin again as a new controller with the first parameters."""
        self._reset(self.sets[0])
        self._refused = 0
        self._add(START)

    def take_y(self, sample: StampedVector, now_ns: int) -> Refusal | None:
        """Pass a sample of y to the controller. If `silent` contains y, the sample is lost."""
        if "y" in self.silent:
            return None
        self._add(TAKE_Y, now_ns, sample.stamp_ns, y=sample.value)
        return self._note_refusal(super().take_y, sample, now_ns)

    def take_y_m(self, sample: StampedVector, now_ns: int) -> Refusal | None:
        """Pass a sample of y_m to the controller. If `silent` contains y_m, the sample is lost."""
        if "y_m" in self.silent:
            return None
        self._add(TAKE_Y_M, now_ns, sample.stamp_ns, y_m=sample.value)
        return self._note_refusal(super().take_y_m, sample, now_ns)

    def _note_refusal(
        self,
        take: Callable[[StampedVector, int], Refusal | None],
        sample: StampedVector,
        now_ns: int,
    ) -> Refusal | None:
        self._refused = 2 * self._refused % REFUSALS
        try:
            refusal = take(sample, now_ns)
        except ChannelError:
            self._refused += 1
            raise
        self._refused += refusal is not None
        return refusal

    def retune_to(self, index: int) -> None:
        """Change to the parameters sets[index], and record the change."""
        self._add(RETUNE, flag=index)
        self.retune(self.sets[index])

    def restart(self) -> None:
        """Restart the controller, and record the restart."""
        self._add(RESTART)
        super().restart()

    def tick(self, now_ns: int, late_ns: int = 0, *, active: bool = True) -> ControlOutput | None:
        """Call `before_tick`, then compute and record a tick."""
        active = self._before_tick(self, now_ns) and active
        self._add(TICK, now_ns, flag=int(active))
        output = super().tick(now_ns, late_ns, active=active)
        self._note_state(None if output is None else output.inputs)
        return output

    def guard_tick(self, now_ns: int, sample: GuardSample | None, *, active: bool) -> None:
        """Compute a tick of the guard with a given sample, and record the tick.

        The guard is the part of the controller around the law, with checks of samples, engagement
        and failsafe. `sample` is None if the tick has no sample of y and y_m.
        """
        y = None
        y_m = []
        if sample is None:
            self._add(GUARD_TICK, now_ns, flag=int(active))
        else:
            stamp_ns, offset_ns = sample.stamp_ns, sample.offset_ns
            flag = int(active) + 2
            self._add(GUARD_TICK, now_ns, stamp_ns, flag, offset_ns, sample.y, sample.y_m)
            y = StampedVector(stamp_ns, sample.y)
            y_m = [StampedVector(stamp_ns, sample.y_m)]
            if offset_ns > 0:
                y_m.append(StampedVector(stamp_ns + offset_ns, sample.y_m))
        self._state, inputs = guard.tick(
            self._state, now_ns, y, y_m, self._guard, self._law, active
        )
        self._note_state(inputs)

    def _note_state(self, inputs: TickInputs | None) -> None:
        state = self.state
        y_stamp_ns = 0 if state.y is None else state.y.stamp_ns
        stamp_ns = 0 if inputs is None else inputs.stamp_ns
        integers = (
            inputs is not None,
            self._refused,
            state.mode,
            state.law is not None,
            y_stamp_ns,
        )
        times = (state.failsafe_start_ns, state.hold_ns, state.ramp_ns, stamp_ns)
        self._integers.append((*map(int, integers), *times))
        self._refused = 0
        row = np.zeros(len(self._names) - len(INTEGERS))
        parts = [state.u, state.u_free, state.u_trim, state.u_ff, state.u_failsafe]
        if (effectors := state.effectors) is not None:
            at_failsafe = state.effectors_failsafe
            parts += [effectors, np.zeros_like(effectors) if at_failsafe is None else at_failsafe]
        if state.law is not None and state.y is not None and state.y_m is not None:
            parts += [state.y.value, state.y_m, *fields(state.law).values()]
            if state.feedforward is not None:
                parts += [np.atleast_1d(value) for value in state.feedforward]
        values = np.concatenate(parts)
        row[: len(values)] = values
        if inputs is not None:
            output = np.concatenate([inputs.y, inputs.y_m, [inputs.y_m_offset, inputs.dt]])
            row[-len(output) :] = output
        self._reals.append(row)

    def recording(self, name: str) -> Recording:
        """Return the events and states so far as a recording called `name`."""
        events = np.array(self._events, dtype=event_type(len(self._none)))
        integers = np.array(self._integers, dtype=np.int64).reshape(-1, len(INTEGERS))
        reals = np.array(self._reals).reshape(len(integers), -1)
        return Recording(
            name=name, names=self._names, events=events, integers=integers, reals=reals
        )


def parameter_sets(controller: RiseDiConfig) -> list[RiseDiConfig]:
    """Return the given parameters, and then sets in which some parameters have other valid values.

    The changes concern gains, limits, signs, times, the schedule, the observer and end stops.
    """
    widths = np.array(controller.input_scale) * controller.law_params().eps
    bound = np.minimum(10.0 * widths, 0.1 * np.array(controller.upper or 10.0 * widths)).tolist()
    tight = {
        "lower": tuple(-value for value in bound),
        "upper": tuple(bound),
        "slew": tuple(4.0 * value for value in bound),
    }
    # Change each parameter of the law and of the guard.
    changes: list[Mapping[str, Any]] = [
        {"k_g": 0.8 * controller.k_g, "Lambda": tuple(0.9 * value for value in controller.Lambda)},
        {"beta": tuple(0.7 * value for value in controller.beta)},
        tight,
        {"slew": tuple(0.2 * value for value in bound)},
        {"sign": "implicit"},
        {"sign": "literal"},
        {"sign": "soft"},
        {"hold": 0.03, "ramp": 0.07, "max_age": 0.05},
        {"on_deactivate": "hold"},
    ]
    # Change the extensions.
    if controller.schedule is not None:
        # Make the time constant shorter than the longest dt.
        changes.append({"schedule.time": 5.0 / controller.rate})
    if controller.observer is not None:
        changes.append({"observer.F": tuple(0.9 * value for value in controller.observer.F)})
        changes.append({"observer.fade": 0.0})
    if controller.allocation is not None:
        stops = controller.effector_limits()
        bind = {"allocation.lower": 0.05 * stops.lower, "allocation.upper": 0.05 * stops.upper}
        bind |= {"allocation.slew": 0.2 * (stops.upper - stops.lower)}
        changes.append({name: tuple(value.tolist()) for name, value in bind.items()})
    sets = [controller]
    for change in changes:
        with suppress(ParameterError):  # the observer may have no margin under these gains
            sets.append(exportable(vary(controller, change)))
    return sets


def flight_recordings(
    scenario: Scenario, sets: Sequence[RiseDiConfig], samples: int = SAMPLE_BUFFER_SIZE
) -> Iterator[Recording]:
    """Yield recordings of three flights: undisturbed, with a tenth of the y lost, and with faults.

    The flights are simulated in one process. The faults are new parameters, deactivation,
    engagement, tight limits, and losses of y or y_m. A loss ends while the failsafe holds u, while
    it ramps u to trim, or after this ramp.
    """
    sensors = scenario.aircraft.sensors.model_dump() | {"dropout": 0.1}
    yield _flight("the flight", scenario, Recorder(sets, samples=samples))
    lossy = scenario.vary(aircraft={"sensors": sensors})
    yield _flight("a tenth of y lost", lossy, Recorder(sets, samples=samples))
    faults = _faults(scenario.flight.duration, sets)
    yield _flight("faults", scenario, Recorder(sets, faults, samples))


def _flight(name: str, scenario: Scenario, recorder: Recorder) -> Recording:
    simulate(scenario, control=lambda _: recorder)
    return recorder.recording(name)


def _faults(duration: float, sets: Sequence[RiseDiConfig]) -> Callable[[Recorder, int], bool]:
    """Return a function that injects the faults of a flight. It is called before each tick."""
    controller = sets[0]
    within_hold = controller.max_age + 0.5 * controller.hold
    in_ramp = controller.max_age + controller.hold + 0.5 * controller.ramp
    past_ramp = controller.max_age + controller.hold + controller.ramp + 0.2
    losses = {
        0.25: ({"y"}, within_hold),
        0.35: ({"y_m"}, in_ramp),
        0.5: ({"y"}, past_ramp),
        0.7: ({"y", "y_m"}, in_ramp),
    }
    retuned = {0.05 + 0.9 * k / len(sets): k for k in range(1, len(sets))}
    applied: set[float] = set()

    def before(recorder: Recorder, now_ns: int) -> bool:
        t = now_ns / NANOSECONDS
        silent = [
            names
            for part, (names, length) in losses.items()
            if part * duration <= t < part * duration + length
        ]
        recorder.silent = frozenset().union(*silent)
        for part, index in retuned.items():
            if t >= part * duration and part not in applied:
                applied.add(part)
                recorder.retune_to(index)
        if t >= 0.97 * duration and 1.0 not in applied:
            applied.add(1.0)
            recorder.restart()
        return not 0.8 * duration <= t < 0.8 * duration + 0.7

    return before


def run_recording(run: RecordedRun) -> tuple[list[RiseDiConfig], Recording, int]:
    """Read the parameter sets and the ticks from a log, and compute the ticks again.

    Returns the sets, the recording, and the number of ticks whose u equals the u in the log. The
    sets are the parameters at the start of the flight, and the parameters after each change in
    flight. Raises ParameterError if the changes in the log do not lead to the parameters that were
    used.
    """
    sets = [exportable(recorded_parameters(run.scenario_file()))]
    changes = [*recorded_changes(run, sets[0])]
    log = run.tape["internals"]
    command = "u" if sets[0].allocation is None else internals.EFFECTOR
    groups = {name: log.group(name).values for name in ("y", "y_m", command)}
    recorder = Recorder(sets)
    equal = 0
    now_ns = log.stamp_ns + np.round(log["age"] * NANOSECONDS).astype(np.int64)
    for k in np.argsort(now_ns, kind="stable").tolist():
        if log["number"][k] == 1 and k:
            recorder.begin()
        in_force = int(log["parameters"][k])
        while recorder.digest != in_force:
            unexplained = (
                f"parameters before tick {log['number'][k]:g} that no change of the log leads to"
            )
            require(bool(changes), "run", unexplained, "a log with all changes of the parameters")
            sets.append(exportable(vary(recorder.parameters, changes.pop(0))))
            recorder.retune_to(len(sets) - 1)
        sample = None
        if log["mode"][k] == Mode.ENGAGED:
            offset_ns = round(float(log["y_m_offset"][k]) * NANOSECONDS)
            if log["dt"][k] == 0.0 and recorder.mode is Mode.ENGAGED:
                recorder.restart()
            stamp_ns = int(log.stamp_ns[k])
            sample = GuardSample(stamp_ns, groups["y"][k], groups["y_m"][k], offset_ns)
        elif log.stamp_ns[k] == recorder.state.stamp_ns:
            # In a failsafe, u keeps the stamp of the u before it only if the newest y is older than
            # that u. The law does not engage with such a y, so each such y gives the same tick.
            stamp_ns = int(log.stamp_ns[k]) - 1
            sample = GuardSample(stamp_ns, groups["y"][k], groups["y_m"][k])
        recorder.guard_tick(int(now_ns[k]), sample, active=log["mode"][k] != Mode.INACTIVE)
        equal += recorder.state.command.tobytes() == groups[command][k].tobytes()
    return sets, recorder.recording(f"the log {printable(str(run.path))}"), equal
