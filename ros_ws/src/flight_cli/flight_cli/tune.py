# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di tune`: make a module that flies better from the log of an autopilot.

It imports, identifies, selects gains, bounds and exports, as the commands of these names do.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import typer
from rich.console import Console

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from flight_analysis.closed_loop.scenario import Scenario, scenario_yaml
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.linear_loop.guarantee import Guarantee, guarantee
from flight_analysis.linear_loop.loop_margins import LoopMargins, margins
from flight_analysis.report.margin_figures import guarantee_text, margin_table
from flight_analysis.report.page import Figures, Page, TableGroup, page_html
from flight_analysis.report.run_folder import remove_empty
from flight_analysis.report.summary_rows import Column
from flight_analysis.report.tables import MetricTable
from flight_cli.output import (
    COUNT_COLUMNS,
    LICENCE,
    entry_table,
    new_table,
    parse_lags,
    print_table,
    progress_bar,
    say,
    write_text,
)
from flight_cli.words import REQUIRED, argument, option, rare_option, scenario_names, warn
from flight_core.files import display_path, writing
from flight_core.parameters import ParameterError, require
from flight_core.rates import period_ns
from flight_core.vectors import FloatArray
from flight_design.gains.effectors import lags_by_input
from flight_design.gains.gain_design import check_gains, select_gains
from flight_design.gains.gain_selection import Selection
from flight_design.gains.ideal_control import ChannelPairing
from flight_design.identification.excitation import (
    factors_of,
    is_late,
    still_outputs,
    to_fly,
    to_set,
)
from flight_design.identification.innovation_filters import Actuation, measured_noise
from flight_design.identification.likelihood import Unknown
from flight_design.identification.log_import import Window
from flight_design.identification.model_identification import (
    Identification,
    Part,
    identify_model,
    model_yaml,
    with_entries,
)
from flight_design.identification.model_quality import (
    NoBetter,
    best_known,
    in_time,
)
from flight_design.identification.own_loop import OwnLoop, own_loop
from flight_design.identification.rates_log import RatesLog, rates_of_log, scaled_torques
from flight_log.px4_parameters import low_pass_delay, rate_loop
from flight_log.vehicle_log import read_foreign_log
from rise_di.c_code import export

UNPROVED = 1
LEAST, MOST = 0.05, 0.3  # bounds on the uncertainty of A and B that the margins must cover
SAMPLES = 60  # uncertain aircraft
DELAY_MARGIN = 0.01  # s, with the observer, as in examples/px4_airplane/rates_observer.yaml
WIDEST = 0.9  # of an entry, in the box of the guarantee
LOGGED_OFTEN = {
    "px4": ": set SDLOG_PROFILE to 17, by which PX4 logs rates and torque at the rate of the gyro"
}
STEPS = {
    "px4": (
        (
            "To fly it: build PX4 with EXTERNAL_MODULES_LOCATION as this folder, start the lines "
            "of extras.txt, fly level, set RDI_EN to 1."
        ),
        (
            "To go back: RDI_EN 0, or the input of RDI_AUX. To fly without the module: remove "
            "extras.txt."
        ),
        (
            "Then: log the doublets with rise_di_status, and tune again with scenario.yaml of this "
            "folder."
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


class Predicted(NamedTuple):
    """What a loop does on the identified aircraft: the rms of e, (m,), and the margins."""

    rms: FloatArray
    margins: LoopMargins


class _Tuned(NamedTuple):
    """The results of the steps of a tuning."""

    identification: Identification
    uncertainty: float
    scenario: Scenario
    selection: Selection
    promise: Guarantee
    law: Predicted
    own: OwnLoop | None
    by_own: Predicted | None


@dataclass(frozen=True, kw_only=True)
class Tune:
    """Identify the aircraft of a log, select its gains, and export the module that flies them.

    The log is a ULog of PX4, or a DataFlash log of ArduPlane, in which the autopilot or an earlier
    module flew doublets on each rate. The scenario has the rates, the end stops and the commands;
    if you tuned before, take the one in the folder of that tuning. If the log has too little
    motion, the command says which doublets to fly.

    Exit status: 0; 1 if an aircraft within the errors of the identification may be unstable, or if
    a bit of the code differs; 2 bad input, a model that is refused, or margins that fall short.
    """

    log: Path = argument("ULog of PX4, or DataFlash log of ArduPlane.", default=REQUIRED)
    scenario: str = option(
        "Scenario of body rates, as for export --px4: name, or path of a file (.yaml).",
        default=REQUIRED,
        autocompletion=scenario_names,
    )
    px4: Path | None = option(
        "Folder for a module of PX4, the files that it was made from, and a page."
    )
    ardupilot: Path | None = option("Folder for a task of ArduPlane, in place of --px4.")
    lag: str | None = option(
        "Lags of the servos in s, in the order of the airframe, as in 0.02,0.1; by default those "
        "of the aircraft in the scenario."
    )
    start: float | None = option("Time to begin at, s since the beginning of the log.", "--from")
    stop: float | None = option("Time to end at, s since the beginning of the log.", "--until")
    calm: bool = option(
        "Do without an observer, which passes the noise of the gyro on to u in calm air.",
        default=False,
    )
    float32: bool = option("Compute in single precision.", default=False)
    accept: bool = rare_option("Write gains even if their margins fall short.", default=False)
    without_proof: bool = rare_option(
        "Write the code without a proof.", "--no-proof", default=False
    )

    def execute(self) -> None:
        """Identify, select, bound, export and show."""
        autopilot, folder = self._target()
        console = Console()
        try:
            tuned = self._tuned(console, autopilot, folder)
        finally:
            remove_empty(folder)
        page = folder / "tuning.html"
        scenario = folder / "scenario.yaml"
        write_text("--write", scenario, LICENCE + scenario_yaml(tuned.scenario))
        with console.status("exporting and comparing"):
            exported = export(
                tuned.scenario,
                folder,
                autopilot=autopilot,
                float32=self.float32,
                drawn=5_000,
                proof=not self.without_proof,
            )
        write_text("--write", page, page_html(_page(tuned, self.log.name, autopilot)))
        _show(console, tuned)
        files = {"airframe": folder / "airframe.yaml", "scenario": scenario, "page": page}
        for name, path in files.items():
            say(console, f"{name}: {display_path(path)}")
        if not tuned.promise.holds or (exported.proof is not None and not exported.proof.holds):
            raise typer.Exit(UNPROVED)

    def _target(self) -> tuple[str, Path]:
        """Return the autopilot and its folder. Raises ParameterError unless one is named."""
        folders = {"px4": self.px4, "ardupilot": self.ardupilot}
        named = {name: path for name, path in folders.items() if path is not None}
        if len(named) != 1:
            raise typer.BadParameter("expected --px4 FOLDER or --ardupilot FOLDER")
        ((autopilot, folder),) = named.items()
        with writing(f"--{autopilot}", folder, "a folder that can"):
            folder.mkdir(parents=True, exist_ok=True)
        return autopilot, folder

    def _tuned(self, console: Console, autopilot: str, folder: Path) -> _Tuned:
        """Identify, select the gains and bound them: the whole command except the export."""
        scenario = find_scenario(self.scenario)
        controller = scenario.rise_di()
        nominal = load_airframe(scenario.aircraft.airframe)
        lags = self._lags(scenario, nominal)
        expected = "--calm: an observer estimates the wind"
        require(self.calm or bool(nominal.gusts), nominal.name, "no gusts", expected)
        log = read_foreign_log(self.log)
        of_log = rates_of_log(log, scenario, nominal, autopilot, Window(self.start, self.stop))
        recorded, taken = of_log.recorded, of_log.taken
        delay = low_pass_delay(of_log.cutoff) or controller.delay
        if autopilot == "px4":
            loop = rate_loop(self.log, controller.rate)
            scenario = scenario.vary(controller={"delay": loop.delay})
            say(console, loop.origin)
            delay = loop.filters
        for sentence in (*taken.notes, *scaled_torques(taken.parameters)):
            warn(f"warning: {sentence}")
        _require_motion(of_log, scenario, nominal, self.log)
        actuation = Actuation(lags, delay - of_log.advance)
        identification = _identified(console, scenario, nominal, of_log, actuation)
        airframe = _kept(nominal, identification)
        if airframe is None:
            raise ParameterError(_what_to_log(identification, scenario, self.log, autopilot))
        for part in identification.parts:
            if part.refusal is not None:
                warn(f"warning: {', '.join(part.outputs)}: {part.refusal}; {_kept_model(part)}")
        uncertainty = _uncertainty(identification)
        entries = _box(identification, airframe)
        taken_parts = tuple(filter(_is_better, identification.parts))
        identification = identification._replace(airframe=airframe, parts=taken_parts)
        path = folder / "airframe.yaml"
        write_text("--write", path, model_yaml(identification, self.log.name))
        noise = measured_noise(recorded.y, np.ones(recorded.y.shape[1]))
        flight = _on_airframe(scenario, path, noise)
        selection = self._selection(console, airframe, flight, uncertainty)
        chosen = flight.vary(controller=selection.chosen)
        with console.status("bounding every aircraft within the errors"):
            answer = check_gains(
                airframe,
                chosen,
                uncertainty=LEAST,
                samples=SAMPLES,
                entries=entries,
                as_told=True,
            )
            promise = guarantee(answer.loop_with_box())
        own = own_loop(taken.parameters, chosen, autopilot)
        law, by_own = _predicted(chosen, airframe, own, uncertainty)
        return _Tuned(
            identification=identification,
            uncertainty=uncertainty,
            scenario=chosen,
            selection=selection,
            promise=promise,
            law=law,
            own=own,
            by_own=by_own,
        )

    def _lags(self, scenario: Scenario, nominal: Airframe) -> FloatArray:
        """Return the lags of the servos in the order of the airframe, s. Raises ParameterError."""
        channels = scenario.aircraft.channels().inputs
        lags = dict(zip(channels, scenario.aircraft.actuators.lag, strict=False))
        if self.lag is not None:
            lags = lags_by_input(parse_lags(self.lag), nominal)
        return np.array([lags.get(name, 0.0) for name in nominal.inputs])

    def _selection(
        self, console: Console, airframe: Airframe, flight: Scenario, uncertainty: float
    ) -> Selection:
        """Select gains for the identified airframe.

        Raises ParameterError if the margins fall short.
        """
        with console.status("selecting gains") as status:
            selection = select_gains(
                airframe,
                flight,
                uncertainty=uncertainty,
                samples=SAMPLES,
                feedforward=True,
                observer=not self.calm,
                margin=DELAY_MARGIN,
                accept=self.accept,
                progress=status.update,
            )
        answer = selection.engineering
        short = "; ".join(row.sentence(answer.controller.outputs) for row in answer.unmet)
        expected = "--accept, which writes them all the same, or --calm"
        require(self.accept or not short, "gains", short, expected)
        return selection


def _identified(
    console: Console,
    scenario: Scenario,
    nominal: Airframe,
    of_log: RatesLog,
    actuation: Actuation,
) -> Identification:
    """Search for the model on the log, and show a progress bar."""
    controller = scenario.rise_di()
    pairing = ChannelPairing(controller.outputs, controller.inputs)
    unknown = Unknown(has_hidden_rows=False)
    with progress_bar(*COUNT_COLUMNS, quiet=console.quiet) as bar:
        show: Callable[..., None] = partial(
            bar.update, bar.add_task(f"search, u {1e3 * actuation.delay:.1f} ms late")
        )
        identification = identify_model(
            of_log.recorded,
            nominal,
            actuation,
            pairing,
            show,
            unknown=unknown,
            searches_again=True,
            timing=of_log.timing,
        )
        show(completed=1, total=1)
    return identification


def _require_motion(of_log: RatesLog, scenario: Scenario, nominal: Airframe, log: Path) -> None:
    """Raise ParameterError, before any search, if an input does not move its output in a log."""
    controller = scenario.rise_di()
    pairing = ChannelPairing(controller.outputs, controller.inputs)
    still = still_outputs(of_log.recorded, nominal, pairing)
    if not still:
        return
    outputs = [each.output for each in still]
    found = "; ".join(each.sentence for each in still)
    fly = to_fly(dict.fromkeys(outputs, 1.0), scenario, nominal, of_log.recorded.y)
    raise ParameterError(f"{log}: {found}{to_set(outputs, of_log.taken.parameters)}{fly}")


def _what_to_log(
    identification: Identification, scenario: Scenario, log: Path, autopilot: str
) -> str:
    """Say why the model is refused, and which log would show what is missing."""
    parts = identification.parts
    y = identification.recorded.y
    fly = to_fly(factors_of(parts), scenario, identification.airframe, y)
    often = LOGGED_OFTEN.get(autopilot, "") if is_late(parts) else ""
    return f"{log}: {identification.refusal}{often}{fly}"


def _kept(nominal: Airframe, identification: Identification) -> Airframe | None:
    """Put the identified parts into the airframe, or return None if one of them must not be used.

    If the nominal model of a part explains the log better, this part stays nominal.
    """
    used = []
    for part in identification.parts:
        if part.refusal and not isinstance(part.refusal, NoBetter):
            return None
        used += [*part.entries] if _is_better(part) else []
    return with_entries(nominal, used)


def _is_better(part: Part) -> bool:
    """Return whether a part's model explains the held-out samples better than the nominal one."""
    return part.after.log_likelihood > part.before.log_likelihood


def _kept_model(part: Part) -> str:
    """Say which model of a refused part is used."""
    kept = "is taken, as the likelier one" if _is_better(part) else "stays nominal"
    return f"the model {kept}"


def _uncertainty(identification: Identification) -> float:
    """Return twice the largest deviation of the best known effects, from LEAST to MOST.

    The deviation of an effect is a fraction of the value that was found. An uncertain delay does
    not count: by it A, B and the delay are off together, and the loop of the log stays the same.
    """
    relative = [
        effect.deviation * abs(effect.nominal / effect.value)
        for part in identification.parts
        for effect in best_known(in_time(part.entries, part.by_timing), part.outputs)
    ]
    return float(np.clip(2.0 * max(relative), LEAST, MOST))


def _box(identification: Identification, airframe: Airframe) -> dict[str, float]:
    """Return twice the standard deviation of each entry, by name, as a part of its value.

    The values are those of the airframe. A part that stays nominal counts at least the change that
    was found.
    """
    A, B = airframe.matrix_a(), airframe.matrix_b()
    inputs = list(airframe.inputs)
    box = {}
    for part in identification.parts:
        is_taken = _is_better(part)
        for entry in part.entries:
            row = airframe.index(entry.row)
            if entry.matrix == "A":
                value = A[row, airframe.index(entry.column)]
            else:
                value = B[row, inputs.index(entry.column)]
            size = (
                2.0 * entry.deviation if is_taken else max(2.0 * entry.deviation, abs(entry.error))
            )
            if value:
                relative = abs(entry.unit * size / value)
                box[f"{entry.matrix}[{entry.row},{entry.column}]"] = min(relative, WIDEST)
    return box


def _on_airframe(scenario: Scenario, airframe: Path, noise: FloatArray) -> Scenario:
    """Return the scenario on the identified airframe.

    Its sensors have the noise of the gyro in the log, rad/s rms.
    """
    changes = {"airframe": str(airframe.resolve()), "sensors": {"noise": noise.tolist()}}
    return scenario.vary(aircraft=changes)


def _predicted(
    scenario: Scenario, airframe: Airframe, own: OwnLoop | None, uncertainty: float
) -> tuple[Predicted, Predicted | None]:
    """Fly RISE-DI, and compute the autopilot's own loop, along the commands of the scenario.

    Both follow y_m on the identified aircraft, with the noise of the gyro in the log.
    """
    controller = scenario.rise_di()
    tape = simulate(scenario)
    truth = tape["truth"]
    rows = [airframe.outputs.index(name) for name in controller.outputs]
    C = airframe.matrix_c()[rows]
    y = np.column_stack([truth[f"x.{state}"] for state in airframe.states]) @ C.T
    y_m = np.column_stack(
        [
            np.interp(truth.stamp_ns, tape["y_m"].stamp_ns, tape["y_m"][name])
            for name in controller.outputs
        ]
    )
    law = Predicted(_rms(y - y_m), margins(scenario, SAMPLES, uncertainty))
    if own is None:
        return law, None
    length = tape["y_m"].stamp_ns[-1] - tape.start_ns
    stamps = tape.start_ns + np.arange(0, length, period_ns(controller.rate, "rate"))
    setpoints = np.column_stack(
        [np.interp(stamps, tape["y_m"].stamp_ns, tape["y_m"][name]) for name in controller.outputs]
    )
    noise = np.array(scenario.aircraft.sensors.noise)[rows]
    error = own.flown(scenario, airframe, setpoints, noise)
    own_margins = margins(own.in_place(scenario), SAMPLES, uncertainty)
    return law, Predicted(_rms(error), own_margins)


def _rms(e: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(e**2, axis=0)))


def _error_rows(tuned: _Tuned) -> list[list[str]]:
    """Return for each output the rms of RISE-DI and of the own loop, mrad/s, and the ratio."""
    outputs = tuned.scenario.controller.outputs
    rows = []
    for i, name in enumerate(outputs):
        cells = [name, f"{1e3 * tuned.law.rms[i]:.1f}", "", ""]
        if tuned.by_own is not None:
            ratio = tuned.law.rms[i] / tuned.by_own.rms[i]
            cells[2:] = [f"{1e3 * tuned.by_own.rms[i]:.1f}", f"{ratio:.2f}"]
        rows.append(cells)
    return rows


def _show(console: Console, tuned: _Tuned) -> None:
    """Print what was identified, and the errors that are predicted."""
    identification = tuned.identification
    title = f"A and B of {identification.airframe.name}"
    print_table(console, entry_table(title, identification.entries))
    headings = ("output", "RISE-DI\nmrad/s", "own loop\nmrad/s", "ratio")
    table = new_table("\nPredicted rms of the error along the commands", headings)
    for row in _error_rows(tuned):
        table.add_row(*row)
    print_table(console, table)
    for sentence in (tuned.selection.origin, *guarantee_text(tuned.promise)):
        say(console, sentence)


def _page(tuned: _Tuned, log: str, autopilot: str) -> Page:
    """Make the page: what was identified, predicted and bounded, and what the pilot does next."""
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
        "deviation: standard deviation of the change",
    )
    own = "no parameters of it in the log" if tuned.own is None else tuned.own.source
    errors = MetricTable(
        "Predicted rms of the error along the commands of the scenario",
        [
            Column(group="RISE-DI", head="mrad/s"),
            Column(group="own loop", head="mrad/s"),
            Column(group="ratio", head=""),
        ],
        _error_rows(tuned),
        f"with the noise of the log's gyro, without wind. Own loop: {own}",
    )
    law = margin_table(tuned.law.margins, tuned.promise)
    tables = [entries, errors, law._replace(caption="Margins of RISE-DI")]
    if tuned.by_own is not None:
        own_margins = margin_table(tuned.by_own.margins)
        tables.append(own_margins._replace(caption="Margins of the own loop"))
    return Page(
        title=f"Tuning of {identification.airframe.name} from {log}",
        lines=_what_to_do(tuned, autopilot),
        blocks=[Figures(groups=[TableGroup(tables)])],
    )


def _what_to_do(tuned: _Tuned, autopilot: str) -> list[str]:
    """Say what is guaranteed, what to set and switch, and how to go back."""
    return [_guaranteed(tuned.promise), *STEPS[autopilot]]


def _guaranteed(promise: Guarantee) -> str:
    """Say how many of the stated deviations of A and B the guarantee covers."""
    holds = "every aircraft is stable" if promise.holds else "an aircraft may be unstable"
    covered = 2.0 * promise.stable / promise.uncertainty
    return (
        f"A and B within twice their stated deviations: {holds} by the guarantee, which holds for "
        f"{covered:.2g} of them"
    )
