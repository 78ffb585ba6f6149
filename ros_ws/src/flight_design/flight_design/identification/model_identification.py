# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Identify A and B of an aircraft from the log of one flight.

The estimate maximises the posterior probability, given the innovations of the observer's filter.

It uses y, and u after the limits of u, and no other signal. Two of three seconds fit the model, and
every third second is held out to validate it. y does not show the scale of alpha or beta, so
entries that depend on this scale stay near their nominal values. No number in this module is
specific to an aircraft.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import chain, count
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.uncertainty import AIR_RELATIVE, as_yaml, wind_factors
from control_laws.nominal_model import NominalModel
from flight_analysis.closed_loop.learning_loop import Entry
from flight_core.files import comment
from flight_core.outcome import Refusal, joined
from flight_core.parameters import require
from flight_core.vectors import FloatArray
from flight_design.gains.ideal_control import ChannelPairing
from flight_design.identification.innovation_filters import (
    LEVELS,
    TRANSIENT,
    Actuation,
    Block,
    FlightData,
    blocks,
    filter_model,
    in_rolling_air,
    whole_aircraft,
)
from flight_design.identification.likelihood import (
    FEW,
    KNOWN,
    PRIOR,
    Fit,
    Innovations,
    Unknown,
)
from flight_design.identification.likelihood_search import (
    REFINED,
    SIGNS,
    START_STEPS,
    STARTS,
    STEPS,
    Doubt,
    Search,
)
from flight_design.identification.model_quality import (
    MAX_WHITENESS,
    Prediction,
    advantage,
    correlation,
    prediction,
    reason_against_prediction,
)
from flight_design.identification.model_refusals import (
    Coupling,
    at_bound,
    entries_without,
    reason_against_airframe,
    reason_against_excitation,
    reason_against_signs,
    reason_against_timing,
)
from flight_design.identification.spans import held_out, span_length

# The innovations of a part follow the u of another part if their `correlation` is at least this. It
# is up to 3 for aircraft without coupling.
FOLLOWS = 10.0
# Least gain in the log-likelihood of held-out samples for which a model with coupling is taken. The
# gain is -20 for aircraft without coupling.
COUPLED_GAIN = 20.0
# largest number of further searches about the last result; each of them allows another factor of
# 2.5
AGAIN = 2


class Part(NamedTuple):
    """The model of a group of states and inputs that does not couple with the rest."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    entries: tuple[Entry, ...]
    before: Prediction  # prediction by the nominal model
    after: Prediction  # prediction by the identified model
    refusal: Refusal | None  # why this part must not be used
    latest: tuple[float, ...]  # s, the delay of each input plus two standard deviations
    has_gusts: bool  # whether the share of its spans with gusts is FEW or more
    delays: tuple[float, ...] = ()  # s, the delay of each input
    # advantage of the model in flight over the nominal one, see `identify_model`
    advantage: float = 0.0
    wind: float = 0.0  # level of the wind in most of its spans, relative to moderate turbulence
    # part of each entry's deviation that comes from an uncertain delay
    by_timing: tuple[float, ...] = ()
    # part of each entry's deviation that is added because the model may be wrong
    by_model: tuple[float, ...] = ()
    # difference of each entry from the same entry of a second model, by `rates_model.doubted`; ()
    # if there is none
    by_motion: tuple[float, ...] = ()


def reason_against_innovations(part: Part) -> Refusal | None:
    """Return a refusal of a part if innovations are too far from white noise, else None.

    The output with the largest `whiteness` decides. The whiteness is 1 for white noise, and must be
    at most MAX_WHITENESS.
    """
    worst = int(np.argmax(part.after.whiteness))
    white = float(part.after.whiteness[worst])
    if white <= MAX_WHITENESS:
        return None
    name = part.outputs[worst]
    return Refusal(
        f"innovations of {name}: found a whiteness of {white:.3g}, expected at most "
        f"{MAX_WHITENESS:g}, 1 being white"
    )


class Identification(NamedTuple):
    """The model of an aircraft that was identified from one flight."""

    airframe: Airframe
    recorded: FlightData
    held_out: NDArray[np.bool_]  # (T,) mask of the samples that validate the model
    # (T, m) each, units of y: innovations of the nominal model, and of the identified model
    innovations: tuple[FloatArray, FloatArray]
    before: Prediction
    after: Prediction
    parts: tuple[Part, ...]
    remarks: tuple[Refusal, ...] = ()  # what else the record contradicts, such as the file

    @property
    def entries(self) -> tuple[Entry, ...]:
        """The identified entries of A and B in all parts."""
        return tuple(chain.from_iterable(part.entries for part in self.parts))

    @property
    def refusal(self) -> Refusal | None:
        """Reason why this model must not be used, with one sentence for each refused part."""
        return joined(part.refusal for part in self.parts)


class _Study(NamedTuple):
    """The data and settings that the searches for all parts of the aircraft share."""

    recorded: FlightData
    airframe: Airframe
    actuation: Actuation
    unknown: Unknown
    validating: NDArray[np.bool_]  # (T,)
    # (T,) samples on which the model in flight is compared with the nominal model
    later: NDArray[np.bool_]
    channels: ChannelPairing
    bound_count: int  # number of entries that may lie at a bound
    searches_again: bool
    timing: float | None  # s, deviation of the delay; if None, no doubt is added (`with_doubt`)
    is_doubted: bool  # whether doubt is added to the deviations that are stated, after all refusals
    step: Callable[[], None]

    def search(self, model: NominalModel, block: Block, *, coupled: bool = False) -> Search:
        """Set up the search for the model of a block."""
        search = Search(
            recorded=self.recorded,
            model=model,
            block=block,
            airframe=self.airframe,
            delay=self.actuation.delay,
            unknown=self.unknown,
            coupled=coupled,
            rates=self.actuation.rate_limit,
        )
        search.progress = self.step
        return search

    def part(self, search: Search, fit: Fit) -> Part:
        """Return the model of a block, with the reason why it must not be used, if there is any."""
        outputs = search.names.outputs
        before = prediction(fit.before, self.validating)
        after = prediction(fit.after, self.validating)
        by_timing = np.zeros(search.count)
        if self.timing is not None:
            fit, by_timing = search.with_doubt(fit, Doubt(self.timing, after.whiteness))
        entries = search.entries(fit)
        stated = entries
        if self.is_doubted:
            doubted, _ = search.with_doubt(fit, Doubt(0.0, after.whiteness, leaves_out=True))
            widest = np.maximum(doubted.deviation, fit.deviation)
            stated = search.entries(fit._replace(deviation=widest))
        # Behind a filter of y, a weaker effect with a shorter lag gives the same loop. So an effect
        # counts as known if it would be known once the lags were known.
        in_phase = np.hypot(by_timing, search.in_errors(fit, fit.by_lag)).tolist()
        identified = with_entries(self.airframe, entries)
        reasons = (
            self.reason_against_airframe(search.about_centre(entries)),
            search.reason_against_air(fit),
            reason_against_timing(entries, by_timing.tolist(), outputs),
            reason_against_excitation(entries_without(entries, in_phase), outputs),
            reason_against_signs(self.airframe, identified, self.channels),
            reason_against_prediction(before, after, outputs),
        )
        delays, deviations = search.delays(fit)
        has_gusts = bool(np.mean(LEVELS[fit.levels, 1] > 0.0) >= FEW)
        return Part(
            inputs=search.names.inputs,
            outputs=outputs,
            entries=tuple(stated),
            before=before,
            after=after,
            refusal=next(filter(None, reasons), None),
            latest=tuple((delays + 2.0 * deviations).tolist()),
            has_gusts=has_gusts,
            delays=tuple(delays.tolist()),
            advantage=0.0 if fit.flown is None else self.advantage(fit.flown, fit.before),
            wind=float(LEVELS[np.bincount(fit.levels).argmax(), 0]),
            by_timing=tuple(by_timing.tolist()),
            by_model=tuple(
                math.sqrt(max(wide.deviation**2 - entry.deviation**2, 0.0))
                for wide, entry in zip(stated, entries, strict=True)
            ),
        )

    def identification(
        self,
        airframe: Airframe,
        parts: Sequence[Part],
        first: Innovations,
        last: Innovations,
    ) -> Identification:
        """Join the parts to one model, with innovations of the nominal and the identified model."""
        return Identification(
            airframe=with_entries(airframe, chain.from_iterable(part.entries for part in parts)),
            recorded=self.recorded,
            held_out=self.validating,
            innovations=(first.r, last.r),
            before=prediction(first, self.validating),
            after=prediction(last, self.validating),
            parts=tuple(parts),
        )

    def again(
        self, search: Search, fit: Fit, used: NDArray[np.bool_], flown: Airframe | None
    ) -> Fit:
        """Search again around a fit in which too many entries are at a bound.

        The entries may be at their bounds because the airframe file is rough. There is no further
        search if the effect of an input is at a bound, for two reasons. No law designed from the
        file can fly an aircraft beyond these bounds. Besides, the block may couple with another
        block of the aircraft.
        """
        for _ in range(AGAIN * self.searches_again):
            entries = search.about_centre(search.entries(fit))
            found = at_bound(entries, self.unknown.factor)
            is_inside = self.reason_against_airframe(entries) is None
            if is_inside or any(entry.matrix == "B" for entry in found):
                break
            also = None if flown is None else search.model_errors(flown)
            fit = search.fit_about(fit, used, also)
        return fit

    def reason_against_airframe(self, entries: Sequence[Entry]) -> Refusal | None:
        """Return a refusal of the airframe if too many entries are at a bound, else None."""
        return reason_against_airframe(
            entries, self.airframe.name, self.bound_count, self.unknown.factor
        )

    def fit(
        self,
        search: Search,
        used: NDArray[np.bool_],
        flown: Airframe | None,
        *,
        quick: bool,
    ) -> tuple[Fit, Part]:
        """Find the most probable theta of a block, and return the fit with the model.

        If `quick`, `Search.fit_alike` is tried first, and its fit is taken if its model may be
        used.
        """
        also = None if flown is None else search.model_errors(flown)
        quick_fit = search.fit_alike(used, also) if quick else None
        if quick_fit is not None:
            part = self.part(search, quick_fit)
            if not part.refusal and part.after.whiteness.max() <= MAX_WHITENESS:
                return quick_fit, part
        fit = self.again(search, search.fit(used, flown=also), used, flown)
        return fit, self.part(search, fit)

    def whole(
        self,
        model: NominalModel,
        fits: Sequence[tuple[Search, Fit]],
        used: NDArray[np.bool_],
        apart: Innovations,
        flown: Airframe | None,
    ) -> tuple[Fit, Part] | Coupling | None:
        """Fit the whole aircraft as one part, with entries that couple its parts.

        Returns a refusal of the separate parts if the innovations of this fit are not white, or if
        its model must not be used. Returns None if the model with coupling predicts no better than
        the parts that were fitted separately, whose innovations are `apart`. The fit also has the
        innovations of the model in flight, `flown`.
        """
        search = self.search(model, whole_aircraft(model), coupled=True)
        also = None if flown is None else search.model_errors(flown)
        fit = search.fit(used, begin=search.joined(fits), flown=also)
        fit = self.again(search, fit, used, flown)
        part = self.part(search, fit)
        if reason := part.refusal or reason_against_innovations(part):
            return Coupling(
                "coupling: found innovations of a part that follow the inputs of another part, "
                f"expected a common model of both, which was refused: {reason}"
            )
        gain = part.after.log_likelihood - prediction(apart, self.validating).log_likelihood
        return (fit, part) if gain * self.validating.sum() > COUPLED_GAIN else None

    def advantage(self, flown: Innovations, nominal: Innovations) -> float:
        """Return how much better the model in flight predicts the samples in the mask `later`.

        The result is the `advantage` over the nominal model, in standard deviations.
        """
        return advantage(flown, nominal, span_length(self.recorded), self.later)


def identify_model(
    recorded: FlightData,
    airframe: Airframe,
    actuation: Actuation,
    channels: ChannelPairing | None = None,
    progress: Callable[..., None] = lambda **_: None,
    bound_count: int = 0,
    unknown: Unknown = KNOWN,
    flown: Airframe | None = None,
    *,
    after: float = -np.inf,
    quick: bool = False,
    searches_again: bool = False,
    timing: float | None = None,
    is_doubted: bool = False,
) -> Identification:
    """Identify the model of a flight. If the model must not be used, the result says why.

    Args:
        recorded: The flight.
        airframe: The nominal airframe.
        actuation: Lags, delay and rate limits between u and the aircraft.
        channels: Channels in the law's order, whose D the model must keep; by default they are in
            the airframe's order.
        progress: Takes the steps `completed` and their largest number `total`.
        bound_count: How many entries of a part may lie at their bound. A part is a group of states
            and inputs that does not couple with the rest.
        unknown: Prior standard deviations of all that is identified, such as delays.
        flown: The model in flight. It is one more start of the search, and its advantage over the
            nominal model is computed.
        after: The advantage is computed from samples after this flight time, s.
        quick: Whether a single start is tried first. Its result is kept if the air is alike in the
            spans, and if the model that is found may be used. If not, more starts follow.
        searches_again: Whether a part with too many entries of A at their bounds is searched again,
            around the result of the first search.
        timing: Standard deviation of the delay in `actuation`, s. If it is given, even as 0, the
            standard deviations of the result also hold for a model that is not right
            (`Search.with_doubt`).
        is_doubted: Whether the stated deviations also hold for a model that is not right. The
            refusals do not use these deviations, but they use those that `timing` widens.

    Raises:
        ParameterError: An output does not move.
    """
    blown = in_rolling_air(airframe)
    model = filter_model(blown, actuation, recorded)
    is_known = np.isfinite(recorded.y).all(axis=1) & (recorded.t >= recorded.t[0] + TRANSIENT)
    _require_motion(airframe.outputs, recorded.y[is_known])
    validating = is_known & held_out(len(recorded.t), span_length(recorded))
    used = is_known & ~validating
    every = blocks(model)
    study = _Study(
        recorded=recorded,
        airframe=blown,
        actuation=actuation,
        unknown=unknown,
        validating=validating,
        later=is_known & (recorded.t > after),
        channels=channels or ChannelPairing(airframe.outputs, tuple(airframe.inputs)),
        bound_count=bound_count,
        searches_again=searches_again,
        timing=timing,
        is_doubted=is_doubted,
        step=_counter(progress, len(every), starts_at_flown=flown is not None),
    )
    searches = [study.search(model, block) for block in every]
    fitted = [study.fit(search, used, flown, quick=quick) for search in searches]
    fits = [(search, fit) for search, (fit, _) in zip(searches, fitted, strict=True)]
    parts = [part for _, part in fitted]
    first = join_innovations([fit.before for _, fit in fits], every)
    last = join_innovations([fit.after for _, fit in fits], every)
    coupled = flown if flown is not None and _has_new_coupling(flown, airframe) else None
    if coupled is not None:
        search = study.search(model, whole_aircraft(model), coupled=True)
        by_flown = search.flying(search.model_errors(coupled), fits)
        z = study.advantage(by_flown, first)
        parts = [part._replace(advantage=z) for part in parts]
    if len(every) > 1 and _follows(fits, every, recorded.u, is_known) > FOLLOWS:
        whole = study.whole(model, fits, used, last, coupled)
        if isinstance(whole, Coupling):
            parts = _unless_white(parts, whole)
        elif whole is not None:
            fit, part = whole
            parts = [part]
            first = fit.before
            last = fit.after
    return study.identification(airframe, parts, first, last)


def _counter(
    progress: Callable[..., None], parts: int, *, starts_at_flown: bool
) -> Callable[[], None]:
    """Return a function that counts the steps of all searches and reports them to `progress`.

    `starts_at_flown` says whether the model in flight is one more start.
    """
    starts = len(STARTS) + len(SIGNS) + starts_at_flown
    total = parts * (starts * START_STEPS + REFINED * STEPS)
    if parts > 1:
        total += START_STEPS + STEPS
    steps = count(1)

    def step() -> None:
        progress(completed=next(steps), total=total)

    return step


def _follows(
    fits: Sequence[tuple[Search, Fit]],
    every: Sequence[Block],
    u: FloatArray,
    known: NDArray[np.bool_],
) -> float:
    """Return how strongly the innovations of a block follow the u of another block, u (T, m).

    The result is the largest `correlation` of all pairs of blocks.
    """
    largest = 0.0
    for (_, fit), block in zip(fits, every, strict=True):
        of_others = np.delete(u, block.inputs, axis=1)
        largest = max(largest, correlation(fit.after.normalised, of_others, known).max())
    return largest


def _unless_white(parts: list[Part], refusal: Coupling) -> list[Part]:
    """Return the parts with a refusal, unless the innovations of all parts are white.

    If they are white, the parts explain the record without a coupling.
    """
    if not any(reason_against_innovations(part) for part in parts):
        return parts
    return [part._replace(refusal=refusal) for part in parts]


def _has_new_coupling(flown: Airframe, nominal: Airframe) -> bool:
    """Return whether a model couples states that do not couple in the nominal model.

    This is so if an entry of A or B is not zero where the nominal entry is zero.
    """
    new, old = (np.hstack([model.matrix_a(), model.matrix_b()]) for model in (flown, nominal))
    return bool(np.any((new != 0.0) & (old == 0.0)))


def _require_motion(outputs: Sequence[str], y: FloatArray) -> None:
    """Raise ParameterError for an output that never changes in y, (T, m)."""
    still = [name for name, values in zip(outputs, y.T, strict=True) if not np.diff(values).any()]
    expected = "outputs that move, or the noise of their sensors"
    require(not still, "record", f"a constant {', '.join(still)}", expected)


def with_entries(airframe: Airframe, entries: Iterable[Entry]) -> Airframe:
    """Put identified entries into an airframe. The wind acts through the new A."""
    A = airframe.matrix_a()
    B = airframe.matrix_b()
    for entry in entries:
        row = airframe.index(entry.row)
        if entry.matrix == "A":
            A[row, airframe.index(entry.column)] = entry.value
        else:
            B[row, list(airframe.inputs).index(entry.column)] = entry.value
    return airframe.with_matrices(A, B, wind_factors(airframe, A[None], AIR_RELATIVE)[0])


def join_innovations(parts: Sequence[Innovations], blocks: Sequence[Block]) -> Innovations:
    """Join the innovations of the blocks to the innovations of all outputs."""
    order = np.argsort(np.concatenate([block.outputs for block in blocks]))
    r = np.concatenate([part.r for part in parts], axis=1)[:, order]
    normalised = np.concatenate([part.normalised for part in parts], axis=1)[:, order]
    return Innovations(r, normalised, np.sum([part.log_likelihood for part in parts], axis=0))


def model_yaml(identified: Identification, origin: str) -> str:
    """Write the identified airframe as the text of an airframe file.

    The header has the origin, the figures of the held-out samples, and the standard deviations of
    the entries.
    """
    lines = [f"The airframe {identified.airframe.name}, with A and B identified from {origin}.", ""]
    lines.append(
        "Held-out samples, one of three seconds: rms of the innovations in SI, whiteness (1 is "
        "white)"
    )
    for name, predicted in (("nominal", identified.before), ("identified", identified.after)):
        figures = zip(identified.airframe.outputs, predicted.rms, predicted.whiteness, strict=True)
        lines.append(
            f"  {name}: "
            + ", ".join(f"{output} {rms:.3g}, {white:.3g}" for output, rms, white in figures)
        )
    lines += [
        "",
        (
            f"Changes of entries and their standard deviations in %, {100 * PRIOR:g} before the "
            "flight:"
        ),
    ]
    lines += [
        f"  {entry.name}: {100 * entry.error:+.1f}, {100 * entry.deviation:.1f}"
        for entry in identified.entries
        if entry.nominal
    ]
    if between := [entry for entry in identified.entries if not entry.nominal]:
        lines += [
            "",
            (
                "Entries between parts that do not couple in the nominal airframe, and their "
                "standard deviations, SI:"
            ),
        ]
        lines += [
            f"  {entry.name}: {entry.value:.3g}, {entry.unit * entry.deviation:.3g}"
            for entry in between
        ]
    return comment(lines) + as_yaml(identified.airframe)
