# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Which drawn entries of A and B decide the score of a campaign.

They are told by rank correlations, and the corner that these point to.
"""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from flight_campaign.rows import entry_names

if TYPE_CHECKING:
    import polars as pl

RANKED = 10_000  # aircraft of a case, the first ones, that are ranked: a standard error of 0.01
LEAST_RANKED = 10  # fewer aircraft show chance alone
CHANCE = 0.05  # part of the campaigns in which an entry without effect exceeds the level of chance


def rank_correlations(table: "pl.DataFrame", published: Mapping[str, float]) -> dict[str, float]:
    """Rank correlation (Spearman) of the size of each entry with the score.

    The size is over its published value; the strongest comes first. +1: the score grows (the
    aircraft flies worse) with the size of the entry. A diverged aircraft has the worst rank. Empty
    for fewer than LEAST_RANKED aircraft, or equal ones.
    """
    from scipy.stats import rankdata  # noqa: PLC0415 - half a second, only for this

    score = table["score"].fill_null(math.inf).to_numpy()
    names = [name for name in entry_names(table) if table[name].n_unique() > 1]
    if len(score) < LEAST_RANKED or not names or np.all(score == score[0]):
        return {}
    sizes = table.select(names).to_numpy() / np.array([published[name] for name in names])
    correlations = np.corrcoef(rankdata(np.column_stack([sizes, score]), axis=0), rowvar=False)[
        -1, :-1
    ]
    order = np.argsort(-np.abs(correlations), kind="stable")
    return {names[k]: float(correlations[k]) for k in order}


def chance_level(aircraft: int, entries: int) -> float:
    """Return the rank correlation that none of so many entries without effect exceeds.

    This holds in 95 % of campaigns. Of independent values it has mean 0 and variance 1 / (N - 1),
    normal for large N. Source: Kendall, Rank Correlation Methods, 1948. The level counts the number
    of entries (Bonferroni).
    """
    from scipy.stats import norm  # noqa: PLC0415 - as above

    return float(norm.ppf(1.0 - CHANCE / (2 * entries))) / math.sqrt(aircraft - 1)


def influence(
    table: "pl.DataFrame",
    worst: "pl.DataFrame",
    published: Mapping[str, float],
    uncertainty: Mapping[str, float],
) -> dict[str, Any]:
    """Rank correlations of a case as figures of a file.

    They are of `table`, beside the entries of the row `worst`, the worst aircraft. `uncertainty` is
    the largest part by entry. "worst_aircraft" and "worst_corner" are parts of the published entry:
    of the worst aircraft, and the limit of the uncertainty on the side of the higher score, 0 for
    an entry within chance.
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
