# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What an identification says of its own errors, beside aircraft whose A and B are known.

The logs are of an aircraft that is integrated in steps of 0.5 ms, apart from the code under test,
and that differs from the model in what the identification leaves out: a later input, noise that is
not white, wind, samples of u that are rare or lost.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.vectors import FloatArray
from flight_design.gains.ideal_control import ChannelPairing
from flight_design.identification.excitation import (
    OwnShare,
    factors_of,
    gust_warning,
    own_shares,
    to_fly,
    to_set,
)
from flight_design.identification.innovation_filters import Actuation, FlightData, coarser
from flight_design.identification.likelihood import Unknown
from flight_design.identification.model_identification import Identification, identify_model
from flight_design.identification.model_quality import NoBetter
from flight_design.identification.trim_check import doubted, without_trim

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


@pytest.fixture(scope="module")
def nominal(tmp_path_factory: pytest.TempPathFactory) -> Airframe:
    path = tmp_path_factory.mktemp("airframe") / "pitch.yaml"
    path.write_text(AIRFRAME)
    return load_airframe(str(path))


def flown(
    nominal: Airframe,
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

    For the first 20 s the elevator is `climb`, rad, off its trim, and no doublets are flown if it
    is. u acts `late`, s. The noise of y follows e_k = `colour` e_(k-1) + white noise. The wind, m/s
    rms, has a correlation of 0.3 s.
    """
    rng = np.random.default_rng(5)
    A, B = nominal.matrix_a(), nominal.matrix_b()
    A[1] *= 1.0 + np.array([TRUE["A[q, alpha]"], TRUE["A[q, q]"]])
    B[1] *= 1.0 + TRUE["B[q, elevator]"]
    by_wind = -A[:, 0] / nominal.speed
    h = PERIOD / STEPS
    both = expm(np.block([[A, B], [np.zeros((1, 3))]]) * h)
    count = int(length / PERIOD)
    y, u = np.zeros(count), np.zeros(count)
    line = [0.0] * round(late / h)
    x = np.zeros(2)
    integral = noise = air = 0.0
    for k in range(count):
        noise = colour * noise + np.sqrt(1.0 - colour**2) * rng.normal()
        phase = k * PERIOD % 3.0
        wanted = setpoint * ((phase < 0.5) - float(0.5 <= phase < 1.0))
        trim = 0.0
        if climb and k * PERIOD < 21.0:
            trim = climb * min(1.0, 21.0 - k * PERIOD)
            wanted = 0.0
        y[k] = x[1] + 0.05 * noise
        integral = np.clip(integral + 3.0 * (wanted - y[k]) * PERIOD, -0.4, 0.4)
        u[k] = 0.26 * np.clip(feedforward * wanted + 0.086 * (wanted - y[k]) + integral, -1.0, 1.0)
        for _ in range(STEPS):
            line.append(u[k] - trim)
            air += -air * h / 0.3 + wind * np.sqrt(2.0 * h / 0.3) * rng.normal()
            x = both[:2, :2] @ x + both[:2, 2] * line.pop(0) + h * by_wind * air
    return y, u


def identified(
    nominal: Airframe, y: FloatArray, u: FloatArray, timing: float | None = TIMING
) -> Identification:
    recorded = FlightData(
        PERIOD, np.arange(len(y), dtype=np.float64) * PERIOD, y[:, None], u[:, None]
    )
    return identify_model(
        coarser(recorded, 2),
        nominal,
        Actuation(np.zeros(1), 0.0),
        unknown=Unknown(has_hidden_rows=False),
        searches_again=True,
        timing=timing,
    )


def twice_identified(
    nominal: Airframe, y: FloatArray, u: FloatArray
) -> tuple[Identification, Identification]:
    """Identify with and without slow changes of trim, as `rise-di tune` does."""
    t = np.arange(len(y), dtype=np.float64) * PERIOD
    steady = without_trim(FlightData(PERIOD, t, y[:, None], u[:, None]))
    return (
        identified(nominal, y, u),
        identified(nominal, steady.y[:, 0], steady.u[:, 0], timing=None),
    )


def farthest(found: Identification) -> float:
    """The largest error of an entry in its stated deviations."""
    return max(abs(entry.error - TRUE[entry.name]) / entry.deviation for entry in found.entries)


@pytest.mark.slow
def test_log_of_gusts_has_a_warning(nominal: Airframe) -> None:
    """Their effect on the estimate is beyond the deviations."""
    (part,) = identified(nominal, *flown(nominal, wind=1.0)).parts
    assert "fly the doublets in calm air" in gust_warning(part)
    (calm,) = identified(nominal, *flown(nominal)).parts
    assert gust_warning(calm) == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    "lacks",
    [
        {},
        # u acts anywhere within a period of the log: half of it is the farthest from the mean
        {"late": 0.002},
        {"colour": 0.5},
        {"wind": 0.3},
        {"late": 0.002, "colour": 0.5, "wind": 0.3},
    ],
    ids=["right model", "late u", "coloured noise", "wind", "all"],
)
def test_no_entry_is_farther_off_than_stated(nominal: Airframe, lacks: dict[str, float]) -> None:
    found = identified(nominal, *flown(nominal, **lacks))
    refusal = found.refusal
    assert farthest(found) < OFF or (refusal is not None and not isinstance(refusal, NoBetter))


@pytest.mark.slow
def test_deviations_of_a_right_model_alone_are_too_small_for_a_late_input(
    nominal: Airframe,
) -> None:
    """What the other deviations are for: 5 stated deviations here, without them."""
    y, u = flown(nominal, late=0.002)
    assert farthest(identified(nominal, y, u, timing=None)) > OFF


@pytest.mark.slow
def test_trim_of_a_climb_is_no_effect_of_the_input(nominal: Airframe) -> None:
    """Without the check an entry would be 56 stated deviations off.

    The autopilot has no feedforward, so its doublets are slow. The doublets alone show the
    aircraft.
    """
    y, u = flown(nominal, climb=0.04, feedforward=0.0)
    once, steady = twice_identified(nominal, y, u)
    found = doubted(once, steady)
    assert str(found.refusal).startswith("trim: found B[q, elevator] changed by -5")
    # tune uses a part that is refused for its innovations alone, so this is no reason to keep
    (part,) = once.parts
    coloured = once._replace(parts=(part._replace(refusal=NoBetter("not white")),))
    assert doubted(coloured, steady).refusal == found.refusal
    # more doublets would not help
    assert factors_of(found.parts) == {}
    assert farthest(found) < OFF
    begin = round(21.0 / PERIOD)
    found = doubted(*twice_identified(nominal, y[begin:], u[begin:]))
    assert not found.refusal
    assert farthest(found) < OFF


@pytest.mark.slow
def test_log_with_rare_samples_of_u_is_refused_for_its_timing(nominal: Airframe) -> None:
    """PX4 logs the torque each 20 ms by default; the loop changes it each 4 ms."""
    y, u = flown(nominal)
    held = np.repeat(u[::5], 5)[: len(u)]
    found = identified(nominal, y, held, timing=0.02 / np.sqrt(12.0))
    assert "timing of u: found B[q, elevator] known to" in str(found.refusal)


@pytest.mark.slow
def test_lost_samples_do_not_move_an_entry_farther_than_stated(nominal: Airframe) -> None:
    """A tenth of the samples, and 8 s at once."""
    y, u = flown(nominal)
    lost = np.random.default_rng(1).random(len(y)) < 0.1
    lost[5000:7000] = True
    y[lost] = np.nan
    assert farthest(identified(nominal, y, u)) < OFF


def test_output_that_its_own_input_does_not_move_is_named(nominal: Airframe) -> None:
    """Wind moves q, and the elevator stands still."""
    y, u = flown(nominal, setpoint=0.0, wind=0.5, length=20.0)
    recorded = FlightData(
        PERIOD, np.arange(len(y), dtype=np.float64) * PERIOD, y[:, None], 0.0 * u[:, None]
    )
    (still,) = own_shares(recorded, nominal, CHANNELS)
    assert still == OwnShare("q", "elevator", 0.0)
    assert still.is_still
    assert still.sentence == "q: found that elevator explains 0 % of its motion, expected 5 %"


def test_output_that_the_noise_of_its_feedback_moves_is_named(nominal: Airframe) -> None:
    """In calm air without doublets the noise of y is all that moves the elevator."""
    y, u = flown(nominal, setpoint=0.0, length=20.0)
    recorded = FlightData(
        PERIOD, np.arange(len(y), dtype=np.float64) * PERIOD, y[:, None], u[:, None]
    )
    (still,) = own_shares(recorded, nominal, CHANNELS)
    assert still.is_still


def test_output_that_doublets_move_is_not_named(nominal: Airframe) -> None:
    y, u = flown(nominal, length=20.0)
    recorded = FlightData(
        PERIOD, np.arange(len(y), dtype=np.float64) * PERIOD, y[:, None], u[:, None]
    )
    (moved,) = own_shares(recorded, nominal, CHANNELS)
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


def test_doublets_to_fly_are_those_of_the_scenario(nominal: Airframe) -> None:
    y = np.full((100, 1), 0.1)
    text = to_fly({"q": 1.0}, scenario_with(0.25), nominal, y)
    assert text == "; fly, 2 s apart, q: 3 doublets of 0.25 rad/s, 0.4 s each way"
    # twice the amplitude is needed: that of the scenario has it, as 2.5 times what moved
    assert "3 doublets of 0.25" in to_fly({"q": 2.0}, scenario_with(0.25), nominal, y)
    # four times as much motion takes (4 / 2.5)^2 as many doublets
    assert "8 doublets of 0.25" in to_fly({"q": 4.0}, scenario_with(0.25), nominal, y)
