# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Build the cards of a flight's page: each has a claim in plain words and a command to check it."""

import math

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.linear_loop.certificate import kept_guarantee
from flight_analysis.linear_loop.guarantee import Guarantee
from flight_analysis.linear_loop.loop_margins import LoopMargins
from flight_analysis.report.display_units import format_seconds, format_value
from flight_analysis.report.flight_head import (
    gains_command,
    learned_spans,
    run_argument,
    scenario_argument,
)
from flight_analysis.report.flown_models import FlownLoops
from flight_analysis.report.margin_figures import (
    MARGIN_WORDS,
    decibels,
    found_percent,
    guarantee_text,
    proved_percent,
)
from flight_analysis.report.page import Card, Step
from flight_analysis.report.summary import RecordedFlight
from flight_analysis.report.summary_rows import stated_deviations


def claims(flight: RecordedFlight, scenario: Scenario, flown: FlownLoops) -> list[Card]:
    """Return the cards of a flight: margins, guarantee, learned models and replay."""
    cards = []
    name = scenario_argument(flight, scenario)
    if len(flown.loops) == 1:
        (single,) = flown.loops
        cards = [
            _margin_card(single.margins, gains_command("check", scenario, name)),
            _guarantee_card(
                kept_guarantee(single.loop), gains_command("guarantee", scenario, name)
            ),
        ]
    elif flown.loops:
        cards = [_changed_card(flown)]
    if flight.summary["models"]:
        cards.append(_learned_card(flight))
    if "internals" in flight.tape:
        cards.append(_replay_card(flight))
    return cards


def _margin_card(margins: LoopMargins, command: str) -> Card:
    """Return the card that says how far the loop is from instability at its worst input."""
    step = Step(sentence="Compute them again:", command=command)
    nominal = margins.nominal
    if not nominal.stable:
        return Card(title="Margins", sentences=["The linear loop is unstable."], step=step)
    worst = int(nominal.phase.argmin())
    phase = math.degrees(nominal.phase[worst])
    gain = float(decibels(nominal.gain.min()))
    gain_text = (
        "any gain" if math.isinf(gain) else f"gains off by a factor of {10 ** (gain / 20):.2g}"
    )
    return Card(
        title="Margins",
        sentences=[
            (
                f"The linear loop is stable. At its worst input, {margins.inputs[worst]}, it "
                f"withstands {phase:.0f} deg more phase lag; at any input {gain_text}."
            ),
            (
                f"If u came {1e3 * margins.delay:.0f} ms later in all inputs, it would be unstable."
                if math.isfinite(margins.delay)
                else "No delay of u makes it unstable."
            ),
        ],
        step=step,
        words=MARGIN_WORDS,
    )


def _guarantee_card(guarantee: Guarantee | None, command: str) -> Card:
    """Return the card that says what is guaranteed if the aircraft differs from its file."""
    title = "Guarantee"
    if guarantee is None:
        return Card(
            title=title,
            sentences=[
                "No guarantee has been computed for this loop, or none holds for its aircraft."
            ],
            step=Step(sentence="Compute one:", command=command),
        )
    if guarantee.stable == 0.0:
        return Card(title=title, sentences=guarantee_text(guarantee))
    late = f", and u up to {1e3 * guarantee.late:g} ms late" if guarantee.late else ""
    lags = ("lags",) if guarantee.has_exact_lags else ()
    exact = ", ".join((*guarantee.exact, *lags, "delay", "period"))
    first = guarantee.unstable
    found = (
        "No unstable aircraft was found within 99 %."
        if first is None
        else f"The first unstable aircraft that was found has entries that differ by "
        f"{found_percent(first.deviation)}."
    )
    alone = guarantee.zeros_alone
    zeros = (
        "."
        if alone is None
        else f". If these are wrong instead, and all others right, it is proved stable while each "
        f"is within {proved_percent(alone.stable)} of its row."
    )
    sentences = [
        (
            "The numbers of the aircraft's model, A and B, may be wrong: the linear loop is proved "
            f"stable for every aircraft whose entries differ by up to "
            f"{proved_percent(guarantee.stable)} from the entries of the file{late}."
        ),
        found,
        (
            f"Taken as exact are {exact}, and each entry that is 0 in the file{zeros} The proof "
            "is of small deviations, without limits of the actuators."
        ),
    ]
    step = Step(
        sentence="Write the proof, which another program checks:",
        command=f"{command} --certificate certificate.json",
    )
    if guarantee.certificate:
        sentences.append(f"Its certificate is {guarantee.certificate}.")
    return Card(title=title, sentences=sentences, step=step, words=("linear loop",))


def _changed_card(flown: FlownLoops) -> Card:
    """Return the card for a flight with several linear loops: how many of the loops are stable."""
    is_stable = [bool(each.margins.nominal.stable) for each in flown.loops]
    count = len(flown.loops)
    sentence = (
        f"All {count} linear loops of this flight are stable."
        if all(is_stable)
        else f"{is_stable.count(False)} of the {count} linear loops of this flight are unstable."
    )
    return Card(
        title="Margins",
        sentences=[
            sentence,
            "The table of margins under All figures has each. A guarantee is of one loop.",
        ],
        words=("linear loop",),
    )


def _learned_card(flight: RecordedFlight) -> Card:
    """Return the card about the models, A and B, that were learned in flight.

    The card says how many of these models were used, and how the error changed.
    """
    spans = flight.summary["models"]
    learned = learned_spans(flight)
    if not learned:
        return Card(
            title="Learned models",
            sentences=["No learned model was used: the initial law was in control to the end."],
        )
    changes = []
    for name, before in spans[0]["rms"].items():
        after = learned[-1]["rms"].get(name)
        if before is not None and after is not None:
            unit = flight.units[name]
            values = (format_value(before, unit.factor), format_value(after, unit.factor))
            changes.append(f"{name} {values[0]} to {values[1]} {unit.unit}")
    used = "models were" if len(learned) > 1 else "model was"
    start = format_seconds(learned[0]["start"])
    sentences = [f"{len(learned)} learned {used} used, the first from t = {start} on."]
    if changes:
        sentences.append(
            f"Rms error under the initial law, and under the last model: {', '.join(changes)}."
            " Commands and wind of the two differ."
        )
    stable = learned[-1].get("stable")
    if stable is not None:
        within = (
            "every aircraft whose entries are within "
            f"{stated_deviations(stable)} of their stated deviations is stable"
        )
        sentences.append(
            f"With the last model, {within if stable else 'no aircraft is proved stable'}, as long "
            f"as no limit acts (loop {learned[-1]['loop']})."
        )
    return Card(title="Learned models", sentences=sentences, words=("initial law",))


def _replay_card(flight: RecordedFlight) -> Card:
    """Return the card with the command that checks the log by computing the ticks again."""
    ticks = len(flight.tape["internals"].stamp_ns)
    return Card(
        title="Replay",
        sentences=[
            (
                f"The log has what the controller computed with in its {ticks} ticks, so that "
                "each can be computed again and compared bit by bit. This page has not done so."
            )
        ],
        step=Step(sentence="Do it:", command=f"rise-di replay {run_argument(flight)}"),
    )
