# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find the gains of a law with an observer, and the weights of the observer.

Gains and weights follow from a rule, from a rough sketch of the aircraft, or from a search.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from aircraft_sim.atmosphere.turbulence import MODERATE, dryden
from control_laws.nominal_model import NominalModel
from control_laws.observer_design import Weights
from flight_core.arguments import as_numbers
from flight_core.files import read_yaml
from flight_core.parameters import require
from flight_core.vectors import FloatArray

# share of a PI law's integral gain that becomes Lambda; the slope of the softened sign is the rest
SHARE = 0.9


class ObserverGains(NamedTuple):
    """Gains of the law, and weights of the observer, in the law's order.

    The gains are for scaled inputs with abs(Omega_ii) of 1.
    """

    K: FloatArray  # (m,) 1/s
    Lambda: FloatArray  # (m,) 1/s
    beta: FloatArray  # (m,) units of y / s^2
    softening: FloatArray  # (m,) width of the softened sign, as a multiple of the total lag
    weights: Weights


def gains_by_rule(model: NominalModel, axes: tuple[str, ...], speed: float) -> ObserverGains:
    """Derive gains from the lags of the loop, as a start for a search.

    The numbers were found on the `osprey`. Gains and weights follow from the total lag T of each
    channel:

        effort = 0.38 T,  drift = 0.4 (0.035 s) / T,  loose = 0.0036
        K = 0.026 / T,  Lambda = K / 4,  beta = K / T,  softening = 3

    With these, the softened sign has the half-width eps = 3 units of y. The noise of the wind is
    0.12 times the one of Dryden's model, sqrt(2 V0 / L) sigma. The time constant of the wind is 17
    times the one of Dryden's model, L / V0.

    `axes` are the axes of the wind in the order of the model's columns, and `speed` is V0, m/s.
    """
    T = model.total_lag
    spectrum = dryden(**MODERATE, sigma=0.0)
    order = {"longitudinal": 0, "lateral": 1, "vertical": 2}
    places = [order[axis] for axis in axes]
    length = spectrum.length[places]
    sigma = spectrum.sigma[places]
    gust = 0.12 * sigma * np.sqrt(2.0 * speed / length)
    weights = Weights(
        effort=0.38 * T,
        drift=0.4 * 0.035 / T,
        gust=gust,
        wind_time=17.0 * length / speed,
        loose=np.array([0.0036]),
    )
    K = 0.026 / T
    return ObserverGains(
        K=K, Lambda=K / 4.0, beta=K / T, softening=np.full(len(T), 3.0), weights=weights
    )


BESIDE_SKETCH = {"effort": (0.25, 4.0), "K": (16.0, 1.0)}
"""Factors on `gains_by_rule` beside a sketch, for a body rate and for V, found on the c172p and the
737 of JSBSim. With them K is 0.42 / T for q and p, two thirds of what it is without an observer
(CROSSOVER_LAG_PRODUCTS). The law keeps so much because a sketch leaves out more than a model."""


def gains_beside_sketch(
    model: NominalModel, outputs: tuple[str, ...], axes: tuple[str, ...], speed: float
) -> ObserverGains:
    """Derive gains for a model that is only a rough sketch of the aircraft.

    The results of `gains_by_rule` are multiplied by BESIDE_SKETCH.
    """
    by_rule = gains_by_rule(model, axes, speed)
    airspeed = [name == "V" for name in outputs]
    effort, K = (np.where(airspeed, *reversed(BESIDE_SKETCH[key])) for key in ("effort", "K"))
    weights = by_rule.weights._replace(effort=effort * by_rule.weights.effort)
    return by_rule._replace(
        K=K * by_rule.K, Lambda=K * by_rule.Lambda, beta=K * by_rule.beta, weights=weights
    )


def read_gains(path: Path, T: FloatArray, axes: int, states: int) -> ObserverGains:
    """Read gains from a file that has the fields of ObserverGains and Weights by name, each a list.

    T is the total lag, (m,), s. `axes` is the number of axes of the wind, and `states` is the
    number of states of the model. Raises ParameterError if the file cannot be read, if it has other
    names, or if a list has another length or a number that is not above 0.
    """
    m = len(T)
    lengths: dict[str, tuple[int, ...]]
    lengths = dict.fromkeys(("K", "Lambda", "beta", "effort", "drift"), (m,))
    lengths |= {"softening": (1, m), "gust": (axes,), "wind_time": (axes,), "loose": (1, states)}
    content = read_yaml(path, "weights", expected := f"a file of {', '.join(lengths)}")
    has_names = isinstance(content, dict) and set(content) == set(lengths)
    require(has_names, "weights", path, expected)
    gains: dict[str, list[float]] = {}
    for name, allowed in lengths.items():
        row = as_numbers(content[name], f"weights.{name}", "numbers above 0")
        count = " or ".join(str(number) for number in allowed)
        fits = len(row) in allowed and min(row) > 0.0
        require(fits, f"weights.{name}", content[name], f"{count} numbers above 0")
        gains[name] = list(row)
    return gains_of_search(gains, T)


def gains_of_search(gains: Mapping[str, list[float]], T: FloatArray) -> ObserverGains:
    """Convert the gains that `rise-di compare --tune` finds for a law with an observer.

    `gains` has these gains by name. Gains of the law rise_observer stay as they are. Gains K and
    Lambda of the law pi_observer become gains of RISE-DI that act as the same PI law inside the
    width of the softened sign. RISE-DI gets the same K, and SHARE times the same Lambda. The slope
    1 / (softening T) of the softened sign gives the rest of Lambda. T is the total lag, (m,), s.
    """
    values = {name: np.array(row, dtype=np.float64) for name, row in gains.items()}
    weights = Weights(**{name: values[name] for name in Weights._fields})
    K = values["K"]
    Lambda = values["Lambda"]
    if "beta" in values:
        return ObserverGains(
            K=K,
            Lambda=Lambda,
            beta=values["beta"],
            softening=np.broadcast_to(values["softening"], K.shape),
            weights=weights,
        )
    return ObserverGains(
        K=K,
        Lambda=SHARE * Lambda,
        beta=K / T,
        softening=1.0 / ((1.0 - SHARE) * Lambda * T),
        weights=weights,
    )
