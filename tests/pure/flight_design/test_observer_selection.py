# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the selection of an observer.

The tests cover shipped scenarios, the delay margin, models that are refused, the observer without
A, and the command.
"""

import math
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from tests.builders import rms
from tests.closed_loop import PROTOTYPE_SERVO
from tests.conftest import REPOSITORY, invoke, refusing

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.uncertainty import nominal_and_sampled
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.parameters import ParameterError
from flight_core.vectors import FloatArray
from flight_design.gains import observer_search
from flight_design.gains.gain_design import STABLE, selected_observer
from flight_design.gains.nominal import activity_units
from flight_design.gains.observer_gains import gains_by_rule
from flight_design.gains.observer_search import WORST_OF
from flight_design.gains.observer_selection import (
    FASTEST,
    WORST_SEED,
    WORST_UNCERTAINTY,
    law_activity_unit,
    model_for,
    with_aircraft_observer,
    with_extended_state_observer,
)
from flight_design.gains.requirement import Requirement
from rise_di_controller.law.linear_loop import LinearPlant, LoopTiming, is_stable, linear_law
from rise_di_controller.rise_di_config import RiseDiConfig

pytestmark = pytest.mark.slow

OSPREY = load_airframe("osprey")
SERVO = PROTOTYPE_SERVO
NOISE = np.array([0.0017, 0.0017, 0.0017, 0.03])  # of osprey_servo in the law's order q, p, r, V
SIZE = np.array([0.1, 0.1, 0.1, 1.0])
SHIPPED = ("osprey_observer", "osprey_turbulence")


FLOWN = SERVO.vary(
    flight={"duration": 30.0},
    aircraft={
        "rate": 100.0,
        "step": 0.005,
        "gusts": {
            "vertical": {"start": 14.0, "speed": 10.12, "length": 15.24},
            "lateral": {"start": 20.0, "speed": 4.0, "length": 15.24},
        },
    },
    reference_model={"rate": 100.0},
)
"""osprey_servo with y at the rate of the law and steps of 5 ms, and its gusts within 30 s."""


def with_observer(controller: RiseDiConfig) -> Scenario:
    """Return osprey_servo with another controller."""
    return FLOWN.vary(controller=controller.model_dump())


@cache
def by_rule(margin: float = 0.03) -> observer_search.SelectedObserver:
    model = model_for(OSPREY, SERVO.controller, NOISE)
    gains = gains_by_rule(model, tuple(OSPREY.gusts), OSPREY.speed)
    return with_aircraft_observer(SERVO.rise_di(), OSPREY, [gains], NOISE, margin)


@cache
def rms_alone() -> FloatArray:
    """Return the errors of osprey_servo without an observer."""
    return rms(simulate(FLOWN))


def Omega() -> FloatArray:  # noqa: N802 - the paper's name
    model = model_for(OSPREY, SERVO.controller, NOISE)
    return model.Omega


def test_shipped_scenarios_have_observer_that_command_writes(tmp_path: Path) -> None:
    path = tmp_path / "gains.yaml"
    result = invoke("gains", "select", "osprey", "--observer", "--write", path)
    assert result.exit_code == 0, result.output
    assert "gains of a search in osprey_servo" in result.output
    section = yaml.safe_load(path.read_text())["/**/controller"]["ros__parameters"]
    again = RiseDiConfig.validate_mapping(section, "controller")
    assert again.observer is not None
    for shipped in (find_scenario(name).controller for name in SHIPPED):
        assert shipped.feedforward == again.feedforward
        assert shipped.observer is not None
        for key in ("Phi", "Gamma", "L", "F"):
            # another LAPACK may differ in the last of the ten digits, amplified by the Riccati
            # equations
            np.testing.assert_allclose(
                getattr(shipped.observer, key), getattr(again.observer, key), rtol=1e-6, atol=1e-9
            )


def test_margin_of_selected_observer_holds_and_is_one_that_was_asked_for() -> None:
    for margin in (0.03, 0.045):
        selected = by_rule(margin)
        controller = selected.controller
        plant = LinearPlant(*_plant(controller))
        loop = LoopTiming(np.array(controller.lag), 0.0, 0.01)
        law = linear_law(controller.tuned_law(), 4, 0.01)
        assert selected.delay_margin >= margin
        assert is_stable(plant, law, loop, np.full(4, margin))
        # the search ends within 0.1 ms
        assert not is_stable(plant, law, loop, np.full(4, selected.delay_margin + 0.001))
    assert by_rule(0.045).cost > by_rule(0.03).cost


def _plant(controller: RiseDiConfig) -> tuple[FloatArray, FloatArray, FloatArray]:
    nominal = controller.nominal()
    assert nominal is not None
    return nominal.A + nominal.gravity, nominal.B, nominal.C


@pytest.mark.parametrize("begin", [0.6, 1.7])
def test_search_finds_the_same_gains_from_faster_and_from_slower_ones(begin: float) -> None:
    model = model_for(OSPREY, SERVO.controller, NOISE)
    gains = gains_by_rule(model, tuple(OSPREY.gusts), OSPREY.speed)
    start = by_rule(0.045)._replace(relaxation=np.full(4, begin))
    selection = with_aircraft_observer(
        SERVO.rise_di(), OSPREY, [gains], NOISE, 0.03, earlier_design=start
    )
    # the logarithms of four channels: 3 % each
    assert selection.cost == pytest.approx(by_rule().cost, abs=0.12)
    assert selection.delay_margin >= 0.03


def test_search_stays_at_the_earlier_loop_where_no_change_errs_less() -> None:
    """The search keeps the earlier loop if no change has a smaller error.

    With 0.9 of the elevator's effect, the loop of the file has its margins, but a larger error.
    """
    B = OSPREY.matrix_b().copy()
    B[:, 0] *= 0.9
    same_wind = np.ones_like(OSPREY.matrix_gusts())
    model = OSPREY.with_matrices(OSPREY.matrix_a(), B, same_wind)
    gains = gains_by_rule(
        model_for(model, SERVO.controller, NOISE), tuple(OSPREY.gusts), OSPREY.speed
    )
    design = partial(
        with_aircraft_observer, SERVO.rise_di(), model, [gains], NOISE, 0.03, uncertain=False
    )
    held = design(earlier_design=by_rule(), is_free=[False] * 4)
    free = design(earlier_design=by_rule())
    assert held.controller.observer == by_rule().controller.observer
    assert held.controller.feedforward == free.controller.feedforward
    assert held.controller.feedforward != by_rule().controller.feedforward
    assert free.cost < held.cost
    assert design(earlier_design=free).controller == free.controller


def test_delay_beyond_margin_makes_flight_oscillate_and_one_within_it_does_not() -> None:
    # y delayed by whole samples: 20 ms is within the margin of 30 ms, 80 ms is far beyond it
    controller = by_rule().controller
    calm = with_observer(controller).vary(flight={"duration": 12.0}, aircraft={"gusts": {}})
    within, beyond = (
        rms(
            simulate(
                calm.vary(
                    aircraft={"sensors": calm.aircraft.sensors.model_dump() | {"delay": delay}}
                )
            )
        )
        for delay in (0.02, 0.08)
    )
    assert within[0] < 5.0  # mrad/s in q
    assert beyond[0] > 5.0 * within[0]


def test_observer_by_rule_halves_error_of_speed_roll_and_yaw() -> None:
    # q, V, p, r in gusts: measured 0.94, 0.15, 0.14, 0.46; the rule is a start, and the gains of a
    # search are better still
    alone = rms_alone()
    observed = rms(simulate(with_observer(by_rule().controller)))
    assert (observed < [1.0, 0.5, 0.5, 0.5] * alone).all()


def test_activity_of_law_inputs_is_that_of_the_effectors_that_they_move() -> None:
    """The halves of a surface cost as much as the whole one.

    A surface has 60 deg/s, and a throttle 600 %/s.
    """
    osprey = SERVO.rise_di()
    twin = find_scenario("osprey_twin")
    controller = twin.rise_di()
    whole = law_activity_unit(OSPREY, osprey)
    halves = law_activity_unit(twin.aircraft.load()[0], controller)
    surface, throttle = np.deg2rad(60.0), 6.0
    assert whole.tolist() == [surface, surface, surface, throttle]
    # v is y_dot: Omega of the osprey turns the unit of its input into that of v
    Omega = np.diag(OSPREY.matrix_c() @ OSPREY.matrix_b())
    by_output = dict(zip(OSPREY.outputs, Omega, strict=True))
    of_input = dict(zip(osprey.outputs, whole, strict=True))
    place = dict(zip(controller.outputs, halves, strict=True))
    assert place["q"] == pytest.approx(of_input["q"] * by_output["q"], rel=1e-6)
    assert place["V"] == pytest.approx(of_input["V"] * by_output["V"], rel=1e-2)  # B[V, elevator]


def test_a_thrust_in_newtons_costs_by_the_thrust_in_trim() -> None:
    """At a trim thrust of 40 N, a rate of 480 N/s has the cost 1.

    In a file without `no_thrust`, thrust has no cost.
    """
    values = OSPREY.model_dump()
    thrust = {"unit": "N", "positive": "more thrust", "no_thrust": -40.0}
    known = Airframe.validate_mapping(
        values | {"inputs": values["inputs"] | {"thrust": thrust}}, "airframe"
    )
    unknown = Airframe.validate_mapping(
        values | {"inputs": values["inputs"] | {"thrust": thrust | {"no_thrust": None}}}, "airframe"
    )
    place = list(known.inputs).index("thrust")
    assert activity_units(known)[place] == 480.0
    assert activity_units(unknown)[place] == math.inf


def test_models_that_do_not_fit_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    flipped = OSPREY.with_matrices(OSPREY.matrix_a(), -OSPREY.matrix_b(), np.ones((8, 3)))
    gains = gains_by_rule(
        model_for(OSPREY, SERVO.controller, NOISE), tuple(OSPREY.gusts), OSPREY.speed
    )
    with refusing(r"found a C B with D = \[-1, -1, -1, -1\], expected D = \[1, 1, 1, 1\]"):
        with_aircraft_observer(SERVO.rise_di(), flipped, [gains], NOISE, 0.03)
    # a search up to 18 takes longer
    monkeypatch.setattr(observer_search, "MAX_RELAXATION", 1.2)
    with refusing(
        r"^--margin: delay margin \(ms\): .*, expected at least 500.*; give the loop less "
        r"delay"
    ):
        with_aircraft_observer(SERVO.rise_di(), OSPREY, [gains], NOISE, 0.5)
    with refusing(r"^Omega: found a C B with D"):
        with_extended_state_observer(SERVO.rise_di(), -Omega(), NOISE, SIZE, 0.03)
    calm = OSPREY.model_copy(update={"gusts": {}})
    with refusing(r"^airframe osprey: found no gusts, expected the effect of wind"):
        with_aircraft_observer(SERVO.rise_di(), calm, [gains], NOISE, 0.03)


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (
            ["--model", "osprey"],
            "error: --model: found osprey, expected an observer too",
        ),
        (
            ["--observer", "--margin", "0.9"],
            "error: --margin: found 0.9, expected 0 to 0.5 s",
        ),
    ],
)
def test_command_refuses_options_that_contradict_each_other(
    arguments: list[str], sentence: str
) -> None:
    with pytest.raises(ParameterError) as refused:
        invoke("gains", "select", "osprey", *arguments, catch_exceptions=False)
    assert f"error: {refused.value}".startswith(sentence)


def test_aircraft_that_no_gains_hold_do_not_count() -> None:
    """If q, p and r are held, alpha and beta move by A - B (C B)^-1 C A.

    For an aircraft in which this motion is unstable, no observer has a margin.
    """
    folder = REPOSITORY / "examples" / "px4_airplane"
    airframe = load_airframe(str(folder / "rates_airframe.yaml"))
    scenario = find_scenario(str(folder / "rates.yaml"))
    A, B = nominal_and_sampled(airframe, WORST_UNCERTAINTY, WORST_OF, WORST_SEED)
    C = airframe.matrix_c()
    dynamics = A - B @ np.linalg.solve(C @ B, C @ A)
    diverging = int(np.sum(np.linalg.eigvals(dynamics).real.max(axis=1)[1:] > FASTEST))
    loose = Requirement(
        phase=math.radians(20.0),
        gain=1.4,
        sensitivity=3.0,
        damping=0.05,
        worst_phase=math.radians(5.0),
    )
    selected = selected_observer(scenario.rise_di(), scenario, airframe, 0.01, loose)
    assert selected.controller.observer is not None
    assert f"{diverging} of {WORST_OF} uncertain aircraft do not count" in selected.origin
    assert 0 < diverging < WORST_OF / 2


def test_gains_of_a_file_make_the_observer_of_the_example(tmp_path: Path) -> None:
    """The observer is the one of the file, to its six digits.

    Any stable loop is accepted here.
    """
    folder = REPOSITORY / "examples" / "px4_airplane"
    airframe = load_airframe(str(folder / "rates_airframe.yaml"))
    scenario = find_scenario(str(folder / "rates_observer.yaml"))
    shipped: Any = scenario.rise_di().observer
    file = folder / "rates_weights.yaml"
    begin = scenario.rise_di(), scenario, airframe, 0.01, STABLE

    def designed(path: Path) -> Any:
        return selected_observer(*begin, uncertain=False, weights=path).controller.observer

    observer = designed(file)
    assert shipped is not None
    assert pytest.approx(shipped.L, rel=1e-4, abs=1e-4) == observer.L
    assert pytest.approx(shipped.F, rel=1e-4, abs=1e-4) == observer.F
    edited = tmp_path / "weights.yaml"
    for old, new, words in (
        ("gust: [0.237, 0.1]", "gust: [0.3]", r"gust: found \[0.3\], expected 2 numbers"),
        ("drift:", "drifts:", "weights: found .* expected a file of K, Lambda"),
    ):
        edited.write_text(file.read_text().replace(old, new))
        with refusing(words):
            designed(edited)
