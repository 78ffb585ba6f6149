# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the identification from a log.

The tests fly aircraft whose A and B are known, and systems whose innovations are known.
"""

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx
from tests.conftest import invoke, refusing

from aircraft_sim import sensors
from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.uncertainty import as_yaml
from control_laws.nominal_model import NominalModel
from control_laws.observer_design import Names
from flight_analysis.closed_loop.learning_loop import Entry
from flight_analysis.closed_loop.scenario import Scenario, scenario_yaml
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from flight_design.identification import innovation_filters, model_identification
from flight_design.identification.innovation_filters import Actuation, FlightData
from flight_design.identification.likelihood import Unknown
from flight_design.identification.likelihood_search import Search
from flight_design.identification.model_identification import (
    Identification,
    Part,
    identify_model,
    model_yaml,
)
from flight_design.identification.model_quality import (
    MAX_WHITENESS,
    correlation,
    whiteness,
)
from flight_design.identification.model_refusals import Coupling, reason_against_excitation
from flight_design.learning.change_test import ANGLE
from flight_design.learning.part_checks import DELAY_DEVIATION, LAG_DEVIATION
from flight_log.bag import LogAttachments
from flight_log.tape_writer import write_run

pytestmark = pytest.mark.slow

OSPREY = load_airframe("osprey")
# those of osprey_servo; a flight in one process has no delay
ACTUATORS = Actuation(np.array([0.02, 0.1, 0.02, 0.02]), 0.0)
DURATION = 36.0  # s: the commands of osprey_servo end at 33 s
AIR: dict[str, dict[str, Any]] = {
    "calm": {"gusts": {}},
    "gust": {
        "gusts": {
            "vertical": {"start": 15.0, "speed": 10.12, "length": 15.24},
            "lateral": {"start": 27.0, "speed": 4.0, "length": 15.24},
        }
    },
    "turbulence": {"gusts": {}, "turbulence": {"altitude": 100.0, "wind": 15.4}},
    "turning": {"gusts": {}, "turbulence": {"altitude": 100.0, "wind": 15.4, "rotary": True}},
}
"""The air of a flight: none, the gusts of osprey_servo within the commands, moderate turbulence,
and that with rotary gusts.
"""


def servo(air: str, uncertainty: float, duration: float = DURATION, **reference: Any) -> Scenario:
    """Return osprey_servo at 100 Hz with an uncertain aircraft."""
    uncertainty_of_aircraft = {"A": uncertainty, "B": uncertainty, "seed": 7, "number": 2}
    return find_scenario("osprey_servo").vary(
        flight={"duration": duration},
        aircraft={"rate": 100.0, "step": 0.005, "uncertainty": uncertainty_of_aircraft} | AIR[air],
        reference_model={"rate": 100.0} | reference,
    )


@cache
def flight(air: str, uncertainty: float) -> Tape:
    return simulate(servo(air, uncertainty))


@cache
def identified(air: str, uncertainty: float) -> Identification:
    return identify_model(
        innovation_filters.recording(flight(air, uncertainty), OSPREY), OSPREY, ACTUATORS
    )


def true_errors(aircraft: Airframe, entries: tuple[Entry, ...]) -> dict[str, float]:
    """Return the relative errors of the nominal entries."""
    A = aircraft.matrix_a()
    B = aircraft.matrix_b()
    inputs = list(aircraft.inputs)
    values = {}
    for entry in entries:
        row = aircraft.index(entry.row)
        value = (
            A[row, aircraft.index(entry.column)]
            if entry.matrix == "A"
            else B[row, inputs.index(entry.column)]
        )
        values[entry.name] = float(value / entry.nominal - 1.0)
    return values


class Filter:
    """A first-order filter at 500 Hz between the outputs and the sensors."""

    def __init__(self, lag: float) -> None:
        self._share = 1.0 - np.exp(-0.002 / lag)
        self._y: FloatArray | None = None
        self._measure = sensors.measure

    def measure(self, number: int, y: FloatArray, *others: Any) -> sensors.Measured:
        """Measure the filtered y. It must be called for every sample in order."""
        self._y = y if self._y is None else self._y + self._share * (y - self._y)
        return self._measure(number, self._y, *others)


MOST_OFF = 3.0  # stated deviations that an entry may be off


def test_filter_in_front_of_y_makes_no_effect_weaker(monkeypatch: pytest.MonkeyPatch) -> None:
    """Behind a filter of 20 ms, the entries are within their stated deviations.

    A model without the lag takes the filter for a delay of u, and finds effects that are too weak.
    """
    filtered = servo("turbulence", 0.3).vary(aircraft={"rate": 500.0, "step": 0.002})
    aircraft = filtered.aircraft.sampled_airframe()
    monkeypatch.setattr(sensors, "measure", Filter(0.02).measure)
    recorded = innovation_filters.recording(simulate(filtered), OSPREY)

    def largest(lag: float) -> float:
        unknown = Unknown(delay=DELAY_DEVIATION, angle=ANGLE, lag=lag)
        found = identify_model(recorded, OSPREY, ACTUATORS, unknown=unknown)
        true = true_errors(aircraft, found.entries)
        off = [(entry.error - true[entry.name]) / entry.deviation for entry in found.entries]
        if lag:
            # the delay of the surfaces with the lag: a design keeps a margin for both
            delays = np.concatenate([part.delays for part in found.parts])
            assert_allclose(delays[[0, 2, 3]], 0.02, atol=0.01)
        return float(np.abs(off).max())

    assert largest(LAG_DEVIATION) < MOST_OFF
    assert largest(0.0) > MOST_OFF


FLIGHTS = [("gust", 0.5), ("turbulence", 0.3)]
MATTER = (
    "B[V, thrust]",
    "B[q, elevator]",
    "A[p, p]",
    "B[p, aileron]",
    "A[beta, r]",
    "A[p, r]",
    "B[r, rudder]",
)
"""What moves the outputs: the effect of each input, roll damping, and the coupling of yaw."""


def rough(matrix: str, row: str, column: str) -> Airframe:
    """Return the airframe with an entry four times too large, which is beyond a search's bounds."""
    A = OSPREY.matrix_a()
    B = OSPREY.matrix_b()
    if matrix == "A":
        A[OSPREY.index(row), OSPREY.index(column)] *= 4.0
    else:
        B[OSPREY.index(row), list(OSPREY.inputs).index(column)] *= 4.0
    return OSPREY.with_matrices(A, B, np.ones((len(B), len(OSPREY.gusts))))


def lateral_part(airframe: Airframe) -> Part:
    """Return the part of p and r in moderate turbulence, identified from an airframe."""
    recorded = innovation_filters.recording(flight("turbulence", 0.3), OSPREY)
    result = identify_model(recorded, airframe, ACTUATORS, bound_count=1, searches_again=True)
    return result.parts[1]


def test_rough_damping_is_searched_again_about_what_was_found() -> None:
    """A[p, p] of the file is four times too large.

    At its bound of 0.4, the part would be refused.
    """
    file = rough("A", "p", "p")
    part = lateral_part(file)
    assert part.refusal is None
    aircraft = servo("turbulence", 0.3).aircraft.sampled_airframe()
    true = true_errors(aircraft, part.entries)
    by_name = {entry.name: entry for entry in part.entries}
    for name in ("A[p, p]", "B[p, aileron]", "B[r, rudder]"):
        assert abs(by_name[name].error - true[name]) < 3.0 * by_name[name].deviation, name
    assert by_name["A[p, p]"].error < -0.6  # beyond the bound about the file


def test_rough_effect_of_an_input_is_refused() -> None:
    """An aircraft whose parts couple by 10 % looked as if its aileron had a fifth of its effect."""
    part = lateral_part(rough("B", "p", "aileron"))
    assert "B[p, aileron]" in str(part.refusal)
    assert "at a bound of the search" in str(part.refusal)


@pytest.mark.parametrize("air, uncertainty", FLIGHTS)
def test_entries_that_matter_found_within_deviations(air: str, uncertainty: float) -> None:
    model = identified(air, uncertainty)
    true = true_errors(servo(air, uncertainty).aircraft.sampled_airframe(), model.entries)
    by_name = {entry.name: entry for entry in model.entries}
    for name in MATTER:
        assert abs(by_name[name].error - true[name]) < 3.0 * by_name[name].deviation, name
    # turbulence hides what the inputs do: their effects are known less well
    largest = {
        "B[V, thrust]": 0.01,
        "B[q, elevator]": 0.1,
        "B[p, aileron]": 0.01,
        "B[r, rudder]": 0.05,
    }
    if air == "turbulence":
        largest = {
            "B[V, thrust]": 0.06,
            "B[q, elevator]": 0.12,
            "B[p, aileron]": 0.02,
            "B[r, rudder]": 0.12,
        }
    for name, limit in largest.items():
        assert abs((1.0 + by_name[name].error) / (1.0 + true[name]) - 1.0) < limit, name


def test_effects_of_inputs_are_found_in_air_that_turns() -> None:
    """With rotary gusts in the filter, p and r are accepted.

    Without a span the filter has none, and they are refused with four entries at a bound. The
    deviations are for the levels of the wind as found, so the rudder is 3.4 of them off.
    """
    model = identified("turning", 0.3)
    true = true_errors(servo("turning", 0.3).aircraft.sampled_airframe(), model.entries)
    for entry in model.entries:
        if entry.name in {"B[V, thrust]", "B[q, elevator]", "B[p, aileron]", "B[r, rudder]"}:
            assert abs(entry.error - true[entry.name]) < 3.5 * entry.deviation, entry.name
    assert all("at a bound" not in str(part.refusal) for part in model.parts)
    assert model.after.whiteness.max() < MAX_WHITENESS


def test_air_that_moves_the_aircraft_more_than_any_wind_does_is_refused() -> None:
    # a frozen field of wind has effects of (0, -1), the specification's sign (0, 1)
    search: Any = SimpleNamespace(_shear=slice(0, 2), _upper=np.array([2.07, 2.07]))
    for effects, name in (([0.0, -1.0], None), ([2.07, -0.2], "alpha"), ([0.1, -2.07], "q")):
        refusal = Search.reason_against_air(search, SimpleNamespace(theta=np.array(effects)))  # type: ignore[arg-type]
        assert (refusal is None) if name is None else (f"wind on {name} at a bound" in str(refusal))


@pytest.mark.parametrize("air, uncertainty", FLIGHTS)
def test_innovations_of_held_out_samples_are_smaller_and_whiter(
    air: str, uncertainty: float
) -> None:
    model = identified(air, uncertainty)
    assert model.refusal is None
    assert len(model.parts) == 2  # nothing is taken as coupled that is not
    assert model.after.log_likelihood > model.before.log_likelihood + 0.1
    assert np.sum(model.after.whiteness) < 0.5 * np.sum(model.before.whiteness)
    assert (model.after.rms <= 1.001 * model.before.rms).all()
    # nothing of the fit is in the held-out samples, of which there are one in three
    assert model.held_out.mean() == approx(1.0 / 3.0, abs=0.02)


def test_the_deviations_are_those_of_the_errors() -> None:
    model = identified("gust", 0.5)
    true = true_errors(servo("gust", 0.5).aircraft.sampled_airframe(), model.entries)
    ratios = np.array(
        [(entry.error - true[entry.name]) / entry.deviation for entry in model.entries]
    )
    # of 26 normal numbers the mean square is below 2 with a probability of 0.998
    assert np.mean(ratios**2) < 2.0


def test_flight_without_excitation_refused_with_channel_and_factor() -> None:
    scenario = servo("calm", 0.3, duration=20.0, pulses={}, coordinated_turn=None)
    model = identify_model(
        innovation_filters.recording(simulate(scenario), OSPREY), OSPREY, ACTUATORS
    )
    pattern = (
        r"excitation of \w: found B\[\w, \w+\] known to [\d.]+ %, expected 10 %: \w needs "
        r"[\d.]+ times the amplitude"
    )
    assert re.match(pattern, str(model.refusal))


def test_effect_that_is_just_known_too_little_has_figures_that_say_so() -> None:
    """A log of PX4 was refused with the sentence "known to 10 %, expected 10 %"."""
    effect = Entry(
        matrix="B",
        row="q",
        column="elevator",
        nominal=-8.0,
        error=0.0,
        deviation=0.1034,
        unit=-8.0,
    )
    text = str(reason_against_excitation([effect], [effect.row]))
    assert "known to 10.3 %, expected 10 %" in text
    assert "needs 1.04 times the amplitude" in text


def test_flight_without_noise_that_is_mostly_at_rest_has_deviations() -> None:
    """At rest the innovations are 0, and the seconds with motion must not count as outliers."""
    scenario = find_scenario("osprey_gust").vary(
        flight={"duration": 15.0},  # p moves from 11 s on
        aircraft={"rate": 100.0, "step": 0.005},
        reference_model={"rate": 100.0},
    )
    model = identify_model(
        innovation_filters.recording(simulate(scenario), OSPREY),
        OSPREY,
        Actuation(np.zeros(4), 0.0),
    )
    assert all(0.0 < entry.deviation < 0.3 for entry in model.entries)


def test_noise_of_a_rounded_y_is_at_least_the_error_of_rounding() -> None:
    """A slow y mostly stays at one value, and third differences would find no noise.

    The noise is at least the error of rounding.
    """
    slow = np.sin(np.linspace(0.0, 6.0, 2000))
    noise = 0.02 * np.random.default_rng(5).standard_normal(2000)
    still = np.zeros(2000)
    y = np.stack([0.1 * np.round(slow / 0.1), slow + noise, still], axis=1)
    y[7] = np.nan
    least = innovation_filters.MIN_NOISE
    found = innovation_filters.measured_noise(y, np.ones(3))
    assert_allclose(found, [0.1 / np.sqrt(12.0), 0.02, least], rtol=0.1)


@pytest.fixture(scope="module")
def coupled_flight(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[FlightData, dict[str, float]]:
    """Return a flight of an aircraft whose parts couple, and the entries that couple them.

    The elevator rolls it with a tenth of the effect of the ailerons, and its roll pitches it. Alpha
    rolls it, too, and so does the vertical wind.
    """
    A = OSPREY.matrix_a()
    B = OSPREY.matrix_b()
    row = OSPREY.index("p")
    aileron = list(OSPREY.inputs).index("aileron")
    elevator = list(OSPREY.inputs).index("elevator")
    coupled = {
        "B[p, elevator]": 0.1 * B[row, aileron],
        "A[q, p]": 0.1 * A[OSPREY.index("q"), OSPREY.index("q")],
        "A[p, alpha]": float(0.2 * A[row, row]),
    }
    B[row, elevator], A[OSPREY.index("q"), row], A[row, OSPREY.index("alpha")] = coupled.values()
    flown = OSPREY.with_matrices(A, B, np.ones((8, 3)))
    vertical = flown.gusts["vertical"] | {"p": -coupled["A[p, alpha]"]}
    flown = flown.model_copy(update={"gusts": flown.gusts | {"vertical": vertical}})
    airframe = tmp_path_factory.mktemp("coupled") / "coupled.yaml"
    airframe.write_text(as_yaml(flown))
    scenario = servo("turbulence", 0.0, duration=20.0).vary(aircraft={"airframe": str(airframe)})
    return innovation_filters.recording(simulate(scenario), OSPREY), coupled


def test_coupled_parts_are_identified_together(
    coupled_flight: tuple[FlightData, dict[str, float]],
) -> None:
    recorded, coupled = coupled_flight
    model = identify_model(recorded, OSPREY, ACTUATORS)
    assert model.refusal is None
    assert model.remarks == ()
    assert [part.outputs for part in model.parts] == [OSPREY.outputs]
    off = {
        entry.name: (
            entry.error - (coupled.get(entry.name, entry.nominal) - entry.nominal) / entry.unit
        )
        / entry.deviation
        for entry in model.entries
    }
    assert {name: z for name, z in off.items() if abs(z) > 3.0} == {}
    elevator = list(OSPREY.inputs).index("elevator")
    effect = model.airframe.matrix_b()[OSPREY.index("p"), elevator]
    assert effect == approx(coupled["B[p, elevator]"], rel=0.2)
    assert "#   B[p, elevator]: " in model_yaml(model, "a flight")


def test_parts_that_couple_are_refused_without_a_common_model(
    coupled_flight: tuple[FlightData, dict[str, float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded, _ = coupled_flight
    monkeypatch.setattr(model_identification, "MAX_WHITENESS", 0.5)  # no model is as white
    model = identify_model(recorded, OSPREY, ACTUATORS)
    assert [part.outputs for part in model.parts] == [("q", "V"), ("p", "r")]
    assert [type(part.refusal) for part in model.parts] == [Coupling, Coupling]
    told = str(model.refusal)
    assert told.startswith("coupling: found innovations of a part that follow the inputs of ")
    assert told.count("coupling:") == 1
    assert told.endswith("expected at most 0.5, 1 being white")


def test_parts_with_white_innovations_need_no_common_model(monkeypatch: pytest.MonkeyPatch) -> None:
    recorded = innovation_filters.recording(flight("turbulence", 0.3), OSPREY)
    monkeypatch.setattr(model_identification, "FOLLOWS", 0.0)
    refused = Coupling("coupling: found no common model")
    monkeypatch.setattr(model_identification._Study, "whole", lambda *_: refused)
    model = identify_model(recorded, OSPREY, ACTUATORS)
    assert [part.refusal for part in model.parts] == [None, None]
    monkeypatch.setattr(model_identification, "MAX_WHITENESS", 0.5)
    model = identify_model(recorded, OSPREY, ACTUATORS)
    assert [part.refusal for part in model.parts] == [refused, refused]


def test_parts_stay_apart_if_a_model_with_coupling_predicts_no_better(
    coupled_flight: tuple[FlightData, dict[str, float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded, _ = coupled_flight
    monkeypatch.setattr(model_identification, "COUPLED_GAIN", 1e9)
    model = identify_model(recorded, OSPREY, ACTUATORS)
    assert [part.outputs for part in model.parts] == [("q", "V"), ("p", "r")]
    assert not any(isinstance(part.refusal, Coupling) for part in model.parts)


def test_lost_samples_are_predicted_over() -> None:
    tape = flight("gust", 0.5)
    y = tape["y"]
    keep = np.random.default_rng(1).random(len(y.stamp_ns)) > 0.2
    lossy = replace(
        tape, signals={**tape.signals, "y": Signal(y.stamp_ns[keep], y.names, y.values[keep])}
    )
    recorded = innovation_filters.recording(lossy, OSPREY)
    count = round(20.0 / recorded.period)
    recorded = recorded._replace(t=recorded.t[:count], y=recorded.y[:count], u=recorded.u[:count])
    assert np.isnan(recorded.y[:, 0]).mean() == approx(0.2, abs=0.02)
    model = identify_model(recorded, OSPREY, ACTUATORS)
    true = true_errors(servo("gust", 0.5).aircraft.sampled_airframe(), model.entries)
    assert model.refusal is None
    assert all(
        abs(entry.error - true[entry.name]) < 3.0 * entry.deviation
        for entry in model.entries
        if entry.name in MATTER
    )


# Parts with a known result


def test_y_taken_at_stamps_of_u() -> None:
    tape = flight("gust", 0.5)
    y = tape["y"]
    u = tape["u"]
    fast = np.repeat(y.values, 5, axis=0) + np.tile(
        [[0.0], [9.0], [9.0], [9.0], [9.0]], (len(y.values), 1)
    )
    stamps = np.arange(len(fast)) * 2_000_000
    recorded = innovation_filters.recording(
        replace(tape, signals={"y": Signal(stamps, y.names, fast), "u": u}), OSPREY
    )
    order = [y.names.index(name) for name in OSPREY.outputs]
    assert_array_equal(recorded.y, y.values[: len(recorded.y), order])
    assert recorded.period == 0.01


def test_log_that_shows_no_model_is_refused() -> None:
    """One log has an output that never changes, and one has a gap of twelve days.

    The gap must not be filled with samples.
    """
    tape = flight("gust", 0.5)
    y = tape["y"]
    u = tape["u"]
    still = Signal(y.stamp_ns, y.names, y.values * [name != "p" for name in y.names])
    with refusing("^record: found a constant p, expected outputs that move"):
        signals = {"y": still, "u": u}
        recorded = innovation_filters.recording(replace(tape, signals=signals), OSPREY)
        identify_model(recorded, OSPREY, ACTUATORS)
    late = [
        Signal(of.stamp_ns + 10**15 * (of.stamp_ns > of.stamp_ns.mean()), of.names, of.values)
        for of in (y, u)
    ]
    with refusing(r"^the log: found .* s of u in 1e\+06 s, expected a log without long gaps$"):
        innovation_filters.recording(replace(tape, signals={"y": late[0], "u": late[1]}), OSPREY)


def test_late_input_is_mean_that_acts_in_period() -> None:
    u = np.array([[0.0], [1.0], [3.0], [3.0]])
    assert_allclose(innovation_filters.delayed(u, 0.25), [[0.0], [0.75], [2.5], [3.0]])
    assert_allclose(innovation_filters.delayed(u, 1.0), [[0.0], [0.0], [1.0], [3.0]])


def osprey_model(noise: Any = (0.0017, 0.03, 0.0017, 0.0017)) -> NominalModel:
    none = FlightData(0.01, np.zeros(10), np.zeros((10, 4)), np.zeros((10, 4)))
    return innovation_filters.filter_model(OSPREY, ACTUATORS, none)._replace(noise=np.array(noise))


def test_the_osprey_has_two_blocks() -> None:
    names = [
        {np.array(list(OSPREY.states))[k] for k in block.states}
        for block in innovation_filters.blocks(osprey_model())
    ]
    assert names == [{"V", "alpha", "q", "theta"}, {"beta", "p", "r", "phi"}]


def test_innovations_of_right_model_are_white_and_of_unit_covariance() -> None:
    block = innovation_filters.blocks(osprey_model())[0]
    model = block.restricted(osprey_model())
    model = model._replace(
        A=model.A[None], B=model.B[None], wind=model.wind[None], gravity=0.0 * model.gravity
    )
    names = Names(
        ("V", "alpha", "q", "theta"),
        ("elevator", "thrust"),
        ("q", "V"),
        ("vertical", "longitudinal"),
    )
    bank = innovation_filters.filter_bank(model, names, 25.0, np.ones((1, 2)))
    # simulate the filter's own model with the noise for which it is designed
    generator = np.random.default_rng(1)
    Phi = bank.sampled.Phi[0, 0]
    H = bank.sampled.H
    wind = [
        bank.sampled.states.index("x.wind.vertical"),
        bank.sampled.states.index("x.wind.longitudinal"),
    ]
    _, gust = innovation_filters.wind_model(names.winds, 25.0)
    z = np.zeros(len(Phi))
    y = np.zeros((20_000, 2))
    for k in range(len(y)):
        y[k] = H @ z + model.noise * generator.standard_normal(2)
        z = Phi @ z
        z[wind] += gust * 0.1 * generator.standard_normal(2)  # root of the period, s
    level = np.full(len(y) // innovation_filters.HOLD, 4)
    r, _ = innovation_filters.Passage(bank, y, np.zeros((len(y), 2)), level).run(
        np.zeros((1, len(Phi)))
    )
    e = np.asarray(
        np.linalg.solve(np.linalg.cholesky(bank.covariance[0, 4]), r[0, 1000:].T).T,
        dtype=np.float64,
    )
    # 19000 samples: the standard deviation of a variance is 1 %; states and disturbances have
    # almost no noise here
    assert_allclose(np.cov(e.T), np.eye(2), atol=0.04)
    assert whiteness(e, np.ones(len(e), dtype=bool)).max() < 2.0


def test_whiteness_is_one_for_white_noise_and_that_of_autocorrelation_for_coloured_noise() -> None:
    generator = np.random.default_rng(1)
    held_out = np.arange(60_000) % 300 >= 200
    white = generator.standard_normal((60_000, 50))
    # n (1 + 0.8 rho_1^2 ..): the mean of 50 figures has a standard deviation of 0.32 / sqrt(50)
    assert whiteness(white, held_out).mean() == approx(1.0, abs=0.2)
    coloured: FloatArray = white[1:] + 0.5 * white[:-1]
    # a moving average has rho_1 = 0.5 / 1.25 alone, and 99 of 100 pairs of a span
    expected = 20_000 * 0.99 * (0.5 / 1.25) ** 2 / 20
    assert whiteness(coloured, held_out[1:]).mean() == approx(expected, rel=0.03)


def test_correlation_is_one_for_independent_noises_and_that_of_what_follows_later() -> None:
    generator = np.random.default_rng(1)
    mask = np.ones(20_000, dtype=bool)
    before, noise = generator.standard_normal((2, 20_000, 20))
    # the mean of 400 figures with a deviation of 0.32 each
    assert correlation(noise, before, mask).mean() == approx(1.0, abs=0.05)
    # n rho^2 with rho = 0.1 at one of 20 lags
    following = np.vstack([np.zeros((7, 20)), 0.1 * before[:-7]]) + np.sqrt(0.99) * noise
    correlations = np.diag(correlation(following, before, mask))
    assert correlations.mean() == approx(1.0 + 20_000 * 0.01 / 20, rel=0.1)


# The command


def run_folder(folder: Path) -> Path:
    """Return a run with a turbulent flight."""
    run = folder / "run"
    run.mkdir()
    scenario = run / "turbulent.yaml"
    notes = run / "provenance.yaml"
    scenario.write_text(scenario_yaml(servo("turbulence", 0.3)))
    notes.write_text("host: {name: test}\n")
    write_run(flight("turbulence", 0.3), run, LogAttachments(scenario, (), notes))
    return run


def command(*arguments: Any) -> Any:
    return invoke("identify", "log", *arguments)


def test_command_writes_airframe_and_page_of_innovations(tmp_path: Path) -> None:
    model = tmp_path / "model.yaml"
    result = command(
        run_folder(tmp_path), "--airframe", "osprey", "--delay", "0", "--write", model, "--json"
    )
    assert result.exit_code == 0
    found = identified("turbulence", 0.3)
    entries = json.loads(result.stdout)["entries"]
    assert list(entries) == [entry.name for entry in found.entries]
    for entry in found.entries:
        shown = {
            "nominal": entry.nominal,
            "value": entry.value,
            "change": entry.error,
            "deviation": entry.deviation,
        }
        assert entries[entry.name] == shown | {"unit": entry.nominal}
    airframe = load_airframe(str(model))
    assert_array_equal(airframe.matrix_b(), found.airframe.matrix_b())
    assert_array_equal(airframe.matrix_gusts(), found.airframe.matrix_gusts())
    header = [line for line in model.read_text().splitlines() if line.startswith("#")]
    assert any("B[q, elevator]" in line for line in header)
    assert {"nominal", "identified", "held out"} <= set(
        re.findall(r'"name":"([^"]+)"', model.with_suffix(".html").read_text())
    )
