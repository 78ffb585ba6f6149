# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Sign check of a channel map: signs from its rows and the airframe, and an estimate of Omega from a recorded flight."""

from typing import NamedTuple

import numpy as np

from autopilot_bridge.params import MOTIONS, ChannelMap
from flight_core.parameters import require
from flight_core.rates import NANOSECONDS, seconds
from flight_core.tape import Signal
from flight_core.vectors import FloatArray

INTERVAL = 0.05  # s over which a slope is taken: longer than a servo lag, shorter than a manoeuvre
MIN_ERROR_RATIO = 5.0  # in standard errors: correlated residuals make them two or three times too small
MIN_INTERVALS = 3  # per regressor


def output_signs(channel_map: ChannelMap) -> FloatArray:
    """+1 for each output with the sign convention of the stack (q nose up, p roll right, r nose right, V faster), otherwise -1.

    Shape (m,) in the map's order. Raises ParameterError where the motion of a row does not belong to its channel.
    """
    signs = []
    for name, row in channel_map.outputs.items():
        output, sign = row.motion
        channels = sorted({channel for channel, _ in MOTIONS.values()})
        key = f"map {channel_map.name}: outputs.{name}"
        require(name in channels, key, "a channel", f"one of {', '.join(channels)}")
        require(output == name, f"{key}.positive", f"{row.positive!r}", f"a motion to which {name} responds")
        signs.append(sign)
    return np.array(signs, dtype=np.float64)


def input_signs(channel_map: ChannelMap, Omega: FloatArray) -> FloatArray:
    """+1 for each input whose effect has the sign of Omega = C B, otherwise -1; shape (m,).

    Arguments: Omega (m, m), rows and columns in the map's order. Raises ParameterError for an input without effect on its
    output.
    """
    signs = []
    for j, (name, row) in enumerate(channel_map.inputs.items()):
        output, sign = row.motion
        key = f"map {channel_map.name}: inputs.{name}.positive"
        outputs = list(channel_map.outputs)
        require(output in outputs, key, f"{row.positive!r}", f"a motion to which one of {', '.join(outputs)} responds")
        effect = Omega[outputs.index(output), j]
        require(effect != 0.0, key, f"{row.positive!r}", f"a motion by {name}: in the airframe {output} does not respond")
        signs.append(sign * np.sign(effect))
    return np.array(signs)


def through(channel_map: ChannelMap, Omega: FloatArray) -> FloatArray:
    """Omega between the channels of the map: diag(output signs) Omega diag(input signs), shape (m, m)."""
    return output_signs(channel_map)[:, None] * Omega * input_signs(channel_map, Omega)


class Estimate(NamedTuple):
    """Estimate of Omega from a recorded flight, rows as `outputs`, columns as `inputs`."""

    Omega: FloatArray  # (m, m) slopes of y per unit of u
    ratio: FloatArray  # (m, m) abs(Omega) / standard error: the sign is certain above MIN_ERROR_RATIO
    intervals: int


def estimate(y: Signal, u: Signal, outputs: tuple[str, ...], inputs: tuple[str, ...]) -> Estimate:
    """Omega by least squares: changes of y_dot on changes of u, from one interval of h = 0.05 s to the next.

        slope_k = (y(t_k + h) - y(t_k)) / h,  slope_(k+1) - slope_k = Omega (u_(k+1) - u_k) + A (y_(k+1) - y_k) + F y_k + c

    with u the mean over its interval. In the changes, states outside y that are slow compared with h, such as alpha and beta,
    cancel. A fit of y_dot itself would attribute the controller's reaction to them to u. The reaction to noise and gusts
    still biases the fit, by less. So excite each input separately, and trust ratios above MIN_ERROR_RATIO.
    Raises ParameterError where there are too few samples or an input never moves.
    """
    for topic, signal, names in (("y", y, outputs), ("u", u, inputs)):
        missing = [name for name in names if name not in signal.names]
        require(not missing, f"{topic} of the log", ", ".join(signal.names), f"the channels {', '.join(names)}")
    start_ns, end_ns = max(y.stamp_ns[0], u.stamp_ns[0]), min(y.stamp_ns[-1], u.stamp_ns[-1])
    count = int(seconds(int(end_ns - start_ns)) / INTERVAL)
    least = MIN_INTERVALS * (2 * len(outputs) + len(inputs) + 1)
    require(count >= least, "the log", f"{max(count, 0)} intervals of {INTERVAL:g} s with y and u", f"{least} or more")
    edges = INTERVAL * np.arange(count + 1)
    t_y, t_u = ((signal.stamp_ns - start_ns) / NANOSECONDS for signal in (y, u))
    values = np.array([np.interp(edges, t_y, y[name]) for name in outputs]).T
    fine = INTERVAL / 10.0 * np.arange(10 * count)
    held = np.clip(np.searchsorted(t_u, fine, side="right") - 1, 0, None)
    bins = np.array([u[name] for name in inputs]).T[held].reshape(count, 10, len(inputs)).mean(axis=1)
    for name, spread in zip(inputs, np.ptp(bins, axis=0), strict=True):
        require(bool(spread > 0.0), f"u.{name} of the log", "a value that never changes", "a flight in which each input moves")
    slope_changes = np.diff(values, n=2, axis=0) / INTERVAL
    u_changes, y_changes = np.diff(bins, axis=0), np.diff(values[:-1], axis=0)
    regressors = np.column_stack([u_changes, y_changes, values[1:-1], np.ones(count - 1)])
    size = np.abs(regressors).max(axis=0)
    size[size == 0.0] = 1.0
    scaled = regressors / size
    inverse = np.linalg.pinv(scaled.T @ scaled)
    fit = inverse @ scaled.T @ slope_changes
    freedom = len(regressors) - regressors.shape[1]
    variance = np.sum((slope_changes - scaled @ fit) ** 2, axis=0) / freedom
    error = np.sqrt(np.outer(np.diag(inverse), variance))
    part = slice(len(inputs))
    Omega = (fit[part] / size[part, None]).T
    deviation = (error[part] / size[part, None]).T
    return Estimate(Omega, np.abs(Omega) / np.maximum(deviation, np.finfo(float).tiny), count)
