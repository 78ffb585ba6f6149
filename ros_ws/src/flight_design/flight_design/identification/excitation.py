# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check whether a log shows the effects of the inputs, and say which doublets would show them."""

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from aircraft_sim.airframes.airframe import Airframe
from flight_analysis.closed_loop.scenario import Scenario
from flight_core.vectors import FloatArray
from flight_design.gains.ideal_control import ChannelPairing
from flight_design.identification.innovation_filters import FlightData, measured_noise
from flight_design.identification.model_identification import Part
from flight_design.identification.model_refusals import (
    MAX_DEVIATION,
    best_known,
    entries_without,
    excitation_factor,
)
from flight_design.identification.rates_model import without_trim

# Least share of an output's variance that its paired input must explain. With doublets of yaw the
# share is 0.2, and without them it is 0.01 or less.
LEAST_SHARE = 0.05
# Least peak of an output, as a multiple of the noise of a sample. Without doublets the input
# answers the noise alone, and its effect came out 20 % too weak. The peak is 1.7 then, and 6 or
# more with doublets.
LEAST_PEAK = 3.0
PEAK = 0.1  # s, time over which the peak is a mean
CLEAR_SHARE = 0.2  # an output with a smaller share is flown again if another output has to be
WINDY = 1.0  # gusts above this, in units of moderate turbulence, hide the effects of the inputs
# 1/s, shift of the poles to the left, so that the integrals of a neutral aircraft fade
FORGETTING = 0.5
FEWEST = 3  # least number of doublets on an axis
LENGTH = 0.5  # s, length of half a doublet, if the scenario has no pulses
SIZE = 0.3  # rad/s, size of a doublet, if the scenario has no pulses
APART = 2.0  # s, time between doublets
YAW_RATES = "FW_ACRO_YAW_EN"  # parameter of PX4, see `to_set`


class OwnShare(NamedTuple):
    """The fraction of an output's variance that its paired input explains."""

    output: str
    input: str
    share: float
    peak: float  # largest mean of the output over PEAK, as a multiple of the noise of a sample

    @property
    def is_still(self) -> bool:
        """Whether the input moves the output too little to identify its effect from the log.

        This is so if the input explains too small a fraction of the output's variance, or if the
        output moves too little compared with the noise.
        """
        return not (self.share >= LEAST_SHARE and self.peak >= LEAST_PEAK)  # NaN shows nothing

    @property
    def sentence(self) -> str:
        """Sentence that compares the motion in the log with the motion that is needed."""
        if self.share >= LEAST_SHARE:
            return (
                f"{self.output}: found a peak of {self.peak:.2g} times the noise of the gyro, "
                f"expected {LEAST_PEAK:g} times"
            )
        return (
            f"{self.output}: found that {self.input} explains {100 * self.share:.2g} % of its "
            f"motion, expected {100 * LEAST_SHARE:g} %"
        )


def shares(recorded: FlightData, airframe: Airframe) -> FloatArray:
    """Return the fraction of each output's variance that each input explains, (outputs, inputs).

        share_ij = var (C_i x_j) / var y_i,  x_j_dot = (A - FORGETTING) x_j + B_j u_j

    A rough airframe suffices. A fraction exceeds 1 if two inputs work against each other.
    """
    A = airframe.matrix_a() - FORGETTING * np.eye(len(airframe.states))
    B = airframe.matrix_b()
    C = airframe.matrix_c()
    n, m = B.shape
    step = recorded.period * np.block([[A, B], [np.zeros((m, n + m))]])
    both = expm(step)
    x = np.zeros((n, m))
    responses = np.empty((len(recorded.u), len(C), m))
    for k, u in enumerate(recorded.u):
        responses[k] = C @ x
        x = both[:n, :n] @ x + both[:n, n:] * u
    return np.asarray(responses.var(axis=0) / np.nanvar(recorded.y, axis=0)[:, None])


def own_shares(
    recorded: FlightData, airframe: Airframe, channels: ChannelPairing
) -> list[OwnShare]:
    """Return the fraction of each output's variance that its paired input explains.

    The outputs are in the law's order.
    """
    share = shares(recorded, airframe)
    peak = peaks(recorded)
    inputs = list(airframe.inputs)
    rows = [airframe.outputs.index(output) for output in channels.outputs]
    return [
        OwnShare(
            output=airframe.outputs[row],
            input=name,
            share=float(share[row, inputs.index(name)]),
            peak=float(peak[row]),
        )
        for row, name in zip(rows, channels.inputs, strict=True)
    ]


def peaks(recorded: FlightData) -> FloatArray:
    """Return how far each output moves from trim, (m,), as a multiple of its noise.

    The motion is the largest magnitude of the means over intervals of PEAK. The noise is the rms
    noise of a single sample.
    """
    y = without_trim(recorded).y
    length = max(1, round(PEAK / recorded.period))
    means = y[: len(y) // length * length].reshape(-1, length, y.shape[1]).mean(axis=1)
    return np.asarray(np.nanmax(np.abs(means), axis=0) / measured_noise(y, np.ones(y.shape[1])))


def to_set(outputs: Iterable[str], parameters: Mapping[str, float]) -> str:
    """Say which parameter of PX4 must be set so that its controller flies the doublets.

    Without this parameter, PX4 does not control the yaw rate to its setpoint. `parameters` has the
    parameters in the log. Returns "" if no parameter need be set. Source: PX4 1.16,
    fw_rate_control.
    """
    if "r" not in outputs or parameters.get(YAW_RATES) != 0.0:
        return ""
    return f"; set {YAW_RATES} to 1, without which PX4 does not control r"


def to_fly(
    outputs: Mapping[str, float], scenario: Scenario, airframe: Airframe, y: FloatArray
) -> str:
    """Say which doublets must be flown to show the effects on some outputs.

    `outputs` has, for each of these outputs, the factor by which its motion in the log is too
    small. A doublet has the size and length of the scenario's pulses, and at least the size of the
    motion in the log, y, (T, m). The number of doublets follows from the factor. Returns "" if
    there are no outputs.
    """
    pulses = scenario.reference_model.pulses
    texts = []
    for output, factor in outputs.items():
        column = y[:, airframe.outputs.index(output)]
        moved = float(np.nanpercentile(np.abs(column), 99.0))
        pulse = pulses.get(output)
        size = max(moved, SIZE) if pulse is None else max(moved, *np.abs(pulse.value))
        length = LENGTH if pulse is None else pulse.stop[0] - pulse.start[0]
        number = max(FEWEST, math.ceil(FEWEST * (factor * moved / size) ** 2))
        texts.append(f"{output}: {number} doublets of {size:.2g} rad/s, {length:.2g} s each way")
    return f"; fly, {APART:g} s apart, {', then '.join(texts)}" if texts else ""


def gust_warning(part: Part) -> str | None:
    """Warn that a part of the aircraft was flown in gusts, or return None if the air was calm.

    A part is a group of states and inputs that does not couple with the rest. The standard
    deviations of its entries do not include the error that gusts cause. In gusts of 0.5 m/s, the
    identified effects of a light airplane's inputs were 20 % too weak.
    """
    if part.wind < WINDY:
        return None
    return (
        f"{', '.join(part.outputs)}: the air moved as in turbulence of {part.wind:g} times "
        "moderate: gusts hide what the inputs do, and their effects may come out a fifth too weak; "
        "fly the doublets in calm air"
    )


def factors_of(parts: Iterable[Part]) -> dict[str, float]:
    """Return the outputs that need more motion, each with the factor by which it must grow.

    An output needs more motion if the standard deviation of every effect on it is above
    MAX_DEVIATION. There are two exceptions. If the effects are uncertain because of a delay, more
    motion would not help. If two models differ (`rates_model.doubted`), the factor is unknown.
    """
    factors = {}
    for part in parts:
        entries = entries_without(part.entries, part.by_timing)
        if part.by_motion:
            entries = entries_without(entries, part.by_motion)
        for effect in best_known(entries, part.outputs):
            if effect.deviation > MAX_DEVIATION:
                factors[effect.row] = excitation_factor(effect)
    return factors
