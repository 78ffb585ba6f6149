# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Catalogue of the compared laws: their measurements, model data, tuned gains, and the initial gains of a search."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from control_laws import adaptive, indi, inversion, lqi, mackunis, rise_di, rise_observer, super_twisting
from control_laws.nominal_model import NominalModel
from flight_core.vectors import FloatArray
from rise_di_controller.control_law import ControlLaw
from rise_di_controller.law import Sign

Gains = dict[str, FloatArray]
"""Gains by name, shape (m, N), or (1, N) where one serves all channels; all of them positive."""

INITIAL_CROSSOVER_LAG_PRODUCT = 0.4
"""rad, bandwidth times the lag of the loop at the start of a search: 23 degrees of phase at the crossover."""

INITIAL_CHANNEL_GAINS = {
    "beta": 5.0,
    "root": 1.0,
    "bandwidth": 15.0,
    "share": 0.7,
    "drift": 0.1,
    "adaptation": 10.0,
    "bias": 10.0,
    "integral": 2.0,
    "effort": 0.05,
}
"""Initial gains of a search in every channel, in scaled inputs and SI; K and Lambda start from the lag of the loop."""

INITIAL_COMMON_GAINS = {"softening": 3.0, "omega": 1.5, "filter": 12.6, "leak": 0.05, "fade": 4.0, "loose": 0.01}
"""Initial gains that are common to all channels."""

INITIAL_GUST_INTENSITY = 0.5
"""m/s per root s, the same for each axis of the wind."""


class Law(NamedTuple):
    """One law."""

    title: str
    measurements: str  # of the aircraft, besides y_m
    model_data: str  # of the nominal aircraft, besides D and the input scale
    control_law: Callable[[NominalModel], ControlLaw]
    params: Callable[[Gains, NominalModel], Any]
    tuned: tuple[str, ...]  # names of its gains
    feedforward: bool = False  # whether it uses the feedforward


def initial_gains(law: Law, model: NominalModel) -> Gains:
    """Initial gains of the search, shapes (m, 1) and (1, 1)."""
    K = INITIAL_CROSSOVER_LAG_PRODUCT / model.total_lag[:, None]
    gains = {"K": K, "Lambda": K / 4.0}
    gains |= {name: np.full(K.shape, value) for name, value in INITIAL_CHANNEL_GAINS.items()}
    gains |= {name: np.full((1, 1), value) for name, value in INITIAL_COMMON_GAINS.items()}
    gains["gust"] = np.full((model.wind.shape[1], 1), INITIAL_GUST_INTENSITY)
    return {name: gains[name] for name in law.tuned}


def _rise(sign: Sign) -> Callable[[NominalModel], ControlLaw]:
    return lambda model: rise_di.control_law(sign)


_soft, _soft_gains = _rise(Sign.SOFT), ("K", "Lambda", "beta", "softening")
_full, _air = "full state", "full state, vanes"

LAWS: dict[str, Law] = {
    "rise": Law("RISE-DI, softened sign", "y", "", _soft, rise_di.of_gains, _soft_gains),
    "rise_implicit": Law(
        "RISE-DI, implicit sign", "y", "", _rise(Sign.IMPLICIT), rise_di.of_gains, ("K", "Lambda", "beta", "omega")
    ),
    "rise_ff": Law("RISE-DI + feedforward", "y", "A, B, f", _soft, rise_di.of_gains, _soft_gains, feedforward=True),
    "rise_observer": Law(
        "RISE-DI + feedforward + observer",
        "y",
        "A, B, f, wind",
        partial(rise_observer.control_law, authority=rise_observer.AUTHORITY_FRACTION),
        rise_observer.observer_params,
        (*_soft_gains, "effort", "gust", "drift", "loose"),
        feedforward=True,
    ),
    "lqg": Law(
        "LQG + feedforward",
        "y",
        "A, B, f, wind",
        partial(rise_observer.control_law, authority=1.0),
        rise_observer.observer_params,
        ("effort", "gust", "drift", "loose"),
        feedforward=True,
    ),
    "pi": Law("PI", "y", "", _soft, rise_di.of_gains, ("K", "Lambda")),
    "pi_ff": Law("PI + feedforward", "y", "A, B, f", _soft, rise_di.of_gains, ("K", "Lambda"), feedforward=True),
    "l1": Law("L1", "y", "Omega", partial(adaptive.l1, feedforward=False), adaptive.l1_params, ("K", "bandwidth")),
    "l1_ff": Law(
        "L1 + feedforward",
        "y",
        "A, B, f",
        partial(adaptive.l1, feedforward=True),
        adaptive.l1_params,
        ("K", "bandwidth"),
        feedforward=True,
    ),
    "twisting": Law(
        "super-twisting", "y", "Omega", super_twisting.control_law, super_twisting.twisting_params, ("root", "beta")
    ),
    "mackunis": Law(
        "MacKunis RISE, filtered difference",
        "y",
        "Omega",
        partial(mackunis.control_law, ideal=False),
        mackunis.mackunis_params,
        ("K", "Lambda", "beta", "softening", "filter"),
    ),
    "mackunis_ideal": Law(
        "MacKunis RISE, perfect y_dot",
        "y, y_dot",
        "Omega",
        partial(mackunis.control_law, ideal=True),
        mackunis.mackunis_params,
        ("K", "Lambda", "beta", "softening"),
    ),
    "indi": Law("INDI", "y, actuators", "Omega", indi.control_law, indi.indi_params, ("K", "bandwidth", "share")),
    "di": Law(
        "dynamic inversion", _full, "A, B, f", partial(inversion.control_law, vanes=False), inversion.inversion_params, ("K",)
    ),
    "di_vanes": Law(
        "dynamic inversion", _air, "A, B, f", partial(inversion.control_law, vanes=True), inversion.inversion_params, ("K",)
    ),
    "di_pi": Law(
        "dynamic inversion + PI",
        _full,
        "A, B, f",
        partial(inversion.control_law, vanes=False),
        inversion.inversion_params,
        ("K", "Lambda"),
    ),
    "di_pi_vanes": Law(
        "dynamic inversion + PI",
        _air,
        "A, B, f",
        partial(inversion.control_law, vanes=True),
        inversion.inversion_params,
        ("K", "Lambda"),
    ),
    "mrac": Law(
        "MRAC", _full, "A, B, f", partial(adaptive.mrac, vanes=False), adaptive.mrac_params, ("K", "adaptation", "bias", "leak")
    ),
    "mrac_vanes": Law(
        "MRAC", _air, "A, B, f", partial(adaptive.mrac, vanes=True), adaptive.mrac_params, ("K", "adaptation", "bias", "leak")
    ),
    "lqi": Law(
        "LQI", _full, "A, B, f", lambda model: lqi.control_law(vanes=False), lqi.lqi_params, ("integral", "effort", "fade")
    ),
    "lqi_vanes": Law(
        "LQI", _air, "A, B, f", lambda model: lqi.control_law(vanes=True), lqi.lqi_params, ("integral", "effort", "fade")
    ),
}
