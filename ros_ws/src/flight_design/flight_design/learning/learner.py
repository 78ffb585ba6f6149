# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Learn in the air: identify A and B from the last seconds of a flight, check them, and design.

The function `model_identification.identify_model` identifies A and B, as it does for a log. The
identification begins with a rough airframe. The design is an observer and a feedforward. If a check
fails, a sentence says why the model is refused. The controller checks the parameters again when it
loads them, and may refuse them.
"""

from collections import deque
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import NamedTuple

import numpy as np

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.airframes.airspeed import at_speed, exponents, level_flight
from flight_analysis.closed_loop.learning_loop import Entry, LearnerResult
from flight_core.outcome import Refusal, joined
from flight_core.parameters import ParameterError, require
from flight_core.rates import nanoseconds, seconds
from flight_core.text import sentences
from flight_core.vectors import FloatArray
from flight_design.gains.ideal_control import ChannelPairing
from flight_design.gains.observer_search import SelectedObserver
from flight_design.identification.innovation_filters import DRIFT, TRANSIENT, Actuation, FlightData
from flight_design.identification.likelihood import KNOWN, Unknown
from flight_design.identification.model_identification import (
    Identification,
    identify_model,
    reason_against_innovations,
    with_entries,
)
from flight_design.learning.change_test import RECORD, Change, change_test
from flight_design.learning.designs import (
    Design,
    DesignOfFile,
    Known,
    LearnedLoop,
    by_law_of_start,
    goal,
    is_late,
    price,
    with_deviations,
    with_flown_channels,
)
from flight_design.learning.file_test import AT_BOUND, identified_within
from flight_design.learning.flight_record import (
    SPREAD,
    FlightRecord,
    Sample,
    about,
    at_trim,
    steady_end,
)
from flight_design.learning.part_checks import (
    change_sentence,
    effect_sentence,
    entries_of_file,
    forgotten_coupling,
    is_file_better,
    is_within,
    reason_against_delays,
    reason_against_effects,
    reason_against_first_model,
    reason_against_part_alone,
    return_to_file,
    without_effect,
)
from rise_di_controller.learning.learned_channels import (
    outputs_given_up,
    without_models,
)
from rise_di_controller.learning.proposals import UNVERIFIED
from rise_di_controller.rise_di_config import RiseDiConfig

# s, shortest record: it has two held-out seconds, and `identify log` requires six
SHORTEST = 20.0 * TRANSIENT
# s from a fallback to the next identification, whose record shows the parameters used after it
AFTER_FALLBACK = 4.0
# s, from one identification to an unplanned one; also the length of a record tested for oscillation
RETRY = 10.0
# Gain of log-likelihood that finds a change after a fallback. Dead surfaces had 46 to 656.
SURE_GAIN = 40.0

PartName = tuple[str, ...]
"""The outputs of a part of the aircraft that does not couple with the rest."""


class Verdict(NamedTuple):
    """The model in use after an identification, and sentences about the parts of this model."""

    model: Airframe  # the model in flight if no part has a new model
    known: dict[PartName, Known]
    sentences: list[str]
    refusals: list[Refusal]
    tried: Airframe  # `model`, with first models of parts that later samples must prove


class Learner:
    """The record of y and u over a window, and the designs that are proposed from it.

    The parts of the aircraft (outputs that couple with no other part) are learned one by one. A
    part without a learned model is controlled by the design for the airframe file, which allows for
    errors, or by the initial law of the flight.
    """

    def __init__(
        self,
        controller: RiseDiConfig,
        airframe: Airframe,
        design: Design,
        actuation: Actuation,
        rough: Unknown = KNOWN,
        design_of_rough: DesignOfFile | None = None,
        *,
        quick: bool = False,
    ) -> None:
        """Make a learner with an empty record.

        `airframe` is the rough model, the prior. The delay in `actuation` is the delay of the loop
        beyond sampling and lags. `design_of_rough` makes a design for the rough model that allows
        for its errors. It is in use from the start, and later in the parts without a learned model.
        If `design_of_rough` is None, the initial law of the flight controls these parts.

        `rough` has the standard deviations of A and B in the rough model. It also has the noise of
        the disturbances, which a test for a change uses as well. With `quick`, an identification
        begins with a single start (`identify_model`), and no guarantee is proved.
        """
        settings = controller.learn
        assert settings is not None  # noqa: S101 - `scenario_learner.learner` makes no other
        self._controller = controller
        self._rough = airframe
        self._design = design
        # None if the rough model is not used, or after the law fell back from it.
        self._design_of_rough = design_of_rough
        self._has_proposed_rough = False
        self._believed = rough
        self._is_sketch = rough.drift > DRIFT
        self._quick = quick
        self._has_speeds = controller.schedule is not None and bool(controller.schedule.models)
        self._thrust = controller.inputs[controller.outputs.index("V")] if self._has_speeds else ""
        self._actuation = actuation
        self._record = FlightRecord(controller, airframe, settings.window)
        self._window_ns = nanoseconds(settings.window)
        self._latency_ns = nanoseconds(settings.latency)
        self._planned = deque(map(nanoseconds, settings.updates))
        # how much earlier than planned an identification may begin, because y may be old
        self._tolerance_ns = nanoseconds(settings.check / 2.0)
        self._first_ns: int | None = None
        self._prior = airframe  # prior of the next identification
        self._model = airframe  # the model in use
        self._tried = airframe  # the model that the next identification tests
        self._tried_ns = -nanoseconds(RETRY)  # end of the record of the last identification
        self._known: dict[PartName, Known] = {}
        # Parts that the initial law controls for good, each with its dead input, or with None if
        # the outputs are in `learn.without`, which the controller has given up.
        self._dead: dict[PartName, str | None] = {}
        self._start = controller  # with the `learn.without` of the parameters in flight
        # Inputs that had no effect in the last test. In a single test a gust can hide an effect.
        self._suspected: dict[PartName, str] = {}
        self._has_ended = False
        self._give_up(outputs_given_up(controller))
        self._changed: set[PartName] = set()  # parts whose model was identified before a change
        self._last = controller  # the last proposal
        self._proposed = controller.digest()  # digest of the last proposal
        self._proposed_ns = -self._latency_ns  # end of the record of the last proposal
        self._proposals = set[int]()  # digests of all proposals
        self.identification: Identification | None = None  # the last identification
        self.proposed_loop: LearnedLoop | None = None  # loop of the last proposal with a model

    @property
    def model(self) -> Airframe | None:
        """The rough airframe with the learned models of its parts, or None if no part has one."""
        return self._model if self._known else None

    def take(self, stamp_ns: int, y: FloatArray, u: FloatArray, flown: int) -> None:
        """Record a tick: y, and u after its limits, (m,), in the law's order.

        `flown` is the digest of the parameters in use in this tick.
        """
        self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        self._record.take(Sample(stamp_ns, y, u, flown))

    def propose(self, flown: int, given_up: Sequence[str] = ()) -> LearnerResult:
        """Propose parameters for the identified model, or return a sentence that says why not.

        The first proposal needs no record. It is a design for the rough airframe that allows for
        errors. Parts whose models are refused later also use this design. If the controller does
        not take this proposal, or if the law falls back, the initial law of the flight controls
        those parts.

        The last RECORD seconds are tested for a loss of effect. If an input has no effect any more,
        the initial law controls its part without this input. After a loss of effect, older samples
        are left out, and the flown model becomes the prior. If nothing is due, nothing is proposed.
        The result then has a sentence only if a single test has found that an input may have no
        effect.

        While the rough model is in use, the first model of a part is only on trial. The next
        identification proposes it if the samples since then show its advantage over the rough one.

        `flown` is the digest of the parameters in use. If it still differs from the digest of the
        last proposal after the latency, the controller refused the proposal or fell back. Then an
        identification is due. `given_up` has the outputs whose models the controller stopped using.
        They are not proposed again. If no part is left to learn, a sentence says so once.
        """
        is_first = not self._has_proposed_rough
        self._has_proposed_rough = True
        try:
            if is_first and self._design_of_rough is not None and flown == self._proposed:
                return self._rough_proposal()
            return self._proposal(flown, given_up)
        except ParameterError as error:  # no steady airspeed, no motion, or no design
            return LearnerResult(None, str(error))

    def _proposal(self, flown: int, given_up: Sequence[str]) -> LearnerResult:
        """Make the proposal of `propose`. Raises ParameterError if there is none."""
        end_ns = self._record.end_ns
        self._note_given_up(flown, given_up)
        lost = flown != self._proposed
        # The last proposal cannot act any more if the law fell back from the parameters before it.
        has_fallen = self._record.has_fallen_back(self._proposed_ns, self._proposals)
        if lost and end_ns < self._proposed_ns + self._latency_ns and not has_fallen:
            return LearnerResult(None, None)  # the last proposal has yet to act
        self._distrust(lost=lost)
        if is_within(self._controller.outputs, chain.from_iterable(self._dead)) and not lost:
            ended, self._has_ended = self._has_ended, True
            none_left = "no part is left to learn: each lacks an input or has the initial law"
            return LearnerResult(None, None if ended else none_left)
        if changes := self._changes(end_ns):
            return self._damaged(changes, end_ns)
        if not self._is_due(end_ns, lost=lost):
            doubts = [
                f"{name} may have no effect, by one test" for name in self._suspected.values()
            ]
            return LearnerResult(None, "; ".join(doubts) or None)
        return self._learned(end_ns, lost=lost)

    def _learned(self, end_ns: int, *, lost: bool) -> LearnerResult:
        """Identify, and return the proposal. Raises ParameterError if there is none."""
        length = self._record.length
        require(
            length > SHORTEST - self._record.period, "record", f"{length:.3g} s", f"{SHORTEST:g} s"
        )
        self.identification = self._identified()
        verdict = self._verdict(self.identification, lost=lost)
        self._tried = verdict.tried
        self._tried_ns = end_ns
        # after a lost proposal, the next proposal has to leave out the dead inputs again
        leaves_out_again = lost and any(self._dead.values())
        if verdict.model is self._model and not leaves_out_again:
            nothing = Refusal("each part already has the initial law")
            return LearnerResult(None, str(joined(verdict.refusals) or nothing))
        left_out = without_effect(self._dead, self._by_law(self._dead)) if lost else []
        price_text = self._adopt(verdict.model, verdict.known, self._dead)
        refused = [f"refused: {refusal}" for refusal in verdict.refusals]
        told = sentences(*left_out, *verdict.sentences, price_text, *refused)
        guarantee = None
        if not self._quick:
            unlearned = max(self._believed.error, self._believed.effect)
            known = tuple(self._known.values())
            self.proposed_loop = LearnedLoop(self._last, self._model, known, unlearned)
            guarantee = self.proposed_loop.guarantee
        return LearnerResult(self._last, told, guarantee)

    def _damaged(self, changes: Sequence[Change], end_ns: int) -> LearnerResult:
        """Decide on parts that have changed. A part stops using a dead input immediately.

        A changed part without a dead input is identified again, from the record since the change
        and around the flown model.
        """
        self._record.forget_before(end_ns - nanoseconds(RECORD))
        self._prior = self._model
        dead = {change.outputs: change.dead for change in changes if change.dead}
        others = [change for change in changes if not change.dead]
        self._changed |= {change.outputs for change in others}
        weaker_parts = [change_sentence(change) for change in others]
        if not dead:
            return LearnerResult(None, "; ".join(weaker_parts))
        known = {part: value for part, value in self._known.items() if part not in dead}
        try:
            price_text = self._adopt(self._model, known, {**self._dead, **dead})
        except ParameterError as error:
            # Report the loss, although no controller without the input can be proposed.
            self._changed |= set(dead)
            losses = [f"{name} has no effect" for name in dead.values()]
            return LearnerResult(None, "; ".join([*losses, *weaker_parts, f"refused: {error}"]))
        told = sentences(*without_effect(dead, self._by_law(dead)), *weaker_parts, price_text)
        return LearnerResult(self._last, told)

    def _verdict(self, identified: Identification, *, lost: bool) -> Verdict:
        """Decide which parts use new models. `lost` says that the last proposal is not in use."""
        known = dict(self._known)
        model = self._model
        told = list[str]()
        refusals = list(identified.remarks)
        tried = list[Entry]()
        is_about_file = self._prior is self._rough
        flies_file = self._design_of_rough is not None
        is_first = is_about_file and (flies_file or self._is_sketch)
        for part in identified.parts:
            if any(
                is_within(part.outputs, outputs) or is_within(outputs, part.outputs)
                for outputs in self._dead
            ):
                continue
            alone = reason_against_part_alone(part, known)
            if is_about_file and alone and is_file_better(part):
                alone = None
                known = {}
                model = self._rough
                told.append(forgotten_coupling(part))
            is_learned = part.outputs in known and part.outputs not in self._changed
            reason = part.refusal or reason_against_innovations(part)
            if is_learned and not lost:
                reason = reason or reason_against_effects(part, model)
            if not (reason or is_learned) and is_first:
                reason = reason_against_first_model(part, self._rough.name, flies=flies_file)
                tried += part.entries
            late = reason_against_delays(part, self._actuation.delay)
            if refusal := alone or late or reason:
                # Parts that couple have the same refusal.
                if refusal not in refusals:
                    refusals.append(refusal)
                if is_learned and is_about_file and is_file_better(part):
                    model = with_entries(model, entries_of_file(part))
                    del known[part.outputs]
                    told.append(return_to_file(part, self._rough.name if flies_file else None))
                continue
            model = with_entries(model, part.entries)
            deviation = {
                entry.name: abs(entry.deviation * entry.unit / entry.value)
                for entry in part.entries
                if entry.value
            }
            known = {old: value for old, value in known.items() if not is_within(old, part.outputs)}
            latest = dict(zip(part.inputs, part.latest, strict=True))
            known[part.outputs] = Known(deviation, latest, part.delays)
            told.append(effect_sentence(part))
        return Verdict(
            model=model,
            known=known,
            sentences=told,
            refusals=refusals,
            tried=with_entries(model, tried) if tried else model,
        )

    def _adopt(
        self, model: Airframe, known: dict[PartName, Known], dead: dict[PartName, str | None]
    ) -> str | None:
        """Design a controller for a model, and note it as the last proposal.

        Returns a sentence on the tracking error that `learn.margin` costs, or None if it costs
        none. Raises ParameterError if no design has the margins.
        """
        proposed, price_text = self._designed(model, known, dead)
        new = [part for part, value in known.items() if value is not self._known.get(part)]
        self._changed = {
            part
            for part in self._changed
            if not any(is_within(part, outputs) for outputs in (*dead, *new))
        }
        self._known = known
        self._model = model
        self._dead = dead
        self._propose(proposed)
        return price_text

    def _propose(self, proposed: RiseDiConfig) -> None:
        """Note the parameters of the proposal that is about to be sent."""
        self._last = proposed
        self._proposed = proposed.digest()
        self._proposed_ns = self._record.end_ns
        self._proposals.add(self._proposed)

    def _distrust(self, *, lost: bool) -> None:
        """Stop using the rough model if its design was refused, or if the law fell back from it."""
        is_rough_alone = not self._known and not self._dead
        if lost and (is_rough_alone or self._record.has_fallen_back(-1, self._proposals)):
            self._design_of_rough = None

    def _rough_proposal(self) -> LearnerResult:
        """Propose a design for the rough airframe. Raises ParameterError if there is none."""
        name = self._rough.name
        try:
            proposed, _ = self._designed(self._rough, {}, self._dead)
        except ParameterError as error:
            self._design_of_rough = None
            raise ParameterError(f"the airframe {name} as it is: {error}") from None
        self._propose(proposed)
        return LearnerResult(proposed, f"the airframe {name} as it is, {UNVERIFIED}")

    def _note_given_up(self, flown: int, outputs: Sequence[str]) -> None:
        """Note that the controller no longer uses a learned model in some outputs.

        If the flown parameters differ from the last proposal only in these outputs, the proposal
        flies. If they also differ elsewhere, the proposal was refused.
        """
        if set(outputs) <= set(outputs_given_up(self._start)):
            return
        self._give_up(outputs)
        flying = without_models(self._controller, self._last, outputs)
        if flying.digest() == flown:
            self._last = flying
            self._proposed = flown

    def _give_up(self, outputs: Sequence[str]) -> None:
        """Leave some outputs to the flight's initial law from now on: extend `learn.without`."""
        self._start = without_models(self._controller, self._controller, outputs)
        if outputs:
            part = outputs_given_up(self._start)
            self._dead[part] = None
            self._known = {
                names: known for names, known in self._known.items() if not is_within(names, part)
            }

    def _is_due(self, end_ns: int, *, lost: bool) -> bool:
        """Return whether an identification is due: at `learn.updates`, then once in every window.

        If the last proposal does not fly (`lost`), or if a part has changed, an identification is
        also due at RETRY after the last identification, unless the law fell back in the last
        AFTER_FALLBACK seconds.
        """
        is_planned = False
        elapsed_ns = -1 if self._first_ns is None else end_ns - self._first_ns
        while elapsed_ns > self._planned[0] - self._tolerance_ns:
            is_planned = True
            last = self._planned.popleft()
            if not self._planned:
                self._planned.append(last + self._window_ns)
        is_wanted = lost or (bool(self._changed) and self._record.length >= SHORTEST)
        is_rested = end_ns >= self._tried_ns + nanoseconds(RETRY)
        after_ns = end_ns - nanoseconds(AFTER_FALLBACK)
        has_fallen = self._record.has_fallen_back(after_ns, self._proposals)
        return is_planned or (is_wanted and is_rested and not has_fallen)

    def _identified(self) -> Identification:
        """Identify A and B from the record; the search starts at the prior and the flown model.

        With models at several speeds, the record and the prior are those at a steady speed, and the
        result is converted to the trim speed. Raises ParameterError if no steady stretch is as long
        as SHORTEST.
        """
        recorded, ratio = self._steady(self._record.recording())
        length = self._record.period * len(recorded.t)
        expected = (
            f"{SHORTEST:g} s or more with an rms of at most {100 * SPREAD:g} % about its mean"
        )
        require(
            length > SHORTEST - self._record.period,
            "airspeed",
            f"it steady over the last {length:.3g} s",
            expected,
        )
        model = None if self._tried is self._rough else self._at_speed(self._tried, ratio)
        identify = partial(
            identify_model,
            recorded,
            self._at_speed(self._prior, ratio),
            actuation=self._actuation,
            channels=ChannelPairing(self._controller.outputs, self._controller.inputs),
            bound_count=AT_BOUND,
            flown=model,
            after=seconds(self._tried_ns),
            quick=self._quick,
            is_doubted=True,
        )
        tests_file = self._prior is self._rough and not self._is_sketch
        identified, self._believed = identified_within(identify, self._believed, tests=tests_file)
        if not self._has_speeds:
            return identified
        powers = exponents(self._rough, self._thrust)
        parts = (
            part._replace(entries=at_trim(part.entries, self._rough, powers, ratio))
            for part in identified.parts
        )
        return identified._replace(parts=tuple(parts))

    def _steady(self, recorded: FlightData) -> tuple[FlightData, float]:
        """Return the record, and its speed divided by V0.

        With models at several speeds, the record is the steady end of the whole record, as
        deviations from the trim at its speed.
        """
        if not self._has_speeds:
            return recorded, 1.0
        steady, ratio = steady_end(recorded, self._rough)
        return about(steady, self._rough, *level_flight(self._model, ratio, self._thrust)), ratio

    def _at_speed(self, model: Airframe, ratio: float) -> Airframe:
        """Return a model converted to the speed that `_steady` returns as a ratio to V0."""
        return at_speed(model, ratio, self._thrust) if self._has_speeds else model

    def _changes(self, end_ns: int) -> list[Change]:
        """Find changes in the last RECORD seconds, in the parts that have a learned model.

        An input is taken as dead only in the second test in a row, unless the law fell back. No
        change is found if the speed was not steady, if an output stood still, or if an output
        oscillated over RETRY, because no model with a stable loop explains such an oscillation.
        """
        suspected, self._suspected = self._suspected, {}
        begin_ns = end_ns - nanoseconds(RECORD)
        learned = {part: known for part, known in self._known.items() if part not in self._changed}
        if (
            not learned
            or self._record.length < RECORD
            or self._record.has_oscillated(end_ns - nanoseconds(RETRY))
        ):
            return []
        whole = self._record.recording(begin_ns)
        recent, ratio = self._steady(whole)
        has_moved = bool((np.nanmax(recent.y, axis=0) > np.nanmin(recent.y, axis=0)).all())
        if len(recent.t) < len(whole.t) or not has_moved:
            return []
        delays = {part: np.array(known.delays) for part, known in learned.items()}
        model = self._at_speed(self._model, ratio)
        changes = change_test(recent, model, self._actuation, delays, self._believed.drift)
        has_fallen = self._record.has_fallen_back(begin_ns, self._proposals)
        found = []
        for change in changes:
            is_counted = change.gain >= SURE_GAIN or not has_fallen
            if change.outputs not in learned or not change.is_found or not is_counted:
                continue
            is_seen_again = suspected.get(change.outputs) == change.dead
            if change.dead and not (has_fallen or is_seen_again):
                self._suspected[change.outputs] = change.dead
            else:
                found.append(change)
        return found

    def _by_law(self, dead: Mapping[PartName, str | None]) -> set[str]:
        """Return the outputs that the flight's initial law controls, given the dead inputs."""
        return by_law_of_start(self._controller, dead, has_file=self._design_of_rough is not None)

    def _designed(
        self, model: Airframe, known: Mapping[PartName, Known], dead: Mapping[PartName, str | None]
    ) -> tuple[RiseDiConfig, str | None]:
        """Design the controller for a model, and say what `learn.margin` costs in error.

        Parts without a learned model are controlled by the initial law of the flight, or by the
        rough model's design as long as it is in use. Raises ParameterError as `_adopt` does.
        """
        start = self._controller
        without_learning = start.model_copy(update={"learn": None})
        flying = set(chain.from_iterable(known))
        file = None
        without = self._by_law(dead)
        if self._design_of_rough is not None:
            file = self._design_of_rough(without_learning)
            flying = set(start.outputs) - without
        designed = without_learning
        price_text = None
        if file is not None and not known:
            designed = file.controller
        elif flying:
            latest = dict(chain.from_iterable(value.latest.items() for value in known.values()))
            aim = goal(start, file, model, list(known), latest, without)
            try:
                selected = self._design(without_learning, model, aim)
            except ParameterError as error:
                if not is_late(start, latest):
                    raise
                worst = 1e3 * max(latest.values())
                raise ParameterError(f"u is up to {worst:.0f} ms late: {error}") from None
            designed = selected.controller
            price_text = self._price(selected, model, list(known), latest, without)
        if flying:
            deviation = chain.from_iterable(part.deviation.items() for part in known.values())
            designed = with_deviations(designed, dict(deviation))
        proposed = with_flown_channels(start, designed, model, flying, dead)
        checked = RiseDiConfig.validate_mapping(
            proposed.model_dump() | {"learn": self._start.model_dump()["learn"]}, "proposal"
        )
        return checked, price_text

    def _price(
        self,
        selected: SelectedObserver,
        model: Airframe,
        parts: list[PartName],
        latest: Mapping[str, float],
        dead: Collection[str],
    ) -> str | None:
        """Write the cost of `learn.margin` in error, or return None if no design compares."""
        start = self._controller
        settings = start.learn
        if settings is None or settings.margin is None or self._design_of_rough is None:
            return None
        plain = start.model_copy(update={"learn": settings.model_copy(update={"margin": None})})
        without_learning = start.model_copy(update={"learn": None})
        file = self._design_of_rough(without_learning)
        kept = goal(plain, file, model, parts, latest, dead)
        try:
            beside = self._design(without_learning, model, kept)
        except ParameterError:  # the proposal flies, but there is nothing to compare it with
            return None
        return price(selected, settings.margin, beside, float(kept.margin.min()))
