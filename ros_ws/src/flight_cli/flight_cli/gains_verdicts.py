# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Judge the conditions of a gain set. Only the verdict on the loop decides.

The verdicts on the rules of the procedure and on the theorem do not decide.
"""

import math
from typing import Any, NamedTuple

from flight_analysis.linear_loop.guarantee import Guarantee
from flight_design.gains.gain_conditions import GainCondition, Relation, failing
from flight_design.gains.gain_selection import GainAssessment


def milliseconds(margin: float) -> str:
    """Return a delay margin, given in s, as text in milliseconds."""
    return f"{1e3 * margin:.0f} ms" if math.isfinite(margin) else "over 500 ms"


class Verdict(NamedTuple):
    """The verdict on a group of conditions. Its sentence is empty if there are no conditions."""

    is_met: bool
    sentence: str


def loop_verdict(answer: GainAssessment[Any], guarantee: Guarantee | None) -> Verdict:
    """Judge whether a loop is stable with the required margins and the required guarantee."""
    is_guaranteed = guarantee is None or guarantee.is_proved
    is_met = answer.is_stable and not failing(answer.loop) and is_guaranteed
    margins = answer.margins
    if margins is None:
        return Verdict(False, "the loop is not judged, because the literal sign has no linear loop")
    if not margins.nominal.stable:
        return Verdict(False, "the loop is unstable")
    if not answer.is_stable:
        text = f"{margins.stable} of {margins.aircraft} uncertain aircraft"
        return Verdict(False, f"the loop is stable, but only {text} are")
    clauses = []
    if short := failing(answer.loop):
        outputs = answer.controller.outputs
        falls = "; ".join(condition.sentence(outputs) for condition in short)
        clauses.append(f"but it lacks what is asked of it ({falls})")
    elif answer.has_requirement:
        phase = math.degrees(margins.nominal.phase.min())
        clauses.append(
            f"with the margins asked of it: at least {phase:.0f} deg of phase in each input, and "
            f"a delay margin of {milliseconds(margins.delay)}"
        )
    if guarantee is not None:
        within = f"within {100.0 * guarantee.uncertainty:g} %"
        clauses.append(
            f"as every aircraft {within} is, which is guaranteed"
            if is_guaranteed
            else f"but an aircraft {within} may be unstable"
        )
    return Verdict(is_met, ", ".join(("the loop is stable", *clauses)))


def rules_verdict(answer: GainAssessment[Any], _: Guarantee | None) -> Verdict:
    """Return a verdict on a gain set: how many rules of the engineering procedure it meets."""
    rules = answer.rules
    if not rules:
        return Verdict(True, "")
    kept = len(rules) - len(failing(rules))
    return Verdict(
        kept == len(rules),
        f"{kept} of {len(rules)} rules are kept. They are where the search for gains begins, and "
        "decide nothing",
    )


def theorem_verdict(answer: GainAssessment[Any], _: Guarantee | None) -> Verdict:
    """Return a verdict on a gain set: how many sufficient conditions of Theorem 1 it meets."""
    conditions = answer.theorem
    if not conditions:
        return Verdict(True, "")
    met = len(conditions) - len(failing(conditions))
    return Verdict(
        met == len(conditions),
        f"{met} of {len(conditions)} conditions of Theorem 1 are met. They are sufficient only, "
        "and decide nothing: the paper's proof is in continuous time, and no loop with servos "
        "meets its assumptions",
    )


HEADINGS = {
    "loop": "The loop: these conditions decide",
    "rules": "Rules of the engineering procedure",
    "theorem": "Theorem 1: sufficient conditions on a loop without servos in continuous time",
}
VERDICTS = {"loop": loop_verdict, "rules": rules_verdict, "theorem": theorem_verdict}
"""HEADINGS and VERDICTS have the heading of each part of the conditions on a gain set, and the
function that judges this part, in the order in which the parts are shown."""


def condition_name(row: tuple[GainCondition, ...], outputs: tuple[str, ...]) -> str:
    """Return the name of a table row, which has the same condition of each gain set.

    If the condition names the same channel in all gain sets, the name of the row has this channel.
    """
    where = {None if condition.channel is None else outputs[condition.channel] for condition in row}
    channel = where.pop() if len(where) == 1 else None
    return (
        row[0].name + (f" of {channel}" if channel else "") + (" ~" if row[0].is_estimate else "")
    )


SYMBOLS = {Relation.AT_LEAST: ">=", Relation.AT_MOST: "<=", Relation.ABOVE: ">"}


def condition_cells(condition: GainCondition) -> tuple[str, str]:
    """Return two cells of a table: the value beside its bound, and the margin, red if it fails."""
    margin = "" if math.isnan(condition.margin) else f"{condition.margin:.2g}"
    symbol = SYMBOLS[condition.relation]
    return (
        f"{condition.value:.4g} {symbol} {condition.bound:.4g}",
        margin if condition.is_met else f"[red]{margin} ![/red]",
    )


def condition_as_json(
    part: str, condition: GainCondition, outputs: tuple[str, ...]
) -> dict[str, Any]:
    """Return a condition as a dict that JSON can hold; `part` is the group to which it belongs."""
    return {
        "name": condition.name,
        "part": part,
        "channel": None if condition.channel is None else outputs[condition.channel],
        "found": condition.value,
        condition.relation.replace(" ", "_"): condition.bound,
        "margin": condition.margin,
        "holds": condition.is_met,
        "estimate": condition.is_estimate,
    }
