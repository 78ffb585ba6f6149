# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the errors that an identification states, on aircraft whose A and B are known.

The logs are of an aircraft that is integrated in steps of 0.5 ms, independently of the code under
test. It differs from the model in what the identification leaves out: a later input, noise that is
not white, wind, and samples of u that are rare or lost.
"""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.linalg import expm
from scipy.signal import lfilter
from tests.conftest import REPOSITORY

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.vectors import FloatArray
from flight_design.gains.ideal_control import ChannelPairing
from flight_design.identification.excitation import (
    gust_warning,
    own_shares,
    to_fly,
    to_set,
)
from flight_design.identification.innovation_filters import Actuation, FlightData, coarser
from flight_design.identification.likelihood import Unknown
from flight_design.identification.model_identification import Identification, identify_model
from flight_design.identification.model_quality import NoBetter
from flight_design.identification.rates_model import banking, identify_rates

PERIOD = 0.004  # s
STEPS = 8  # of the aircraft in a period
TRUE = {"A[q, alpha]": 0.2, "A[q, q]": 0.2, "B[q, elevator]": -0.15}  # changes of the entries
OFF = 2.5  # stated deviations that an entry may be off
TIMING = PERIOD / np.sqrt(12.0)  # s
CHANNELS = ChannelPairing(("q",), ("elevator",))
AIRFRAME = """
name: pitch
source: the pitch of examples/px4_airplane/rates_airframe.yaml
speed: 11.5
states: {alpha: rad, q: rad/s}
inputs:
  elevator: {unit: rad, positive: nose up}
outputs: [q]
A:
  - [-22.4, 0.82]
  - [-513.0, -19.2]
B:
  - [5.6]
  - [534.0]
gusts:
  vertical: {alpha: 22.4, q: 513.0}
"""


NOMINAL = Airframe.validate_mapping(yaml.safe_load(AIRFRAME), "airframe")


@cache
def flown(
    *,
    late: float = 0.0,
    colour: float = 0.0,
    wind: float = 0.0,
    setpoint: float = 0.3,
    length: float = 60.0,
    climb: float = 0.0,
    feedforward: float = 0.33,
) -> tuple[FloatArray, FloatArray]:
    """Return y and u, (T,), of doublets under PI with feedforward.

    For the first 20 s the elevator is `climb`, rad, off its trim. If `climb` is not 0, no doublets
    are flown in this time. u acts `late`, s. The noise of y follows e_k = `colour` e_(k-1) + white
    noise. The wind, m/s rms, has a correlation time of 0.3 s.
    """
    A, B = NOMINAL.matrix_a(), NOMINAL.matrix_b()
    A[1] *= 1.0 + np.array([TRUE["A[q, alpha]"], TRUE["A[q, q]"]])
    B[1] *= 1.0 + TRUE["B[q, elevator]"]
    by_wind = -A[:, 0] / NOMINAL.speed
    h = PERIOD / STEPS
    both = expm(np.block([[A, B], [np.zeros((1, 3))]]) * h)
    count = int(length / PERIOD)
    y, u = np.zeros(count), np.zeros(count)
    white, *gusts = np.random.default_rng(5).normal(size=(count, 1 + STEPS)).T
    decay = 1.0 - h / 0.3
    air = lfilter([wind * np.sqrt(2.0 * h / 0.3)], [1.0, -decay], np.array(gusts).T.ravel())
    air = air.reshape(count, STEPS)
    powers = np.array([np.linalg.matrix_power(both[:2, :2], STEPS - 1 - j) for j in range(STEPS)])
    over_period = np.linalg.matrix_power(both[:2, :2], STEPS)
    by_air = h * powers @ by_wind  # (STEPS, 2)
    by_input = powers @ both[:2, 2]
    delayed = round(late / h)  # steps, fewer than a period
    x = np.zeros(2)
    integral = noise = before = 0.0
    for k in range(count):
        noise = colour * noise + np.sqrt(1.0 - colour**2) * white[k]
        phase = k * PERIOD % 3.0
        wanted = setpoint * ((phase < 0.5) - float(0.5 <= phase < 1.0))
        trim = 0.0
        if climb and k * PERIOD < 21.0:
            trim = climb * min(1.0, 21.0 - k * PERIOD)
            wanted = 0.0
        y[k] = x[1] + 0.05 * noise
        integral = np.clip(integral + 3.0 * (wanted - y[k]) * PERIOD, -0.4, 0.4)
        u[k] = 0.26 * np.clip(feedforward * wanted + 0.086 * (wanted - y[k]) + integral, -1.0, 1.0)
        acts = np.full(STEPS, u[k] - trim)
        acts[:delayed] = before
        before = u[k] - trim
        x = over_period @ x + acts @ by_input + air[k] @ by_air
    return y, u


def recording(y: FloatArray, u: FloatArray) -> FlightData:
    """Return the record of y and u, (T,) or (T, m)."""
    t = np.arange(len(y), dtype=np.float64) * PERIOD
    return FlightData(PERIOD, t, y.reshape(len(t), -1), u.reshape(len(t), -1))


def identified(y: FloatArray, u: FloatArray, timing: float | None = TIMING) -> Identification:
    return identify_model(
        coarser(recording(y, u), 2),
        NOMINAL,
        Actuation(np.zeros(1), 0.0),
        unknown=Unknown(has_hidden_rows=False),
        searches_again=True,
        timing=timing,
    )


def by_rates(nominal: Airframe, y: FloatArray, u: FloatArray) -> Identification:
    """Identify as `rise-di tune` does."""
    return identify_rates(
        coarser(recording(y, u), 2),
        nominal,
        Actuation(np.zeros(len(nominal.inputs)), 0.0),
        ChannelPairing(nominal.outputs, tuple(nominal.inputs)),
        timing=TIMING,
    )


def flown_in_turns(nominal: Airframe) -> tuple[FloatArray, FloatArray]:
    """Return y and u, (T, 3), of the nominal airplane in doublets of each rate.

    It banks, and its autopilot, PI with feedforward, commands the r of a coordinated turn.
    """
    rng = np.random.default_rng(5)
    plane = banking(nominal)
    A, B, C = plane.matrix_a(), plane.matrix_b(), plane.matrix_c()
    n, m = B.shape
    both = expm(np.block([[A, B], [np.zeros((m, n + m))]]) * PERIOD)
    FF, P, gain = np.array([[0.331, 0.206, 0.259], [0.086, 0.05, 0.4155], [1.19, 2.95, 10.0]])
    count = round(60.0 / PERIOD)
    y, u = np.zeros((count, m)), np.zeros((count, m))
    x, integral = np.zeros(n), np.zeros(m)
    for k in range(count):
        number, phase = divmod(k * PERIOD, 3.0)
        wanted = np.zeros(m)
        doublet = float(phase < 0.5) - float(0.5 <= phase < 1.0)
        wanted[int(number) % 3] = (0.3, 0.6, 0.2)[int(number) % 3] * doublet
        wanted[2] += 9.81 / plane.speed * x[plane.index("phi")]
        y[k] = C @ x + np.array([0.05, 0.1, 0.02]) * rng.normal(size=m)
        integral = np.clip(integral + gain * (wanted - y[k]) * PERIOD, -0.4, 0.4)
        u[k] = 0.26 * np.clip(FF * wanted + P * (wanted - y[k]) + integral, -1.0, 1.0)
        x = both[:n, :n] @ x + both[:n, n:] @ u[k]
    return y, u


def farthest(found: Identification) -> float:
    """Return the largest error of an entry in units of its stated deviation."""
    return max(abs(entry.error - TRUE[entry.name]) / entry.deviation for entry in found.entries)


@pytest.mark.slow
def test_log_of_gusts_has_a_warning() -> None:
    """The effect of the gusts on the estimate is larger than the deviations."""
    (part,) = identified(*flown(wind=1.0)).parts
    warning = gust_warning(part)
    assert warning is not None
    assert "fly the doublets in calm air" in warning


@pytest.mark.slow
@pytest.mark.parametrize(
    "lacks",
    [
        {},
        # u acts anywhere within a period of the log: half of it is the farthest from the mean
        {"late": 0.002},
        {"late": 0.002, "colour": 0.5, "wind": 0.3},
    ],
    ids=["right model", "late u", "late u, coloured noise, wind"],
)
def test_no_entry_is_farther_off_than_stated(lacks: dict[str, float]) -> None:
    found = identified(*flown(**lacks))
    refusal = found.refusal
    assert lacks or gust_warning(found.parts[0]) is None
    assert farthest(found) < OFF or (refusal is not None and not isinstance(refusal, NoBetter))


@pytest.mark.slow
def test_deviations_of_a_right_model_alone_are_too_small_for_a_late_input() -> None:
    """This is why the other deviations are needed.

    Without them, an entry would be 5 stated deviations off.
    """
    y, u = flown(late=0.002)
    assert farthest(identified(y, u, timing=None)) > OFF


@pytest.mark.slow
def test_trim_of_a_climb_is_no_effect_of_the_input() -> None:
    """An estimator that believes the trim is 56 stated deviations off.

    The autopilot has no feedforward, so its doublets are slow.
    """
    y, u = flown(climb=0.04, feedforward=0.0)
    assert farthest(identified(y, u)) > 30.0
    found = by_rates(NOMINAL, y, u)
    assert not found.refusal
    assert farthest(found) < OFF


@pytest.mark.slow
def test_gravity_in_a_bank_is_no_effect_of_the_rudder() -> None:
    """The aircraft turns in a bank, and its autopilot lets the rudder follow the turn.

    An estimator that does not know the bank takes the turn for an effect of the rudder.
    """
    nominal = load_airframe(str(REPOSITORY / "examples/px4_airplane/rates_airframe.yaml"))
    y, u = flown_in_turns(nominal)
    found = by_rates(nominal, y, u)
    assert not found.refusal
    off = [entry for entry in found.entries if abs(entry.error) > OFF * entry.deviation]
    assert not off


@pytest.mark.slow
def test_log_with_rare_samples_of_u_is_refused_for_its_timing() -> None:
    """By default PX4 logs the torque every 20 ms, while the loop changes it every 4 ms."""
    y, u = flown()
    held = np.repeat(u[::5], 5)[: len(u)]
    found = identified(y, held, timing=0.02 / np.sqrt(12.0))
    assert "timing of u: found B[q, elevator] known to" in str(found.refusal)


@pytest.mark.slow
def test_lost_samples_do_not_move_an_entry_farther_than_stated() -> None:
    """A tenth of the samples is lost, and 8 s at once."""
    y, u = flown()
    lost = np.random.default_rng(1).random(len(y)) < 0.1
    lost[5000:7000] = True
    assert farthest(identified(np.where(lost, np.nan, y), u)) < OFF


@pytest.mark.parametrize(
    "factor, reason",
    [
        (1, "elevator explains 3.4 % of its motion, expected 5 %"),
        (2, "times the noise of the gyro, expected 3 times"),
    ],
)
def test_output_that_only_its_noise_moves_is_named(factor: int, reason: str) -> None:
    """The elevator responds to the noise of the gyro, and no doublets are flown."""
    y, u = flown(setpoint=0.0, length=20.0)
    (still,) = own_shares(coarser(recording(y, u), factor), NOMINAL, CHANNELS)
    assert still.is_still
    assert reason in still.sentence


def test_output_that_its_own_input_does_not_move_is_named() -> None:
    """The wind moves q, and the elevator stands still."""
    y, u = flown(setpoint=0.0, wind=0.5, length=20.0)
    (still,) = own_shares(recording(y, 0.0 * u), NOMINAL, CHANNELS)
    assert (still.output, still.input, still.share) == ("q", "elevator", 0.0)
    assert still.is_still
    assert still.sentence == "q: found that elevator explains 0 % of its motion, expected 5 %"


def test_output_that_doublets_move_is_not_named() -> None:
    y, u = flown(length=20.0)
    (moved,) = own_shares(recording(y, u), NOMINAL, CHANNELS)
    assert not moved.is_still


@pytest.mark.parametrize(
    ("outputs", "parameters", "is_named"),
    [
        (["p", "r"], {"FW_ACRO_YAW_EN": 0.0}, True),
        (["r"], {"FW_ACRO_YAW_EN": 1.0}, False),
        (["q"], {"FW_ACRO_YAW_EN": 0.0}, False),
        # a multicopter or ArduPlane, which have no such parameter
        (["r"], {}, False),
    ],
)
def test_parameter_without_which_px4_does_not_control_r_is_named(
    outputs: list[str], parameters: dict[str, float], is_named: bool
) -> None:
    assert ("set FW_ACRO_YAW_EN to 1" in to_set(outputs, parameters)) == is_named


def scenario_with(value: float) -> Scenario:
    path = Path(__file__).parents[3] / "examples" / "px4_airplane" / "rates.yaml"
    pulses = {"q": {"start": [3.0], "stop": [3.4], "value": [value]}}
    return find_scenario(str(path)).vary(reference_model={"pulses": pulses})


def test_doublets_to_fly_are_those_of_the_scenario() -> None:
    y = np.full((100, 1), 0.1)
    text = to_fly({"q": 1.0}, scenario_with(0.25), NOMINAL, y)
    assert text == "; fly, 2 s apart, q: 3 doublets of 0.25 rad/s, 0.4 s each way"
    # twice the amplitude is needed: that of the scenario has it, as 2.5 times what moved
    assert "3 doublets of 0.25" in to_fly({"q": 2.0}, scenario_with(0.25), NOMINAL, y)
    # four times as much motion takes (4 / 2.5)^2 as many doublets
    assert "8 doublets of 0.25" in to_fly({"q": 4.0}, scenario_with(0.25), NOMINAL, y)
