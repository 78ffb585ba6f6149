# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Show what a phase margin costs in tracking error of the linear loop along a manoeuvre.

Gains are selected for several requirements, and the errors of their loops are compared.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from flight_analysis.linear_loop.loop_margins import law_order, linear_loop
from flight_core.vectors import FloatArray
from flight_design.gains.gain_selection import Selection, gain_sets
from flight_design.gains.ideal_control import Study
from flight_design.gains.linear_error import linear_error

TRADED_PHASE_MARGINS = (30.0, 40.0, 45.0, 60.0)  # deg


class TradeRow(NamedTuple):
    """The margins and errors of the loop whose gains are selected for a phase margin."""

    phase_margin: float  # deg, the requirement
    reached: float  # deg, least phase margin that the loop has
    delay_margin: float  # s
    # (m,) rms error of the linear loop along the manoeuvre, SI, by output of the law
    rms: FloatArray


def trade(
    selection: Selection, phase_margins: Sequence[float] = TRADED_PHASE_MARGINS
) -> tuple[TradeRow, ...]:
    """Select the engineering gains for several required phase margins, deg.

    The rows of the result have the errors of the nominal aircraft.
    """
    nominal = _nominal(selection.study)
    rows = []
    for phase_margin in phase_margins:
        requirement = selection.setting.requirement._replace(phase=math.radians(phase_margin))
        assessed = gain_sets(
            nominal, selection.setting._replace(requirement=requirement)
        ).engineering
        if assessed.margins is None:
            continue
        loop = linear_loop(assessed.controller, nominal.airframe, nominal.A, nominal.B)
        least = math.degrees(float(assessed.margins.nominal.phase.min()))
        _, columns = law_order(nominal.airframe, assessed.controller)
        rms = linear_error(loop, nominal.u_dot[:, 0][:, columns])
        rows.append(TradeRow(phase_margin, least, assessed.margins.delay, rms))
    return tuple(rows)


def _nominal(study: Study) -> Study:
    """Return the study with the nominal airframe only."""
    return study._replace(
        A=study.A[:1], B=study.B[:1], u_dot=study.u_dot[:, :1], stable=study.stable[:1]
    )
