# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Turn a flight into a polars data frame."""

from typing import TYPE_CHECKING

import numpy as np

from flight_core.rates import NANOSECONDS
from flight_core.tape import Tape, as_tape

if TYPE_CHECKING:  # polars takes some tenths of a second to load
    import polars as pl


def data_frame(tape: Tape) -> "pl.DataFrame":
    """Return a flight's signals as a table, SI, with a column "topic.channel" for each channel.

    There is a row for each instant at which any topic has a sample. The first columns are
    "stamp_ns" (int64) and "t" = (stamp_ns - start) / 1e9. A topic that has no sample at an instant
    has nulls there. If two samples have the same stamp, the table has the later sample.

    Args:
        tape: A flight.

    Returns:
        A polars data frame, in SI and radians.

    Raises:
        ParameterError: `tape` is no Tape, or has no topic.

    Examples:
        >>> tape = rise_di.simulate(rise_di.find_scenario("osprey_servo", duration=0.1))
        >>> rise_di.data_frame(tape)["y.q"].drop_nulls().len()
        51
    """
    import polars as pl  # noqa: PLC0415

    as_tape(tape)
    stamps = np.unique(np.concatenate([signal.stamp_ns for signal in tape.signals.values()]))
    columns: dict[str, np.ndarray] = {
        "stamp_ns": stamps,
        "t": (stamps - tape.start_ns) / NANOSECONDS,
    }
    missing: dict[str, np.ndarray] = {}
    for topic, signal in tape.signals.items():
        rows = np.searchsorted(stamps, signal.stamp_ns)
        absent = np.ones(len(stamps), dtype=bool)
        absent[rows] = False
        for name in signal.names:
            column = np.full(len(stamps), np.nan)
            column[rows] = signal[name]
            columns[f"{topic}.{name}"] = column
            missing[f"{topic}.{name}"] = absent
    return pl.DataFrame(columns).with_columns(
        pl.when(pl.Series(absent)).then(None).otherwise(pl.col(name)).alias(name)
        for name, absent in missing.items()
        if absent.any()
    )
