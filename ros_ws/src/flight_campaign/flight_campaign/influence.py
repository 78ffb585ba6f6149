# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find which drawn entries of A and B decide the score of a campaign.

Rank correlations show which entries matter. They also show in which corner of the box of
uncertainty the score is worst.
"""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import ndtri

from flight_campaign.rows import entry_names

if TYPE_CHECKING:
    import polars as pl

RANKED = 10_000  # largest number of aircraft of a case that are ranked: standard error 0.01
LEAST_RANKED = 10  # least number of aircraft; fewer aircraft show only chance
CHANCE = 0.05  # share of campaigns in which an entry without effect exceeds the level of chance


def rank_correlations(table: "pl.DataFrame", published: Mapping[str, float]) -> dict[str, float]:
    """Return how the size of each entry correlates with the score, by ranks (Spearman).

    The size is relative to the published value. The strongest correlation comes first. A
    correlation of +1 means that the aircraft flies worse, with a higher score, the larger the entry
    is. A diverged aircraft has the worst rank. The result is empty if there are fewer than
    LEAST_RANKED aircraft, or if all aircraft are equal.
    """
    import polars as pl  # noqa: PLC0415 - some tenths of a second

    score = table["score"].fill_null(math.inf).to_numpy()
    names = [name for name in entry_names(table) if table[name].n_unique() > 1]
    if len(score) < LEAST_RANKED or not names or np.all(score == score[0]):
        return {}
    sizes = table.select(names).to_numpy() / np.array([published[name] for name in names])
    ranks = pl.DataFrame(np.column_stack([sizes, score])).select(pl.all().rank()).to_numpy()
    correlations = np.corrcoef(ranks, rowvar=False)[-1, :-1]
    order = np.argsort(-np.abs(correlations), kind="stable")
    return {names[k]: float(correlations[k]) for k in order}


def chance_level(aircraft: int, entries: int) -> float:
    """Return which rank correlation the entries rarely exceed by chance.

    In 95 % of campaigns no entry without effect exceeds it. The correlation of independent values
    has mean 0 and variance 1 / (N - 1), and is normal for large N. Source: Kendall, Rank
    Correlation Methods, 1948. The level allows for the number of entries (Bonferroni).
    """
    return float(ndtri(1.0 - CHANCE / (2 * entries))) / math.sqrt(aircraft - 1)


def influence(
    table: "pl.DataFrame",
    worst: "pl.DataFrame",
    published: Mapping[str, float],
    uncertainty: Mapping[str, float],
) -> dict[str, Any]:
    """Return the rank correlations of a case as a dict that JSON can hold.

    The correlations come from `table`, and the row `worst` has the entries of the worst aircraft.
    `uncertainty` is the largest deviation of each entry. Two entries of the result have deviations,
    as fractions of the published entries. "worst_aircraft" has the deviations of the worst
    aircraft. "worst_corner" has plus or minus the uncertainty, with the sign for which the score
    rises, and 0 if the correlation may be chance.
    """
    correlations = rank_correlations(table, published)
    level = chance_level(table.height, len(correlations)) if correlations else None
    entries = [
        {
            "entry": name,
            "rank_correlation": value,
            "worst_aircraft": worst[name][0] / published[name] - 1.0,
            "worst_corner": math.copysign(uncertainty[name], value)
            if level is not None and abs(value) > level
            else 0.0,
        }
        for name, value in correlations.items()
    ]
    return {"aircraft": table.height, "chance": level, "entries": entries}
