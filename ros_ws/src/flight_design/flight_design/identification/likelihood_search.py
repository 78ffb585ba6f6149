# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Search for the most probable A and B of one block.

A block is a group of states and inputs of the aircraft that does not couple with the rest. The
method is Gauss-Newton with damping, from several starts.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_core.vectors import FloatArray
from flight_design.identification.block_changes import between, blocks_of, few_blocks, left_out
from flight_design.identification.innovation_filters import LEVELS
from flight_design.identification.likelihood import Fit, Innovations, Likelihood

DIFFERENCE = 1e-4  # step of a parameter in the finite differences of the derivatives
LATER = 1e-3  # s, step of the delay in the finite differences of the derivatives
BLOCK = 4.0  # s, length of the blocks of a log over which scores are summed; longer than a doublet
# If the undamped step lowers the cost by at least this share of the decrease that the quadratic
# model predicts, no damped step is tried.
GOOD = 0.7
# dampings of the steps that are tried side by side, and fractions of the undamped step that are
# tried
DAMPINGS = (0.0, 0.01, 0.1, 1.0, 10.0)
FRACTIONS = (0.5, 0.25)
# levels with which the search begins: calm air, light and moderate turbulence, gusts
STARTS = (0, 3, 4, 13)
TURBULENT = STARTS[2]
# least share of the spans with the same level for which `fit_alike` takes this level for all
ALIKE = 0.8
# signs of the effect of the vertical wind's slope on q, each for one more start
SIGNS = (-1.0, 1.0)
# largest number of steps at a start, and in the search that goes on from one of the best starts
START_STEPS = 8
STEPS = 12
REFINED = 2  # largest number of starts from which the search goes on
CLOSE = 100.0  # largest excess of the cost of such a start over the cost of the best start
# A start, or a search, ends when a step lowers the cost, a log-likelihood, by less than this.
START_PROGRESS = 5.0
PROGRESS = 0.3


class SearchEnd(NamedTuple):
    """The parameters at which a search ends, with their cost."""

    cost: float
    theta: FloatArray  # (p,)
    hessian: FloatArray  # (p, p)
    levels: NDArray[np.int64]  # (spans,) levels of the wind


class Slopes(NamedTuple):
    """The innovations at a theta, divided by their rms, and their derivatives by theta."""

    cost: float
    e: FloatArray  # (samples, m) innovations divided by their rms
    J: FloatArray  # (p, samples m), derivatives of e
    half_log_det: FloatArray  # (p,) derivatives of the sum of log det S / 2


class Doubt(NamedTuple):
    """Two causes of error, besides noise, that widen the standard deviations of a fit.

    They are the uncertain delay of u, and a model that is not right.
    """

    timing: float  # s, standard deviation of the delay of u, which is not identified
    whiteness: FloatArray  # (m,) `whiteness` of the innovations of the held-out samples
    # whether the deviations come from how far theta moves if one block of the log is left out
    leaves_out: bool = False


class Search(Likelihood):
    """The search for the most probable theta of one block."""

    coarse: "Search"
    progress: Callable[[], None] = staticmethod(lambda: None)  # called before each step

    def fit(
        self,
        used: NDArray[np.bool_],
        begin: FloatArray | None = None,
        flown: FloatArray | None = None,
    ) -> Fit:
        """Find the parameters theta of the least cost over the samples in the mask `used`, (T,).

        The cost is N/2 sum_i log mean e_i^2 + sum log det S / 2 + |(theta - centre) / prior|^2 / 2.
        Here e are the normalised innovations, S is the covariance of the innovations, and N is the
        number of samples. The cost has several minima, because a wrong wind can explain a wrong
        model.

        So the search has several starts, at which the flight is averaged over the shortest lag:

        - theta = 0;
        - for each level in STARTS, a start with this level in all spans;
        - for either sign of the effect of the wind's slope on q, a start with this sign.

        The search goes on from the REFINED best starts. Now theta decides the level of each span,
        and the strengths of the winds are free. At last, the search goes on from the best end with
        the most frequent level in every span. Turbulence is the same in every span, and levels that
        change with theta could hold the search at a worse minimum. After the starts, spans that no
        level explains are left out, and so are spans with gusts if there are few of them.

        If `begin`, (p,), is given, it is the only start. If it is not given, `flown`, the theta of
        the model in flight, is one more start.
        """
        if begin is None:
            ends = self._ends(flown, used)
        else:
            theta = self._started(self._within(begin), None, winds=True)
            ends = [self._refined(theta, None, used)]
        best = min(ends, key=lambda end: end.cost)
        same = np.full_like(best.levels, np.bincount(best.levels).argmax())
        steady = self._refined(best.theta, same, used)
        return self._fit_at(min(best, steady, key=lambda end: end.cost), same, used, flown)

    def fit_about(self, fit: Fit, used: NDArray[np.bool_], flown: FloatArray | None = None) -> Fit:
        """Search again from an earlier fit, whose errors become the means of the prior."""
        deviation = self.prior[self._errors]
        self.believe(deviation, fit.theta[self._errors])
        return self.fit(used, fit.theta, flown)

    def fit_alike(self, used: NDArray[np.bool_], flown: FloatArray | None = None) -> Fit | None:
        """Search from one start only, with the same level of the wind in every span.

        The start is in moderate turbulence, at the model in flight, whose theta is `flown`. If
        `flown` is None, the start is at the nominal model. Returns None if less than the fraction
        ALIKE of the spans have the same level.
        """
        coarse = self.coarse
        begin = self._lagging(np.zeros(len(self.prior)) if flown is None else flown)
        turbulent = np.full(len(coarse._spans), TURBULENT)
        theta = self._started(begin, turbulent, winds=True)
        counts = np.bincount(coarse.levels(theta))
        if counts.max() < ALIKE * counts.sum():
            return None
        same = np.full(len(self._spans), counts.argmax())
        end = self._refined(theta, same, used, unsettled=0)
        return self._fit_at(end, None, used, flown)

    def _fit_at(
        self,
        best: SearchEnd,
        same: NDArray[np.int64] | None,
        used: NDArray[np.bool_],
        flown: FloatArray | None,
    ) -> Fit:
        """Return the fit at the end of a search.

        The fit also has the innovations of the nominal model, and of the model `flown` if there is
        one. For each of these two models, the wind has the best level in each span, or the levels
        `same` if the cost with `same` is lower.
        """
        theta = best.theta
        covariance: FloatArray = np.asarray(np.linalg.inv(best.hessian), float)

        def beside(errors: FloatArray | float) -> Innovations:
            changed = np.where(self._errors, errors, theta)
            winds = self.levels(changed)
            if same is not None:
                winds = min(winds, same, key=lambda each: self.cost(changed, used, each))
            return self.predicted(changed, winds)

        after = self.predicted(theta, best.levels)
        by_flown = None if flown is None else beside(flown)
        return Fit(
            theta=theta,
            deviation=np.sqrt(np.diag(covariance)),
            before=beside(0.0),
            after=after,
            levels=best.levels,
            late_deviation=self.late_deviation(theta, covariance),
            by_lag=self.by_lag(covariance),
            flown=by_flown,
        )

    def _ends(self, flown: FloatArray | None, used: NDArray[np.bool_]) -> list[SearchEnd]:
        """Search from the best starts, and return the ends of these searches."""
        coarse = self.coarse
        fitted = coarse.is_fitted()
        zero = self._lagging(np.zeros(len(self.prior)))
        candidates = [(coarse.cost(zero, fitted), zero)]
        begins = [(zero, level) for level in STARTS]
        if self._is_sheared:
            # With the wrong sign of this effect, the search would end at another model.
            for sign in SIGNS:
                begin = zero.copy()
                begin[self._shear.stop - 1] = sign
                begins.append((begin, TURBULENT))
        for begin, level in begins:
            theta = self._started(begin, np.full(len(coarse._spans), level), winds=False)
            candidates.append((coarse.cost(theta, fitted), theta))
        if flown is not None and flown.any():
            theta = self._started(self._lagging(flown), None, winds=True)
            candidates.append((coarse.cost(theta, fitted), theta))
        best = sorted(candidates, key=lambda start: start[0])[:REFINED]
        return [
            self._refined(theta, None, used) for cost, theta in best if cost < best[0][0] + CLOSE
        ]

    def _lagging(self, theta: FloatArray) -> FloatArray:
        """Return theta, (p,), clipped to the bounds, with a lag of y and inertias of the actuators.

        The lag and each inertia are one standard deviation. If they started from 0, the search
        would explain a filter of y or a slow servo by a delay of u, and end there, although a lag
        or an inertia predicts better.
        """
        begin = self._within(theta)
        begin[self._lag] = begin[self._inertia] = 1.0
        return begin

    def _within(self, theta: FloatArray) -> FloatArray:
        """Return theta, (p,), clipped to the bounds of the search."""
        return np.clip(theta, self._lower, self._upper)

    def _started(
        self, theta: FloatArray, levels: NDArray[np.int64] | None, *, winds: bool
    ) -> FloatArray:
        """Return theta, (p,), after at most START_STEPS steps of the search.

        These steps use the flight averaged over the shortest lag. `levels` gives the level of each
        span. If it is None, theta decides the levels. `winds` says whether the strengths of the
        winds are free. The lags of the actuators are not free: beside free delays and inertias, the
        first long steps would set the lags to arbitrary values.
        """
        free = np.ones(len(theta), dtype=bool)
        free[self._winds] = winds
        free[self._servo] = False
        coarse = self.coarse
        fitted = coarse.is_fitted()
        for _ in range(START_STEPS):
            self.progress()
            theta, _, progressed = coarse._step(
                theta, coarse.levels(theta) if levels is None else levels, fitted, free
            )
            if progressed < START_PROGRESS:
                break
        return theta

    def _refined(
        self,
        theta: FloatArray,
        levels: NDArray[np.int64] | None,
        used: NDArray[np.bool_],
        unsettled: int = 1,
    ) -> SearchEnd:
        """Search from one start, and return the end of the search.

        `levels` gives the level of each span. If it is None, theta decides the levels. In the first
        step and in the next `unsettled` steps every span is used, and the search does not end.
        """
        for iteration in range(STEPS):
            self.progress()
            span_levels = self.levels(theta) if levels is None else levels
            mask = used & self._is_counted(theta, span_levels) if iteration > unsettled else used
            theta, hessian, progressed = self._step(
                theta, span_levels, mask, np.ones(len(theta), dtype=bool)
            )
            if iteration > unsettled and progressed < PROGRESS:
                break
        winds = self.levels(theta) if levels is None else levels
        return SearchEnd(self.cost(theta, used, winds), theta, hessian, winds)

    def _step(
        self,
        theta: FloatArray,
        levels: NDArray[np.int64],
        used: NDArray[np.bool_],
        free: NDArray[np.bool_],
    ) -> tuple[FloatArray, FloatArray, float]:
        """Return theta after a damped step of Gauss-Newton, and the Hessian before the step.

        The third result is the decrease of the cost. The derivatives are finite differences, from
        filters that run side by side. The Hessian is J J' + prior^-2, where J has a row for each
        parameter: the derivatives of the innovations, divided by their rms. Source: L. Ljung,
        "System Identification", 7.4 and 10.2.
        """
        slopes = self._slopes(theta, levels, used, free)
        hessian = self._hessian(slopes)
        slope = self._slope(slopes, theta)
        trials = np.clip(
            theta + damped_steps(theta, slope, hessian, self._lower, self._upper, free),
            self._lower,
            self._upper,
        )
        expected = -float(slope @ (trials[0] - theta)) / 2.0
        for several in (trials[:1], trials[1:]):
            innovations = self.innovations(self.models(several, levels), levels)
            lower, _, _ = self._costs(innovations, used, several)
            progressed = float(slopes.cost - lower.min())
            if progressed >= GOOD * expected:
                break
        if progressed <= 0.0:
            return theta, hessian, progressed
        best = several[int(lower.argmin())]
        if len(several) == 1:
            self._passed = best.tobytes(), levels, innovations
        return best, hessian, progressed

    def _slopes(
        self,
        theta: FloatArray,
        levels: NDArray[np.int64],
        used: NDArray[np.bool_],
        free: NDArray[np.bool_],
    ) -> Slopes:
        """Return the derivatives of the innovations and costs at theta by finite differences.

        The filters of all differences run side by side, as one batch.
        """
        size = len(theta)
        indices = np.flatnonzero(free)
        models = self.models(
            theta + DIFFERENCE * np.vstack([np.zeros(size), np.eye(size)[indices]]),
            levels,
            near=True,
        )
        costs, e, half_log_det = self._costs(self.innovations(models, levels), used, theta[None])
        rms = np.sqrt(np.mean(e[0] ** 2, axis=0))
        J = np.zeros((size, e[0].size))
        J[indices] = ((e[1:] - e[0]) / DIFFERENCE / rms).reshape(len(indices), -1)
        log_det = np.zeros(size)
        log_det[indices] = (half_log_det[1:] - half_log_det[0]) / DIFFERENCE
        return Slopes(cost=float(costs[0]), e=e[0] / rms, J=J, half_log_det=log_det)

    def with_doubt(self, fit: Fit, doubt: Doubt) -> tuple[Fit, FloatArray]:
        """Replace the standard deviations of a fit by ones that also hold for a wrong model.

            covariance = H^-1 (M + prior^-2) H^-1 + s s' timing^2,  s = -H^-1 J j

        H is the Hessian. J has the derivatives by theta of the innovations e, divided by their rms.
        If the model were right, M would be J J'. Here two matrices take its place, and each
        parameter gets the largest of its standard deviations. The first matrix sums the outer
        products of J e over blocks of the log. The second matrix is J J' times the whiteness of
        each output, as in Birge's ratio. With `leaves_out`, `left_out` and `few_blocks` take the
        place of the sum over blocks, and the gusts of the fit count as in `_in_lasting_gusts`.

        s is the change of theta with the delay of u, and j is the derivative of e by this delay.
        Sources: H. White, Econometrica 50(1), 1982; R. T. Birge, Phys. Rev. 40(2), 1932; S. F.
        Schmidt, Advances in Control Systems 3, 1966, for a delay that is not estimated.

        Returns the fit, and the part of each entry's standard deviation that the delay causes,
        (entries,).
        """
        theta, used = fit.theta, self.is_fitted()
        slopes = self._slopes(theta, fit.levels, used, np.ones(len(theta), dtype=bool))
        before = np.diag(self.prior**-2)
        inverse: FloatArray = np.asarray(np.linalg.inv(self._hessian(slopes)), float)
        by_output = slopes.J.reshape(len(theta), *slopes.e.shape)
        coloured = (by_output * np.sqrt(np.maximum(doubt.whiteness, 1.0))).reshape(slopes.J.shape)
        places = np.flatnonzero(used) // round(BLOCK / self._period)
        blocks = blocks_of(by_output, slopes.e, places)
        by_prior = np.diag(inverse @ before @ inverse)
        variances = [np.diag(inverse @ coloured @ coloured.T @ inverse) + by_prior]
        if doubt.leaves_out:
            by_noise = np.diag(inverse) - by_prior
            variances.append(left_out(blocks, inverse) + by_prior)
            variances.append(few_blocks(blocks, inverse, by_noise) + by_prior)
            variance, change = self._in_lasting_gusts(fit, used)
            variances.append(variance)
        else:
            change = np.zeros(len(theta))
            variances.append(between(blocks.scores @ inverse) + by_prior)
        models = self.models(theta[None], fit.levels)
        later = models._replace(u=self._delayed(self._delay + LATER / self._period))
        (e,), (e_later,) = (
            self._costs(self.innovations(each, fit.levels), used, theta[None])[1]
            for each in (models, later)
        )
        j = (e_later - e) / np.sqrt(np.mean(e**2, axis=0)) / LATER
        late = np.abs(doubt.timing * inverse @ (slopes.J @ j.ravel()))
        square = np.maximum.reduce(variances) + change**2 + late**2
        return fit._replace(deviation=np.sqrt(square)), late[: self.count]

    def _in_lasting_gusts(self, fit: Fit, used: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
        """Return the variance of theta with gusts in every span, and how theta changes, (p,) each.

        A span counts as a gust if the model of theta cannot explain it by calmer air. So the levels
        of the wind favour the theta that they were found with, and the effects of inputs that
        answer the gusts come out too weak. Here every span has the most frequent level of the
        gusts, which needs no choice of spans. The change is a step of Gauss-Newton. Both are 0 if
        the fit has no gusts. Source: J. A. Hausman, Econometrica 46(6), 1978, for a model that is
        tested by the change of its estimate under a weaker assumption.
        """
        theta = fit.theta
        gusts = fit.levels[LEVELS[fit.levels, 1] > 0.0]
        if not len(gusts):
            return np.zeros(len(theta)), np.zeros(len(theta))
        lasting = np.full_like(fit.levels, np.bincount(gusts).argmax())
        slopes = self._slopes(theta, lasting, used, np.ones(len(theta), dtype=bool))
        inverse = np.linalg.inv(self._hessian(slopes))
        return np.diag(inverse), np.asarray(-inverse @ self._slope(slopes, theta))

    def _hessian(self, slopes: Slopes) -> FloatArray:
        """Return the Hessian of Gauss-Newton, J J' + prior^-2, (p, p)."""
        return np.asarray(slopes.J @ slopes.J.T + np.diag(self.prior**-2))

    def _slope(self, slopes: Slopes, theta: FloatArray) -> FloatArray:
        """Return the derivative of the cost by theta, (p,)."""
        by_prior = (theta - self.centre) / self.prior**2
        return np.asarray(slopes.J @ slopes.e.ravel() + by_prior + slopes.half_log_det)

    def flying(self, flown: FloatArray, parts: Iterable[tuple[Likelihood, Fit]]) -> Innovations:
        """Return the innovations of the model in use, whose theta is `flown`, (p,).

        Winds, angles and delays come from the fits of the `parts` (groups of states that do not
        couple).
        """
        theta = np.where(self._errors, flown, self.joined(parts))
        return self.predicted(theta, self.levels(theta))

    def joined(self, parts: Iterable[tuple[Likelihood, Fit]]) -> FloatArray:
        """Return one theta, (p,), with the mean winds, angles and delays of all parts.

        In this theta the errors of A and B are 0, and so are the lags and inertias of the
        actuators. The values that were found for a part are wrong if the part couples with another
        one.
        """
        values: dict[str, list[float]] = {}
        for part, fit in parts:
            for name, value in list(zip(part.named(), fit.theta.tolist(), strict=True))[
                part.count :
            ]:
                values.setdefault(name, []).append(value)
        theta = np.array([np.mean(values.get(name, [0.0])) for name in self.named()])
        theta[self._servo] = theta[self._inertia] = 0.0
        return theta


def damped_steps(
    theta: FloatArray,
    slope: FloatArray,
    hessian: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    free: NDArray[np.bool_],
) -> FloatArray:
    """Return steps of theta: -(hessian + d diag hessian)^-1 slope for each damping d, (k, p).

    The last steps are the first step multiplied by each of FRACTIONS. Only the parameters in the
    mask `free`, (p,), move. A parameter at its bound does not move outwards. Source: D. W.
    Marquardt, J. SIAM 11(2), 1963.
    """
    steps = np.zeros((len(DAMPINGS), len(theta)))
    while True:
        part = hessian[np.ix_(free, free)]
        damped = part + np.array(DAMPINGS)[:, None, None] * np.diag(np.diag(part))
        steps[:] = 0.0
        steps[:, free] = -np.linalg.solve(damped, slope[free, None])[..., 0]
        outwards = free & (
            ((theta >= upper) & (steps[0] > 0.0)) | ((theta <= lower) & (steps[0] < 0.0))
        )
        if not outwards.any():
            return np.vstack([steps, np.outer(FRACTIONS, steps[0])])
        free = free & ~outwards
