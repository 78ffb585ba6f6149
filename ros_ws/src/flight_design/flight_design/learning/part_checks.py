# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check the model of a part of the aircraft, and write sentences about the part.

A part is a group of states and inputs that does not couple with the rest. The new model of a part
is checked against the model in flight.
"""

from collections.abc import Collection, Iterable, Mapping

from aircraft_sim.airframes.airframe import Airframe
from flight_analysis.closed_loop.learning_loop import Entry
from flight_core.outcome import Refusal
from flight_design.identification.likelihood import MAX_DELAY_ERROR, PRIOR
from flight_design.identification.model_identification import Part
from flight_design.identification.model_refusals import MAX_DEVIATION, best_known
from flight_design.learning.change_test import Change

# level of the two tests of a model against the file, in standard deviations. A normal value exceeds
# it with a probability of 5 %.
LIKELIER = 1.645
# s, standard deviation of the delay. It suffices to find a host, a bridge or a servo that is 30 ms
# later than the file says.
DELAY_DEVIATION = 0.015
# s, standard deviation of the lag of a filter in front of y, such as the low-pass of a gyro. If a
# model has no lag, it takes a filter of 20 ms for a delay of u, and its effects of the inputs are
# up to 8 standard deviations too weak. A larger value, 15 ms, would widen the stated deviations of
# an aircraft without a filter more.
LAG_DEVIATION = 0.01
# standard deviation of the logarithm of an actuator's lag. With a fixed lag of 20 ms, of first
# order, the effects of servos of second order at 40 rad/s were up to 10 stated deviations off.
SERVO_DEVIATION = 0.3


def is_within(part: Iterable[str], outputs: Iterable[str]) -> bool:
    """Return whether all outputs of a part belong to the given `outputs`."""
    return set(part) <= set(outputs)


def change_sentence(change: Change) -> str:
    """Say which part of the aircraft has changed, and name its weakest input."""
    name, effectiveness = min(change.left.items(), key=lambda effect: effect[1])
    weakest = f"{name} has {100 * effectiveness:.0f} % of its effect"
    return f"{' and '.join(change.outputs)} changed, log-likelihood {change.gain:.3g}: {weakest}"


def reason_against_delays(part: Part, delay: float) -> Refusal | None:
    """Return a refusal of a part if the delay of an input is at the bound of the search, else None.

    `delay` is the known delay of the loop, s, from which the search starts.
    """
    bound = delay + MAX_DELAY_ERROR * DELAY_DEVIATION
    late = [
        name
        for name, delay in zip(part.inputs, part.delays, strict=False)
        if delay >= bound - 1e-6  # the rounding tolerance is in s
    ]
    if not late:
        return None
    return Refusal(
        f"{' and '.join(late)}: found u {1e3 * bound:.0f} ms late or later, expected less: a servo "
        "may be slower than its lag says"
    )


def is_file_better(part: Part) -> bool:
    """Return whether the nominal model predicts later samples better than the model in flight.

    If the two models are equally near to the aircraft, the result is True in at most 5 % of cases.
    """
    return part.advantage < -LIKELIER


def reason_against_first_model(part: Part, name: str, *, flies: bool) -> Refusal | None:
    """Refuse the first model of a part until it has proved itself against the airframe `name`.

    The model was chosen by the record, so only later samples can prove it. Let a difference be
    clear if two equally good models show it with a probability of at most 5 %. If the airframe
    `flies`, as one from a file does, the model must be clearly better than the airframe. If the
    airframe does not fly, as a sketch (a rough model) does not, the model is refused only if it is
    clearly worse. Returns None if the model is not refused.
    """
    limit = LIKELIER if flies else -LIKELIER
    if part.advantage == 0.0:
        return Refusal(
            f"{' and '.join(part.outputs)}: a first model, which later seconds have to prove"
        )
    if part.advantage > limit:
        return None
    return Refusal(
        f"{' and '.join(part.outputs)}: found an advantage over the airframe {name} of "
        f"{part.advantage:.2g} standard deviations in the seconds since the previous model, "
        f"expected more than {limit:g}"
    )


def return_to_file(part: Part, name: str | None) -> str:
    """Say which model or law a part uses now, because the model in flight predicted worse.

    The model of the airframe file has predicted better. The part uses the airframe `name`. If
    `name` is None, it uses the law with which the flight started.
    """
    used = "the initial law" if name is None else f"the airframe {name} as it is"
    return f"{' and '.join(part.outputs)} by {used}: {_file_advantage(part)}"


def _file_advantage(part: Part) -> str:
    return f"the file predicts later seconds better, by {-part.advantage:.2g} standard deviations"


def entries_of_file(part: Part) -> tuple[Entry, ...]:
    """Return the entries of a part with the values of the airframe file."""
    return tuple(entry._replace(error=0.0) for entry in part.entries)


def reason_against_part_alone(part: Part, known: Iterable[tuple[str, ...]]) -> Refusal | None:
    """Return a refusal of a separate model of a part that is coupled in the model in flight.

    Returns None if the model in flight does not couple the part with another one.
    """
    if not any(is_within(part.outputs, outputs) for outputs in known if outputs != part.outputs):
        return None
    return Refusal(
        f"{' and '.join(part.outputs)}: found no model with coupling, expected one, like the model "
        "in use"
    )


def forgotten_coupling(part: Part) -> str:
    """Say why the model that couples two parts is not used any more."""
    return f"no coupling any more: {_file_advantage(part)}"


def reason_against_effects(part: Part, flown: Airframe | None) -> Refusal | None:
    """Return a refusal if gusts have made an identified effect too weak, else None.

    An effect is too weak if it is below the effect in the flown model by more than the fraction
    MAX_DEVIATION. Gusts hide the effects of the inputs. The gains of a design with too weak effects
    would be too high.
    """
    if flown is None or not part.has_gusts:
        return None
    for entry in best_known(part.entries, part.outputs):
        share = (
            entry.value
            / flown.matrix_b()[flown.index(entry.row), list(flown.inputs).index(entry.column)]
        )
        if share < 1.0 - MAX_DEVIATION:
            return Refusal(
                f"{entry.name}: found {100 * share:.0f} % of the effect in the model in use, "
                f"expected {100 * (1.0 - MAX_DEVIATION):g} % or more beside gusts, which hide "
                "effects"
            )
    return None


def effect_sentence(part: Part) -> str:
    """Say which effects of the inputs on the outputs the flight has shown.

    Each effect is given relative to the same effect in the rough airframe, with its standard
    deviation.
    """
    effects = (entry for entry in part.entries if entry.matrix == "B" and entry.row in part.outputs)
    known = (entry for entry in effects if entry.nominal and entry.deviation < PRIOR / 2.0)
    text = ", ".join(
        f"{entry.name} {100 * entry.error:+.0f} +- {100 * entry.deviation:.0f} %" for entry in known
    )
    return text if all(entry.nominal for entry in part.entries) else f"{text}, with coupling"


def without_effect(
    left: Mapping[tuple[str, ...], str | None], by_law: Collection[str]
) -> list[str]:
    """Say which parts do without an input, and which outputs the initial law controls.

    `left` is as in `designs.by_law_of_start`, and `by_law` has the outputs that this law controls.
    """
    told = []
    for part, dead in left.items():
        outputs = [output for output in part if output in by_law]
        which = "" if len(outputs) == len(part) else f"{' and '.join(outputs)} "
        if dead is not None:
            flown = f"{' and '.join(part)} without it, {which}by the initial law"
            told.append(f"{dead} has no effect: {flown}")
    return told
