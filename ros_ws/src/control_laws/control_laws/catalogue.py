# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""List the control laws that are compared.

For each law the catalogue has its measurements, its model data, its tuned gains, and the initial
gains of a search.
"""

from collections.abc import Callable
from enum import StrEnum
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from control_laws import indi, l1, lqg, lqi, mackunis, observed, pi, rise_di_law
from control_laws.nominal_model import NominalModel
from flight_core.vectors import FloatArray
from rise_di_controller.extensions.observer import ObserverParams, with_observer
from rise_di_controller.law import law as rise
from rise_di_controller.law.control_law import ControlLaw
from rise_di_controller.law.law import Sign

Gains = dict[str, FloatArray]
"""Positive gains by name, for N sets of gains: (m, N), (G, N) for the axes of the wind, or (1, N)
for all channels."""

INITIAL_CROSSOVER_LAG_PRODUCT = 0.4
"""Bandwidth times the lag of the loop at the start of a search, rad. The lag then costs 23 degrees
of phase at the crossover."""

INITIAL_CHANNEL_GAINS = {
    "beta": 5.0,
    "bandwidth": 15.0,
    "share": 0.7,
    "drift": 0.1,
    "integral": 2.0,
    "effort": 0.05,
    "rate_drift": 0.5,
    "decay": 5.0,
}
"""Initial gains of a search in every channel, in scaled inputs and SI. K and Lambda are not here,
because they start from the lag of the loop."""

INITIAL_COMMON_GAINS = {
    "softening": 3.0,
    "omega": 1.5,
    "filter": 12.6,
    "fade": 4.0,
    "loose": 0.01,
}
"""Initial gains of a search that all channels share."""

INITIAL_WIND_GAINS = {"gust": 0.5, "wind_time": 2.0}
"""Initial noise of the wind, m/s per root s, and its time constant, s, which are equal for every
axis. Dryden's L / V0 at 100 m and 25 m/s is 4 s vertically and 10 s along the flight. A design gust
that takes 15 m to its peak takes 0.6 s."""


class FeedforwardModel(StrEnum):
    """A model of the aircraft that a feedforward uses."""

    NONE = "none"  # the law has no feedforward
    AIRCRAFT = "aircraft"  # A, B and f of the nominal aircraft
    INTEGRATORS = "integrators"  # y_dot = Omega u


class Law(NamedTuple):
    """A law of the catalogue, with functions that make the law and its parameters."""

    title: str
    law: str  # its name in `controller.law` of a scenario
    measurements: str  # what the law measures of the aircraft; y_m is always known
    model_data: str  # what the law knows of the nominal aircraft; D is always known
    control_law: Callable[[NominalModel], ControlLaw]
    params: Callable[[Gains, NominalModel], Any]
    tuned: tuple[str, ...]  # names of the gains
    # model of the feedforward, or the name of the law if the feedforward is of its controller
    feedforward: FeedforwardModel | str = FeedforwardModel.NONE
    # gains at which a search begins; None if they follow from the lag of the loop and the constants
    # INITIAL_...
    initial: Gains | None = None
    is_linear: bool = True  # whether the law is linear near e = 0

    @property
    def has_margins(self) -> bool:
        """Whether the law has a linear loop from y to u.

        A law that measures more than y, or has the implicit sign, has no such loop.
        """
        return self.is_linear and self.measurements == "y"


def initial_gains(law: Law, model: NominalModel) -> Gains:
    """Return the gains at which the search begins, with the shapes (m, 1), (G, 1) or (1, 1)."""
    if law.initial is not None:
        return law.initial
    K = INITIAL_CROSSOVER_LAG_PRODUCT / model.total_lag[:, None]
    gains = {"K": K, "Lambda": K / 4.0}
    gains |= {name: np.full(K.shape, value) for name, value in INITIAL_CHANNEL_GAINS.items()}
    gains |= {name: np.full((1, 1), value) for name, value in INITIAL_COMMON_GAINS.items()}
    gains |= {
        name: np.full((model.wind.shape[1], 1), value) for name, value in INITIAL_WIND_GAINS.items()
    }
    return {name: gains[name] for name in law.tuned}


def _over(
    law_params: Callable[[Gains, NominalModel], Any], part: float = observed.PART
) -> Callable[[Gains, NominalModel], ObserverParams]:
    """Return a function that makes the parameters of an observer that extends a law.

    The observer uses the aircraft's model. `law_params` makes the parameters of the law.
    """
    return lambda gains, model: observed.observer_params(
        observed.aircraft_design(gains, model), law_params(gains, model), model, part
    )


def _extended_state(gains: Gains, model: NominalModel) -> ObserverParams:
    return observed.observer_params(
        observed.extended_state_design(gains, model), pi.params_of(gains, model), model
    )


def _fixed(law: ControlLaw) -> Callable[[NominalModel], ControlLaw]:
    """Return a function that returns the same law for any model."""
    return lambda _: law


_rise_gains = ("K", "Lambda", "beta", "softening")
_observer_gains = ("effort", "gust", "wind_time", "drift", "loose")
_soft, _implicit = (_fixed(rise.CONTROL_LAWS[sign]) for sign in (Sign.SOFT, Sign.IMPLICIT))
_filtered, _ideal = (partial(mackunis.control_law, ideal=ideal) for ideal in (False, True))
_l1, _l1_ff = (_fixed(l1.CONTROL_LAWS[feedforward]) for feedforward in (False, True))
_lqi, _lqi_vanes = (partial(lqi.control_law, vanes=vanes) for vanes in (False, True))
_model = "A, B, f"
_wind = "A, B, f, wind, lags, noise"

LAWS: dict[str, Law] = {
    "rise": Law(
        title="RISE-DI, softened sign",
        law="rise_di",
        measurements="y",
        model_data="Omega_ii",
        control_law=_soft,
        params=rise_di_law.params_of,
        tuned=_rise_gains,
    ),
    "rise_implicit": Law(
        title="RISE-DI, implicit sign",
        law="rise_di",
        measurements="y",
        model_data="Omega_ii",
        control_law=_implicit,
        params=rise_di_law.params_of,
        tuned=("K", "Lambda", "beta", "omega"),
        is_linear=False,
    ),
    "rise_ff": Law(
        title="RISE-DI + feedforward",
        law="rise_di",
        measurements="y",
        model_data=_model,
        control_law=_soft,
        params=rise_di_law.params_of,
        tuned=_rise_gains,
        feedforward=FeedforwardModel.AIRCRAFT,
    ),
    "rise_observer": Law(
        title="RISE-DI + feedforward + observer",
        law="rise_di",
        measurements="y",
        model_data=_wind,
        control_law=_fixed(with_observer(rise.CONTROL_LAWS[Sign.SOFT])),
        params=_over(rise_di_law.params_of),
        tuned=_rise_gains + _observer_gains,
        feedforward=FeedforwardModel.AIRCRAFT,
    ),
    "pi_observer": Law(
        title="PI + feedforward + observer",
        law="pi",
        measurements="y",
        model_data=_wind,
        control_law=_fixed(with_observer(pi.CONTROL_LAW)),
        params=_over(pi.params_of),
        tuned=("K", "Lambda", *_observer_gains),
        feedforward=FeedforwardModel.AIRCRAFT,
    ),
    "lqg": Law(
        title="LQG + feedforward",
        law="lqg",
        measurements="y",
        model_data=_wind,
        control_law=_fixed(with_observer(lqg.CONTROL_LAW)),
        params=_over(lqg.params_of, 1.0),
        tuned=_observer_gains,
        feedforward=FeedforwardModel.AIRCRAFT,
    ),
    "eso": Law(
        title="PI + feedforward + extended-state observer",
        law="pi",
        measurements="y",
        model_data="Omega, lags, noise",
        control_law=_fixed(with_observer(pi.CONTROL_LAW)),
        params=_extended_state,
        tuned=("K", "Lambda", "effort", "drift", "rate_drift", "decay"),
        feedforward=FeedforwardModel.INTEGRATORS,
    ),
    "pi": Law(
        title="PI",
        law="pi",
        measurements="y",
        model_data="Omega_ii",
        control_law=_fixed(pi.CONTROL_LAW),
        params=pi.params_of,
        tuned=("K", "Lambda"),
    ),
    "pi_ff": Law(
        title="PI + feedforward",
        law="pi",
        measurements="y",
        model_data=_model,
        control_law=_fixed(pi.CONTROL_LAW),
        params=pi.params_of,
        tuned=("K", "Lambda"),
        feedforward=FeedforwardModel.AIRCRAFT,
    ),
    "l1": Law(
        title="L1",
        law="l1",
        measurements="y",
        model_data="Omega",
        control_law=_l1,
        params=l1.params_of,
        tuned=("K", "bandwidth"),
    ),
    "l1_ff": Law(
        title="L1 + feedforward",
        law="l1",
        measurements="y",
        model_data=_model,
        control_law=_l1_ff,
        params=l1.params_of,
        tuned=("K", "bandwidth"),
        feedforward=FeedforwardModel.AIRCRAFT,
    ),
    "mackunis": Law(
        title="MacKunis RISE, filtered difference",
        law="mackunis",
        measurements="y",
        model_data="Omega",
        control_law=_filtered,
        params=mackunis.mackunis_params,
        tuned=(*_rise_gains, "filter"),
    ),
    "mackunis_ideal": Law(
        title="MacKunis RISE, perfect y_dot",
        law="mackunis",
        measurements="y, y_dot",
        model_data="Omega",
        control_law=_ideal,
        params=mackunis.mackunis_params,
        tuned=_rise_gains,
    ),
    "indi": Law(
        title="INDI",
        law="indi",
        measurements="y, actuators",
        model_data="Omega",
        control_law=indi.control_law,
        params=indi.indi_params,
        tuned=("K", "bandwidth", "share"),
    ),
    "lqi": Law(
        title="LQI",
        law="lqi",
        measurements="full state",
        model_data=_model,
        control_law=_lqi,
        params=lqi.lqi_params,
        tuned=("integral", "effort", "fade"),
    ),
    "lqi_vanes": Law(
        title="LQI",
        law="lqi",
        measurements="full state, vanes",
        model_data=_model,
        control_law=_lqi_vanes,
        params=lqi.lqi_params,
        tuned=("integral", "effort", "fade"),
    ),
}
