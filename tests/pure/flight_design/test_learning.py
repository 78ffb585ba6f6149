# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test learning in the air: a flight that learns, compared with the law alone, and its replay.

Further tests are about wrong proposals, damage and the fallback.
"""

import copy
import json
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import Mock

import numpy as np
import pytest
from pytest import approx
from scipy import stats
from tests.conftest import invoke, refusing
from tests.pure.flight_analysis.test_certificate import run as check
from tests.pure.flight_analysis.test_certificate import signed

import rise_di
from aircraft_sim.airframes.airframe import Airframe, load_airframe
from flight_analysis.closed_loop.learning_loop import GUARANTEE, Entry, Learn, LearnerResult
from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.replay_ticks import vary
from flight_analysis.closed_loop.scenario import Scenario, scenario_yaml
from flight_analysis.closed_loop.scenario_library import find_scenario, save_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.linear_loop.loop_margins import linear_loop, loop_margins
from flight_analysis.report.html import write_page
from flight_analysis.report.model_spans import errors_by_model
from flight_analysis.report.summary import RecordedFlight, summarise
from flight_bringup.fly import fly_in_process
from flight_core.modes import Mode
from flight_core.outcome import COMPLETED, Refusal
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from flight_design.gains.gain_design import selected_observer
from flight_design.gains.observer_search import SelectedObserver
from flight_design.identification.likelihood import Innovations
from flight_design.identification.model_identification import Part, reason_against_innovations
from flight_design.identification.model_quality import Prediction, advantage
from flight_design.identification.model_refusals import Coupling, reason_against_airframe
from flight_design.learning import learner as design_learner
from flight_design.learning import part_checks
from flight_design.learning.change_test import Change
from flight_design.learning.designs import Goal, Known, by_law_of_start, goal
from flight_design.learning.learner import Learner
from flight_design.learning.scenario_learner import learn_again, learner, with_last_model
from flight_log.stored_messages import parameter_changes
from flight_log.tape_reader import read_run
from rise_di_controller.law.linear_loop import (
    LinearPlant,
    LoopTiming,
    closed_loop,
    is_stable,
    linear_law,
)
from rise_di_controller.learning.learned_channels import (
    acting_inputs,
    authority,
    authority_names,
    without_models,
)
from rise_di_controller.learning.proposals import Updates
from rise_di_controller.rise_di_config import LearnConfig, RiseDiConfig

pytestmark = pytest.mark.slow

SWITCH = 18.0  # s, when the model of the first 18 s flies
END = 25.0  # s
NAMES = ("q", "V", "p", "r")


def scenario(**changed: Any) -> Scenario:
    """Return osprey_learn at 100 Hz for 25 s.

    A model is identified after 11 s, and 7 s more must confirm it.
    """
    return find_scenario("osprey_learn").vary(
        flight={"duration": END},
        aircraft={"rate": 100.0, "step": 0.005},
        reference_model={"rate": 100.0},
        controller={"learn": {"updates": [11.0, 18.0], "latency": SWITCH - 18.0}} | changed,
    )


class Flown(NamedTuple):
    """A flight that learns."""

    run: Path
    lines: list[str]  # what its learner said
    learner: Learner


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    run = tmp_path_factory.mktemp("learn")
    lines = list[str]()
    chosen = save_scenario(scenario(), run / "learn.yaml")
    learned = made_learner(chosen)
    assert (
        fly_in_process(chosen, run, lambda t, text: None, lambda _: learned, lines.append)
        == COMPLETED
    )
    return Flown(run, lines, learned)


class Taught(NamedTuple):
    """What `rise-di learn` makes from the log of this flight."""

    output: str
    model: Path
    certificate: Path


@pytest.fixture(scope="module")
def taught(flown: Flown, tmp_path_factory: pytest.TempPathFactory) -> Taught:
    folder = tmp_path_factory.mktemp("taught")
    model, certificate = folder / "model.yaml", folder / "learned.json"
    result = invoke("learn", flown.run, "--write", model, "--certificate", certificate)
    assert result.exit_code == 0, result.output
    return Taught(" ".join(result.output.split()), model, certificate)


@cache
def maker(text: str) -> Learn:
    """Return what makes the learners of a scenario. They share the design for the rough model."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scenario.yaml"
        path.write_text(text)
        make = learner(find_scenario(str(path)))
    assert make is not None
    return make


def made_learner(chosen: Scenario) -> Learner:
    made = maker(scenario_yaml(chosen))(chosen.rise_di())
    assert isinstance(made, Learner)
    return made


def found(*parts: Part) -> Any:
    """Return an identification with these parts."""
    return SimpleNamespace(parts=parts, remarks=(), airframe=load_airframe("osprey"))


def record_rest(made: Learner) -> None:
    """Record 10 s at rest with the initial law."""
    for k in range(1001):
        made.take(k * 10_000_000, np.zeros(4), np.zeros(4), 0)


def error(tape: Tape, first: float, last: float) -> FloatArray:
    """Return the true rms error of q, V, p, r between two flight times, s."""
    truth = tape["truth"]
    y_m = tape["y_m"]
    within = (tape.time("y_m") >= first) & (tape.time("y_m") < last)
    return np.array(
        [np.sqrt(np.mean((truth[f"x.{name}"] - y_m[name])[within] ** 2)) for name in NAMES]
    )


def plant_of(airframe: Airframe, controller: RiseDiConfig) -> LinearPlant:
    """Return an airframe in the order of a controller, with gravity in A."""
    rows = [airframe.outputs.index(name) for name in controller.outputs]
    columns = [list(airframe.inputs).index(name) for name in controller.inputs]
    A = airframe.matrix_a() + airframe.matrix_gravity()
    return LinearPlant(A, airframe.matrix_b()[:, columns], airframe.matrix_c()[rows])


class Fixed:
    """A learner whose proposals are given."""

    def __init__(self, *proposals: RiseDiConfig | None) -> None:
        self._proposals = list(proposals)

    def take(self, stamp_ns: int, y: FloatArray, u: FloatArray, flown: int) -> None:
        """Learn nothing."""

    def propose(self, flown: int, given_up: Sequence[str]) -> LearnerResult:
        """Return the next given proposal."""
        return LearnerResult(self._proposals.pop(0), "given")


def test_replay_of_learning_flight_is_equal_to_the_bit(flown: Flown) -> None:
    result = replay(flown.run)
    assert result.is_equal()
    assert result.is_compared.all()
    assert any("observer.part" in note for note in result.notes)


def test_learned_model_lowers_errors_without_jump_of_u(flown: Flown) -> None:
    run, lines, _ = flown
    tape = read_run(run).tape
    alone = simulate(scenario(learn=None))
    before = error(alone, SWITCH, END)
    after = error(tape, SWITCH, END)
    # the model of the second simulator of the prototype: 1.64 to 0.81 in all outputs together, here
    # at least a fifth less
    units = np.array([0.01, 0.1, 0.02, 0.01])
    assert np.sum(after / units) < 0.8 * np.sum(before / units)
    u = tape["u"].values
    t = tape.time("u")
    step = np.abs(np.diff(u, axis=0))
    at = int(np.searchsorted(t, SWITCH))
    # in turbulence u moves in each tick; u_o goes to -F z within `observer.within`, 0.1 s: 31 mrad
    # or 3 % a tick, and u_ff of the rudder has 8 mrad a tick along the y_m of this roll
    assert (step[at - 1] <= step[at - 200 : at - 1].max(axis=0) + 0.04).all()
    assert len(lines) == 3
    assert "flies the airframe osprey as it is" in lines[0]
    assert "no model: q and V: a first model, which later seconds have to prove" in lines[1]
    assert "B[p, aileron]" in lines[2]
    assert (run / "log" / "learner.log").read_text().splitlines() == lines


def test_feedforward_goes_on_in_the_turn_that_was_commanded_before_the_switch(flown: Flown) -> None:
    """The model flies from 18 s on, which is during a turn.

    The reference is a flight in which it already flew before the turn.
    """
    model = scenario().rise_di()
    for change in parameter_changes(flown.run, "/controller", RiseDiConfig.model_fields):
        varied = vary(model, change)
        assert isinstance(varied, RiseDiConfig)
        model = varied
    before = simulate(scenario(**model.model_dump() | {"learn": None}))
    learned, whole = (
        tape["internals"]["u_ff.rudder"][-600:] for tape in (read_run(flown.run).tape, before)
    )
    # sideslip of the two models in the first seconds of the turn; with a wings-level begin the
    # difference is 0.8 rad
    assert np.max(np.abs(learned - whole)) < 0.1


def test_log_teaches_what_flight_taught_and_model_starts_next_flight(
    flown: Flown, taught: Taught
) -> None:
    assert flown.lines[-1].partition(" flies ")[2] in taught.output
    B = load_airframe(taught.model).matrix_b()
    of_file = load_airframe("osprey").matrix_b()
    found = {entry.name: entry.error for entry in flown.learner.identification.entries}  # type: ignore[union-attr]
    assert B[2, 0] / of_file[2, 0] - 1.0 == approx(found["B[q, elevator]"])
    assert learner(scenario(learn={"prior": {"file": str(taught.model)}})) is not None
    with refusing(
        r"^controller\.learn\.prior\.file: found an airframe with another name, expected a "
        r"model of"
    ):
        learner(scenario(learn={"prior": {"file": "navion_lateral"}}))


def test_log_has_the_guarantee_of_the_model_that_flies(flown: Flown) -> None:
    """Corners of the box at the logged size are stable, by the exact loop of each aircraft."""
    run, _, made = flown
    tape = read_run(run).tape
    rows = tape["learned"]
    assert rows["proposed"].tolist() == [0.0, 1.0]
    assert [rows[name][0] for name in GUARANTEE] == [0.0, 0.0, 0.0]  # nothing was proposed
    digest, deviations, loop = (rows[name][1] for name in GUARANTEE)
    assert digest == tape["internals"]["parameters"][-1]
    assert deviations > 2.0
    model = made.model
    assert model is not None
    controller = scenario().rise_di()
    for change in parameter_changes(run, "/controller", RiseDiConfig.model_fields):
        controller = vary(controller, change)  # type: ignore[assignment]
    assert controller.digest() == digest
    drawn = np.random.default_rng(5).choice([-1.0, 1.0], (300, 26))
    part = {
        name: value for known in made._known.values() for name, value in known.deviation.items()
    }
    assert len(part) == drawn.shape[1]
    A, B = (np.repeat(each()[None], 300, axis=0) for each in (model.matrix_a, model.matrix_b))
    columns = {"A": list(model.states), "B": list(model.inputs)}
    for (name, deviation), signs in zip(part.items(), drawn.T, strict=True):
        row, column = name[2:-1].split(", ")
        matrix = A if name[0] == "A" else B
        place = model.index(row), columns[name[0]].index(column)
        matrix[:, *place] *= 1.0 + deviations * deviation * signs
    linear = linear_loop(controller, model, A, B)
    z = np.linalg.eigvals(closed_loop(linear.plant, linear.law, linear.loop, np.zeros(4)))
    assert np.abs(z).max() < 1.0 + 1e-6
    span = errors_by_model(tape)[-1]
    assert span.stable == deviations
    assert int(span.loop, 16) == loop


def test_certificate_of_the_learned_model_is_proved_and_an_altered_one_is_refused(
    flown: Flown, taught: Taught, tmp_path: Path
) -> None:
    """The log names the loop of the certificate, and its constants are those of an export."""
    rows = read_run(flown.run).tape["learned"]
    within = f"{np.floor(10.0 * rows[GUARANTEE[1]][1]) / 10.0:.1f} stated deviations of the model"
    assert f"stable for every aircraft within {within}" in taught.output
    content = json.loads(taught.certificate.read_text())
    assert int(content["loop"][:12], 16) == rows[GUARANTEE[2]][1]
    constants = tmp_path / "c" / "rise_di_parameters.h"
    rise_di.export(flown.run / "learn.yaml", tmp_path / "c", run=flown.run, proof=False)
    done = check(content, tmp_path, str(constants))
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("PROVED")
    wider = signed(content | {"size": 1.5 * content["size"]})
    other = copy.deepcopy(content)
    other["B"][2][0] *= 0.5
    for altered, reason in (
        (wider, "not proved"),
        (signed(other), "B[q,elevator]"),
        (other, "digest"),
    ):
        refused = check(altered, tmp_path)
        assert refused.returncode != 0
        assert not refused.stdout.startswith("PROVED")
        assert reason in refused.stderr, refused.stderr


def test_page_says_within_which_deviations_the_last_model_is_stable(
    flown: Flown, tmp_path: Path
) -> None:
    run = read_run(flown.run)
    flight = RecordedFlight("learns", scenario(), run.tape, summarise(run.tape, scenario()))
    write_page(tmp_path / "page.html", [flight])
    page = " ".join((tmp_path / "page.html").read_text().split())
    deviations = run.tape["learned"]["guarantee.deviations"][-1]
    assert f"within {int(10.0 * deviations) / 10.0:.1f} of their stated deviations" in page
    assert "stable within (deviations)" in page


def test_log_teaches_with_other_settings(flown: Flown, monkeypatch: pytest.MonkeyPatch) -> None:
    """The flight has other parameters than the ones this learner proposes.

    The learner knows no refusal, and identifies once per window.
    """
    proven = flown.learner.identification
    assert proven is not None
    unproven_parts = tuple(part._replace(advantage=0.0) for part in proven.parts)
    identified = Mock(side_effect=[proven._replace(parts=unproven_parts), proven])
    monkeypatch.setattr(design_learner, "identify_model", identified)
    result = invoke("learn", flown.run, "--set", "controller.learn.updates=[10,20]")
    assert result.exit_code == 0, result.output
    first, second = (line for line in result.output.splitlines() if line.startswith("t ="))
    unproven = "t = 10.00 s: no model: q and V: a first model, which later seconds have to"
    assert first.startswith(unproven), result.output
    assert second.startswith("t = 20.00 s: B["), result.output
    lengths = [len(call.args[0].t) for call in identified.call_args_list]
    assert lengths == [1001, 2001]  # of the record


def test_last_model_of_a_run_is_exported_without_learn(flown: Flown, tmp_path: Path) -> None:
    chosen = scenario()
    last = with_last_model(chosen, read_run(flown.run)).rise_di()
    assert last.learn is None
    assert last.models() == flown.learner._last.models() != chosen.rise_di().models()
    exported = rise_di.export(chosen, tmp_path, run=flown.run, duration=1.0, drawn=100)
    assert exported.proof is not None
    assert exported.proof.is_proved  # C has the bits of Python in flights of the learned model
    with refusing("controller.learn: found a section, expected none: C code replaces"):
        rise_di.export(chosen, tmp_path, proof=False)
    other = chosen.vary(controller={"ramp": 1.0})
    with refusing("run: found a flight with other parameters, expected the parameters of"):
        with_last_model(other, read_run(flown.run))


def test_deactivated_law_ends_the_record_of_a_log(flown: Flown) -> None:
    tape = read_run(flown.run).tape
    ticks = tape["internals"]
    t = tape.time("internals")
    changed = ticks.values.copy()
    changed[(t > 5.0) & (t < 6.0), ticks.names.index("mode")] = Mode.INACTIVE
    # from there on y is two ticks late: an instant is that of the tick
    changed[t > 2.0, ticks.names.index("age")] = 0.02
    cut = replace(
        tape, signals={"internals": Signal(ticks.stamp_ns[t < 9.5], ticks.names, changed[t < 9.5])}
    )
    steps = learn_again(cut, scenario(learn={"updates": [3.0]})).steps
    # 3 s from the first tick of either engagement
    assert [step.t for step in steps] == approx([3.0, 9.0], abs=0.021)
    assert [step.sentence for step in steps] == [
        f"record: found {length} s, expected 10 s" for length in (2.99, 3.01)
    ]
    with refusing(r"^the log: found at most 5\.02 s of ticks of an active controller"):
        learn_again(cut, scenario(learn={"updates": [6.0]}))


def test_log_without_outputs_that_controller_gave_up_is_refused(flown: Flown) -> None:
    tape = read_run(flown.run).tape
    ticks = tape["internals"]
    kept = [k for k, name in enumerate(ticks.names) if not name.startswith("given_up.")]
    bare = Signal(ticks.stamp_ns, tuple(ticks.names[k] for k in kept), ticks.values[:, kept])
    with refusing(
        r"^the log: found no channels given_up\.\* of internals, expected a log that has"
    ):
        learn_again(replace(tape, signals={"internals": bare}), scenario())


def test_lost_ticks_are_unknown_in_record() -> None:
    made = made_learner(scenario())
    period_ns = 10_000_000
    for k in (0, 1, 3, 3, 6):
        made.take(k * period_ns + 400, np.full(4, float(k)), np.array([1.0, 2.0, 3.0, 4.0]) * k, 0)
    recorded = made._record.recording()
    # y is q, p, r, V in the law and q, V, p, r in the airframe; u is held
    np.testing.assert_array_equal(recorded.y[:, 0], [0.0, 1.0, np.nan, 3.0, np.nan, np.nan, 6.0])
    np.testing.assert_array_equal(
        recorded.u, np.outer([0.0, 1.0, 1.0, 3.0, 3.0, 3.0, 6.0], [1.0, 4.0, 2.0, 3.0])
    )


def test_short_record_is_refused() -> None:
    made = made_learner(scenario())
    assert made.propose(0) == LearnerResult(None, "record: found 0 s, expected 10 s")
    for t in (0, 5):  # the ticks between them are lost
        made.take(t * NANOSECONDS, np.zeros(4), np.zeros(4), 0)
    assert made.propose(0) == LearnerResult(None, "record: found 5.01 s, expected 10 s")


def test_identification_is_due_where_last_proposal_does_not_fly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = made_learner(scenario(learn={"updates": [15.0]}))
    identified = Mock(return_value=found())
    monkeypatch.setattr(design_learner, "identify_model", identified)
    record_rest(made)
    rough = made.propose(scenario(learn={"updates": [15.0]}).rise_di().digest()).controller
    assert rough is not None
    assert made.propose(rough.digest()) == LearnerResult(None, None)
    identified.assert_not_called()
    # it is yet to act
    assert made.propose(0) == LearnerResult(None, None)
    for k in range(1001, 1500):
        made.take(k * 10_000_000, np.zeros(4), np.zeros(4), 0)
    # other parameters fly: the proposal was refused, or the controller fell back
    assert made.propose(0).sentence == "each part already has the initial law"
    identified.assert_called_once()


def test_the_rough_model_flies_until_it_fell_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """A rough model is designed for errors, and flies together with learned parts.

    After a fallback, the initial law flies.
    """
    made = made_learner(scenario())
    start = scenario().rise_di()
    rough = made.propose(start.digest()).controller
    assert rough is not None
    assert rough.feedforward is not None
    assert rough.feedforward.inputs is None  # of all parts
    assert made.model is None  # nothing is learned
    entry = Entry("B", "q", "elevator", 56.15, 0.1, 0.01, 56.15)
    refused = lateral()._replace(refusal=Refusal("none"))
    unproven = lateral()._replace(outputs=("q", "V"), entries=(entry, THRUST))
    learned = unproven._replace(advantage=1.7)
    parts = [(unproven, refused), (learned, refused), (learned, refused)]
    identified = Mock(side_effect=[found(*each) for each in parts])
    monkeypatch.setattr(design_learner, "identify_model", identified)
    for k in range(1001):
        made.take(k * 10_000_000, np.zeros(4), np.zeros(4), rough.digest())
    made._planned.appendleft(0)  # an identification is due
    assert made.propose(rough.digest()).controller is None
    made._planned.appendleft(0)
    # the model that was found is tested on what is later than its record
    mixed = made.propose(rough.digest()).controller
    assert mixed is not None
    tested = identified.call_args.kwargs
    assert tested["after"] == approx(10.0)
    assert tested["flown"].matrix_b()[2, 0] == approx(1.1 * 56.15)
    assert acting_inputs(mixed) == start.inputs
    # other parameters fly than any proposal, as after a fallback; it has had the time to act
    for k in range(1002, 2200):
        made.take(k * 10_000_000, np.zeros(4), np.zeros(4), 1)
    after = made.propose(1).controller
    assert after is not None
    assert acting_inputs(after) == ("elevator", "thrust")


@pytest.mark.parametrize("advantage, flies", [(0.0, False), (-2.0, False), (-1.0, True)])
def test_first_model_about_a_sketch_waits_for_later_seconds(
    advantage: float, flies: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An advantage of 0 means that there was no model to test.

    The limit is 1.645 standard deviations, which chance exceeds in 5 % of cases.
    """
    made = learner_that_finds(lateral()._replace(advantage=advantage), monkeypatch)
    made._is_sketch = True
    assert (made.propose(0).controller is not None) is flies


@pytest.mark.parametrize("advantage, is_back", [(-2.0, True), (-1.0, False)])
def test_refused_part_goes_back_to_the_file_that_predicts_better(
    advantage: float, is_back: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file must predict better by 1.645 standard deviations, 5 % by chance.

    Otherwise the last model stays.
    """
    made = learner_that_finds(lateral(), monkeypatch)
    first = made.propose(0)
    assert first.controller is not None
    assert ("p", "r") in made._known
    refused = lateral(whiteness=9.0)._replace(advantage=advantage)
    monkeypatch.setattr(design_learner, "identify_model", lambda *_, **__: found(refused))
    made._planned.appendleft(0)  # an identification is due
    after = made.propose(first.controller.digest())
    assert (("p", "r") not in made._known) is is_back
    assert "innovations of r: found a whiteness of 9" in str(after.sentence)
    if is_back:
        # this learner's file was refused before, by the digest 0 that flew
        assert "p and r by the initial law: the file predicts" in str(after.sentence)
        assert after.controller is not None
        assert after.controller.observer is not None
        assert after.controller.observer.part == 0.0  # no observer flies


@pytest.mark.parametrize("begin", [0, 250])
def test_advantage_has_the_probability_of_the_t_test_of_the_spans(begin: int) -> None:
    generator = np.random.default_rng(0)
    first, second = generator.normal(size=(2, 305))
    r = np.zeros((305, 1))
    second[257] = np.nan  # a lost sample counts for neither
    counted = np.isfinite(second) & (np.arange(305) >= begin)
    z = advantage(Innovations(r, r, first), Innovations(r, r, second), 10, counted)
    sums = np.nansum((first - second)[begin:300].reshape(-1, 10), axis=1)
    probability = stats.ttest_1samp(sums, 0.0, alternative="greater").pvalue
    assert stats.norm.sf(z) == approx(probability)
    assert advantage(Innovations(r, r, first), Innovations(r, r, first), 10, counted) == 0.0


def test_entry_that_the_record_shows_at_its_bound_is_refused() -> None:
    """An entry that the record hardly shows may be at its bound.

    Such an entry has at least half of its deviation before the flight.
    """
    hidden = Entry("B", "p", "rudder", 1.0, -0.6, 0.2, 1.0)
    assert reason_against_airframe([hidden], "osprey", allowed=1) is None
    shown = hidden._replace(deviation=0.06)
    assert "found B[p, rudder] at a bound" in str(
        reason_against_airframe([shown], "osprey", allowed=1)
    )


def test_a_rougher_file_widens_the_bounds_of_the_search() -> None:
    # twice the deviation of +-50 %: the square of the largest factor
    made = made_learner(scenario(learn={"prior": {"off": 0.58}}))
    assert made._believed.factor == approx(2.5**2)
    far = [Entry("B", "q", "elevator", 56.15, 3.0, 0.05, 56.15)]
    assert "at a bound of the search, 0.4 or 2.5 times" in str(
        reason_against_airframe(far, "osprey")
    )
    assert reason_against_airframe(far, "osprey", factor=made._believed.factor) is None


def test_model_with_coupling_is_not_replaced_by_one_of_a_part(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = made_learner(scenario(learn={"updates": [10.0], "latency": 0.0}))
    start = scenario().rise_di()
    entry = Entry("B", "q", "elevator", 56.15, 0.1, 0.01, 56.15)

    def part(outputs: tuple[str, ...], *entries: Entry) -> Part:
        return lateral()._replace(outputs=outputs, entries=entries)

    whole = part(NAMES, entry, Entry("B", "p", "elevator", 0.0, 0.3, 0.01, 29.0))
    apart = (part(("q", "V"), entry, THRUST), part(("p", "r"), *LATERAL))
    worse_than_file = tuple(each._replace(advantage=-2.0) for each in apart)
    parts = [(whole,), apart, worse_than_file]
    identified = Mock(side_effect=[found(*each) for each in parts])
    monkeypatch.setattr(design_learner, "identify_model", identified)
    monkeypatch.setattr(made, "_design", lambda *_: SelectedObserver(start, 0.03, 0.6, ONES, 0.0))
    record_rest(made)
    assert made.propose(0).sentence == "B[q, elevator] +10 +- 1 %, with coupling"
    assert made.model is not None
    assert made.model.matrix_b()[5, 0] == approx(0.3 * 29.0)
    made._planned.appendleft(0)  # an identification is due
    refused = made.propose(0)
    assert refused.controller is None
    assert str(refused.sentence).startswith(
        "q and V: found no model with coupling, expected one, like the model in use; p and r"
    )
    # the search begins at the model in use too
    assert [call.kwargs["flown"] for call in identified.call_args_list] == [None, made.model]
    made._planned.appendleft(0)
    # a model with coupling that predicts worse than the file by two deviations is forgotten
    assert str(made.propose(0).sentence).startswith("no coupling any more: the file predicts")
    assert made.model.matrix_b()[5, 0] == 0.0


def test_parts_that_couple_do_not_fly_separate_models_and_are_told_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = learner_that_finds(lateral(), monkeypatch)
    refusal = Coupling("coupling: found innovations of a part that follow another part")
    parts = [part._replace(refusal=refusal) for part in 2 * [lateral()]]
    monkeypatch.setattr(design_learner, "identify_model", lambda *_, **__: found(*parts))
    assert made.propose(0) == LearnerResult(None, str(refusal))


def test_part_that_the_controller_took_back_is_not_proposed_again(
    flown: Flown, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(design_learner, "change_test", lambda *arguments: [])
    # Each identification finds what the flight found.
    identification = flown.learner.identification
    monkeypatch.setattr(design_learner, "identify_model", lambda *_, **__: identification)
    start = scenario().rise_di()
    model = start
    for change in parameter_changes(flown.run, "/controller", RiseDiConfig.model_fields):
        varied = vary(model, change)
        assert isinstance(varied, RiseDiConfig)
        model = varied
    fallen = without_models(start, model, ["q", "V"])
    learned = copy.deepcopy(flown.learner)
    # all but this part is as proposed
    assert learned.propose(fallen.digest(), ["q", "V"]) == LearnerResult(None, None)
    learned = copy.deepcopy(flown.learner)
    learned.propose(model.digest())
    # a later proposal, which lost the race with the fallback
    learned._proposed = 0
    learned._last = start
    learned._planned.appendleft(0)  # an identification is due
    again = learned.propose(fallen.digest(), ["q", "V"]).controller
    assert again is not None
    assert acting_inputs(again) == ("aileron", "rudder")
    restarted = made_learner(scenario())  # it has proposed nothing yet
    restarted._design_of_rough = None  # the file was refused
    restarted._record = learned._record
    restarted._first_ns = learned._first_ns
    fresh = restarted.propose(
        without_models(start, start, ["q", "V"]).digest(), ["q", "V"]
    ).controller
    assert fresh is not None
    assert acting_inputs(fresh) == ("aileron", "rudder")
    none_left = without_models(start, fresh, ["p", "r"]).digest()
    sentences = [restarted.propose(none_left, NAMES).sentence for _ in range(2)]
    assert sentences == [
        "no part is left to learn: each lacks an input or has the initial law",
        None,
    ]


DEAD_RUDDER = Change(("p", "r"), 60.0, {"aileron": 1.0, "rudder": 0.05}, "rudder")
WEAK_AILERON = Change(("p", "r"), 20.0, {"aileron": 0.5, "rudder": 1.0}, "")


def learned_part(monkeypatch: pytest.MonkeyPatch, change: Change) -> tuple[Learner, int]:
    """Return a learner whose p and r are learned and then change, and the digest of what flies."""
    made = learner_that_finds(lateral(), monkeypatch)
    proposed = made.propose(0).controller
    assert proposed is not None
    for k in range(1001, 1201):
        made.take(k * 10_000_000, np.zeros(4), np.zeros(4), proposed.digest())
    monkeypatch.setattr(made, "_changes", lambda _: [change])
    return made, proposed.digest()


def test_part_flies_without_a_dead_input_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made, flown = learned_part(monkeypatch, DEAD_RUDDER)
    identified = Mock(side_effect=AssertionError)  # a test tells: 10 s of record would be too late
    monkeypatch.setattr(design_learner, "identify_model", identified)
    proposal = made.propose(flown)
    assert proposal.sentence == ("rudder has no effect: p and r without it, by the initial law")
    assert proposal.controller is not None
    names = authority_names(proposal.controller.outputs)
    effects = authority(proposal.controller, scenario().rise_di()).tolist()
    assert dict(zip(names, effects, strict=True))["up.r"] == 0.0
    assert made.model is None


def test_output_with_a_whole_input_keeps_the_design_for_the_file(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made, flown = learned_part(monkeypatch, DEAD_RUDDER)
    file = find_scenario("osprey_observer").rise_di()
    made._design_of_rough = Mock(return_value=Mock(controller=file))
    proposal = made.propose(flown)
    assert proposal.sentence == ("rudder has no effect: p and r without it, r by the initial law")
    assert proposal.controller is not None
    assert acting_inputs(proposal.controller) == ("elevator", "aileron", "thrust")


def test_part_without_elevator_or_without_the_file_flies_by_the_law() -> None:
    """The observer of V needs a controlled pitch.

    A design for the file may fly only if there is one.
    """
    start = scenario().rise_di()
    dead: dict[tuple[str, ...], str] = {("q", "V"): "elevator", ("p", "r"): "aileron"}
    assert by_law_of_start(start, dead, has_file=True) == {"q", "V", "p"}
    assert by_law_of_start(start, dead, has_file=False) == {"q", "V", "p", "r"}
    assert by_law_of_start(start, {("q", "V"): "thrust"}, has_file=True) == {"V"}
    assert by_law_of_start(start, {("p", "r"): None}, has_file=True) == {"p", "r"}


def test_part_without_an_input_states_the_margin_of_its_own_loop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Output r flies by the initial law, which has another delay margin than the design."""
    made, flown = learned_part(monkeypatch, DEAD_RUDDER)
    proposed = made.propose(flown).controller
    assert proposed is not None
    assert proposed.observer is not None
    frame = made._model
    loop = linear_loop(proposed, frame, frame.matrix_a()[None], frame.matrix_b()[None])
    undelayed = loop._replace(loop=loop.loop._replace(delay=0.0))
    own = loop_margins(undelayed).delay
    assert proposed.observer.margin == pytest.approx(min(own - 3e-4, 0.03), abs=1e-6)


def test_dead_input_is_told_where_no_controller_without_it_is_stable(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made, flown = learned_part(monkeypatch, DEAD_RUDDER)
    refusal = ParameterError("proposal.observer.margin: found a nominal loop that is unstable")
    monkeypatch.setattr(made, "_designed", Mock(side_effect=refusal))
    assert made.propose(flown) == LearnerResult(None, f"rudder has no effect; refused: {refusal}")
    assert made.model is not None  # that of what flies


def test_part_that_changed_is_told_at_once_and_identified_from_the_record_since(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made, flown = learned_part(monkeypatch, WEAK_AILERON)
    told = made.propose(flown)
    assert told == LearnerResult(
        None, "p and r changed, log-likelihood 20: aileron has 50 % of its effect"
    )
    monkeypatch.setattr(made, "_changes", lambda _: [])
    assert made.propose(flown) == LearnerResult(None, None)  # 4 s of record are left
    for k in range(1201, 2001):
        made.take(k * 10_000_000, np.zeros(4), np.zeros(4), flown)
    again = made.propose(flown)
    assert str(again.sentence).startswith("B[p, aileron] +10")
    assert again.controller is not None


def test_effect_that_gusts_hide_does_not_replace_a_stronger_one() -> None:
    flown = load_airframe("osprey")
    effects = (
        Entry("B", "q", "elevator", 56.1499, -0.3, 0.02, 56.1499),
        Entry("B", "V", "thrust", 6.0, 0.0, 0.01, 6.0),
    )
    part = lateral()._replace(outputs=("q", "V"), entries=effects, has_gusts=True)
    assert str(part_checks.reason_against_effects(part, flown)).startswith(
        "B[q, elevator]: found 70 % of the effect in the model in use"
    )
    # a first model, one without gusts, and one that is within the deviation that is allowed
    assert part_checks.reason_against_effects(part, None) is None
    assert part_checks.reason_against_effects(part._replace(has_gusts=False), flown) is None
    near = effects[0]._replace(error=-0.09), effects[1]
    assert part_checks.reason_against_effects(part._replace(entries=near), flown) is None


@pytest.mark.parametrize("whiteness, refused", [(2.9, False), (3.1, True), (3.6, True)])
def test_part_with_coloured_innovations_is_refused_from_the_limit_on(
    whiteness: float, refused: bool
) -> None:
    """The limit is 3, and a model above it is refused, even by a factor of 1.2."""
    refusal = reason_against_innovations(lateral(whiteness=whiteness))
    assert (refusal is not None) is refused
    assert not refused or str(refusal) == (
        f"innovations of r: found a whiteness of {whiteness:g}, expected at most 3, 1 being white"
    )


THRUST = Entry("B", "V", "thrust", 6.0, 0.0, 0.29, 6.0)
"""An effect that the flight has not shown."""
LATERAL = (
    Entry("B", "p", "aileron", 85.9437, 0.1, 0.05, 85.9437),
    Entry("B", "r", "rudder", 9.74028, -0.2, 0.08, 9.74028),
)
"""Effects that a flight showed, with deviations: of the aileron 10 % more than in the file, of the
rudder 20 % less."""


def lateral(*, whiteness: float = 1.0, latest: float = 0.0) -> Part:
    """Return the part of p and r as identified."""
    before = Prediction(np.ones(2), np.full(2, 9.0), 1.0)
    after = Prediction(np.ones(2), np.array([1.0, whiteness]), 2.0)
    inputs = ("aileron", "rudder")
    return Part(inputs, ("p", "r"), LATERAL, before, after, None, (latest, latest), has_gusts=False)


def learner_that_finds(part: Part, monkeypatch: pytest.MonkeyPatch, **learn: Any) -> Learner:
    """Return a learner with a record of 10 s, whose search finds a part."""
    made = made_learner(scenario(learn={"updates": [10.0]} | learn))
    monkeypatch.setattr(design_learner, "identify_model", lambda *_, **__: found(part))
    record_rest(made)
    return made


def test_guidance_gets_effects_less_two_deviations_of_what_was_learned(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The effect is B exp(-2 s) times the limit of 0.523599 rad.

    s is relative to the value that was found.
    """
    proposed = learner_that_finds(lateral(), monkeypatch).propose(0).controller
    assert proposed is not None
    least = dict(
        zip(
            authority_names(proposed.outputs),
            authority(proposed, scenario().rise_di()).tolist(),
            strict=True,
        )
    )
    assert least["up.p"] == approx(1.1 * 85.9437 * np.exp(-2.0 * 0.05 / 1.1) * 0.523599)
    assert least["down.r"] == approx(0.8 * 9.74028 * np.exp(-2.0 * 0.08 / 0.8) * 0.523599)


@pytest.mark.parametrize(
    "latest, asked, margin",
    [
        (0.008, None, 0.03),  # 8 and 10 ms are within the 30 ms of the start
        (0.024, None, 0.034),  # 10 ms are left
        (0.0424, None, 0.0524),
        (0.008, 0.04, 0.04),  # `learn.margin`
        (0.0424, 0.04, 0.0524),
    ],
)
def test_delay_margin_counts_the_delay_that_was_found(
    latest: float, asked: float | None, margin: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    goals = list[Goal]()

    def design(start: RiseDiConfig, model: Airframe, goal: Goal) -> SelectedObserver:
        goals.append(goal)
        raise ParameterError("none has it")

    made = learner_that_finds(lateral(latest=latest), monkeypatch, margin=asked)
    monkeypatch.setattr(made, "_design", design)
    sentence = made.propose(0).sentence
    (goal,) = goals
    assert goal.margin[1:3] == approx(margin)
    is_late = latest + 0.01 > (asked or 0.03)
    late = f"u is up to {1e3 * latest:.0f} ms late: " if is_late else ""
    assert sentence == f"{late}none has it"
    assert made.model is None  # what flies stays


def test_learned_part_keeps_the_margin_of_the_file_and_the_other_part_its_gains() -> None:
    """With 1.4 of its effect, the elevator makes the loop of the file faster.

    The loop then has less than the 30 ms that it was designed for.
    """
    start = scenario().rise_di()
    plain = start.model_copy(update={"learn": None})
    flight = scenario()
    file = selected_observer(plain, flight, OSPREY, 0.03)
    B = OSPREY.matrix_b().copy()
    B[:, 0] *= 1.4
    same_wind = np.ones_like(OSPREY.matrix_gusts())
    model = OSPREY.with_matrices(OSPREY.matrix_a(), B, same_wind)
    aim = goal(start, file, model, [("q", "V")], {})
    q, p, r, V = aim.margin
    assert 0.02 <= q == V < 0.029
    assert p == r == approx(0.03, abs=1e-3)
    assert aim.is_free == [True, False, False, True]
    assert aim.first is file
    # once every part is learned no gain set has to stay
    assert goal(start, file, model, [("q", "V"), ("p", "r")], {}).is_free == [True] * 4
    design = selected_observer(
        plain,
        flight,
        model,
        aim.margin,
        aim.needed,
        uncertain=False,
        earlier_design=file,
        is_free=aim.is_free,
    )
    assert (design.relaxation[1:3] == file.relaxation[1:3]).all()
    law = linear_law(design.controller.tuned_law(), 4, 0.01)
    loop = LoopTiming(np.array(plain.lag), 0.0, 0.01)
    assert is_stable(plant_of(model, design.controller), law, loop, aim.margin)
    slow = selected_observer(
        plain,
        flight,
        model,
        0.03,
        aim.needed,
        uncertain=False,
        earlier_design=file,
        is_free=aim.is_free,
    )
    assert design.cost < slow.cost


def test_price_of_a_margin_that_is_asked_for_is_told() -> None:
    known: dict[tuple[str, ...], Known] = {("p", "r"): Known({}, {}, (0.0, 0.0))}
    asked = made_learner(scenario(learn={"updates": [10.0], "margin": 0.04}))
    proposed, price = asked._designed(OSPREY, known, {})
    assert proposed.observer is not None
    assert proposed.observer.margin == 0.04
    sentence = (
        r"^([\d.]+) times the error of a design with 29 ms of delay margin, "
        r"because 40 ms are asked for$"
    )
    assert price is not None
    times = re.search(sentence, price)
    assert times is not None, price
    assert 1.0 <= float(times[1]) < 1.5
    assert made_learner(scenario())._designed(OSPREY, known, {})[1] is None


def test_margin_that_is_asked_for_flies_where_that_of_the_file_has_no_design(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    known: dict[tuple[str, ...], Known] = {("p", "r"): Known({}, {}, (0.0, 0.0))}
    made = made_learner(scenario(learn={"updates": [10.0], "margin": 0.025}))
    design = made._design

    def only_asked(start: RiseDiConfig, model: Airframe, goal: Goal) -> SelectedObserver:
        if goal.margin.min() > 0.025:
            raise ParameterError("none has it")
        return design(start, model, goal)

    monkeypatch.setattr(made, "_design", only_asked)
    proposed, price = made._designed(OSPREY, known, {})
    assert proposed.observer is not None
    assert (proposed.observer.margin, price) == (0.025, None)


@pytest.mark.parametrize("latest", [(0.004, 0.05), (0.03, 0.004)])
def test_late_thrust_costs_the_elevator_no_margin(
    latest: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A late thrust does not reduce the margin of the elevator.

    The loop of V is slow. Thrust may be 60 ms late, while all inputs together may be 30 ms late.
    """
    entry = Entry("B", "q", "elevator", 56.15, 0.1, 0.01, 56.15)
    part = lateral()._replace(
        inputs=("elevator", "thrust"), outputs=("q", "V"), entries=(entry, THRUST), latest=latest
    )
    made = learner_that_finds(part, monkeypatch)
    flown = made.propose(0).controller
    assert flown is not None
    assert flown.observer is not None
    assert flown.observer.margin == 0.03  # of all inputs at once
    assert made.model is not None
    behind = dict(zip(part.inputs, np.add(latest, 0.01), strict=True))
    late = np.array([max(behind.get(name, 0.0), 0.03) for name in flown.inputs])
    law = linear_law(flown.tuned_law(), 4, 0.01)
    loop = LoopTiming(np.array(flown.lag), 0.0, 0.01)
    assert is_stable(plant_of(made.model, flown), law, loop, late)


def test_model_of_a_late_u_has_margin_behind_its_delay_and_errs_less_than_the_law_alone() -> None:
    """No file says that u is 40 ms late.

    With the margin of the initial design, the loop would be unstable from the first model on.
    """
    actuators = scenario().aircraft.actuators.model_dump() | {"delay": 0.04}
    learn = {"updates": [11.0, 16.0, 21.0], "latency": 0.0, "check": 20.0}
    late = scenario(learn=learn).vary(aircraft={"actuators": actuators}, flight={"duration": 23.0})
    learned = made_learner(late)
    tape = simulate(late, learn=lambda _: learned)
    alone = simulate(late.vary(controller={"learn": None}))
    flown: Any = late.rise_di()
    for change in tape.changes:
        flown = vary(flown, change)
    # a delay within 5 ms, and its deviations
    assert flown.observer.margin == approx(0.04 + 0.01, abs=0.01)
    true = late.aircraft.sampled_airframe()
    loop = LoopTiming(np.array(flown.lag), 0.04, 0.01)
    assert is_stable(
        plant_of(true, flown), linear_law(flown.tuned_law(), 4, 0.01), loop, np.zeros(4)
    )
    units = np.array([0.01, 0.1, 0.02, 0.01])
    assert np.sum(error(tape, SWITCH, 23.0) / units) < np.sum(error(alone, SWITCH, 23.0) / units)


ONES = np.ones(4)
OSPREY = load_airframe("osprey")
RECORDED = 2000  # ticks of 10 ms; the last 400 are tested


def loss(gain: float, dead: str = "") -> Change:
    return Change(("p", "r"), gain, {"aileron": 0.3, "rudder": 1.0}, dead)


@pytest.mark.parametrize(
    "fallback, frequency, change, is_learned, told",
    [
        (None, 0.0, loss(20.0), True, [""]),
        (1800, 0.0, loss(20.0), True, []),  # 2 s ago: the model may be the cause
        (1800, 0.0, loss(60.0, "aileron"), True, ["aileron"]),
        (1500, 0.0, loss(20.0), True, [""]),  # 5 s ago
        # an elevator that lived had a gain of 10 in gusts, as one without effect
        (None, 0.0, loss(10.0), True, []),
        (None, 0.0, loss(60.0, "aileron"), True, []),  # the first test of two
        (None, 2.2, loss(60.0, "aileron"), True, []),
        # beside the file's model a healthy aileron of an aircraft that couples had a gain of 147
        (None, 0.0, loss(147.0, "aileron"), False, []),
        (1800, 0.0, loss(147.0, "aileron"), False, []),
    ],
)
def test_damage_counts_by_its_gain_beside_a_fallback_and_not_in_an_oscillation(
    fallback: int | None,
    frequency: float,
    change: Change,
    is_learned: bool,
    told: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In an oscillation of q of 2.2 Hz, the test had found a healthy engine to be dead."""
    made = made_learner(scenario(learn={"updates": [10.0]}))
    monkeypatch.setattr(design_learner, "change_test", Mock(return_value=(change,)))
    if is_learned:
        made._known = {("p", "r"): Known({}, {}, (0.0, 0.0))}
    noise = np.random.default_rng(1).normal(size=(RECORDED, 4))
    for k in range(RECORDED):
        has_fallen = fallback is not None and k >= fallback
        y = 1e-3 * noise[k]
        y[0] += 0.1 * np.sin(2.0 * np.pi * frequency * 0.01 * k)
        made.take(k * 10_000_000, y, np.zeros(4), 2 if has_fallen else 1)
    assert [change.dead for change in made._changes((RECORDED - 1) * 10_000_000)] == told


def test_input_without_effect_in_two_tests_in_a_row_is_dead(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In one lateral gust of 10 min, a healthy rudder had a gain of 47, and 2 s later none."""
    made = made_learner(scenario(learn={"updates": [10.0]}))
    made._known = {("p", "r"): Known({}, {}, (0.0, 0.0))}
    noise = np.random.default_rng(1).normal(size=(RECORDED, 4))
    for k in range(RECORDED):
        made.take(k * 10_000_000, 1e-3 * noise[k], np.zeros(4), 1)
    healthy = Change(("p", "r"), 0.0, {"aileron": 1.0, "rudder": 1.0}, "")
    tests = [loss(60.0, "aileron"), healthy, loss(60.0, "rudder"), loss(60.0, "aileron")]
    told = []
    for change in [*tests, loss(15.0, "aileron")]:
        monkeypatch.setattr(design_learner, "change_test", Mock(return_value=(change,)))
        told.append([part.dead for part in made._changes((RECORDED - 1) * 10_000_000)])
    assert told == [[], [], [], [], ["aileron"]]


def test_input_without_effect_in_one_test_is_a_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    made, flown = learned_part(monkeypatch, DEAD_RUDDER)
    monkeypatch.setattr(made, "_changes", type(made)._changes.__get__(made))
    monkeypatch.setattr(design_learner, "change_test", Mock(return_value=(DEAD_RUDDER,)))
    moved = np.random.default_rng(1).normal(size=(400, 4))
    for k in range(400):
        made.take((1201 + k) * 10_000_000, 1e-3 * moved[k], np.zeros(4), flown)
    doubt = made.propose(flown)
    assert doubt == LearnerResult(None, "rudder may have no effect, by one test")
    again = made.propose(flown)
    assert str(again.sentence).startswith("rudder has no effect")


def test_tests_for_damage_fill_the_time_between_identifications() -> None:
    updates = Updates(LearnConfig(updates=(10.0, 15.0, 22.0), check=2.0))
    ticks = range(0, 28 * NANOSECONDS, NANOSECONDS // 10)
    due = [t_ns / NANOSECONDS for t_ns in ticks if updates.is_due(t_ns)]
    # none before the first model, and none within a period of the next identification
    assert due == [0.0, 10.0, 12.0, 15.0, 17.0, 19.0, 22.0, 24.0, 26.0]


def test_flight_without_learner_is_refused() -> None:
    with refusing(r"^controller\.learn: found a flight without a learner"):
        simulate(scenario())


def test_law_with_wrong_model_falls_back_and_replay_is_equal() -> None:
    """The model does not have the delay of the aircraft, and the feedback is five times too strong.

    Only the model is certified.
    """
    margin = {"observer": scenario().rise_di().model_dump()["observer"] | {"margin": 0.0}}
    late = scenario(learn={"updates": [6.0], "check": 10.0, "latency": 0.0}, **margin).vary(
        aircraft={"sensors": {"delay": 0.03}}, flight={"duration": 12.0}
    )
    start = late.rise_di()
    shipped = find_scenario("osprey_observer").rise_di().observer
    assert shipped is not None
    given = {f"observer.{key}": getattr(shipped, key) for key in ("Phi", "Gamma", "L")}
    strong = tuple(5.0 * value for value in shipped.F)
    wrong = vary(start, given | {"observer.F": strong, "observer.part": 1.0})
    assert isinstance(wrong, RiseDiConfig)
    tape = simulate(late, learn=lambda _: Fixed(None, wrong))
    assert tape.outcome.status == 0
    taken, back = tape.changes
    assert taken["observer.part"] == 1.0
    assert vary(vary(start, taken), back) == start
    assert (error(tape, 6.0, 8.0) > 2.0 * error(tape, 3.0, 6.0)).any()
    # the law alone has up to 0.11 m/s in this turbulence
    assert (error(tape, 10.0, 12.0) < 0.15).all()
    assert replay(tape).is_equal()
