# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The model of a part beside what flies: reasons against the model, and sentences about it."""

from collections.abc import Iterable, Mapping

import numpy as np

from aircraft_sim.airframes.airframe import Airframe
from flight_analysis.closed_loop.learning_loop import Entry
from flight_design.identification.likelihood import MAX_DELAY_ERROR, PRIOR
from flight_design.identification.model_identification import Part
from flight_design.identification.model_quality import MAX_DEVIATION, MAX_WHITENESS, best_known
from flight_design.learning.change_test import Change

# standard deviations of a normal distribution, passed with 5 %: the level of either test of a model
# against the file
LIKELIER = 1.645
# s: a host, a bridge or a servo that is 30 ms later than the file says is found
DELAY_DEVIATION = 0.015


def is_within(part: Iterable[str], outputs: Iterable[str]) -> bool:
    """Whether the outputs of a part are among those of another."""
    return set(part) <= set(outputs)


def change_sentence(change: Change) -> str:
    """The part that has changed, and its weakest input."""
    name, effectiveness = min(change.left.items(), key=lambda effect: effect[1])
    weakest = f"{name} has {100 * effectiveness:.0f} % of its effect"
    return f"{' and '.join(change.outputs)} changed, log-likelihood {change.gain:.3g}: {weakest}"


def not_white(part: Part) -> str:
    """The output with the least white innovations, if above MAX_WHITENESS."""
    worst = int(np.argmax(part.after.whiteness))
    white = float(part.after.whiteness[worst])
    if white <= MAX_WHITENESS:
        return ""
    name = part.outputs[worst]
    return (
        f"innovations of {name}: found a whiteness of {white:.3g}, expected at most "
        f"{MAX_WHITENESS:g}, 1 being white"
    )


def too_late(part: Part, delay: float) -> str:
    """The refusal of a part whose inputs are as late as the search goes.

    The search goes on from the known `delay` of the loop, s.
    """
    bound = delay + MAX_DELAY_ERROR * DELAY_DEVIATION
    late = [
        name
        for name, delay in zip(part.inputs, part.delays, strict=False)
        if delay >= bound - 1e-6  # s, of rounding
    ]
    if not late:
        return ""
    return (
        f"{' and '.join(late)}: found u {1e3 * bound:.0f} ms late or later, expected less: a servo "
        "may be slower than its lag says"
    )


def is_file_better(part: Part) -> bool:
    """Whether the nominal model predicts later samples better than the one that flies.

    The probability of that is at most 5 % where both are as near to the aircraft.
    """
    return part.advantage < -LIKELIER


def unproven(part: Part, name: str, *, flies: bool) -> str:
    """The refusal of a first model beside the airframe of a name.

    The model before was chosen on the record up to then, and later samples count. A file that
    `flies` needs an advantage over it, with a probability of at most 5 % where both are as near to
    the aircraft. A sketch does not fly, and no such disadvantage is enough.
    """
    limit = LIKELIER if flies else -LIKELIER
    if part.advantage == 0.0:
        return f"{' and '.join(part.outputs)}: a first model, which later seconds have to prove"
    if part.advantage > limit:
        return ""
    return (
        f"{' and '.join(part.outputs)}: found an advantage over the airframe {name} of "
        f"{part.advantage:.2g} standard deviations in the seconds since the model before, "
        f"expected more than {limit:g}"
    )


def return_to_file(part: Part, name: str) -> str:
    """What flies where the airframe file predicts better than the model that flew.

    That is the airframe of a name, or the law of the start.
    """
    flies = f"the airframe {name} as it is" if name else "the law of the start"
    return f"{' and '.join(part.outputs)} by {flies}: {_file_advantage(part)}"


def _file_advantage(part: Part) -> str:
    return f"the file predicts later seconds better, by {-part.advantage:.2g} standard deviations"


def entries_of_file(part: Part) -> tuple[Entry, ...]:
    """The entries of a part as in the airframe file."""
    return tuple(entry._replace(error=0.0) for entry in part.entries)


def uncoupled(part: Part, known: Iterable[tuple[str, ...]]) -> str:
    """The refusal of a part alone where the flown model couples it with another; else empty."""
    if not any(is_within(part.outputs, outputs) for outputs in known if outputs != part.outputs):
        return ""
    return (
        f"{' and '.join(part.outputs)}: found no model with coupling, expected one, as that "
        "which flies"
    )


def forgotten_coupling(part: Part) -> str:
    """Why a model with coupling is forgotten."""
    return f"no coupling any more: {_file_advantage(part)}"


def weaker(part: Part, flown: Airframe | None) -> str:
    """The effect that a record of gusts has weaker than the model that flies, by MAX_DEVIATION.

    Gusts hide what the inputs do: the effects come out too weak, a design with them too strong.
    """
    if flown is None or not part.gusts:
        return ""
    for entry in best_known(part.entries, part.outputs):
        share = (
            entry.value
            / flown.matrix_b()[flown.index(entry.row), list(flown.inputs).index(entry.column)]
        )
        if share < 1.0 - MAX_DEVIATION:
            return (
                f"{entry.name}: found {100 * share:.0f} % of that of the model that flies, expected"
                f" {100 * (1.0 - MAX_DEVIATION):g} % or more beside gusts, which hide effects"
            )
    return ""


def effect_sentence(part: Part) -> str:
    """The effects of inputs on outputs that the flight shows.

    They are relative to the rough airframe, with deviations.
    """
    effects = (entry for entry in part.entries if entry.matrix == "B" and entry.row in part.outputs)
    known = (entry for entry in effects if entry.nominal and entry.deviation < PRIOR / 2.0)
    text = ", ".join(
        f"{entry.name} {100 * entry.error:+.0f} +- {100 * entry.deviation:.0f} %" for entry in known
    )
    return text if all(entry.nominal for entry in part.entries) else f"{text}, with coupling"


def without_effect(dead: Mapping[tuple[str, ...], str]) -> list[str]:
    """The sentences about parts that fly without an input."""
    return [
        f"{name} has no effect: {' and '.join(part)} without it, by the law of the start"
        for part, name in dead.items()
        if name
    ]
