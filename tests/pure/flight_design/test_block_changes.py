# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the deviations that the blocks of a log give.

They are compared with sums by hand, and with regressions whose truth is known.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from pytest import approx

from flight_core.vectors import FloatArray
from flight_design.identification.block_changes import (
    Blocks,
    between,
    blocks_of,
    few_blocks,
    left_out,
)
from flight_design.identification.innovation_filters import LEVELS
from flight_design.identification.likelihood_search import Search, Slopes

PLACES = np.repeat(np.arange(4), 10)  # blocks of 40 samples


def regression(seed: int, colour: float = 0.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return J, (2, samples), the errors of a regression, and those of theta.

    The share `colour` of the variance of the errors is common to all samples of a block.
    """
    rng = np.random.default_rng(seed)
    J = np.vstack([np.ones(40), rng.normal(size=40) + rng.normal(size=4)[PLACES]])
    noise = np.sqrt(1.0 - colour) * rng.normal(size=40)
    noise += np.sqrt(colour) * rng.normal(size=4)[PLACES]
    off = np.linalg.solve(J @ J.T, J @ noise)
    return J, noise - off @ J, off


def divided(J: FloatArray, e: FloatArray) -> Blocks:
    return blocks_of(J[:, :, None], e[:, None], PLACES)


def inverted(hessian: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(hessian), np.float64)


def test_deviation_of_a_mean_is_that_of_the_means_of_its_blocks_by_students_t() -> None:
    """The deviation of a mean is found from the means of the blocks by Student's t.

    The four blocks have the means 1, -1, 2 and -2. Their variance is 10 / 3, and the one of e is 5
    / 6. t(0.93) is 1.9950 with three degrees of freedom, and 1.4758 in a normal distribution.
    """
    means = np.array([1.0, -1.0, 2.0, -2.0])
    J = np.ones((1, 40))
    blocks = divided(J, means[PLACES])
    inverse = np.array([[1.0 / 40.0]])
    variance = few_blocks(blocks, inverse, by_noise=np.diag(inverse))
    assert variance == approx((10.0 / 3.0) / 4.0 * (1.99502 / 1.47579) ** 2, rel=1e-5)
    # without a block, the mean of the others changes by a third of the mean of the block
    assert left_out(blocks, inverse) == approx(4.0 / 3.0 * np.sum((means / 3.0) ** 2))


def test_change_without_a_block_is_that_of_a_fit_without_it() -> None:
    J, e, _ = regression(1)
    changes = []
    for k in range(4):
        kept = k != PLACES
        changes.append(np.linalg.solve(J[:, kept] @ J[:, kept].T, J[:, kept] @ e[kept]))
    assert_allclose(left_out(divided(J, e), inverted(J @ J.T)), between(np.array(changes)))


def test_entry_that_moves_nothing_keeps_the_variance_of_its_prior() -> None:
    J, e, _ = regression(2)
    J[1] = 0.0
    inverse = inverted(J @ J.T + np.eye(2))
    by_noise = np.diag(inverse - inverse @ inverse)
    assert few_blocks(divided(J, e), inverse, by_noise)[1] == 0.0


@pytest.mark.parametrize("colour, share", [(0.0, 0.14), (0.5, 0.17)])
def test_few_blocks_cover_a_true_value_as_often_as_deviations_should(
    colour: float, share: float
) -> None:
    """With normal errors, 14 % are above 1.476 deviations, and 28 % or more by a plain sum."""
    beyond = []
    for seed in range(2000):
        J, e, off = regression(seed, colour)
        inverse = inverted(J @ J.T)
        blocks = divided(J, e)
        plain = between(blocks.scores @ inverse)
        stated = few_blocks(blocks, inverse, by_noise=np.diag(inverse))
        beyond.append(np.abs(off) > 1.476 * np.sqrt([plain, stated]))
    by_sum, by_t = np.mean(beyond, axis=(0, 2))
    assert by_t == approx(share, abs=0.02)
    assert by_sum > 0.25


class Line(Search):
    """A search whose innovations are linear in theta, and depend on the level of the wind."""

    def __init__(self, J: FloatArray, e: FloatArray) -> None:
        self.prior = np.array([0.3, 0.3])
        self.centre = np.zeros(2)
        self.asked: list[NDArray[np.int64]] = []
        self._line = J, e

    def _slopes(
        self, theta: FloatArray, levels: NDArray[np.int64], *masks: Any, **others: Any
    ) -> Slopes:
        self.asked.append(levels)
        J, e = self._line
        return Slopes(0.0, (e + theta @ J)[:, None], J, np.zeros(2))


def test_change_with_gusts_in_every_span_is_that_of_a_fit_with_them() -> None:
    """The level is the one that most spans with gusts have. This is 12, and not the calm 0."""
    J, e, _ = regression(3, colour=0.5)
    e += 0.3 * J[1]
    theta = np.array([0.1, -0.2])
    line = Line(J, e)
    levels = np.array([0, 0, 0, 0, 12, 12, 13])
    assert (LEVELS[[12, 13], 1] > 0.0).all()
    fit: Any = SimpleNamespace(theta=theta, levels=levels)
    variance, change = line._in_lasting_gusts(fit, np.ones(40, dtype=bool))
    hessian = J @ J.T + np.eye(2) / 0.09
    assert_allclose(theta + change, -np.linalg.solve(hessian, J @ e))
    assert_allclose(variance, np.diag(inverted(hessian)))
    assert [asked.tolist() for asked in line.asked] == [[12] * 7]


def test_air_without_gusts_changes_nothing() -> None:
    fit: Any = SimpleNamespace(theta=np.ones(2), levels=np.array([0, 3, 4]))
    line = Line(np.ones((2, 40)), np.zeros(40))
    variance, change = line._in_lasting_gusts(fit, np.ones(40, dtype=bool))
    assert not variance.any()
    assert not change.any()
    assert not line.asked
