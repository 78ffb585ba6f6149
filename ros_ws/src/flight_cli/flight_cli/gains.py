# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di gains`: select gains by Theorem 1 and by the procedure, or check those of a scenario."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from aircraft_sim.airframes.airframe import airframes
from flight_analysis.closed_loop.scenario_library import scenarios
from flight_analysis.linear_loop.guarantee import Guarantee
from flight_analysis.report.display_units import display_unit
from flight_analysis.report.html import write_loop_page
from flight_analysis.report.margin_figures import (
    MARGIN_COLUMNS,
    MARGIN_LEGEND,
    margin_rows,
    margins_as_json,
    modes_text,
)
from flight_campaign.statistics import SCORE_UNIT, score_units
from flight_cli.gains_guarantee import (
    proved,
    require_guarantee,
    show_guarantee,
    write_certificate,
    write_unstable,
)
from flight_cli.gains_verdicts import (
    HEADINGS,
    VERDICTS,
    condition_as_json,
    condition_cells,
    condition_name,
    loop_verdict,
    milliseconds,
)
from flight_cli.output import (
    LICENCE,
    named_numbers,
    new_table,
    parse_lags,
    parse_numbers,
    print_json,
    print_table,
    say,
    write_text,
)
from flight_cli.words import (
    REQUIRED,
    airframe_names,
    argument,
    json_option,
    option,
    rare_option,
    require_unused,
    scenario_names,
    values_of,
    write_option,
)
from flight_core.files import display_path, writing
from flight_core.parameters import ParameterError, require
from flight_core.units import quantity
from flight_design.gains import gain_selection, gain_yaml
from flight_design.gains.airframe_properties import airframe_facts, marginal_sentence
from flight_design.gains.gain_design import check_gains, select_gains
from flight_design.gains.gain_selection import GainAssessment, Selection
from flight_design.gains.ideal_control import Study
from flight_design.gains.relaxation import lacking
from flight_design.gains.requirement import PHASE_MARGIN
from flight_design.gains.trade import trade
from flight_log.px4_parameters import rate_loop
from rise_di_controller.params import ControllerConfig

CONDITION_FAILS = 1
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
LOOP = ("rate", "y_rate", "lag", "delay", "inputs")
STUDY = ("uncertainty", "gamma_2", "samples", "seed")
SELECTION = (
    "rate",
    "y_rate",
    "delay",
    "feedforward",
    "observer",
    "model",
    "margin",
    "weights",
    "phase_margin",
    "accept",
    "mixing",
)
"""Options that describe a loop, options of a check, and options of a selection."""


class _GainsAnswer(NamedTuple):
    """Gain sets by name with their conditions: one that was checked, or a selection."""

    answers: dict[str, Assessment]
    selection: Selection | None = None
    checked: str = ""  # name of the scenario that was checked
    promise: Guarantee | None = None
    written: Sequence[str] = ()  # sentences about the files of a guarantee

    @property
    def titles(self) -> dict[str, Assessment]:
        """Gain sets by the names that are shown; that of a check has the scenario's name."""
        return {self.checked: self.first} if self.checked else self.answers

    @property
    def first(self) -> Assessment:
        return next(iter(self.answers.values()))

    @property
    def last(self) -> Assessment:
        return [*self.answers.values()][-1]

    @property
    def study(self) -> Study:
        return self.first.study


@dataclass(frozen=True, kw_only=True)
class Gains:
    """Select gains by Theorem 1 and by the engineering procedure, or check the gains of a scenario.

    Every condition on both gain sets is shown. With --check, the margins and the conditions are
    those of the scenario's controller, of any law, with its own gains. The exit status then follows
    the verdict on the loop, because the conditions of Theorem 1 are only sufficient.

    Exit status: 0; 1 with --check unless the loop is stable with the margins that it needs, or with
    --guarantee if an aircraft within --uncertainty may be unstable; 2 bad input.
    """

    airframe: str = argument(
        "Name or file (.yaml) of an airframe; with --check also jsbsim:NAME as in the scenario.",
        default=REQUIRED,
        autocompletion=airframe_names,
    )
    uncertainty: float = option("Largest relative deviation of each entry of A and B.", default=0.3)
    scenario: str = option(
        "Scenario with the commands, the gusts and the loop; with --check also a file of --write.",
        default="osprey_servo",
        autocompletion=scenario_names,
    )
    rate: float | None = rare_option("Rate of the law, Hz; by default that of the scenario.")
    y_rate: float | None = rare_option(
        "Rate of y, Hz. If its period is longer than that of the law, the difference counts as "
        "delay. y is stale after three periods."
    )
    lag: str | None = option("Lags of the actuators in s, in the airframe's order: 0.02,0.1.")
    delay: float | None = option("Pure delay, s; by default that of the scenario.")
    px4: Path | None = rare_option(
        "Parameter file of QGroundControl or ULog of PX4, which gives the rate and the delay of "
        "the body rates for a module of export --px4."
    )
    inputs: str | None = rare_option(
        "Input that moves each output, in the order of the airframe, as in rudder,aileron."
    )
    gamma_2: float = rare_option(
        "gamma_2 of Lemma 1, 1/s. It is an assumption: nothing bounds it.", default=0.0
    )
    samples: int = rare_option(
        "Uncertain airframes for the bounds of the theorem.", default=100, min=0, max=10_000
    )
    seed: int = rare_option("Seed of the uncertain airframes.", default=1, min=0)
    write: Path | None = write_option("File for the engineering gains, as a section of a scenario.")
    feedforward: bool = rare_option(
        "Also write the airframe, as the model of the feedforward (an extension).", default=False
    )
    observer: bool = option(
        "Write a feedforward, an observer, and gains for them (an extension).", default=False
    )
    model: str | None = rare_option(
        "Airframe that is the model of the observer, as rise-di identify RUN writes it."
    )
    margin: float = rare_option(
        "Least delay margin that the nominal loop with the observer must have, s.", default=0.03
    )
    speeds: str | None = rare_option(
        "With --observer: also models at two fractions of the trim speed, as in 0.7,1.4, and a "
        "schedule between them."
    )
    weights: Path | None = rare_option(
        "With --observer: file of gains and weights in place of those that a search or a rule "
        "finds; with accept they are taken as they are."
    )
    phase_margin: float = rare_option(
        "Least phase margin of the loop with its servos, deg; 35 or less with the observer.",
        default=PHASE_MARGIN,
    )
    theorem: bool = rare_option(
        "With --write: the gains of Theorem 1, for an ideal loop: --lag 0 --delay 0.", default=False
    )
    mixing: str = rare_option(
        "diagonal: one input for each output; full: the inverse of C B distributes the inputs.",
        default="diagonal",
    )
    accept: bool = rare_option(
        "Accept a phase margin below 40 deg, and write gains whose margins fall short.",
        default=False,
    )
    check: bool = option(
        "Check the gain set of the scenario instead of selecting one.", default=False
    )
    entry: list[str] | None = rare_option(
        "With --check: an entry with a deviation of its own, 'A[q,alpha]=0.6', or of an actuator "
        "'1/lag[elevator]=0.3'; may be repeated."
    )
    page: Path | None = rare_option(
        "HTML file for margins, Bode and Nyquist plots of the engineering gains, or with --check."
    )
    guaranteed: bool = option(
        "With --check: bound what holds for every aircraft within --uncertainty.",
        "--guarantee",
        default=False,
    )
    worst: Path | None = rare_option(
        "With --guarantee: folder for the first unstable aircraft and one 1.2 times as far off."
    )
    late: float = rare_option(
        "With --guarantee: largest time by which u is late, s. It may differ at each tick and in "
        "each input.",
        default=0.0,
    )
    certificate: Path | None = rare_option(
        "With --guarantee: file for its proof (JSON), which examples/check_certificate.py checks "
        "with nothing but numpy."
    )
    as_json: bool = json_option()

    def execute(self) -> None:
        """Select or check gains, write them, and show them."""
        is_scenario = self.airframe in set(scenarios()) - set(airframes())
        require(
            not is_scenario,
            "airframe",
            f"the scenario {self.airframe!r}",
            f"the airframe that it flies, with `--scenario {self.airframe}` beside it",
        )
        require(
            not self.theorem or (self.write is not None and not self.observer),
            "theorem",
            "no --write, or --observer beside it",
            "--write beside it, without --observer",
        )
        require_guarantee(
            check=self.check,
            is_wanted=self.guaranteed,
            airframe=self.airframe,
            scenario=self.scenario,
            late=self.late,
            entries=self.entry or (),
            files={"worst": self.worst, "certificate": self.certificate},
        )
        rate, delay, origin = _loop_of_px4(self.px4, self.rate, self.delay)
        result = replace(self, rate=rate, delay=delay)._result()
        if self.page is not None:
            _write_page(self.page, result.last)
        if self.as_json:
            print_json(_as_json(result, self.seed))
        else:
            self._show(Console(), result, origin)
        if self.check and not loop_verdict(result.first, result.promise).holds:
            raise typer.Exit(CONDITION_FAILS)

    def _result(self) -> _GainsAnswer:
        """Return the gain sets with all conditions, and write them if they were selected."""
        with Console(quiet=self.as_json).status("selecting gains on uncertain airframes") as status:
            if self.check:
                return self._checked(status.update)
            return self._selected(status.update)

    def _checked(self, progress: Callable[[str], None]) -> _GainsAnswer:
        """Check the gains of the scenario."""
        contradiction = "one of the two: --check selects nothing to write"
        require_unused(
            self, ("write", "feedforward", "observer"), contradiction, "--check beside it"
        )
        own_loop = all(value is None for value in values_of(self, *LOOP).values())
        expected = "the scenario's own rate, lag, delay and inputs"
        require(own_loop, "--check", "another loop beside it", expected)
        entries = named_numbers("entry", self.entry or (), "1/lag[elevator]=0.3")
        answer = check_gains(
            self.airframe, self.scenario, **values_of(self, *STUDY), entries=entries
        )
        name = Path(self.scenario).stem
        if not self.guaranteed:
            return _GainsAnswer({"scenario": answer}, checked=name)
        progress("bounding every aircraft of the box")
        loop = answer.loop_with_box()
        promise = proved(loop, self.late)
        lines = write_certificate(self.certificate, loop, promise, self.airframe, self.scenario)
        lines += write_unstable(self.worst, promise, self.airframe, self.scenario)
        return _GainsAnswer({"scenario": answer}, checked=name, promise=promise, written=lines)

    def _selected(self, progress: Callable[[str], None]) -> _GainsAnswer:
        """Select gains by Theorem 1 and by the procedure, or those that go with an observer."""
        selection = select_gains(
            self.airframe,
            self.scenario,
            **values_of(self, *STUDY, *SELECTION),
            lag=None if self.lag is None else parse_lags(self.lag),
            inputs=self.inputs or (),
            speeds=() if self.speeds is None else parse_numbers(self.speeds) or self.speeds,
            progress=progress,
        )
        if self.write is not None:
            if not self.accept:
                _require_margins(selection, theorem=self.theorem)
            text = LICENCE + gain_yaml.selection_yaml(selection, theorem=self.theorem)
            write_text("--write", self.write, text)
        if self.observer:
            return _GainsAnswer({"observer": selection.engineering}, selection)
        answers = {"theorem": selection.theorem, "engineering": selection.engineering}
        return _GainsAnswer(answers, selection)

    def _show(self, console: Console, result: _GainsAnswer, origin: str) -> None:
        """Print the tables, the trade of a selection, the origins and the paths of the files."""
        selection = result.selection
        _show_margins(console, result.study, result.titles)
        show_guarantee(console, result.promise, result.first)
        _show_verdicts(console, result)
        lines = [origin]
        if selection is not None:
            lines.insert(0, selection.origin)
            if not self.observer and selection.engineering.has_requirement:
                _show_trade(console, selection)
        lines += result.written
        files = {"gains": self.write, "page": self.page, "certificate": self.certificate}
        lines += [f"{key}: {display_path(path)}" for key, path in files.items() if path is not None]
        for line in filter(None, lines):
            say(console, line)


def _loop_of_px4(
    px4: Path | None, rate: float | None, delay: float | None
) -> tuple[float | None, float | None, str]:
    """Return the rate and the delay, and where they come from.

    They are as given or, if there is one, from a parameter file.
    """
    if px4 is None:
        return rate, delay, ""
    require(delay is None, "px4", "--delay beside it", "one of the two")
    loop = rate_loop(px4, rate)
    return loop.rate, loop.delay, loop.origin


def _write_page(path: Path, answer: Assessment) -> None:
    """Write the margins of a gain set on a page.

    Raises ParameterError for the literal sign, which has no linear loop.
    """
    loop = answer.loop_with_box()
    with writing("--page", path, "a page that can"):
        write_loop_page(path, f"Loop of {answer.study.airframe.name}", loop)


def _require_margins(selection: Selection, *, theorem: bool) -> None:
    """Refuse gains whose margins fall short of the requirement."""
    assessment = selection.theorem if theorem else selection.engineering
    short = "; ".join(row.sentence(assessment.controller.outputs) for row in assessment.unmet)
    if short and not theorem and assessment.controller.observer is None:
        short = lacking(selection, options=("lag", "delay", "rate"))
    if short:
        raise ParameterError(f"--write: {short}; --accept writes them all the same")


def _show_trade(console: Console, selection: Selection) -> None:
    """Show how the error of the linear loop along the manoeuvre trades against the phase margin."""
    controller = selection.chosen
    frame = selection.study.airframe
    outputs = controller.outputs
    output_units = frame.units_of_outputs()
    unit_texts = [display_unit(output_units[name]) for name in outputs]
    # A height has no unit of the score.
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
    say(console, MARGIN_LEGEND, style="dim")


def _show_verdicts(console: Console, result: _GainsAnswer) -> None:
    """Print the conditions part by part, each with its verdict. That on the loop decides."""
    answers = result.titles
    first = result.first
    for part, heading in HEADINGS.items():
        if getattr(first, part):
            print_table(console, _condition_table(answers, part, heading))
        for name, answer in answers.items():
            verdict = VERDICTS[part](answer, result.promise)
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
    """Make a table of the conditions of a part, with one condition in each row."""
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
    """Make a table of K, Lambda and beta of RISE-DI, with one channel in each row."""
    headings = []
    for name in answers:
        headings += [f"{name}\nK", "\nLambda", "\nbeta"]
    title = (
        f"Gains for {aircraft}; K, Lambda in 1/s, beta in units of y / s^2, for inputs "
        "scaled by 1 / abs(Omega_ii)"
    )
    table = new_table(title, ["channel", "D", *headings], left_aligned=("channel",))
    first = next(iter(answers.values())).controller
    for i, (output, name) in enumerate(zip(first.outputs, first.inputs, strict=True)):
        row = [f"{output} by {name}", f"{first.D[i]:+d}"]
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
    """Make a table of the parameters of a law other than RISE-DI."""
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
    """Say up to which speed a positive delay margin lasts if the gains stay fixed."""
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
    """Return up to which multiple of the trim speed the loop is stable.

    Returns None if there is no limit, or if the literal sign has no linear loop.
    """
    if answer.delay_margin is None:
        return None
    ratio = gain_selection.stable_speed_ratio(study, answer.controller)
    return ratio if math.isfinite(ratio) else None


def _as_json(result: _GainsAnswer, seed: int) -> dict[str, Any]:
    study = result.study
    promise = result.promise
    inputs = list(study.airframe.inputs)
    return {
        "airframe": study.airframe.name,
        "uncertainty": study.uncertainty,
        "entries": dict(study.spread.entries),
        "samples": len(study.A) - 1,
        "seed": seed,
        "slew": dict(zip(inputs, study.slew.tolist(), strict=True)),
        "slew_calm": dict(zip(inputs, study.slew_undisturbed.tolist(), strict=True)),
        "checked": result.checked or None,
        **{
            name: _assessment_as_json(study, answer, promise)
            for name, answer in result.answers.items()
        },
        **({} if promise is None else {"guarantee": promise.as_json()}),
    }


def _assessment_as_json(
    study: Study, answer: Assessment, promise: Guarantee | None
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
    verdicts = {part: verdict(answer, promise) for part, verdict in VERDICTS.items()}
    return {
        "verdicts": {
            part: verdict._asdict() for part, verdict in verdicts.items() if verdict.sentence
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
