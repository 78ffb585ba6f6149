# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Keep the record of a learner: y, u and the flown parameters in the ticks of the last seconds."""

from collections import deque
from collections.abc import Collection
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.airframes.airspeed import Exponents
from flight_analysis.closed_loop.learning_loop import Entry
from flight_core.rates import nanoseconds, seconds
from flight_core.vectors import FloatArray
from flight_design.identification.innovation_filters import FlightData
from rise_di_controller.learning import divergence
from rise_di_controller.rise_di_config import RiseDiConfig

# Largest rms deviation of the airspeed from its mean, relative to this mean, in a record at one
# speed. The effects of the surfaces then vary by 4 %.
SPREAD = 0.02


class Sample(NamedTuple):
    """A tick in the record, with y and u in the law's order."""

    stamp_ns: int
    y: FloatArray  # (m,)
    u: FloatArray  # (m,) inputs after their limits
    flown: int  # digest of the parameters in use in this tick


class FlightRecord:
    """The last samples of a flight, within a window."""

    def __init__(self, controller: RiseDiConfig, airframe: Airframe, window: float) -> None:
        """Make an empty record that covers a window of `window` s.

        Samples come in the controller's order, and recordings are in the airframe's order.
        """
        self._rows = [controller.outputs.index(name) for name in airframe.outputs]
        self._columns = [controller.inputs.index(name) for name in airframe.inputs]
        self._least = divergence.least(controller.outputs)
        self._window_ns = nanoseconds(window)
        self._samples = deque[Sample]()
        self.period = 1.0 / controller.rate

    @property
    def end_ns(self) -> int:
        """Stamp of the last sample, or 0 if there is no sample."""
        return self._samples[-1].stamp_ns if self._samples else 0

    @property
    def flown(self) -> int | None:
        """Digest of the parameters in use in the last sample, or None if there is no sample."""
        return self._samples[-1].flown if self._samples else None

    @property
    def length(self) -> float:
        """Time that the record covers, including lost ticks, s."""
        if not self._samples:
            return 0.0
        return seconds(self.end_ns - self._samples[0].stamp_ns) + self.period

    def take(self, sample: Sample) -> None:
        """Take a sample if it is later than the last, and forget samples before the window."""
        if not self._samples or sample.stamp_ns > self.end_ns:
            self._samples.append(sample)
        while sample.stamp_ns - self._samples[0].stamp_ns >= self._window_ns:
            self._samples.popleft()

    def forget_before(self, stamp_ns: int) -> None:
        """Forget all samples up to an instant."""
        self._samples = deque(self._after(stamp_ns))

    def recording(self, after_ns: int = -1) -> FlightData:
        """Return the record after an instant in equal periods, in the airframe's order.

        In a lost tick, y is NaN and u is held.
        """
        record = self._after(after_ns)
        stamp_ns = np.array([sample.stamp_ns for sample in record])
        place = np.round((stamp_ns - stamp_ns[0]) * 1e-9 / self.period).astype(int)
        place, first_places = np.unique(place, return_index=True)
        y = np.array([sample.y for sample in record])[first_places]
        u = np.array([sample.u for sample in record])[first_places]
        t = seconds(int(stamp_ns[0])) + self.period * np.arange(place[-1] + 1)
        padded_y = np.full((len(t), y.shape[1]), np.nan)
        padded_y[place] = y
        held = u[np.searchsorted(place, np.arange(len(t)), side="right") - 1]
        return FlightData(self.period, t, padded_y[:, self._rows], held[:, self._columns])

    def has_fallen_back(self, after_ns: int, proposals: Collection[int]) -> bool:
        """Return whether the law fell back after an instant, because a proposal failed.

        This is so if the parameters changed, and the new parameters are no proposal. `proposals`
        has the digests of the proposals.
        """
        flown = [sample.flown for sample in self._after(after_ns)]
        return any(new != old and new not in proposals for old, new in pairwise(flown))

    def has_oscillated(self, after_ns: int) -> bool:
        """Return whether an output oscillated during the whole time after an instant."""
        y = np.array([sample.y for sample in self._after(after_ns)])
        return bool(divergence.oscillating(y, self._least).any())

    def _after(self, stamp_ns: int) -> list[Sample]:
        return [sample for sample in self._samples if sample.stamp_ns > stamp_ns]


def steady_end(recorded: FlightData, airframe: Airframe) -> tuple[FlightData, float]:
    """Return the longest end of a record with a steady airspeed, and this airspeed over V0.

    The airspeed is steady if its rms deviation from the mean is at most SPREAD of the mean. The
    relative change of the surfaces' effects is then twice as large, and a linear model still holds.
    """
    V = recorded.y[:, airframe.outputs.index("V")] / airframe.speed
    known = np.isfinite(V)[::-1]
    ratio = np.where(known, 1.0 + V[::-1], 0.0)
    count = np.maximum(np.cumsum(known), 1)
    mean = np.cumsum(ratio) / count
    square = np.cumsum(ratio**2) / count - mean**2
    length = int(np.flatnonzero(square <= (SPREAD * mean) ** 2)[-1]) + 1
    first = len(V) - length
    return recorded._replace(
        t=recorded.t[first:], y=recorded.y[first:], u=recorded.u[first:]
    ), float(mean[length - 1])


def about(recorded: FlightData, airframe: Airframe, x: FloatArray, u: FloatArray) -> FlightData:
    """Return a record as deviations from a given trim, in the airframe's order.

    In this trim the aircraft has the state x, (n,), and the inputs u, (m,).
    """
    return recorded._replace(y=recorded.y - airframe.matrix_c() @ x, u=recorded.u - u)


def at_trim(
    entries: tuple[Entry, ...], airframe: Airframe, powers: Exponents, ratio: float
) -> tuple[Entry, ...]:
    """Convert entries of A and B from another speed to the trim speed.

    `ratio` is the other speed divided by the trim speed. The relative errors and deviations stay.
    """
    states = list(airframe.states)
    columns = {"A": states, "B": list(airframe.inputs)}
    factors = [
        ratio
        ** getattr(powers, entry.matrix)[
            states.index(entry.row), columns[entry.matrix].index(entry.column)
        ].item()
        for entry in entries
    ]
    return tuple(
        entry._replace(nominal=entry.nominal / factor, unit=entry.unit / factor)
        for entry, factor in zip(entries, factors, strict=True)
    )
