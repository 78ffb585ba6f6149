# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Store a campaign as a table; a row has an aircraft's metrics, outcome and drawn entries."""

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from flight_campaign.equipment import is_of_equipment
from flight_campaign.statistics import Tally, has_lost_track
from flight_core.vectors import FloatArray

if TYPE_CHECKING:  # it takes some tenths of a second to load
    import polars as pl

KEYS = ("seed", "number", "factor", "diverged", "lost")
"""First columns of every table. "factor" is the factor of the sweep, or 1 without a sweep. The
columns of the figures follow, and then those of the drawn entries."""


class Chunk(NamedTuple):
    """Results of the aircraft in a chunk."""

    first: int  # number of the first aircraft
    diverged: FloatArray  # (N,)
    figures: dict[str, FloatArray]  # figures by name, (N,) each
    # drawn values by name, (N,) each, see `uncertainty.drawn_entries` and `equipment.drawn`
    entries: dict[str, FloatArray]


def join_chunks(parts: Sequence[Chunk]) -> Chunk:
    """Join consecutive parts of a chunk."""
    first, *others = parts
    if not others:
        return first
    tables = ([part.figures for part in parts], [part.entries for part in parts])
    figures, entries = (
        {name: np.concatenate([table[name] for table in several]) for name in several[0]}
        for several in tables
    )
    return Chunk(first.first, np.concatenate([part.diverged for part in parts]), figures, entries)


def encode_chunk(chunk: Chunk, seed: int, factor: float) -> bytes:
    """Encode the table of a chunk as Parquet (zstd), SI.

    The metrics of a diverged aircraft are null. NaN becomes null too.
    """
    import polars as pl  # noqa: PLC0415

    count = len(chunk.diverged)
    stream = io.BytesIO()
    diverged = pl.Series("diverged", chunk.diverged.astype(bool))
    table = pl.DataFrame(
        {
            "seed": pl.repeat(seed, count, dtype=pl.Int64, eager=True),
            "number": pl.int_range(chunk.first, chunk.first + count, eager=True),
            "factor": pl.repeat(factor, count, dtype=pl.Float64, eager=True),
            "diverged": diverged,
            "lost": has_lost_track(chunk.diverged, chunk.figures["score"]),
            **chunk.figures,
            **chunk.entries,
        }
    )
    table = table.with_columns(
        pl.when(~diverged).then(pl.col(name).fill_nan(None)).alias(name) for name in chunk.figures
    )
    table.write_parquet(stream)
    return stream.getvalue()


def entry_names(table: "pl.DataFrame") -> list[str]:
    """Return the columns with drawn entries: A and B, lags, noise and the delay of u."""
    return [
        name for name in table.columns if name.startswith(("A[", "B[")) or is_of_equipment(name)
    ]


def tally_of(table: "pl.DataFrame") -> Tally:
    """Return the statistics of the rows of a chunk."""
    figures = [name for name in table.columns if name not in {*KEYS, *entry_names(table)}]
    columns = {name: table[name].to_numpy() for name in figures}
    return Tally.from_flights(table["number"][0], table["diverged"].to_numpy(), columns)
