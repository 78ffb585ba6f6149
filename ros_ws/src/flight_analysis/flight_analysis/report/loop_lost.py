# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether the loop of a flight was lost: an input that goes from limit to limit, an error that
oscillates, or one that grows. Limits keep all three bounded, and such a flight reaches its end.

- Of the ticks of WINDOW, SATURATED or more have u of an input at a limit, SIDE or more on either
  side of u_free. A climb at full throttle stays on one side. A limit of the rate does not count:
  noise reaches the rate of a slow engine to either side. A swing between rate limits shows in e:
  the loop is lost once e repeats itself or grows, and holds otherwise.
- e repeats itself over WINDOW, `divergence.period`, with a mean square above `divergence.least`: a
  limit cycle, also of actuators whose limits the controller does not have.
- The mean square of e over the last WINDOW is above FACTOR^2 times the largest before, and above
  the least.

FACTOR, WINDOW and the least are those at which a controller ends a learned model.
"""

import numpy as np
from numpy.typing import NDArray

from flight_analysis.metrics import best_error
from flight_core.rates import seconds
from flight_core.tape import Signal, Tape
from rise_di_controller.divergence import FACTOR, WINDOW, least, period
from rise_di_controller.internals import Saturation

SATURATED = 0.5  # of the ticks: a stable loop of the osprey has 0.14 at most in moderate gusts
SIDE = 0.1  # of the ticks, on either side


def lost_parts(tape: Tape) -> tuple[str, ...]:
    """What was lost, in words; empty for a flight of less than WINDOW, and of a sound loop."""
    parts = _between_limits(tape)
    if {"y", "y_m"} <= set(tape.signals):
        kind, error = best_error(tape)
        smallest = least(error.names)
        for name, lowest in zip(error.names, smallest.tolist(), strict=True):
            part = _oscillates(error, name, lowest) or _grown(error, name, lowest)
            parts += [f"the {kind} of {name} {part}"] if part else []
    return tuple(parts)


def _between_limits(tape: Tape) -> list[str]:
    """The inputs that go from limit to limit, of those with u and u_free in the log."""
    if "internals" not in tape:
        return []
    limited = tape["internals"].group("limited")
    u = tape["internals"].group("u")
    u_free = tape["internals"].group("u_free")
    parts = []
    for name in sorted({*limited.names} & {*u.names} & {*u_free.names}, key=limited.names.index):
        at_limit = limited[name] == Saturation.MAGNITUDE
        above = at_limit & (u_free[name] > u[name])
        below = at_limit & (u_free[name] < u[name])
        share_above = _windowed(limited, above)
        share_below = _windowed(limited, below)
        both = share_above + share_below
        alternates = np.minimum(share_above, share_below) >= SIDE
        worst = np.where(alternates, both, 0.0)
        if worst.max(initial=0.0) >= SATURATED:
            parts.append(
                f"{name} went from limit to limit in {100.0 * worst.max():.0f} % of {WINDOW:g} s"
            )
    return parts


def _oscillates(error: Signal, name: str, lowest: float) -> str:
    """Whether an error repeats itself over a WINDOW, at steps of half of it from the end."""
    ticks = _ticks(error)
    values = error[name]
    for end in range(len(values), ticks - 1, -max(ticks // 2, 1)):
        x = values[end - ticks : end]
        if np.var(x) > lowest and (samples := period(x)):
            return f"oscillated by {np.std(x):.2g} rms, {WINDOW * samples / ticks:.2g} s a cycle"
    return ""


def _grown(error: Signal, name: str, lowest: float) -> str:
    """Whether an error grew up to the end."""
    ticks = _ticks(error)
    squares = _windowed(error, error[name] ** 2)
    if len(squares) <= ticks:
        return ""
    largest = float(squares[:-ticks].max())
    last = float(squares[-1])
    if last <= max(FACTOR**2 * largest, lowest):
        return ""
    return f"grew {np.sqrt(last / largest):.1f} times in the last {WINDOW:g} s"


def _ticks(signal: Signal) -> int:
    """Samples of WINDOW."""
    steps = np.diff(signal.stamp_ns)
    return round(WINDOW / seconds(int(np.median(steps)))) if len(steps) else 1


def _windowed(signal: Signal, values: NDArray[np.generic]) -> NDArray[np.float64]:
    """Means over each whole WINDOW of samples."""
    ticks = _ticks(signal)
    total = np.concatenate([[0.0], np.cumsum(values, dtype=np.float64)])
    return np.asarray((total[ticks:] - total[:-ticks]) / ticks)
