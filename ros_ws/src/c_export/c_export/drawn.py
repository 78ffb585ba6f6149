# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Draw random inputs with which C and Python are compared.

The inputs are calls of a controller with any timing, and single steps from any state.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from c_export.events import (
    GUARD_TICK,
    LOAD,
    START,
    STEP_REFERENCE,
    TAKE_U_M,
    Recorder,
    Recording,
    event_type,
    numbered,
    real_groups,
    state_names,
)
from flight_core.modes import Mode
from flight_core.rates import NANOSECONDS, seconds
from flight_core.vectors import ChannelError, FloatArray, StampedVector
from reference_model.params import ReferenceModelConfig
from reference_model.reference import Reference
from rise_di_controller.extensions import feedforward
from rise_di_controller.extensions.allocation import Allocation, allocate, limits_of_effectors
from rise_di_controller.extensions.feedforward import FeedforwardState, Nominal
from rise_di_controller.guard.guard import LEAST_DT, SAMPLE_BUFFER_SIZE
from rise_di_controller.law.control_law import Measurements, fields, restored
from rise_di_controller.law.saturation import saturate
from rise_di_controller.rise_di_config import RiseDiConfig

# Start of the drawn stamps, which is so large that float64 does not resolve 1 ns.
EPOCH_NS = 1_795_000_000_000_000_000


def drawn_calls(
    sets: Sequence[RiseDiConfig], ticks: int, seed: int, samples: int = SAMPLE_BUFFER_SIZE
) -> Recording:
    """Draw random calls of a controller, with faults of every kind, and record them.

    The faults are jitter, lost, late and early samples, repeated stamps, errors of any size, jumps,
    new parameters and deactivation.
    """
    rng = np.random.default_rng(seed)
    controller = sets[0]
    m = len(controller.outputs)
    period_ns = controller.guard().period_ns
    unit = controller.law_params().eps
    schedule = controller.schedule
    airspeed = np.array(
        [0.0 if schedule is None or name != "V" else schedule.speed for name in controller.outputs]
    )
    recorder = Recorder(sets, samples=samples)
    now_ns = EPOCH_NS
    y_m = np.zeros(m)
    size = unit
    inactive = 0
    silence = 0
    jumps = _jumps(unit, np.random.default_rng([seed, 1]))
    stamp_m_ns = now_ns
    for k in range(ticks):
        draw = rng.random(10)
        now_ns += _interval_ns(draw[0], draw[1], period_ns)
        # Draw the size of the error, and how long both topics are silent.
        if k % 50 == 0:
            drawn = unit * 10.0 ** rng.uniform(-3.0, 2.5, m)
            size = np.where(rng.random(m) < 0.9, drawn, 0.0)
        silence = int(draw[2] * 100.0) if draw[3] < 0.005 else max(silence - 1, 0)
        y_m = 0.98 * y_m + size * rng.normal(size=m)
        with suppress(ChannelError):
            if draw[4] < 0.92 and not silence:
                late = rng.uniform(-0.1, 0.4 * draw[6])
                first = 2 - int(3.0 * draw[5])
                # some samples are too close together for a slope of y_m
                for distance in (0.3, 0.02, 0.0)[first:]:
                    stamp_m_ns = now_ns - round(period_ns * (late + distance))
                    recorder.take_y_m(
                        StampedVector(stamp_m_ns, y_m * rng.uniform(0.9, 1.1)), now_ns
                    )
        with suppress(ChannelError):
            # Draw a sample of y that is late, far too late, or has the stamp of y_m.
            if draw[7] < 0.95 and not 0 < silence < 30:
                late = rng.uniform(-0.05, 0.6) if draw[8] < 0.97 else rng.uniform(-300.0, 30.0)
                stamp_ns = stamp_m_ns if draw[8] < 0.1 else now_ns - round(period_ns * late)
                y = y_m + size * rng.normal(size=m) + airspeed * rng.uniform(-1.0, 1.0)
                recorder.take_y(StampedVector(stamp_ns, y + next(jumps)), now_ns)
        # Draw new parameters, a new engagement, a new controller, or a deactivation.
        if draw[9] < 0.01:
            recorder.retune_to(int(rng.integers(len(sets))))
        elif draw[9] < 0.02:
            recorder.restart()
        elif draw[9] < 0.023:
            recorder.begin()
            inactive = int(rng.integers(2)) * 5
        elif draw[9] < 0.03:
            inactive = int(rng.integers(1, 60))
        inactive = max(inactive - 1, 0)
        recorder.tick(now_ns, active=not inactive)
    return recorder.recording("drawn calls")


def _interval_ns(kind: float, size: float, period_ns: int) -> int:
    """Return a random time from one tick to the next, ns.

    The time is a period with jitter, or far from a period, or a long pause. It follows from `kind`
    and `size`, which the caller has drawn from 0 to 1.
    """
    if kind < 0.9:
        return round(period_ns * (1.0 + 0.2 * (size - 0.5)))
    if kind < 0.99:
        far: float = 10.0 ** (2.4 * size - 1.2)
        return round(period_ns * far)
    return round(period_ns * 300.0 * size)


def _jumps(unit: FloatArray, rng: np.random.Generator) -> Iterator[FloatArray]:
    """Yield an offset for each sample of y, (m,): 0, or the size of a jump of the sensors.

    A jump begins at one sample in 50 and lasts for some samples. The offset is up to 10^5 times
    `unit`, so the controller does not take the first samples of a large jump.
    """
    m = len(unit)
    offset = np.zeros_like(unit)
    while True:
        if rng.random() < 0.02:
            offset = np.where(rng.random(m) < 0.3, unit * 10.0 ** rng.uniform(0.0, 5.0, m), 0.0)
        elif rng.random() < 0.4:
            offset = np.zeros(m)
        yield offset


def drawn_standstill(
    sets: Sequence[RiseDiConfig], ticks: int, seed: int, samples: int = SAMPLE_BUFFER_SIZE
) -> Recording:
    """Draw noisy samples of y with stretches of up to twelve equal samples, as of a frozen sensor.

    The samples arrive at the ticks and half a period before the ticks.
    """
    rng = np.random.default_rng(seed)
    period_ns = sets[0].guard().period_ns
    unit = 0.01 * sets[0].law_params().eps
    recorder = Recorder(sets, samples=samples)
    y = np.zeros(len(unit))
    equal = 0
    for k in range(ticks):
        now_ns = EPOCH_NS + k * period_ns
        recorder.take_y_m(StampedVector(now_ns, np.zeros_like(unit)), now_ns)
        begins = equal == 0 and rng.random() < 0.01
        equal = int(rng.integers(1, 13)) if begins else max(equal - 1, 0)
        for stamp_ns in (now_ns - period_ns // 2, now_ns)[rng.integers(2) :]:
            y = y if equal else unit * rng.normal(size=len(unit))
            recorder.take_y(StampedVector(stamp_ns, y), now_ns)
        recorder.tick(now_ns)
    return recorder.recording("drawn standstill")


def drawn_steps(sets: Sequence[RiseDiConfig], index: int, steps: int, seed: int) -> Recording:
    """Draw single steps of an engaged controller from any state, and compute them all at once.

    The controller has the parameters sets[index]. Errors are 0.001 to 300 widths of the softened
    sign. dt is 0.2 to 10 periods, so that up to 9 samples are missing. dt is always short enough
    that the law does not engage again.
    """
    rng = np.random.default_rng(seed)
    guard = sets[index].guard()
    period_ns = guard.period_ns
    longest_ns = min(guard.longest_ns, feedforward.LONGEST_PART * period_ns)
    factor = 10.0 ** (
        rng.choice([0.0, 0.0, 0.3, 1.0, -1.0], steps) + rng.uniform(-0.05, 0.05, steps)
    )
    dt_ns = np.minimum(np.round(period_ns * factor).astype(np.int64), longest_ns)
    before, y, y_m = _drawn_states(sets[index], rng, dt_ns)
    after = _states_after(sets[index], before, y, y_m, dt_ns)
    zero = np.zeros((steps, 9), dtype=np.int64)
    integers = zero + np.array([1, 0, Mode.ENGAGED, 1, 0, 0, 0, 0, 0])
    integers[:, 4] = integers[:, 8] = EPOCH_NS + dt_ns
    events = np.zeros(2 * steps + 1, dtype=event_type(len(y)))
    events[0]["kind"] = START
    events[0]["flag"] = index
    load = events[1::2]
    tick = events[2::2]
    load["kind"] = LOAD
    load["stamp_ns"] = EPOCH_NS
    tick["kind"] = GUARD_TICK
    tick["flag"] = 3
    tick["y"] = y.T
    tick["y_m"] = y_m.T
    tick["now_ns"] = tick["stamp_ns"] = EPOCH_NS + dt_ns
    groups = list(real_groups(sets[index]))
    reals = _rows(after, groups)
    loaded = _rows(before, groups)
    return Recording(
        name=f"drawn steps, parameters {index}",
        names=state_names(sets[index]),
        events=events,
        integers=integers,
        reals=reals,
        loaded=loaded,
    )


def drawn_commands(reference: ReferenceModelConfig, steps: int, seed: int) -> Recording:
    """Draw live commands u_m for the reference model, and record its steps.

    The commands have any size, also beyond their bounds. They can be late, repeated, or lost for
    longer than `max_age`.
    """
    rng = np.random.default_rng(seed)
    model = Reference(
        reference.model_copy(update={"pulses": {}, "sines": {}, "coordinated_turn": None})
    )
    m = len(reference.outputs)
    bounds = reference.live_params().bounds
    size = np.where(np.isfinite(bounds), bounds, 1.0)
    none = np.zeros(m)
    events: list[tuple[Any, ...]] = [(START, 0, 0, 0, 0, none, none)]
    refusals = []
    reals = []
    silence = 0
    for k in range(steps):
        silence -= 1
        if rng.random() < 0.02:
            silence = int(rng.exponential(2.0 * reference.live.max_age * reference.rate))
        refusals.append(0)
        if silence <= 0:
            stamp_ns = max(k + round(rng.uniform(-1.5, 0.5)), 0) * model.period_ns
            u_m = rng.uniform(-1.1, 1.1) * size * rng.uniform(0.2, 1.0, m)
            events.append((TAKE_U_M, 0, stamp_ns, 0, 0, u_m, none))
            try:
                model.take(stamp_ns, u_m)
            except ChannelError:
                refusals[-1] = 1
        events.append((STEP_REFERENCE, 0, 0, 0, 0, none, none))
        reals.append(np.concatenate([model.sample(k + 1), model.x_m]))
    names = ("refused", *numbered({"y_m": m, "x_m": len(model.x_m)}))
    integers = np.array(refusals, dtype=np.int64)[:, None]
    return Recording(
        name="drawn commands",
        names=names,
        events=np.array(events, dtype=event_type(m)),
        integers=integers,
        reals=np.array(reals),
    )


def _rows(values: Mapping[str, FloatArray], groups: Sequence[str]) -> FloatArray:
    """Return an array with a row for each step. A row has the values of all groups side by side.

    `values` has an array of the shape (values, steps) for each group.
    """
    return np.ascontiguousarray(np.vstack([values[name] for name in groups]).T)


def _drawn_states(
    controller: RiseDiConfig, rng: np.random.Generator, dt_ns: NDArray[np.int64]
) -> tuple[dict[str, FloatArray], FloatArray, FloatArray]:
    """Draw the states before the steps, by group of values, and the y and y_m of the steps.

    Each array has the shape (values, steps).
    """
    m = len(controller.outputs)
    steps = len(dt_ns)
    eps = controller.law_params().eps[:, None]
    scale = np.array(controller.input_scale)[:, None]
    size = (
        eps
        * 10.0 ** rng.uniform(-3.0, 2.5, (1, steps))
        * 10.0 ** rng.uniform(-1.0, 0.0, (m, steps))
    )
    u_size = 10.0 * scale * size
    sizes = {
        "u": u_size, "u_free": u_size, "u_trim": 0.1 * u_size, "y": eps, "y_m": eps, "e_0": size,
        "e": size, "integral_e": size,
        "Pi": 10.0 * size, "u_o": 0.1 * u_size, "z": size[:1], "feedforward.x": size[:1],
        "feedforward.u": u_size,
        "feedforward.u_0": u_size,
        "u_ff": (0.0 if controller.feedforward is None else 0.3) * u_size,
    }  # fmt: skip
    if controller.allocation is not None:
        stops = controller.effector_limits()
        sizes["effectors"] = 0.3 * (stops.upper - stops.lower)[:, None]
    states = {
        name: sizes.get(name, 0.0) * rng.normal(size=(count, steps))
        for name, count in real_groups(controller).items()
    }
    states |= {"sigma": rng.random((1, steps)), "scale": rng.uniform(0.3, 3.0, (m, steps))}
    states |= {"feedforward.dt": dt_ns[None] / NANOSECONDS * rng.random((1, steps))}
    states |= {"feedforward.ticks": rng.integers(0, 5, (1, steps)).astype(np.float64)}
    states["y"] = states["y_m"] + states["e"]
    y_m = states["y_m"] + 0.1 * size * rng.normal(size=(m, steps))
    y = y_m + states["e"] + 0.1 * size * rng.normal(size=(m, steps))
    if controller.schedule is not None:
        y[list(controller.outputs).index("V")] += controller.schedule.speed * rng.uniform(
            -1.0, 1.0, steps
        )
    return states, y, y_m


def _states_after(
    controller: RiseDiConfig,
    before: Mapping[str, FloatArray],
    y: FloatArray,
    y_m: FloatArray,
    dt_ns: NDArray[np.int64],
) -> dict[str, FloatArray]:
    """Compute the states after each step, all columns at once, by the functions of the guard.

    A column is one of the drawn steps.
    """
    guard = controller.guard()
    law = controller.tuned_law()
    period = seconds(guard.period_ns)
    dt = np.maximum(dt_ns / NANOSECONDS, LEAST_DT * period)
    params = _columns(law.params)
    limits = _columns(guard.limits)
    zero = np.zeros_like(y)
    state = restored(law.control_law, before)
    u_before = before["u"]
    at_last_y = Measurements(
        y=before["y"],
        y_m=before["y_m"],
        y_m_dot=zero,
        u_trim=before["u_trim"] + before["u_ff"],
        u_before=u_before,
    )
    # Predict over lost periods.
    lost_periods = np.round(dt / period) - 1.0
    for k in range(round(lost_periods.max())):
        state = _where(k < lost_periods, law.control_law.missed(state, at_last_y, params), state)
    u_ff, model_state = _feedforward_step(guard.nominal, before, y_m, dt)
    u_trim = before["u_trim"] if guard.nominal is None else before["u_trim"] + u_ff
    measurements = Measurements(y=y, y_m=y_m, y_m_dot=zero, u_trim=u_trim, u_before=u_before)
    # Step the law, and step it inside the limits if one of them acts.
    law_state, u_free = law.control_law.step(state, measurements, dt, params)
    last = before.get("effectors")
    u, _ = _effector_values(saturate(u_free, u_before, dt, limits), last, dt, guard.allocation)
    is_limited = (u != u_free).any(axis=0)
    limits = limits if guard.allocation is None else limits_of_effectors(u_free, u)
    law_state_limited, u_free_limited, u_limited = law.control_law.limited(
        state, measurements, dt, params, limits
    )
    u, effectors = _effector_values(np.where(is_limited, u_limited, u), last, dt, guard.allocation)
    # Collect the state after the step, and the output of the tick.
    after = {
        **before,
        "u": u,
        "u_free": np.where(is_limited, u_free_limited, u_free),
        "u_ff": u_ff,
        **({} if effectors is None else {"effectors": effectors}),
        **fields(_where(is_limited, law_state_limited, law_state)),
        **model_state,
    }
    output = {
        "output.y": y,
        "output.y_m": y_m,
        "output.y_m_offset": np.zeros((1, len(dt))),
        "output.dt": dt[None],
    }
    return after | {"y": y, "y_m": y_m} | output


def _feedforward_step(
    nominal: Nominal | None,
    before: Mapping[str, FloatArray],
    y_m: FloatArray,
    dt: FloatArray,
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Compute u_ff after a step of the feedforward, and the feedforward's states by name.

    Each array has a column for each of the drawn steps.
    """
    if nominal is None:
        return before["u_ff"], {}
    x, u, dt_before, ticks, u_0 = (
        before[f"feedforward.{name}"] for name in FeedforwardState._fields
    )
    model_state, u_ff = feedforward.step(
        FeedforwardState(x=x, u=u, dt=dt_before[0], ticks=ticks[0], u_0=u_0),
        y_m,
        dt,
        _columns(nominal),
    )
    states = model_state._asdict().items()
    return u_ff, {f"feedforward.{name}": np.atleast_2d(value) for name, value in states}


def _effector_values(
    u: FloatArray, before: FloatArray | None, dt: FloatArray, params: Allocation | None
) -> tuple[FloatArray, FloatArray | None]:
    """Allocate u to the effectors for many steps, one in each column.

    Returns the u that the effectors can give, and the commands of the effectors. Without an
    allocation, the results are `u` and None.
    """
    if params is None or before is None:
        return u, None
    pairs = [
        allocate(v, last, step, params) for v, last, step in zip(u.T, before.T, dt, strict=True)
    ]
    return np.array([v for _, v in pairs]).T, np.array([effectors for effectors, _ in pairs]).T


def _columns(params: Any) -> Any:
    """Turn the vectors of a controller's parameters into columns, for many steps at once."""
    if hasattr(params, "_asdict"):
        return type(params)(*map(_columns, params))
    return params[:, None] if isinstance(params, np.ndarray) and params.ndim == 1 else params


def _where(mask: NDArray[np.bool_], here: Any, otherwise: Any) -> Any:
    """Return, for each step, the state `here` if the mask is True, else the other state.

    The other state is the argument `otherwise`.
    """
    if hasattr(here, "_asdict"):
        return type(here)(*(_where(mask, *pair) for pair in zip(here, otherwise, strict=True)))
    return np.where(mask, here, otherwise)
