# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Guard a control law with saturation, engagement and failsafe.

The guard consists of pure functions, like the law, and works with every control law.

- Saturation limits the magnitude and rate of u (`saturation.saturate`). Anti-windup is part of the
  law (`ControlLaw.limited`).
- Allocation distributes u over more effectors than the law has inputs, inside the limits of the
  effectors (`allocation.allocate`).
- The watchdog finds stale inputs, which are older than `max_age` (`tick`).
- The failsafe for stale inputs holds u, then ramps it to trim (modes HOLD, RAMP, TRIM).
- Bumpless transfer means that every engagement starts from the present u, with the state of the law
  as at the first engagement.
- Only finite values pass. A sample with NaN or infinity counts as missing. If u or the state of the
  law would not be finite, the law engages again.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from flight_core.failsafe import failsafe_scale
from flight_core.modes import Mode
from flight_core.rates import seconds
from flight_core.vectors import Array, FloatArray, StampedVector, is_finite
from rise_di_controller.extensions import feedforward
from rise_di_controller.extensions.allocation import Allocation, allocate, limits_of_effectors
from rise_di_controller.extensions.feedforward import FeedforwardState, Nominal
from rise_di_controller.extensions.observer import PastTick
from rise_di_controller.extensions.schedule import OverSpeed
from rise_di_controller.guard.probe import Probe
from rise_di_controller.guard.samples import SampleLimits
from rise_di_controller.law.control_law import Measurements, TunedLaw, fields
from rise_di_controller.law.saturation import Limits, saturate

# Least time between two samples whose slope is extrapolated, as a fraction of the longest
# extrapolation. Closer samples would amplify the noise of their difference more than 20 times.
MIN_SLOPE_SPAN = 0.05

LARGEST_VANE = np.pi  # largest reading of a vane, rad

# Number of samples of y and of y_m that are kept, so that y_m is known at the stamp of y. They span
# 0.1 s at 1 kHz, and more at lower rates.
SAMPLE_BUFFER_SIZE = 100


class GuardParams(NamedTuple):
    """Parameters of the guard: times, saturation limits, and the model of the feedforward."""

    period_ns: int  # period of the controller's ticks
    max_age_ns: int  # an older sample is stale
    hold_ns: int  # how long u is held in a failsafe
    ramp_ns: int  # how long u then takes to reach trim
    deactivation_holds: bool  # whether u is held when deactivated; otherwise u ramps to trim
    limits: Limits
    samples: SampleLimits  # bounds of the samples of y and y_m
    nominal: Nominal | None = None  # None without a feedforward
    # number of ticks on which a new observer is run before it is used; if 0, it starts from the
    # present error
    history: int = 0
    allocation: Allocation | None = None  # None if the inputs of the law are the effectors
    # indices of the states of the nominal model that the vanes measure; in y the readings of the
    # vanes come after the outputs
    vanes: tuple[int, ...] = ()
    # the nominal model as a function of the airspeed; if None, `nominal` holds at every airspeed
    over_speed: OverSpeed | None = None
    probe: Probe | None = None  # sines that are added to u_trim; None without a probe

    @property
    def longest_ns(self) -> int:
        """Longest time between two samples of y over which the law may step, ns.

        After a longer time the law engages again. This limit is larger than the age limit, because
        the last tick with a fresh y can be a period before the tick of the next y. A step
        integrates over the whole time between two samples. If half of the ticks are lost, a limit
        of only 3 periods would raise the error by 15 % in q and 22 % in r.
        """
        return self.max_age_ns + self.period_ns


# least dt of a step, in periods; it keeps a burst of samples from exciting the sign term
LEAST_DT = 0.2


# Stamp that stands for the last u before the first u. Every y is later.
BEFORE_ALL_NS = -(2**63)


class VaneReadings(NamedTuple):
    """Readings of the k vanes at the last step of the law."""

    reading: FloatArray  # (k,)
    reference: FloatArray  # readings in the motion of the nominal model, (k,)


class ControllerState(NamedTuple):
    """State of the controller between two ticks."""

    mode: Mode
    law: Any  # state of the control law; None before the first engagement
    y: StampedVector | None  # y of the last step
    y_m: FloatArray | None  # the reference at the stamp of y
    u: FloatArray  # commanded input, after saturation
    u_free: FloatArray  # input before saturation
    u_trim: FloatArray  # u at engagement, to which the law adds its output
    failsafe_start_ns: int  # when the inputs became stale, or the controller was deactivated
    u_failsafe: FloatArray  # u at the start of the failsafe
    u_ff: FloatArray  # the feedforward, 0 for an input without it
    feedforward: FeedforwardState | None = None
    # Times of the present failsafe. New times act from the next failsafe on, so that u does not
    # jump.
    hold_ns: int = 0
    ramp_ns: int = 0
    history: tuple[PastTick, ...] = ()
    # Commanded effectors, (p,), or None without an allocation. u is then the input of the law that
    # these effectors give.
    effectors: FloatArray | None = None
    effectors_failsafe: FloatArray | None = None  # effectors at the start of the failsafe
    vanes: VaneReadings | None = None  # None without vanes
    stamp_ns: int = BEFORE_ALL_NS  # stamp of the last u
    tick_ns: int = 0  # instant of the tick that gave the last u

    @property
    def command(self) -> FloatArray:
        """The published command: u or, with an allocation, the commands of the effectors."""
        return self.u if self.effectors is None else self.effectors


class TickInputs(NamedTuple):
    """What a tick computed u from, for the log.

    Computing the tick again from these inputs gives the same u to the last bit.
    """

    stamp_ns: int  # stamp of u, the stamp of its y; without a y it goes on with the clock
    y: FloatArray
    y_m: FloatArray  # interpolated to the stamp of y
    y_m_offset: float  # stamp of the newest y_m minus stamp of y, s
    dt: float  # step of the law, s; 0 without a step


def initial_state(m: int, allocation: Allocation | None = None) -> ControllerState:
    """Return the state before the first sample, with u = 0."""
    zero = np.zeros(m)
    effectors = None if allocation is None else np.zeros(len(allocation.T))
    return ControllerState(
        mode=Mode.WAITING,
        law=None,
        y=None,
        y_m=None,
        u=zero,
        u_free=zero,
        u_trim=zero,
        failsafe_start_ns=0,
        u_failsafe=zero,
        u_ff=zero,
        effectors=effectors,
    )


def align(samples: Sequence[StampedVector], stamp_ns: int, reach_ns: int) -> FloatArray | None:
    """Return a signal at the instant `stamp_ns`, shape (m,).

    Returns None if neither interpolation nor extrapolation is possible.

    If a sample has exactly this stamp, its value is returned unchanged. Between two samples the
    signal is linear. Beyond the newest sample it is extrapolated by at most `reach_ns`, with the
    slope between the newest sample and one that is older by at least MIN_SLOPE_SPAN times
    `reach_ns`. If there is no such older sample, the newest value is held.

    The samples must have increasing stamps.
    """
    for sample in reversed(samples):
        if sample.stamp_ns == stamp_ns:
            return sample.value
    older = [sample for sample in samples if sample.stamp_ns < stamp_ns]
    newer = [sample for sample in samples if sample.stamp_ns > stamp_ns]
    if older and newer:
        before = older[-1]
        after = newer[0]
    elif not older or stamp_ns - older[-1].stamp_ns > reach_ns:
        return None
    else:
        after = older[-1]
        spaced = [
            sample
            for sample in older
            if after.stamp_ns - sample.stamp_ns >= MIN_SLOPE_SPAN * reach_ns
        ]
        if not spaced:
            return after.value
        before = spaced[-1]
    fraction = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
    return before.value + fraction * (after.value - before.value)


def _with_history(
    state: ControllerState,
    stepped: ControllerState,
    inputs: TickInputs,
    missed: int,
    guard: GuardParams,
) -> ControllerState:
    """Append a step of the law, and the ticks that were missed before it, to the history."""
    scale = getattr(stepped.law, "scale", None)
    nominal = np.float64(seconds(guard.period_ns))
    lost_ticks = (
        PastTick(
            e=None, u=state.u - state.u_trim - state.u_ff, y_m=state.y_m, dt=nominal, scale=scale
        ),
    ) * missed
    last = PastTick(
        e=inputs.y - inputs.y_m,
        u=stepped.u - state.u_trim - stepped.u_ff,
        y_m=inputs.y_m,
        dt=np.float64(inputs.dt),
        scale=scale,
    )
    return stepped._replace(history=(*state.history, *lost_ticks, last)[-guard.history :])


def tick(
    state: ControllerState,
    now_ns: int,
    y: StampedVector | None,
    y_m: Sequence[StampedVector],
    guard: GuardParams,
    law: TunedLaw,
    active: bool = True,
    u_ff_recorded: FloatArray | None = None,
    vane_m_recorded: FloatArray | None = None,
) -> tuple[ControllerState, TickInputs | None]:
    """Advance the controller by a tick, and return the new state, which has u, and the inputs.

    Fresh inputs engage or re-engage the law with u_trim = u (bumpless transfer). With each new y,
    the law then takes a step with the measured dt, which is at least LEAST_DT periods. If more than
    `longest_ns` have passed, the law does not step but engages again. Before the step,
    `ControlLaw.missed` predicts the state over every whole period that had no y. The law adds its
    output to u_trim, or to u_trim + u_ff if there is a feedforward. Without a new y nothing
    changes.

    Stale inputs start the failsafe. Its modes are HOLD, in which nothing is integrated, then RAMP
    to trim, then TRIM. The stamp of u is normally the stamp of the y from which u is computed. In a
    failsafe the stamp of u continues from there with the clock, as the stamps of the missing y
    would. A y that is older than the last u does not engage the law, so the stamp of u never goes
    back.

    If `active` is false, the mode is INACTIVE, and u is held or ramps to trim. With fresh inputs u
    is published even before the first engagement, and is then at trim. The returned inputs are None
    if there is nothing to publish.

    `y` is the newest sample, and `y_m` holds the last samples with increasing stamps. The channels
    of both are in the law's order, and the readings of vanes follow the outputs in y. A replay from
    a log does not know the state of the feedforward, so it gives the recorded `u_ff_recorded` and
    `vane_m_recorded`.
    """
    vane = None
    if guard.vanes and y is not None:
        m = len(state.u)
        vane = _readings(y.value[m:], state.vanes)
        y = y._replace(value=y.value[:m])
    reference = None if y is None else _fresh_reference(now_ns, y, y_m, guard)
    # A y that is older than the last u is too late, so the law waits for the next y.
    is_late = y is not None and state.mode is not Mode.ENGAGED and y.stamp_ns < state.stamp_ns
    if y is None or reference is None:
        after, inputs = _failsafe(state, _going_on(state, now_ns), now_ns, guard, active)
    elif not active and state.law is None and not state.u.any():
        after = state._replace(mode=Mode.INACTIVE)
        inputs = TickInputs(
            stamp_ns=max(y.stamp_ns, state.stamp_ns),
            y=y.value,
            y_m=reference,
            y_m_offset=0.0,
            dt=0.0,
        )
    elif not active or is_late:
        stamp_ns = state.stamp_ns if is_late else _going_on(state, now_ns)
        after, inputs = _failsafe(state, stamp_ns, now_ns, guard, active)
    else:
        inputs = TickInputs(
            stamp_ns=y.stamp_ns,
            y=y.value,
            y_m=reference,
            y_m_offset=seconds(y_m[-1].stamp_ns - y.stamp_ns),
            dt=0.0,
        )
        after, inputs = _with_sample(
            state, y, inputs, vane, guard, law, u_ff_recorded, vane_m_recorded
        )
    if inputs is None:
        return after, None
    return after._replace(stamp_ns=inputs.stamp_ns, tick_ns=now_ns), inputs


def _going_on(state: ControllerState, now_ns: int) -> int:
    """Return the stamp of a u that has no y, ns: the last stamp of u plus the time since then."""
    return state.stamp_ns + max(now_ns - state.tick_ns, 0)


def _with_sample(
    state: ControllerState,
    y: StampedVector,
    inputs: TickInputs,
    vane: FloatArray | None,
    guard: GuardParams,
    law: TunedLaw,
    u_ff_recorded: FloatArray | None,
    vane_m_recorded: FloatArray | None,
) -> tuple[ControllerState, TickInputs | None]:
    """Advance by a tick with fresh inputs: the law engages or steps if there is a new y."""
    last = state.y
    if state.law is None or last is None or state.y_m is None or state.mode is not Mode.ENGAGED:
        return _engaged(state, y, inputs, vane, guard, law, vane_m_recorded), inputs
    span_ns = y.stamp_ns - last.stamp_ns
    if span_ns <= 0:
        return state, None
    if span_ns > guard.longest_ns:
        return _engaged(state, y, inputs, vane, guard, law, vane_m_recorded), inputs
    period = seconds(guard.period_ns)
    dt = max(seconds(span_ns), LEAST_DT * period)
    missed = max(round(dt / period) - 1, 0)
    predicted = state
    if missed:
        at_last_y = Measurements(
            y=last.value,
            y_m=state.y_m,
            y_m_dot=np.zeros_like(state.u_ff),
            u_trim=_probed_trim(state, y.stamp_ns, guard) + state.u_ff,
            u_before=state.u,
        )
        predicted = state._replace(law=_predicted(state.law, at_last_y, missed, law))
    stepped = _stepped(predicted, y, inputs, vane, guard, law, u_ff_recorded, vane_m_recorded)
    if not _is_finite(stepped):
        return _engaged(state, y, inputs, vane, guard, law, vane_m_recorded), inputs
    inputs = inputs._replace(dt=dt)
    if guard.history:
        stepped = _with_history(state, stepped, inputs, missed, guard)
    return stepped, inputs


def _stepped(
    state: ControllerState,
    y: StampedVector,
    inputs: TickInputs,
    vane: FloatArray | None,
    guard: GuardParams,
    law: TunedLaw,
    u_ff_recorded: FloatArray | None,
    vane_m_recorded: FloatArray | None,
) -> ControllerState:
    """Step the law and the feedforward, after predicting the state over the missed ticks."""
    assert state.y is not None  # noqa: S101 - for the type checker
    assert state.y_m is not None  # noqa: S101 - for the type checker
    span_ns = y.stamp_ns - state.y.stamp_ns
    dt = max(seconds(span_ns), LEAST_DT * seconds(guard.period_ns))
    u_trim = _probed_trim(state, y.stamp_ns, guard)
    u_ff = state.u_ff
    ff_state = state.feedforward
    # The feedforward moves the trim. In a replay it may come from the log.
    model = nominal_at_speed(guard, state.law)
    if model is not None and ff_state is not None:
        parts = feedforward.step_count(span_ns, guard.period_ns)
        ff_state, u_ff = feedforward.step(ff_state, inputs.y_m, dt, model, parts)
        u_trim = u_trim + u_ff
    elif u_ff_recorded is not None:
        u_ff = u_ff_recorded
        u_trim = u_trim + u_ff
    # Step the law from this trim, inside the limits.
    vanes = _vanes(vane, ff_state, guard, vane_m_recorded)
    slope = (inputs.y_m - state.y_m) / dt
    vane_m = None if vanes is None else vanes.reference
    measurements = Measurements(
        y=y.value,
        y_m=inputs.y_m,
        y_m_dot=slope,
        u_trim=u_trim,
        u_before=state.u,
        vane=vane,
        vane_m=vane_m,
    )
    after, u_free, u, effectors = law_within_limits(
        state.law, measurements, dt, law, guard, state.effectors
    )
    return state._replace(
        law=after,
        y=y,
        y_m=inputs.y_m,
        u=u,
        u_free=u_free,
        u_ff=u_ff,
        feedforward=ff_state,
        effectors=effectors,
        vanes=vanes,
    )


def _predicted(law_state: Any, held: Measurements, missed: int, law: TunedLaw) -> Any:
    """Predict the state of the law over `missed` periods without a y, in which u is held."""
    for _ in range(missed):
        law_state = law.control_law.missed(law_state, held, law.params)
    return law_state


def _probed_trim(state: ControllerState, stamp_ns: int, guard: GuardParams) -> FloatArray:
    """Return u_trim plus the sines of the probe at the stamp of y, (m,)."""
    return state.u_trim if guard.probe is None else state.u_trim + guard.probe.at(stamp_ns)


def _fresh_reference(
    now_ns: int, y: StampedVector, y_m: Sequence[StampedVector], guard: GuardParams
) -> FloatArray | None:
    """Return the reference at the stamp of y, (m,).

    Returns None if y or y_m is stale or not finite, or if y_m has no sample near the stamp of y.
    """
    if not y_m or max(abs(now_ns - sample.stamp_ns) for sample in (y, y_m[-1])) > guard.max_age_ns:
        return None
    reference = align(y_m, y.stamp_ns, guard.period_ns)
    return None if reference is None or not is_finite(y.value + reference) else reference


def _engaged(
    state: ControllerState,
    y: StampedVector,
    inputs: TickInputs,
    vane: FloatArray | None,
    guard: GuardParams,
    law: TunedLaw,
    vane_m_recorded: FloatArray | None,
) -> ControllerState:
    """Engage the law, so that it begins from the present u."""
    reference = inputs.y_m
    zero = np.zeros_like(state.u)
    ff_state = (
        None if guard.nominal is None else feedforward.initial_state(reference, guard.nominal)
    )
    measurements = Measurements(
        y=y.value, y_m=reference, y_m_dot=zero, u_trim=state.u, u_before=state.u, vane=vane
    )
    u_trim = state.u
    if guard.probe is not None:
        u_trim = u_trim - guard.probe.at(y.stamp_ns)  # so that u continues without a jump
    return state._replace(
        mode=Mode.ENGAGED,
        law=law.control_law.engage(measurements, law.params),
        y=y,
        y_m=reference,
        u_trim=u_trim,
        u_free=state.u,
        u_ff=zero,
        feedforward=ff_state,
        history=(),
        vanes=_vanes(vane, ff_state, guard, vane_m_recorded),
    )


def _is_finite(state: ControllerState) -> bool:
    """Return whether u and every value from which the next u is computed are finite."""
    arrays = [state.u, state.u_free, state.u_ff, *fields(state.law).values()]
    if state.effectors is not None:
        arrays.append(state.effectors)
    if state.feedforward is not None:
        arrays += [state.feedforward.x, state.feedforward.u, state.feedforward.u_0]
    return is_finite(np.concatenate(arrays))


def _readings(reading: FloatArray, before: VaneReadings | None) -> FloatArray:
    """Return the readings of the vanes, (k,), without gaps.

    If a reading is missing, the last reading is repeated, so that the vane seems to stand still.
    """
    last = np.zeros_like(reading) if before is None else before.reading
    return np.where(np.abs(reading) <= LARGEST_VANE, reading, last)


def nominal_at_speed(guard: GuardParams, law: Any) -> Nominal | None:
    """Return the nominal model of the feedforward, at the airspeed of the schedule if there is one.

    Returns None without a feedforward.
    """
    if guard.nominal is None or guard.over_speed is None:
        return guard.nominal
    nominal: Nominal = guard.over_speed.at_scale(law.scale)
    return nominal


def _vanes(
    reading: FloatArray | None,
    state: FeedforwardState | None,
    guard: GuardParams,
    recorded: FloatArray | None,
) -> VaneReadings | None:
    """Return the readings of the vanes, and what they would read in the reference motion.

    In the reference motion, the nominal model follows y_m, and each vane would read a state of this
    model. Returns None without vanes.
    """
    if reading is None:
        return None
    return VaneReadings(reading, recorded if state is None else state.x[list(guard.vanes)])  # type: ignore[arg-type]


def law_within_limits(
    state: Any,
    measurements: Measurements,
    dt: Array,
    law: TunedLaw,
    guard: GuardParams,
    effectors: FloatArray | None,
) -> tuple[Any, FloatArray, FloatArray, FloatArray | None]:
    """Step the law inside its own limits and the limits of the effectors.

    Returns the state, u before saturation, u, and the commands of the effectors. The argument
    `effectors`, (p,), has the commands of the last tick, or is None without an allocation.
    """
    after, u_free = law.control_law.step(state, measurements, dt, law.params)
    u, effector_values = _within_effectors(
        saturate(u_free, measurements.u_before, dt, guard.limits), effectors, dt, guard
    )
    # Without an active limit, `limited` would give the same u and take three times as long.
    if not np.array_equal(u, u_free):
        limits = guard.limits if guard.allocation is None else limits_of_effectors(u_free, u)
        after, u_free, u = law.control_law.limited(state, measurements, dt, law.params, limits)
        u, effector_values = _within_effectors(u, effectors, dt, guard)
    return after, u_free, u, effector_values


def _within_effectors(
    u: FloatArray, before: FloatArray | None, dt: Array, guard: GuardParams
) -> tuple[FloatArray, FloatArray | None]:
    """Return what the effectors can give of a demanded u, and the commands of the effectors, (p,).

    Without an allocation the results are u itself and None.
    """
    if guard.allocation is None or before is None:
        return u, None
    effectors, u = allocate(u, before, dt, guard.allocation)
    return u, effectors


def _failsafe(
    state: ControllerState, stamp_ns: int, now_ns: int, guard: GuardParams, active: bool
) -> tuple[ControllerState, TickInputs | None]:
    """Advance by a tick in which inputs are stale, or the controller is inactive.

    u gets the stamp `stamp_ns`.
    """
    y = state.y
    y_m = state.y_m
    if y is None or y_m is None:
        return state._replace(mode=Mode.WAITING if active else Mode.INACTIVE), None
    was_active = state.mode is not Mode.INACTIVE
    if state.mode in {Mode.ENGAGED, Mode.WAITING} or was_active != active:
        hold_ns = guard.hold_ns if active else 0
        state = state._replace(
            failsafe_start_ns=now_ns,
            u_failsafe=state.u,
            effectors_failsafe=state.effectors,
            hold_ns=hold_ns,
            ramp_ns=guard.ramp_ns,
        )
    elapsed_ns = now_ns - state.failsafe_start_ns
    is_held = not active and guard.deactivation_holds
    scale = 1.0 if is_held else failsafe_scale(elapsed_ns, state.hold_ns, state.ramp_ns)
    if not active:
        mode = Mode.INACTIVE
    elif scale == 1.0:
        mode = Mode.HOLD
    else:
        mode = Mode.RAMP if scale > 0.0 else Mode.TRIM
    u = state.u_failsafe if scale == 1.0 else scale * state.u_failsafe
    effectors = state.effectors_failsafe
    if effectors is not None and scale != 1.0:
        effectors = scale * effectors
    return state._replace(mode=mode, u=u, u_free=u, effectors=effectors), TickInputs(
        stamp_ns=stamp_ns, y=y.value, y_m=y_m, y_m_offset=0.0, dt=0.0
    )
