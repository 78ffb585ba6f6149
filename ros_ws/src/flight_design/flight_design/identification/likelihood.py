# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute the likelihood of A and B for one block, from a recorded flight.

A block is a group of states and inputs of the aircraft that does not couple with the rest. The
Kalman filter of the observer gives the innovations at each level of the wind.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.atmosphere.disturbance import ROTARY
from aircraft_sim.uncertainty import coupled_gust_directions
from control_laws.nominal_model import NominalModel
from flight_analysis.closed_loop.learning_loop import Entry
from flight_core.outcome import Refusal
from flight_core.vectors import FloatArray
from flight_design.identification.entry_units import MAX_ERROR, MAX_FACTOR, largest_error, units
from flight_design.identification.innovation_filters import (
    DRIFT,
    HOLD,
    LEVELS,
    SHEARED,
    TRANSIENT,
    Block,
    FilterBank,
    FlightData,
    Passage,
    coarser,
    delayed,
    filter_bank,
)
from flight_design.identification.normalised import Normalised, normalised
from flight_design.identification.servo_model import behind_servos
from flight_design.identification.spans import held_out, span_length

PRIOR = 0.29  # standard deviation of a relative error before the flight: uniform within +-50 %
SHEAR_PRIOR = 1.0  # prior standard deviation of the effect of the vertical wind's slope on a state
WIND_PRIOR = 1.0  # prior standard deviation of the logarithm of the wind's strength along an axis
# largest error of the delay in standard deviations: 60 ms for a deviation of 15 ms
MAX_DELAY_ERROR = 4.0
# least gain of log-likelihood in a span for which a stronger wind is taken: odds of 20 to 1
CHANGE = 3.0
# A span whose innovations have a mean square above this multiple of the median is explained by no
# level of the wind.
UNEXPLAINED = 5.0
# If fewer than this share of the spans have gusts, these spans do not count in the fit, because
# gusts are no white noise.
FEW = 0.25
# number of spans that are left out after a span that was left out, while the estimates recover
RECOVERY = 2


class Innovations(NamedTuple):
    """Innovations of a model over a recording, with the likelihood of each sample."""

    r: FloatArray  # (T, m) in units of y, NaN where y is lost
    normalised: FloatArray  # (T, m) innovations whose covariance is I if the model is right
    # (T,) log-likelihood of each sample up to a constant, see `predicted`
    log_likelihood: FloatArray


class Models(NamedTuple):
    """The filters of N models, and their inputs."""

    bank: FilterBank
    levels: NDArray[np.int64]  # indices in LEVELS of the levels that the bank has
    begin: FloatArray  # (N, s) estimates at the beginning of the flight
    u: FloatArray  # (T, m), or (N, T, m) if the delay is identified


class Unknown(NamedTuple):
    """Standard deviations, before the flight, of all that is identified, or 0 for a known value.

    `drift` is an exception: it is the noise of the disturbances in the filter. Hidden states, such
    as alpha, are states that y does not contain. If y has only the rates, the rows of the hidden
    states are taken as known, because mass and lift give them.
    """

    delay: float = 0.0  # s, deviation of the delay of u
    angle: float = 0.0  # rad, deviation of pitch and bank at the beginning of the recording
    effect: float = PRIOR  # relative deviation of an entry of B before the flight
    error: float = PRIOR  # relative deviation of an entry of A before the flight
    drift: float = DRIFT  # sizes/s per root s, noise of the disturbances
    has_hidden_rows: bool = True  # whether the rows of states that are no outputs are identified
    lag: float = 0.0  # s, deviation of the lag of a filter of first order through which y comes
    # deviation of the logarithm of an actuator's lag; if it and `delay` are above 0, the actuator
    # may also be of second order
    servo: float = 0.0

    @property
    def factor(self) -> float:
        """Largest factor by which an entry may be larger or smaller than its nominal value.

        It is MAX_FACTOR if `error` and `effect` are at most PRIOR, and grows with the larger of the
        two.
        """
        roughness = max(self.error, self.effect, PRIOR) / PRIOR
        return float(MAX_FACTOR**roughness)


KNOWN = Unknown()


class Fit(NamedTuple):
    """The most probable parameters theta of a block, and the innovations of the models."""

    theta: FloatArray
    """(p,) relative errors of the uncertain entries of A, then of B; logarithms of the strengths of
    the winds; then, if they are identified, the shear, the angles at the beginning, the lag of y,
    the logarithms of the lags of the actuators, their inertias, and the errors of the delays, in
    units of their deviations."""
    deviation: FloatArray  # (p,) standard deviations of theta after the flight
    before: Innovations  # innovations of the nominal model in the winds of this fit
    after: Innovations  # innovations of the identified model
    levels: NDArray[np.int64]  # (spans,) levels of the wind with the identified model
    late_deviation: FloatArray  # s, standard deviation of the delay of each input with the lag of y
    by_lag: FloatArray  # (p,) part of each deviation that comes from the lags, see `by_lag`
    # innovations of the model in flight, in the winds that fit it best
    flown: Innovations | None = None


class Likelihood:
    """The data of one block, and functions of the parameters theta, such as their likelihood."""

    coarse: "Likelihood"  # likelihood of the same flight, averaged over the shortest lag

    def __init__(
        self,
        recorded: FlightData,
        model: NominalModel,
        block: Block,
        airframe: Airframe,
        delay: float | FloatArray,
        unknown: Unknown = KNOWN,
        factor: int | None = None,
        *,
        coupled: bool = False,
        rates: FloatArray | None = None,
    ) -> None:
        """Set up the likelihood, with the priors of the errors of A and B in `unknown`.

        `believe` may replace the priors later. `delay` is the delay of u, s. The search starts with
        means over `factor` periods, by default over the shortest lag. If `coupled`, entries that
        are 0 in the nominal model are identified as well. `rates` has the rate limits of the
        aircraft's actuators, in units of u / s. They are used only if the delay is identified.
        """
        if factor is None:
            factor = max(int(float(np.min(model.lag)) / recorded.period + 1e-9), 1)
        self.coarse = self
        if factor > 1:
            period = factor * recorded.period
            slow = model._replace(noise=model.noise / np.sqrt(factor), period=period)
            means = coarser(recorded, factor)
            self.coarse = type(self)(
                means, slow, block, airframe, delay, unknown, 1, coupled=coupled, rates=rates
            )
        self._period = recorded.period
        self._delay = np.broadcast_to(delay, len(block.inputs)) / recorded.period
        self._delay_deviation = unknown.delay / recorded.period
        self._lag_deviation = unknown.lag
        self._servo_deviation = unknown.servo
        self._rates = None if rates is None else rates[block.inputs]
        self._drift = unknown.drift
        angles = np.flatnonzero(block.restricted(model).gravity.any(axis=0))
        self._angles = angles if unknown.angle else angles[:0]
        self._angle_deviation = unknown.angle
        self._model = block.restricted(model)
        self._block = block
        self._airframe = airframe
        self.names = block.named(airframe)
        rolls = any(axis in ROTARY for axis in self.names.winds)
        in_part = set(SHEARED) <= set(self.names.states) and "vertical" in self.names.winds
        self._is_sheared = airframe.span is not None and in_part
        self._usable = np.flatnonzero((LEVELS[:, 2] == 0.0) | rolls)
        self._y = recorded.y[:, block.outputs]
        self._u = recorded.u[:, block.inputs]
        length = span_length(recorded)
        self._spans = [slice(first, first + length) for first in range(0, len(recorded.t), length)]
        self._units = units(self._model, coupled=coupled)
        if not unknown.has_hidden_rows:
            is_output = np.any(self._model.C, axis=0).astype(float)[:, None]
            units_A, units_B = self._units
            self._units = units_A * is_output, units_B * is_output
        count_A, count_B = map(np.count_nonzero, self._units)
        # theta, levels and innovations of the last call of `levels`
        self._passed: tuple[bytes, NDArray[np.int64], Normalised] | None = None
        self.count = int(count_A + count_B)  # number of entries of A and B that are identified
        self._factor = unknown.factor
        self.believe(np.repeat([unknown.error, unknown.effect], [count_A, count_B]))

    def believe(self, deviation: FloatArray, centre: FloatArray | None = None) -> None:
        """Set the prior of the relative errors: their standard deviations and means, (entries,).

        The means are `centre`, by default 0. The standard deviations and the bounds of the search
        are relative to the values of the entries at the means.
        """
        delay_prior = np.ones(len(self._block.inputs) if self._delay_deviation else 0)
        wind_prior = np.full(len(self._block.winds), WIND_PRIOR)
        if self.coarse is not self:
            self.coarse.believe(deviation, centre)
        shear_prior = np.full(len(SHEARED) if self._is_sheared else 0, SHEAR_PRIOR)
        begin_prior = np.ones(len(self._angles))
        lag_prior = np.ones(1 if self._lag_deviation else 0)
        servo_prior = np.ones(2 * len(self._block.inputs) if self._servo_deviation else 0)
        others = [wind_prior, shear_prior, begin_prior, lag_prior, servo_prior, delay_prior]
        self.prior = np.concatenate([deviation, *others])
        self._errors = np.arange(len(self.prior)) < len(deviation)
        self._upper = MAX_ERROR / PRIOR * self.prior
        self._lower = -self._upper
        self._upper[self._errors] = (
            deviation / PRIOR * [largest_error(entry) for entry in self.nominal_entries()]
        )
        self._late = slice(len(self.prior) - len(delay_prior), len(self.prior))
        rough = np.zeros(len(self.prior), dtype=bool)
        nominal = np.array([entry.nominal for entry in self.nominal_entries()])
        rough[self._errors] = (deviation > PRIOR) & (nominal != 0.0)
        self._upper[rough] = np.log(self._factor)
        self._lower[rough] = -self._upper[rough]
        self._by_factor = rough[self._errors]
        self.centre = np.zeros(len(self.prior))
        if centre is not None:
            self.centre[self._errors] = centre
            scale = np.where((nominal != 0.0) & ~self._by_factor, 1.0 + centre, 1.0)
            for bounds in (self._lower, self._upper):
                bounds[self._errors] = centre + scale * bounds[self._errors]
            self.prior[self._errors] *= scale
        if len(delay_prior):  # u cannot act before it is sent
            earliest = -self._delay / self._delay_deviation
            self._lower[self._late] = np.maximum(-MAX_DELAY_ERROR, earliest)
            self._upper[self._late] = MAX_DELAY_ERROR
        self._winds = slice(len(deviation), len(deviation) + len(wind_prior))
        self._shear = slice(self._winds.stop, self._winds.stop + len(shear_prior))
        self._begin = slice(self._shear.stop, self._shear.stop + len(self._angles))
        self._lag = slice(self._begin.stop, self._begin.stop + len(lag_prior))
        middle = self._lag.stop + len(servo_prior) // 2
        self._servo = slice(self._lag.stop, middle)
        self._inertia = slice(middle, self._lag.stop + len(servo_prior))
        self._lower[self._servo] = -MAX_DELAY_ERROR
        self._lower[self._lag] = self._lower[self._inertia] = 0.0
        self._upper[self._lag.start : self._inertia.stop] = MAX_DELAY_ERROR

    def relative_errors(self, theta: FloatArray) -> FloatArray:
        """Return the relative errors of the entries for their parameters theta, (..., entries).

        The errors equal theta, except for entries whose prior deviation is above PRIOR. A rough
        file errs by a factor, up or down, so the theta of such an entry is the logarithm of the
        factor.
        """
        return np.where(self._by_factor, np.expm1(theta), theta)

    def with_errors(self, thetas: FloatArray) -> NominalModel:
        """Return the models for N thetas, (N, p): A (N, n, n), B (N, n, m), wind (N, n, G).

        The wind acts on each model through the A of this model, because an aircraft is moved by its
        motion relative to the air. So an identified entry also changes the effect of the wind, even
        if it is 0 in the nominal airframe.
        """
        matrices = []
        errors = self.relative_errors(thetas[:, : self.count])
        parts = np.split(errors, [np.count_nonzero(self._units[0])], axis=1)
        for matrix, unit, part in zip(
            (self._model.A, self._model.B), self._units, parts, strict=True
        ):
            changed = np.tile(matrix, (len(thetas), 1, 1))
            changed[:, unit != 0.0] += unit[unit != 0.0] * part
            matrices.append(changed)
        A = np.tile(self._airframe.matrix_a(), (len(thetas), 1, 1))
        x = self._block.states
        A[:, x[:, None], x] = matrices[0]
        wind = coupled_gust_directions(self._airframe, A)[:, x[:, None], self._block.winds]
        return self._model._replace(A=matrices[0], B=matrices[1], wind=wind)

    def models(
        self, thetas: FloatArray, levels: NDArray[np.int64], *, near: bool = False
    ) -> Models:
        """Design the filters of N models, with parameters theta (N, p), at some levels of the wind.

        With `near`, the gains of all models are computed from the gains of the first model, to
        first order.
        """
        levels = np.unique(levels)
        airframe = self._airframe
        bank = filter_bank(
            self.with_errors(thetas),
            self.names,
            airframe.speed,
            np.exp(thetas[:, self._winds]),
            levels,
            self._drift,
            near=near,
            span=airframe.span,
            shear=thetas[:, self._shear] if self._is_sheared else None,
            lag=self._lag_deviation * thetas[:, self._lag.start] if self._lag_deviation else None,
        )
        first = np.where(np.isfinite(self._y[0]), self._y[0], 0.0)
        begin = np.tile(first @ bank.sampled.H, (len(thetas), 1))
        if self._lag_deviation:  # y before the filter equals y behind it
            begin[:, : len(self.names.states)] = first @ self._model.C
        begin[:, self._angles] = self._angle_deviation * thetas[:, self._begin]
        if not self._delay_deviation:
            return Models(bank, levels, begin, self._delayed(self._delay))
        periods = self._delay + self._delay_deviation * thetas[:, self._late]
        inertia = thetas[:, self._inertia] if self._servo_deviation else np.zeros(periods.shape)
        servo = self._servo_lag(thetas), inertia, self._rates
        u = behind_servos(self._u, periods, self._period, self._model.lag, *servo)
        return Models(bank, levels, begin, u)

    def _servo_lag(self, thetas: FloatArray) -> FloatArray:
        """Return the lags of the actuators for N thetas, s, (N, m)."""
        if not self._servo_deviation:
            return np.tile(self._model.lag, (len(thetas), 1))
        factor = np.exp(self._servo_deviation * thetas[:, self._servo])
        return np.asarray(self._model.lag * factor)

    def _delayed(self, periods: FloatArray) -> FloatArray:
        """Return u, (T, m), with each input delayed by its number of periods, (m,)."""
        columns = zip(self._u.T, np.maximum(periods, 0.0).tolist(), strict=True)
        return np.hstack([delayed(u[:, None], late) for u, late in columns])

    def delays(self, fit: Fit) -> tuple[FloatArray, FloatArray]:
        """Return the delays of the inputs, s, and their standard deviations, (m,) each.

        A delay includes the lag of y, and the time by which the lag of the actuator exceeds the
        known lag, because all of them make a loop late.
        """
        late = self._period * self._delay
        if self._delay_deviation:
            late = late + self._period * self._delay_deviation * fit.theta[self._late]
        late = late + self._servo_lag(fit.theta[None])[0] - self._model.lag
        return late + self._lag_deviation * np.sum(fit.theta[self._lag]), fit.late_deviation

    def late_deviation(self, theta: FloatArray, covariance: FloatArray) -> FloatArray:
        """Return the standard deviations of `delays`, s, from the covariance of theta, (p, p)."""
        m = len(self._delay)
        size = np.zeros((m, len(self.prior)))
        size[:, self._lag] = self._lag_deviation
        size[:, self._late] = (
            self._period * self._delay_deviation * np.eye(m)[:, : len(self.prior[self._late])]
        )
        if self._servo_deviation:
            size[:, self._servo] = self._servo_deviation * np.diag(self._servo_lag(theta[None])[0])
        return np.asarray(np.sqrt(np.einsum("ip,pq,iq->i", size, covariance, size)))

    def by_lag(self, covariance: FloatArray) -> FloatArray:
        """Return which part of each standard deviation of theta is caused by unknown lags, (p,).

        The lags are the lag of y and the lags of the actuators, with their inertias. `covariance`
        is the covariance of theta. If the lags were known, the variances would be smaller by the
        squares of these parts.
        """
        lags = slice(self._lag.start, self._inertia.stop)
        shared = covariance[:, lags]
        by_lags = np.linalg.solve(covariance[lags, lags], shared.T)
        return np.asarray(np.sqrt(np.sum(shared.T * by_lags, axis=0)))

    def levels(self, theta: FloatArray) -> NDArray[np.int64]:
        """Choose the level of the wind in each span, (spans,), for the parameters theta, (p,).

        At each level, the filter predicts a span from the estimates at its beginning. Of the levels
        whose log-likelihood is within CHANGE of the best one, the calmest is chosen.
        """
        models = self.models(theta[None], self._usable)
        bank = models.bank.by_level()
        u = models.u.reshape(self._u.shape)
        precision = np.linalg.inv(bank.covariance[:, 0])
        log_det = np.linalg.slogdet(bank.covariance[:, 0])[1]
        length = self._spans[0].stop // HOLD
        flight = Passage(bank, self._y, u, np.zeros(-(-len(self._y) // HOLD), dtype=np.int64))
        z = np.repeat(models.begin, len(self._usable), axis=0)
        calmest = list[int]()
        r_found = list[FloatArray]()
        for k in range(len(self._spans)):
            r, after = flight.run(z, k * length, (k + 1) * length)
            gain = (
                -np.nansum(np.einsum("lki,lij,lkj->lk", r, precision, r) + log_det[:, None], axis=1)
                / 2.0
            )
            calmest.append(int(np.argmax(gain >= gain.max() - CHANGE)))
            r_found.append(r[calmest[-1]])
            z = np.repeat(after[calmest[-1]][None], len(self._usable), axis=0)
        passed = normalised(
            np.concatenate(r_found)[None, : len(self._y)],
            models.bank.covariance,
            self._of_span(calmest),
        )
        levels = self._usable[calmest]
        self._passed = theta.tobytes(), levels, passed
        return levels

    def _of_span(self, values: Sequence[int] | NDArray[np.int64]) -> NDArray[np.int64]:
        """Repeat the value of each span for every sample of the span, (T,)."""
        return np.repeat(np.asarray(values), self._spans[0].stop)[: len(self._y)]

    def innovations(self, models: Models, levels: NDArray[np.int64]) -> Normalised:
        """Return the innovations of N models at the given level of the wind in each span."""
        place = self._of_span(np.searchsorted(models.levels, levels))
        r = Passage(models.bank, self._y, models.u, place[::HOLD]).run(models.begin)[0][
            :, : len(self._y)
        ]
        return normalised(r, models.bank.covariance, place)

    def passed(self, theta: FloatArray, levels: NDArray[np.int64]) -> Normalised:
        """Return the innovations for theta, (p,), at the given level of the wind in each span.

        If the last call of `levels` had this theta, its innovations are returned.
        """
        if (
            self._passed is not None
            and self._passed[0] == theta.tobytes()
            and np.array_equal(self._passed[1], levels)
        ):
            return self._passed[2]
        return self.innovations(self.models(theta[None], levels), levels)

    def predicted(self, theta: FloatArray, levels: NDArray[np.int64]) -> Innovations:
        """Return the innovations for theta, (p,), with their log-likelihood.

            log p = -1/2 sum_i (e_i^2 / s_i + log s_i) - 1/2 log det S,   s_i = mean e_i^2

        The means s_i are over the samples to which the model is fitted. As in the cost, the
        division by them takes out the scale of e. The noise of the filter is only a guess, and a
        model must not gain by a better guess.
        """
        (r,), (e,), (half_log_det,) = self.passed(theta, levels)
        scale = np.mean(e[self.is_fitted()] ** 2, axis=0)
        log_likelihood = -np.sum(e**2 / scale + np.log(scale), axis=1) / 2.0 - half_log_det
        return Innovations(r, e, log_likelihood)

    def cost(
        self,
        theta: FloatArray,
        used: NDArray[np.bool_],
        levels: NDArray[np.int64] | None = None,
    ) -> float:
        """Return the cost that `Search.fit` minimises, for theta, (p,).

        The wind has the given `levels`. If `levels` is None, it has the best level in each span.
        """
        levels = self.levels(theta) if levels is None else levels
        (cost,), _, _ = self._costs(self.passed(theta, levels), used, theta[None])
        return float(cost)

    def nominal_entries(self) -> list[Entry]:
        """Return the entries of A and B to identify, with their values before the flight."""
        places = []
        for matrix, unit, columns in zip(
            "AB", self._units, (self.names.states, self.names.inputs), strict=True
        ):
            values = self._model.A if matrix == "A" else self._model.B
            places += [
                Entry(
                    matrix=matrix,
                    row=self.names.states[i],
                    column=columns[j],
                    nominal=float(values[i, j]),
                    error=0.0,
                    deviation=0.0,
                    unit=float(unit[i, j]),
                )
                for i, j in np.argwhere(unit)
            ]
        return [
            place._replace(deviation=deviation)
            for place, deviation in zip(places, self.prior.tolist(), strict=False)
        ]

    def named(self) -> list[str]:
        """Return the names of the parameters theta, (p,).

        Their order is entries, winds, shears, angles, lag, servos, delays.
        """
        angles = [self.names.states[k] for k in self._angles]
        names = [entry.name for entry in self.nominal_entries()]
        shears = [f"shear of {name}" for name in SHEARED] if self._is_sheared else []
        delays = [f"delay of {name}" for name in self.names.inputs]
        lag = ["lag of y"] if self._lag_deviation else []
        servo = [f"{kind} of {name}" for kind in ("lag", "inertia") for name in self.names.inputs]
        servo = servo if self._servo_deviation else []
        others = [*self.names.winds, *shears, *angles, *lag, *servo, *delays]
        return names + others[: len(self.prior) - len(names)]

    def model_errors(self, airframe: Airframe) -> FloatArray:
        """Return the theta, (p,), whose errors of A and B give the model `airframe`.

        The entries of theta for winds, shears, angles, lag and delays are 0.
        """
        A = airframe.matrix_a()
        B = airframe.matrix_b()
        inputs = list(airframe.inputs)
        theta = np.zeros(len(self.prior))
        for k, entry in enumerate(self.nominal_entries()):
            row = airframe.index(entry.row)
            if entry.matrix == "A":
                value = A[row, airframe.index(entry.column)]
            else:
                value = B[row, inputs.index(entry.column)]
            theta[k] = (value - entry.nominal) / entry.unit
        rough = np.flatnonzero(self._by_factor)
        theta[rough] = np.log(np.maximum(1.0 + theta[rough], 1.0 / self._factor))
        return theta

    def entries(self, fit: Fit) -> list[Entry]:
        """Return the entries of A and B with their identified errors."""
        # The entries are the first parameters in theta; winds and others follow.
        errors = self.relative_errors(fit.theta[: self.count])
        deviations = self.in_errors(fit, fit.deviation)
        return [
            entry._replace(error=error, deviation=deviation)
            for entry, error, deviation in zip(
                self.nominal_entries(), errors.tolist(), deviations.tolist(), strict=True
            )
        ]

    def in_errors(self, fit: Fit, deviation: FloatArray) -> FloatArray:
        """Convert standard deviations of theta, (p,), to deviations of the relative errors."""
        slope = np.where(self._by_factor, np.exp(fit.theta[: self.count]), 1.0)
        return slope * deviation[: self.count]

    def about_centre(self, entries: Iterable[Entry]) -> list[Entry]:
        """Return entries with errors and deviations that are relative to the mean of the prior."""
        centred = []
        centres = self.relative_errors(self.centre[: self.count]).tolist()
        for entry, centre in zip(entries, centres, strict=True):
            scale = 1.0 + centre if entry.nominal else 1.0
            error = (entry.error - centre) / scale
            centred.append(entry._replace(error=error, deviation=entry.deviation / scale))
        return centred

    def reason_against_air(self, fit: Fit) -> Refusal | None:
        """Return a refusal of a fit if the slope of the vertical wind acts too strongly.

        If the effect of this slope on a state is at its bound, the effect stands for errors of the
        aircraft's model, not for the wind. Returns None if no effect is at its bound.
        """
        effects = np.abs(fit.theta[self._shear])
        bounds = self._upper[self._shear]
        at_bound = np.flatnonzero(effects >= bounds)
        if not len(at_bound):
            return None
        names = " and ".join(SHEARED[k] for k in at_bound)
        return Refusal(
            f"air: found an effect of the slope of the vertical wind on {names} at a bound of the "
            f"search, {bounds[0]:.2g}, expected less"
        )

    def is_known(self) -> NDArray[np.bool_]:
        """Return the mask of the samples that can be used, (T,).

        These samples have a y, and lie after the transient of the filter.
        """
        return np.isfinite(self._y).all(axis=1) & (
            np.arange(len(self._y)) >= TRANSIENT / self._period - 0.5
        )

    def is_fitted(self) -> NDArray[np.bool_]:
        """Return the mask of the samples to which the model is fitted, (T,)."""
        return self.is_known() & ~held_out(len(self._y), self._spans[0].stop)

    def _is_counted(self, theta: FloatArray, levels: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return the mask of the samples that are used in the fit, (T,).

        A span is left out if no level of the wind explains it. A span with a gust is left out if
        less than the fraction FEW of all spans have gusts. After a span that is left out, the next
        RECOVERY spans are left out as well.
        """
        _, (e,), _ = self.passed(theta, levels)
        square = np.array(
            [np.nansum(e[span] ** 2) / max(np.isfinite(e[span]).sum(), 1) for span in self._spans]
        )
        # At rest without noise, the mean square is 0.
        largest = UNEXPLAINED * np.median(square[square > 0.0]) if square.any() else np.inf
        unexplained, gusts = (
            np.convolve(spans, np.ones(RECOVERY + 1))[: len(levels)] > 0.0
            for spans in (square > largest, LEVELS[levels, 1] > 0.0)
        )
        left_out = unexplained | gusts if np.mean(gusts) < FEW else unexplained
        return ~np.repeat(left_out, self._spans[0].stop)[: len(self._y)]

    def _costs(
        self, innovations: Normalised, used: NDArray[np.bool_], thetas: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the costs of N models, their normalised innovations, and sum log det S / 2.

        Samples outside the mask `used` are left out. The innovations have shape (N, samples, m).
        """
        e = innovations.e[:, used]
        total = np.sum(innovations.half_log_det[:, used], axis=1)
        costs = e.shape[1] / 2.0 * np.sum(np.log(np.mean(e**2, axis=1)), axis=1) + total
        costs = costs + np.sum(((thetas - self.centre) / self.prior) ** 2, axis=1) / 2.0
        return np.where(np.isfinite(costs), costs, np.inf), e, total
