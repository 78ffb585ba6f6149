# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The closed loop in one process, without ROS: the functions that the nodes call, in the order in which the topics flow."""

from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from aircraft_sim import plant, truth
from aircraft_sim.sensors import Underway, transmit
from flight_analysis.scenario import Scenario
from flight_core.outcome import COMPLETED, INTERRUPTED
from flight_core.rates import nanoseconds, period_ns, seconds
from flight_core.tape import Signal, Tape
from flight_core.vectors import Array, ChannelError, FloatArray, select
from reference_model import model
from reference_model.command import command
from reference_model.params import zero_state
from rise_di_controller import guard, internals
from rise_di_controller.guard import Sample


class _Track:
    """Grows one signal of a tape."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names = tuple(names)
        self.stamps: list[int] = []
        self.rows: list[FloatArray] = []

    def add(self, stamp_ns: int, row: FloatArray) -> None:
        self.stamps.append(stamp_ns)  # before the row: an interrupt between the two leaves a stamp too many
        self.rows.append(row)

    def signal(self) -> Signal:
        values = np.array(self.rows) if self.rows else np.zeros((0, len(self.names)))
        return Signal(np.array(self.stamps[: len(values)], dtype=np.int64), self.names, values)


def simulate(scenario: Scenario, progress: Callable[[float], None] | None = None) -> Tape:
    """Fly a scenario and return its tape; `progress` is told the flight time once a simulated second.

    At each instant: the aircraft's y that arrives, the reference's y_m, then the controller's u, which the aircraft holds until
    the next. A sample that was lost is not on the tape; one that came late is, at the instant it belongs to. A flight that
    diverges or is interrupted (Ctrl-C) ends there: the tape holds what was flown, its `outcome` says why.
    """
    (airframe, _), hardware = scenario.aircraft.load(), scenario.aircraft.plant()
    reference, profile = scenario.reference_model.model(), scenario.reference_model.profile()
    law, limits = scenario.controller.law(), scenario.controller.guard()
    outputs, inputs = scenario.controller.outputs, scenario.controller.inputs
    aircraft_ns = period_ns(scenario.aircraft.rate, "aircraft.rate")
    reference_ns = period_ns(scenario.reference_model.rate, "reference_model.rate")

    def commanded(t: Array) -> Array:
        return command(t, profile)

    tracks = {
        "y": _Track(airframe.outputs),
        "y_m": _Track(scenario.reference_model.outputs),
        "u": _Track(inputs),
        "internals": _Track(internals.names(outputs, inputs)),
        "truth": _Track(truth.names(airframe, scenario.aircraft)),
    }
    aircraft, x_m = plant.start(hardware), zero_state(reference)
    state = guard.start(len(inputs))
    y: Sample | None = None
    underway: Underway = ()
    y_m_samples: deque[Sample] = deque(maxlen=guard.KEPT_REFERENCES)
    u = select(list(airframe.inputs), inputs, state.u)
    base_ns = int(np.gcd(aircraft_ns, reference_ns))
    end_ns = nanoseconds(scenario.flight.duration)
    outcome = COMPLETED
    try:
        for t_ns in range(0, end_ns + 1, base_ns):
            if t_ns % aircraft_ns == 0:
                aircraft = plant.advance(t_ns - aircraft_ns, aircraft, u, aircraft_ns, hardware) if t_ns else aircraft
                if plant.diverged(aircraft):
                    outcome = f"diverged at t = {seconds(t_ns):.2f} s"
                    break
                measured = plant.measure(t_ns // aircraft_ns, aircraft, hardware)
                underway, arrived = transmit(underway, t_ns, measured.y, hardware.sensors)
                for sample in arrived:
                    tracks["y"].add(sample.stamp_ns, sample.y)
                    y = Sample(sample.stamp_ns, select(outputs, airframe.outputs, sample.y))
                tracks["truth"].add(t_ns, truth.values(t_ns, aircraft, measured.noise, hardware.aircraft))
            if t_ns % reference_ns == 0:
                before = seconds(t_ns - reference_ns)
                x_m = model.step(before, x_m, commanded, seconds(reference_ns), reference) if t_ns else x_m
                y_m = model.output(x_m, reference)
                tracks["y_m"].add(t_ns, y_m)
                y_m_samples.append(Sample(t_ns, select(outputs, scenario.reference_model.outputs, y_m)))
            if t_ns % limits.period_ns == 0:
                state, used = guard.tick(state, t_ns, y, list(y_m_samples), limits, law)
                if used is not None:
                    u = select(list(airframe.inputs), inputs, state.u)
                    tracks["u"].add(used.stamp_ns, state.u)
                    age = seconds(t_ns - used.stamp_ns)
                    tracks["internals"].add(used.stamp_ns, internals.values(state, used, limits.limits, late=0.0, age=age))
            if progress is not None and t_ns % 1_000_000_000 == 0:
                progress(seconds(t_ns))
    except KeyboardInterrupt:
        outcome = INTERRUPTED
    except ChannelError as error:  # commands or noise beyond any number
        outcome = f"ended at t = {seconds(t_ns):.2f} s: {error}"
    return Tape({name: track.signal() for name, track in tracks.items()}, outcome=outcome)
