# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Show gain sets with their margins and conditions, as tables or as JSON."""

import math
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flight_analysis.linear_loop.guarantee import Guarantee
from flight_analysis.linear_loop.saturation import LimitGuarantee
from flight_analysis.report.display_units import display_unit
from flight_analysis.report.glossary import legend
from flight_analysis.report.margin_figures import (
    MARGIN_COLUMNS,
    MARGIN_WORDS,
    margin_rows,
    margins_as_json,
    modes_text,
)
from flight_campaign.statistics import SCORE_UNIT, score_units
from flight_cli.gains_guarantee import show_guarantee
from flight_cli.gains_verdicts import (
    HEADINGS,
    VERDICTS,
    condition_as_json,
    condition_cells,
    condition_name,
    milliseconds,
)
from flight_cli.output import (
    new_table,
    print_table,
    say,
)
from flight_core.units import quantity
from flight_design.gains import gain_selection, gain_yaml
from flight_design.gains.airframe_properties import airframe_facts, marginal_sentence
from flight_design.gains.gain_selection import GainAssessment, Selection
from flight_design.gains.ideal_control import Study
from flight_design.gains.trade import trade
from rise_di_controller.params import ControllerConfig

MEANINGS = {
    "lag product": "crossover lag product, bandwidth times the lag of the loop (actuator, 1.5 "
    "periods, delay), rad: times 57.3 it is the phase in deg that the lag costs at the crossover",
    "softening": "width of the softened sign as a time, compared with the lag of the loop: if it "
    "is narrower, the loop is unstable",
    "beta": "for inputs scaled by 1 / abs(Omega_ii) in every table; a file has a smaller scale "
    "if (22) asks for a larger K",
}
"""Terms of the table and their meaning."""
Assessment = GainAssessment[Any]


class GainSets(NamedTuple):
    """Gain sets by name with their conditions, which were checked or selected."""

    answers: dict[str, Assessment]
    selection: Selection | None = None
    checked: str = ""  # name of the scenario that was checked, if any
    guarantee: Guarantee | None = None
    limited: LimitGuarantee | None = None

    @property
    def titles(self) -> dict[str, Assessment]:
        """Gain sets by the names under which they are printed.

        A gain set that was checked has the name of its scenario.
        """
        return {self.checked: self.first} if self.checked else self.answers

    @property
    def first(self) -> Assessment:
        """The first gain set. After a check there is only this one."""
        return next(iter(self.answers.values()))

    @property
    def last(self) -> Assessment:
        """The last gain set. After a selection, it comes from the engineering procedure."""
        return [*self.answers.values()][-1]

    @property
    def study(self) -> Study:
        """The study, with aircraft and loop, in which the gain sets were assessed."""
        return self.first.study


def show_gains(console: Console, sets: GainSets) -> None:
    """Print gains, margins, guarantee and verdicts, and for a selection its trade-off."""
    _show_margins(console, sets.study, sets.titles)
    show_guarantee(console, sets.guarantee, sets.first)
    _show_verdicts(console, sets)
    selection = sets.selection
    if (
        selection is not None
        and "engineering" in sets.answers
        and selection.engineering.has_requirement
    ):
        _show_trade(console, selection)


def _show_trade(console: Console, selection: Selection) -> None:
    """Print how the linear loop's error in the manoeuvre trades against the phase margin."""
    controller = selection.chosen
    frame = selection.study.airframe
    outputs = controller.outputs
    output_units = frame.units_of_outputs()
    unit_texts = [display_unit(output_units[name]) for name in outputs]
    # An altitude has no unit in the score.
    have_scores = all(quantity(unit).dimension in SCORE_UNIT for unit in output_units.values())
    units = score_units(outputs, output_units) if have_scores else np.full(len(outputs), np.nan)
    headings = (f"{name},\n{unit.unit}" for name, unit in zip(outputs, unit_texts, strict=True))
    heads = ["phase margin,\ndeg", "least\nfound", "delay\nmargin", *headings, "score"]
    table = new_table(
        "\nTrade: rms of the error of the linear loop along the manoeuvre", heads, left_aligned=()
    )
    for row in trade(selection):
        errors = (
            f"{rms * unit.factor:.3g}"
            for rms, unit in zip(row.rms.tolist(), unit_texts, strict=True)
        )
        margins = f"{row.phase_margin:g}", f"{row.reached:.0f}", milliseconds(row.delay_margin)
        table.add_row(*margins, *errors, f"{float(np.sum(row.rms / units)):.2f}")
    print_table(console, table)


def _show_margins(console: Console, study: Study, answers: dict[str, Assessment]) -> None:
    """Print the gains and the margins."""
    first = next(iter(answers.values()))
    samples = len(study.A) - 1
    parts = {"A and B": study.uncertainty, **study.spread.entries}
    box = ", ".join(f"{name} +-{100 * part:g} %" for name, part in parts.items())
    aircraft = f"{study.airframe.name}, {escape(box)} ({samples} samples)"
    print_table(
        console,
        _gain_table(answers, aircraft) if first.theorem else _own_gains(first.controller, aircraft),
    )
    for name, answer in answers.items():
        if answer.margins is not None and answer.margins.nominal.stable:
            heads = ("input", *(f"{column.group}\n{column.head}" for column in MARGIN_COLUMNS))
            table = new_table(
                f"\nMargins, {name}: nominal (worst found in the box)",
                heads,
                left_aligned=("input",),
            )
            for row in margin_rows(answer.margins):
                table.add_row(*row)
            print_table(console, table)
            say(console, modes_text(answer.margins))
        say(console, f"{name}: {_format_delay_margin(study, answer)}")
    say(console, legend(MARGIN_WORDS), style="dim")


def _show_verdicts(console: Console, sets: GainSets) -> None:
    """Print each part of the conditions with a verdict. The verdict on the loop decides."""
    answers = sets.titles
    first = sets.first
    for part, heading in HEADINGS.items():
        if getattr(first, part):
            print_table(console, _condition_table(answers, part, heading))
        for name, answer in answers.items():
            verdict = VERDICTS[part](answer, sets.guarantee)
            if verdict.sentence:
                say(console, f"{name}: {verdict.sentence}", "bold" if part == "loop" else "")
    if first.theorem and (marginal := marginal_sentence([airframe_facts(first.study.airframe)])):
        say(console, marginal)
    if first.bounds is None:
        estimate = ""
    else:
        estimate = f"; ~ is an estimate: gamma_2 = {first.bounds.gamma_2[0]:g} 1/s is an assumption"
    say(console, f"margin: a condition holds above 1 and fails (!) below{estimate}", style="dim")
    for word, meaning in MEANINGS.items() if first.bounds is not None else ():
        say(console, f"{word}: {meaning}", style="dim")


def _condition_table(answers: dict[str, Assessment], part: str, title: str) -> Table:
    """Return a table of the conditions of a part, with one condition in each row."""
    headings = ["condition"]
    for name in answers:
        headings += [f"{name}\nvalue and bound", "\nmargin"]
    table = new_table(f"\n{title}", headings, left_aligned=("condition",), wrapped=("condition",))
    outputs = next(iter(answers.values())).controller.outputs
    for conditions in zip(*(getattr(answer, part) for answer in answers.values()), strict=True):
        cells = chain.from_iterable(map(condition_cells, conditions))
        table.add_row(condition_name(conditions, outputs), *cells)
    return table


def _gain_table(answers: dict[str, Assessment], aircraft: str) -> Table:
    """Return a table of K, Lambda and beta of RISE-DI, with one channel in each row."""
    headings = []
    for name in answers:
        headings += [f"{name}\nK", "\nLambda", "\nbeta"]
    title = (
        f"Gains for {aircraft}; K, Lambda in 1/s, beta in units of y / s^2, for inputs "
        "scaled by 1 / abs(Omega_ii)"
    )
    table = new_table(title, ["channel", "D", *headings], left_aligned=("channel",))
    # all gain sets have the same channels and D
    controller = next(iter(answers.values())).controller
    for i, (output, name) in enumerate(zip(controller.outputs, controller.inputs, strict=True)):
        row = [f"{output} by {name}", f"{controller.D[i]:+d}"]
        for answer in answers.values():
            params = answer.controller.law_params()
            response = gain_selection.response(answer.study, answer.controller)[i]
            row += [
                f"{params.K[i] * response:.4g}",
                f"{params.Lambda[i]:.3g}",
                f"{params.beta[i] * response:.4g}",
            ]
        table.add_row(*row)
    return table


def _own_gains(controller: ControllerConfig, aircraft: str) -> Table:
    """Return a table of the parameters of a law other than RISE-DI."""
    table = new_table(
        f"Law {controller.law} for {aircraft}",
        ("parameter", "value"),
        left_aligned=("parameter", "value"),
        wrapped=("value",),
    )
    for name in type(controller).model_fields:
        if name not in ControllerConfig.model_fields:
            table.add_row(name, gain_yaml.yaml_flow(getattr(controller, name), 4))
    return table


def _format_delay_margin(study: Study, answer: Assessment) -> str:
    if answer.delay_margin is None:
        return "no linear loop (literal sign)"
    if answer.delay_margin == 0.0:
        return "predicted delay margin none: the linear loop is unstable with this lag"
    each = zip(answer.controller.outputs, answer.channel_margins, strict=True)
    single_margins = ", ".join(f"{output} {milliseconds(margin)}" for output, margin in each)
    margin = (
        f"predicted delay margin {milliseconds(answer.delay_margin)}; in one channel "
        f"alone: {single_margins}"
    )
    return f"{margin}; {speed_of_margin(study, answer)}"


def speed_of_margin(study: Study, answer: Assessment) -> str:
    """Return a sentence on the speed up to which the delay margin of fixed gains is positive."""
    if study.airframe.speed == 0.0:
        return "the airframe has no trim speed"
    ratio = gain_selection.stable_speed_ratio(study, answer.controller)
    if math.isinf(ratio):
        return f"it lasts beyond {gain_selection.MAX_SPEED_RATIO:g} times the trim speed"
    return (
        f"it lasts up to {ratio * study.airframe.speed:.3g} m/s, {ratio:.3g} of the trim "
        "speed, without a schedule"
    )


def _stable_speed_ratio(study: Study, answer: Assessment) -> float | None:
    """Return the multiple of the trim speed up to which the loop is stable.

    Returns None if there is no limit, or if the literal sign has no linear loop.
    """
    if answer.delay_margin is None:
        return None
    ratio = gain_selection.stable_speed_ratio(study, answer.controller)
    return ratio if math.isfinite(ratio) else None


def gains_as_json(sets: GainSets, seed: int) -> dict[str, Any]:
    """Return study, gain sets with conditions, and guarantee as a dict that JSON can hold."""
    study = sets.study
    guarantee = sets.guarantee
    inputs = list(study.airframe.inputs)
    return {
        "airframe": study.airframe.name,
        "uncertainty": study.uncertainty,
        "entries": dict(study.spread.entries),
        "samples": len(study.A) - 1,
        "seed": seed,
        "slew": dict(zip(inputs, study.slew.tolist(), strict=True)),
        "slew_calm": dict(zip(inputs, study.slew_undisturbed.tolist(), strict=True)),
        "checked": sets.checked or None,
        **{
            name: _assessment_as_json(study, answer, guarantee)
            for name, answer in sets.answers.items()
        },
        **({} if guarantee is None else {"guarantee": guarantee.as_json()}),
        **({} if sets.limited is None else {"saturation": sets.limited.as_json()}),
    }


def _assessment_as_json(
    study: Study, answer: Assessment, guarantee: Guarantee | None
) -> dict[str, Any]:
    outputs = answer.controller.outputs
    bounds = None
    if answer.bounds is not None:
        bounds = {key: getattr(answer.bounds, key).tolist() for key in ("U", "N_d", "gamma_2")} | {
            "rho": answer.bounds.rho
        }
    conditions = [
        condition_as_json(part, condition, outputs)
        for part in HEADINGS
        for condition in getattr(answer, part)
    ]
    verdicts = {part: verdict(answer, guarantee) for part, verdict in VERDICTS.items()}
    return {
        "verdicts": {
            part: {"holds": verdict.is_met, "sentence": verdict.sentence}
            for part, verdict in verdicts.items()
            if verdict.sentence
        },
        "controller": answer.controller.model_dump(exclude_none=True),
        "delay_margin": answer.delay_margin,
        "channel_margins": answer.channel_margins,
        "stable_speed_ratio": _stable_speed_ratio(study, answer),
        "margins": None if answer.margins is None else margins_as_json(answer.margins),
        "bounds": bounds,
        "conditions": conditions,
        "differences": study.differences,
    }
