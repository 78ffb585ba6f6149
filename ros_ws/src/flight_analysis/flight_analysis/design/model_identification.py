# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Identification of A and B from the log of one flight: maximum a posteriori over the innovations of the observer's filter.

It takes y and u alone, u after its limits. Two of three seconds fit the model, and every third one, held out, validates it. The
scale of alpha or beta cannot be told from y; such entries stay near their nominal values. No number in this module is specific
to an aircraft.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import count
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aircraft_sim.airframe import Airframe
from aircraft_sim.uncertainty import AIR_RELATIVE, as_yaml, gust_directions, wind_factors
from control_laws.nominal_model import NominalModel
from control_laws.observer_design import Names
from flight_analysis.design.gain_selection import ChannelPairing
from flight_analysis.design.innovation_filters import (
    LEVELS,
    TRANSIENT,
    Actuation,
    Block,
    FilterBank,
    Recording,
    blocks,
    delayed,
    filter_bank,
    filter_model,
)
from flight_core.vectors import FloatArray

PRIOR = 0.29  # 1, standard deviation of a relative error before the flight: that of +-50 %, uniform
WIND_PRIOR = 1.0  # 1, the same of the logarithm of the strength of the wind along an axis
MAX_ERROR = 0.6  # 1, bound of a relative error: two standard deviations

DIFFERENCE = 1e-4  # 1, of a parameter, for the derivatives
DAMPINGS, FRACTIONS = (0.0, 0.01, 0.1, 1.0, 10.0), (0.5, 0.25)  # of the steps that are tried side by side
MAX_ITERATIONS = 22  # of 0.45 s each on one core: an identification takes at most 10 s
MIN_PROGRESS, MIN_PROGRESS_STRONG = 0.05, 5.0  # of the cost, a log-likelihood, in a step: the search ends, or its first part

STRONG = 4  # index of the level at which the search begins
CHANGE = 3.0  # of log-likelihood that a span has to gain by a stronger wind: odds of 20 to 1

RECOVERY = 2  # spans after a gust that do not count either: the estimates recover
SPAN = 1.0  # s, within which the level is constant
HELD_OUT = 3  # Every third span is held out: each command and gust is then in both parts. A last third has no command.
MAX_DEVIATION = 0.1  # of the best known effect of an input on each output: two deviations are then a fifth of the loop gain
MAX_WHITENESS = 3.0  # 1 for white innovations, with a deviation of 0.3: a model with more leaves out what the aircraft does
LAGS = 20  # of the autocorrelation in the figure of whiteness: 0.2 s at 100 Hz


def span_length(recorded: Recording) -> int:
    """Periods of a span."""
    return max(round(SPAN / recorded.period), 1)


class Innovations(NamedTuple):
    """Innovations of one model over a recording, each span at the level of the wind that predicts it best."""

    r: FloatArray  # (T, m) in units of y, NaN where y is lost
    normalised: FloatArray  # (T, m) of covariance I where the model is right
    log_likelihood: FloatArray  # (T,) of a sample, up to a constant


class Models(NamedTuple):
    """The filters of N models, and their inputs."""

    bank: FilterBank
    begin: FloatArray  # (N, s) estimates at the begin
    u: FloatArray  # (T, m), or (N, T, m) where the delay is identified


class Unknown(NamedTuple):
    """Standard deviations of what else is identified; 0: it is known."""

    delay: float = 0.0  # s, of u
    angle: float = 0.0  # rad, of pitch and bank at the begin of the recording


KNOWN = Unknown()


class Fit(NamedTuple):
    """The most probable theta of a block."""

    theta: FloatArray
    """(p,) relative errors of the uncertain entries of A, then of B; logarithms of the strengths of the winds; where they are
    identified, the angles at the begin and the error of the delay, in units of their deviations."""
    deviation: FloatArray  # (p,) standard deviations after the flight
    before: Innovations  # of the nominal model in these winds
    after: Innovations  # of the identified one
    iterations: int


def uncertain(model: NominalModel) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks of the entries of A and B that are identified: all that are not 0, but for the rows of angles."""
    free = model.kinematic[:, None] == 0.0
    return (model.A != 0.0) & free, (model.B != 0.0) & free


class Entry(NamedTuple):
    """An entry of A or B: its nominal value in SI, its relative error, and the standard deviation of that after the flight."""

    matrix: str
    row: str
    column: str
    nominal: float
    error: float
    deviation: float

    @property
    def name(self) -> str:
        """Such as B[q, elevator]."""
        return f"{self.matrix}[{self.row}, {self.column}]"


class Search:
    """The data of one block, and the functions of theta over them."""

    def __init__(
        self,
        recorded: Recording,
        model: NominalModel,
        block: Block,
        airframe: Airframe,
        delay: float,
        unknown: Unknown = KNOWN,
    ) -> None:
        """The prior of each relative error is PRIOR; `believe` replaces it. The delay of u is `delay`, s, where it is known."""
        self._period = recorded.period
        self._delay, self._delay_deviation = delay / recorded.period, unknown.delay / recorded.period
        angles = np.flatnonzero(block.of(model).gravity.any(axis=0))
        self._angles, self._angle_deviation = angles if unknown.angle else angles[:0], unknown.angle
        self._model, self._block, self._airframe = block.of(model), block, airframe
        named = (tuple(airframe.states), tuple(airframe.inputs), airframe.outputs, tuple(airframe.gusts))
        self.names = Names(*(tuple(names[k] for k in part) for names, part in zip(named, block, strict=True)))
        self._y, self._u = recorded.y[:, block.outputs], recorded.u[:, block.inputs]
        length = span_length(recorded)
        self._spans = [slice(first, first + length) for first in range(0, len(recorded.t), length)]
        self.count = sum(int(mask.sum()) for mask in uncertain(self._model))  # of the entries that are identified
        self.believe(np.full(self.count, PRIOR))

    def believe(self, deviation: FloatArray) -> None:
        """Take these standard deviations of the relative errors before the flight, (p - G,)."""
        of_delay = np.ones(1 if self._delay_deviation else 0)
        of_winds = np.full(len(self._block.winds), WIND_PRIOR)
        self.prior = np.concatenate([deviation, of_winds, np.ones(len(self._angles)), of_delay])
        self.bound = MAX_ERROR / PRIOR * self.prior
        self._lower = -self.bound
        if len(of_delay):  # no u acts before it is sent
            self._lower[-1] = max(self._lower[-1], -self._delay / self._delay_deviation)
        self._errors = np.arange(len(self.prior)) < len(deviation)
        self._winds = slice(len(deviation), len(deviation) + len(of_winds))
        self._begin = slice(self._winds.stop, self._winds.stop + len(self._angles))

    def with_errors(self, thetas: FloatArray) -> NominalModel:
        """The models of relative errors (N, p): A (N, n, n), B (N, n, m), and wind (N, n, G) that acts by the model's own A."""
        matrices, masks = [], uncertain(self._model)
        of_A, of_B = (int(mask.sum()) for mask in masks)
        parts = np.split(thetas, [of_A, of_A + of_B], axis=1)[:2]
        for matrix, mask, part in zip((self._model.A, self._model.B), masks, parts, strict=True):
            changed = np.tile(matrix, (len(thetas), 1, 1))
            changed[:, mask] *= 1.0 + part
            matrices.append(changed)
        whole, x = np.tile(self._airframe.matrix_a(), (len(thetas), 1, 1)), self._block.states
        whole[:, x[:, None], x] = matrices[0]
        wind = gust_directions(self._airframe, whole, AIR_RELATIVE)[:, x[:, None], self._block.winds]
        return self._model._replace(A=matrices[0], B=matrices[1], wind=wind)

    def models(self, thetas: FloatArray) -> Models:
        """The filters of theta, (N, p)."""
        bank = filter_bank(self.with_errors(thetas), self.names, self._airframe.speed, np.exp(thetas[:, self._winds]))
        first = np.where(np.isfinite(self._y[0]), self._y[0], 0.0)
        begin = np.tile(first @ bank.sampled.H, (len(thetas), 1))
        begin[:, self._angles] = self._angle_deviation * thetas[:, self._begin]
        if not self._delay_deviation:
            return Models(bank, begin, delayed(self._u, self._delay))
        periods = self._delay + self._delay_deviation * thetas[:, -1]
        return Models(bank, begin, np.array([delayed(self._u, value) for value in np.maximum(periods, 0.0).tolist()]))

    def delay(self, fit: Fit) -> float:
        """The delay of u, periods."""
        return self._delay + self._delay_deviation * (float(fit.theta[-1]) if self._delay_deviation else 0.0)

    def levels(self, models: Models) -> NDArray[np.int64]:
        """The level of the wind in each span for the first of some models, shape (spans,).

        Every level predicts the span from the estimates at its begin. The calmest one is taken whose log-likelihood is within
        CHANGE of the best.
        """
        bank, u = models.bank, models.u if models.u.ndim == self._u.ndim else models.u[0]
        every, zeros = np.arange(len(LEVELS)), np.zeros(len(LEVELS), dtype=np.int64)
        precision, log_det = np.linalg.inv(bank.covariance[0]), np.linalg.slogdet(bank.covariance[0])[1]
        z, found = np.repeat(models.begin[:1], len(LEVELS), axis=0), []
        for span in self._spans:
            r, after = bank.advance(z, self._y[span], u[span], zeros, every)
            gain = -np.nansum(np.einsum("kli,lij,klj->kl", r, precision, r) + log_det, axis=0) / 2.0
            found.append(int(np.argmax(gain >= gain.max() - CHANGE)))
            z = np.repeat(after[found[-1]][None], len(LEVELS), axis=0)
        return np.array(found)

    def innovations(self, models: Models, levels: NDArray[np.int64]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Innovations of all models at given levels, and normalised, (N, T, m), and half the log of det S, (N, T)."""
        bank, z, u = models
        every = np.arange(len(bank.L))
        root = np.linalg.cholesky(bank.covariance)
        inverse, half_log_det = np.linalg.inv(root), np.sum(np.log(np.diagonal(root, axis1=-2, axis2=-1)), axis=-1)
        r = np.empty((len(every), *self._y.shape))
        normalised, weight = np.empty_like(r), np.empty(r.shape[:2])
        for span, level in zip(self._spans, levels, strict=True):
            ahead, z = bank.advance(z, self._y[span], u[..., span, :], every, np.full(len(every), level))
            r[:, span] = np.swapaxes(ahead, 0, 1)
            normalised[:, span] = r[:, span] @ np.swapaxes(inverse[:, level], -1, -2)
            weight[:, span] = half_log_det[:, level, None]
        return r, normalised, weight

    def best_levels(self, theta: FloatArray) -> Innovations:
        """The innovations of one theta, (p,)."""
        models = self.models(theta[None])
        (r,), (normalised,), (weight,) = self.innovations(models, self.levels(models))
        return Innovations(r, normalised, -np.sum(normalised**2, axis=1) / 2.0 - weight)

    def fit(self, used: NDArray[np.bool_], progress: Callable[[], None]) -> Fit:
        """The theta that minimises N/2 sum_i log mean r_i^2 + sum log det S / 2 + |theta / prior|^2 / 2 where `used`, (T,).

        r are the normalised innovations, S their covariance, N the number of those used. Gauss-Newton with damping, the
        derivatives by differences, the filters of all parameters side by side. The Hessian is J'J + prior^-2, with J the
        derivatives of the innovations over their rms. The first steps take a strong wind in every span, for which the cost has
        hardly a second minimum. Then the levels follow theta, and their strengths are part of it. At last the spans of gusts do
        not count: a gust is no noise. Source: L. Ljung, "System Identification", 7.4 and 10.2.
        """
        size, errors, free = len(self.prior), self._errors, np.ones(len(self.prior), dtype=bool)
        free[self._winds] = False
        theta, levels, follows, gusts = np.zeros(size), np.full(len(self._spans), STRONG), False, False
        for iteration in range(MAX_ITERATIONS + 1):
            progress()
            models, before = self.models(theta + DIFFERENCE * np.vstack([np.zeros(size), np.eye(size)])), levels
            levels = self.levels(models) if follows else levels
            settled = follows and np.array_equal(levels, before)
            quiet = used & self._quiet(levels) if gusts else used
            counted = quiet if quiet.any() else used  # a gust in every span
            costs, e, half_log_det = self._costs(models, levels, counted, theta[None])
            rms = np.sqrt(np.mean(e[0] ** 2, axis=0))
            J = ((e[1:] - e[0]) / DIFFERENCE / rms).reshape(size, -1)
            hessian = J @ J.T + np.diag(self.prior**-2)
            slope = J @ (e[0] / rms).ravel() + (half_log_det[1:] - half_log_det[0]) / DIFFERENCE + theta / self.prior**2
            steps = damped_steps(theta, slope, hessian, self._lower, self.bound, follows | free)
            tried = np.clip(theta + steps, self._lower, self.bound)
            lower, _, _ = self._costs(self.models(tried), levels, counted, tried)
            progressed = costs[0] - lower.min()
            if iteration == MAX_ITERATIONS or (settled and gusts and progressed < MIN_PROGRESS):
                break
            gusts |= settled and progressed < MIN_PROGRESS
            theta = tried[int(lower.argmin())] if progressed > 0.0 else theta
            follows |= progressed < MIN_PROGRESS_STRONG
        deviation = np.sqrt(np.diag(np.linalg.inv(hessian)))
        nominal = np.where(errors, 0.0, theta)
        return Fit(theta, deviation, self.best_levels(nominal), self.best_levels(theta), iteration)

    def nominal_entries(self) -> list[Entry]:
        """The entries of A and B that are identified, before the flight."""
        places = []
        for matrix, mask, columns in zip("AB", uncertain(self._model), (self.names.states, self.names.inputs), strict=True):
            values = self._model.A if matrix == "A" else self._model.B
            places += [(matrix, self.names.states[i], columns[j], float(values[i, j])) for i, j in np.argwhere(mask)]
        return [Entry(*place, 0.0, deviation) for place, deviation in zip(places, self.prior.tolist(), strict=False)]

    def entries(self, fit: Fit) -> list[Entry]:
        """The identified entries of A and B."""
        found = zip(
            self.nominal_entries(), fit.theta.tolist(), fit.deviation.tolist(), strict=False
        )  # winds follow the entries
        return [entry._replace(error=error, deviation=deviation) for entry, error, deviation in found]

    def known(self) -> NDArray[np.bool_]:
        """Mask of the samples that count, (T,): with a y, after the transient of the filter."""
        return np.isfinite(self._y).all(axis=1) & (np.arange(len(self._y)) >= TRANSIENT / self._period - 0.5)

    def _quiet(self, levels: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Mask of the samples, (T,), that are neither in a gust nor within RECOVERY spans after one."""
        gust = levels > np.median(levels)
        recent = np.convolve(gust, np.ones(RECOVERY + 1))[: len(gust)] > 0.0
        return ~np.repeat(recent, self._spans[0].stop)[: len(self._y)]

    def _costs(
        self, models: Models, levels: NDArray[np.int64], used: NDArray[np.bool_], thetas: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Costs of some models, the normalised innovations used, (N, samples, m), and their sum log det S / 2."""
        _, normalised, half_log_det = self.innovations(models, levels)
        e, total = normalised[:, used], np.sum(half_log_det[:, used], axis=1)
        costs = e.shape[1] / 2.0 * np.sum(np.log(np.mean(e**2, axis=1)), axis=1) + total
        costs = costs + np.sum((thetas / self.prior) ** 2, axis=1) / 2.0
        return np.where(np.isfinite(costs), costs, np.inf), e, total


def damped_steps(
    theta: FloatArray,
    slope: FloatArray,
    hessian: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    free: NDArray[np.bool_],
) -> FloatArray:
    """Steps -(hessian + d diag hessian)^-1 slope for every damping d, and fractions of the first, (k, p).

    Only the free parameters move, mask (p,), and none outwards at its bound. Source: D. W. Marquardt, J. SIAM 11(2), 1963.
    """
    steps = np.zeros((len(DAMPINGS), len(theta)))
    while True:
        part = hessian[np.ix_(free, free)]
        damped = part + np.array(DAMPINGS)[:, None, None] * np.diag(np.diag(part))
        steps[:] = 0.0
        steps[:, free] = -np.linalg.solve(damped, slope[free, None])[..., 0]
        outwards = free & (((theta >= upper) & (steps[0] > 0.0)) | ((theta <= lower) & (steps[0] < 0.0)))
        if not outwards.any():
            return np.vstack([steps, np.outer(FRACTIONS, steps[0])])
        free = free & ~outwards


# The result


class Prediction(NamedTuple):
    """How well a model predicts the held-out samples one period ahead."""

    rms: FloatArray  # (m,) of the innovations, units of y
    whiteness: FloatArray  # (m,) 1 for white noise, see `whiteness`
    log_likelihood: float  # mean of a sample, up to a constant


class Part(NamedTuple):
    """The model of a part of the aircraft that does not couple with the rest."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    entries: tuple[Entry, ...]
    before: Prediction  # of the nominal model
    after: Prediction
    refusal: str  # why this part must not be used, one sentence; empty if it may
    delay: float  # s, of its inputs


class Identification(NamedTuple):
    """The identified model of one flight."""

    airframe: Airframe
    recorded: Recording
    held_out: NDArray[np.bool_]  # (T,)
    innovations: tuple[FloatArray, FloatArray]  # (T, m) each, of the nominal model and of this one, units of y
    before: Prediction
    after: Prediction
    parts: tuple[Part, ...]

    @property
    def entries(self) -> tuple[Entry, ...]:
        """Those of all parts."""
        return tuple(entry for part in self.parts for entry in part.entries)

    @property
    def refusal(self) -> str:
        """Why this model must not be used, a sentence a part; empty if it may."""
        return "; ".join(part.refusal for part in self.parts if part.refusal)


def identify(
    recorded: Recording,
    airframe: Airframe,
    actuation: Actuation,
    channels: ChannelPairing | None = None,
    progress: Callable[..., None] = lambda **_: None,
    at_bound: int = 0,
    unknown: Unknown = KNOWN,
) -> Identification:
    """The model of a flight, with the reason why it must not be used if there is one.

    Arguments: `airframe` the nominal one; `channels` in the law's order, whose D the model has to keep, by default the
    airframe's order; `at_bound` how many entries of a part may lie at their bound; `unknown` what else is identified;
    `progress` is called with the steps `completed` of the search, and their largest number `total`.
    """
    model = filter_model(airframe, actuation, recorded)
    known = np.isfinite(recorded.y).all(axis=1) & (recorded.t >= recorded.t[0] + TRANSIENT)
    held_out = known & (np.arange(len(recorded.t)) // span_length(recorded) % HELD_OUT == HELD_OUT - 1)
    every, done = blocks(model), count(1)
    paired = channels or ChannelPairing(airframe.outputs, tuple(airframe.inputs))
    parts, before, after = [], [], []
    for block in every:
        search = Search(recorded, model, block, airframe, actuation.delay, unknown)
        fit = search.fit(known & ~held_out, lambda: progress(completed=next(done), total=len(every) * (MAX_ITERATIONS + 1)))
        outputs, entries = search.names.outputs, search.entries(fit)
        predictions = prediction(fit.before, held_out), prediction(fit.after, held_out)
        sentences = (
            another_airframe(entries, airframe.name, at_bound),
            too_little_excitation(entries, outputs),
            other_signs(airframe, with_entries(airframe, entries), paired),
            no_better(*predictions),
        )
        refusal, delay = next(filter(None, sentences), ""), recorded.period * search.delay(fit)
        parts.append(Part(search.names.inputs, outputs, tuple(entries), *predictions, refusal, delay))
        before.append(fit.before)
        after.append(fit.after)
    first, last = joined(before, every), joined(after, every)
    identified = with_entries(airframe, (entry for part in parts for entry in part.entries))
    figures = prediction(first, held_out), prediction(last, held_out)
    return Identification(identified, recorded, held_out, (first.r, last.r), *figures, tuple(parts))


def with_entries(airframe: Airframe, entries: Iterable[Entry]) -> Airframe:
    """The airframe with identified entries; wind acts by its own A."""
    A, B = airframe.matrix_a(), airframe.matrix_b()
    for entry in entries:
        row = airframe.index(entry.row)
        if entry.matrix == "A":
            A[row, airframe.index(entry.column)] *= 1.0 + entry.error
        else:
            B[row, list(airframe.inputs).index(entry.column)] *= 1.0 + entry.error
    return airframe.with_matrices(A, B, wind_factors(airframe, A[None], AIR_RELATIVE)[0])


def joined(parts: Sequence[Innovations], of: Sequence[Block]) -> Innovations:
    """Innovations of all outputs from those of the blocks."""
    order = np.argsort(np.concatenate([block.outputs for block in of]))
    r = np.concatenate([part.r for part in parts], axis=1)[:, order]
    normalised = np.concatenate([part.normalised for part in parts], axis=1)[:, order]
    return Innovations(r, normalised, np.sum([part.log_likelihood for part in parts], axis=0))


def prediction(innovations: Innovations, held_out: NDArray[np.bool_]) -> Prediction:
    """The prediction of the held-out samples, (T,)."""
    rms = np.sqrt(np.mean(innovations.r[held_out] ** 2, axis=0))
    likelihood = float(np.mean(innovations.log_likelihood[held_out]))
    return Prediction(rms, whiteness(innovations.normalised, held_out), likelihood)


def whiteness(e: FloatArray, held_out: NDArray[np.bool_]) -> FloatArray:
    """Mean of n_k rho_k^2 over the lags k = 1 .. LAGS, (m,), rho_k the autocorrelation of n_k pairs of held-out samples.

    It is 1 for white noise, with a standard deviation of sqrt(2 / LAGS). Arguments: e (T, m), held_out (T,). Source: G. M.
    Ljung, G. E. P. Box, Biometrika 65(2), 1978, here for the pairs within the held-out spans.
    """
    kept = np.where(held_out[:, None], e, 0.0)
    power, total = np.sum(kept**2, axis=0) / held_out.sum(), np.zeros(e.shape[1])
    for lag in range(1, LAGS + 1):
        pairs = max(int(np.sum(held_out[lag:] & held_out[:-lag])), 1)
        total += np.sum(kept[lag:] * kept[:-lag], axis=0) ** 2 / pairs / power**2
    return np.asarray(total / LAGS)


def model_yaml(found: Identification, origin: str) -> str:
    """The identified airframe as the text of an airframe file. The header has its origin, held-out figures and deviations."""
    lines = [f"The airframe {found.airframe.name}, with A and B identified from {origin}.", ""]
    lines.append("Held-out samples, one of three seconds: rms of the innovations in SI, whiteness (1 is white)")
    for name, prediction in (("nominal", found.before), ("identified", found.after)):
        figures = zip(found.airframe.outputs, prediction.rms, prediction.whiteness, strict=True)
        lines.append(f"  {name}: " + ", ".join(f"{output} {rms:.3g}, {white:.3g}" for output, rms, white in figures))
    lines += ["", f"Changes of entries and their standard deviations in %, {100 * PRIOR:g} before the flight:"]
    lines += [f"  {entry.name}: {100 * entry.error:+.1f}, {100 * entry.deviation:.1f}" for entry in found.entries]
    return "".join(f"# {line}".rstrip() + "\n" for line in lines) + as_yaml(found.airframe)


# Reasons against a model, each a sentence, or empty where there is none


def too_little_excitation(entries: Iterable[Entry], outputs: Iterable[str]) -> str:
    """The output whose inputs are known worst, if the best known effect on it has a deviation above MAX_DEVIATION."""
    effects = [entry for entry in entries if entry.matrix == "B"]
    best = [min((entry for entry in effects if entry.row == output), key=lambda one: one.deviation) for output in outputs]
    worst = max(best, key=lambda one: one.deviation)
    if worst.deviation <= MAX_DEVIATION:
        return ""
    # information adds up with the square of the amplitude
    information = worst.deviation**-2 - PRIOR**-2
    factor = np.sqrt((MAX_DEVIATION**-2 - PRIOR**-2) / max(information, 1e-2 * PRIOR**-2))
    return (
        f"excitation of {worst.row}: found {worst.name} known to {100 * worst.deviation:.2g} %, expected"
        f" {100 * MAX_DEVIATION:.2g} %: {worst.row} needs {factor:.2g} times the amplitude, or {factor**2:.2g} times the time"
    )


def another_airframe(entries: Iterable[Entry], name: str, allowed: int = 0) -> str:
    """The entries at the bound of the search, if more than `allowed`."""
    at_bound = [entry.name for entry in entries if abs(entry.error) >= MAX_ERROR]
    if len(at_bound) > allowed:
        return (
            f"airframe {name}: found {', '.join(at_bound)} at the bound of +-{100 * MAX_ERROR:g} %, expected a log of this"
            " airframe, in calm air if its effect of wind is not known"
        )
    return ""


def other_signs(nominal: Airframe, identified: Airframe, channels: ChannelPairing) -> str:
    """D of the law where the identified model has another: D follows from the signs of the leading minors of C B."""
    columns = [list(nominal.inputs).index(name) for name in channels.inputs]
    order = np.ix_([nominal.outputs.index(name) for name in channels.outputs], columns)
    before, after = (
        [np.sign(np.linalg.det(Omega[:k, :k])) for k in range(1, len(Omega) + 1)]
        for Omega in ((frame.matrix_c() @ frame.matrix_b())[order] for frame in (nominal, identified))
    )
    return "" if before == after else "C B: found other signs of its minors than in the nominal airframe, expected the same D"


def no_better(before: Prediction, after: Prediction) -> str:
    """Whether the model does not predict the held-out samples better, or neither with white nor with whiter innovations."""
    if after.log_likelihood <= before.log_likelihood:
        return (
            f"held-out samples: found a log-likelihood of {after.log_likelihood:.4g} a sample, expected more than the"
            f" {before.log_likelihood:.4g} of the nominal airframe, which explains this flight as it is"
        )
    if np.sum(after.whiteness) >= np.sum(before.whiteness) and np.max(after.whiteness) > MAX_WHITENESS:
        return (
            f"held-out samples: found innovations with a whiteness of {np.mean(after.whiteness):.3g}, expected less than the"
            f" {np.mean(before.whiteness):.3g} of the nominal airframe"
        )
    return ""
