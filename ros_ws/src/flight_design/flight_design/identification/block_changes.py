# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find how uncertain a fit is from the changes that the blocks of its log make in it.

The fit minimises |e|^2 / 2 with a prior, and J has the derivatives of e by theta. H is the Hessian
of the cost. The errors e of different blocks are independent, but those within a block need not be.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, t

from flight_core.vectors import FloatArray

# Probability of an error below 1.476 deviations, for few blocks as for many. After 15 s of
# osprey_learn the guarantee covered 2.06 deviations of the first model; with 0.95 it covered 1.90,
# where the box has two.
COVERED = 0.93


class Blocks(NamedTuple):
    """What each block of a log adds to the derivatives of the cost by theta."""

    scores: FloatArray  # (blocks, p) J_k e_k
    hessians: FloatArray  # (blocks, p, p) J_k J_k'


def blocks_of(J: FloatArray, e: FloatArray, places: NDArray[np.int64]) -> Blocks:
    """Divide J, (p, samples, m), and e, (samples, m), into blocks.

    `places` has the number of the block of each sample.
    """
    scores, hessians = [], []
    for k in np.unique(places):
        part = J[:, places == k].reshape(len(J), -1)
        scores.append(part @ e[places == k].ravel())
        hessians.append(part @ part.T)
    return Blocks(np.array(scores), np.array(hessians))


def between(changes: FloatArray) -> FloatArray:
    """Return the variance of the sum of the changes by blocks, (blocks, p), for each parameter."""
    about_mean = changes - changes.mean(axis=0)
    return np.asarray(np.sum(about_mean**2, axis=0) * len(changes) / max(len(changes) - 1, 1))


def left_out(blocks: Blocks, inverse: FloatArray) -> FloatArray:
    """Return the variance of theta from its changes when single blocks are left out, (p,).

        c_k = (H - J_k J_k')^-1 J_k e_k

    c_k is the change of theta without block k. If a few blocks decide theta, the fit follows the
    errors in them, and their e is too small to show these errors. Their c_k is not too small.
    `inverse` is H^-1. Source: J. G. MacKinnon, H. White, J. Econometrics 29(3), 1985.
    """
    without = np.linalg.inv(np.linalg.inv(inverse) - blocks.hessians)
    return between(np.einsum("kij,kj->ki", without, blocks.scores))


def few_blocks(blocks: Blocks, inverse: FloatArray, by_noise: FloatArray) -> FloatArray:
    """Return the variance of theta from few blocks, (p,).

        v_i = K / (K - 1) sum_k (c_ki - mean)^2,   c_k = H^-1 J_k e_k
        variance_i = v_i / E(v_i) by_noise_i (t_nu(0.93) / 1.476)^2,   nu = 2 E(v_i)^2 / var(v_i)

    E and var are the mean and the variance if the model is right, that is if e is white noise
    before the fit. Then noise alone gives theta the variance `by_noise`, (p,). The v_i of few
    blocks may be small by chance. So the deviation is widened until 1.476 deviations have the same
    probability as in a normal distribution: t_nu is a quantile of Student's t.

    `inverse` is H^-1. Sources: R. M. Bell, D. F. McCaffrey, Survey Methodology 28(2), 2002, for nu;
    G. W. Imbens, M. Kolesar, Rev. Economics and Statistics 98(4), 2016, for the quantile.
    """
    found = between(blocks.scores @ inverse)
    count = len(blocks.scores)
    ones = np.eye(count)
    through = inverse @ blocks.hessians
    # (p, blocks, blocks) covariance of c_ki and c_li, after the fit
    shared = np.einsum("kij,ji,kl->ikl", through, inverse, ones)
    shared -= np.einsum("kij,jm,lim->ikl", through, inverse, through)
    about_mean = (ones - 1.0 / count) @ shared
    mean = np.trace(about_mean, axis1=1, axis2=2)
    square = np.einsum("ikl,ilk->i", about_mean, about_mean)
    # An entry that does not move the log has no c_k, and its quotients would be 0 / 0.
    is_shown = mean > 0.0
    degrees = np.divide(mean**2, square, out=np.ones_like(mean), where=is_shown)
    expected = np.where(is_shown, mean * count / max(count - 1, 1), 1.0)
    factor = t.ppf(COVERED, degrees) / norm.ppf(COVERED)
    return np.asarray(found / expected * by_noise * factor**2)
