# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Identify the input-output response of an aircraft from a log of y and u, without a model.

The results are Omega, lags and delays with standard errors.

A predictor gives every sample of y from earlier samples of y and from u. The predictor is fitted by
least squares, and it goes back far enough to predict the effect of earlier disturbances as well.
The step response of the predictor is the step response of the aircraft. A second-order response
with a delay and a lag is fitted to the beginning of this step response, and yields Omega, the lag
and the delay.

Sources: L. Ljung, "System Identification", 1999, 7.3 and 13.4 (direct identification in closed
loop); U. Forssell, L. Ljung, Automatica 35, 1999; Y. Zhu, "Multivariable System Identification for
Process Control", 2001, 6 (a high-order ARX model, then a reduced one).
"""

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from flight_core.outcome import Refusal
from flight_core.parameters import require
from flight_core.rates import NANOSECONDS, seconds
from flight_core.tape import Signal
from flight_core.vectors import FloatArray
from flight_design.identification.step_response_fit import (
    RESOLUTION,
    ResponseColumn,
    fitted_column,
    no_column,
)

# s, width of the windows over which u and older samples of y are averaged; shorter than the lag of
# a servo
WINDOW = 0.02
RECENT = 4  # number of the newest samples of y, which the predictor takes one by one
# s, time before a sample that windows of equal width cover. It contains the longest delay and a
# lag.
FINE_Y = 0.2
FINE_U = 0.45
# s, time before a sample that windows of doubling width cover. It contains the memory of
# disturbances and of a controller.
FAR = 2.0
HORIZON = 0.8  # s, length of the step response
# number of random draws of the predictor's coefficients, from which the covariance of the step
# response follows
DRAWS = 200
# Prior standard deviation of a coefficient. A coefficient of 1 turns the typical change of an
# output within a window, or the standard deviation of an input, into the typical change of y.
PRIOR = 10.0
MEMORY = 0.2  # s, decay of the prior standard deviations of the predictor's coefficients
MIN_ROWS_PER_COEFFICIENT = 5.0
# Share of the motion in a closed loop that the excitation must explain. The response to
# disturbances through the feedback is then too small to be taken for the response of the aircraft.
MIN_SHARE = 0.9
# Factor on the estimated errors in a closed loop: up to a tenth of the motion comes from feedback,
# and the bias is then as large as the errors.
CLOSED_LOOP_ERRORS = 2.0
LOOP_MEMORY = 8.0  # s, time before an instant in which the excitation has an effect at this instant
LOOP_FINE = 6  # number of windows that are a PERIOD wide
PERIOD = 0.05  # s
FOLDS = 6  # number of parts of a flight, each of which is predicted from the other parts
# Regularisation of the fit; the value that predicts better is used. The first one suits flights
# with few commands, the second one flights with many disturbances.
RIDGES = (1e-4, 1e-2)
# s, least delay in a closed loop. An earlier response would be the reaction of u to y, because no
# servo is as fast.
LEAST_DELAY = 0.01
ITERATIONS = 3  # number of times that the variance and then the coefficients are estimated
# s, longest gap in y that a straight line bridges; no prediction looks across a longer gap
BRIDGED = 0.1
# the sign of Omega is certain if the response has at least this many standard errors
MIN_RATIO = 5.0


Spans = Sequence[tuple[int, int]]


class Response(NamedTuple):
    """The response of m outputs to m inputs, where input i drives output i, in SI.

        y_i_dot = sum_j Omega_ij v_j + slower terms,   lag_j v_j_dot = u_j(t - delay_j) - v_j

    The lag, the delay and the column of Omega of an input without a step response are NaN. Other
    refused channels keep their values.
    """

    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    Omega: FloatArray  # (m, m), a row for each output and a column for each input
    Omega_deviation: FloatArray  # (m, m) standard errors of Omega
    lag: FloatArray  # (m,) s, lag of each input
    lag_deviation: FloatArray  # (m,) standard errors of the lags, s
    delay: FloatArray  # (m,) s, delay from u to the stamp of y
    delay_deviation: FloatArray  # (m,) standard errors of the delays, s
    refusal: tuple[Refusal | None, ...]  # (m,) why Omega_ii must not be used
    seconds: float  # how many seconds of the log were used
    share: FloatArray  # (m,) share of the motion that the excitation explains; 1 in open loop
    # (m,) response of output i to input i, in standard errors; the sign of Omega_ii is certain from
    # MIN_RATIO on. It is 0 if `share` is below MIN_SHARE, or if the delay is below LEAST_DELAY in a
    # closed loop.
    sign_ratio: FloatArray

    def reason_against_sign(self, i: int) -> Refusal | None:
        """Return a refusal if the sign of Omega_ii is uncertain, else None."""
        output = self.outputs[i]
        name = self.inputs[i]
        ratio = float(self.sign_ratio[i])
        if ratio == 0.0 and self.refusal[i] is not None:
            return self.refusal[i]
        if ratio >= MIN_RATIO:
            return None
        uncertain = (
            f"{output} by {name}: found a response of {ratio:.1f} standard errors, "
            f"expected {MIN_RATIO:g} or more"
        )
        return Refusal(f"{uncertain}: {_more_excitation(name, ratio)}")


def identify_response(
    y: Signal,
    u: Signal,
    outputs: Sequence[str],
    inputs: Sequence[str],
    *,
    excitation: Signal | None = None,
    engaged: Spans | None = None,
) -> Response:
    """Return Omega, lag and delay of every channel of a log, with standard errors and refusals.

    Args:
        y: The outputs. Their stamps may have irregular intervals.
        u: The inputs after their limits. Their stamps may have irregular intervals.
        outputs: The outputs of the channels.
        inputs: The inputs of the channels, in pairs with the outputs.
        excitation: The signal that moves u from outside in a closed loop, such as y_m. It is None
            if u itself is the excitation, as in an open-loop experiment.
        engaged: The spans in ns in which u acts on the aircraft; by default the whole log.

    Raises:
        ParameterError: A channel is missing, or there are too few samples for any channel.
    """
    for topic, signal, names in (("y", y, outputs), ("u", u, inputs)):
        missing = [name for name in names if name not in signal.names]
        require(
            not missing,
            f"{topic} of the log",
            ", ".join(signal.names),
            f"the channels {', '.join(names)}",
        )
    require(
        len(y.stamp_ns) > 1 and len(u.stamp_ns) > 1,
        "the log",
        f"{len(y.stamp_ns)} samples of y",
        "a flight",
    )
    layout = Layout.from_period(float(np.median(np.diff(y.stamp_ns))) / NANOSECONDS)
    spans = [(int(y.stamp_ns[0]), int(y.stamp_ns[-1]))] if engaged is None else engaged
    rows = [_rows(y, u, outputs, inputs, layout, span) for span in spans]
    predictor = _fit(rows, layout, len(outputs))
    share = np.ones(len(outputs))
    if excitation is not None:
        share = np.minimum(
            explained(y, outputs, excitation, spans), explained(u, inputs, excitation, spans)
        )
    return _fitted_response(
        tuple(outputs), tuple(inputs), layout, predictor.step_responses(), rows, share
    )


# The predictor


class Layout(NamedTuple):
    """The regressors that predict y(k): recent samples of y, and means of y and u over windows.

    The windows lie before the sample k. The ends of the windows are given in sample periods before
    k.
    """

    period: float  # s, period of y
    recent: int  # number of the newest samples of y, taken one by one
    y_windows: tuple[tuple[int, int], ...]  # (a, b): the mean of y(k - a - 1) to y(k - b)
    # (a, b): the mean of u from t_k - b period to t_k - a period
    u_windows: tuple[tuple[int, int], ...]

    @classmethod
    def from_period(cls, period: float) -> "Layout":
        """Return the layout for a given period of y, s."""

        def windows(first: int, fine: float) -> tuple[tuple[int, int], ...]:
            width = max(round(WINDOW / period), 1)
            ends = [first]
            while ends[-1] * period < FAR:
                width = width if ends[-1] * period < fine else 2 * width
                ends.append(ends[-1] + width)
            return tuple(pairwise(ends))

        return cls(period, RECENT, windows(RECENT, FINE_Y), windows(0, FINE_U))

    @property
    def past(self) -> int:
        """Number of samples of y before the first sample that is predicted."""
        return self.y_windows[-1][1]

    def y_decay(self) -> FloatArray:
        """Return the relative prior standard deviations of the coefficients of y."""
        middles = [*range(1, self.recent + 1), *((a + b + 1) / 2.0 for a, b in self.y_windows)]
        return np.asarray(np.exp(-self.period * np.array(middles) / MEMORY))

    def u_root(self) -> FloatArray:
        """Return a root of the relative prior covariance of the coefficients of u.

        The prior expects coefficients that are smooth and decay. Its kernel is exp(-max(s, t) /
        MEMORY) for two windows at the times s and t. Source: T. Chen, H. Ohlsson, L. Ljung,
        Automatica 48, 2012.
        """
        ends = np.array(self.u_windows)
        late = self.period * np.mean(ends, axis=1)
        return np.asarray(np.linalg.cholesky(np.exp(-np.maximum(late[:, None], late) / MEMORY)))


class _Rows(NamedTuple):
    regressors: FloatArray  # (N, coefficients)
    y: FloatArray  # (N, m)
    u: FloatArray  # (K, m) as recorded in the span


def _within(
    signal: Signal, names: Sequence[str], span: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Return the samples of the named channels in a span: times after its start, s, and values."""
    inside = (signal.stamp_ns >= span[0]) & (signal.stamp_ns <= span[1])
    return (signal.stamp_ns[inside] - span[0]) / NANOSECONDS, np.stack(
        [signal[name][inside] for name in names], axis=1
    )


def bridged(
    t: FloatArray, values: FloatArray, period: float
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Fill gaps of at most BRIDGED by straight lines, and return which samples were recorded.

    Returns the times, (N,), the values, (N, m), and the mask, (N,), of the samples that were
    recorded.
    """
    missing = np.rint(np.diff(t) / period).astype(np.int64) - 1
    counts = 1 + np.where(missing * period <= BRIDGED, np.maximum(missing, 0), 0)
    before = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(len(before)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[
        before
    ]
    filled = np.append(t[before] + share * np.diff(t)[before], t[-1:])
    columns = [np.interp(filled, t, column) for column in values.T] if len(t) else list(values.T)
    return filled, np.stack(columns, axis=1), np.append(share == 0.0, np.ones(len(t[-1:]), bool))


def _integral(t: FloatArray, steps: FloatArray, instants: FloatArray) -> FloatArray:
    """Integrate a signal from t[0] to `instants`.

    `steps` has the mean of the signal between each of the times t and the next one.
    """
    sums = np.concatenate(
        [np.zeros((1, steps.shape[1])), np.cumsum(steps * np.diff(t)[:, None], axis=0)]
    )
    return np.stack([np.interp(instants, t, column) for column in sums.T], axis=1)


def _rows(
    y: Signal,
    u: Signal,
    outputs: Sequence[str],
    inputs: Sequence[str],
    layout: Layout,
    span: tuple[int, int],
) -> _Rows:
    """Return the regressors for a span, the samples of y that they predict, and u."""
    (t, values), (t_u, u_values), m = (
        _within(y, outputs, span),
        _within(u, inputs, span),
        len(outputs),
    )
    t, values, is_recorded = bridged(t, values, layout.period)
    gaps = np.concatenate([[0], np.cumsum(np.diff(t) > BRIDGED + layout.period)])
    k = np.arange(layout.past, len(t))
    k = k[is_recorded[k] & (gaps[k] == gaps[k - layout.past])]
    if len(t_u) > 1:
        k = k[(t[k] - layout.u_windows[-1][1] * layout.period >= t_u[0]) & (t[k] <= t_u[-1])]
    if len(t_u) < 2 or not len(k):
        return _Rows(np.zeros((0, 0)), np.zeros((0, m)), u_values)
    sums = np.concatenate([np.zeros((1, m)), np.cumsum(values, axis=0)])
    columns = [values[k - lag] for lag in range(1, layout.recent + 1)]
    columns += [(sums[k - a] - sums[k - b]) / (b - a) for a, b in layout.y_windows]
    edges = [0, *(b for _, b in layout.u_windows)]
    ends = [_integral(t_u, u_values[:-1], t[k] - edge * layout.period) for edge in edges]
    for (new, old), (a, b) in zip(pairwise(ends), layout.u_windows, strict=True):
        columns.append((new - old) / ((b - a) * layout.period))
    return _Rows(np.concatenate(columns, axis=1), values[k], u_values)


class _Predictor(NamedTuple):
    """The predictor y(k) = coefficients^T regressors + e, with its uncertainty."""

    layout: Layout
    coefficients: FloatArray  # (m lags, m), rows in the order of the regressors
    roots: FloatArray  # (m, m lags, m lags) roots of the covariance of each column

    def step_responses(self) -> FloatArray:
        """Return the responses of every output to a step of every input, (1 + DRAWS, K, m, m).

        The step has size 1. The first response comes from the estimate, and the others come from
        random draws of the coefficients. The K instants are whole periods after the step, up to
        HORIZON.
        """
        m = self.coefficients.shape[1]
        layout = self.layout
        normal = np.random.default_rng(0).standard_normal((DRAWS, *self.coefficients.shape))
        draws = self.coefficients + np.einsum("ikl,dli->dki", self.roots, normal)
        every = np.concatenate([self.coefficients[None], draws])
        blocks = np.swapaxes(every.reshape(len(every), -1, m, m), -1, -2)
        windows = len(layout.y_windows)
        steps = round(HORIZON / layout.period)
        feedback = np.zeros((len(every), max(layout.past, steps), m, m))
        feedback[:, : layout.recent] = blocks[:, : layout.recent]
        for number, (first, last) in enumerate(layout.y_windows, layout.recent):
            feedback[:, first:last] += blocks[:, number : number + 1] / (last - first)
        s = np.zeros((len(every), steps + 1, m, m))
        for k in range(1, steps + 1):
            for number, (first, last) in enumerate(layout.u_windows, layout.recent + windows):
                s[:, k] += min(max((k - first) / (last - first), 0.0), 1.0) * blocks[:, number]
            s[:, k] += np.einsum("dlij,dljn->din", feedback[:, : k - 1], s[:, k - 1 : 0 : -1])
        return s[:, 1:]


def _fit(rows: Sequence[_Rows], layout: Layout, m: int) -> _Predictor:
    """Fit the predictor by least squares over the spans, with a constant for each span."""
    parts = [part for part in rows if len(part.y)]
    samples = sum(len(part.y) for part in parts)
    coefficients = m * (layout.recent + len(layout.y_windows) + len(layout.u_windows))
    least = MIN_ROWS_PER_COEFFICIENT * coefficients
    length = f"{samples * layout.period:.3g} s in which u acts and {FAR:g} s before are known"
    require(samples >= least, "the log", length, f"{least * layout.period:.3g} s or more")
    X = np.concatenate([part.regressors - part.regressors.mean(axis=0) for part in parts])
    Y = np.concatenate([part.y - part.y.mean(axis=0) for part in parts])
    first_u = m * (layout.recent + len(layout.y_windows))
    moves = np.std(np.diff(Y, axis=0), axis=0) * max(WINDOW / layout.period, 1.0) ** 0.5
    spread = np.std(X[:, first_u : first_u + m], axis=0)
    per_y, per_u = (
        1.0 / np.where(deviation > 0.0, deviation, np.inf) for deviation in (moves, spread)
    )
    prior = PRIOR * block_diag(
        np.diag(np.kron(layout.y_decay(), per_y)), np.kron(layout.u_root(), np.diag(per_u))
    )
    X_scaled = X @ prior
    normal = X_scaled.T @ X_scaled
    fits = []
    roots = []
    for i in range(m):
        variance = (1e-3 * moves[i]) ** 2 or 1.0
        for _ in range(ITERATIONS):
            values, vectors = np.linalg.eigh(
                normal * moves[i] ** 2 / variance + np.eye(len(normal))
            )
            root = moves[i] * prior @ (vectors / np.sqrt(np.maximum(values, 1.0)))
            fit = root @ (root.T @ (X.T @ Y[:, i])) / variance
            e = Y[:, i] - X @ fit
            variance = float(e @ e) / (len(e) - coefficients - len(parts)) or 1.0
        fits.append(fit)
        roots.append(root)
    return _Predictor(layout, np.stack(fits, axis=1), np.stack(roots))


# The excitation of a closed loop


def explained(signal: Signal, names: Sequence[str], excitation: Signal, spans: Spans) -> FloatArray:
    """Return the fraction of each channel's variance that the excitation explains, (k,).

    Without disturbances the fraction is 1. The regressors of a channel at an instant are means of
    the excitation over windows before this instant, up to LOOP_MEMORY. Each span is divided into
    FOLDS parts, and each part is predicted with coefficients that were fitted to the other parts.
    Source of the cross-validation: M. Stone, J. Royal Statistical Society B 36, 1974.
    """
    residual = np.zeros((len(RIDGES), len(names)))
    total = np.zeros(len(names))
    for span in spans:
        before = int(excitation.stamp_ns[0])
        (t, values), (t_w, w) = (
            _within(signal, names, span),
            _within(excitation, excitation.names, (before, span[1])),
        )
        t_w = t_w + seconds(before - span[0])
        if len(t) < 2 or len(t_w) < 2 or t_w[-1] - t[0] < FOLDS * PERIOD:
            continue
        # Take the means of the excitation over windows before each instant.
        instants = np.arange(t[0], min(t[-1], t_w[-1]), PERIOD)
        edges = [0.0]
        while edges[-1] < LOOP_MEMORY:
            edges.append(edges[-1] + PERIOD * 2.0 ** max(len(edges) - LOOP_FINE, 0))
        ends = [_integral(t_w, (w[:-1] + w[1:]) / 2.0, instants - edge) for edge in edges]
        means = [
            (new - old) / (b - a)
            for (new, old), (a, b) in zip(pairwise(ends), pairwise(edges), strict=True)
        ]
        Z = np.concatenate([*means, ends[0]], axis=1)
        Z = Z - Z.mean(axis=0)
        Z = Z / np.maximum(np.linalg.norm(Z, axis=0), np.finfo(float).tiny)
        X = values[np.searchsorted(t, instants, side="right") - 1]
        X = X - X.mean(axis=0)
        # Predict each fold from the others, with each of the ridges.
        fold = np.arange(len(instants)) * FOLDS // len(instants)
        for number in range(FOLDS):
            others = Z[fold != number]
            in_fold = fold == number
            normal = others.T @ others
            product = others.T @ X[fold != number]
            for k, ridge in enumerate(RIDGES):
                fit = np.linalg.solve(normal + ridge * np.eye(len(normal)), product)
                residual[k] += np.sum((X[in_fold] - Z[in_fold] @ fit) ** 2, axis=0)
        total += np.sum(X**2, axis=0)
    unexplained = residual.min(axis=0) / np.where(total > 0.0, total, np.inf)
    return np.where(total > 0.0, 1.0 - unexplained, 0.0)


# The step response


def _has_motion(parts: Iterable[FloatArray]) -> bool:
    """Return whether the values of a channel change in any of the given parts of a log."""
    return any(len(part) and np.ptp(part) > 0.0 for part in parts)


def _fitted_response(
    outputs: tuple[str, ...],
    inputs: tuple[str, ...],
    layout: Layout,
    responses: FloatArray,
    rows: Sequence[_Rows],
    share: FloatArray,
) -> Response:
    """Fit the response of each channel to the step responses of the predictor.

    `responses` comes from `_Predictor.step_responses`. `share` is the fraction of each channel's
    motion that the excitation explains, (m,). A channel that does not move in `rows`, or whose step
    response is not finite, has no fit.
    """
    every = max(round(RESOLUTION / layout.period), 1)
    t = layout.period * np.arange(every, responses.shape[1] + 1, every)
    responses = responses[:, every - 1 :: every]
    columns = []
    refusal = []
    for j in range(len(inputs)):
        recorded = {
            inputs[j]: [part.u[:, j] for part in rows],
            outputs[j]: [part.y[:, j] for part in rows],
        }
        still = next((name for name, parts in recorded.items() if not _has_motion(parts)), None)
        usable = still is None and bool(np.isfinite(responses[..., j]).all())
        columns.append(
            fitted_column(t, responses[..., j], j) if usable else no_column(len(outputs))
        )
        refusal.append(
            _reason_against_channel(outputs[j], inputs[j], columns[-1], j, still, float(share[j]))
        )
    lag, lag_deviation, delay, delay_deviation, sign_ratio = (
        np.array([getattr(column, name) for column in columns])
        for name in ResponseColumn._fields[2:]
    )
    counts = (share >= MIN_SHARE) & ~((share < 1.0) & (delay < LEAST_DELAY))
    weights = np.where(share < 1.0, counts / CLOSED_LOOP_ERRORS, counts)
    return Response(
        outputs=outputs,
        inputs=inputs,
        Omega=np.stack([column.Omega for column in columns], axis=1),
        Omega_deviation=np.stack([column.deviation for column in columns], axis=1),
        lag=lag,
        lag_deviation=lag_deviation,
        delay=delay,
        delay_deviation=delay_deviation,
        refusal=tuple(refusal),
        seconds=sum(len(part.y) for part in rows) * layout.period,
        share=share,
        sign_ratio=sign_ratio * weights,
    )


def _reason_against_channel(
    output: str, name: str, column: ResponseColumn, j: int, still: str | None, share: float
) -> Refusal | None:
    if still is not None:
        return Refusal(f"{output} by {name}: found {still} constant, expected it to move")
    if not np.isfinite(column.Omega[j]):
        return Refusal(
            f"{output} by {name}: found a response that grows beyond all bounds, expected a "
            "flight that does not diverge"
        )
    if share < MIN_SHARE:
        return Refusal(f"{output} by {name}: {_too_little_share(output, name, share)}")
    ratio = abs(column.Omega[j]) / column.deviation[j]
    if ratio >= MIN_RATIO:
        return None
    inaccurate = (
        f"found Omega within {100.0 / max(ratio, 0.1):.0f} %, expected "
        f"{100.0 / MIN_RATIO:.0f} % or less"
    )
    return Refusal(f"{output} by {name}: {inaccurate}: {_more_excitation(name, ratio)}")


def _too_little_share(output: str, name: str, share: float) -> str:
    """Say that the excitation explains too little of a channel's motion, and how to get more.

    `share` is P / (P + Q), with the power P of the excitation and the power Q of the disturbances.
    """
    factor = math.sqrt((1.0 - share) / max(share, 0.05) / (1.0 / MIN_SHARE - 1.0))
    excited = (
        f"found {100.0 * max(share, 0.0):.0f} % of the motion of {output} and {name} by "
        "the excitation, the rest by feedback"
    )
    remedy = f"command {output} {factor:.1f} times as strongly"
    return f"{excited} of disturbances, expected {100.0 * MIN_SHARE:.0f} % or more: {remedy}"


def _more_excitation(name: str, ratio: float) -> str:
    """Say how much more excitation is needed to identify a channel with certainty.

    The standard errors fall in proportion to the size of the excitation, and to the square root of
    its duration.
    """
    factor = MIN_RATIO / max(ratio, 0.5)
    return f"excite {name} {factor:.1f} times as strongly, or for {factor**2:.1f} times as long"
