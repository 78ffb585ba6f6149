# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The error that a controller will have around a learned model, before the model flies."""

import numpy as np

from aircraft_sim.airframe import Airframe
from flight_analysis.closed_loop.loop_margins import linear_loop
from flight_core.vectors import FloatArray
from flight_design.gains.nominal import sizes
from rise_di_controller.linear_loop import closed_loop, delay_margin, zero_order_hold
from rise_di_controller.rise_di_config import RiseDiConfig

# m/s and m from the entry to the peak, of a 1-cosine gust: those of W. MacKunis et al., IEEE TCST
# 18(5), 2010, in which the gains of the observers are searched
GUSTS = {"vertical": (10.12, 15.24), "lateral": (4.0, 15.24)}
LASTING = 20.0  # s, over which the error counts: the slow modes of a loop have settled


def tolerates(controller: RiseDiConfig, aircraft: Airframe, late: float) -> bool:
    """Whether the linear loop of a controller around an aircraft is stable up to u `late`, s."""
    linear = linear_loop(controller, aircraft, aircraft.matrix_a()[None], aircraft.matrix_b()[None])
    loop = linear.loop._replace(delay=0.0)
    return delay_margin(linear.nominal, linear.law, loop, above=late, longest=2.0 * late) > 0.0


def predicted_error(controller: RiseDiConfig, aircraft: Airframe, late: float) -> FloatArray:
    """Rms of e of the linear loop, (m,), in sizes, over LASTING after each gust of GUSTS and after
    a step of each command by its size, u `late`, s; the squares of all of these add up.

        y(0) = Omega (Omega_c^-1 - Omega^-1) size   after a step of a command

    with Omega = C B of the aircraft, and Omega_c that of the feedforward of the controller: a
    feedforward by the right model moves y with y_m. Not finite for an unstable loop.
    """
    A = aircraft.matrix_a()
    linear = linear_loop(controller, aircraft, A[None], aircraft.matrix_b()[None])
    plant = linear.nominal
    loop = linear.loop._replace(delay=0.0)
    motion = closed_loop(plant, linear.law, loop, np.full(len(loop.lag), late))
    n = len(A)
    model = controller.feedforward
    assert model is not None  # noqa: S101 - a design has one
    rows = [model.states.index(name) for name in controller.outputs]
    Omega_c = np.reshape(model.B, (len(model.states), -1))[rows]
    Omega = plant.C @ plant.B
    units = aircraft.units_of_outputs()
    size = sizes(units[name] for name in controller.outputs)
    steps = plant.B @ (np.linalg.inv(Omega_c) - np.linalg.inv(Omega)) * size
    axes = [axis for axis in aircraft.gusts if axis in GUSTS]
    wind = aircraft.matrix_gusts()[:, [list(aircraft.gusts).index(axis) for axis in axes]]
    _, drive = zero_order_hold(plant.A, wind, loop.period)
    speed, length = np.array([GUSTS[axis] for axis in axes]).reshape(-1, 2).T
    state = np.zeros((len(motion), len(axes) + len(size)))
    state[:n, len(axes) :] = steps
    square = np.zeros(len(size))
    count = round(LASTING / loop.period)
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(count):
            square += np.sum((plant.C @ state[:n]) ** 2, axis=1)
            state = motion @ state
            place = aircraft.speed * k * loop.period / length
            blowing = speed / 2.0 * (1.0 - np.cos(np.pi * place)) * (place < 2.0)
            state[:n, : len(axes)] += drive * blowing
    return np.asarray(np.sqrt(square / count) / size)
