# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the metrics of a flight against numbers that are computed by hand."""

import math
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from pytest import approx
from scipy.signal import welch
from tests.recordings import EPOCH, MS, signal

from flight_analysis.metrics.by_part import errors_by_part, inputs_by_part
from flight_analysis.metrics.controller_log import saturation_shares, sign_switches
from flight_analysis.metrics.errors import ErrorMetrics, error_metrics, noise_floor, tracking_error
from flight_analysis.metrics.settling import settling_bands, settling_time, settling_times
from flight_analysis.metrics.time_spans import is_in_spans
from flight_analysis.metrics.transients import (
    Transient,
    TransientKind,
    guided_transients,
    part_masks,
)
from flight_analysis.report.spectra import spectra
from flight_analysis.report.timing import tick_metrics
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray
from rise_di_controller.internals import Saturation


def tape(**signals: Signal) -> Tape:
    """Return a flight that begins at EPOCH."""
    return Tape(dict(signals), EPOCH)


def test_rms_and_max() -> None:
    # sqrt((9 + 16 + 0 + 0) / 4) = 2.5
    errors = error_metrics(np.array([3.0, -4.0, 0.0, 0.0]))
    assert (errors.rms, errors.max) == (2.5, 4.0)


def test_error_formed_at_stamps_of_y_by_name() -> None:
    y = signal([0, 1, 2], q=[1.0, 2.0, 3.0], V=[0.0, 0.0, 0.0])
    y_m = signal([0, 2], V=[1.0, 1.0], q=[0.0, 4.0])  # q is 2 half way
    error = tracking_error(tape(y=y, y_m=y_m))
    assert error.names == ("q", "V")
    assert error["q"].tolist() == [1.0, 0.0, -1.0]
    assert error["V"].tolist() == [-1.0, -1.0, -1.0]


def test_y_outside_the_reference_is_left_out() -> None:
    y = signal([0, 1, 2, 3], q=[9.0, 1.0, 1.0, 9.0])
    y_m = signal([1, 2], q=[0.0, 0.0])
    assert tracking_error(tape(y=y, y_m=y_m))["q"].tolist() == [1.0, 1.0]


def test_a_span_extends_beyond_its_end() -> None:
    assert is_in_spans(np.array([0.9, 1.0, 2.0, 2.5, 2.6]), [(1.0, 2.0)], 0.5).tolist() == [
        False,
        True,
        True,
        True,
        False,
    ]


def instants_by_part(t: FloatArray, transients: list[Transient]) -> dict[str, list[float]]:
    masks = part_masks(t, transients, settle=1.0)
    return {part: t[mask].tolist() for part, mask in masks.items()}


def test_each_instant_belongs_to_one_part_of_flight() -> None:
    transients = [
        Transient(kind=TransientKind.ENGAGEMENT, name="", start=0.0, stop=0.0),
        Transient(kind=TransientKind.COMMAND, name="q", start=3.0, stop=3.1),
        Transient(kind=TransientKind.GUST, name="vertical", start=3.5, stop=4.0),
    ]
    t = np.array([0.0, 0.5, 1.5, 3.0, 3.4, 3.6, 4.5, 5.5])
    assert instants_by_part(t, transients) == {
        "whole": t.tolist(),
        "calm": [1.5, 5.5],  # 0 and 0.5 belong to the engagement
        "command": [3.0, 3.4],
        "gust": [3.6, 4.5],  # although the command lasts to 4.1
    }


def test_turn_and_capture_replace_commands_of_guided_flight() -> None:
    transients = [
        Transient(kind=TransientKind.CAPTURE, name="", start=1.0, stop=2.0),
        Transient(kind=TransientKind.TURN, name="", start=2.5, stop=3.0),
        Transient(kind=TransientKind.GUST, name="vertical", start=3.5, stop=4.0),
    ]
    t = np.array([0.5, 1.5, 2.2, 2.9, 3.8, 6.0])
    assert instants_by_part(t, transients) == {
        "whole": t.tolist(),
        "calm": [0.5, 6.0],
        "capture": [1.5, 2.2],
        "turn": [2.9],
        "gust": [3.8],
    }


def guided(**channels: Any) -> list[Any]:
    """Return kind, start and stop of the transients of 20 s of guidance at 40 m/s.

    Guidance has the given channels from 5 to 8 s.
    """
    t = np.arange(0.0, 20_000.0, 20.0)
    level = {"phi_c": 0.0, "climb_c": 0.0, "xtrack": 0.0, "V_c": 40.0}
    changes = {
        name: np.where((t >= 5_000) & (t < 8_000), value, level[name])
        for name, value in channels.items()
    }
    transients = guided_transients(tape(guidance=signal(t.tolist(), **level | changes)))
    return [(transient.kind, transient.start, transient.stop) for transient in transients]


@pytest.mark.parametrize(
    "channels, expected",
    [
        ({"phi_c": -0.1}, [("turn", 5.0, 8.0)]),  # 5.7 deg
        ({"phi_c": 0.08}, []),  # 4.6 deg
        ({"climb_c": 0.8}, [("capture", 5.0, 8.0)]),  # of 40 m/s: 1.15 deg
        ({"climb_c": -0.6}, []),  # 0.86 deg
        ({"xtrack": -21.0}, [("capture", 5.0, 8.0)]),  # 20 m is half a second
        ({"xtrack": 19.0}, []),
        ({"V_c": 42.0}, [("capture", 5.0, 6.0), ("capture", 8.0, 9.0)]),  # one step up, one down
        ({"phi_c": 0.3, "xtrack": 100.0}, [("turn", 5.0, 8.0)]),  # a turn first of all
    ],
)
def test_turns_and_captures_follow_from_commands_of_guidance(channels: Any, expected: Any) -> None:
    assert guided(**channels) == [
        (kind, approx(start), approx(stop)) for kind, start, stop in expected
    ]


def test_errors_split_by_part_and_ultimate_bound_is_largest_undisturbed_error() -> None:
    flight = tape(y=signal([0, 1000, 2000], q=[3.0, 4.0, 0.0]), y_m=signal([0, 2000], q=[0.0, 0.0]))
    table = errors_by_part(
        flight, [Transient(kind=TransientKind.GUST, name="g", start=0.9, stop=1.1)], settle=0.0
    )
    assert table["q"]["gust"] == ErrorMetrics(rms=4.0, max=4.0)
    assert table["q"]["calm"].rms == approx(math.sqrt(4.5))
    assert table["q"]["calm"].max == 3.0
    assert table["q"]["whole"].max == 4.0


def test_settling_time_ends_where_error_begins_to_stay_in_band() -> None:
    t = np.arange(6.0) + 10.0
    for e, settling in (
        ([0.0, 3.0, -2.0, 1.0, 0.5, 0.0], 3.0),
        ([0.0, 1.0, -1.0, 0.0, 0.0, 0.0], 0.0),
        ([0.0, 0.0, 0.0, 5.0, 0.0, 0.0], 0.0),  # leaves the band after the 2 s
        ([5.0, 0.0, 5.0, 5.0, 5.0, 2.0], None),
        ([5.0, 0.0, 0.0, 0.0, 5.0, 0.0], 1.0),  # in the band for the dwell of 3 s
        ([5.0, 0.0, 0.0, 5.0, 5.0, 0.0], 5.0),  # in the band for 2 s, then to the end
    ):
        assert settling_time(t, np.array(e), band=1.0, leaves=2.0, dwell=3.0) == settling
    assert settling_time(np.zeros(0), np.zeros(0), band=1.0, leaves=2.0) is None


def test_settling_band_of_measured_error_is_at_least_four_noise_floors() -> None:
    # Second differences of +-1 are +-4: the floor is 4 / (0.6745 sqrt(6)). Four floors exceed 1 %
    # of a reference of 10.
    stamps = [10.0 * k for k in range(100)]
    noisy = signal(stamps, q=[1.0, -1.0] * 50)
    y_m = signal(stamps, q=10.0)
    floor = 4.0 / (0.6745 * math.sqrt(6.0))
    assert settling_bands(tape(y=noisy, y_m=y_m)) == {"q": approx(4.0 * floor)}
    truth = signal(stamps, **{"x.q": 10.0})
    assert settling_bands(tape(y=noisy, y_m=y_m, truth=truth)) == {"q": approx(0.1)}


def test_settling_measured_up_to_next_transient_of_channel() -> None:
    # q leaves the band at 1 s and at 5 s, each time for 0.2 s; its reference of 1 makes it 0.01
    # wide.
    stamps = [100.0 * k for k in range(81)]
    t = np.array(stamps) / 1000.0
    error = np.where(((t > 0.95) & (t < 1.15)) | ((t > 4.95) & (t < 5.15)), 0.5, 0.0)
    flight = tape(y=signal(stamps, q=1.0 + error, p=0.0), y_m=signal(stamps, q=1.0, p=0.0))
    transients = [
        Transient(
            kind=TransientKind.GUST, name="late", start=9.0, stop=9.5
        ),  # after the end of the flight
        Transient(kind=TransientKind.COMMAND, name="q", start=1.0, stop=1.1),
        Transient(kind=TransientKind.COMMAND, name="p", start=3.0, stop=3.1),
        Transient(kind=TransientKind.GUST, name="vertical", start=5.0, stop=5.1),
    ]
    first, second, gust = settling_times(flight, transients)
    assert first.until == {"q": 5.0}
    assert first.time == {"q": approx(0.2)}
    assert (second.transient.name, second.until, second.time) == ("p", {"p": 5.0}, {"p": 0.0})
    assert gust.until == {"q": 8.0, "p": 8.0}
    assert gust.time == {"q": approx(0.2), "p": 0.0}


def test_control_effort_is_rms_about_trim_and_mean_rate() -> None:
    # 0 -> 2 -> -2 -> -2 in 0.1 s each: a total variation of 6 in 0.3 s. sqrt((0 + 4 + 4 + 4) / 4) =
    # sqrt(3).
    flight = tape(u=signal([0, 100, 200, 300], elevator=[0.0, 2.0, -2.0, -2.0]))
    effort = inputs_by_part(flight, [])["elevator"]["whole"]
    assert asdict(effort) == approx({"rms": math.sqrt(3.0), "max": 2.0, "rate": 20.0})
    # The step into the gust and the one within it end there: 4 and 0 in 0.2 s.
    parts = inputs_by_part(
        flight, [Transient(kind=TransientKind.GUST, name="g", start=0.15, stop=0.35)], settle=0.0
    )["elevator"]
    assert asdict(parts["gust"]) == approx({"rms": 2.0, "max": 2.0, "rate": 20.0})
    assert parts["calm"].rate == approx(20.0)  # 2 in 0.1 s
    assert math.isnan(parts["command"].rms)
    assert math.isnan(parts["command"].rate)
    assert inputs_by_part(tape(), []) == {}


def test_saturated_ticks_are_counted_by_kind() -> None:
    kinds = [Saturation.NO, Saturation.MAGNITUDE, Saturation.RATE, Saturation.RATE]
    internals = signal([0, 10, 20, 30], **{"limited.thrust": kinds})
    assert saturation_shares(tape(internals=internals)) == {
        "thrust": {"magnitude": 0.25, "rate": 0.5}
    }
    assert saturation_shares(tape()) == {}


def test_sign_switches_counted_on_increments_of_pi() -> None:
    # Increments +, 0, +, -, -, +: two changes in 0.06 s; an increment of 0 is no direction.
    internals = signal(
        [10.0 * k for k in range(7)], **{"Pi.q": [0.0, 1.0, 1.0, 2.0, 1.0, 0.0, 1.0]}
    )
    assert sign_switches(tape(internals=internals)) == {"q": approx(2 / 0.06)}


def test_the_noise_floor_is_the_recorded_noise() -> None:
    flight = tape(
        y=signal([0, 10], q=[1.0, 2.0]), truth=signal([0, 10], **{"noise.q": [3.0, -4.0]})
    )
    assert noise_floor(flight) == {"q": approx(math.sqrt(12.5))}


def test_noise_floor_estimated_from_y_without_truth() -> None:
    # Normal noise of rms 0.02 on a slow sine of 1; with 20 000 samples the estimate is within some
    # per cent.
    k = np.arange(20_000)
    y = np.sin(k / 2000.0) + 0.02 * np.random.default_rng(1).standard_normal(len(k))
    flight = tape(y=Signal(EPOCH + k * 2 * MS, ("q",), y[:, None]))
    assert noise_floor(flight)["q"] == approx(0.02, rel=0.05)


def test_spectrum_of_sine_peaks_at_frequency_and_has_variance() -> None:
    # 5 Hz of amplitude 2: variance 2, the integral of the squared density over all frequencies.
    k = np.arange(6000)
    u = Signal(
        EPOCH + k * 10 * MS, ("elevator",), 2.0 * np.sin(2 * np.pi * 5.0 * k / 100.0)[:, None]
    )
    frequency, density = spectra(u, 10 * MS)
    assert frequency[np.argmax(density["elevator"])] == approx(5.0, abs=0.1)
    assert np.sum(density["elevator"] ** 2) * (frequency[1] - frequency[0]) == approx(2.0, rel=0.01)


# A window of the whole, an even and an odd one.
@pytest.mark.parametrize("samples", [300, 2560, 6005])
def test_a_spectrum_is_that_of_scipy(samples: int) -> None:
    values = np.random.default_rng(1).standard_normal((samples, 2)).cumsum(axis=0)
    frequency, density = spectra(
        Signal(EPOCH + np.arange(samples) * 10 * MS, ("a", "b"), values), 10 * MS
    )
    expected, power = welch(values, fs=100.0, nperseg=max(samples // 10, min(samples, 256)), axis=0)
    assert frequency == approx(expected[1:], rel=1e-12)
    for name, column in zip(("a", "b"), power[1:].T, strict=True):
        assert density[name] == approx(np.sqrt(column), rel=1e-9)  # rounding


def test_a_spectrum_bridges_missing_samples() -> None:
    k = np.delete(np.arange(1000), [100, 101, 500])
    frequency, density = spectra(Signal(EPOCH + k * 10 * MS, ("u",), np.ones((len(k), 1))), 10 * MS)
    assert frequency[-1] == 50.0
    assert np.all(density["u"] < 1e-12)  # constant, for gaps repeat the sample before


def test_periods_without_a_tick_are_counted() -> None:
    # Ticks at 0, 10, 20, 40 ms: none at 30, mean 13.3 ms; the stamps are those of y, 1 ms older.
    internals = signal([-1, 9, 19, 39], late=[0.0, 1e-4, 0.0, 3e-4], age=1e-3)
    result = tick_metrics(tape(internals=internals), 10 * MS)
    assert result is not None
    assert (result.ticks, result.without_new_y, result.period_max, result.late_max) == (
        4,
        1,
        0.02,
        3e-4,
    )
    assert result.period_mean == approx(0.04 / 3, abs=1e-9)
    assert result.jitter == 0.0  # the last took two whole periods
