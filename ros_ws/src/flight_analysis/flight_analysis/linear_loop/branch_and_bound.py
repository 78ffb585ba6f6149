# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Proof of stability for every aircraft of a box, where a bound of the whole box is too large.

The box is halved along one parameter, and each half again, over the frequencies that are left.
Source: M. P. Newlin, P. M. Young, International Journal of Robust and Nonlinear Control 7, 1997.
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
    tightened,
    tightened_at,
)
from flight_analysis.linear_loop.uncertain_loop import Channels, ComplexArray
from flight_core.vectors import FloatArray

LEVELLED = 8  # frequencies at which the ratios of the D of a late u are sought
DIGITS = 5  # of D and G in a step


class Region(NamedTuple):
    """abs(d - centre) <= half of each parameter, (r,), at the frequencies from low to high."""

    centre: FloatArray
    half: FloatArray
    low: float  # rad/s
    high: float
    scaling: Scaling | None = None  # of a larger box or of a neighbouring frequency

    def halves(self, i: int) -> list["Region"]:
        """Both halves along a parameter."""
        half = self.half.copy()
        half[i] /= 2.0
        step = np.zeros(len(half))
        step[i] = half[i]
        narrowed = self._replace(half=half)
        return [narrowed._replace(centre=self.centre + side * step) for side in (-1.0, 1.0)]

    def outside(self, begin: float, end: float) -> list["Region"]:
        """The frequencies below and above an interval, rad/s."""
        below = self._replace(high=begin)
        above = self._replace(low=end)
        return [side for side in (below, above) if side.high > side.low]


def proof_of(part: Channels, size: float, disk: float, most: int) -> list[dict[str, Any]] | None:
    """The steps that prove the loop stable; None if `most` boxes are too few.

    The proof holds for every abs(d_i) <= size, any delays of the part from tick to tick, and
    complex disks of a size in the channels of disks. The loop of d = 0 is stable. None of the box
    has a mode on abs(z) = RADIUS, so none leaves.

    A step takes the last box of a list, at first the whole one from 0 to pi / T. It halves the box
    along an entry, {"halve": i}, and appends both halves; or it proves the box from "low" to
    "high", rad/s, by "t" and "g", and appends what is left below and above.
    """
    highest = np.pi / part.period
    narrowest = NARROWEST * highest
    half = np.full(len(part.entries), size)
    others = np.r_[np.ones(part.late), np.full(len(part.D) - part.uncertain - part.late, disk)]
    part = _levelled(part, np.r_[half[part.parameters], others])
    regions = [Region(centre=np.zeros(len(half)), half=half, low=0.0, high=highest)]
    steps: list[dict[str, Any]] = []
    while regions and len(steps) < most:
        region = regions.pop()
        w = _frequency(region, highest)
        around = part.at(region.centre)
        scale = np.r_[region.half[part.parameters], others]
        M = scale[:, None] * around.response(w, RADIUS)
        bound, scaling = tightened_at(around, w, M, region.scaling)
        interval = interval_at(around, w, scaling, scale) if bound < 1.0 else None
        region = region._replace(scaling=scaling)
        if interval is None:
            entry = int(np.argmax(_effects(part, M, scaling)))
            if region.half[entry] < NARROWEST * size:
                return None  # around a mode on the circle, which rounding may hide
            steps.append({"halve": entry})
            regions += region.halves(entry)
        else:
            # to the ends of the region where rounding is left
            begin, end = interval
            low = region.low if begin - region.low <= narrowest else begin
            high = region.high if region.high - end <= narrowest else end
            steps.append({"low": low, "high": high} | _as_step(scaling, len(part.entries)))
            regions += region.outside(low, high)
    return None if regions else steps


def _as_step(scaling: Scaling, entries: int) -> dict[str, list[float]]:
    """D and G as `t` and `g`, rounded: any of them prove what they prove.

    Those of the means alone where the others follow from them, as in `tightened_at`.
    """
    count = len(scaling.t) if scaling.g[entries:].any() else entries
    t, g = ([float(f"{x:.{DIGITS}g}") for x in values[:count]] for values in scaling)
    return {"t": t, "g": g}


def _frequency(region: Region, highest: float) -> float:
    """The frequency of a region to bound: the ends 0 and pi / T, where M is real, first."""
    if region.low == 0.0:
        return 0.0
    return highest if region.high == highest else float(np.sqrt(region.low * region.high))


def _levelled(part: Channels, scale: FloatArray) -> Channels:
    """The channels of a late u so scaled that at the worst frequency one factor of D serves them.

    What changes from tick to tick has the same D at all frequencies, up to a common factor.
    """
    if not part.late:
        return part
    # the means of the entries over a period suffice for the ratios
    k = len(part.entries)
    rows = np.r_[0:k, part.uncertain : len(scale)]
    worst, level = 0.0, np.zeros(part.late)
    for w in np.pi / part.period * np.geomspace(1e-2, 1.0, LEVELLED):
        M = (scale[:, None] * part.response(w, RADIUS))[np.ix_(rows, rows)]
        bound, scaling = tightened(M, k, 0.0)
        if bound > worst:
            worst, level = bound, scaling.t[k : k + part.late]
    size = np.ones(len(scale))
    size[part.uncertain : part.uncertain + part.late] = np.exp(level - level.mean())
    rows = size[:, None]
    return part._replace(W=part.W / size, Z=rows * part.Z, D=rows * part.D / size)


def _effects(part: Channels, M: ComplexArray, scaling: Scaling) -> FloatArray:
    """How far the bound of M falls with the half width of each parameter, up to a factor."""
    scale = np.exp(scaling.t)
    N = scale[:, None] * M / scale
    centre = Centre(np.ones(len(N)), scaling.g[: part.uncertain], np.eye(len(N)))
    level = max((1.0 + STALLED) * centre.bound(N), 1.0)
    P = np.linalg.inv(centre.inequality(N, level))
    effects = np.diag(N @ P @ N.conj().T).real[: part.uncertain]
    return np.bincount(part.parameters, effects).astype(np.float64)
