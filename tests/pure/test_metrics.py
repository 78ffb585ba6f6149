# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Figures of a flight, against numbers worked by hand."""

import math

import numpy as np
import pytest

from flight_analysis.metrics import error_figures, error_table, in_windows, tick_figures, tracking_error
from flight_core.tape import Signal, Tape

MS = 1_000_000
EPOCH = 1_795_000_000_000_000_000  # a stamp of today, where float64 seconds resolve no better than 0.2 us


def signal(stamps_ms: list[float], **channels: list[float]) -> Signal:
    stamps = EPOCH + np.array([round(stamp * MS) for stamp in stamps_ms], dtype=np.int64)
    return Signal(stamps, tuple(channels), np.column_stack([np.array(values) for values in channels.values()]))


def test_rms_and_max() -> None:
    # sqrt((9 + 16 + 0 + 0) / 4) = 2.5
    assert error_figures(np.array([3.0, -4.0, 0.0, 0.0])) == (2.5, 4.0)


def test_a_part_without_samples_has_no_figure() -> None:
    assert all(math.isnan(figure) for figure in error_figures(np.zeros(0)))


def test_error_is_formed_at_the_stamps_of_y_by_name() -> None:
    y = signal([0, 1, 2], q=[1.0, 2.0, 3.0], V=[0.0, 0.0, 0.0])
    y_m = signal([0, 2], V=[1.0, 1.0], q=[0.0, 4.0])  # q is 2 half way
    error = tracking_error(Tape({"y": y, "y_m": y_m}, EPOCH))
    assert error.names == ("q", "V")
    assert error["q"].tolist() == [1.0, 0.0, -1.0]
    assert error["V"].tolist() == [-1.0, -1.0, -1.0]


def test_y_outside_the_reference_is_left_out() -> None:
    y, y_m = signal([0, 1, 2, 3], q=[9.0, 1.0, 1.0, 9.0]), signal([1, 2], q=[0.0, 0.0])
    assert tracking_error(Tape({"y": y, "y_m": y_m}, EPOCH))["q"].tolist() == [1.0, 1.0]


def test_calm_and_gust_are_told_apart() -> None:
    windows = {"vertical": (1.0, 2.0)}
    assert in_windows(np.array([0.9, 1.0, 2.0, 2.5, 2.6]), windows, 0.5).tolist() == [False, True, True, True, False]
    y = signal([0, 1000, 2000], q=[3.0, 4.0, 0.0])
    table = error_table(Tape({"y": y, "y_m": signal([0, 2000], q=[0.0, 0.0])}, EPOCH), {"g": (0.9, 1.1)}, settle=0.0)
    assert table["q"]["gust"] == (4.0, 4.0)
    assert table["q"]["calm"].rms == pytest.approx(math.sqrt(4.5))
    assert table["q"]["whole"].max == 4.0


def test_ticks_are_counted_against_their_period() -> None:
    # Ticks at 0, 10, 20, 40 ms: none at 30, mean 13.3 ms; the stamps are those of y, 1 ms older.
    internals = signal([-1, 9, 19, 39], late=[0.0, 1e-4, 0.0, 3e-4], age=[1e-3] * 4)
    figures = tick_figures(Tape({"internals": internals}, EPOCH), 10 * MS)
    assert figures is not None
    assert (figures.ticks, figures.without_new_y, figures.period_max, figures.late_max) == (4, 1, 0.02, 3e-4)
    assert figures.period_mean == pytest.approx(0.04 / 3, abs=1e-9)


def test_a_flight_of_one_tick_has_no_tick_figures() -> None:
    assert tick_figures(Tape({"internals": signal([0], late=[0.0], age=[0.0])}, EPOCH), 10 * MS) is None


def test_groups_of_channels_lose_their_prefix() -> None:
    tape = signal([0], **{"e.q": [1.0], "Pi.q": [2.0], "e.V": [3.0]})
    assert tape.group("e").names == ("q", "V")
    assert tape.group("e").values.tolist() == [[1.0, 3.0]]
    with pytest.raises(KeyError, match=r"no channel x among e\.q, Pi\.q, e\.V"):
        tape["x"]


def test_a_period_is_without_a_new_y_whether_the_sample_or_the_tick_was_lost() -> None:
    # Ticks at 0, 10, 30 ms: at 20 ms there was no y to step on, and no tick came late.
    internals = signal([0, 10, 30], late=[0.0] * 3, age=[0.0] * 3)
    figures = tick_figures(Tape({"internals": internals}, EPOCH), 10 * MS)
    assert figures is not None
    assert (figures.ticks, figures.without_new_y, figures.late_max) == (3, 1, 0.0)
