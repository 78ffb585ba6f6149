# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Aircraft that learn, side by side: the compiled loop flies them from one change of parameters to
the next.

Between two changes the parameters of the N aircraft are arrays. At a change the controller, the
learner and the certificate of each aircraft act by the code of a single flight.
"""

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import numpy as jnp

from flight_analysis.closed_loop.learning_loop import Identifications, Learn, proposed
from flight_campaign import batch_loop
from flight_campaign.batch_loop import Constants, FleetResult, LoopState, Timing, Vehicle
from flight_campaign.batch_matrices import Fleet
from flight_campaign.batch_schedule import ASKED
from flight_campaign.campaign_course import ENGAGE, STEP, Course, Segments
from flight_core.modes import Mode
from flight_core.rates import nanoseconds, period_ns
from flight_core.vectors import Array, FloatArray, StampedVector
from rise_di_controller import feedforward
from rise_di_controller.control_law import ControlLaw
from rise_di_controller.controller import Controller
from rise_di_controller.feedforward import FeedforwardState, Nominal
from rise_di_controller.guard import ControllerState
from rise_di_controller.observer import PastTick
from rise_di_controller.proposals import Event, Learning, Updates
from rise_di_controller.rise_di_config import RiseDiConfig


class Ticks(NamedTuple):
    """What the ticks of a flight gave, T ticks of N aircraft in the law's order."""

    y: Array  # (T, m, N) as the law took it
    u: Array  # (T, m, N)
    u_ff: Array  # (T, m, N) feedforward


class FleetState(NamedTuple):
    """N aircraft between two ticks."""

    loop: LoopState
    feedforward: FeedforwardState  # fields (.., N)
    ticks: Ticks


class Outcome(NamedTuple):
    """What the learning of a flight came to."""

    events: tuple[Event, ...]
    unproposed: int  # identifications without a proposal
    left_loop: bool  # whether the flight left the compiled loop: its figures are of a part of it


@partial(jax.jit, static_argnames=("sines", "law", "timing"), donate_argnames=("state",))
def _fly_span(
    state: FleetState,
    constants: Constants,
    nominal: Nominal,
    segments: Segments,
    first: int,
    last: int,
    *,
    sines: tuple[int, ...],
    law: ControlLaw,
    timing: Timing,
) -> FleetState:
    """The state after the ticks from `first` to before `last`. Spans of any length share the
    program.
    """
    nominal = nominal._replace(sine_states=sines)
    window = jnp.asarray(batch_loop.window_of(np.arange(len(segments.t)), timing.windows))

    def step(k: Array, now: FleetState) -> FleetState:
        segment = jax.tree.map(lambda values: values[k], segments)
        y_m = segment.sampled_y_m[:, None] + 0.0 * now.loop.u
        moved, u_ff = feedforward.step(now.feedforward, y_m, segment.dt, nominal)
        steps = segment.phase == STEP
        model = jax.tree.map(partial(jnp.where, steps), moved, now.feedforward)
        u_ff = jnp.where(steps, u_ff, 0.0)
        at_tick = (segment._replace(u_ff=u_ff), None, window[k])
        loop, sample = batch_loop.tick(now.loop, at_tick, ASKED, constants, law, timing)
        new = Ticks(sample.y, loop.u, u_ff)
        ticks = jax.tree.map(lambda values, value: values.at[k].set(value), now.ticks, new)
        return FleetState(loop, model, ticks)

    return jax.lax.fori_loop(first, last, step, state)


def _stacked(values: Sequence[Any]) -> Any:
    """Trees of arrays of N aircraft as one, the aircraft as the last axis."""
    return jax.tree.map(lambda *each: np.stack(each, axis=-1), *values)


def _of_aircraft(values: Any, number: int) -> Any:
    """The tree of arrays of an aircraft among N."""
    return jax.tree.map(lambda array: np.array(array[..., number]), values)


def flies_side_by_side(controller: RiseDiConfig, course: Course) -> bool:
    """Whether the compiled loop has all that a controller does on a course."""
    plain = controller.allocation is None and controller.schedule is None and not controller.vanes
    has_models = controller.observer is not None and controller.feedforward is not None
    phase = course.segments.phase
    no_gaps = phase[0] == ENGAGE and bool((phase[1:] == STEP).all())
    return plain and has_models and no_gaps and course.late == 0


class _Aircraft:
    """Controller, learner and certificate of an aircraft."""

    def __init__(self, parameters: RiseDiConfig, learn: Learn) -> None:
        self.events: list[Event] = []
        self.controller = Controller(parameters)
        self.learning = Learning(parameters, self.events.append, simulated=True)
        self.learner = learn(parameters)
        self.identifications = Identifications(self.learner, parameters.outputs)
        self.unproposed = 0
        self.left_loop = False

    def take(self, stamp_ns: Sequence[int], y: FloatArray, u: FloatArray) -> None:
        """Record ticks, y and u (T, m)."""
        digest = self.controller.digest
        for tick in zip(stamp_ns, y, u, strict=True):
            self.learner.take(*tick, digest)

    def watch(self, e: FloatArray, dt: Sequence[float]) -> None:
        """Note whether the law falls back within some ticks, e (T, m): a fallback ends the span of
        this aircraft alone.
        """
        for at_tick in zip(e, dt, strict=True):
            self.controller.watch(*at_tick)
            if self.controller.diverging() or self.controller.oscillations():
                self.left_loop = True
                return

    def propose(self, t_ns: int) -> None:
        """Identify at a tick where this is due."""
        proposal = proposed(self.learner, self.learning, self.controller, t_ns)
        identified = self.identifications.next(proposal)
        if identified is not None and not identified.values[0]:
            self.unproposed += 1

    @property
    def law(self) -> ControlLaw:
        """The law that flies, without parameters."""
        return self.controller.parameters.tuned_law().control_law


class LearningFleet:
    """The flights of N aircraft that learn."""

    def __init__(
        self,
        fleet: Fleet,
        vehicle: Vehicle,
        course: Course,
        parameters: RiseDiConfig,
        learn: Sequence[Learn],
        windows: tuple[int, ...] = (),
    ) -> None:
        """`learn` makes the learner of each aircraft; `windows` as for `batch.fly`. Raises
        ParameterError.
        """
        self._fleet = fleet
        self._vehicle = vehicle
        self._course = course
        self._segments = jax.tree.map(jnp.asarray, course.segments)
        late = int(np.max(np.asarray(fleet.late)))
        self._timing = Timing(fleet.blocks, course.steps, course.late, late, windows)
        self._aircraft = [_Aircraft(parameters, each) for each in learn]
        self._law = parameters.tuned_law().control_law
        self._period_ns = period_ns(parameters.rate, "controller.rate")
        self._history = parameters.history_ticks()
        assert parameters.learn is not None  # noqa: S101 - for the type checker
        updates = Updates(parameters.learn)
        latency_ns = nanoseconds(parameters.learn.latency)
        # A proposal acts before the first tick of its latency after the tick where it is due. One
        # that would act after the flight is not made.
        self._acting = {}
        for k in range(len(course.segments.t)):
            acting = max(k + 1, k - (-latency_ns // self._period_ns))
            if updates.due(k * self._period_ns) and acting < len(course.segments.t) - 1:
                self._acting[k] = acting

    def fly(self) -> tuple[FleetResult, list[Outcome]]:
        """The figures of the flights, and what the learning of each came to."""
        count = len(self._course.segments.t)
        acting = set(self._acting.values())
        ends = sorted({*(k + 1 for k in self._acting), *acting, count})
        state = self._begin()
        for first, last in pairwise([0, *ends]):
            state = self._span(state, first, last)
            self._learn(state, first, last)
            if last in acting:
                state = self._changed(state, last)
        result = batch_loop.figures(state.loop, count, self._course.period, None, self._timing)
        bounded = np.asarray(state.loop.bounded)
        return jax.tree.map(np.asarray, result), [
            Outcome(tuple(each.events), each.unproposed, each.left_loop or not is_bounded)
            for each, is_bounded in zip(self._aircraft, bounded, strict=True)
        ]

    def _constants(self) -> Constants:
        params = _stacked(
            [each.controller.parameters.tuned_law().params for each in self._aircraft]
        )
        return Constants(self._fleet._replace(blocks=()), self._vehicle, params, None)

    def _nominals(self) -> list[Nominal]:
        each = [aircraft.controller.parameters.guard().nominal for aircraft in self._aircraft]
        acts = np.ones(len(self._vehicle.outputs))
        return [
            nominal._replace(acts=acts if nominal.acts is None else nominal.acts)
            for nominal in each
            if nominal is not None
        ]

    def _begin(self) -> FleetState:
        """In trim before the first tick."""
        segments = self._course.segments
        first = jax.tree.map(lambda values: values[0], segments)
        loop = batch_loop.begin(
            self._constants(), first, control_law=self._law, timing=self._timing
        )
        start = [feedforward.initial_state(first.sampled_y_m, each) for each in self._nominals()]
        shape = (len(segments.t), *loop.u.shape)
        return FleetState(loop, _stacked(start), Ticks(*(jnp.zeros(shape) for _ in range(3))))

    def _span(self, state: FleetState, first: int, last: int) -> FleetState:
        """The state after the ticks from `first` to before `last`."""
        nominals = self._nominals()
        return _fly_span(
            state,
            self._constants(),
            _stacked([each._replace(sine_states=()) for each in nominals]),
            self._segments,
            first,
            last,
            sines=nominals[0].sine_states,
            law=self._law,
            timing=self._timing,
        )

    def _learn(self, state: FleetState, first: int, last: int) -> None:
        """Record some ticks, and identify where the last one is due."""
        segments = self._course.segments
        ticks = slice(first, last)
        y, u = (np.moveaxis(np.asarray(values[ticks]), -1, 0) for values in state.ticks[:2])
        stamp_ns = [k * self._period_ns for k in range(first, last)]
        for each, its_y, its_u in zip(self._aircraft, y, u, strict=True):
            if each.left_loop:
                continue
            each.watch(its_y - segments.sampled_y_m[ticks], segments.dt[ticks].tolist())
            each.take(stamp_ns, its_y, its_u)
            due = each.learning.ticked(each.controller, stamp_ns[-1]) and last - 1 in self._acting
            if due and not each.left_loop:
                each.propose(stamp_ns[-1])

    def _changed(self, state: FleetState, k: int) -> FleetState:
        """The state before tick k with the proposals that act there."""
        begin = max(k - self._history, 1)
        recent = jax.tree.map(lambda values: np.asarray(values[begin - 1 : k]), state.ticks)
        law, model = (
            jax.tree.map(np.asarray, part) for part in (state.loop.law, state.feedforward)
        )
        laws = []
        models = []
        for number, each in enumerate(self._aircraft):
            after = ControllerState(
                mode=Mode.ENGAGED,
                law=_of_aircraft(law, number),
                feedforward=_of_aircraft(model, number),
                **self._last_ticks(_of_aircraft(recent, number), k),
            )
            if not each.left_loop:
                each.controller.resume(after)
                each.learning.step(each.controller, k * self._period_ns)
                each.left_loop = each.law is not self._law
                after = after if each.left_loop else each.controller.state
            laws.append(after.law)
            models.append(after.feedforward)
        loop = state.loop._replace(law=_stacked(laws))
        return FleetState(loop, _stacked(models), state.ticks)

    def _last_ticks(self, ticks: Ticks, k: int) -> dict[str, Any]:
        """The fields of a controller's state from its last ticks, the last one k - 1."""
        segments = self._course.segments
        # The first tick, which engages the law, is no part of the history.
        past = range(max(k - self._history, 1), k)
        places = range(len(ticks.y) - len(past), len(ticks.y))
        history = tuple(
            PastTick(
                ticks.y[row] - segments.sampled_y_m[tick],
                ticks.u[row] - ticks.u_ff[row],
                segments.sampled_y_m[tick],
                segments.dt[tick],
            )
            for row, tick in zip(places, past, strict=True)
        )
        zero = np.zeros_like(ticks.u[-1])
        return {
            "y": StampedVector((k - 1) * self._period_ns, ticks.y[-1]),
            "y_m": segments.sampled_y_m[k - 1],
            "u": ticks.u[-1],
            "u_free": ticks.u[-1],
            "u_trim": zero,
            "failsafe_start_ns": 0,
            "u_failsafe": zero,
            "u_ff": ticks.u_ff[-1],
            "history": history,
        }
