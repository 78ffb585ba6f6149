# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Learning in the air: A and B from the last seconds of a flight, checked, and the observer and
feedforward of that model.

The identification is that of a log (`model_identification.identify_model`), about a rough
airframe. A model that fails a check is refused with a sentence. The controller refuses parameters
that fail its own checks at load.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import NamedTuple

import numpy as np

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.airframes.airspeed import at_speed, exponents, level_flight
from flight_analysis.closed_loop.learning_loop import Entry, LearnerResult
from flight_core.parameters import ParameterError, require
from flight_core.rates import nanoseconds, seconds
from flight_core.vectors import FloatArray
from flight_design.gains.ideal_control import ChannelPairing
from flight_design.gains.observer_search import SelectedObserver
from flight_design.identification.innovation_filters import DRIFT, TRANSIENT, Actuation, FlightData
from flight_design.identification.likelihood import HELD_OUT, KNOWN, Unknown
from flight_design.identification.model_identification import (
    Identification,
    identify_model,
    with_entries,
)
from flight_design.identification.model_quality import another_airframe
from flight_design.learning.change_test import (
    ANGLE,
    MAX_GAIN,
    RECORD,
    Change,
    believed,
    change_test,
)
from flight_design.learning.designs import (
    Goal,
    goal,
    is_late,
    price,
    with_deviations,
    without_effect,
)
from flight_design.learning.flight_record import SPREAD, FlightRecord, Sample, about, steady_end
from flight_design.learning.part_checks import (
    DELAY_DEVIATION,
    as_in_file,
    back,
    back_to_file,
    changed,
    explains,
    forgotten,
    is_within,
    not_white,
    sentence,
    too_late,
    unchanged,
    uncoupled,
    unproven,
    weaker,
)
from rise_di_controller.learning.learned_channels import (
    outputs_without,
    with_channels_of,
    without_models,
)
from rise_di_controller.learning.proposals import UNVERIFIED
from rise_di_controller.rise_di_config import RiseDiConfig

# entries at their bound: the right model may have one that hardly shows, wrong ones have two to six
AT_BOUND = 1
# s, of a record: two held-out seconds of the six that `identify` needs at least
SHORTEST = 20.0 * TRANSIENT

Design = Callable[[RiseDiConfig, Airframe, Goal], SelectedObserver]
"""A controller with the feedforward and the observer of a model. Raises ParameterError."""

DesignOfFile = Callable[[RiseDiConfig], SelectedObserver]
"""The design of the rough model as one that errs. Raises ParameterError."""


class Known(NamedTuple):
    """A part of the aircraft whose model flies."""

    end_ns: int  # of its window
    deviation: Mapping[str, float]  # of its entries by name, 1
    latest: Mapping[str, float]  # of each input, delay and two standard deviations, s
    is_rough: bool  # that of the rough airframe as it is
    delays: tuple[float, ...]  # of each input, s


class Verdict(NamedTuple):
    """What shall fly after an identification, and what is said about its parts."""

    model: Airframe
    known: dict[tuple[str, ...], Known]
    sentences: list[str]
    refusals: list[str]
    tried: Airframe  # the model, with those that later samples have to show as better


class Learner:
    """The record of y and u over a window, and proposals from it.

    The parts of the aircraft that do not couple are learned one by one: one without a model flies
    the law of the start.
    """

    def __init__(
        self,
        controller: RiseDiConfig,
        airframe: Airframe,
        design: Design,
        delay: float = 0.0,
        rough: Unknown = KNOWN,
        design_of_rough: DesignOfFile | None = None,
        *,
        quick: bool = False,
    ) -> None:
        """`airframe` is the rough model, the prior; `delay` that of the loop, s, beyond sampling
        and lags. `design_of_rough` designs for a model that errs: by it the rough model flies from
        the start, and later in parts without a learned model; None: the law of the start does.

        `rough` has the deviation of B in the rough model, and the noise of the disturbances. With
        more noise than DRIFT the aircraft is not tested for a change: the disturbances stand for a
        change, and for a dead input. `quick` is that of `identify`.
        """
        settings = controller.learn
        assert settings is not None  # noqa: S101 - `scenario_learner.learner` makes no other
        self._controller = controller
        self._rough = airframe
        self._design = design
        # None too once the rough model has not flown, or the law fell back
        self._design_of_rough = design_of_rough
        self._has_proposed_rough = False
        self._believed = rough
        self._is_sketch = rough.drift > DRIFT
        self._quick = quick
        self._has_speeds = controller.schedule is not None and bool(controller.schedule.models)
        self._thrust = controller.inputs[controller.outputs.index("V")] if self._has_speeds else ""
        lag = dict(zip(controller.inputs, controller.lag, strict=True))
        self._actuation = Actuation(np.array([lag[name] for name in airframe.inputs]), delay)
        self._record = FlightRecord(controller, airframe, settings.window)
        self._window_ns = nanoseconds(settings.window)
        self._planned = deque(map(nanoseconds, settings.updates))
        self._first_ns: int | None = None
        # of the next identification; what flies
        self._prior = airframe
        self._model = airframe
        self._tried = airframe  # what the next identification tests
        self._tried_ns = -1  # end of its record
        self._known: dict[tuple[str, ...], Known] = {}  # by the outputs of a part
        # Parts that fly the law of the start for good: their inputs without effect, "" for outputs
        # of `learn.without`
        self._dead: dict[tuple[str, ...], str] = {}
        self._start = controller  # with the `learn.without` of what flies
        self._has_ended = False
        self._give_up(outputs_without(controller))
        self._changed: set[tuple[str, ...]] = set()  # parts whose model is that of before a change
        self._last = controller  # the last proposal
        self._proposed = controller.digest()  # of the last proposal
        self._proposals = set[int]()  # digests of all of them
        self.identification: Identification | None = None  # the last one
        self.has_fallen_back = False  # whether the law fell back with the last tick

    @property
    def model(self) -> Airframe | None:
        """The rough airframe with the models of the parts that are known; None where there is
        none.
        """
        return self._model if self._known else None

    def take(self, stamp_ns: int, y: FloatArray, u: FloatArray, flown: int) -> None:
        """Record y and u, after its limits, of a tick, (m,), in the law's order, and the digest of
        its parameters.
        """
        self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        before = self._record.flown
        self._record.take(Sample(stamp_ns, y, u, flown))
        self.has_fallen_back = before not in {None, flown} and flown not in self._proposals

    def propose(self, flown: int, given_up: Sequence[str] = ()) -> LearnerResult:
        """Parameters with the observer and the feedforward of what was identified, or the sentence
        of a refusal.

        The last RECORD seconds are tested for a loss of effect of inputs. After a loss the older
        record is left out, and the flown model is the prior. A part with an input without effect
        flies the law of the start, without this input. Before the first model of a part, a rough
        airframe that explains the flight as it is, with white innovations, is taken itself.

        The first proposal, before any record, is the rough airframe designed as one that errs.
        Parts that are refused later fly so, too. The law of the start follows where that proposal
        does not fly, or the law falls back.

        While the rough model flies, a first model of a part only tests: the next identification
        takes its own where the samples since then show an advantage over the rough model.

        Where the last proposal does not fly, by the digest `flown`, an identification is due: the
        proposal was refused, or the controller fell back. Outputs that the controller gave up,
        `given_up`, are not proposed again. Where no part is left, nothing is identified, and the
        sentence says so once.
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
        """The proposal of `propose`. Raises ParameterError where there is none."""
        end_ns = self._record.end_ns
        length = self._record.length
        if length < SHORTEST - self._record.period:
            return LearnerResult(None, f"record: found {length:.3g} s, expected {SHORTEST:g} s")
        self._note_given_up(flown, given_up)
        lost = flown != self._proposed
        self._distrust(lost=lost)
        if is_within(self._controller.outputs, chain.from_iterable(self._dead)) and not lost:
            ended, self._has_ended = self._has_ended, True
            return LearnerResult(
                None,
                ""
                if ended
                else "each part flies the law of the start from now on: no part is left to learn",
            )
        changes = self._changes(end_ns)
        damaged = [change for change in changes if change.found]
        due = self._is_due(end_ns) or lost
        if not (due or damaged or self._changed):
            return LearnerResult(None, unchanged(changes))
        if damaged:
            self._record.forget_before(end_ns - nanoseconds(RECORD))
            self._prior = self._model
            self._changed |= {change.outputs for change in damaged}
        identified = self.identification = self._identified()
        dead = {
            change.outputs: change.dead
            for change in changes
            if change.dead and not self._acts(change.dead, identified)
        }
        without_model = self._dead | dead
        sentences = [
            f"{name} has no effect: {' and '.join(part)} without it, by the law of the start"
            for part, name in (without_model if lost else dead).items()
            if name
        ]
        sentences += [changed(change) for change in damaged if change.outputs not in dead]
        verdict = self._verdict(identified, without_model, lost=lost)
        if self._changed and any(
            another_airframe(part.entries, self._rough.name, AT_BOUND, self._believed.factor)
            for part in identified.parts
        ):
            # the model that flew may have been the wrong one, and not the aircraft have changed
            self._prior = self._model if self._prior is self._rough else self._rough
        sentences += verdict.sentences
        if not sentences:
            self._test_next(verdict)
            nothing = "each part flies the law of the start from before on"
            return LearnerResult(None, "; ".join(verdict.refusals) or nothing)
        sentences.append(self._adopt(verdict, without_model))
        refused = [f"refused: {refusal}" for refusal in verdict.refusals]
        return LearnerResult(self._last, "; ".join(filter(None, sentences + refused)))

    def _verdict(
        self,
        identified: Identification,
        without_model: Mapping[tuple[str, ...], str],
        *,
        lost: bool,
    ) -> Verdict:
        """Which parts of an identification shall fly."""
        end_ns = self._record.end_ns
        known = {part: value for part, value in self._known.items() if part not in without_model}
        model = self._model
        sentences = []
        refusals = []
        tried = list[Entry]()
        is_about_file = self._prior is self._rough
        flies_file = self._design_of_rough is not None
        is_first = is_about_file and not self._changed and (flies_file or self._is_sketch)
        for part in identified.parts:
            if any(
                is_within(part.outputs, outputs) or is_within(outputs, part.outputs)
                for outputs in without_model
            ):
                continue
            if is_about_file and uncoupled(part, known) and back_to_file(part):
                known = {}
                model = self._rough
                sentences.append(forgotten(part))
            rough = part.outputs not in known and explains(part)
            learned = {
                outputs for outputs, estimate in known.items() if not estimate.is_rough
            } - self._changed
            before = model if part.outputs in learned and not lost else None
            reason = "" if rough else part.refusal or not_white(part) or weaker(part, before)
            if not (rough or reason or part.outputs in learned) and is_first:
                reason = unproven(part, self._rough.name, flies=flies_file)
                tried += part.entries
            if refusal := uncoupled(part, known) or too_late(part, self._actuation.delay) or reason:
                refusals.append(refusal)
                if part.outputs in learned and is_about_file and back_to_file(part):
                    model = with_entries(model, as_in_file(part))
                    del known[part.outputs]
                    name = "" if self._design_of_rough is None else self._rough.name
                    sentences.append(back(part, name))
                continue
            entries = as_in_file(part) if rough else part.entries
            model = with_entries(model, entries)
            deviation = {
                entry.name: abs(entry.deviation * entry.unit / entry.value)
                for entry in entries
                if entry.value
            }
            known = {old: value for old, value in known.items() if not is_within(old, part.outputs)}
            latest = dict(zip(part.inputs, part.latest, strict=True))
            known[part.outputs] = Known(end_ns, deviation, latest, rough, part.delays)
            sentences.append(
                f"{' and '.join(part.outputs)} of the airframe {self._rough.name} as it is"
                if rough
                else sentence(part)
            )
        tested = with_entries(model, tried) if tried else model
        return Verdict(model, known, sentences, refusals, tested)

    def _adopt(self, verdict: Verdict, without_model: dict[tuple[str, ...], str]) -> str:
        """Design for a verdict, and take it as proposed: what `learn.margin` costs. Raises
        ParameterError without a design.
        """
        proposed, price_text = self._designed(verdict.model, verdict.known, without_model)
        end_ns = self._record.end_ns
        new = [
            *without_model,
            *(part for part, value in verdict.known.items() if value.end_ns == end_ns),
        ]
        self._changed = {
            part for part in self._changed if not any(is_within(part, outputs) for outputs in new)
        }
        self._test_next(verdict)
        self._known = verdict.known
        self._model = verdict.model
        self._dead = without_model
        self._propose(proposed)
        return price_text

    def _test_next(self, verdict: Verdict) -> None:
        """Note what the next identification tests, on samples that are later than the record."""
        self._tried = verdict.tried
        self._tried_ns = self._record.end_ns

    def _propose(self, proposed: RiseDiConfig) -> None:
        """Note what is proposed."""
        self._last = proposed
        self._proposed = proposed.digest()
        self._proposals.add(self._proposed)

    def _distrust(self, *, lost: bool) -> None:
        """No longer fly the rough model where it was refused, or the law fell back."""
        is_rough_alone = not self._known and not self._dead
        if lost and (is_rough_alone or self._record.fell_back(-1, self._proposals)):
            self._design_of_rough = None

    def _rough_proposal(self) -> LearnerResult:
        """The rough airframe by a design for one that errs. Raises ParameterError."""
        name = self._rough.name
        try:
            proposed, _ = self._designed(self._rough, {}, self._dead)
        except ParameterError as error:
            self._design_of_rough = None
            raise ParameterError(f"the airframe {name} as it is: {error}") from None
        self._propose(proposed)
        return LearnerResult(proposed, f"the airframe {name} as it is, {UNVERIFIED}")

    def _note_given_up(self, flown: int, outputs: Sequence[str]) -> None:
        """Give up the outputs that the controller gave up. The rest of what flies is the last
        proposal, or it was refused.
        """
        if set(outputs) <= set(outputs_without(self._start)):
            return
        self._give_up(outputs)
        flying = without_models(self._controller, self._last, outputs)
        if flying.digest() == flown:
            self._last = flying
            self._proposed = flown

    def _give_up(self, outputs: Sequence[str]) -> None:
        """Leave outputs to the law of the start, by `learn.without`."""
        self._start = without_models(self._controller, self._controller, outputs)
        if outputs:
            part = outputs_without(self._start)
            self._dead[part] = ""
            self._known = {
                names: known for names, known in self._known.items() if not is_within(names, part)
            }

    def _is_due(self, end_ns: int) -> bool:
        """Whether an identification is planned by now: at `learn.updates`, then once a window."""
        assert self._first_ns is not None  # noqa: S101 - there is a record
        due = False
        while end_ns - self._first_ns > self._planned[0] - nanoseconds(self._record.period):
            due = True
            last = self._planned.popleft()
            if not self._planned:
                self._planned.append(last + self._window_ns)
        return due

    def _acts(self, name: str, identified: Identification) -> bool:
        """Whether an identified model predicts the held-out samples better than one that is
        identified without an input.

        The test of a loss takes A as known: with a wrong A an input that acts may look dead. With A
        free it does not. Better is a gain of log-likelihood above the limit of the test: beside a
        dead rudder, with wider bounds, it was 1.1.
        """
        gain = (
            identified.after.log_likelihood - self._identified(dead_input=name).after.log_likelihood
        )  # of a sample
        return gain * len(self._record.recording().t) / HELD_OUT > MAX_GAIN

    def _identified(self, dead_input: str = "") -> Identification:
        """A and B from the record, about the prior, without the effect of `dead_input`; also from
        the model that flies on.

        Beside models at several speeds the record is of a steady speed, and so is the prior. The
        entries are reduced to the trim speed. Raises ParameterError where the speed is not steady
        over SHORTEST.
        """
        channels = ChannelPairing(self._controller.outputs, self._controller.inputs)
        unknown = self._believed._replace(delay=DELAY_DEVIATION, angle=ANGLE)
        identified = partial(
            identify_model,
            actuation=self._actuation,
            channels=channels,
            at_bound=AT_BOUND,
            unknown=unknown,
            after=seconds(self._tried_ns),
            may_couple=self._record.is_full,
            quick=self._quick,
        )
        prior = self._prior
        model = None if self._tried is self._rough else self._tried
        if dead_input:
            prior = without_effect(prior, dead_input)
            model = model and without_effect(model, dead_input)
        if not self._has_speeds:
            return identified(self._record.recording(), prior, flown=model)
        steady, ratio = self._steady(self._record.recording())
        length = self._record.period * len(steady.t)
        expected = (
            f"{SHORTEST:g} s or more with an rms of at most {100 * SPREAD:g} % about its mean"
        )
        require(
            length > SHORTEST - self._record.period,
            "airspeed",
            f"it steady over the last {length:.3g} s",
            expected,
        )
        flown = None if model is None else self._at_speed(model, ratio)
        reduced = identified(steady, self._at_speed(prior, ratio), flown=flown)
        parts = (
            part._replace(entries=self._at_trim(part.entries, ratio)) for part in reduced.parts
        )
        return reduced._replace(parts=tuple(parts))

    def _steady(self, recorded: FlightData) -> tuple[FlightData, float]:
        """Beside models at several speeds: the steady end of a record, about the trim there, and
        the speed over V0.
        """
        if not self._has_speeds:
            return recorded, 1.0
        steady, ratio = steady_end(recorded, self._rough)
        return about(steady, self._rough, *level_flight(self._model, ratio, self._thrust)), ratio

    def _at_speed(self, model: Airframe, ratio: float) -> Airframe:
        """A model at a speed of `_steady`."""
        return at_speed(model, ratio, self._thrust) if self._has_speeds else model

    def _at_trim(self, entries: tuple[Entry, ...], ratio: float) -> tuple[Entry, ...]:
        """Entries reduced to the trim speed: relative errors and deviations stay."""
        powers = exponents(self._rough, self._thrust)
        states = list(self._rough.states)
        columns = {"A": states, "B": list(self._rough.inputs)}
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

    def _changes(self, end_ns: int) -> list[Change]:
        """Tests of the parts over the last RECORD that count; none where the speed was not steady
        over it, an output oscillated or stood still.

        A loop near instability moves y as no model with a stable loop says.
        """
        begin_ns = end_ns - nanoseconds(RECORD)
        if self._is_sketch or self._record.length < RECORD or self._record.oscillated(begin_ns):
            return []
        learned = {part: known for part, known in self._known.items() if part not in self._changed}
        whole = self._record.recording(begin_ns)
        recent, ratio = self._steady(whole)
        has_moved = bool((np.nanmax(recent.y, axis=0) > np.nanmin(recent.y, axis=0)).all())
        if len(recent.t) < len(whole.t) or not has_moved:
            return []
        delays = {part: np.array(known.delays) for part, known in learned.items()}
        changes = change_test(recent, self._at_speed(self._model, ratio), self._actuation, delays)
        rested = {part for part, known in learned.items() if known.end_ns <= begin_ns}
        has_fallen = self._record.fell_back(begin_ns, self._proposals)
        return [
            change
            for change in changes
            if not any(is_within(change.outputs, part) for part in (*self._dead, *self._changed))
            and believed(change, learned, rested, has_fallen=has_fallen)
        ]

    def _designed(
        self,
        model: Airframe,
        known: Mapping[tuple[str, ...], Known],
        dead: Mapping[tuple[str, ...], str],
    ) -> tuple[RiseDiConfig, str]:
        """The controller of a model, with the law of the start in the parts without one, and what
        `learn.margin` costs, a sentence.

        While the rough model flies, a part without a learned model flies by it. Raises
        ParameterError.
        """
        start = self._controller
        without_learning = start.model_copy(update={"learn": None})
        flying = {output for part in known for output in part}
        held = {output for part in dead for output in part}
        file = None
        if self._design_of_rough is not None:
            file = self._design_of_rough(without_learning)
            flying = set(start.outputs) - held
        designed = without_learning
        price_text = ""
        if file is not None and not known:
            designed = file.controller
        elif flying:
            latest = dict(chain.from_iterable(value.latest.items() for value in known.values()))
            aim = goal(start, file, model, list(known), latest)
            try:
                selected = self._design(without_learning, model, aim)
                designed = selected.controller
            except ParameterError as error:
                if not is_late(start, latest):
                    raise
                worst = 1e3 * max(latest.values())
                raise ParameterError(f"u is up to {worst:.0f} ms late: {error}") from None
            price_text = self._price(selected, model, list(known), latest)
        if flying:
            designed = with_deviations(
                designed, {k: v for part in known.values() for k, v in part.deviation.items()}
            )
        proposed = with_channels_of(
            start,
            designed,
            [output not in flying for output in start.outputs],
            [name in dead.values() for name in start.inputs],
        )
        checked = RiseDiConfig.validate_mapping(
            proposed.model_dump() | {"learn": self._start.model_dump()["learn"]}, "proposal"
        )
        return checked, price_text

    def _price(
        self,
        selected: SelectedObserver,
        model: Airframe,
        parts: list[tuple[str, ...]],
        latest: Mapping[str, float],
    ) -> str:
        """What `learn.margin` costs beside the margin of the file's loop; "" without either."""
        start = self._controller
        settings = start.learn
        if settings is None or settings.margin is None or self._design_of_rough is None:
            return ""
        plain = start.model_copy(update={"learn": settings.model_copy(update={"margin": None})})
        without_learning = start.model_copy(update={"learn": None})
        file = self._design_of_rough(without_learning)
        kept = goal(plain, file, model, parts, latest)
        try:
            beside = self._design(without_learning, model, kept)
        except ParameterError:  # what was asked for flies: there is nothing to compare with
            return ""
        return price(selected, settings.margin, beside, float(kept.margin.min()))
