# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the export of flights as tables and figures, which independent readers read back."""

import csv
from pathlib import Path

import numpy as np
import polars as pl
from matplotlib.image import imread
from tests.recordings import EPOCH

from flight_analysis.report.data_frame import data_frame
from flight_analysis.report.export import write_csv, write_parquet, write_png
from flight_analysis.report.summary import RecordedFlight
from flight_core.tape import Signal, Tape


def test_table_has_row_per_instant_and_null_without_sample() -> None:
    y = Signal(
        np.array([EPOCH, EPOCH + 1, EPOCH + 2]),
        ("q", "V"),
        np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]),
    )
    u = Signal(
        np.array([EPOCH + 1, EPOCH + 3, EPOCH + 3]), ("thrust",), np.array([[0.5], [0.25], [0.75]])
    )
    assert data_frame(Tape({"y": y, "u": u}, EPOCH)).to_dict(as_series=False) == {
        "stamp_ns": [EPOCH, EPOCH + 1, EPOCH + 2, EPOCH + 3],
        "t": [0.0, 1e-9, 2e-9, 3e-9],
        "y.q": [1.0, 3.0, 5.0, None],
        "y.V": [2.0, 4.0, 6.0, None],
        "u.thrust": [None, 0.5, None, 0.75],  # the later of two with one stamp
    }


def test_csv_and_parquet_hold_every_sample_to_last_bit(
    flight: RecordedFlight, tmp_path: Path
) -> None:
    write_csv(tmp_path / "run.csv", [flight])
    write_parquet(tmp_path / "run.parquet", [flight])
    with (tmp_path / "run.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    table = pl.read_parquet(tmp_path / "run.parquet")
    assert len(rows) == len(table) == 1501
    for topic, name in (("y", "q"), ("u", "thrust"), ("internals", "Pi.r"), ("truth", "x.alpha")):
        column = f"{topic}.{name}"
        expected = flight.tape[topic][name].tolist()
        assert [float(row[column]) for row in rows if row[column]] == expected
        assert table[column].drop_nulls().to_list() == expected
    # 100 Hz of 500
    assert [row["u.thrust"] != "" for row in rows[:11]] == [
        True,
        *[False] * 4,
        True,
        *[False] * 4,
        True,
    ]


def test_table_of_several_flights_has_column_run(flight: RecordedFlight, tmp_path: Path) -> None:
    bare = flight._replace(
        name="bare", tape=Tape({"y": flight.tape["y"], "y_m": flight.tape["y_m"]})
    )
    write_parquet(tmp_path / "both.parquet", [flight, bare])
    both = pl.read_parquet(tmp_path / "both.parquet")
    assert both["run"].value_counts(sort=True).rows() == [("run", 1501), ("bare", 1501)]
    assert both.filter(pl.col("run") == "bare")["u.thrust"].null_count() == 1501


def test_one_png_shows_all_flights(flight: RecordedFlight, tmp_path: Path) -> None:
    bare = flight._replace(
        name="bare", tape=Tape({"y": flight.tape["y"], "y_m": flight.tape["y_m"]})
    )
    for flights in ([flight], [bare], [flight, bare]):
        write_png(tmp_path / "run.png", flights)
        pixels = imread(tmp_path / "run.png")
        assert pixels.shape[1] == 1800
        assert pixels.shape[0] > 1000  # four rows
        assert (pixels[..., :3].min(axis=2) < 0.5).mean() > 0.005  # not blank
