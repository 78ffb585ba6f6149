# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Draw the actuator lags, the sensor noise and the delay of u of a campaign's aircraft.

They are drawn like the entries of A and B. The entry lag[INPUT] is a time constant in s, and
noise[OUTPUT] is a standard deviation in SI. The entries lag and noise without a channel mean all
channels. The entry delay, in s, is the largest delay of u beyond the delay of the scenario. The
delay is drawn in whole periods of the controller.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from aircraft_sim import random_streams
from aircraft_sim.uncertainty import Spread, deviations
from flight_analysis.closed_loop.scenario import Scenario
from flight_core.parameters import require
from flight_core.vectors import FloatArray

DELAY = "delay"
KINDS = ("lag", "noise", DELAY)


def is_of_equipment(entry: str) -> bool:
    """Return whether an entry is a lag, a noise or the delay, and not an entry of A or B."""
    return entry.partition("[")[0] in KINDS


def is_of_loop(entry: str) -> bool:
    """Return whether an entry is a lag or the delay, which belong to the linear loop."""
    return is_of_equipment(entry) and not entry.startswith("noise")


def matrix_entries(entries: Mapping[str, float]) -> dict[str, float]:
    """Return only the entries of A and B."""
    return {name: part for name, part in entries.items() if not is_of_equipment(name)}


def published(scenario: Scenario) -> dict[str, float]:
    """Return the lags and the noise of a scenario that are above 0, by name, SI."""
    aircraft = scenario.aircraft
    channels = scenario.aircraft.channels()
    entries = (
        ("lag", channels.inputs, aircraft.actuators.lag),
        ("noise", channels.outputs, aircraft.sensors.noise),
    )
    above: dict[str, float] = {}
    for kind, names, values in entries:
        above |= {
            f"{kind}[{name}]": value
            for name, value in zip(names, values, strict=False)
            if value > 0.0
        }
    return above


def expanded(entries: Mapping[str, float], scenario: Scenario) -> dict[str, float]:
    """Replace the entries lag and noise by an entry for each channel.

    An entry for a single channel takes precedence. The delay is rounded down to whole
    periods. Raises ParameterError if an entry is unknown or the delay is below a period.
    """
    entries_of_scenario = published(scenario)
    every = dict[str, float]()
    for name, part in entries.items():
        if name == DELAY:
            rate = scenario.controller.rate
            expected = f"at least a period of the controller, {1.0 / rate:g} s"
            require(part >= 1.0 / rate, "entry", f"delay {part:g} s", expected)
            every[name] = math.floor(part * rate + 1e-9) / rate if math.isfinite(part) else part
            continue
        if name.startswith(("A[", "B[")):
            every[name] = part
            continue
        matches = [
            entry for entry in entries_of_scenario if name in (entry, entry.partition("[")[0])
        ]
        expected = (
            f"a lag or a noise above 0: {', '.join(entries_of_scenario) or 'none'}; delay, or an "
            "entry of A or B, as A[q,q]"
        )
        require(bool(matches), "entry", name, expected)
        every |= {entry: entries.get(entry, part) for entry in matches}
    return every


def drawn(
    scenario: Scenario, spread: Spread, seed: int, first: int, count: int
) -> dict[str, FloatArray]:
    """Draw lags, noise and delays of `count` aircraft, by entry, (count,) each.

    The aircraft have the numbers first, first + 1, ... under `seed`. A lag and a noise are
    multiplied by 1 + d, in the same way as an entry of A. A delay is (1 + d) / 2 times the largest
    delay, in whole periods. A value depends only on the seed and on the number of the aircraft. The
    entries of `spread` must come from `expanded`.
    """
    published_values = published(scenario)
    rate = scenario.controller.rate
    uniform = random_streams.uniform(
        first, count, len(published_values) + 1, random_streams.EQUIPMENT, seed
    )
    d = deviations(uniform, spread.distribution)
    values = {
        name: value * (1.0 + spread.entries[name] * d[:, k])
        for k, (name, value) in enumerate(published_values.items())
        if name in spread.entries
    }
    if DELAY in spread.entries:
        most = round(spread.entries[DELAY] * rate)
        values[DELAY] = np.minimum(np.floor((1.0 + d[:, -1]) / 2.0 * (most + 1)), most) / rate
    return values


def references(scenario: Scenario, entries: Mapping[str, float]) -> dict[str, float]:
    """Return, for each entry, the value by which its drawn deviation is multiplied.

    These are the `published` values. For the delay it is half of the largest delay, so that the
    delay is drawn within +-100 %.
    """
    return published(scenario) | ({DELAY: entries[DELAY] / 2.0} if DELAY in entries else {})


def in_order(
    values: Mapping[str, Any], kind: str, names: tuple[str, ...], otherwise: tuple[float, ...]
) -> list[Any]:
    """Return the value of each of the channels `names`, in their order.

    `kind` is "lag" or "noise". A channel without an entry in `values` has its value from
    `otherwise`.
    """
    return [
        values.get(f"{kind}[{name}]", value) for name, value in zip(names, otherwise, strict=True)
    ]


def scenario_with_equipment(scenario: Scenario, values: Mapping[str, float]) -> Scenario:
    """Return the scenario with other lags, other noise and an additional delay of u.

    `values` has these by the names of `drawn`.
    """
    aircraft = scenario.aircraft
    channels = scenario.aircraft.channels()
    changes = {}
    delay = aircraft.actuators.delay + values.get(DELAY, 0.0)
    if any(name.startswith("lag[") or name == DELAY for name in values):
        if aircraft.actuators.lag:
            lag = in_order(values, "lag", tuple(channels.inputs), aircraft.actuators.lag)
        else:
            lag = []
        changes["actuators"] = aircraft.actuators.model_dump() | {"lag": lag, "delay": delay}
    if any(name.startswith("noise[") for name in values):
        noise = in_order(values, "noise", tuple(channels.outputs), aircraft.sensors.noise)
        changes["sensors"] = aircraft.sensors.model_dump() | {"noise": noise}
    return scenario.vary(aircraft=changes)
