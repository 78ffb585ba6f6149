# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Put a filter of first order, such as the low-pass of a gyro, between the outputs and y."""

import numpy as np

from control_laws.observer_design import Correction, ObserverModel
from flight_core.vectors import FloatArray


def kept_share(lag: FloatArray, period: float) -> FloatArray:
    """Return `keep` of `behind_filter` for N lags, s, as (N, 1, 1, 1).

    With this `keep`, the filter is late by its lag at low frequencies. With a lag of 0 it changes
    nothing.
    """
    return (lag / (lag + period))[:, None, None, None]


def behind_filter(sampled: ObserverModel, keep: FloatArray) -> ObserverModel:
    """Extend N sampled models by a filter between their outputs and y.

        f+ = keep f + (1 - keep) H z+,   y = f

    In the state of the result, f comes after z.
    """
    m, s = sampled.H.shape
    reach = _reach(sampled.H, keep)
    Phi = np.concatenate([reach @ sampled.Phi, np.zeros((*reach.shape[:-1], m))], axis=-1)
    Phi[..., s:, s:] = keep * np.eye(m)
    names = (f"filtered.{k}" for k in range(m))
    H = np.eye(m, s + m, s)
    return ObserverModel((*sampled.states, *names), Phi, reach @ sampled.Gamma, H)


def filtered_correction(
    keep: FloatArray,
    correction: Correction,
    Phi: FloatArray,
    H: FloatArray,
    process: FloatArray,
    noise: FloatArray,
) -> FloatArray:
    """Compute the gain of `correction` for the models of `behind_filter`.

    The noise of the process also reaches the states of the filter within a period.
    """
    reach = _reach(H, keep)
    behind = behind_filter(ObserverModel((), Phi, Phi[..., :0], H), keep)
    moved = reach @ process @ np.swapaxes(reach, -1, -2)
    return correction(behind.Phi, behind.H, moved, noise)


def _reach(H: FloatArray, keep: FloatArray) -> FloatArray:
    """Return the matrix from a change of z to the change of z and f, (N, 1, s + m, s)."""
    s = H.shape[1]
    unit = np.broadcast_to(np.eye(s), (*keep.shape[:2], s, s))
    return np.concatenate([unit, (1.0 - keep) * H], axis=-2)
