# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test which proposals of a learner the controller takes or refuses, in real and simulated time."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest import approx

from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_bringup.graph import LEARNER, parameter_overrides, second_stage
from flight_core.channels import UNKNOWN
from flight_core.modes import Mode
from flight_core.parameters import flatten
from flight_core.rates import NANOSECONDS, nanoseconds
from flight_core.vectors import StampedVector
from rise_di_controller.controller import Controller, ControlOutput
from rise_di_controller.learning.learned_channels import (
    acting_inputs,
    authority,
    authority_names,
    coupled,
    outputs_given_up,
    with_channels_of,
    with_fallback,
    without_models,
)
from rise_di_controller.learning.proposals import (
    DESIGNED,
    Event,
    EventKind,
    Learning,
    Proposal,
    Updates,
    changes,
    design_changes,
)
from rise_di_controller.rise_di_config import LearnConfig, RiseDiConfig

START = find_scenario("osprey_learn").rise_di()
END_NS = 10 * NANOSECONDS  # of the first window


FLATTENED = flatten(find_scenario("osprey_observer").rise_di().model_dump())
CHANGE = {name: value for name, value in FLATTENED if name.split(".")[0] in DESIGNED}
"""A model with its observer and gains."""


class Flight:
    """An engaged controller, and the proposals of its flight."""

    def __init__(self, *, simulated: bool = False) -> None:
        self.controller, self.events = Controller(START), list[Event]()
        self.learning = Learning(START, self.events.append, simulated=simulated)
        self.now_ns = END_NS
        self.engage()

    def engage(self) -> ControlOutput:
        """Run a tick with a new y and y_m."""
        now = StampedVector(self.now_ns, np.zeros(len(START.outputs)))
        self.controller.take_y(now, self.now_ns)
        self.controller.take_y_m(now, self.now_ns)
        output = self.controller.tick(self.now_ns)
        assert self.controller.mode is Mode.ENGAGED
        assert output is not None
        return output

    def receive(self, change: dict[str, Any] | None = None, **replaced: Any) -> None:
        """Receive a proposal with the present stamp."""
        digest = self.controller.digest
        proposal = Proposal(
            stamp_ns=self.now_ns,
            start=START.digest(),
            flown=digest,
            change=CHANGE if change is None else change,
            sentence="model",
        )
        self.learning.receive(proposal._replace(**replaced), self.controller, self.now_ns)

    def step(self, count: int = 20) -> int:
        """Make steps until the parameters change, and return how many it took."""
        for k in range(count):
            if self.learning.step(self.controller, self.now_ns) is not None:
                return k + 1
        return count

    @property
    def sentences(self) -> list[str]:
        """Return the sentences of the events."""
        return [event.sentence for event in self.events]


def test_proposal_flies_after_certificate_in_parts() -> None:
    flight = Flight()
    flight.receive()
    # fields, relations, zeros, filter and feedback, three delays, law, limits, names, the switch
    assert flight.step() == 11
    assert flight.sentences == ["flies model"]
    expected = RiseDiConfig.validate_mapping(START.changed(CHANGE), "expected")
    assert flight.controller.digest == expected.digest()
    assert flight.events[0].change == changes(START, expected)


def test_part_that_is_learned_later_gets_its_feedforward() -> None:
    parameters = RiseDiConfig.validate_mapping(START.changed(CHANGE), "whole")
    lateral = RiseDiConfig.validate_mapping(
        parameters.changed({"feedforward.inputs": ["aileron", "rudder"]}), "lateral"
    )
    flight = Flight()
    inputs = []
    for model in (lateral, parameters):
        flight.receive(design_changes(START, model))
        flight.step()
        flight.now_ns += 10 * NANOSECONDS
        flown = flight.controller.parameters.feedforward
        assert flown is not None
        inputs.append(flown.inputs)
    assert inputs == [("aileron", "rudder"), None]


def test_authority_is_what_the_model_leaves_at_its_lower_bound() -> None:
    def of(flown: RiseDiConfig) -> dict[str, float]:
        return dict(
            zip(authority_names(START.outputs), authority(flown, START).tolist(), strict=True)
        )

    assert set(of(START).values()) == {UNKNOWN}  # no model flies yet
    flight = Flight()
    flight.receive(
        CHANGE | {"feedforward.deviation": [0.05 * abs(value) for value in CHANGE["feedforward.B"]]}
    )
    flight.step()
    parameters = flight.controller.parameters
    assert isinstance(parameters, RiseDiConfig)
    # of the file: 0.98 / s^2 per deg and 30 deg, 0.06 m/s^2 per % and 50 %. Twice 5 % less are 10 %
    # to first order
    assert of(parameters)["up.q"] == approx(0.9 * 0.98 * 30.0, rel=0.01)
    assert of(parameters)["down.V"] == approx(0.9 * 0.06 * 50.0, rel=0.01)
    np.testing.assert_array_equal(
        flight.learning.authority(flight.controller), authority(parameters, START)
    )
    # of aileron, rudder
    mixed = with_channels_of(
        START, parameters, [False, True, True, False], [False, True, False, False]
    )
    assert [of(mixed)[name] for name in ("down.p", "up.p", "up.r")] == [0.0, 0.0, UNKNOWN]
    assert of(mixed)["up.q"] == of(parameters)["up.q"]


def scaled(name: str, factor: float) -> dict[str, Any]:
    return CHANGE | {name: [factor * value for value in CHANGE[name]]}


@pytest.mark.parametrize(
    "change, sentence",
    [
        (
            scaled("feedforward.B", -1.0),
            r"^refused: controller\.feedforward\.B: found a C B with D = \[-1, -1, -1, -1\]",
        ),
        (scaled("observer.F", -1.0), r"^refused: controller\.observer\.F: found a spectral radius"),
        (scaled("observer.L", -1.0), r"^refused: controller\.observer\.L: found a spectral"),
        (scaled("observer.F", 4.0), r"late, expected a delay margin of at"),
        (scaled("observer.Phi", math.nan), r"^refused: controller\.observer\.Phi.*found nan"),
        (scaled("observer.Phi", 1e7), r"^refused: controller\.observer\.L: found a spectral"),
        (
            CHANGE | {"observer.margin": 0.0},
            r"^refused: controller\.observer\.margin: found 0 s, expected at least 0\.02 s",
        ),
        (
            CHANGE | {"D": [-1, 1, 1, 1]},
            r"^refused: proposal: found a change of D, expected changes of",
        ),
        (
            CHANGE | {"observer.states": ["x.q"]},
            r"^refused: controller\.observer\.states: found x\.q",
        ),
        (CHANGE | {"feedforward": 1.0}, r"^refused: feedforward.*: found both a value and a group"),
        ({"observer": None}, r"^refused: proposal: found no observer, expected one"),
    ],
)
def test_lie_is_refused_with_a_sentence(change: dict[str, Any], sentence: str) -> None:
    flight = Flight()
    flight.receive(change)
    flight.step()
    assert flight.controller.digest == START.digest()
    (event,) = flight.events
    assert not event.change
    assert re.search(sentence, event.sentence), event.sentence
    assert event.kind is EventKind.REFUSED


def test_model_that_is_not_proposed_is_said() -> None:
    flight = Flight()
    flight.receive({}, sentence="innovations of q: not white")
    assert flight.sentences == ["no model: innovations of q: not white"]
    assert flight.events[-1].kind is EventKind.NO_MODEL


def test_proposal_for_other_parameters_or_beside_changed_ones_is_refused() -> None:
    flight = Flight()
    flight.receive(start=1)
    flight.receive(flown=1)
    assert "found a proposal for the parameters 1, expected" in flight.sentences[0]
    assert "found a proposal made with the parameters 1, expected" in flight.sentences[1]


def test_proposal_that_loses_the_race_during_its_certificate_is_refused() -> None:
    flight = Flight()
    flight.receive()
    flight.step(1)
    flight.controller.retune(START.model_copy(update={"hold": 1.0}))
    flight.step()
    assert flight.sentences[0].endswith("they changed meanwhile; proposed: model")


def test_input_without_effect_is_held_though_the_law_fell_back_meanwhile(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flight = Flight()
    flight.receive()
    flight.step()
    parameters = flight.controller.parameters
    assert isinstance(parameters, RiseDiConfig)
    flight.now_ns += 10 * NANOSECONDS
    monkeypatch.setattr(flight.controller, "diverging", lambda: ("q",))
    flight.step(1)
    monkeypatch.undo()
    assert flight.controller.digest == START.digest()
    of_q = [name in {"elevator", "thrust"} for name in START.inputs]
    change = design_changes(
        START,
        with_channels_of(START, parameters, of_q, [name == "elevator" for name in START.inputs]),
    )
    flight.receive(flown=parameters.digest())  # a model alone: the law fell back because of one
    flight.receive(change, flown=parameters.digest() + 1)
    # a refusal says what was found all the same: an input without effect stays one
    ends = [
        sentence.endswith("they changed meanwhile; proposed: model")
        for sentence in flight.sentences[-2:]
    ]
    assert ends == [True, True]
    flight.receive(change, flown=parameters.digest())
    flight.step()
    assert flight.sentences[-1] == "flies model"
    assert acting_inputs(flight.controller.parameters) == ("aileron", "rudder")  # type: ignore[arg-type]
    # the law moves it no more
    assert flight.controller.parameters.input_scale[START.inputs.index("elevator")] < 1e-6


def test_second_and_late_proposals_are_refused() -> None:
    flight = Flight()
    flight.receive()
    flight.receive()  # while the first is certified
    flight.step()
    flight.receive()
    flight.receive(stamp_ns=END_NS - nanoseconds(31.0))  # of a learner that was stopped
    flight.receive(stamp_ns=END_NS + 1)  # of another clock
    assert [
        sentence.partition(", expected ")[2].partition(";")[0] for sentence in flight.sentences
    ] == [
        "one at a time",
        "",
        "one that ends at least 1 s after the window of the last proposal",
        "0 to 30 s",
        "0 to 30 s",
    ]
    flight.now_ns += nanoseconds(5.0)
    flight.receive(CHANGE | {"observer.part": 0.5})
    flight.step()
    assert flight.sentences[-1] == "flies model"


def test_empty_proposal_of_a_test_delays_and_refuses_nothing() -> None:
    """An empty proposal tells that a test was passed; it delays and refuses no model.

    The learner tests the aircraft every 2 s, also while a model is certified.
    """
    flight = Flight()
    flight.receive({}, sentence=None)
    flight.receive()  # 0 s later: a proposal would be too soon
    flight.receive({}, sentence=None)  # while that is certified
    flight.step()
    assert flight.sentences == ["flies model"]


def test_storm_of_proposals_costs_one_certificate() -> None:
    flight = Flight()
    for _ in range(1000):
        flight.receive()
    assert len(flight.sentences) == 999
    flight.step()
    assert flight.sentences[-1] == "flies model"


def test_simulated_time_waits_for_each_proposal_that_is_due_and_takes_it_after_latency() -> None:
    flight = Flight(simulated=True)
    acts_ns = END_NS + nanoseconds(4.0)
    flight.learning.ticked(flight.controller, 0)
    assert flight.learning.is_waiting(nanoseconds(4.0))
    flight.receive({}, stamp_ns=0, sentence=None)  # of the first tick, without a rough model
    for now_ns in range(NANOSECONDS, acts_ns + 1, NANOSECONDS):
        flight.learning.ticked(flight.controller, now_ns)
        assert flight.learning.is_waiting(now_ns) is (now_ns >= acts_ns)
    flight.receive()
    flight.receive()
    assert len(flight.sentences) == 1  # it came twice
    assert flight.learning.step(flight.controller, acts_ns - 1) is None
    assert not flight.learning.is_waiting(acts_ns)
    assert flight.learning.step(flight.controller, acts_ns) is not None
    assert flight.sentences[1:] == ["flies model"]


def test_simulated_time_waits_for_no_proposal_of_a_deactivated_law() -> None:
    flight = Flight(simulated=True)
    flight.learning.ticked(flight.controller, 0)
    flight.controller.tick(flight.now_ns, active=False)
    flight.learning.step(flight.controller, flight.now_ns)
    assert not flight.learning.ticked(flight.controller, flight.now_ns)  # an identification is due
    assert not flight.learning.is_waiting(flight.now_ns + nanoseconds(60.0))


def test_identifications_begin_at_their_times_and_then_tests_at_theirs() -> None:
    updates = Updates(LearnConfig(window=30.0, updates=(10.0, 15.0), check=12.0))
    # 55 s of late ticks from 7 s on
    ticks = [7 * NANOSECONDS + nanoseconds(0.011 * k) for k in range(5_000)]
    begins = [(now_ns / NANOSECONDS - 7.0) for now_ns in ticks if updates.is_due(now_ns)]
    assert begins == approx([0.0, 10.0, 15.0, 27.0, 39.0, 51.0], abs=0.011)


def test_latency_above_shortest_spacing_is_refused() -> None:
    with pytest.raises(ValueError, match=r"learn\.latency: found 6 s, expected at most 5 s"):
        find_scenario("osprey_learn").vary(controller={"learn": {"latency": 6.0}})


def test_stale_law_takes_no_model() -> None:
    flight = Flight()
    flight.receive()
    flight.step(3)
    flight.now_ns += nanoseconds(START.max_age) + 1
    flight.controller.tick(flight.now_ns)
    flight.step()
    refusal = "found the mode HOLD, expected a model only while the law is engaged"
    assert flight.sentences == [f"refused: {refusal}; proposed: model"]
    assert flight.controller.digest == START.digest()


def test_deactivated_law_goes_back_to_start_and_takes_models_of_its_next_engagement_alone() -> None:
    flight = Flight()
    flight.receive()
    flight.step()
    assert flight.controller.has_learned_model
    released_ns = flight.now_ns = flight.now_ns + NANOSECONDS
    flight.controller.tick(flight.now_ns, active=False)
    u = flight.controller.state.u
    assert flight.step(1) == 1
    assert flight.sentences[-1] == "goes back to the initial law: it was deactivated"
    assert flight.events[-1].kind is EventKind.RESTART
    assert flight.controller.digest == START.digest()
    assert flight.controller.state.u.tobytes() == u.tobytes()
    assert flight.step(3) == 3  # said once
    flight.now_ns += nanoseconds(3.0)
    flight.engage()
    flight.receive(stamp_ns=released_ns - 1)
    late = "refused: found a window that ends 3 s ago, expected 0 to 3 s; proposed: model"
    assert flight.sentences[-1] == late
    flight.receive()
    flight.step()
    assert flight.sentences[-1] == "flies model"


def test_learner_starts_beside_the_nodes_of_a_scenario_that_learns_but_not_behind_a_bridge(
    tmp_path: Path,
) -> None:
    scenario = find_scenario("osprey_learn")
    assert LEARNER in second_stage(scenario)
    assert LEARNER not in second_stage(scenario.vary(controller={"learn": None}))
    assert parameter_overrides(LEARNER, scenario, tmp_path, 0.0, lockstep=True) == {
        "lockstep": True,
        "scenario_file": str(scenario.path),
    }
    with pytest.raises(
        ValueError, match=r"controller\.learn: found a bridge, expected a simulated aircraft"
    ):
        second_stage(scenario, bridge=True)


def test_part_that_oscillates_flies_the_law_of_the_start_to_the_end_of_the_engagement(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flight = Flight()
    flight.receive()
    flight.step()
    parameters = flight.controller.parameters
    monkeypatch.setattr(flight.controller, "oscillations", lambda: {"q": 0.25})
    flight.step(1)
    monkeypatch.undo()
    fallen = flight.controller.parameters
    assert isinstance(parameters, RiseDiConfig)
    assert isinstance(fallen, RiseDiConfig)
    longitudinal = [name in {"q", "V"} for name in START.outputs]
    assert fallen == without_models(START, parameters, ["q", "V"])
    assert outputs_given_up(fallen) == ("q", "V")
    flight.now_ns += 10_000_000
    logged = dict(zip(flight.controller.names, flight.engage().internals.tolist(), strict=True))
    assert [logged[f"given_up.{name}"] for name in ("q", "V", "p", "r")] == [1.0, 1.0, 0.0, 0.0]
    assert outputs_given_up(without_models(START, fallen, ["r", "p"])) == START.outputs
    assert changes(fallen, with_fallback(START, parameters, longitudinal)) == {
        "learn.without": None
    }
    assert acting_inputs(fallen) == ("aileron", "rudder")
    flight.now_ns += 10 * NANOSECONDS
    # all parts, as of a learner that was started again
    flight.receive(CHANGE | {"observer.fade": 0.5})
    flight.step()
    assert acting_inputs(flight.controller.parameters) == ("aileron", "rudder")  # type: ignore[arg-type]
    flight.now_ns += 10 * NANOSECONDS
    flight.receive(design_changes(START, fallen))  # a later model of p and r
    flight.step()
    assert acting_inputs(flight.controller.parameters) == ("aileron", "rudder")  # type: ignore[arg-type]
    assert flight.sentences[1:] == [
        (
            "falls back to the initial law in q, V, to the end of the engagement: q "
            "oscillates at 4 Hz"
        ),
        "flies model, without q, V",
        "flies model, without q, V",
    ]
    flight.now_ns += NANOSECONDS
    flight.controller.tick(flight.now_ns, active=False)
    flight.step(1)
    flight.now_ns += NANOSECONDS
    flight.engage()
    flight.receive()
    flight.step()
    assert acting_inputs(flight.controller.parameters) == START.inputs  # type: ignore[arg-type]


def test_law_of_the_start_flies_where_all_parts_oscillate() -> None:
    parameters = RiseDiConfig.validate_mapping(START.changed(CHANGE), "whole")
    assert with_fallback(START, parameters, [True] * 4) == START
    assert with_fallback(START, START, [True, False, False, False]) == START
    flight = Flight()
    flight.controller.retune(without_models(START, parameters, START.outputs))
    flight.receive()
    flight.step()
    sentence = (
        "refused: proposal: found no model, expected one of other outputs than q, p, r, "
        "V, by learn.without; proposed: model"
    )
    assert flight.sentences == [sentence]
    flight.now_ns += 10 * NANOSECONDS
    flight.receive({}, sentence=None)  # nothing to say
    assert flight.sentences == [sentence]
    flight.controller.tick(flight.now_ns + NANOSECONDS, active=False)
    flight.step(1)
    assert flight.controller.parameters == START
    assert coupled(parameters, ["r"]) == [name in {"p", "r"} for name in START.outputs]


def diverge(flight: Flight, monkeypatch: pytest.MonkeyPatch, *outputs: str) -> None:
    """Make a step in which outputs diverge.

    The next window for a proposal is 10 s later, and time moves on to it.
    """
    monkeypatch.setattr(flight.controller, "diverging", lambda: outputs)
    flight.step(1)
    monkeypatch.undo()
    flight.now_ns += 10 * NANOSECONDS


def faded(time: float) -> dict[str, Any]:
    """Return a change to a model that differs from CHANGE in one number."""
    return CHANGE | {"observer.fade": time}


def test_parameters_that_diverged_are_not_taken_again_in_the_engagement(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flight = Flight()
    flight.receive()
    flight.step()
    diverge(flight, monkeypatch, "q")
    flight.receive()
    flight.step()
    refusal = "found parameters that diverged in this engagement, expected others"
    assert flight.sentences[1:] == [
        "falls back to the initial law: q diverges",
        f"refused: {refusal}; proposed: model",
    ]
    assert [event.kind for event in flight.events] == [
        EventKind.FLIES,
        EventKind.FALLBACK,
        EventKind.REFUSED,
    ]
    assert flight.controller.digest == START.digest()
    flight.controller.tick(flight.now_ns, active=False)
    flight.step(1)
    flight.now_ns += NANOSECONDS
    flight.engage()
    flight.receive()
    flight.step()
    assert flight.sentences[-1] == "flies model"


def test_part_has_no_further_model_after_its_second_fallback(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A part gets no further model after its second fallback.

    The learner here goes on proposing, like one whose models all have the same fault.
    """
    flight = Flight()
    for time in (0.5, 0.6):
        flight.receive(faded(time))
        flight.step()
        diverge(flight, monkeypatch, "q")
    assert flight.controller.parameters == without_models(START, START, ["q", "V"])
    for time in (0.7, 0.8):
        flight.receive(faded(time))
        flight.step()
        assert acting_inputs(flight.controller.parameters) == ("aileron", "rudder")  # type: ignore[arg-type]
        flight.now_ns += 10 * NANOSECONDS
    assert flight.sentences == [
        "flies model",
        "falls back to the initial law: q diverges",
        "flies model",
        ("falls back to the initial law, in q, V to the end of the engagement: q diverges again"),
        "flies model, without q, V",
        "flies model, without q, V",
    ]
    for time in (0.9, 1.1):  # p and r, which have not fallen back by an error of their own
        diverge(flight, monkeypatch, "p", "r")
        flight.receive(faded(time))
        flight.step()
    assert outputs_given_up(flight.controller.parameters) == START.outputs
    assert flight.sentences[-2].endswith(
        "in p, r to the end of the engagement: p diverges again and r diverges again"
    )
    assert flight.sentences[-1].startswith(
        "refused: proposal: found no model, expected one of other outputs than q, p, r, V"
    )
    flight.controller.tick(flight.now_ns, active=False)
    flight.step(1)
    flight.now_ns += NANOSECONDS
    flight.engage()
    # the fallbacks of the engagement before do not count, nor those of another part
    for time, name in ((0.5, "q"), (0.6, "p")):
        flight.receive(faded(time))
        flight.step()
        assert acting_inputs(flight.controller.parameters) == START.inputs  # type: ignore[arg-type]
        diverge(flight, monkeypatch, name)
    assert outputs_given_up(flight.controller.parameters) == ()


def test_margin_of_a_proposal_is_certified_to_its_end() -> None:
    """A proposed model is certified up to the delay margin that it asks for.

    This one has a margin of 31 ms. A learner that found u 20 ms late asks for 30 ms, and one that
    found 40 ms asks for 50 ms.
    """
    flight = Flight()
    flight.receive(CHANGE | {"observer.margin": 0.05})
    flight.step()
    assert re.search(
        r"unstable with u 50 ms late, expected a delay margin of at least 50 ms",
        flight.sentences[0],
    )
    assert flight.controller.digest == START.digest()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_authority_towards_each_limit_is_that_of_the_limit(sign: float) -> None:
    """The authority towards each limit is the effect times this limit.

    With an effect B of 56.15 / s^2, an elevator between -0.1 and +0.4 rad has 5.615 rad/s^2 in one
    direction and 22.46 in the other.
    """
    parameters = RiseDiConfig.validate_mapping(START.changed(CHANGE), "whole")
    assert parameters.feedforward is not None
    B = tuple(sign * value for value in parameters.feedforward.B)
    model = parameters.feedforward.model_copy(update={"B": B, "deviation": None})
    limits = {"lower": (-0.1, -0.2, -0.3, -0.1), "upper": (0.4, 0.5, 0.6, 0.7)}
    config = parameters.model_copy(update=limits | {"feedforward": model})
    least = dict(
        zip(authority_names(START.outputs), authority(config, START).tolist(), strict=True)
    )
    lower, upper = ("down", "up") if sign > 0.0 else ("up", "down")
    assert least[f"{lower}.q"] == approx(56.1499 * 0.1)
    assert least[f"{upper}.q"] == approx(56.1499 * 0.4)
    assert least[f"{lower}.V"] == approx(6.0 * 0.1)  # 0.06 m/s^2 per %
    assert least[f"{upper}.V"] == approx(6.0 * 0.7)
