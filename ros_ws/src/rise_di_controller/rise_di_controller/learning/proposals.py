# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Decide in the controller what becomes of models that are learned in flight.

This module decides when identifications begin, which proposed models are used, and when to fall
back to the initial law. It has no side effects, so both the node and the in-process loop use it.
"""

from collections import Counter, deque
from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple

from flight_core.modes import Mode
from flight_core.outcome import Refusal
from flight_core.parameters import SMALLEST, ParameterError, flatten, require
from flight_core.rates import nanoseconds, seconds
from flight_core.vectors import FloatArray
from rise_di_controller.controller import Controller, Prepared, prepared, preparing
from rise_di_controller.learning.learned_channels import (
    authority,
    coupled,
    outputs_given_up,
    with_fallback,
    without_models,
)
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import LearnConfig, RiseDiConfig

DESIGNED = frozenset(
    {
        "k_g",
        "k_d",
        "Lambda",
        "beta",
        "softening",
        "input_scale",
        "omega",
        "sign",
        "feedforward",
        "observer",
        "schedule",
    }
)
"""Parameters, or groups of parameters, that a proposal may change. `rise-di gains select
--observer` designs them at every speed."""

OPTIONAL = ("feedforward.inputs", "feedforward.gravity", "feedforward.deviation")
"""Parameters that a design may lack. For example, `feedforward.inputs` names the inputs with a
feedforward, and a design in which all inputs have one lacks it."""


class EventKind(StrEnum):
    """Kind of an event in learning, as the messages of the topic `learning` name it."""

    FLIES = "flies"  # the controller has taken a proposal
    REFUSED = "refused"  # a proposal fails a check of the controller
    NO_MODEL = "no model"  # the learner has refused what it identified
    FALLBACK = "fallback"  # all or some parts of the model fall back to the initial law
    # the law was deactivated, and begins again with the initial parameters
    RESTART = "restart"


class Proposal(NamedTuple):
    """What a learner found in its window, as the controller receives it."""

    stamp_ns: int  # the end of the window, which is the instant of its last tick
    start: int  # digest of the parameters at the start of the flight, which the learner has
    flown: int  # digest of the parameters in use at the end of the window
    # all parameters of DESIGNED by dotted name, None for one that is removed; empty if no model is
    # proposed
    change: Mapping[str, Any]
    sentence: str | None  # what was learned, or why not; None if nothing was due


class Event(NamedTuple):
    """What became of a proposed model, or that the controller fell back.

    An event has the reason, and the parameters that changed, by dotted name. It is possible that
    none changed.
    """

    stamp_ns: int
    kind: EventKind
    change: Mapping[str, Any]
    sentence: str


UNVERIFIED = "until a model is learned"
"""End of the sentence of a proposal to use the rough model before there is any record."""

FALLBACKS = 2
"""Number of fallbacks in an engagement after which a part of the model gets no further models. By
then a second model has diverged although it was certified. A part consists of the outputs that the
model couples with each other (`coupled`)."""

AUTHORITY_TICKS = 10
"""Number of ticks of the controller between two samples of `authority`."""


class Fallback(NamedTuple):
    """A fallback: all outputs returned to the law with which the flight started."""

    flown: int  # digest of the parameters before
    input_scale: tuple[float, ...]  # input_scale of the parameters before
    fallen: int  # digest of the parameters after

    def is_outlived_by(self, proposal: Proposal, digest: int) -> bool:
        """Return whether a proposal may still act although it was made before this fallback.

        It may act if it stops the use of one more input that has no effect.
        """
        scale = proposal.change.get("input_scale")
        if (proposal.flown, digest) != (self.flown, self.fallen) or not isinstance(scale, Sequence):
            return False
        return any(new == SMALLEST < old for new, old in zip(scale, self.input_scale, strict=False))


class Updates:
    """The times at which models are proposed: at the first tick, and at given times after it.

    At the first tick the rough model is proposed unchanged. From the first given time on, the
    aircraft is also tested for damage at intervals of `learn.check`. A test is left out if a given
    time follows in less than `learn.check`.
    """

    def __init__(self, settings: LearnConfig) -> None:
        self._check_ns = nanoseconds(settings.check)
        self._times_ns = deque(map(nanoseconds, (0.0, *settings.updates)))
        self._begin_ns = nanoseconds(settings.updates[0])  # before this time there is no test
        self._first_ns: int | None = None
        self._last_ns = 0  # time of the last identification or test after the first tick

    def is_due(self, now_ns: int) -> bool:
        """Return whether an identification or a test begins at this tick.

        Ticks must come in order.
        """
        self._first_ns = now_ns if self._first_ns is None else self._first_ns
        elapsed_ns = now_ns - self._first_ns
        is_planned = False
        while self._times_ns and elapsed_ns >= self._times_ns[0]:
            is_planned = True
            self._last_ns = self._times_ns.popleft()
        if is_planned:
            return True
        next_ns = self._last_ns + self._check_ns
        is_late = bool(self._times_ns) and next_ns + self._check_ns > self._times_ns[0]
        if next_ns <= self._begin_ns or is_late or elapsed_ns < next_ns:
            return False
        self._last_ns = elapsed_ns - (elapsed_ns - self._last_ns) % self._check_ns
        return True


class Learning:
    """The proposed models of a flight and the fallback, advanced between two ticks.

    In simulated time a proposal acts `learn.latency` after the end of its window, and the flight
    waits for it. In real time a proposal acts as soon as it is certified. Each call of `step` does
    a small part of the certification, so that no tick has to wait.
    """

    def __init__(
        self, parameters: RiseDiConfig, announce: Callable[[Event], None], *, simulated: bool
    ) -> None:
        assert parameters.learn is not None  # noqa: S101 - only a controller that learns has one
        self.start = parameters
        self._digest = parameters.digest()
        self._settings = parameters.learn
        self._announce = announce
        self._simulated = simulated
        self._updates = Updates(parameters.learn)
        # ends of the windows whose proposals have not acted yet, in simulated time
        self._due = deque[int]()
        self._received: dict[int, Proposal] = {}  # by end of the window, in simulated time
        self._certificate: tuple[Proposal, Generator[None, None, Prepared]] | None = None
        self._spacing_ns = nanoseconds(min(parameters.learn.spacing(), parameters.learn.check)) // 2
        # end of the window of the last proposal that was not refused at once
        self._last_ns: int | None = None
        # when the law was last inactive; a window before this belongs to an earlier engagement
        self._since_ns: int | None = None
        self._fallback: Fallback | None = None  # the last fallback
        self._fallbacks = Counter[str]()  # number of fallbacks of each output in this engagement
        self._diverged = set[int]()  # digests of the parameters that diverged in this engagement

    def authority(self, controller: Controller) -> FloatArray:
        """Return the values of the topic `authority` under the parameters in force."""
        parameters = controller.parameters
        assert isinstance(parameters, RiseDiConfig)  # noqa: S101 - proposals keep the initial law
        return authority(parameters, self.start)

    def ticked(self, controller: Controller, now_ns: int) -> bool:
        """Note a tick, and return whether an identification or a test begins at it.

        None begins while the law is deactivated.
        """
        due = controller.mode is not Mode.INACTIVE and self._updates.is_due(now_ns)
        if due and self._simulated:
            self._due.append(now_ns)
        return due

    def is_waiting(self, now_ns: int) -> bool:
        """Return whether the tick at `now_ns` waits for a proposal; in real time none does."""
        return any(
            self._acts_ns(end_ns) <= now_ns and end_ns not in self._received for end_ns in self._due
        )

    def receive(self, proposal: Proposal, controller: Controller, now_ns: int) -> None:
        """Take a proposal, or refuse it and add an event that says why."""
        if not (self._simulated or proposal.change) and proposal.sentence is None:
            return  # a test without a change has nothing to certify or report
        if refusal := self._reason_against(proposal, now_ns, controller):
            self._refuse(refusal, proposal, now_ns)
        elif self._simulated:
            self._received[proposal.stamp_ns] = proposal
        else:
            self._last_ns = proposal.stamp_ns
            self._begin(proposal, controller, now_ns)

    def step(self, controller: Controller, now_ns: int) -> ControllerConfig | None:
        """Certify a part of a proposal, let due proposals act, and fall back if the law diverges.

        Returns the parameters that the controller has taken, or None if it keeps the present ones.
        After a deactivation the law begins again with the initial parameters, because a
        learned model may have been the reason to deactivate it.
        """
        if controller.mode is Mode.INACTIVE:
            return self._begin_again(controller, now_ns)
        adopted = None
        while (
            self._due and self._acts_ns(self._due[0]) <= now_ns and self._due[0] in self._received
        ):
            self._begin(self._received.pop(self._due.popleft()), controller, now_ns)
            adopted = self._certify(controller, now_ns) or adopted
        if not self._simulated:
            adopted = self._certify(controller, now_ns)
        if oscillations := controller.oscillations():
            adopted = self._end_oscillations(oscillations, controller, now_ns)
        elif diverging := controller.diverging():
            adopted = self._end_divergence(diverging, controller, now_ns)
        return adopted

    def _end_divergence(
        self, diverging: Collection[str], controller: Controller, now_ns: int
    ) -> RiseDiConfig:
        """Fall back to the initial parameters in all outputs, because some of them diverge.

        A part of the model is a group of outputs that the model couples. The fallback is counted
        only for the parts in which an output diverges. A part with FALLBACKS fallbacks flies the
        initial law until the engagement ends.
        """
        parameters = controller.parameters
        assert isinstance(parameters, RiseDiConfig)  # noqa: S101 - for the type checker
        part = [
            name
            for name, diverges in zip(
                parameters.outputs, coupled(parameters, diverging), strict=True
            )
            if diverges
        ]
        self._fallbacks.update(part)
        ends = [name for name in part if self._fallbacks[name] >= FALLBACKS]
        fallen = without_models(self.start, self.start, {*outputs_given_up(parameters), *ends})
        lasting = f", in {', '.join(ends)} to the end of the engagement" * bool(ends)
        reason = " and ".join(f"{name} diverges{' again' * bool(ends)}" for name in diverging)
        self._fallback = Fallback(controller.digest, parameters.input_scale, fallen.digest())
        self._diverged.add(controller.digest)
        what = f"falls back to the initial law{lasting}: {reason}"
        self._take(controller, now_ns, prepared(fallen), EventKind.FALLBACK, what)
        return fallen

    def _end_oscillations(
        self, periods: Mapping[str, float], controller: Controller, now_ns: int
    ) -> RiseDiConfig:
        """Fall back in the outputs that oscillate, and in outputs that the model couples with them.

        The initial law controls all of these outputs until the engagement ends.
        """
        parameters = controller.parameters
        assert isinstance(parameters, RiseDiConfig)  # noqa: S101 - for the type checker
        bare = coupled(parameters, periods)
        fallen = without_models(
            self.start,
            parameters,
            [name for name, is_bare in zip(parameters.outputs, bare, strict=True) if is_bare],
        )
        rates = " and ".join(
            f"{name} oscillates at {1.0 / period:.2g} Hz" for name, period in periods.items()
        )
        outputs = ", ".join(
            name for name, is_bare in zip(parameters.outputs, bare, strict=True) if is_bare
        )
        what = f"falls back to the initial law in {outputs}, to the end of the engagement: {rates}"
        self._take(controller, now_ns, prepared(fallen), EventKind.FALLBACK, what)
        return fallen

    def _begin_again(self, controller: Controller, now_ns: int) -> ControllerConfig | None:
        """Forget all proposals and fallbacks.

        Returns the initial parameters if a model was in use, else None.
        """
        self._updates = Updates(self._settings)
        self._certificate = None
        self._last_ns = None
        self._since_ns = now_ns
        self._due.clear()
        self._received.clear()
        self._fallbacks.clear()
        self._diverged.clear()
        if not controller.has_learned_model and outputs_given_up(
            controller.parameters
        ) == outputs_given_up(self.start):
            return None
        what = "goes back to the initial law: it was deactivated"
        self._take(controller, now_ns, prepared(self.start), EventKind.RESTART, what)
        return self.start

    def _acts_ns(self, end_ns: int) -> int:
        return end_ns + nanoseconds(self._settings.latency)

    def _reason_against(
        self, proposal: Proposal, now_ns: int, controller: Controller
    ) -> Refusal | None:
        """Return why a proposal is refused before it is certified, or None.

        The check takes only microseconds for any proposal.
        """
        window = f"a window that ends {seconds(now_ns - proposal.stamp_ns):.3g} s ago"
        if proposal.start != self._digest:
            return Refusal(
                f"found a proposal for the parameters {proposal.start}, expected "
                f"{self._digest}, the digest of the initial parameters"
            )
        if self._simulated:
            is_due = proposal.stamp_ns in self._due and proposal.stamp_ns not in self._received
            late = f"found {window}, expected the window of an identification that is due, once"
            return None if is_due else Refusal(late)
        longest = nanoseconds(self._settings.window)
        if self._since_ns is not None:
            longest = min(longest, now_ns - self._since_ns)
        if not 0 <= now_ns - proposal.stamp_ns <= longest:
            return Refusal(f"found {window}, expected 0 to {seconds(longest):.3g} s")
        if self._certificate is not None:
            return Refusal(
                f"found {window} while another proposal is certified, expected one at a time"
            )
        if self._last_ns is not None and proposal.stamp_ns - self._last_ns < self._spacing_ns:
            later = (
                f"one that ends at least {seconds(self._spacing_ns):g} s after the window of the "
                "last proposal"
            )
            return Refusal(f"found {window}, expected {later}")
        return self._reason_against_change(proposal, controller)

    def _begin(self, proposal: Proposal, controller: Controller, now_ns: int) -> None:
        if proposal.change:
            self._certificate = (
                proposal,
                _certificate(controller.parameters, proposal.change, self.start),
            )
        elif proposal.sentence is not None:
            self._announce(Event(now_ns, EventKind.NO_MODEL, {}, f"no model: {proposal.sentence}"))

    def _certify(self, controller: Controller, now_ns: int) -> ControllerConfig | None:
        """Do one step of the certification, or all steps in simulated time.

        Returns the parameters that are taken if the certification is complete, else None.
        """
        if self._certificate is None:
            return None
        proposal, certificate = self._certificate
        try:
            next(certificate)
            while self._simulated:
                next(certificate)
        except StopIteration as end:
            self._certificate = None
            refusal = self._reason_against_change(proposal, controller)
            if end.value.digest in self._diverged:
                refusal = Refusal(
                    "found parameters that diverged in this engagement, expected others"
                )
            if refusal is None:
                bare_outputs = ", ".join(outputs_given_up(end.value.parameters))
                exception = f", without {bare_outputs}" if bare_outputs else ""
                what = f"flies {proposal.sentence or 'the proposal'}{exception}"
                self._take(controller, now_ns, end.value, EventKind.FLIES, what)
                return controller.parameters
        except ArithmeticError as error:
            refusal = Refusal(
                f"found numbers too large or too small ({error.args[-1]}), expected "
                "numbers of a flight"
            )
        except ValueError as error:  # ParameterError, or LAPACK finds no eigenvalues of a matrix
            refusal = Refusal(str(error))
        else:
            return None
        self._certificate = None
        self._refuse(refusal, proposal, now_ns)
        return None

    def _reason_against_change(self, proposal: Proposal, controller: Controller) -> Refusal | None:
        """Return why the law cannot take a certified proposal, or None.

        The law cannot take it if it is not engaged, or if another change of the parameters came
        first. A proposal that stops the use of an input without effect is taken even after a
        fallback, because the loss of this input may have caused the fallback.
        """
        if controller.mode is not Mode.ENGAGED:
            return Refusal(
                f"found the mode {controller.mode.name}, expected a model only while the law "
                "is engaged"
            )
        if proposal.flown == controller.digest:
            return None
        if self._fallback is not None and self._fallback.is_outlived_by(
            proposal, controller.digest
        ):
            return None
        return Refusal(
            f"found a proposal made with the parameters {proposal.flown}, expected "
            f"{controller.digest}: they changed meanwhile"
        )

    def _take(
        self, controller: Controller, now_ns: int, new: Prepared, kind: EventKind, sentence: str
    ) -> None:
        change = changes(controller.parameters, new.parameters)
        controller.retune(new)
        self._announce(Event(now_ns, kind, change, sentence))

    def _refuse(self, refusal: Refusal, proposal: Proposal, now_ns: int) -> None:
        # The sentence may say which input has no effect, which is true in spite of the refusal.
        proposed = "" if proposal.sentence is None else f"; proposed: {proposal.sentence}"
        self._announce(Event(now_ns, EventKind.REFUSED, {}, f"refused: {refusal}{proposed}"))


def _certificate(
    parameters: ControllerConfig, change: Mapping[str, Any], start: RiseDiConfig
) -> Generator[None, None, Prepared]:
    """Apply a change to the parameters in force, and check the result as if it came from a file.

    The generator yields after at most about 1 ms. Raises ParameterError if a check fails.
    """
    foreign = sorted(name for name in change if name.split(".")[0] not in DESIGNED)
    require(
        not foreign,
        "proposal",
        f"a change of {', '.join(foreign)}",
        f"changes of {', '.join(sorted(DESIGNED))} alone",
    )
    proposed = RiseDiConfig.validate_mapping(parameters.changed(change), "controller", check=False)
    yield
    require(proposed.observer is not None, "proposal", "no observer", "one")
    assert proposed.observer is not None  # noqa: S101 - for the type checker
    assert start.observer is not None  # noqa: S101 - a controller that learns has one
    require(
        proposed.observer.states == start.observer.states,
        "controller.observer.states",
        ", ".join(proposed.observer.states),
        f"the states of the initial parameters: {', '.join(start.observer.states)}",
    )
    speeds = _speeds(start)
    require(
        _speeds(proposed) == speeds,
        "controller.schedule",
        _speeds(proposed) or "none",
        f"the speeds of the initial parameters: {speeds or 'none'}",
    )
    least = start.observer.margin
    if start.learn is not None:
        least = start.learn.least_margin(least)
    margin = proposed.observer.margin
    require(
        margin >= least,
        "controller.observer.margin",
        f"{margin:g} s",
        f"at least {least:g} s",
    )
    if bare_outputs := outputs_given_up(parameters):
        others = f"one of other outputs than {', '.join(bare_outputs)}, by learn.without"
        require(proposed.feedforward is not None, "proposal", "no feedforward", others)
        bare = coupled(proposed, bare_outputs)
        proposed = with_fallback(start, proposed, bare)
        require(not all(bare), "proposal", "no model", others)
        yield
    try:
        yield from proposed.checks()
    except ParameterError as error:
        raise ParameterError(f"controller.{error}") from None
    ready = yield from preparing(proposed)
    yield
    return ready


def _speeds(parameters: RiseDiConfig) -> str:
    """Describe the speeds of models and schedule as text; return "" without a schedule."""
    schedule = parameters.schedule
    if schedule is None:
        return ""
    ratios = " and ".join(f"{model.ratio!r}" for model in schedule.models)
    return f"{schedule.speed!r} m/s, {schedule.time!r} s, models at {ratios or 'no'} times it"


def design_changes(old: ControllerConfig, new: ControllerConfig) -> dict[str, Any]:
    """Return what a new design sets: the parameters in DESIGNED of the new set, by dotted name.

    The value None removes a parameter. Two kinds of parameters that the new set lacks get this
    value: those that the old set has, and those in OPTIONAL, which the parameters in force may have
    by then.
    """
    before = _designed_values(old)
    after = _designed_values(new)
    return dict.fromkeys([*before, *OPTIONAL]) | after


def _designed_values(parameters: ControllerConfig) -> dict[str, Any]:
    """Return the parameters that a design sets, which are those in DESIGNED, by dotted name."""
    values = flatten(parameters.model_dump())
    return {name: value for name, value in values if name.split(".")[0] in DESIGNED}


def changes(old: ControllerConfig, new: ControllerConfig) -> dict[str, Any]:
    """Return the values of the new set that differ from the old set, by dotted name.

    The value is None for a parameter that the new set lacks.
    """
    before = dict(flatten(old.model_dump()))
    after = dict(flatten(new.model_dump()))
    return {name: after.get(name) for name in before | after if before.get(name) != after.get(name)}
