# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di tune`, which makes a better controller from the log of an autopilot.

The controller is exported as a module for the autopilot. The command imports, identifies, selects
gains, compares, bounds and exports, as the commands with these names do.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import typer
from rich.console import Console

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.uncertainty import Spread, as_yaml
from flight_analysis.closed_loop.scenario import Scenario, scenario_yaml
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.linear_loop.guarantee import Guarantee, loop_guarantee
from flight_analysis.linear_loop.loop_margins import margins
from flight_analysis.report.page import page_html
from flight_analysis.report.run_folder import remove_empty
from flight_cli.output import COUNT_COLUMNS, LICENCE, parse_lags, progress_bar, say, write_text
from flight_cli.tune_candidates import LEAST, SAMPLES, Selectors, best_of, candidates
from flight_cli.tune_page import OwnFlight, Tuned, show_tuning, tuning_page
from flight_cli.words import REQUIRED, argument, option, rare_option, scenario_names, warn
from flight_core.files import display_path, writing
from flight_core.parameters import ParameterError, require
from flight_core.vectors import FloatArray
from flight_design.gains.effectors import lags_by_input
from flight_design.gains.gain_design import check_gains
from flight_design.gains.ideal_control import ChannelPairing
from flight_design.identification.excitation import (
    CLEAR_SHARE,
    factors_of,
    gust_warning,
    own_shares,
    to_fly,
    to_set,
)
from flight_design.identification.innovation_filters import Actuation, FlightData, measured_noise
from flight_design.identification.log_import import Window, lost_share
from flight_design.identification.model_identification import (
    Identification,
    Part,
    model_yaml,
    with_entries,
)
from flight_design.identification.model_quality import NoBetter
from flight_design.identification.model_refusals import best_known, entries_without
from flight_design.identification.own_loop import own_loop
from flight_design.identification.rates_log import SPARSE, RatesLog, rates_of_log, scaled_torques
from flight_design.identification.rates_model import banking, identify_rates
from flight_log.px4_parameters import low_pass_delay, rate_loop
from flight_log.vehicle_log import read_foreign_log
from rise_di.c_code import export
from rise_di_controller.rise_di_config import RiseDiConfig

UNPROVED = 1
MOST = 0.3  # largest uncertainty of A and B for which gains are searched
MOST_LOST = 0.1  # largest share of the samples of y or u that may be missing
WIDEST = 0.9  # largest half-width of an entry in the box, as a fraction of its value
LOGGED_OFTEN = "each one: set SDLOG_PROFILE to 17, by which PX4 logs rates and torque at full rate"


@dataclass(frozen=True, kw_only=True)
class Tune:
    """Identify the aircraft of a log, and export the module that flies it best.

    The log is a ULog of PX4, or a DataFlash log of ArduPlane, in which the autopilot or an earlier
    module flew doublets on each rate. The scenario has the rates, the end stops and the commands;
    if you tuned before, take the one in the folder of that tuning. If the log does not show the
    aircraft, the command says which doublets to fly, and which parameter to set.

    Several controllers then fly the commands of the scenario on the identified aircraft, in calm
    air and in gusts: the scenario's own, and some that are selected for this aircraft. The one
    with the least errors becomes the module, even if that is the controller that you had.

    Exit status: 0; 1 if an aircraft within the errors of the identification may be unstable, or if
    a result of the C code differs in one bit from the result of Python; 2 bad input, a model that
    is refused, or margins that fall short.
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
        "Tune for calm air alone, without an observer, which passes the noise of the gyro on to u.",
        default=False,
    )
    weights: Path | None = option(
        "File of gains and weights for one more observer, as for gains select --weights (.yaml)."
    )
    float32: bool = option("Compute in single precision.", default=False)
    accept: bool = rare_option("Write gains even if their margins fall short.", default=False)
    without_proof: bool = rare_option(
        "Write the code without a proof.", "--no-proof", default=False
    )

    def execute(self) -> None:
        """Identify the aircraft, select and bound gains, export the module, and print results."""
        autopilot, folder = self._target()
        console = Console()
        try:
            with TemporaryDirectory() as temporary:
                aircraft = Path(temporary) / "aircraft.yaml"
                tuned = self._tuned(console, autopilot, folder, aircraft)
        finally:
            remove_empty(folder)
        page = folder / "tuning.html"
        scenario = folder / "scenario.yaml"
        write_text("--write", scenario, LICENCE + scenario_yaml(tuned.best.scenario))
        say(console, "exporting and comparing")
        exported = export(
            tuned.best.scenario,
            folder,
            autopilot=autopilot,
            float32=self.float32,
            drawn=5_000,
            proof=not self.without_proof,
        )
        write_text("--write", page, page_html(tuning_page(tuned, self.log.name, autopilot)))
        show_tuning(console, tuned)
        files = {"airframe": folder / "airframe.yaml", "scenario": scenario, "page": page}
        for name, path in files.items():
            say(console, f"{name}: {display_path(path)}")
        if not tuned.guarantee.is_proved or (
            exported.proof is not None and not exported.proof.is_proved
        ):
            raise typer.Exit(UNPROVED)

    def _target(self) -> tuple[str, Path]:
        """Return the autopilot that an option names, and the folder for its module.

        Raises BadParameter if not exactly one autopilot is named.
        """
        folders = {"px4": self.px4, "ardupilot": self.ardupilot}
        named = {name: path for name, path in folders.items() if path is not None}
        if len(named) != 1:
            raise typer.BadParameter("expected --px4 FOLDER or --ardupilot FOLDER")
        ((autopilot, folder),) = named.items()
        with writing(f"--{autopilot}", folder):
            folder.mkdir(parents=True, exist_ok=True)
        return autopilot, folder

    def _tuned(self, console: Console, autopilot: str, folder: Path, aircraft: Path) -> Tuned:
        """Do everything except the export: identify, select the gains and bound them.

        The aircraft that flies is written to the file `aircraft`.
        """
        scenario = find_scenario(self.scenario)
        nominal = load_airframe(scenario.aircraft.airframe)
        scenario = self._with_lags(scenario, nominal)
        expected = "--calm: an observer estimates the wind"
        require(self.calm or bool(nominal.gusts), nominal.name, "no gusts", expected)
        log = read_foreign_log(self.log)
        of_log = rates_of_log(log, scenario, nominal, autopilot, Window(self.start, self.stop))
        scenario, delay = self._in_time(console, scenario, of_log, autopilot)
        for sentence in (*of_log.taken.notes, *scaled_torques(of_log.taken.parameters)):
            warn(f"warning: {sentence}")
        _require_shown(of_log, scenario, nominal, self.log, autopilot)
        actuation = Actuation(_lags(scenario, nominal), delay - of_log.advance)
        identification = _identified(console, scenario, nominal, of_log, actuation)
        airframe = _kept(nominal, identification)
        if airframe is None:
            raise ParameterError(_what_to_fly(identification, scenario, self.log))
        for part in identification.parts:
            if part.refusal is not None:
                warn(f"warning: {', '.join(part.outputs)}: {part.refusal}; {_kept_model(part)}")
            if gusts := gust_warning(part):
                warn(f"warning: {gusts}")
        uncertainty = _uncertainty(identification)
        entries = _box(identification, airframe)
        taken_parts = tuple(filter(_is_better, identification.parts))
        identification = identification._replace(airframe=airframe, parts=taken_parts)
        path = folder / "airframe.yaml"
        write_text("--write", path, model_yaml(identification, self.log.name))
        write_text("the aircraft that flies", aircraft, as_yaml(banking(airframe)))
        selectors = Selectors(
            airframe=airframe,
            flight=_on_airframe(scenario, path, of_log.recorded),
            aircraft=aircraft,
            uncertainty=uncertainty,
            entries=entries,
            lead=_with_lead if autopilot == "px4" else lambda controller: controller,
            calm=self.calm,
            accept=self.accept,
            weights=self.weights,
            report=partial(say, console),
        )
        found = candidates(selectors)
        best = best_of(found, accept=self.accept)
        say(console, f"best: {best.name}; bounding every aircraft within the errors")
        with console.status("checking the gains on uncertain airframes") as status:
            guarantee = _guarantee(best.scenario, airframe, entries, status.update)
        own = own_loop(of_log.taken.parameters, best.scenario, autopilot)
        return Tuned(
            identification=identification,
            best=best,
            candidates=found,
            guarantee=guarantee,
            margins=margins(best.scenario, SAMPLES, LEAST, spread=Spread(entries)),
            own=None if own is None else OwnFlight.of(own, selectors),
        )

    def _in_time(
        self, console: Console, scenario: Scenario, of_log: RatesLog, autopilot: str
    ) -> tuple[Scenario, float]:
        """Return the scenario with the delay of the log, and the delay of the gyro's filter, s.

        For PX4 both delays follow from the rate and the filters of the gyro. For ArduPlane the
        scenario stays as it is, and the second delay follows from the cut-off of the filter. If the
        log does not have the cut-off, the delay of the controller is returned.
        """
        controller = scenario.rise_di()
        if autopilot != "px4":
            return scenario, low_pass_delay(of_log.cutoff) or controller.delay
        loop = rate_loop(self.log, controller.rate, of_log.rate)
        say(console, loop.origin)
        aircraft = scenario.aircraft
        periods = round(loop.filters * aircraft.rate)
        sensors = aircraft.sensors.model_copy(update={"delay": periods / aircraft.rate})
        timed = scenario.vary(
            controller={"delay": loop.delay}, aircraft={"sensors": sensors.model_dump()}
        )
        return timed, loop.filters

    def _with_lags(self, scenario: Scenario, nominal: Airframe) -> Scenario:
        """Return the scenario with the lags of --lag, in the aircraft and in the controller.

        Raises ParameterError if the lags are invalid.
        """
        if self.lag is None:
            return scenario
        lags = lags_by_input(parse_lags(self.lag), nominal)
        of_aircraft = [lags[name] for name in scenario.aircraft.channels().inputs]
        actuators = scenario.aircraft.actuators.model_copy(update={"lag": tuple(of_aircraft)})
        of_controller = [lags[name] for name in scenario.controller.inputs]
        return scenario.vary(
            aircraft={"actuators": actuators.model_dump()}, controller={"lag": of_controller}
        )


def _lags(scenario: Scenario, nominal: Airframe) -> FloatArray:
    """Return the lags of the servos in the order of the airframe, s."""
    channels = scenario.aircraft.channels().inputs
    lags = dict(zip(channels, scenario.aircraft.actuators.lag, strict=False))
    return np.array([lags.get(name, 0.0) for name in nominal.inputs])


def _with_lead(controller: RiseDiConfig) -> RiseDiConfig:
    """Let the feedforward lead by the lag of the servos and half a period.

    The module compares y with the y_m of the same instant. Therefore the lead must not contain the
    delay of the gyro's filter.
    """
    if controller.feedforward is None:
        return controller
    lead = tuple(lag + 0.5 / controller.rate for lag in controller.lag)
    feedforward = controller.feedforward.model_copy(update={"lead": lead})
    return controller.model_copy(update={"feedforward": feedforward})


def _guarantee(
    scenario: Scenario,
    airframe: Airframe,
    entries: Mapping[str, float],
    report: Callable[[str], None],
) -> Guarantee:
    """Return the guarantee for A and B within the errors of the identification.

    An entry without an error may be off by the fraction LEAST. `report` gets a sentence for each
    step.
    """
    answer = check_gains(
        airframe, scenario, uncertainty=LEAST, samples=SAMPLES, entries=entries, as_told=True
    )
    return loop_guarantee(answer.loop_with_box(), report=report)


def _identified(
    console: Console,
    scenario: Scenario,
    nominal: Airframe,
    of_log: RatesLog,
    actuation: Actuation,
) -> Identification:
    """Search for the model that fits the log, and show a progress bar."""
    length = len(of_log.recorded.t) * of_log.recorded.period
    say(console, f"searching for A and B in {length:.0f} s of flight")
    controller = scenario.rise_di()
    with progress_bar(*COUNT_COLUMNS, quiet=console.quiet) as bar:
        task = bar.add_task(f"search, u {1e3 * actuation.delay:.1f} ms late")
        show: Callable[..., None] = partial(bar.update, task)
        found = identify_rates(
            of_log.recorded,
            nominal,
            actuation,
            ChannelPairing(controller.outputs, controller.inputs),
            show,
            timing=of_log.timing,
        )
        show(completed=1, total=1)
        return found


def _require_shown(
    of_log: RatesLog, scenario: Scenario, nominal: Airframe, log: Path, autopilot: str
) -> None:
    """Raise ParameterError, before any search, if a log does not show the aircraft.

    Such a log has too many gaps, too few samples of u, or an input that does not move its output.
    """
    tape = of_log.taken.tape
    holes = [name for name in ("y", "u") if lost_share(tape[name].stamp_ns) > MOST_LOST]
    found = "; ".join(note for note in of_log.taken.notes if note.split()[0] in holes)
    part = f"at most {100 * MOST_LOST:g} %: a part of the log without holes, by --from and --until"
    require(not holes, f"{log}: holes", found, part)
    controller = scenario.rise_di()
    rare = f"a sample each {1e3 * of_log.every:.0f} ms, of a loop of {controller.rate:g} Hz"
    has_all = autopilot != "px4" or of_log.every <= SPARSE / controller.rate
    require(has_all, f"{log}: torque", rare, LOGGED_OFTEN)
    pairing = ChannelPairing(controller.outputs, controller.inputs)
    own = own_shares(of_log.recorded, nominal, pairing)
    sentences = [each.sentence for each in own if each.is_still]
    if not sentences:
        return
    outputs = [each.output for each in own if each.is_still or each.share < CLEAR_SHARE]
    fly = to_fly(dict.fromkeys(outputs, 1.0), scenario, nominal, of_log.recorded.y)
    set_first = to_set(outputs, of_log.taken.parameters)
    raise ParameterError(f"{log}: {'; '.join(sentences)}{set_first}{fly}")


def _what_to_fly(identification: Identification, scenario: Scenario, log: Path) -> str:
    """Return a sentence on why the model is refused, and which doublets to fly."""
    parts = identification.parts
    y = identification.recorded.y
    fly = to_fly(factors_of(parts), scenario, identification.airframe, y)
    return f"{log}: {identification.refusal}{fly}"


def _kept(nominal: Airframe, identification: Identification) -> Airframe | None:
    """Return the airframe with the identified parts, or None if a part must not be used.

    A part is a group of entries that are identified together. If the nominal model of a part
    explains the log better, the part stays nominal.
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
    """Say which model is used for a part whose identified model is refused."""
    kept = "is taken, as the likelier one" if _is_better(part) else "stays nominal"
    return f"the model {kept}"


def _uncertainty(identification: Identification) -> float:
    """Return the uncertainty of A and B for which gains are searched, from LEAST to MOST.

    For each output, take the effect of an input that has the smallest relative standard deviation.
    The result is twice the largest of these deviations, as a fraction of the identified value. The
    uncertainty of the delay is left out. If the delay is wrong, A and B are wrong in a way that
    compensates it, so that the loop is still the loop of the log.
    """
    relative = [
        effect.deviation * abs(effect.nominal / effect.value)
        for part in identification.parts
        for effect in best_known(entries_without(part.entries, part.by_timing), part.outputs)
    ]
    return float(np.clip(2.0 * max(relative), LEAST, MOST))


def _box(identification: Identification, airframe: Airframe) -> dict[str, float]:
    """Return by how much each entry may deviate in the guarantee, as a fraction of its value.

    It is twice the standard deviation of the entry. In a part that stays nominal, it is at least
    the difference between the identified and the nominal value.
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


def _on_airframe(scenario: Scenario, airframe: Path, recorded: FlightData) -> Scenario:
    """Return the scenario on the identified airframe, with the noise of the gyro in the log.

    The sensors of the scenario may have another rate than `recorded`. White noise has the same
    density at both rates if its variance is proportional to the rate. The density is kept, because
    the loop passes only slow noise.
    """
    noise = measured_noise(recorded.y, np.ones(recorded.y.shape[1]))
    noise = noise * math.sqrt(scenario.aircraft.rate * recorded.period)
    changes = {"airframe": str(airframe.resolve()), "sensors": {"noise": noise.tolist()}}
    return scenario.vary(aircraft=changes)
