# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di gains`, which selects gains, checks them, or proves what they guarantee.

The guarantee holds for every aircraft in a box around the nominal one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.status import Status

from aircraft_sim.airframes.airframe import airframes
from flight_analysis.closed_loop.scenario_library import scenarios
from flight_analysis.linear_loop.guarantee import NAMED
from flight_analysis.linear_loop.loop_margins import LinearLoop
from flight_analysis.linear_loop.saturation import guarantee_with_limit
from flight_analysis.report.html import write_loop_page
from flight_cli.gains_guarantee import (
    proved,
    require_guarantee,
    require_linear,
    warn_of_controller_alone,
    write_certificate,
    write_unstable,
)
from flight_cli.gains_saturation import (
    limit_text,
    require_saturation,
    write_limit_certificate,
)
from flight_cli.gains_tables import GainSets, gains_as_json, show_gains
from flight_cli.gains_verdicts import (
    loop_verdict,
)
from flight_cli.output import (
    LICENCE,
    named_numbers,
    parse_lags,
    parse_numbers,
    print_json,
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
    scenario_names,
    values_of,
    write_option,
)
from flight_core.files import display_path, writing
from flight_core.outcome import Refusal, joined
from flight_core.parameters import ParameterError, require
from flight_design.gains import gain_yaml
from flight_design.gains.gain_design import check_gains, select_gains
from flight_design.gains.gain_selection import GainAssessment, Selection
from flight_design.gains.relaxation import reason_against_gains
from flight_design.gains.requirement import PHASE_MARGIN
from flight_log.px4_parameters import rate_loop

LOOP_FAILS = 1
STUDY = ("uncertainty", "gamma_2", "samples", "seed")
SELECTION = (
    "y_rate",
    "feedforward",
    "observer",
    "model",
    "margin",
    "weights",
    "phase_margin",
    "accept",
    "mixing",
)
"""STUDY has the options of a study, and SELECTION the further options of a selection."""


@dataclass(frozen=True, kw_only=True)
class _Gains:
    """The options and arguments that the subcommands of `rise-di gains` share."""

    airframe: str = argument(
        "Name or file (.yaml) of an airframe.",
        default=REQUIRED,
        autocompletion=airframe_names,
    )
    uncertainty: float = option("Largest relative deviation of each entry of A and B.", default=0.3)
    scenario: str = option(
        "Scenario with the commands, the gusts and the loop.",
        default="osprey_servo",
        autocompletion=scenario_names,
    )
    gamma_2: float = rare_option(
        "gamma_2 of Lemma 1, 1/s. It is an assumption: nothing bounds it.", default=0.0
    )
    samples: int = rare_option(
        "Uncertain airframes for the bounds of the theorem.", default=100, min=0, max=10_000
    )
    seed: int = rare_option("Seed of the uncertain airframes.", default=1, min=0)
    page: Path | None = rare_option("HTML file for margins, Bode and Nyquist plots of the gains.")
    as_json: bool = json_option()

    def _require_airframe(self) -> None:
        """Check that the name belongs to an airframe, and not to a scenario.

        Raises ParameterError if not.
        """
        is_scenario = self.airframe in set(scenarios()) - set(airframes())
        require(
            not is_scenario,
            "airframe",
            f"the scenario {self.airframe!r}",
            f"the airframe that it flies, with `--scenario {self.airframe}` beside it",
        )

    def _status(self, text: str) -> Status:
        return Console(quiet=self.as_json).status(text)

    def _show(
        self, sets: GainSets, sentences: Sequence[str], files: Mapping[str, Path | None] = {}
    ) -> None:
        """Print tables, sentences and paths, or JSON with --json; write the page of --page.

        `files` has the paths of the written files by their names in the output.
        """
        if self.page is not None:
            _write_page(self.page, sets.last)
        if self.as_json:
            print_json(gains_as_json(sets, self.seed))
            return
        console = Console()
        show_gains(console, sets)
        paths = {**files, "page": self.page}
        written = [
            f"{key}: {display_path(path)}" for key, path in paths.items() if path is not None
        ]
        for line in filter(None, [*sentences, *written]):
            say(console, line)


@dataclass(frozen=True, kw_only=True)
class Select(_Gains):
    """Select gains by Theorem 1 and by the engineering procedure, and check all conditions on them.

    The loop has the rate, the lags and the delay of the scenario, unless options say otherwise.
    Exit status: 0, or 2 bad input.
    """

    rate: float | None = rare_option("Rate of the law, Hz; by default as in the scenario.")
    y_rate: float | None = rare_option(
        "Rate of y, Hz. If its period is longer than the law's, the difference counts as "
        "delay. y is stale after three periods."
    )
    lag: str | None = option("Lags of the actuators in s, in the airframe's order: 0.02,0.1.")
    delay: float | None = option("Pure delay, s; by default as in the scenario.")
    px4: Path | None = rare_option(
        "Parameter file of QGroundControl or ULog of PX4, which gives the rate and the delay of "
        "the body rates for a module of export --px4."
    )
    inputs: str | None = rare_option(
        "Input that moves each output, in the order of the airframe, as in rudder,aileron."
    )
    write: Path | None = write_option("File for the engineering gains, as a section of a scenario.")
    feedforward: bool = rare_option(
        "Also write the airframe, as the model of the feedforward (an extension).", default=False
    )
    observer: bool = option(
        "Write a feedforward, an observer, and gains for them (an extension).", default=False
    )
    model: str | None = rare_option(
        "Airframe that is the model of the observer, as rise-di identify log RUN writes it."
    )
    margin: float = rare_option(
        "Least delay margin that the nominal loop with the observer must have, s.", default=0.03
    )
    speeds: str | None = rare_option(
        "With --observer: also models at two fractions of the trim speed, as in 0.7,1.4, and a "
        "schedule between them."
    )
    weights: Path | None = rare_option(
        "With --observer: file of gains and weights, in place of a search or a rule. With "
        "--accept they are taken as they are."
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

    def execute(self) -> None:
        """Select gains, write them to a file, and print them."""
        self._require_airframe()
        require(
            not self.theorem or (self.write is not None and not self.observer),
            "theorem",
            "no --write, or --observer beside it",
            "--write beside it, without --observer",
        )
        rate, delay, origin = _loop_of_px4(self.px4, self.rate, self.delay)
        with self._status("selecting gains on uncertain airframes") as status:
            selection = select_gains(
                self.airframe,
                self.scenario,
                **values_of(self, *STUDY, *SELECTION),
                rate=rate,
                delay=delay,
                lag=None if self.lag is None else parse_lags(self.lag),
                inputs=self.inputs or (),
                speeds=() if self.speeds is None else parse_numbers(self.speeds) or self.speeds,
                progress=status.update,
            )
            if self.write is not None:
                if not self.accept:
                    _require_margins(selection, theorem=self.theorem)
                text = LICENCE + gain_yaml.selection_yaml(selection, theorem=self.theorem)
                write_text("--write", self.write, text)
        answers = {"theorem": selection.theorem, "engineering": selection.engineering}
        if self.observer:
            answers = {"observer": selection.engineering}
        written = selection.theorem if self.theorem else selection.engineering
        chatter = gain_yaml.chatter_sentence(written.controller, written.margins)
        sentences = [selection.origin, origin, chatter]
        self._show(GainSets(answers, selection), sentences, {"gains": self.write})


@dataclass(frozen=True, kw_only=True)
class Check(_Gains):
    """Check the gains of a scenario with any law: the margins, and every condition on the gains.

    The exit status follows the verdict on the loop, because the conditions of Theorem 1 are only
    sufficient. The airframe may be jsbsim:NAME as in the scenario, and the scenario may be a file
    that `gains select --write` wrote.

    Exit status: 0; 1 unless the loop is stable with the margins that it needs; 2 bad input.
    """

    entry: list[str] | None = rare_option(
        "An entry with a deviation of its own, 'A[q,alpha]=0.6', or of an actuator "
        "'1/lag[elevator]=0.3'; may be repeated."
    )
    zeros: float = option(
        "Bound of the entries of A and B that are 0 in the file, as a part of their row: 0.1.",
        default=0.0,
    )

    def execute(self) -> None:
        """Check the gains, and print the result."""
        self._require_airframe()
        warn_of_controller_alone(self.scenario)
        with self._status("checking the gains on uncertain airframes"):
            answer = self._checked()
        sets = GainSets({"scenario": answer}, checked=Path(self.scenario).stem)
        self._show(sets, ())
        self._exit_if_loop_fails(sets)

    def _checked(self) -> GainAssessment[Any]:
        entries = named_numbers("entry", self.entry or (), "1/lag[elevator]=0.3")
        words = values_of(self, *STUDY, "zeros")
        return check_gains(self.airframe, self.scenario, **words, entries=entries)

    def _exit_if_loop_fails(self, sets: GainSets) -> None:
        if not loop_verdict(sets.first, sets.guarantee).is_met:
            raise typer.Exit(LOOP_FAILS)


@dataclass(frozen=True, kw_only=True)
class Guarantee(Check):
    """Show what `gains check` shows, and prove what holds for every aircraft within --uncertainty.

    Exit status: 0; 1 if the loop does not pass `gains check`, or if an aircraft within
    --uncertainty may be unstable; 2 bad input.
    """

    worst: Path | None = option(
        "Folder for the unstable aircraft that deviates least, and one 1.2 times as far off."
    )
    late: float = option(
        "Largest time by which u is late, s. It may differ at each tick and in each input.",
        default=0.0,
    )
    saturation: str | None = option(
        "Input with limits of any size: find what holds with them, and write it to --certificate."
    )
    certificate: Path | None = option(
        "File for the proof (JSON), which examples/check_certificate.py checks "
        "with nothing but numpy."
    )

    def execute(self) -> None:
        """Check and bound the gains, write the files that options name, and print the results."""
        self._require_airframe()
        warn_of_controller_alone(self.scenario)
        require_guarantee(
            airframe=self.airframe,
            scenario=self.scenario,
            late=self.late,
            worst=self.worst,
            certificate=self.certificate,
        )
        require_saturation(
            self.saturation,
            scenario=self.scenario,
            late=self.late,
            entries=self.entry or (),
            worst=self.worst,
        )
        with self._status("checking the gains on uncertain airframes") as status:
            answer = self._checked()
            status.update("bounding every aircraft of the box")
            loop = answer.loop_with_box()
            if self.saturation is not None:
                self._bound_limited(answer, loop)
                return
            guarantee = proved(answer, self.late, status.update)
            lines = write_certificate(
                self.certificate, loop, guarantee, self.airframe, self.scenario
            )
            lines += write_unstable(self.worst, guarantee, self.airframe, self.scenario)
        name = Path(self.scenario).stem
        sets = GainSets({"scenario": answer}, checked=name, guarantee=guarantee)
        self._show(sets, lines, {"certificate": self.certificate})
        self._exit_if_loop_fails(sets)

    def _bound_limited(self, answer: GainAssessment[Any], loop: LinearLoop) -> None:
        """Prove the guarantee for a loop in which one input saturates; write and print it."""
        name = self.saturation or ""
        require_linear(loop)
        guarantee = guarantee_with_limit(loop, name)
        lines = limit_text(name, guarantee, loop.digest[:NAMED])
        lines += write_limit_certificate(
            self.certificate, loop, guarantee, self.airframe, self.scenario
        )
        sets = GainSets({"scenario": answer}, checked=Path(self.scenario).stem, limited=guarantee)
        self._show(sets, lines, {"certificate": self.certificate})
        self._exit_if_loop_fails(sets)
        if guarantee is None or not guarantee.is_proved:
            raise typer.Exit(LOOP_FAILS)


def _loop_of_px4(
    px4: Path | None, rate: float | None, delay: float | None
) -> tuple[float | None, float | None, str]:
    """Return the rate and the delay of the loop, and a text on where they come from.

    They come from the arguments, or from a parameter file of PX4 if there is one.
    """
    if px4 is None:
        return rate, delay, ""
    require(delay is None, "px4", "--delay beside it", "one of the two")
    loop = rate_loop(px4, rate)
    return loop.rate, loop.delay, loop.origin


def _write_page(path: Path, answer: GainAssessment[Any]) -> None:
    """Write the margins of a gain set on a page.

    Raises ParameterError for the literal sign, which has no linear loop.
    """
    loop = answer.loop_with_box()
    with writing("--page", path, "a writable file"):
        write_loop_page(path, f"Loop of {answer.study.airframe.name}", loop)


def _require_margins(selection: Selection, *, theorem: bool) -> None:
    """Raise ParameterError if the margins of the gains fall short of the requirement."""
    assessment = selection.theorem if theorem else selection.engineering
    outputs = assessment.controller.outputs
    lack = joined(Refusal(row.sentence(outputs)) for row in assessment.unmet)
    if lack and not theorem and assessment.controller.observer is None:
        lack = reason_against_gains(selection, options=("lag", "delay", "rate"))
    if lack is not None:
        raise ParameterError(f"--write: {lack}; --accept writes them all the same")
