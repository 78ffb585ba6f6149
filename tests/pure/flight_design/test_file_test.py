# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test how the learner tests the deviations of an airframe file against a flight.

The files are the osprey's, with entries of A multiplied by factors exp(0.6 N), where 29 % are
believed.
"""

from functools import cache, partial

import numpy as np
import pytest
from pytest import approx
from scipy import stats
from tests.pure.flight_design.test_model_identification import (
    ACTUATORS,
    OSPREY,
    flight,
    identified,
    servo,
    true_errors,
)

from aircraft_sim.airframes.airframe import Airframe
from aircraft_sim.uncertainty import AIR_RELATIVE, wind_factors
from flight_analysis.closed_loop.learning_loop import Entry
from flight_design.identification import innovation_filters
from flight_design.identification.likelihood import KNOWN, PRIOR, Unknown
from flight_design.identification.model_identification import (
    Identification,
    Part,
    identify_model,
)
from flight_design.identification.model_quality import Prediction
from flight_design.identification.model_refusals import Coupling
from flight_design.learning.file_test import (
    AT_BOUND,
    ROUGHEST,
    identified_within,
    is_contradicted,
)

pytestmark = pytest.mark.slow

ROUGH = 0.6  # standard deviation of the logarithms of the factors
NAMES = ("p", "r")


def rough_file(seed: int) -> Airframe:
    """Return the osprey with each entry of A multiplied by a random factor.

    The kinematics stay.
    """
    rng = np.random.default_rng(seed)
    A = OSPREY.matrix_a()
    factors = np.exp(ROUGH * rng.standard_normal(A.shape))
    for angle in ("theta", "phi"):
        factors[OSPREY.index(angle)] = 1.0
    A *= factors
    return OSPREY.with_matrices(
        A, OSPREY.matrix_b(), wind_factors(OSPREY, A[None], AIR_RELATIVE)[0]
    )


@cache
def learned(seed: int | None, uncertainty: float = 0.3) -> tuple[Identification, Unknown]:
    """Identify a flight in moderate turbulence, from a rough file or from the osprey's own."""
    recorded = innovation_filters.recording(flight("turbulence", uncertainty), OSPREY)
    file = OSPREY if seed is None else rough_file(seed)
    identify = partial(identify_model, recorded, file, ACTUATORS, bound_count=AT_BOUND)
    return identified_within(identify, KNOWN, tests=True)


def furthest_off(model: Identification) -> float:
    """Return the largest error of an entry of the parts that may be used, in stated deviations."""
    aircraft = servo("turbulence", 0.3).aircraft.sampled_airframe()
    entries = tuple(e for part in model.parts if not part.refusal for e in part.entries)
    true = true_errors(aircraft, entries)
    return max(abs(entry.error - true[entry.name]) / entry.deviation for entry in entries)


@pytest.mark.parametrize("seed", [5, 7])
def test_rough_file_is_found_rough_and_its_entries_within_three_deviations(seed: int) -> None:
    model, believed = learned(seed)
    assert (believed.error, believed.effect) == (0.58, 0.58)
    assert model.refusal is None
    assert furthest_off(model) < 3.0


@pytest.mark.parametrize("uncertainty", [0.0, 0.3])
def test_right_file_keeps_its_deviations(uncertainty: float) -> None:
    model, believed = learned(None, uncertainty)
    assert believed == KNOWN
    assert model.remarks == ()


@pytest.mark.parametrize("air", ["turning", "gust"])
def test_doubt_widens_deviations_and_refuses_nothing(air: str) -> None:
    recorded = innovation_filters.recording(flight(air, 0.3), OSPREY)
    doubted = identify_model(recorded, OSPREY, ACTUATORS, is_doubted=True)
    model = identified(air, 0.3)
    assert doubted.refusal == model.refusal
    added = np.array([each for part in doubted.parts for each in part.by_model])
    before, after = (
        np.array([entry.deviation for entry in each.entries]) for each in (model, doubted)
    )
    assert [entry.error for entry in doubted.entries] == [entry.error for entry in model.entries]
    assert after == approx(np.hypot(before, added))
    assert added.max() > 0.01


ROLL = Entry("A", "p", "p", -10.0, 0.0, 0.05, -10.0)


def lateral(*errors: float, whiteness: float = 1.0, aileron: float = 0.0) -> Identification:
    """Return a model of p and r, with entries of A that the record shows, and their errors."""
    effects = (
        Entry("B", "p", "aileron", 80.0, aileron, 0.02, 80.0),
        Entry("B", "r", "rudder", 10.0, 0.0, 0.02, 10.0),
    )
    entries = tuple(ROLL._replace(error=error) for error in errors)
    prediction = Prediction(np.ones(2), np.full(2, whiteness), 1.0)
    inputs = ("aileron", "rudder")
    part = Part(
        inputs, NAMES, entries + effects, prediction, prediction, None, (0.0, 0.0), has_gusts=False
    )
    recorded = innovation_filters.FlightData(0.01, *(np.zeros((1, 1)),) * 3)
    nothing = np.zeros((1, 1))
    return Identification(
        OSPREY, recorded, nothing[0] > 0.0, (nothing, nothing), prediction, prediction, (part,)
    )


def test_chi_square_of_the_errors_has_its_limit_at_a_probability_of_a_thousandth() -> None:
    """Chi-square has 3.9 degrees of freedom.

    There are three entries and two effects, and part of them is left open by the record.
    """
    degrees = 3.0 * (1.0 - (0.05 / PRIOR) ** 2) + 2.0 * (1.0 - (0.02 / PRIOR) ** 2)
    limit = PRIOR * np.sqrt(stats.chi2.isf(1e-3, degrees) / 3.0)
    assert not is_contradicted(lateral(*[0.99 * limit] * 3), KNOWN)
    assert is_contradicted(lateral(*[1.01 * limit] * 3), KNOWN)


def test_errors_of_a_rough_file_count_as_logarithms_of_factors() -> None:
    """An entry at a third of its value is as far off as an entry at three times its value."""
    rough = Unknown(error=0.5, effect=0.5)
    for factor in (1.0 / 3.0, 3.0):
        model = lateral(*[factor - 1.0] * 4)
        part = model.parts[0]
        shown = tuple(entry._replace(deviation=0.05 * factor) for entry in part.entries[:4])
        part = part._replace(entries=shown + part.entries[4:])
        assert not is_contradicted(model._replace(parts=(part,)), rough)


@pytest.mark.parametrize(
    "model",
    [
        lateral(0.9, 0.9, 0.9, 0.9, whiteness=9.0),
        lateral(0.9, 0.9, 0.9, 0.9, aileron=-0.6),
    ],
    ids=["coloured", "aileron at a bound"],
)
def test_wrong_model_says_nothing_about_the_file(model: Identification) -> None:
    assert is_contradicted(lateral(0.9, 0.9, 0.9, 0.9), KNOWN)
    assert not is_contradicted(model, KNOWN)


def test_part_that_lacks_its_coupling_says_nothing_about_the_file() -> None:
    model = lateral(0.9, 0.9, 0.9, 0.9)
    part = model.parts[0]._replace(refusal=Coupling("coupling: found none"))
    assert not is_contradicted(model._replace(parts=(part,)), KNOWN)


def test_deviations_are_doubled_up_to_the_roughest_and_the_learner_says_so() -> None:
    asked = list[Unknown]()

    def identify(unknown: Unknown, *, searches_again: bool) -> Identification:
        asked.append(unknown)
        return lateral(*[4.0] * 4)

    believed = KNOWN
    told = []
    for _ in range(3):
        found, believed = identified_within(identify, believed, tests=True)
        told.append([str(remark) for remark in found.remarks])
    assert [unknown.error for unknown in asked] == [0.29, 0.58, 0.58, ROUGHEST, ROUGHEST]
    assert told[0] == [
        (
            "airframe osprey: found entries further off than their deviation of 29 %, expected "
            "within; from now on it is 58 %"
        )
    ]
    assert told[2] == []
    assert identified_within(identify, KNOWN, tests=False)[1] == KNOWN
