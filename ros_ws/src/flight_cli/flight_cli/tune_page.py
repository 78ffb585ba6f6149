# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Show the results of `rise-di tune`: the aircraft, the controllers, and what to do next."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from rich.console import Console

from aircraft_sim.uncertainty import Spread
from flight_analysis.linear_loop.guarantee import Guarantee
from flight_analysis.linear_loop.loop_margins import LoopMargins, margins
from flight_analysis.report.margin_figures import margin_table
from flight_analysis.report.page import Figures, Page, TableGroup
from flight_analysis.report.summary_rows import Column
from flight_analysis.report.tables import MetricTable
from flight_cli.output import entry_table, new_table, print_table, say
from flight_cli.tune_candidates import (
    FORMER,
    LEAST,
    SAMPLES,
    Candidate,
    Selectors,
    rms_of_own_loop,
)
from flight_core.vectors import FloatArray
from flight_design.identification.model_identification import Identification
from flight_design.identification.own_loop import OwnLoop

OWN = "the autopilot's own loop"
CHOSEN = "the module"
STEPS = {
    "px4": (
        (
            "To fly it: copy this folder to one path that you keep, build PX4 with "
            "EXTERNAL_MODULES_LOCATION as that path, start the lines of extras.txt, fly level, set "
            "RDI_EN to 1. With the same path the next module compiles three files."
        ),
        (
            "To go back: RDI_EN 0, or the input of RDI_AUX. To fly without the module: remove "
            "extras.txt."
        ),
        (
            "Then: log the doublets with logger_topics.txt in etc/logging, and tune again with "
            "scenario.yaml of this folder."
        ),
    ),
    "ardupilot": (
        (
            "To fly it: copy ArduPlane/ over that folder of ArduPilot, add the lines of hooks.txt, "
            "set RCx_OPTION of a free channel to 300, fly level, turn the switch on."
        ),
        "To go back: turn the switch off.",
        "Then: log the doublets, and tune again with scenario.yaml of this folder.",
    ),
}


class OwnFlight(NamedTuple):
    """A simulated flight of the autopilot's loop on the identified aircraft."""

    loop: OwnLoop
    rms: Mapping[str, FloatArray]  # rms of y - y_m by air, (m,)
    margins: LoopMargins

    @classmethod
    def of(cls, loop: OwnLoop, selectors: Selectors) -> "OwnFlight":
        """Simulate the autopilot's loop in the airs in which the candidates fly."""
        flight = selectors.flight
        return cls(
            loop=loop,
            rms=rms_of_own_loop(loop, selectors),
            margins=margins(
                loop.in_place(flight), SAMPLES, LEAST, spread=Spread(selectors.entries)
            ),
        )


class Tuned(NamedTuple):
    """The results of the steps of a tuning."""

    identification: Identification
    best: Candidate
    candidates: Sequence[Candidate]  # the first has the gains of the scenario
    guarantee: Guarantee
    margins: LoopMargins  # margins of the best candidate
    own: OwnFlight | None  # None if the log lacks the autopilot's parameters


def error_rows(tuned: Tuned) -> list[list[str]]:
    """Return a table row for each controller in each kind of air: name and rms errors, mrad/s."""
    loops = [(each.name, each.rms, each is tuned.best) for each in tuned.candidates]
    if tuned.own is not None:
        loops.append((OWN, tuned.own.rms, False))
    rows = []
    for air in tuned.best.rms:
        for name, rms, is_best in loops:
            mark = f", {CHOSEN}" if is_best else ""
            cells = [f"{1e3 * value:.1f}" for value in rms[air].tolist()]
            rows.append([f"{air}: {name}{mark}", *cells])
    return rows


def verdict(tuned: Tuned) -> list[str]:
    """Return sentences on which controller became the module, and why a better one did not."""
    best, former = tuned.best, tuned.candidates[0]
    ratio = f"{best.score / former.score:.2g} times the error"
    if best is former:
        sentences = [f"{CHOSEN}: {FORMER}: nothing that was selected has less error"]
    else:
        sentences = [f"{CHOSEN}: {best.name}, {ratio} of the controller of the scenario"]
    sentences += [
        f"{each.name} has less error, but not the margins: {each.shortfall}; --accept takes it"
        for each in tuned.candidates
        if each.score < best.score
    ]
    if best.origin:
        sentences.append(best.origin)
    if best.shortfall:
        sentences.append(f"accepted although its margins fall short: {best.shortfall}")
    return sentences


def guaranteed(guarantee: Guarantee) -> str:
    """Return a sentence on how many standard deviations of A and B the guarantee covers."""
    holds = "every aircraft is stable" if guarantee.is_proved else "an aircraft may be unstable"
    # Rounded down, because more is not proved.
    covered = math.floor(20.0 * guarantee.stable / guarantee.uncertainty) / 10.0
    return (
        f"A and B within twice their stated deviations: {holds} by the guarantee, which covers "
        f"{covered:g} of them"
    )


def show_tuning(console: Console, tuned: Tuned) -> None:
    """Print the identified model, the predicted errors, and the guarantee."""
    identification = tuned.identification
    title = f"A and B of {identification.airframe.name}"
    print_table(console, entry_table(title, identification.entries))
    outputs = tuned.best.scenario.controller.outputs
    table = new_table(
        "\nPredicted rms of the error along the commands, mrad/s", ("controller", *outputs)
    )
    for row in error_rows(tuned):
        table.add_row(*row)
    print_table(console, table)
    certificate = tuned.guarantee.certificate
    for sentence in (*verdict(tuned), guaranteed(tuned.guarantee)):
        say(console, sentence)
    if certificate:
        say(console, f"certificate {certificate}")


def tuning_page(tuned: Tuned, log: str, autopilot: str) -> Page:
    """Return the page with model, predictions, guarantee, and the pilot's next steps."""
    identification = tuned.identification
    entries = MetricTable(
        f"Identified from {log}",
        [
            Column(group="nominal", head="SI"),
            Column(group="identified", head="SI"),
            Column(group="deviation", head="%"),
        ],
        [
            [
                entry.name,
                f"{entry.nominal:.4g}",
                f"{entry.value:.4g}",
                f"{100 * entry.deviation:.1f}",
            ]
            for entry in identification.entries
        ],
        "deviation: standard deviation of the change. It counts innovations that are not white, "
        "parts of the log that differ, and that u may act at any instant between two samples",
    )
    own = "no parameters of it in the log" if tuned.own is None else tuned.own.loop.source
    errors = MetricTable(
        "Predicted rms of the error along the commands of the scenario",
        [Column(group=name, head="mrad/s") for name in tuned.best.scenario.controller.outputs],
        error_rows(tuned),
        "with the noise of the log's gyro; gusts: a wind of 5 m/s near the ground, "
        "and air that rolls with 0.5 rad/s rms. "
        f"{'. '.join(verdict(tuned))}. The autopilot's own loop: {own}",
    )
    law = margin_table(tuned.margins, tuned.guarantee)
    tables = [entries, errors, law._replace(caption="Margins of the module")]
    if tuned.own is not None:
        own_margins = margin_table(tuned.own.margins)
        tables.append(own_margins._replace(caption="Margins of the own loop"))
    return Page(
        title=f"Tuning of {identification.airframe.name} from {log}",
        lines=[guaranteed(tuned.guarantee), *STEPS[autopilot]],
        blocks=[Figures(groups=[TableGroup(tables)])],
    )
