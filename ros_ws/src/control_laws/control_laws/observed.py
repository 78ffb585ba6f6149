# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Extend a law by an observer, for many sets of weights at once.

The parameters of the observers come from the gains of a search.
"""

from typing import Any

import numpy as np

from control_laws.nominal_model import NominalModel
from control_laws.observer_design import (
    ExtendedStateWeights,
    Names,
    ObserverDesign,
    Weights,
    aircraft_observer,
    extended_state_observer,
)
from flight_core.vectors import FloatArray
from rise_di_controller.extensions.model_sections import ObserverConfig
from rise_di_controller.extensions.observer import ObserverParams
from rise_di_controller.law.saturation import Limits

# The defaults of an observer in a file.
PART, WITHIN, FADE = (
    float(ObserverConfig.model_fields[name].default) for name in ("part", "within", "fade")
)


def observer_params(
    design: ObserverDesign, law_params: Any, model: NominalModel, part: float = PART
) -> ObserverParams:
    """Return the parameters of an observer that extends a law, from N designs.

    `law_params` has the parameters of the law. u_o stays within the fraction `part` of the limits
    of u, needs WITHIN s or more from 0 to this bound, and fades in for FADE s after an engagement.
    """

    def aircraft_last(matrices: FloatArray) -> FloatArray:
        return np.moveaxis(matrices, 0, -1) if matrices.ndim > 2 else matrices

    lower = part * model.lower[:, None]
    upper = part * model.upper[:, None]
    limits = Limits(lower, upper, (upper - lower) / 2.0 / WITHIN)
    Phi, Gamma, H, L, F = (
        aircraft_last(matrix) for matrix in (design.Phi, design.Gamma, design.H, design.L, design.F)
    )
    return ObserverParams(
        law=law_params,
        Phi=Phi,
        Gamma=Gamma,
        H=H,
        L=L,
        F=F,
        limits=limits,
        fade_rate=np.array(1.0 / FADE),
    )


def aircraft_design(
    gains: dict[str, FloatArray], model: NominalModel, names: Names | None = None
) -> ObserverDesign:
    """Design observers with the aircraft's model, with weights from the gains of a search.

    The gains are effort and drift, each (m, N), gust and wind_time, each (G, N), and loose, which
    is (1, N) or (n, N).
    """
    weights = Weights(*(gains[name].T for name in Weights._fields))
    return aircraft_observer(model, names or unnamed(model), weights)


def extended_state_design(
    gains: dict[str, FloatArray], model: NominalModel, names: Names | None = None
) -> ObserverDesign:
    """Design observers that know only Omega and the lags, for the gains of a search.

    The gains are effort, drift, rate_drift and decay, each (m, N).
    """
    weights = ExtendedStateWeights(*(gains[name].T for name in ExtendedStateWeights._fields))
    return extended_state_observer(model, names or unnamed(model), weights)


def unnamed(model: NominalModel) -> Names:
    """Return numbers in place of names, for a design that is not written to a file."""
    (n, m), G = model.B.shape[-2:], model.wind.shape[-1]
    numbers = [tuple(map(str, range(count))) for count in (n, m, m, G)]
    return Names(*numbers)
