# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Prove stability for every aircraft of a box, if one bound for the whole box is too large.

A box has an interval for each uncertain entry of A and B. It is halved along one of these entries,
and a half that is not proved is halved again. A half is only examined at the frequencies at which
nothing is proved yet. Source: M. P. Newlin, P. M. Young, International Journal of Robust and
Nonlinear Control 7, 1997.
"""

from typing import Any, NamedTuple

import numpy as np

from flight_analysis.linear_loop.structured_value import (
    NARROWEST,
    RADIUS,
    STALLED,
    Centre,
    Scaling,
    interval_at,
    least_bound,
    least_bound_at,
)
from flight_analysis.linear_loop.uncertain_loop import Channels, ComplexArray
from flight_core.vectors import FloatArray

LEVELLED = 8  # number of frequencies at which `levels_of` looks for the worst one
LATE = 1.01  # size to which a late u is proved: it covers the coefficients that are left out
DIGITS = 5  # significant digits of X and G in a step of a proof


class Region(NamedTuple):
    """A smaller box within a box, with a range of frequencies: one step of a proof covers it.

    It contains the aircraft with abs(d - centre) <= half, where d holds the r deviations of the
    entries. The range of frequencies is from `low` to `high`. d, `centre` and `half` have the shape
    (r,).
    """

    centre: FloatArray
    half: FloatArray
    low: float  # rad/s
    high: float
    # X and G of a larger box or of a neighbouring frequency, at which the search begins
    scaling: Scaling | None = None

    def halves(self, i: int) -> list["Region"]:
        """Return the two halves of the region, cut in the middle of the range of entry i."""
        half = self.half.copy()
        half[i] /= 2.0
        step = np.zeros(len(half))
        step[i] = half[i]
        narrowed = self._replace(half=half)
        return [narrowed._replace(centre=self.centre + side * step) for side in (-1.0, 1.0)]

    def outside(self, begin: float, end: float) -> list["Region"]:
        """Return the region at the frequencies outside the interval from `begin` to `end`, rad/s.

        The result has one region with the frequencies below the interval and one with the
        frequencies above it. A region without frequencies is left out.
        """
        below = self._replace(high=begin)
        above = self._replace(low=end)
        return [side for side in (below, above) if side.high > side.low]


def proof_of(
    part: Channels, size: float, disk: float, most: int, reserve: float = 0.0
) -> list[dict[str, Any]] | None:
    """Find the steps that prove the loop stable, or return None if `most` steps are too few.

    The proof holds for all abs(d_i) <= size, for delays that change from tick to tick within their
    range if `levelled` has scaled their channels, and for complex disks of size `disk` in the
    channels `part.disks`. The loop is known to be stable at d = 0. The proof shows that no aircraft
    of the box has a mode on abs(z) = RADIUS. The eigenvalues move continuously over the box, so
    none of them can leave this circle. Each region is proved for half widths that are larger by the
    fraction `reserve`.

    Each step takes the last region of a list, which at first holds the whole box from 0 to pi / T.
    A step {"halve": i} halves this region along entry i and appends both halves to the list. Every
    other step proves the region from "low" to "high", rad/s, by the scalings "t" and "g". It then
    appends the regions that are left below and above.
    """
    highest = np.pi / part.period
    narrowest = NARROWEST * highest
    half = np.full(len(part.entries), size)
    others = _sizes(part, size, disk)[part.uncertain :]
    regions = [Region(centre=np.zeros(len(half)), half=half, low=0.0, high=highest)]
    steps: list[dict[str, Any]] = []
    while regions and len(steps) < most:
        # Depth first: the last region is the smallest, and its X and G are a good start for the
        # next.
        region = regions.pop()
        w = frequency_in(region, highest)
        around = part.at(region.centre)
        # Bound mu of the deviations of this region, scaled to 1, at one frequency.
        scale = np.r_[(1.0 + reserve) * region.half[part.parameters], others]
        M = scale[:, None] * around.response(w, RADIUS)
        bound, scaling = least_bound_at(around, w, M, region.scaling)
        interval = interval_at(around, w, scaling, scale) if bound < 1.0 else None
        region = region._replace(scaling=scaling)
        if interval is None:
            entry = int(np.argmax(effects_of(part, M, scaling)))
            if region.half[entry] < NARROWEST * size:
                return None  # a mode lies on the circle, and rounding may hide it
            steps.append({"halve": entry})
            regions += region.halves(entry)
        else:
            # extend to the ends of the region if only rounding is left beyond
            begin, end = interval
            low = region.low if begin - region.low <= narrowest else begin
            high = region.high if region.high - end <= narrowest else end
            steps.append({"low": low, "high": high} | _as_step(scaling, part))
            regions += region.outside(low, high)
    return None if regions else steps


def _as_step(scaling: Scaling, part: Channels) -> dict[str, list[float]]:
    """Round the scalings X and G, and return them as the lists `t` and `g` of a step of the proof.

    The lists have only the scalings of the uncertain entries. Rounding is safe, because any X and G
    prove a bound. A delay has channels for the means over a period and for the second Legendre
    coefficients. If the scalings of the second follow from those of the means, as in
    `least_bound_at`, only the means are in the lists. A common factor of all X changes no bound, so
    X is divided by its value at the channels of a delay.
    """
    k = len(part.entries)
    count = part.uncertain if scaling.g[k:].any() else k
    delay = scaling.t[part.uncertain] if part.late else 0.0
    values = (scaling.t[:count] - delay, scaling.g[:count])
    t, g = ([float(f"{x:.{DIGITS}g}") for x in each] for each in values)
    return {"t": t, "g": g}


def frequency_in(region: Region, highest: float) -> float:
    """Choose the frequency, rad/s, at which the bound of a region is computed.

    If an end of the region is 0 or `highest`, pi / T, the frequency is this end, because M is real
    there. If no end is, the frequency is the geometric mean of the ends.
    """
    if region.low == 0.0:
        return 0.0
    return highest if region.high == highest else float(np.sqrt(region.low * region.high))


def _sizes(part: Channels, size: float, disk: float) -> FloatArray:
    """Return, for each channel, the size up to which its deviation is proved.

    The channels of the entries come first, then the channels of a late u, then the disks.
    """
    late, disks = len(part.late), len(part.D) - part.disks.start
    return np.repeat([size, LATE, disk], [part.uncertain, late, disks])


def levels_of(part: Channels, size: float, disk: float) -> FloatArray:
    """Return t = log(X) / 2 of the channels of a late u, rounded and shifted to the mean 0.

    A delay can change from tick to tick, so the ratios of X between its channels must be the same
    at all frequencies. The ratios are taken from the frequency at which the bound is largest. The
    Legendre coefficients of one block of the delay have the same X.
    """
    k, late = len(part.entries), len(part.late)
    scale = _sizes(part, size, disk)
    # the means over a period are enough to find the ratios of X between these channels
    rows = np.r_[0:k, part.uncertain : len(scale)]
    factors = np.arange(len(rows))
    factors[k + late // 2 : k + late] = factors[k : k + late // 2]
    worst, level = 0.0, np.zeros(late)
    for w in np.pi / part.period * np.geomspace(1e-2, 1.0, LEVELLED):
        M = (scale[:, None] * part.response(w, RADIUS))[np.ix_(rows, rows)]
        bound, scaling = least_bound(M, k, 0.0, factors)
        if bound > worst:
            worst, level = bound, scaling.t[k : k + late]
    return np.array([float(f"{x:.{DIGITS}g}") for x in level - level.mean()])


def levelled(part: Channels, levels: FloatArray) -> Channels:
    """Scale the channels of a late u by exp(levels), so that the same X fits all of them.

    `levels` is the result of `levels_of`.
    """
    size = np.ones(len(part.D))
    size[part.uncertain : part.disks.start] = np.exp(levels)
    rows = size[:, None]
    return part._replace(W=part.W / size, Z=rows * part.Z, D=rows * part.D / size)


def effects_of(part: Channels, M: ComplexArray, scaling: Scaling) -> FloatArray:
    """Estimate how much the bound of M falls if the half width of an entry becomes smaller.

    The result has a value for each entry of the part of the loop. Only the ratios of these values
    matter, because all values have the same unknown factor.
    """
    scale = np.exp(scaling.t)
    N = scale[:, None] * M / scale
    centre = Centre(np.ones(len(N)), scaling.g[: part.uncertain], np.eye(len(N)))
    level = max((1.0 + STALLED) * centre.bound(N), 1.0)
    P = np.linalg.inv(centre.inequality(N, level))
    effects = np.diag(N @ P @ N.conj().T).real[: part.uncertain]
    return np.bincount(part.parameters, effects).astype(np.float64)
