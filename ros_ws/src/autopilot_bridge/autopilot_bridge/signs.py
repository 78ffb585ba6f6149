# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Which way things go through a channel map: what its rows say, and what a recorded flight shows."""

from typing import NamedTuple

import numpy as np

from autopilot_bridge.params import MOTIONS, ChannelMap
from flight_core.parameters import require
from flight_core.rates import NANOSECONDS, seconds
from flight_core.tape import Signal
from flight_core.vectors import FloatArray

INTERVAL = 0.05  # s over which a slope is taken: longer than servos take, shorter than a manoeuvre
SURE = 5.0  # times its standard error: residuals that hang together make that error look two or three times too small
FEWEST = 3  # intervals a regressor, else the fit says nothing


def output_signs(channel_map: ChannelMap) -> FloatArray:
    """+1 for each output that comes with the stack's sign (q nose up, p roll right, r nose right, V faster), -1 for others.

    Shape (m,) in the map's order. Raises ParameterError where a row is of another motion than its channel's.
    """
    signs = []
    for name, row in channel_map.outputs.items():
        output, sign = row.motion
        channels = sorted({channel for channel, _ in MOTIONS.values()})
        require(name in channels, f"map {channel_map.name}: outputs.{name}", "a channel", f"one of {', '.join(channels)}")
        require(
            output == name, f"map {channel_map.name}: outputs.{name}.positive", f"{row.positive!r}", f"a motion that {name} shows"
        )
        signs.append(sign)
    return np.array(signs, dtype=np.float64)


def input_signs(channel_map: ChannelMap, Omega: FloatArray) -> FloatArray:
    """+1 for each input that moves the aircraft the way Omega = C B says, -1 for one that moves it the other way; shape (m,).

    Arguments: Omega (m, m), rows and columns in the map's order. Raises ParameterError where an input does not move its output.
    """
    signs = []
    for j, (name, row) in enumerate(channel_map.inputs.items()):
        output, sign = row.motion
        key = f"map {channel_map.name}: inputs.{name}.positive"
        require(output in channel_map.outputs, key, f"{row.positive!r}", f"a motion that one of {', '.join(channel_map.outputs)} shows")
        effect = Omega[list(channel_map.outputs).index(output), j]
        require(
            effect != 0.0, key, f"{row.positive!r}", f"a motion that {name} makes: in the airframe {output} does not answer"
        )
        signs.append(sign * np.sign(effect))
    return np.array(signs)


def through(channel_map: ChannelMap, Omega: FloatArray) -> FloatArray:
    """Omega as the controller sees it through the map: diag(output signs) Omega diag(input signs), shape (m, m)."""
    return output_signs(channel_map)[:, None] * Omega * input_signs(channel_map, Omega)


class Estimate(NamedTuple):
    """What a recorded flight shows of Omega, rows as `outputs`, columns as `inputs`."""

    Omega: FloatArray  # (m, m) slopes of y per unit of u
    ratio: FloatArray  # (m, m) each beside its standard error: the sign is sure from SURE on
    intervals: int  # how many


def estimate(y: Signal, u: Signal, outputs: tuple[str, ...], inputs: tuple[str, ...]) -> Estimate:
    """Least squares of the changes of y_dot on those of u, from one interval of h = 0.05 s to the next.

        slope_k = (y(t_k + h) - y(t_k)) / h,  slope_(k+1) - slope_k = Omega (u_(k+1) - u_k) + A (y_(k+1) - y_k) + F y_k + c

    with u the mean over its interval. Changes, not the values: states that are not in y, such as alpha and beta, are slow
    beside h and drop out; a fit of y_dot itself takes what the controller does against them for an effect of u. Simple, and
    honest only so far: noise that the controller answers, and gusts, do the same on a smaller scale. So excite each input by
    itself, and believe ratios of SURE and more.
    Raises ParameterError where there are too few samples, or an input never moves.
    """
    for what, signal, names in (("y", y, outputs), ("u", u, inputs)):
        missing = [name for name in names if name not in signal.names]
        require(not missing, f"{what} of the log", ", ".join(signal.names), f"the channels {', '.join(names)}")
    start_ns, end_ns = max(y.stamp_ns[0], u.stamp_ns[0]), min(y.stamp_ns[-1], u.stamp_ns[-1])
    count = int(seconds(int(end_ns - start_ns)) / INTERVAL)
    least = FEWEST * (2 * len(outputs) + len(inputs) + 1)
    require(count >= least, "the log", f"{max(count, 0)} intervals of {INTERVAL:g} s with y and u", f"{least} or more")
    edges = INTERVAL * np.arange(count + 1)
    t_y, t_u = ((signal.stamp_ns - start_ns) / NANOSECONDS for signal in (y, u))
    values = np.array([np.interp(edges, t_y, y[name]) for name in outputs]).T
    fine = INTERVAL / 10.0 * np.arange(10 * count)
    held = np.clip(np.searchsorted(t_u, fine, side="right") - 1, 0, None)
    bins = np.array([u[name] for name in inputs]).T[held].reshape(count, 10, len(inputs)).mean(axis=1)
    for name, spread in zip(inputs, np.ptp(bins, axis=0), strict=True):
        require(bool(spread > 0.0), f"u.{name} of the log", "a value that never changes", "a flight in which each input moves")
    turn = np.diff(values, n=2, axis=0) / INTERVAL
    moves, changes = np.diff(bins, axis=0), np.diff(values[:-1], axis=0)
    regressors = np.column_stack([moves, changes, values[1:-1], np.ones(len(turn))])
    size = np.abs(regressors).max(axis=0)
    size[size == 0.0] = 1.0
    scaled = regressors / size
    inverse = np.linalg.pinv(scaled.T @ scaled)
    fit = inverse @ scaled.T @ turn
    freedom = len(turn) - regressors.shape[1]
    variance = np.sum((turn - scaled @ fit) ** 2, axis=0) / freedom
    error = np.sqrt(np.outer(np.diag(inverse), variance))
    part = slice(len(inputs))
    Omega = (fit[part] / size[part, None]).T
    deviation = (error[part] / size[part, None]).T
    return Estimate(Omega, np.abs(Omega) / np.maximum(deviation, np.finfo(float).tiny), count)
