# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the decomposition Omega = S D U: its factors, what D depends on, and what is refused.

Further tests are about the pairing of channels that gives D = I.
"""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose, assert_array_equal

from aircraft_sim.airframes.airframe import load_airframe
from flight_core.parameters import ParameterError
from flight_core.vectors import FloatArray
from rise_di_controller.law.decomposition import (
    SDU,
    DecompositionError,
    Pairing,
    coupling,
    decompose,
    leading_minors,
    search,
    signs,
    unit_diagonal,
)

EPSILON = float(np.finfo(np.float64).eps)
SIZES = st.integers(1, 5)
ENTRIES = st.floats(-10.0, 10.0).filter(lambda value: abs(value) > 0.01)


def matrices() -> st.SearchStrategy[FloatArray]:
    return SIZES.flatmap(lambda m: arrays(np.float64, (m, m), elements=ENTRIES))


@st.composite
def factors(draw: st.DrawFn) -> SDU:
    m = draw(SIZES)
    root = draw(arrays(np.float64, (m, m), elements=st.floats(-2.0, 2.0)))
    D = draw(arrays(np.float64, m, elements=st.sampled_from([-1.0, 1.0])))
    U = np.eye(m) + np.triu(draw(arrays(np.float64, (m, m), elements=st.floats(-2.0, 2.0))), 1)
    return SDU(root @ root.T + np.eye(m), D, U)


def product(sdu: SDU) -> FloatArray:
    return sdu.S @ np.diag(sdu.D) @ sdu.U


def decomposed(Omega: FloatArray) -> SDU:
    """Return S D U of Omega. Hypothesis leaves out an Omega that has no such factors."""
    try:
        return decompose(Omega)
    except DecompositionError:
        assume(False)
        raise


def pairing_of(Omega: FloatArray, largest_U: float = math.inf) -> Pairing:
    pairing = search(Omega, largest_U)
    assert pairing is not None
    return pairing


AIRFRAME = load_airframe("osprey")
OSPREY: FloatArray = AIRFRAME.matrix_c() @ np.array(AIRFRAME.B)
"""Omega of the osprey in the units of its file: rad/s and m/s per deg and %."""
SWAPPED = OSPREY[:, [0, 1, 3, 2]]  # the rudder is paired with the roll rate
EXCHANGE = np.array([[0.0, 1.0], [1.0, 0.0]])


@given(matrices())
def test_factors_have_structure_that_paper_requires(Omega: FloatArray) -> None:
    S, D, U = decomposed(Omega)
    assert np.array_equal(S, S.T)
    # A Cholesky factor exists only for positive definite matrices; the shift is the rounding of the
    # entries of S.
    np.linalg.cholesky(S + EPSILON * len(S) * np.diag(np.diag(S)))
    assert set(D) <= {-1.0, 1.0}
    assert np.array_equal(U, np.triu(U))
    assert np.array_equal(np.diag(U), np.ones(len(U)))


@pytest.mark.equation(10, 11)
@given(matrices())
def test_product_of_factors_is_omega_to_machine_precision(Omega: FloatArray) -> None:
    sdu = decomposed(Omega)
    residual = np.linalg.norm(product(sdu) - Omega)
    # The largest of 20 000 random matrices with up to 6 channels and entries over 6 decades was
    # 1.0; the bound is 10.
    assert residual <= 10.0 * len(Omega) * EPSILON * np.linalg.norm(sdu.S) * np.linalg.norm(sdu.U)


@pytest.mark.equation(10, 11)
@given(factors())
def test_unique_factors_are_recovered_from_their_product(known: SDU) -> None:
    recovered = decompose(product(known))
    # S has eigenvalues in [1, 101]: rounding is amplified by far less than 1e6, which a tolerance
    # of 1e-10 allows.
    assert_allclose(recovered.S, known.S, rtol=1e-10, atol=1e-10 * float(np.max(known.S)))
    assert_array_equal(recovered.D, known.D)
    assert_allclose(recovered.U, known.U, atol=1e-10 * float(np.max(known.S)))


@given(matrices())
def test_d_is_sign_of_ratios_of_leading_minors(Omega: FloatArray) -> None:
    D = decomposed(Omega).D
    minors = leading_minors(Omega)
    assert_array_equal(D, np.sign(minors / np.concatenate([[1.0], minors[:-1]])))
    assert_array_equal(D, signs(Omega))


@given(matrices(), st.data())
def test_sign_change_of_input_changes_own_d_only(Omega: FloatArray, data: st.DataObject) -> None:
    D = decomposed(Omega).D
    k = data.draw(st.integers(0, len(Omega) - 1))
    flip = np.where(np.arange(len(Omega)) == k, -1.0, 1.0)
    assert_array_equal(signs(Omega * flip), D * flip)


@given(matrices(), st.data())
def test_units_do_not_change_d(Omega: FloatArray, data: st.DataObject) -> None:
    """D is independent of the units of inputs and outputs."""
    # Far from the limit of 1e-9, which holds for equilibrated units and changes by a factor with
    # other units.
    D = decomposed(Omega).D
    assume(all(abs(minor) > 1e-6 for minor in leading_minors(Omega)))
    units = arrays(
        np.float64, len(Omega), elements=st.sampled_from([1e-3, 0.01, 0.3048, 1.0, 57.3, 1e4])
    )
    assert_array_equal(signs(data.draw(units)[:, None] * Omega * data.draw(units)), D)


@given(matrices())
@settings(max_examples=30)  # up to 14 400 orders of five channels
def test_search_returns_pairing_with_identity_d_and_u(Omega: FloatArray) -> None:
    pairing = search(Omega)
    assume(pairing is not None)
    assert pairing is not None
    outputs, inputs, input_signs, U = pairing
    rearranged = Omega[np.ix_(outputs, inputs)] * np.array(input_signs)
    assert_array_equal(signs(rearranged), np.ones(len(Omega)))
    assert_allclose(decompose(unit_diagonal(rearranged)).U, U, atol=1e-9 * float(np.max(np.abs(U))))


@pytest.mark.equation(10, 11)
def test_positive_diagonal_does_not_make_d_one() -> None:
    # By hand: L = [[1, 0], [2, 1]], p = (1, -3), W = [[1, 2], [0, 1]]; S = L |p| L', U = D L^-T D
    # W.
    S, D, U = decompose(np.array([[1.0, 2.0], [2.0, 1.0]]))
    assert_array_equal(S, [[1.0, 2.0], [2.0, 7.0]])
    assert_array_equal(D, [1.0, -1.0])
    assert_array_equal(U, [[1.0, 4.0], [0.0, 1.0]])


def test_omega_without_s_d_u_refused() -> None:
    """A nonsingular Omega with a zero leading minor is refused with the number of the minor."""
    with pytest.raises(
        DecompositionError, match=r"^Omega: found leading minor 1 zero .*, expected .*"
    ) as caught:
        decompose(EXCHANGE)
    assert caught.value.minor == 1
    assert isinstance(caught.value, ParameterError)


@pytest.mark.parametrize(
    "Omega, minor",
    [
        ([[0.0, 0.0], [0.0, 0.0]], 1),
        ([[1e-17, 1.0], [1.0, 0.0]], 1),  # zero up to rounding
        ([[1.0, 1.0], [1.0, 1.0]], 2),
        ([[1.0, 1.0], [1.0, 1.0 + 1e-12]], 2),
        # 0.1 * 0.1 is not 0.01 in floating point.
        (
            [[1.0, 0.1, 0.0], [0.1, 0.01, 1.0], [0.0, 1.0, 1.0]],
            2,
        ),
        ([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]], 3),
    ],
)
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_minor_zero_by_rounding_refused(Omega: list[list[float]], minor: int, unit: float) -> None:
    """A leading minor that is zero up to rounding is refused in any unit of inputs and outputs."""
    units = unit ** np.arange(len(Omega))
    with pytest.raises(DecompositionError) as caught:
        signs(units[:, None] * np.array(Omega) / units[::-1])
    assert caught.value.minor == minor


@pytest.mark.parametrize(
    "Omega, sentence",
    [
        (np.ones((1, 3)), r"Omega: found shape \(1, 3\), expected as many outputs as inputs"),
        (np.array([[math.nan]]), r"Omega: found \[\[nan\]\], expected finite values"),
    ],
)
def test_matrix_not_square_or_finite_refused(Omega: FloatArray, sentence: str) -> None:
    for function in (decompose, signs, leading_minors, unit_diagonal, coupling, search):
        with pytest.raises(DecompositionError, match=sentence):
            function(Omega)


def test_osprey_has_identity_d_and_little_coupling() -> None:
    # Channels q, V, p, r and elevator, thrust, aileron, rudder, with the signs of the airframe
    # file.
    assert_array_equal(signs(OSPREY), [1.0, 1.0, 1.0, 1.0])
    assert coupling(OSPREY) == pytest.approx(0.058, abs=5e-4)


def test_textbook_elevator_sign_flips_the_first_d() -> None:
    trailing_edge_down = OSPREY * np.array([-1.0, 1.0, 1.0, 1.0])
    assert_array_equal(signs(trailing_edge_down), [-1.0, 1.0, 1.0, 1.0])
    assert pairing_of(trailing_edge_down).signs == (-1, 1, 1, 1)


def test_search_keeps_bad_pairing_unless_u_limited() -> None:
    sign_change = pairing_of(SWAPPED)
    assert sign_change.inputs == (0, 1, 2, 3)
    assert sign_change.signs == (1, 1, -1, 1)
    re_paired = pairing_of(SWAPPED, largest_U=1.0)
    assert re_paired[:3] == ((0, 1, 2, 3), (0, 1, 3, 2), (1, 1, 1, 1))
    assert float(np.max(np.abs(re_paired.U - np.eye(4)))) == pytest.approx(0.058, abs=5e-4)


def test_search_changes_pairing_beyond_signs() -> None:
    """If no change of the input signs gives D = I, the search also changes the pairing."""
    assert pairing_of(EXCHANGE)[:3] == ((0, 1), (1, 0), (1, 1))


@pytest.mark.parametrize("m", [6, 16])
def test_search_pairs_many_channels(m: int) -> None:
    """Many channels are paired in a short time.

    Sixteen channels have (16!)^2 = 4e26 orders, which no computer can try one by one.
    """
    random = np.random.default_rng(m)
    inputs = random.permutation(m)
    Omega = 0.02 * random.uniform(-1.0, 1.0, (m, m))
    Omega[range(m), inputs] = random.choice([-1.0, 1.0], m) * random.uniform(1.0, 2.0, m)
    pairing = pairing_of(Omega, largest_U=0.5)
    assert (pairing.outputs, pairing.inputs) == (tuple(range(m)), tuple(inputs))
    ordered = Omega[:, inputs] * np.array(pairing.signs)
    assert all(np.linalg.det(ordered[:k, :k]) > 0.0 for k in range(1, m + 1))


def test_coupling_without_own_response_is_infinite() -> None:
    """The coupling is infinite if an output does not respond to its paired input."""
    assert coupling(np.array([[1.0, 1.0], [1.0, 0.0]])) == math.inf
    with pytest.raises(DecompositionError, match="found Omega_22 = 0"):
        unit_diagonal(np.array([[1.0, 1.0], [1.0, 0.0]]))
