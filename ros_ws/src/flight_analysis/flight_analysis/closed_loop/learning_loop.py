# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Define the interface of a learner, and the stations that run it in a flight in one process.

A learner identifies A and B in flight and proposes new parameters of the control law.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from flight_analysis.closed_loop.stations import ControllerStation, Topics
from flight_core.modes import Mode
from flight_core.vectors import FloatArray, StampedVector
from rise_di_controller.controller import Controller
from rise_di_controller.learning.learned_channels import authority_names, outputs_given_up
from rise_di_controller.learning.proposals import (
    AUTHORITY_TICKS,
    Learning,
    Proposal,
    design_changes,
)
from rise_di_controller.rise_di_config import RiseDiConfig


class ModelGuarantee(NamedTuple):
    """The guarantee for a proposal: how far A and B may deviate from its model.

    Within these deviations, stability is proved.
    """

    # Every aircraft is stable if each of its entries differs from the model by at most so many
    # times the stated deviation of this entry. 0 if nothing is proved.
    deviations: float
    loop: str  # digest of the loop, in hexadecimal digits


NO_GUARANTEE = ModelGuarantee(0.0, "0")


class LearnerResult(NamedTuple):
    """Result of an identification in flight: new parameters, or why there are none."""

    controller: RiseDiConfig | None
    sentence: str | None  # None if no identification was due
    # Computes the guarantee of a learned model, which takes about half a second. A learner may call
    # it after its proposal has been sent. None if there is no model, or no guarantee is wanted.
    guarantee: Callable[[], ModelGuarantee] | None = None


class Learner(Protocol):
    """Interface of a learner, which identifies A and B during a flight and proposes parameters.

    The channels of y and u are in the order of the control law.
    """

    def take(self, stamp_ns: int, y: FloatArray, u: FloatArray, flown: int) -> None:
        """Record one tick in which the law was engaged.

        y and u have the shape (m,), and u is the input after the limits were applied. `flown` is
        the digest of the parameters with which the law computed u.
        """

    def propose(self, flown: int, given_up: Sequence[str]) -> LearnerResult:
        """Propose parameters from the ticks that were recorded so far.

        `flown` is the digest of the parameters in force at the last of these ticks. `given_up` has
        the outputs whose model failed, so that the law controls them without a model until it
        disengages.
        """


Learn = Callable[[RiseDiConfig], Learner]


class Entry(NamedTuple):
    """An entry of A or B with its nominal value, and the error of this value as found in flight.

    The nominal value is in SI. `error` is a fraction of `unit`, which is the nominal value, or
    another value if the nominal value is 0. `deviation` is the standard deviation of the error that
    was found, also as a fraction of `unit`.
    """

    matrix: str
    row: str
    column: str
    nominal: float
    error: float
    deviation: float
    unit: float  # value in SI of which `error` and `deviation` are fractions

    @property
    def name(self) -> str:
        """The name of the entry, such as B[q, elevator]."""
        return f"{self.matrix}[{self.row}, {self.column}]"

    @property
    def value(self) -> float:
        """The value of the entry as found in flight, SI."""
        return self.nominal + self.unit * self.error


class Learned(NamedTuple):
    """A sample of the topic `learned`, with the names of its channels.

    The first channel, `proposed`, is 1 if parameters were proposed, else 0. Then follow the values
    of the entries of A and B that act on the outputs, and after them the standard deviations of
    these values. The last three channels are named in GUARANTEE.
    """

    names: tuple[str, ...]
    values: FloatArray


GUARANTEE = ("parameters", "guarantee.deviations", "guarantee.loop")
"""The channels of `learned` on the guarantee of a proposal: the digest of the proposed parameters,
the number of stated deviations, and the first LOOP_DIGITS digits of the loop's digest."""

LOOP_DIGITS = 12
"""Hexadecimal digits of a loop's digest in the log, as in the name of a certificate: a number of 48
bits, which a channel holds exactly."""


def learned_sample(
    entries: Iterable[Entry], outputs: tuple[str, ...], proposal: LearnerResult
) -> Learned:
    """Return the sample of the topic `learned` for an identification and its proposal.

    `entries` has the entries that the identification found. The function computes the guarantee of
    the proposal. If nothing was proposed, the channels of GUARANTEE are 0.
    """
    output_entries = [entry for entry in entries if entry.row in outputs]
    channels = {"proposed": float(proposal.controller is not None)}
    channels |= {f"value.{entry.name}": entry.value for entry in output_entries}
    channels |= {
        f"deviation.{entry.name}": abs(entry.unit) * entry.deviation for entry in output_entries
    }
    digest = 0 if proposal.controller is None else proposal.controller.digest()
    guarantee = NO_GUARANTEE if proposal.guarantee is None else proposal.guarantee()
    kept = (digest, guarantee.deviations, int(guarantee.loop[:LOOP_DIGITS], 16))
    channels |= dict(zip(GUARANTEE, map(float, kept), strict=True))
    return Learned(tuple(channels), np.array(list(channels.values())))


class Identifications:
    """Returns each new identification of a learner once, as a sample of the topic `learned`.

    Some learners make no identification.
    """

    def __init__(self, learner: Learner, outputs: tuple[str, ...]) -> None:
        self._learner = learner
        self._outputs = outputs
        self._last = None
        self._names: tuple[str, ...] = ()

    def next(self, proposal: LearnerResult) -> Learned | None:
        """Return the sample of the topic `learned` for the newest identification and its proposal.

        Returns None if there was no identification since the last call. Call this after the
        proposal has been sent, because it computes the guarantee, which takes long.
        """
        identification = getattr(self._learner, "identification", None)
        if identification is None or identification is self._last:
            return None
        self._last = identification
        entries = {entry.name: entry for entry in identification.entries if entry.nominal}
        # A topic must keep its channels, so the entries of the first identification stay.
        self._names = self._names or tuple(entries)
        return learned_sample((entries[name] for name in self._names), self._outputs, proposal)


def as_received(proposal: LearnerResult, start: RiseDiConfig, end_ns: int, flown: int) -> Proposal:
    """Return a proposal in the form in which the controller receives it.

    `start` are the parameters with which the flight started. `end_ns` is the stamp of the proposal:
    the end of the data that the learner used. `flown` is the digest of the parameters in force at
    this time.
    """
    change = {} if proposal.controller is None else design_changes(start, proposal.controller)
    return Proposal(
        stamp_ns=end_ns,
        start=start.digest(),
        flown=flown,
        change=change,
        sentence=proposal.sentence,
    )


def proposed(
    learner: Learner, learning: Learning, controller: Controller, t_ns: int
) -> LearnerResult:
    """Ask the learner for a proposal at a tick, pass it to the controller, and return it."""
    proposal = learner.propose(controller.digest, outputs_given_up(controller.parameters))
    received = as_received(proposal, learning.start, t_ns, controller.digest)
    learning.receive(received, controller, t_ns)
    return proposal


class ProposalStation:
    """Lets a learner's proposals take effect when they are due, and publishes `authority`.

    If the law diverges, the station returns to the parameters with which the flight started.
    """

    def __init__(self, controller: Controller, learning: Learning, topics: Topics) -> None:
        self._controller = controller
        self._learning = learning
        self._topics = topics
        self.period_ns = controller.period_ns
        topics.advertise("authority", authority_names(controller.parameters.outputs))

    def step(self, t_ns: int) -> None:
        """Let a proposal take effect if it is due, and publish `authority` if this topic is due."""
        self._learning.step(self._controller, t_ns)
        if t_ns % (AUTHORITY_TICKS * self.period_ns) == 0:
            self._topics.publish(
                "authority", StampedVector(t_ns, self._learning.authority(self._controller)), t_ns
            )


class LearnerStation:
    """Passes the ticks of the controller to a learner.

    When an identification is due, the station asks the learner for a proposal.
    """

    def __init__(
        self, station: ControllerStation, learning: Learning, learner: Learner, topics: Topics
    ) -> None:
        self._station = station
        self._learning = learning
        self._learner = learner
        self._topics = topics
        self.period_ns = station.period_ns
        self._identifications = Identifications(learner, learning.start.outputs)

    def step(self, t_ns: int) -> None:
        """Pass the tick to the learner, and ask for a proposal if an identification is due."""
        controller = self._station.controller
        output = self._station.output
        if output is None or not controller.has_internals:
            return
        if controller.mode is Mode.ENGAGED:
            # This is the u of the law. If there is an allocation, `output.u` has the effectors.
            u = controller.state.u
            self._learner.take(output.stamp_ns, output.inputs.y, u, controller.digest)
        if not self._learning.ticked(controller, t_ns):
            return
        proposal = proposed(self._learner, self._learning, controller, t_ns)
        if (identified := self._identifications.next(proposal)) is not None:
            self._topics.advertise("learned", identified.names)
            self._topics.publish("learned", StampedVector(t_ns, identified.values), t_ns)
