# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Prove guarantees that hold for every aircraft of a box.

A box is the set of all aircraft whose entries of A and B, and lags of actuators, lie within given
intervals. A guarantee states the deviation up to which the loop is stable, and the disk margins
that remain. It assumes that the deviations are constant in time, and that the loop is linear,
without saturation or rate limits.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flight_analysis.linear_loop.branch_and_bound import levelled, levels_of, proof_of
from flight_analysis.linear_loop.late_sequences import nearest_leaving
from flight_analysis.linear_loop.loop_margins import LAG_ENTRY, MOST_OF_LAG, LinearLoop
from flight_analysis.linear_loop.structured_value import RADIUS
from flight_analysis.linear_loop.uncertain_loop import (
    Box,
    Channels,
    parts_of,
    plants_at,
    uncertain_loop,
)
from flight_analysis.linear_loop.worst_case import first_unstable, worst_in_box
from flight_core.parameters import require
from flight_core.vectors import FloatArray
from rise_di_controller.law.linear_loop import LoopTiming, closed_loop, is_stable

LARGEST = 0.99  # relative deviation up to which the search for an unstable aircraft goes
WIDEST_DISK = 2.0  # a disk of 2 means a phase margin of 90 deg and any gain
# factor by which the deviations of an unstable aircraft grow until the exact loop confirms it
EXACT = 1.002
CONFIRMED = 10  # number of such steps that are tried

# Gaps between the size to prove and the least size that was found too large, as fractions of the
# size to prove. If a proof succeeds with the first of GAPS, FINER_GAPS are tried as well.
GAPS = (0.08, 0.16, 0.32, 0.64, 1.28, 2.56)
FINER_GAPS = (0.04, 0.02, 0.01, 0.005)
ATTACKED = 4  # number of unstable aircraft from which a search for sequences of delays starts
HALVINGS = 3  # how often the distance of two of GAPS is halved
BOXES = 1500  # largest number of steps of a proof for the first gap
FEWER_BOXES = 300  # largest number of steps for the other gaps, and for disks
# The proved deviations are larger than the stated ones by this fraction. It covers the coefficients
# that are left out, and the width that a check by interval arithmetic loses.
SLACK = 2e-3
# The slack if a lag deviates. It is larger, because the coefficients that are left out are larger
# for an actuator. It is a fraction of the half widths of each region, because the same fraction of
# the whole box could exceed the half widths of a small region.
LAG_SLACK = 5e-3
NAMED = 12  # number of digits of the digest that name a certificate


class Unstable(NamedTuple):
    """An unstable aircraft that a search has found."""

    deviation: float  # relative deviation of the entry that deviates most in the box
    frequency: float  # rad/s
    # relative deviation of each entry; an entry that is 0 in the file is given as a part of its row
    entries: dict[str, float]
    # in which inputs u is late by the whole time, tick by tick, if this sequence, repeated, makes
    # the aircraft unstable and no constant delay that was tried does
    late: tuple[tuple[bool, ...], ...] = ()


class Zeros(NamedTuple):
    """Proved deviation of entries that are 0 in the airframe file, while all others are exact."""

    # fraction of its row up to which each of these entries may deviate in a stable aircraft
    stable: float
    # unstable aircraft that deviates least; None if none was found up to LARGEST
    unstable: Unstable | None


class Guarantee(NamedTuple):
    """A guarantee for every aircraft of a box. Deviations are fractions of the nominal entry."""

    uncertainty: float  # largest relative deviation in the box
    stable: float  # every aircraft within this deviation is stable, at most 1
    # unstable aircraft that deviates least; None if none was found up to LARGEST
    unstable: Unstable | None
    # balanced disk margin that every aircraft of the box has at an input, with other loops closed
    disk: dict[str, float]
    disk_all: float  # disk margin with independent disks in all inputs at once
    loop: str  # digest of the loop
    # u is late by an unknown time from 0 to this number, s, and this time changes from tick to tick
    late: float = 0.0
    has_exact_lags: bool = True  # whether no lag of an actuator is in the box
    exact: tuple[str, ...] = ()  # nonzero entries of A and B that are not part of the box
    # fraction of its row up to which each entry that is 0 in the file may deviate, while all other
    # entries deviate by up to `stable`; 0 if such entries stay 0
    zeros: float = 0.0
    zeros_alone: Zeros | None = None  # how far zeros go if the others are exact, if computed
    # "entries" and "steps" of each strongly connected part of the loop, as in `proof_of`, and if u
    # is late "levels": places of its channels as in `Channels.late`, with those of `levels_of`
    proof: Sequence[dict[str, Any]] = ()

    @property
    def is_proved(self) -> bool:
        """Whether every aircraft of the box is proved stable."""
        return self.stable >= self.uncertainty

    @property
    def certificate(self) -> str:
        """Name of the certificate of this guarantee, or "" if nothing is proved."""
        return self.loop[:NAMED] if self.stable else ""

    def as_json(self) -> dict[str, Any]:
        """Return the guarantee as a dict that JSON can hold, without the proof."""
        content = self._asdict() | {"holds": self.is_proved}
        del content["proof"]
        if self.unstable is not None:
            content["unstable"] = self.unstable._asdict()
        if self.zeros_alone is not None:
            unstable = self.zeros_alone.unstable
            content["zeros_alone"] = {
                "stable": self.zeros_alone.stable,
                "unstable": None if unstable is None else unstable._asdict(),
            }
        return content


def loop_guarantee(
    linear: LinearLoop, late: float = 0.0, report: Callable[[str], None] = lambda _: None
) -> Guarantee:
    """Compute the guarantee for the box of a loop.

    The guarantee includes inputs that are late. Each input is late by an unknown time from 0 to
    `late`, s, which can change from tick to tick. The work can take minutes, and `report` is called
    with a sentence at the start of each step. Raises ParameterError if the loop has no box.
    """
    none = _none(linear, late)
    box = linear.box
    assert box is not None  # noqa: S101 - for mypy
    largest = box.largest
    is_lag = _is_lag(box)
    if not _is_nominal_stable(linear):
        return none
    uncertain = uncertain_loop(linear.nominal, linear.law, linear.loop, box, late)
    report("searching for an unstable aircraft")
    found = _unstable(linear, late, LARGEST / float(box.part.max()))
    if 0.0 < late <= linear.loop.period:
        report("searching for a sequence of delays that makes an aircraft unstable")
        for each in found[:ATTACKED]:
            found.append(_leaving(linear, late, each, _nearest(found)))
    first = _nearest(found)
    size = 1.0 / float(box.part.max()) if first is None else first.deviation / largest
    # beyond MOST_OF_LAG nothing can be proved for a lag
    most = MOST_OF_LAG / float(box.part[is_lag].max()) if is_lag.any() else np.inf
    exact = first is None or most < size
    reserve = LAG_SLACK if is_lag.any() else 0.0
    parts = parts_of(uncertain)

    def show(proved: float) -> None:
        report(f"proving every aircraft within {100.0 * largest * proved:.1f} %")

    proved, proof = _proved(
        parts, min(size, most), disks=False, exact=exact, reserve=reserve, show=show
    )
    guarantee = none._replace(
        stable=largest * proved, unstable=first, proof=proof, zeros=box.largest_zero * proved
    )
    if not guarantee.is_proved:
        return guarantee
    disks, disk_all = _disks(linear, uncertain, late, report)
    return guarantee._replace(disk=disks, disk_all=disk_all)


def _none(linear: LinearLoop, late: float) -> Guarantee:
    """Return the guarantee for the box of a loop with which a search starts: nothing is proved.

    The stable deviation and the disk margins are 0. Raises ParameterError if the loop has no box.
    """
    box = linear.box
    require(box is not None, "uncertainty", "0", "an uncertainty above 0 for a guarantee")
    assert box is not None  # noqa: S101 - for mypy
    return Guarantee(
        uncertainty=box.largest,
        stable=0.0,
        unstable=None,
        disk=dict.fromkeys(linear.inputs, 0.0),
        disk_all=0.0,
        loop=linear.digest,
        late=late,
        has_exact_lags=not _is_lag(box).any(),
        exact=_exact_entries(linear, box),
    )


def _is_lag(box: Box) -> NDArray[np.bool_]:
    """Return a mask of the entries of a box that are lags of actuators."""
    return np.array([name.startswith(LAG_ENTRY) for name in box.names], dtype=bool)


def zeros_alone(linear: LinearLoop, late: float = 0.0) -> Zeros | None:
    """Compute how far entries that are 0 in the airframe file may deviate if all others are exact.

    The box of `linear` must have only entries that are 0 in the file. There can be very many of
    them, so search and proof stop early, as in `quick_guarantee`. Returns None if there is no box,
    or if the nominal loop is unstable.
    """
    box = linear.box
    if box is None or not _is_nominal_stable(linear):
        return None
    stable, first, _ = _quick(linear, 1.0 / box.largest, late)
    return Zeros(box.largest * stable, first)


def quick_guarantee(linear: LinearLoop, most: float) -> Guarantee:
    """Compute the guarantee for the box of a loop, enlarged by up to the factor `most`.

    Search and proof stop early, when the proved size is within GAPS[0] of the size that was found
    unstable, and no disk margins are computed. So this takes less than a tenth of the time of
    `loop_guarantee`. Nothing is proved if the nominal loop is unstable. Raises ParameterError if
    the loop has no box.
    """
    none = _none(linear, 0.0)
    if not _is_nominal_stable(linear):
        return none
    size, first, proof = _quick(linear, most, 0.0)
    return none._replace(stable=none.uncertainty * size, unstable=first, proof=proof)


def _quick(
    linear: LinearLoop, most: float, late: float
) -> tuple[float, Unstable | None, list[dict[str, Any]]]:
    """Search and prove as `quick_guarantee` does.

    Returns the proved size of the box, as a factor on its deviations, the unstable aircraft that
    deviates least, or None if none was found, and the steps of the proof.
    """
    box = linear.box
    assert box is not None  # noqa: S101 - for mypy
    first = _nearest(_unstable(linear, late, LARGEST * most, quick=True))
    size = most if first is None else first.deviation / box.largest
    parts = parts_of(uncertain_loop(linear.nominal, linear.law, linear.loop, box, late))
    proved, proof = _proved(parts, size, disks=False, exact=first is None, finer_gaps=())
    return proved, first, proof


def _is_nominal_stable(linear: LinearLoop) -> bool:
    still = np.zeros(len(linear.inputs))
    return is_stable(linear.nominal, linear.law, linear.loop, still)


def _exact_entries(linear: LinearLoop, box: Box) -> tuple[str, ...]:
    """List the nonzero entries of A and B that are the same in every aircraft of the box."""
    states = linear.states
    moved = (box.E != 0.0).astype(float) @ (box.F != 0.0)
    rows, columns = np.nonzero((linear.nominal.A != 0.0) & (moved == 0.0))
    # the plant can have actuators as further states after those of the aircraft; their rows have
    # lags and no entries of A
    places = [place for place in zip(rows, columns, strict=True) if max(place) < len(states)]
    left_out = [name for name, part in zip(box.names, box.part, strict=True) if not part]
    names = [*left_out, *(f"A[{states[i]},{states[j]}]" for i, j in places)]
    return tuple(dict.fromkeys(names))


def _loops(linear: LinearLoop, late: float) -> list[LoopTiming]:
    """Return two timings of the loop: with u in time, and with every u late by `late`, s."""
    loop = linear.loop
    return [loop._replace(delay=loop.delay + extra) for extra in sorted({0.0, late})]


def _nearest(found: Sequence[Unstable]) -> Unstable | None:
    """Return the unstable aircraft that deviates least, or None if there is none."""
    return min(found, key=lambda unstable: unstable.deviation, default=None)


def _unstable(
    linear: LinearLoop, late: float, largest: float, *, quick: bool = False
) -> list[Unstable]:
    """Search for unstable aircraft up to a size of the box, and sort them by their deviation.

    `largest` is the largest size that is searched, as a factor on the deviations of the box. The
    search is made for two constant delays of u, 0 and `late`, s.
    """
    box = linear.box
    assert box is not None  # noqa: S101 - for mypy
    found = []
    for loop in _loops(linear, late):
        delayed = linear._replace(loop=loop)
        for part in parts_of(uncertain_loop(linear.nominal, linear.law, loop, box)):
            unstable = first_unstable(part, len(box.names), largest, quick=quick)
            found += [_confirmed(delayed, d) for d in unstable]
    return sorted(filter(None, found), key=lambda unstable: unstable.deviation)


def _leaving(
    linear: LinearLoop, late: float, known: Unstable, nearest: Unstable | None
) -> Unstable:
    """Search for an aircraft that deviates less and is unstable with delays that change in time.

    The search looks for a sequence of delays that makes the aircraft unstable. It begins at the
    size of `nearest`, in the direction of the deviations of the unstable aircraft `known`. Returns
    `known` if nothing is found.
    """
    assert nearest is not None  # noqa: S101 - the known one is found
    box = linear.box
    assert box is not None  # noqa: S101 - for mypy
    parts = np.array([known.entries.get(name, 0.0) for name in box.names])
    d = np.divide(parts, box.part, out=np.zeros(len(parts)), where=box.part > 0.0)
    d *= nearest.deviation / known.deviation
    found = nearest_leaving(linear.nominal, linear.law, linear.loop, box, late, d)
    if found is None:
        return known
    frequency = found.frequency / linear.loop.period
    return _as_unstable(box, found.d, frequency)._replace(late=found.late)


def _disks(
    linear: LinearLoop, uncertain: Channels, late: float, report: Callable[[str], None]
) -> tuple[dict[str, float], float]:
    """Return the disk margins that are proved for every aircraft of the box.

    The first result has the margin of each input alone, by the name of the input. The second one is
    the margin for independent disks in all inputs at once.
    """
    box = linear.box
    assert box is not None  # noqa: S101 - for mypy
    report("searching for the aircraft with the least margins")
    loops = _loops(linear, late)
    worst = [worst_in_box(linear.nominal, linear.law, loop, box).worst for loop in loops]
    report("proving the disk margin in all inputs at once")
    places = tuple(range(len(linear.inputs)))
    disk_all = _disk(uncertain, places, min(float(least.disk_all) for least in worst))
    disks = {}
    for i, name in enumerate(linear.inputs):
        report(f"proving the disk margin of {name}")
        least_found = min(float(least.disk[i]) for least in worst)
        # disks in all inputs at once include a disk in one input
        disks[name] = max(_disk(uncertain, (i,), least_found), disk_all)
    return disks, disk_all


def _disk(loop: Channels, inputs: tuple[int, ...], least: float) -> float:
    """Return the disk margin in `inputs` that is proved for every aircraft of the box.

    `least` is the least disk margin that a search over the box has found.
    """
    return _proved(parts_of(loop, inputs), min(least, WIDEST_DISK), disks=True)[0]


def _proved(
    parts: list[Channels],
    least: float,
    *,
    disks: bool,
    exact: bool = False,
    finer_gaps: Sequence[float] = FINER_GAPS,
    reserve: float = 0.0,
    show: Callable[[float], None] = lambda _: None,
) -> tuple[float, list[dict[str, Any]]]:
    """Find the largest size below `least` that can be proved, and return it with its proof.

    The size is a factor on the deviations of the box. If `disks` is True, the size is the size of
    the disks, and the deviations cover the whole box. The result is 0 if no size is proved. `least`
    is a size that a search has found too large. If `exact` is True, the search has found no such
    size, so `least` itself may be provable and is tried first. Without `finer_gaps` the first size
    that is proved is the result. `show` gets each size before its proof is tried.
    """

    def proof_at(gap: float, most: int) -> list[dict[str, Any]] | None:
        size = least / (1.0 + gap)
        show(size)
        return _proof(parts, size, most, disks=disks, reserve=reserve)

    failed = 0.0
    for proved in (*(0.0,) * exact, *GAPS):
        proof = proof_at(proved, FEWER_BOXES if disks or proved > GAPS[0] else BOXES)
        if proof is not None:
            break
        failed = proved
    else:
        return 0.0, []
    for finer in finer_gaps if proved == GAPS[0] else ():
        if sum(len(part["steps"]) for part in proof) > FEWER_BOXES:
            break
        tighter = proof_at(finer, FEWER_BOXES)
        if tighter is None:
            break
        proof, proved = tighter, finer
    for _ in range(HALVINGS if finer_gaps and proved > GAPS[0] else 0):
        between = (failed + proved) / 2.0
        tighter = proof_at(between, FEWER_BOXES)
        if tighter is None:
            failed = between
        else:
            proof, proved = tighter, between
    return least / (1.0 + proved), proof


def _proof(
    parts: list[Channels], size: float, most: int, *, disks: bool, reserve: float
) -> list[dict[str, Any]] | None:
    """Prove each part of the loop for a size, or return None if `most` steps are not enough.

    If `reserve` is 0, the proof covers deviations that are larger than the size by the fraction
    SLACK. If `reserve` is not 0, the half widths of each region are larger by the fraction
    `reserve`, and SLACK is not used.
    """
    proof = []
    whole = size if reserve else (1.0 + SLACK) * size
    for part in parts:
        deviation, disk = (1.0, size) if disks else (whole, 0.0)
        levels = levels_of(part, deviation, disk) if part.late else np.zeros(0)
        steps = proof_of(levelled(part, levels), deviation, disk, most, reserve)
        if steps is None:
            return None
        most -= len(steps)
        proved: dict[str, Any] = {"entries": list(part.entries), "steps": steps}
        if part.late:
            half = len(part.late) // 2
            proved["levels"] = list(zip(part.late[:half], levels[:half].tolist(), strict=True))
        proof.append(proved)
    return proof


def _confirmed(linear: LinearLoop, d: FloatArray) -> Unstable | None:
    """Confirm that the aircraft with deviations d is unstable, or return None.

    The search that found the aircraft has left out small terms, so the exact loop may still be
    stable at d. In this case d is enlarged a little, up to CONFIRMED times.
    """
    box = linear.box
    assert box is not None  # noqa: S101 - for mypy
    still = np.zeros(len(linear.inputs))
    for _ in range(CONFIRMED):
        aircraft = plants_at(linear.nominal, box, d)
        z = np.linalg.eigvals(closed_loop(aircraft, linear.law, linear.loop, still))
        worst = z[int(np.argmax(np.abs(z)))]
        if abs(worst) > RADIUS:
            turn = abs(np.angle(worst))
            return _as_unstable(box, d, turn / linear.loop.period)
        d = EXACT * d
    return None


def _as_unstable(box: Box, d: FloatArray, frequency: float) -> Unstable:
    """Describe the aircraft with deviations d and an unstable mode at `frequency`, rad/s."""
    entries = {
        name: float(part) for name, part in zip(box.names, d * box.part, strict=True) if part
    }
    return Unstable(float(np.abs(d).max()) * box.largest, frequency, entries)
