# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Collect Monte Carlo statistics, whose size does not grow with the number of flights.

Moments, histograms and the worst flights are summed chunk by chunk.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv

from flight_core.fields import Field
from flight_core.parameters import Config, require
from flight_core.units import ANGULAR_RATE, SPEED, quantity
from flight_core.vectors import FloatArray

PER_DECADE = 100
DECADES = (-8, 6)
"""Decades of the histograms, from 1e-8 to 1e6 in SI, with PER_DECADE bins each. All errors of a
flight lie between these limits, and a bin is 2.3 % wide."""

EDGES = 10.0 ** (np.arange(DECADES[0] * PER_DECADE, DECADES[1] * PER_DECADE + 1) / PER_DECADE)

SCORE_UNIT = {ANGULAR_RATE: 0.010, SPEED: 0.1}  # rad/s, m/s
"""Unit of an rms error in the score, by dimension of the channel."""

# rad/s, by channel, in place of the unit of its dimension; p counts half, because its commands are
# larger
SCORE_UNIT_OF = {"p": 0.020}

FIRST_MODEL = "first_model"
"""Name of a figure of aircraft with a learner, `LearningOutcome.first_model`."""

LOSS_OF_TRACK_SCORE = 10.0  # a higher score counts as a loss of track; scores of 1 to 4 are usual
QUANTILES = (0.5, 0.95, 0.99)
WORST_KEPT = 10  # number of worst flights in a tally


class FigureStatistics(Config):
    """The statistics of a metric over many flights.

    The order of the sums is fixed, so the same chunks give the same result to the last bit.
    """

    count: int = 0
    mean: float = 0.0
    squares: float = 0.0  # sum of (value - mean)^2
    largest: float = -1.0  # -1 as long as there is no value
    # Number of values in each bin that is not empty. The key is the index in EDGES of the lower
    # edge of the bin. It is -1 for values below all edges, and len(EDGES) - 1 for values above.
    bins: dict[int, int] = Field(default={})

    @classmethod
    def from_values(cls, values: FloatArray) -> Self:
        """Collect values >= 0, (N,), into statistics, and leave out NaN."""
        values = values[~np.isnan(values)]
        if not len(values):
            return cls()
        places, counts = np.unique(
            np.searchsorted(EDGES, values, side="right") - 1, return_counts=True
        )
        mean = float(np.mean(values))
        bins = dict(zip(places.tolist(), counts.tolist(), strict=True))
        squares = float(np.sum((values - mean) ** 2))
        largest = float(np.max(values))
        return cls(count=len(values), mean=mean, squares=squares, largest=largest, bins=bins)

    def __add__(self, added: Self) -> Self:
        """Join the statistics of two sets of flights.

        Source: Chan, Golub, LeVeque, Updating formulae and a pairwise algorithm, 1979.
        """
        count = self.count + added.count
        if not count:
            return self
        gap = added.mean - self.mean
        return type(self)(
            count=count,
            mean=self.mean + gap * added.count / count,
            squares=self.squares + added.squares + gap**2 * self.count * added.count / count,
            largest=max(self.largest, added.largest),
            bins=dict(sorted((Counter(self.bins) + Counter(added.bins)).items())),
        )

    @property
    def deviation(self) -> float:
        """Standard deviation of the sample, or 0 if it has fewer than two values."""
        return math.sqrt(self.squares / (self.count - 1)) if self.count > 1 else 0.0

    def quantile(self, share: float) -> float:
        """Return a quantile of the flights, interpolated within its bin, which is 2.3 % wide."""
        rank = share * self.count
        below = 0
        for place, number in self.bins.items():
            if below + number >= rank:
                if place < 0:
                    return 0.0
                low = EDGES[place]
                high = EDGES[min(place + 1, len(EDGES) - 1)]
                return min(float(low * (high / low) ** ((rank - below) / number)), self.largest)
            below += number
        return self.largest


class Worst(Config):
    """One of the worst flights: the aircraft's number, and its score or None if it diverged."""

    number: int
    score: float | None


class Tally(Config):
    """Statistics of many flights."""

    flights: int = 0
    diverged: int = 0
    # number of flights that did not diverge, but have a score above LOSS_OF_TRACK_SCORE
    lost: int = 0
    # statistics of "score", "rms.q", "max.q", "slew.elevator", ... over the flights that did not
    # diverge
    figures: dict[str, FigureStatistics] = Field(default={})
    worst: tuple[Worst, ...] = ()  # worst flights, the worst first

    @classmethod
    def from_flights(
        cls, first: int, diverged: FloatArray, figures: Mapping[str, FloatArray]
    ) -> Self:
        """Collect the flights of the aircraft first, first + 1, ... into statistics.

        `figures` has the metrics of the aircraft by name, (N,) each. One of them is "score".
        """
        bounded = ~np.asarray(diverged, dtype=bool)
        scores = np.asarray(figures["score"])
        rank = np.where(bounded, scores, np.inf)
        order = np.argsort(-rank, kind="stable")[:WORST_KEPT]
        return cls(
            flights=len(bounded),
            diverged=int((~bounded).sum()),
            lost=int(has_lost_track(diverged, scores).sum()),
            figures={
                name: FigureStatistics.from_values(np.asarray(values)[bounded])
                for name, values in figures.items()
            },
            worst=tuple(
                Worst(number=first + int(k), score=float(scores[k]) if bounded[k] else None)
                for k in order
            ),
        )

    def __add__(self, added: Self) -> Self:
        names = list(self.figures) or list(added.figures)
        worst = sorted(
            (*self.worst, *added.worst),
            key=lambda flight: -math.inf if flight.score is None else -flight.score,
        )
        return type(self)(
            flights=self.flights + added.flights,
            diverged=self.diverged + added.diverged,
            lost=self.lost + added.lost,
            figures={
                name: self.figures.get(name, FigureStatistics())
                + added.figures.get(name, FigureStatistics())
                for name in names
            },
            worst=tuple(worst[:WORST_KEPT]),
        )

    def without_model(self) -> int | None:
        """Count the flights that neither diverged nor had a learned model.

        Returns None in a campaign without learners.
        """
        if FIRST_MODEL in self.figures:
            return self.flights - self.diverged - self.figures[FIRST_MODEL].count
        return None

    def summary(self) -> dict[str, Any]:
        """Return the statistics, ready for a JSON file, SI."""
        unmodelled = self.without_model()
        shares: dict[str, Any] = {} if unmodelled is None else {"without_model": unmodelled}
        for word, count in (("diverged", self.diverged), ("lost", self.lost)):
            share, low, high = self.share(count)
            shares[word] = {"count": count, "share": share, "low": low, "high": high}
        summaries = {}
        for name, figure in self.figures.items():
            quantiles = {f"q{100 * part:g}": figure.quantile(part) for part in QUANTILES}
            summaries[name] = {
                "mean": figure.mean,
                "deviation": figure.deviation,
                "worst": figure.largest,
            } | quantiles
        return {
            "flights": self.flights,
            **shares,
            "figures": summaries,
            "worst": [flight.model_dump() for flight in self.worst],
        }

    def share(self, count: int) -> tuple[float, float, float]:
        """Return a count of flights as a share, with its 95 % confidence interval, 0 to 1.

        The interval follows Clopper and Pearson, by quantiles of the beta distribution.
        """
        others = self.flights - count
        low = float(betaincinv(count, others + 1, 0.025)) if count else 0.0
        high = float(betaincinv(count + 1, others, 0.975)) if others else 1.0
        return count / self.flights, low, high


def has_lost_track(diverged: FloatArray, scores: FloatArray) -> NDArray[np.bool_]:
    """Return which flights lost track, (N,).

    A flight lost track if it did not diverge, but has a score above LOSS_OF_TRACK_SCORE.
    """
    return np.asarray(~np.asarray(diverged, dtype=bool) & (scores > LOSS_OF_TRACK_SCORE))


def score_units(
    outputs: Sequence[str], units: Mapping[str, str], stated: Mapping[str, float] | None = None
) -> FloatArray:
    """Return the units of the channels' rms errors in the score, SI, (m,).

    `stated` replaces the usual units of outputs. Raises ParameterError if an output has no unit in
    the score.
    """
    units_of_score = SCORE_UNIT_OF | dict(stated or {})
    for name in outputs:
        has_score = name in units_of_score or quantity(units[name]).dimension in SCORE_UNIT
        require(
            has_score,
            "outputs",
            f"{name} in {units[name]}",
            "rad/s or m/s, or a unit of the score for this output",
        )
    return np.array(
        [
            units_of_score[name]
            if name in units_of_score
            else SCORE_UNIT[quantity(units[name]).dimension]
            for name in outputs
        ]
    )


def score(rms: FloatArray, unit: FloatArray) -> FloatArray:
    """Return the score, which is the sum over the channels of rms / unit, (N,).

    rms has shape (m, N), and unit has shape (m,). With the usual units, an error of 10 mrad/s or
    0.1 m/s adds 1 to the score. In the channel p, an error of 20 mrad/s adds 1.
    """
    return np.asarray(np.sum(rms / unit[:, None], axis=0))
