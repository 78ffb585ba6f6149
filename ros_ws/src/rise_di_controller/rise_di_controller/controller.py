# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The controller without ROS, for the node and for simulation.

It buffers y and y_m, steps the guarded law, and returns u and a log.
"""

from collections import deque
from collections.abc import Callable, Generator
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core.modes import Mode
from flight_core.outcome import Refusal
from flight_core.parameters import require
from flight_core.rates import seconds
from flight_core.vectors import FloatArray, StampedVector, require_newer, require_not_future
from rise_di_controller import internals
from rise_di_controller.guard import guard, retuning, samples
from rise_di_controller.guard.probe import EffectTest
from rise_di_controller.law.control_law import TunedLaw
from rise_di_controller.learning import divergence
from rise_di_controller.params import ControllerConfig, as_controller


class ControlOutput(NamedTuple):
    """What `Controller.tick` returns: u, its stamp, and the values for the log."""

    stamp_ns: int  # stamp of the y from which u was computed
    u: FloatArray  # (p,), in the order of `effectors` of the parameters
    inputs: guard.TickInputs
    log: Callable[[], FloatArray]
    effects: FloatArray | None = None  # bound of each input's effect, (m,); None if no test was due

    @property
    def internals(self) -> FloatArray:
        """Values for the log, in the order of `Controller.names`.

        They are computed only when this property is read, so that u can be published first.
        """
        return self.log()


class Prepared(NamedTuple):
    """What a controller computes from new parameters before they take effect.

    A third of the work of a change is done in advance in this way. `Controller.retune` does the
    rest, at the tick at which the parameters change.
    """

    parameters: ControllerConfig
    law: TunedLaw
    guard: guard.GuardParams
    digest: int
    names: tuple[str, ...]  # names of the channels of `internals`


def preparing(parameters: ControllerConfig) -> Generator[None, None, Prepared]:
    """Prepare parameters as `prepared` does, but in steps of at most about 1 ms.

    The generator yields after each step, so that a controller can fly its ticks in between.
    """
    law = parameters.tuned_law()
    yield
    limits = parameters.guard()
    yield
    return Prepared(
        parameters=parameters,
        law=law,
        guard=limits,
        digest=parameters.digest(),
        names=internals.names(parameters.logged_groups(law.control_law)),
    )


def prepared(parameters: ControllerConfig) -> Prepared:
    """Compute in advance what a controller needs to take new parameters."""
    parts = preparing(parameters)
    while True:
        try:
            next(parts)
        except StopIteration as end:
            ready: Prepared = end.value
            return ready


class Controller:
    """The controller without ROS, which holds its state and the last samples of y and y_m.

    Args:
        parameters: Parameters of the controller.

    Raises:
        ParameterError: `parameters` is not a ControllerConfig.

    Examples:
        >>> controller = rise_di.Controller(rise_di.find_scenario("osprey_servo").controller)
        >>> sample = rise_di.StampedVector(10_000_000, np.zeros(4))
        >>> controller.take_y(sample, 10_000_000), controller.take_y_m(sample, 10_000_000)
        (None, None)
        >>> controller.tick(10_000_000).u.tolist()
        [0.0, 0.0, 0.0, 0.0]
    """

    def __init__(self, parameters: ControllerConfig) -> None:
        as_controller(parameters, "parameters")
        _, self._law, self._guard, self._digest, self.names = prepared(parameters)
        self._state = guard.initial_state(len(parameters.inputs), self._guard.allocation)
        self.period_ns = self._guard.period_ns
        self._number = 0  # number of the last sample of `internals`
        self._effects = self._effect_test(parameters)
        self._at_start = self._parameters = parameters
        self._given_up = parameters.given_up()
        self._has_learned_model = False
        self._learned = _has_feedforward(parameters)
        zero = np.zeros(len(parameters.outputs))
        self._errors = divergence.Errors(zero, zero)
        self._least = divergence.least(parameters.outputs)
        self._oscillations = divergence.Oscillations(self._least)
        self._learns = parameters.history_ticks() > 0
        self._engaged_ns = 0
        self._vanes_moved = self._vanes_still = np.zeros(len(parameters.vanes), dtype=bool)
        self._samples: samples.SampleState | None = None  # None before the first y
        self._restart_reason: Refusal | None = None  # why the law engaged again by itself
        self._y: deque[StampedVector] = deque(maxlen=guard.SAMPLE_BUFFER_SIZE)
        self._y_m: deque[StampedVector] = deque(maxlen=guard.SAMPLE_BUFFER_SIZE)

    @property
    def mode(self) -> Mode:
        """Mode of the guard."""
        return self._state.mode

    @property
    def state(self) -> guard.ControllerState:
        """State of the guard and the law after the last tick."""
        return self._state

    @property
    def has_internals(self) -> bool:
        """Whether there is a state of the law to log. There is one from the first engagement on."""
        return self._state.law is not None

    @property
    def parameters(self) -> ControllerConfig:
        """The parameters in force."""
        return self._parameters

    @property
    def digest(self) -> int:
        """Digest of the parameters in force."""
        return self._digest

    @property
    def has_learned_model(self) -> bool:
        """Whether the feedforward or the observer has changed since the start of the flight.

        Only a learner changes a feedforward or an observer in flight, by its proposals.
        """
        return self._has_learned_model

    def restart(self) -> None:
        """Engage the law again with the next fresh y and y_m, starting from the present u.

        u does not jump (bumpless transfer). A failsafe that is under way continues until then.
        """
        if self._state.mode is Mode.ENGAGED:
            self._state = self._state._replace(mode=Mode.WAITING)

    def retune(self, parameters: "ControllerConfig | Prepared") -> None:
        """Replace the parameters between two ticks, without a jump of u (bumpless transfer).

        If the new parameters equal the old ones, nothing changes.

        Args:
            parameters: The new parameters. Give the result of `prepared` for them if this call
                must be short.

        Raises:
            ParameterError: The channels of the log would change, because the law changes, or
                because an observer is added or removed.
        """
        new = parameters if isinstance(parameters, Prepared) else prepared(parameters)
        if new.digest == self._digest:
            return
        require(
            new.names == self.names,
            "controller.law",
            new.parameters.law,
            "the law and the observer in use: these change at a restart",
        )
        before = self._parameters
        self._state = retuning.retune_state(
            self._state, self._law, new.law, (self._guard, new.guard)
        )
        self._law = new.law
        self._guard = new.guard
        self._digest = new.digest
        self._parameters = new.parameters
        if not np.array_equal(new.parameters.probe_gain(), before.probe_gain()):
            self._effects = self._effect_test(new.parameters)
        self._given_up = new.parameters.given_up()
        self._has_learned_model = not self._has_models_of_start(new.parameters)
        self._learned = _has_feedforward(new.parameters)

    def still_vanes(self) -> tuple[str, ...]:
        """Return the names of the vanes that the observer ignores because they stand still.

        Each engagement starts a new measurement of how much the readings move. Until a vane has
        moved, or the averaging time has passed, the vane is treated as it was before the
        engagement.
        """
        return tuple(
            name
            for name, still in zip(self._parameters.vanes, self._vanes_still, strict=True)
            if still
        )

    def _effect_test(self, parameters: ControllerConfig) -> EffectTest | None:
        if self._guard.probe is None or parameters.probe is None:
            return None
        gain = parameters.probe_gain()
        return EffectTest(self._guard.probe, gain, parameters.probe.false_alarm)

    def _tested(self, inputs: guard.TickInputs) -> FloatArray | None:
        """Return the effect of each input as the probe measured it, or None if no test was due."""
        if self._effects is None:
            return None
        if self.mode is not Mode.ENGAGED or inputs.dt == 0.0:
            self._effects.clear()
            return None
        return self._effects.take(inputs.stamp_ns, inputs.y, self._state.u)

    def _measure_vanes(self, inputs: guard.TickInputs) -> None:
        measures = getattr(self._state.law, "vane_measures", None)
        observer = self._parameters.observer
        if measures is None or observer is None or observer.vanes is None:
            return
        if self.mode is Mode.ENGAGED and inputs.dt == 0.0:
            self._engaged_ns, self._vanes_moved = inputs.stamp_ns, np.zeros_like(self._vanes_moved)
        self._vanes_moved = self._vanes_moved | (measures > 0.0)
        counts = self._vanes_moved | (
            seconds(inputs.stamp_ns - self._engaged_ns) >= observer.vanes.time
        )
        self._vanes_still = np.where(counts, measures == 0.0, self._vanes_still)

    def diverging(self) -> tuple[str, ...]:
        """Return the outputs whose error diverges under a model that was learned in flight."""
        if not self._has_learned_model:
            return ()
        diverging = divergence.diverging(self._errors, self._least, self._learned)
        return tuple(
            name
            for name, diverges in zip(self._parameters.outputs, diverging, strict=True)
            if diverges
        )

    def oscillations(self) -> dict[str, float]:
        """Return the period, s, of each output that oscillates under a model learned in flight.

        An output is included only if it oscillates more than it did under the law with which the
        flight started.
        """
        if not self._has_learned_model or not self._oscillations.periods.any():
            return {}
        periods = zip(
            self._parameters.outputs,
            (self._learned * self._oscillations.periods).tolist(),
            strict=True,
        )
        return {name: period for name, period in periods if period}

    def _has_models_of_start(self, parameters: ControllerConfig) -> bool:
        return parameters.models() == self._at_start.models()

    def take_y(self, sample: StampedVector, now_ns: int) -> Refusal | None:
        """Store a sample of y, with its channels in the law's order.

        A sample that no aircraft can give (see `samples`) is dropped, as if it had never arrived.
        If a value is beyond its bound, the sample is forgotten altogether. Any other dropped sample
        is remembered: the next sample must have a later stamp, and if the next samples confirm a
        jump of y, they are taken and the law engages again.

        Args:
            sample: The sample, shape (m,), or (m + k,) with k vanes, SI, deviations from trim.
            now_ns: The clock, ns.

        Returns:
            The reason why the sample was dropped, or None if it was taken.

        Raises:
            ChannelError: Reason "future": the stamp is more than the age limit ahead of the clock.
                Reason "order": the stamp is not later than the stamp of the last sample, even if
                that sample was dropped.
        """
        m = len(self._parameters.outputs)
        outputs = sample._replace(value=sample.value[:m])
        last_compared = self._samples and self._samples.far
        if (reason := self._reason_against(outputs, last_compared, now_ns)) is not None:
            return reason
        if self._samples is None:
            self._samples = samples.first_state(outputs)
        else:
            last = self._samples.last
            self._samples, change = samples.step(self._samples, outputs, self._guard.samples)
            if change is samples.SampleChange.FROZEN:
                return samples.standstill(self._samples, outputs)
            if change is not samples.SampleChange.NEAR:
                jump = samples.jump(last, outputs, self._parameters.outputs)
                if change is samples.SampleChange.FAR:
                    return Refusal(jump)
                self._restart_reason = Refusal(f"{jump}, and stays there")
                self.restart()
        self._y.append(sample)
        return None

    def take_y_m(self, sample: StampedVector, now_ns: int) -> Refusal | None:
        """Store a sample of y_m as `take_y` does, except that y_m may jump or stand still.

        Args:
            sample: The sample, shape (m,), SI, deviations from trim.
            now_ns: The clock, ns.

        Returns:
            The reason why the sample was dropped, or None if it was taken.

        Raises:
            ChannelError: Reason "future": the stamp is more than the age limit ahead of the clock.
                Reason "order": the stamp is not later than the stamp of the last sample taken.
        """
        last = self._y_m[-1] if self._y_m else None
        if (reason := self._reason_against(sample, last, now_ns)) is not None:
            return reason
        self._y_m.append(sample)
        return None

    def _reason_against(
        self, sample: StampedVector, last: StampedVector | None, now_ns: int
    ) -> Refusal | None:
        """Return a refusal if one of the m values of a sample is beyond its bound, else None.

        Raises ChannelError if the stamp of the sample is in the future, or not later than the stamp
        of `last`.
        """
        require_not_future(sample.stamp_ns, now_ns, self._guard.max_age_ns)
        if last is not None:
            require_newer(sample.stamp_ns, last.stamp_ns)
        return samples.bound_violation(sample.value, self._parameters.outputs, self._guard.samples)

    def pop_restart_reason(self) -> Refusal | None:
        """Return why the law has engaged again since the last call, and clear the reason.

        Returns None if the law did not engage again, or did so only because `restart` was called.
        """
        reason, self._restart_reason = self._restart_reason, None
        return reason

    def tick(self, now_ns: int, late_ns: int = 0, *, active: bool = True) -> ControlOutput | None:
        """Advance the controller by a tick at `now_ns`, which is `late_ns` after its deadline.

        Args:
            now_ns: Instant of the tick, ns.
            late_ns: Time since the deadline, ns.
            active: Whether the controller may send u.

        Returns:
            u and the internals, SI, or None if there is nothing to publish.
        """
        y = self._newest_paired_y()
        last = self._state.y
        was_engaged = self._state.mode is Mode.ENGAGED
        self._state, inputs = guard.tick(
            self._state, now_ns, y, list(self._y_m), self._guard, self._law, active
        )
        if inputs is None:
            return None
        # dt is above 0 in a step of the law, and 0 at an engagement
        if was_engaged and self._state.mode is Mode.ENGAGED and inputs.dt == 0.0:
            gap_ns = 0 if last is None else inputs.stamp_ns - last.stamp_ns
            self._restart_reason = Refusal(
                f"a gap of y of {seconds(gap_ns):g} s, longer than max_age"
                if gap_ns > self._guard.longest_ns
                else "u or the state of the law was not finite"
            )
        effects = self._tested(inputs)
        self._measure_vanes(inputs)
        self._number += self.has_internals
        self.watch(inputs.y - inputs.y_m, inputs.dt)
        age = seconds(now_ns - inputs.stamp_ns)
        limits = self._guard
        digest = self._digest
        given_up = self._given_up
        log = partial(
            internals.values,
            self._state,
            inputs,
            limits,
            seconds(late_ns),
            age,
            self._number,
            digest,
            given_up,
        )
        return ControlOutput(
            stamp_ns=inputs.stamp_ns, u=self._state.command, inputs=inputs, log=log, effects=effects
        )

    def watch(self, e: FloatArray, dt: float) -> None:
        """Record the error of a tick, from which `diverging` and `oscillations` are computed.

        Args:
            e: y - y_m, shape (m,), SI.
            dt: Time since the tick before, s.
        """
        self._errors = divergence.step(
            self._errors, e, dt, has_learned_model=self._has_learned_model
        )
        if self._learns:
            self._oscillations.take(e, dt, self._learned if self._has_learned_model else None)

    def resume(self, state: guard.ControllerState) -> None:
        """Continue from a state that was simulated elsewhere with the same parameters.

        A campaign simulates the beginning of a flight for many aircraft at once, without a
        `Controller`.

        Args:
            state: State of the guard and of the law after the last tick.
        """
        self._state = state

    def overrun(self, last_ns: int, now_ns: int) -> tuple[int, ...]:
        """Return the instants of ticks that must be added before the tick at `now_ns`.

        Ticks are added if the last tick was longer ago than the age limit. Since no u arrived in
        the meantime, the aircraft has started its own failsafe. Two ticks without fresh inputs
        bring the u of the controller to the value that the aircraft applies now, so that the law
        engages again without a bump.

        Args:
            last_ns: Instant of the last tick, ns.
            now_ns: Instant of the tick, ns.

        Returns:
            The instants, ns, or () if the last tick is recent enough.
        """
        begin_ns = last_ns + self._guard.max_age_ns
        return (begin_ns + self.period_ns, now_ns) if now_ns > begin_ns else ()

    def _newest_paired_y(self) -> StampedVector | None:
        """Return the newest y that has a y_m: it is at most a period newer than the newest y_m.

        If y_m comes late, an earlier y is therefore used, and no failsafe starts.
        """
        newest = self._y[-1] if self._y else None
        if not self._y_m:
            return newest
        known_ns = self._y_m[-1].stamp_ns + self._guard.period_ns
        return next((sample for sample in reversed(self._y) if sample.stamp_ns <= known_ns), newest)

    def ages(self, now_ns: int) -> dict[str, float]:
        """Return the ages of the newest y and y_m, s. An input that never came is left out.

        Args:
            now_ns: The clock, ns.

        Returns:
            Ages by "y" and "y_m", s.
        """
        newest = {"y": self._y, "y_m": self._y_m}
        return {
            name: seconds(now_ns - samples[-1].stamp_ns)
            for name, samples in newest.items()
            if samples
        }

    def stale(self, now_ns: int) -> tuple[str, ...]:
        """Return which of y and y_m never came, or are older than the age limit.

        Args:
            now_ns: The clock, ns.

        Returns:
            The names of the stale inputs, or () if y and y_m are fresh.
        """
        ages = self.ages(now_ns)
        limit = seconds(self._guard.max_age_ns)
        return tuple(name for name in ("y", "y_m") if ages.get(name, limit + 1.0) > limit)


def _has_feedforward(parameters: ControllerConfig) -> NDArray[np.bool_]:
    """Return a mask, (m,), of the channels in which the feedforward acts.

    In a model that a learner proposes, channels without a learned model have no feedforward.
    """
    some = None if parameters.feedforward is None else parameters.feedforward.inputs
    return np.array([some is None or name in some for name in parameters.inputs])
