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

Gains = dict[str, FloatArray]  # gains by name, shape (m, N), or (1, N) where one serves all channels; all of them positive

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

INITIAL_GUST_INTENSITY = 0.5  # m/s per root s, the same for each axis of the wind


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


_rise, _rise_gains = rise_di.of_gains, ("K", "Lambda", "beta", "softening")
_observer, _observer_gains = rise_observer.observer_params, ("effort", "gust", "drift", "loose")
_filtered, _ideal = (partial(mackunis.control_law, ideal=ideal) for ideal in (False, True))
_l1_ff, _model = partial(adaptive.l1, feedforward=True), "A, B, f"
_soft, _implicit = (partial(rise_di.control_law, sign=sign) for sign in (Sign.SOFT, Sign.IMPLICIT))
_bounded, _lqg = (partial(rise_observer.control_law, authority=one) for one in (rise_observer.AUTHORITY_FRACTION, 1.0))

FULL_STATE: dict[str, tuple[str, Callable[..., ControlLaw], Callable[[Gains, NominalModel], Any], tuple[str, ...]]] = {
    "di": ("dynamic inversion", inversion.control_law, inversion.inversion_params, ("K",)),
    "di_pi": ("dynamic inversion + PI", inversion.control_law, inversion.inversion_params, ("K", "Lambda")),
    "mrac": ("MRAC", adaptive.mrac, adaptive.mrac_params, ("K", "adaptation", "bias", "leak")),
    "lqi": ("LQI", lqi.control_law, lqi.lqi_params, ("integral", "effort", "fade")),
}
"""Title, law, parameters and tuned gains of the laws of the full state; each also flies with vanes, relative to the air."""

LAWS: dict[str, Law] = {
    "rise": Law("RISE-DI, softened sign", "y", "", _soft, _rise, _rise_gains),
    "rise_implicit": Law("RISE-DI, implicit sign", "y", "", _implicit, _rise, ("K", "Lambda", "beta", "omega")),
    "rise_ff": Law("RISE-DI + feedforward", "y", _model, _soft, _rise, _rise_gains, feedforward=True),
    "rise_observer": Law(
        "RISE-DI + feedforward + observer", "y", f"{_model}, wind", _bounded, _observer, _rise_gains + _observer_gains, True
    ),
    "lqg": Law("LQG + feedforward", "y", f"{_model}, wind", _lqg, _observer, _observer_gains, feedforward=True),
    "pi": Law("PI", "y", "", _soft, _rise, ("K", "Lambda")),
    "pi_ff": Law("PI + feedforward", "y", _model, _soft, _rise, ("K", "Lambda"), feedforward=True),
    "l1": Law("L1", "y", "Omega", partial(adaptive.l1, feedforward=False), adaptive.l1_params, ("K", "bandwidth")),
    "l1_ff": Law("L1 + feedforward", "y", _model, _l1_ff, adaptive.l1_params, ("K", "bandwidth"), feedforward=True),
    "twisting": Law(
        "super-twisting", "y", "Omega", super_twisting.control_law, super_twisting.twisting_params, ("root", "beta")
    ),
    "mackunis": Law(
        "MacKunis RISE, filtered difference", "y", "Omega", _filtered, mackunis.mackunis_params, (*_rise_gains, "filter")
    ),
    "mackunis_ideal": Law("MacKunis RISE, perfect y_dot", "y, y_dot", "Omega", _ideal, mackunis.mackunis_params, _rise_gains),
    "indi": Law("INDI", "y, actuators", "Omega", indi.control_law, indi.indi_params, ("K", "bandwidth", "share")),
} | {
    f"{name}_vanes" if vanes else name: Law(
        title, "full state, vanes" if vanes else "full state", _model, partial(control_law, vanes=vanes), params, tuned
    )
    for name, (title, control_law, params, tuned) in FULL_STATE.items()
    for vanes in (False, True)
}
