# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Assess how well a model predicts the samples that were held out of its fit."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtr

from flight_core.outcome import Refusal
from flight_core.vectors import FloatArray
from flight_design.identification.likelihood import Innovations

# largest `whiteness` of a model's innovations. White innovations have 1, with a deviation of 0.3. A
# model with more leaves out something that the aircraft does.
MAX_WHITENESS = 3.0
LAGS = 20  # largest lag in `whiteness`, in samples: 0.2 s at 100 Hz


class Prediction(NamedTuple):
    """Quality of a model's predictions of the held-out samples, one period ahead."""

    rms: FloatArray  # (m,) rms of the innovations, units of y
    whiteness: FloatArray  # (m,) 1 for white noise, see `whiteness`
    log_likelihood: float  # mean over the samples, up to a constant


def prediction(innovations: Innovations, held_out: NDArray[np.bool_]) -> Prediction:
    """Assess how well innovations predict the held-out samples, whose mask has shape (T,)."""
    rms = np.sqrt(np.mean(innovations.r[held_out] ** 2, axis=0))
    likelihood = float(np.mean(innovations.log_likelihood[held_out]))
    return Prediction(rms, whiteness(innovations.normalised, held_out), likelihood)


def whiteness(e: FloatArray, held_out: NDArray[np.bool_]) -> FloatArray:
    """Return how far innovations are from white noise, for each output, (m,); 1 for white noise.

    The value is the mean of n_k rho_k^2 over the lags k = 1 .. LAGS. rho_k is the autocorrelation
    of n_k pairs of held-out samples. For white noise the mean is 1, with a standard deviation of
    sqrt(2 / LAGS). e has shape (T, m), held_out (T,). Source: G. M. Ljung, G. E. P. Box, Biometrika
    65(2), 1978. Here both samples of a pair lie in the same held-out span.
    """
    return np.diag(correlation(e, e, held_out))


def correlation(e: FloatArray, lagged: FloatArray, used: NDArray[np.bool_]) -> FloatArray:
    """Return how strongly e follows each column of `lagged`, (m, k); 1 if they are independent.

    The value is the mean of n_k rho_k^2 over the lags k = 1 .. LAGS. rho_k is the correlation of e
    with `lagged` k samples earlier. e has shape (T, m), lagged (T, k). `used`, (T,), is the mask of
    n samples.
    """
    now, then = (np.where(used[:, None], values, 0.0) for values in (e, lagged))
    power = np.outer(*(np.sum(values**2, axis=0) / used.sum() for values in (now, then)))
    total = np.zeros_like(power)
    for lag in range(1, LAGS + 1):
        pairs = max(int(np.sum(used[lag:] & used[:-lag])), 1)
        total += (now[lag:].T @ then[:-lag]) ** 2 / pairs / power
    return np.asarray(total / LAGS)


def advantage(
    first: Innovations, second: Innovations, span: int, counts: NDArray[np.bool_]
) -> float:
    """Return by how many standard deviations the first model predicts a record better.

        t = sum d_k / sqrt(K var d),  d_k the difference of log-likelihood of span k of K
        z = Phi^-1(F_(K-1)(t)),  F of Student's distribution, Phi of the normal one

    The result is z. If both models are equally far from the aircraft, z has a standard normal
    distribution. This holds whichever model is simpler, and even if both models are wrong. Source:
    Q. H. Vuong, Econometrica 57(2), 1989, here with spans of `span` samples, whose d_k are nearly
    independent. Student's t is used because K is small. Samples outside the mask `counts`, (T,),
    are left out. With fewer than two spans z is 0.
    """
    end = len(counts) // span * span
    d = np.where(counts, first.log_likelihood - second.log_likelihood, 0.0)[:end]
    is_counted = counts[:end].reshape(-1, span).any(axis=1)
    sums = d.reshape(-1, span).sum(axis=1)[is_counted]
    if len(sums) < 2 or np.ptp(sums) == 0.0:
        return 0.0
    t = np.sum(sums) / (np.sqrt(len(sums)) * np.std(sums, ddof=1))
    return float(-np.sign(t) * ndtri(stdtr(len(sums) - 1, -abs(t))))


@dataclass(frozen=True)
class NoBetter(Refusal):
    """A refusal of a model for the sole reason that the nominal model predicts as well."""


def reason_against_prediction(
    before: Prediction, after: Prediction, outputs: Sequence[str]
) -> NoBetter | None:
    """Return a refusal of a model that predicts held-out samples no better than the nominal one.

    A model is also refused if the innovations of an output are not white, and no whiter than those
    of the nominal model. Returns None if the model is not refused.
    """
    if after.log_likelihood <= before.log_likelihood:
        return NoBetter(
            f"held-out samples: found a log-likelihood of {after.log_likelihood:.4g} a sample, "
            "expected more than the"
            f" {before.log_likelihood:.4g} of the nominal airframe, which explains this flight "
            "as it is"
        )
    coloured = (after.whiteness > MAX_WHITENESS) & (after.whiteness >= before.whiteness)
    if coloured.any():
        worst = int(np.argmax(np.where(coloured, after.whiteness, 0.0)))
        return NoBetter(
            f"held-out samples: found innovations of {outputs[worst]} with a whiteness of "
            f"{after.whiteness[worst]:.3g}, expected less than the {before.whiteness[worst]:.3g} "
            "of the nominal airframe"
        )
    return None
