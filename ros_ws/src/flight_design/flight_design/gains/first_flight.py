# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write a first scenario for an airframe.

The scenario has the channels, assumed actuators, noise, and gusts in proportion to the trim speed.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from aircraft_sim.airframes.airframe import Airframe
from flight_core.outcome import Refusal
from flight_core.parameters import require
from flight_core.units import ANGLE, ANGULAR_RATE, GRAVITY, SPEED, quantity
from flight_design.gains import gain_yaml
from flight_design.gains.channel_signs import MAX_COUPLING
from flight_design.gains.effectors import Effectors, LawInputs, design_allocation
from flight_design.gains.first_scenario import (
    CONTROL_RATE,
    RATE,
    Channel,
    Sections,
    first_commands,
    scenario_text,
    sensor_noise,
    unit_gains,
)
from flight_design.gains.gain_conditions import bandwidths
from flight_design.gains.gain_selection import (
    CROSSOVER_LAG_PRODUCTS,
    DEFAULT_CROSSOVER_LAG_PRODUCT,
)
from rise_di_controller.extensions.model_sections import AllocationConfig
from rise_di_controller.law.decomposition import search
from rise_di_controller.law.linear_loop import LoopTiming

# s, assumed lags of the servos and the engine of a light aircraft
SURFACE_LAG = 0.05
ENGINE_LAG = 0.3
# rad, rad/s: assumed end stop and rate of a surface, 20 deg and 57 deg/s
STOP = 0.35
SURFACE_RATE = 1.0
# m/s^2, rad/s^2: assumed effect of any other input at its end stop
AUTHORITY = {SPEED: 0.3 * GRAVITY, ANGULAR_RATE: 2.0}
DELAY = 0.003  # s, beyond sampling
APART = 3.0  # time between two gusts, s


def first_flight(
    airframe: Airframe,
    path: str,
    scenario: str,
    controller: str,
    lag: Sequence[float],
    part: float = 1.0,
    shortfall: Refusal | None = None,
) -> str:
    """Write a scenario file for the airframe that is in the file `path`.

    `controller` is the text of the section controller. The commands come from `first_commands`, and
    `part` multiplies the heights of their pulses. `shortfall` says which required margins the loop
    misses, and becomes the first line of the scenario. The gusts blow across the flight path, at 3
    % of the trim speed.
    """
    V0 = airframe.speed
    stops = _stops(airframe)
    # a bank turns an aeroplane
    banks = bool({"beta", "v"} & set(airframe.states))
    channels = _channels(airframe, lag)
    commands = first_commands(channels, V0 or None, RATE, banks=banks, part=part)
    crosswise = [axis for axis in airframe.gusts if axis != "longitudinal"]
    gusts = {
        axis: {
            "start": commands.gust + APART * k,
            "speed": round(0.03 * V0, 2),
            "length": round(0.5 * V0, 1),
        }
        for k, axis in enumerate(crosswise)
    }
    with_gusts = ", gusts" if gusts else ""
    assumed = "put your aircraft's own here, then select the gains again:"
    heading = [
        str(shortfall or ""),
        f"The airframe {airframe.name} at {V0:.6g} m/s: every channel, servos, noise{with_gusts}.",
        f"Lags, end stops, rates and noise are assumed: {assumed}",
        f"rise-di gains select {path} --scenario {scenario} --write gains.yaml",
    ]
    aircraft = {
        "airframe": path,
        "rate": RATE,
        "step": 1.0 / RATE,
        "gusts": gusts,
        "actuators": {
            "lag": list(lag),
            "lower": [-stop for stop in stops],
            "upper": stops,
            "rate": _rates(airframe),
        },
        "sensors": {"noise": [channel.noise for channel in channels.values()], "seed": 1},
    }
    sections: Sections = {
        "flight": {"duration": commands.duration},
        "aircraft": aircraft,
        "reference_model": commands.reference,
        "recorder": {"rate": 100.0},
        "controller": controller,
    }
    return scenario_text(heading, sections)


def _channels(airframe: Airframe, lag: Sequence[float]) -> dict[str, Channel]:
    """Return, by output, the properties of each channel that determine its commands."""
    outputs = list(airframe.outputs)
    if len(airframe.inputs) > len(outputs):
        _, law = _distributed(airframe, lag)
        authority = law.upper
        lags = law.lag
    else:
        inputs = list(pairing(airframe))
        response = np.abs(airframe.matrix_c() @ airframe.matrix_b())[range(len(outputs)), inputs]
        authority = response * np.array(_stops(airframe))[inputs]
        lags = np.array(lag)[inputs]
    products = [CROSSOVER_LAG_PRODUCTS.get(name, DEFAULT_CROSSOVER_LAG_PRODUCT) for name in outputs]
    bandwidth = bandwidths(LoopTiming(lags, DELAY, 1.0 / CONTROL_RATE), np.array(products))
    rows = airframe.matrix_c()
    damping = -np.diag(rows @ airframe.matrix_a() @ np.linalg.pinv(rows))
    return {
        output: Channel(
            motion=output,
            authority=float(authority[i]),
            bandwidth=float(bandwidth[i]),
            noise=sensor_noise(output),
            damping=max(float(damping[i]), 0.0),
        )
        for i, output in enumerate(outputs)
    }


def _surfaces(airframe: Airframe) -> list[bool]:
    return [quantity(channel.unit).dimension == ANGLE for channel in airframe.inputs.values()]


def _stops(airframe: Airframe) -> list[float]:
    """Choose the end stop of every input.

    A surface gets STOP. For any other input, the stop is the deflection at which the input has the
    effect AUTHORITY on the output that it drives.
    """
    Omega = np.abs(airframe.matrix_c() @ airframe.matrix_b())
    authorities = np.array(
        [
            AUTHORITY.get(quantity(unit).dimension, 1.0)
            for unit in airframe.units_of_outputs().values()
        ]
    )
    outputs = np.argmax(Omega / authorities[:, None], axis=0).tolist()
    if len(airframe.inputs) == len(airframe.outputs):
        for i, j in enumerate(pairing(airframe)):
            outputs[j] = i
    return [
        STOP if surface else float(f"{authorities[i] / max(Omega[i, j], 1e-9):.3g}")
        for j, (surface, i) in enumerate(zip(_surfaces(airframe), outputs, strict=True))
    ]


def _rates(airframe: Airframe) -> list[float]:
    return [
        SURFACE_RATE if surface else stop
        for surface, stop in zip(_surfaces(airframe), _stops(airframe), strict=True)
    ]


def _distributed(airframe: Airframe, lag: Sequence[float]) -> tuple[AllocationConfig, LawInputs]:
    """Design the allocation of an airframe with more inputs than outputs."""
    stops = np.array(_stops(airframe))
    return design_allocation(
        airframe, Effectors(-stops, stops, np.array(_rates(airframe)), np.array(lag))
    )


def default_lags(airframe: Airframe) -> tuple[float, ...]:
    """Choose the lag of each input, s: a servo's lag for an angle, else an engine's lag."""
    return tuple(SURFACE_LAG if surface else ENGINE_LAG for surface in _surfaces(airframe))


def placeholder(airframe: Airframe, lag: Sequence[float]) -> str:
    """Write a section controller with all gains at 1, as a start for the selection of gains."""
    allocation = None
    m = len(airframe.outputs)
    if len(airframe.inputs) > m:
        config, law = _distributed(airframe, lag)
        allocation = config.model_dump(exclude_none=True)
        inputs = list(law.names)
        lags = law.lag.tolist()
    else:
        paired = pairing(airframe)
        inputs = [list(airframe.inputs)[j] for j in paired]
        lags = [lag[j] for j in paired]
    require(
        m > 1,
        "inputs",
        inputs[0],
        "two inputs or more: add a thrust with --thrust, or a second control",
    )
    values: Mapping[str, Any] = {
        "rate": CONTROL_RATE,
        "outputs": list(airframe.outputs),
        "inputs": inputs,
        **unit_gains(lags, DELAY),
        "max_age": 0.1,
        "hold": 0.5,
        "ramp": 2.0,
        **({} if allocation is None else {"allocation": allocation}),
    }
    lines = [f"    {key}: {gain_yaml.yaml_flow(value, 10)}" for key, value in values.items()]
    return "\n".join(["/**/controller:", "  ros__parameters:", *lines, ""])


def pairing(airframe: Airframe) -> tuple[int, ...]:
    """Return the index of the input that is paired with each output.

    The pairs follow from the smallest change of pairs and signs that makes D = I with a coupling of
    at most MAX_COUPLING. If there is no such change, the inputs stay in their order.
    """
    best = search(airframe.matrix_c() @ airframe.matrix_b(), MAX_COUPLING)
    if best is None:
        return tuple(range(len(airframe.outputs)))
    return tuple(j for _, j in sorted(zip(best.outputs, best.inputs, strict=True)))
