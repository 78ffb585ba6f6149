# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Identification of A and B from the log of one flight: maximum a posteriori over the innovations of the observer's filter.

It takes y and u alone, u after its limits. Two of three seconds fit the model, and every third one, held out, validates it. The
scale of alpha or beta cannot be told from y; such entries stay near their nominal values. No number in this module is specific
to an aircraft.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import chain, count
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aircraft_sim.airframe import Airframe
from aircraft_sim.uncertainty import AIR_RELATIVE, as_yaml, gust_directions, wind_factors
from control_laws.nominal_model import NominalModel
from control_laws.observer_design import Names
from flight_analysis.closed_loop.learning_loop import Entry
from flight_core.files import comment
from flight_core.parameters import require
from flight_core.vectors import FloatArray
from flight_design.gains.gain_selection import ChannelPairing
from flight_design.identification.innovation_filters import (
    DRIFT,
    HOLD,
    LEVELS,
    TRANSIENT,
    Actuation,
    Block,
    FilterBank,
    Passage,
    Recording,
    blocks,
    coarser,
    delayed,
    filter_bank,
    filter_model,
    whole_aircraft,
)

PRIOR = 0.29  # 1, standard deviation of a relative error before the flight: that of +-50 %, uniform
WIND_PRIOR = 1.0  # 1, the same of the logarithm of the strength of the wind along an axis
MAX_ERROR = 0.6  # 1, lower bound of a relative error: two standard deviations
MAX_DELAY_ERROR = 4.0  # standard deviations, bound of the error of the delay: 60 ms for one of 15 ms
MAX_FACTOR = 2.5  # 1, of a value over the nominal one: 1 / (1 - MAX_ERROR), for a rough model errs by a factor either way

FOLLOWS = 10.0  # 1, of innovations that follow the u of another part, see `correlation`: uncoupled aircraft have up to 3
COUPLED_GAIN = 20.0  # of log-likelihood of held-out samples by coupling: uncoupled aircraft have -20
COUPLING = 0.34  # of the largest effect on a row, unit of an entry that is 0: a deviation of 10 % before the flight

DIFFERENCE = 1e-4  # 1, of a parameter, for the derivatives
# of the steps that are tried side by side
DAMPINGS = (0.0, 0.01, 0.1, 1.0, 10.0)
FRACTIONS = (0.5, 0.25)
GOOD = 0.7  # of the decrease by the quadratic model: the undamped step is taken, and no damped one is tried
STARTS = (0, 3, 4, 9)  # levels with which the search begins: calm air, light and moderate turbulence, gusts
# at most, of each start, and of the search from one of the best
START_STEPS = 8
STEPS = 12
# starts from which the search goes on, at most, and of cost above that of the best one
REFINED = 2
CLOSE = 100.0
# of the cost, a log-likelihood, in a step: a start ends, or the search
START_PROGRESS = 5.0
PROGRESS = 0.3

CHANGE = 3.0  # of log-likelihood that a span has to gain by a stronger wind: odds of 20 to 1
UNEXPLAINED = 5.0  # 1, mean square of the innovations of a span in parts of the median one: no level explains it
FEW = 0.25  # of the spans: so few gusts do not count, for a gust is no noise
RECOVERY = 2  # spans after such a one that do not count either: the estimates recover
SPAN = 1.0  # s, within which the level is constant
HELD_OUT = 3  # Every third span is held out: each command and gust is then in both parts. A last third has no command.
MAX_DEVIATION = 0.1  # of the best known effect of an input on each output: two deviations are then a fifth of the loop gain
MAX_WHITENESS = 3.0  # 1 for white innovations, with a deviation of 0.3: a model with more leaves out what the aircraft does
LAGS = 20  # of the autocorrelation in the figure of whiteness: 0.2 s at 100 Hz


def span_length(recorded: Recording) -> int:
    """Periods of a span: whole blocks of the filters."""
    return HOLD * max(round(SPAN / recorded.period / HOLD), 1)


def held_out(periods: int, span: int) -> NDArray[np.bool_]:
    """Mask of the validation's periods, every HELD_OUT-th span."""
    return np.asarray(np.arange(periods) // span % HELD_OUT == HELD_OUT - 1)


class Innovations(NamedTuple):
    """Innovations of one model over a recording, each span at the level of the wind that predicts it best."""

    r: FloatArray  # (T, m) in units of y, NaN where y is lost
    normalised: FloatArray  # (T, m) of covariance I where the model is right
    log_likelihood: FloatArray  # (T,) of a sample, up to a constant


class Normalised(NamedTuple):
    """Innovations of N models."""

    r: FloatArray  # (N, T, m) in units of y, NaN where y is lost
    e: FloatArray  # (N, T, m) of covariance I where a model is right
    half_log_det: FloatArray  # (N, T) of the covariance of r


def normalised(r: FloatArray, covariance: FloatArray, place: NDArray[np.int64]) -> Normalised:
    """Innovations r, (N, T, m), with covariances (N, levels, m, m); `place` is the level of a sample among these, (T,)."""
    root = np.linalg.cholesky(covariance)
    inverse = np.linalg.inv(root)
    half_log_det = np.sum(np.log(np.diagonal(root, axis1=-2, axis2=-1)), axis=-1)
    e = np.empty_like(r)
    for k in np.unique(place).tolist():
        e[:, place == k] = r[:, place == k] @ np.swapaxes(inverse[:, k], -1, -2)
    return Normalised(r, e, half_log_det[:, place])


class Models(NamedTuple):
    """The filters of N models, and their inputs."""

    bank: FilterBank
    levels: NDArray[np.int64]  # (levels of the bank,), those of LEVELS
    begin: FloatArray  # (N, s) estimates at the begin
    u: FloatArray  # (T, m), or (N, T, m) where the delay is identified


class Unknown(NamedTuple):
    """Standard deviations of what else is identified, 0: known; of B; and the noise of the disturbances."""

    delay: float = 0.0  # s, of u
    angle: float = 0.0  # rad, of pitch and bank at the begin of the recording
    effect: float = PRIOR  # 1, of an entry of B before the flight
    drift: float = DRIFT  # sizes/s per root s, of the disturbances


KNOWN = Unknown()


class Fit(NamedTuple):
    """The most probable theta of a block."""

    theta: FloatArray
    """(p,) relative errors of the uncertain entries of A, then of B; logarithms of the strengths of the winds; where they are
    identified, the angles at the begin and the error of the delay, in units of their deviations."""
    deviation: FloatArray  # (p,) standard deviations after the flight
    before: Innovations  # of the nominal model in these winds
    after: Innovations  # of the identified one
    levels: NDArray[np.int64]  # (spans,) of the wind, with the identified model


def units(model: NominalModel, *, coupled: bool = False) -> tuple[FloatArray, FloatArray]:
    """Units of the errors of A and B, SI, 0 for an entry that is known: nominal values, and 0 in the rows of angles.

    If `coupled`, an entry that is 0 has the unit COUPLING of the largest effect on its row, in units of motion; the columns of
    angles stay 0.
    """
    free = model.kinematic[:, None] == 0.0
    turned = model.kinematic == 0.0
    units_A = np.where(free, model.A, 0.0)
    units_B = np.where(free, model.B, 0.0)
    if coupled:
        largest_A = np.max(np.abs(units_A) * model.size, axis=1, keepdims=True) / model.size * turned
        largest_B = np.max(np.abs(units_B), axis=1, keepdims=True)
        units_A, units_B = (
            np.where((part == 0.0) & free, COUPLING * largest, part)
            for part, largest in ((units_A, largest_A), (units_B, largest_B))
        )
    return units_A, units_B


def largest_error(entry: Entry) -> float:
    """The upper bound of the relative error of an entry."""
    return MAX_FACTOR - 1.0 if entry.nominal else MAX_ERROR


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
        factor: int | None = None,
        *,
        coupled: bool = False,
    ) -> None:
        """The prior of each error of A is PRIOR; `believe` replaces it. The delay of u is `delay`, s, where it is known.

        The starts of the search take means of `factor` periods, by default of the shortest lag. If `coupled`, the entries that
        are 0 are identified too.
        """
        factor = max(int(float(np.min(model.lag)) / recorded.period + 1e-9), 1) if factor is None else factor
        self.coarse = self
        if factor > 1:
            slow = model._replace(noise=model.noise / np.sqrt(factor), period=factor * recorded.period)
            self.coarse = Search(coarser(recorded, factor), slow, block, airframe, delay, unknown, factor=1, coupled=coupled)
        self._period = recorded.period
        self._delay = delay / recorded.period
        self._delay_deviation = unknown.delay / recorded.period
        self._drift = unknown.drift
        angles = np.flatnonzero(block.restricted(model).gravity.any(axis=0))
        self._angles = angles if unknown.angle else angles[:0]
        self._angle_deviation = unknown.angle
        self._model = block.restricted(model)
        self._block = block
        self._airframe = airframe
        named = (tuple(airframe.states), tuple(airframe.inputs), airframe.outputs, tuple(airframe.gusts))
        parts = [tuple(map(names.__getitem__, places)) for names, places in zip(named, block, strict=True)]
        self.names = Names(*parts)
        self._y = recorded.y[:, block.outputs]
        self._u = recorded.u[:, block.inputs]
        length = span_length(recorded)
        self._spans = [slice(first, first + length) for first in range(0, len(recorded.t), length)]
        self._units = units(self._model, coupled=coupled)
        count_A, count_B = map(np.count_nonzero, self._units)
        self._passed: tuple[bytes, NDArray[np.int64], Normalised] | None = None  # theta, levels and innovations of `levels`
        self.count = int(count_A + count_B)  # of the entries that are identified
        self.believe(np.repeat([PRIOR, unknown.effect], [count_A, count_B]))

    def believe(self, deviation: FloatArray) -> None:
        """Take these standard deviations of the relative errors before the flight, (p - G,)."""
        delay_prior = np.ones(1 if self._delay_deviation else 0)
        wind_prior = np.full(len(self._block.winds), WIND_PRIOR)
        if self.coarse is not self:
            self.coarse.believe(deviation)
        self.prior = np.concatenate([deviation, wind_prior, np.ones(len(self._angles)), delay_prior])
        self._errors = np.arange(len(self.prior)) < len(deviation)
        self._upper = MAX_ERROR / PRIOR * self.prior
        self._lower = -self._upper
        self._upper[self._errors] = deviation / PRIOR * [largest_error(entry) for entry in self.nominal_entries()]
        if len(delay_prior):  # no u acts before it is sent
            self._lower[-1] = max(-MAX_DELAY_ERROR, -self._delay / self._delay_deviation)
            self._upper[-1] = MAX_DELAY_ERROR
        self._winds = slice(len(deviation), len(deviation) + len(wind_prior))
        self._begin = slice(self._winds.stop, self._winds.stop + len(self._angles))

    def with_errors(self, thetas: FloatArray) -> NominalModel:
        """The models of relative errors (N, p): A (N, n, n), B (N, n, m), and wind (N, n, G) that acts by the model's own A."""
        matrices = []
        parts = np.split(thetas, [np.count_nonzero(self._units[0]), self.count], axis=1)[:2]
        for matrix, unit, part in zip((self._model.A, self._model.B), self._units, parts, strict=True):
            changed = np.tile(matrix, (len(thetas), 1, 1))
            changed[:, unit != 0.0] += unit[unit != 0.0] * part
            matrices.append(changed)
        A = np.tile(self._airframe.matrix_a(), (len(thetas), 1, 1))
        x = self._block.states
        A[:, x[:, None], x] = matrices[0]
        wind = gust_directions(self._airframe, A, AIR_RELATIVE)[:, x[:, None], self._block.winds]
        return self._model._replace(A=matrices[0], B=matrices[1], wind=wind)

    def models(self, thetas: FloatArray, levels: NDArray[np.int64], *, near: bool = False) -> Models:
        """The filters of theta, (N, p), at the winds of some levels; all may be `near` the first theta."""
        levels = np.unique(levels)
        strength = np.exp(thetas[:, self._winds])
        airframe = self._airframe
        drift = self._drift
        bank = filter_bank(self.with_errors(thetas), self.names, airframe.speed, strength, levels, drift, near=near)
        first = np.where(np.isfinite(self._y[0]), self._y[0], 0.0)
        begin = np.tile(first @ bank.sampled.H, (len(thetas), 1))
        begin[:, self._angles] = self._angle_deviation * thetas[:, self._begin]
        if not self._delay_deviation:
            return Models(bank, levels, begin, delayed(self._u, self._delay))
        periods = np.maximum(self._delay + self._delay_deviation * thetas[:, -1], 0.0)
        late = {value: delayed(self._u, value) for value in set(periods.tolist())}
        return Models(bank, levels, begin, np.array([late[value] for value in periods.tolist()]))

    def delay(self, fit: Fit) -> float:
        """The delay of u, periods."""
        return self._delay + self._delay_deviation * (float(fit.theta[-1]) if self._delay_deviation else 0.0)

    def levels(self, theta: FloatArray) -> NDArray[np.int64]:
        """The level of the wind in each span, (spans,), for theta, (p,).

        Every level predicts the span from the estimates at its begin. The calmest one is taken whose log-likelihood is within
        CHANGE of the best.
        """
        models = self.models(theta[None], np.arange(len(LEVELS)))
        bank = models.bank.by_level()
        u = models.u.reshape(self._u.shape)
        precision = np.linalg.inv(bank.covariance[:, 0])
        log_det = np.linalg.slogdet(bank.covariance[:, 0])[1]
        length = self._spans[0].stop // HOLD
        flight = Passage(bank, self._y, u, np.zeros(-(-len(self._y) // HOLD), dtype=np.int64))
        z = np.repeat(models.begin, len(LEVELS), axis=0)
        calmest = list[int]()
        r_found = list[FloatArray]()
        for k in range(len(self._spans)):
            r, after = flight.run(z, k * length, (k + 1) * length)
            gain = -np.nansum(np.einsum("lki,lij,lkj->lk", r, precision, r) + log_det[:, None], axis=1) / 2.0
            calmest.append(int(np.argmax(gain >= gain.max() - CHANGE)))
            r_found.append(r[calmest[-1]])
            z = np.repeat(after[calmest[-1]][None], len(LEVELS), axis=0)
        passed = normalised(np.concatenate(r_found)[None, : len(self._y)], models.bank.covariance, self._of_span(calmest))
        self._passed = theta.tobytes(), np.array(calmest), passed
        return np.array(calmest)

    def _of_span(self, values: Sequence[int] | NDArray[np.int64]) -> NDArray[np.int64]:
        """Values of the spans for the samples, (T,)."""
        return np.repeat(np.asarray(values), self._spans[0].stop)[: len(self._y)]

    def innovations(self, models: Models, levels: NDArray[np.int64]) -> Normalised:
        """Innovations of N models at given levels."""
        place = self._of_span(np.searchsorted(models.levels, levels))
        r = Passage(models.bank, self._y, models.u, place[::HOLD]).run(models.begin)[0][:, : len(self._y)]
        return normalised(r, models.bank.covariance, place)

    def passed(self, theta: FloatArray, levels: NDArray[np.int64]) -> Normalised:
        """Innovations of a theta, (p,), at given levels, without a new passage after `levels` of this theta."""
        if self._passed is not None and self._passed[0] == theta.tobytes() and np.array_equal(self._passed[1], levels):
            return self._passed[2]
        return self.innovations(self.models(theta[None], levels), levels)

    def predicted(self, theta: FloatArray, levels: NDArray[np.int64]) -> Innovations:
        """The innovations of a theta, (p,)."""
        (r,), (e,), (half_log_det,) = self.passed(theta, levels)
        return Innovations(r, e, -np.sum(e**2, axis=1) / 2.0 - half_log_det)

    def fit(
        self,
        used: NDArray[np.bool_],
        progress: Callable[[], None] = lambda: None,
        starts: Sequence[int] = STARTS,
        levels: NDArray[np.int64] | None = None,
        begin: FloatArray | None = None,
        flown: FloatArray | None = None,
    ) -> Fit:
        """The theta that minimises N/2 sum_i log mean r_i^2 + sum log det S / 2 + |theta / prior|^2 / 2 where `used`, (T,).

        r are the normalised innovations, S their covariance, N the number of samples. The cost has further minima: a wrong
        wind explains a wrong model. So the search begins several times, with a level of `starts` in a span, on means over
        the shortest lag. From the REFINED best starts, or 0, the search goes on with the level of a span by theta, or with
        `levels`, and the strengths of the winds are free. At last spans without a level to explain them do not count, nor
        a few gusts. A theta to `begin` at, (p,), is the only start. The theta of the model that has `flown` is a
        further start.
        """
        if begin is None:
            ends = self._ends(starts, flown, used, levels, progress)
        else:
            free = np.ones(len(begin), dtype=bool)
            theta = self._started(np.clip(begin, self._lower, self._upper), None, free, progress)
            ends = [self._refined(theta, levels, used, progress)]
        _, theta, hessian = min(ends, key=lambda end: end[0])
        deviation = np.sqrt(np.diag(np.linalg.inv(hessian)))
        nominal = np.where(self._errors, 0.0, theta)
        before = self.predicted(nominal, self.levels(nominal) if levels is None else levels)
        winds = self.levels(theta) if levels is None else levels
        return Fit(theta, deviation, before, self.predicted(theta, winds), winds)

    def _ends(
        self,
        starts: Sequence[int],
        flown: FloatArray | None,
        used: NDArray[np.bool_],
        levels: NDArray[np.int64] | None,
        progress: Callable[[], None],
    ) -> list[tuple[float, FloatArray, FloatArray]]:
        """Costs, thetas and Hessians at the ends of the search from the best starts."""
        coarse = self.coarse
        fitted = coarse.fitted()
        fixed = np.ones(len(self.prior), dtype=bool)
        fixed[self._winds] = False
        candidates = [(coarse.cost(np.zeros(len(self.prior)), fitted), np.zeros(len(self.prior)))]
        for level in starts:
            theta = self._started(np.zeros(len(self.prior)), np.full(len(coarse._spans), level), fixed, progress)
            candidates.append((coarse.cost(theta, fitted), theta))
        if flown is not None and flown.any():
            theta = self._started(flown, None, np.ones(len(flown), dtype=bool), progress)
            candidates.append((coarse.cost(theta, fitted), theta))
        best = sorted(candidates, key=lambda start: start[0])[:REFINED]
        return [self._refined(theta, levels, used, progress) for cost, theta in best if cost < best[0][0] + CLOSE]

    def _started(
        self, theta: FloatArray, levels: NDArray[np.int64] | None, free: NDArray[np.bool_], progress: Callable[[], None]
    ) -> FloatArray:
        """Theta, (p,), after steps on means over the shortest lag, with the level of a span by theta or with `levels`."""
        coarse = self.coarse
        fitted = coarse.fitted()
        for _ in range(START_STEPS):
            progress()
            theta, _, progressed = coarse._step(theta, coarse.levels(theta) if levels is None else levels, fitted, free)
            if progressed < START_PROGRESS:
                break
        return theta

    def _refined(
        self,
        theta: FloatArray,
        levels: NDArray[np.int64] | None,
        used: NDArray[np.bool_],
        progress: Callable[[], None],
    ) -> tuple[float, FloatArray, FloatArray]:
        """Cost, theta and Hessian at the end of the search from a start."""
        for iteration in range(STEPS):
            progress()
            flown = self.levels(theta) if levels is None else levels
            counted = used & self._counted(theta, flown) if iteration > 1 else used
            theta, hessian, progressed = self._step(theta, flown, counted, np.ones(len(theta), dtype=bool))
            if iteration > 1 and progressed < PROGRESS:
                break
        return self.cost(theta, used), theta, hessian

    def cost(self, theta: FloatArray, used: NDArray[np.bool_]) -> float:
        """The cost of `fit` for the best levels of a theta, (p,)."""
        levels = self.levels(theta)
        (cost,), _, _ = self._costs(self.passed(theta, levels), used, theta[None])
        return float(cost)

    def _step(
        self, theta: FloatArray, levels: NDArray[np.int64], used: NDArray[np.bool_], free: NDArray[np.bool_]
    ) -> tuple[FloatArray, FloatArray, float]:
        """Theta after a step of Gauss-Newton with damping, the Hessian before, and by how much the cost is less.

        The derivatives are differences, the filters side by side. The Hessian is J'J + prior^-2, with J the
        derivatives of the innovations over their rms. Source: L. Ljung, "System Identification", 7.4 and 10.2.
        """
        size = len(theta)
        moving = np.flatnonzero(free)
        models = self.models(theta + DIFFERENCE * np.vstack([np.zeros(size), np.eye(size)[moving]]), levels, near=True)
        costs, e, half_log_det = self._costs(self.innovations(models, levels), used, theta[None])
        rms = np.sqrt(np.mean(e[0] ** 2, axis=0))
        J = np.zeros((size, e[0].size))
        J[moving] = ((e[1:] - e[0]) / DIFFERENCE / rms).reshape(len(moving), -1)
        hessian = J @ J.T + np.diag(self.prior**-2)
        slope = J @ (e[0] / rms).ravel() + theta / self.prior**2
        slope[moving] += (half_log_det[1:] - half_log_det[0]) / DIFFERENCE
        tried = np.clip(theta + damped_steps(theta, slope, hessian, self._lower, self._upper, free), self._lower, self._upper)
        expected = -float(slope @ (tried[0] - theta)) / 2.0
        for several in (tried[:1], tried[1:]):
            lower, _, _ = self._costs(self.innovations(self.models(several, levels), levels), used, several)
            progressed = float(costs[0] - lower.min())
            if progressed >= GOOD * expected:
                break
        return (several[int(lower.argmin())] if progressed > 0.0 else theta), hessian, progressed

    def nominal_entries(self) -> list[Entry]:
        """The entries of A and B that are identified, before the flight."""
        places = []
        for matrix, unit, columns in zip("AB", self._units, (self.names.states, self.names.inputs), strict=True):
            values = self._model.A if matrix == "A" else self._model.B
            places += [
                Entry(matrix, self.names.states[i], columns[j], float(values[i, j]), 0.0, 0.0, float(unit[i, j]))
                for i, j in np.argwhere(unit)
            ]
        return [place._replace(deviation=deviation) for place, deviation in zip(places, self.prior.tolist(), strict=False)]

    def named(self) -> list[str]:
        """Names of the parameters theta, (p,): those of the entries, the winds, the angles, the delay."""
        angles = [self.names.states[k] for k in self._angles]
        names = [entry.name for entry in self.nominal_entries()]
        return names + [*self.names.winds, *angles, "delay"][: len(self.prior) - len(names)]

    def joined(self, parts: Iterable[tuple["Search", Fit]]) -> FloatArray:
        """Theta, (p,), without errors, with winds, angles and delay of parts: means over the parts.

        A part that is searched apart from the parts with which it couples has wrong errors.
        """
        known: dict[str, list[float]] = {}
        for part, fit in parts:
            for name, value in list(zip(part.named(), fit.theta.tolist(), strict=True))[part.count :]:
                known.setdefault(name, []).append(value)
        return np.array([np.mean(known.get(name, [0.0])) for name in self.named()])

    def model_errors(self, airframe: Airframe) -> FloatArray:
        """Theta, (p,), of a model in the winds and with the delay of theta = 0, within the bounds."""
        A = airframe.matrix_a()
        B = airframe.matrix_b()
        inputs = list(airframe.inputs)
        theta = np.zeros(len(self.prior))
        for k, entry in enumerate(self.nominal_entries()):
            row = airframe.index(entry.row)
            value = A[row, airframe.index(entry.column)] if entry.matrix == "A" else B[row, inputs.index(entry.column)]
            theta[k] = (value - entry.nominal) / entry.unit
        return np.clip(theta, self._lower, self._upper)

    def entries(self, fit: Fit) -> list[Entry]:
        """The identified entries of A and B."""
        errors = zip(
            self.nominal_entries(), fit.theta.tolist(), fit.deviation.tolist(), strict=False
        )  # winds follow the entries
        return [entry._replace(error=error, deviation=deviation) for entry, error, deviation in errors]

    def known(self) -> NDArray[np.bool_]:
        """Mask of the samples that count, (T,): with a y, after the transient of the filter."""
        return np.isfinite(self._y).all(axis=1) & (np.arange(len(self._y)) >= TRANSIENT / self._period - 0.5)

    def fitted(self) -> NDArray[np.bool_]:
        """Mask of the samples that fit the model, (T,)."""
        return self.known() & ~held_out(len(self._y), self._spans[0].stop)

    def _counted(self, theta: FloatArray, levels: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Mask of the samples to count, (T,): not of spans without a level to explain them, nor of gusts if these are FEW.

        RECOVERY spans afterwards do not count either.
        """
        _, (e,), _ = self.passed(theta, levels)
        square = np.array([np.nansum(e[span] ** 2) / max(np.isfinite(e[span]).sum(), 1) for span in self._spans])
        largest = UNEXPLAINED * np.median(square[square > 0.0]) if square.any() else np.inf  # 0 at rest, without noise
        unexplained, gusts = (
            np.convolve(spans, np.ones(RECOVERY + 1))[: len(levels)] > 0.0
            for spans in (square > largest, LEVELS[levels, 1] > 0.0)
        )
        left_out = unexplained | gusts if np.mean(gusts) < FEW else unexplained
        return ~np.repeat(left_out, self._spans[0].stop)[: len(self._y)]

    def _costs(
        self, innovations: Normalised, used: NDArray[np.bool_], thetas: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Costs of some models, the normalised innovations used, (N, samples, m), and their sum log det S / 2."""
        e = innovations.e[:, used]
        total = np.sum(innovations.half_log_det[:, used], axis=1)
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
    """How well a model predicts the held-out samples a period ahead."""

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
    gusts: bool  # whether FEW of its seconds, or more, are of gusts
    delay_deviation: float = 0.0  # s, standard deviation of `delay`; 0 for a known delay


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
        return tuple(chain.from_iterable(part.entries for part in self.parts))

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
    flown: Airframe | None = None,
) -> Identification:
    """The model of a flight, with the reason why it must not be used if there is one.

    Arguments: `airframe` the nominal one; `channels` in the law's order, whose D the model has to keep, by default the
    airframe's order; `at_bound` how many entries of a part may lie at their bound; `unknown` what else is identified; `flown`
    the model in flight, a further start of the search; `progress` is called with the steps `completed` of
    the search, and their largest number `total`. Raises ParameterError for an output that does not move.
    """
    model = filter_model(airframe, actuation, recorded)
    known = np.isfinite(recorded.y).all(axis=1) & (recorded.t >= recorded.t[0] + TRANSIENT)
    still = [name for name, y in zip(airframe.outputs, recorded.y[known].T, strict=True) if not np.diff(y).any()]
    require(not still, "record", f"a constant {', '.join(still)}", "outputs that move, or the noise of their sensors")
    validating = known & held_out(len(recorded.t), span_length(recorded))
    every = blocks(model)
    step_count = count(1)
    starts = len(STARTS) + (flown is not None)
    total = len(every) * (starts * START_STEPS + REFINED * STEPS) + (len(every) > 1) * (START_STEPS + STEPS)
    paired = channels or ChannelPairing(airframe.outputs, tuple(airframe.inputs))

    def search_of(block: Block, *, coupled: bool = False) -> Search:
        return Search(recorded, model, block, airframe, actuation.delay, unknown, coupled=coupled)

    def step() -> None:
        progress(completed=next(step_count), total=total)

    def part_of(search: Search, fit: Fit) -> Part:
        outputs = search.names.outputs
        entries = search.entries(fit)
        predictions = prediction(fit.before, validating), prediction(fit.after, validating)
        sentences = (
            another_airframe(entries, airframe.name, at_bound),
            too_little_excitation(entries, outputs),
            other_signs(airframe, with_entries(airframe, entries), paired),
            no_better(*predictions),
        )
        refusal = next(filter(None, sentences), "")
        delay = recorded.period * search.delay(fit)
        gusts = bool(np.mean(LEVELS[fit.levels, 1] > 0.0) >= FEW)
        delay_deviation = unknown.delay * float(fit.deviation[-1])
        return Part(search.names.inputs, outputs, tuple(entries), *predictions, refusal, delay, gusts, delay_deviation)

    fits = []
    for search in map(search_of, every):
        also = None if flown is None else search.model_errors(flown)
        fits.append((search, search.fit(known & ~validating, step, flown=also)))
    parts = [part_of(*each) for each in fits]
    first = joined([fit.before for _, fit in fits], every)
    last = joined([fit.after for _, fit in fits], every)
    others = [np.delete(recorded.u, block.inputs, axis=1) for block in every]
    follows = [correlation(fit.after.normalised, u, known) for (_, fit), u in zip(fits, others, strict=True)]
    if len(every) > 1 and max(map(np.max, follows)) > FOLLOWS:
        search = search_of(whole_aircraft(model), coupled=True)
        fit = search.fit(known & ~validating, step, begin=search.joined(fits))
        part = part_of(search, fit)
        gain = part.after.log_likelihood - prediction(last, validating).log_likelihood
        white = part.after.whiteness.max() <= MAX_WHITENESS
        if white and not part.refusal and gain * validating.sum() > COUPLED_GAIN:
            parts = [part]
            first = fit.before
            last = fit.after
    identified = with_entries(airframe, chain.from_iterable(part.entries for part in parts))
    figures = prediction(first, validating), prediction(last, validating)
    return Identification(identified, recorded, validating, (first.r, last.r), *figures, tuple(parts))


def with_entries(airframe: Airframe, entries: Iterable[Entry]) -> Airframe:
    """The airframe with identified entries; wind acts by its own A."""
    A = airframe.matrix_a()
    B = airframe.matrix_b()
    for entry in entries:
        row = airframe.index(entry.row)
        if entry.matrix == "A":
            A[row, airframe.index(entry.column)] = entry.value
        else:
            B[row, list(airframe.inputs).index(entry.column)] = entry.value
    return airframe.with_matrices(A, B, wind_factors(airframe, A[None], AIR_RELATIVE)[0])


def joined(parts: Sequence[Innovations], blocks: Sequence[Block]) -> Innovations:
    """Innovations of all outputs from those of the blocks."""
    order = np.argsort(np.concatenate([block.outputs for block in blocks]))
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
    return np.diag(correlation(e, e, held_out))


def correlation(e: FloatArray, before: FloatArray, used: NDArray[np.bool_]) -> FloatArray:
    """Mean of n_k rho_k^2 over the lags k = 1 .. LAGS, (m, k), rho_k the correlation of e with what was k samples `before`.

    It is 1 for independent white noises. Arguments: e (T, m), before (T, k), `used` (T,), mask of n samples.
    """
    now, then = (np.where(used[:, None], values, 0.0) for values in (e, before))
    power = np.outer(*(np.sum(values**2, axis=0) / used.sum() for values in (now, then)))
    total = np.zeros_like(power)
    for lag in range(1, LAGS + 1):
        pairs = max(int(np.sum(used[lag:] & used[:-lag])), 1)
        total += (now[lag:].T @ then[:-lag]) ** 2 / pairs / power
    return np.asarray(total / LAGS)


def model_yaml(identified: Identification, origin: str) -> str:
    """The identified airframe as the text of an airframe file. The header has its origin, held-out figures and deviations."""
    lines = [f"The airframe {identified.airframe.name}, with A and B identified from {origin}.", ""]
    lines.append("Held-out samples, one of three seconds: rms of the innovations in SI, whiteness (1 is white)")
    for name, prediction in (("nominal", identified.before), ("identified", identified.after)):
        figures = zip(identified.airframe.outputs, prediction.rms, prediction.whiteness, strict=True)
        lines.append(f"  {name}: " + ", ".join(f"{output} {rms:.3g}, {white:.3g}" for output, rms, white in figures))
    lines += ["", f"Changes of entries and their standard deviations in %, {100 * PRIOR:g} before the flight:"]
    lines += [
        f"  {entry.name}: {100 * entry.error:+.1f}, {100 * entry.deviation:.1f}"
        for entry in identified.entries
        if entry.nominal
    ]
    if between := [entry for entry in identified.entries if not entry.nominal]:
        lines += ["", "Entries between parts that do not couple in the nominal airframe, and their standard deviations, SI:"]
        lines += [f"  {entry.name}: {entry.value:.3g}, {entry.unit * entry.deviation:.3g}" for entry in between]
    return comment(lines) + as_yaml(identified.airframe)


# Reasons against a model, each a sentence, or empty where there is none


def best_known(entries: Iterable[Entry], outputs: Iterable[str]) -> list[Entry]:
    """The best known effect of an input on each output."""
    effects = [entry for entry in entries if entry.matrix == "B" and entry.nominal]
    best = []
    for output in outputs:
        on_output = [entry for entry in effects if entry.row == output]
        best.append(min(on_output, key=lambda effect: effect.deviation))
    return best


def too_little_excitation(entries: Iterable[Entry], outputs: Iterable[str]) -> str:
    """The output whose inputs are known worst, if the best known effect on it has a deviation above MAX_DEVIATION."""
    worst = max(best_known(entries, outputs), key=lambda effect: effect.deviation)
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
    """The entries at a bound of the search, if more than `allowed`."""
    at_bound = [entry.name for entry in entries if not -MAX_ERROR < entry.error < largest_error(entry)]
    if len(at_bound) > allowed:
        return (
            f"airframe {name}: found {', '.join(at_bound)} at a bound of the search, {1.0 - MAX_ERROR:g} or {MAX_FACTOR:g}"
            " times the nominal value, expected a log of this airframe, in calm air if its effect of wind is not known"
        )
    return ""


def _minor_signs(Omega: FloatArray) -> list[float]:
    """The signs of the leading minors."""
    return [np.sign(np.linalg.det(Omega[:k, :k])) for k in range(1, len(Omega) + 1)]


def other_signs(nominal: Airframe, identified: Airframe, channels: ChannelPairing) -> str:
    """D of the law where the identified model has another: D follows from the signs of the leading minors of C B."""
    columns = [list(nominal.inputs).index(name) for name in channels.inputs]
    order = np.ix_([nominal.outputs.index(name) for name in channels.outputs], columns)
    before = _minor_signs((nominal.matrix_c() @ nominal.matrix_b())[order])
    after = _minor_signs((identified.matrix_c() @ identified.matrix_b())[order])
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
