# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di identify`: identify an aircraft of JSBSim by linearisation, and write its scenario.

From the log of a flight it identifies A and B of an airframe.
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import typer
from rich.console import Console

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.jsbsim.jsbsim_aircraft import PREFIX, named_properties, require_aircraft
from flight_analysis.closed_loop.replay import recorded_parameters, recorded_scenario
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics import mask_spans
from flight_analysis.report.display_units import DisplayUnit, display_unit
from flight_analysis.report.figures import ERROR, GUST, PLANT
from flight_analysis.report.page import Page, Section, page_html
from flight_analysis.report.plotting import (
    Curve,
    Interval,
    PlotContext,
    SampleStore,
    time_series_figure,
)
from flight_cli.bridge_experiment import BridgeExperiment
from flight_cli.identified import identified_as_json, show_identified
from flight_cli.log_options import scenario_file, warn_of_lacks
from flight_cli.output import (
    COUNT_COLUMNS,
    entries_as_json,
    entry_table,
    new_table,
    print_json,
    print_table,
    progress_bar,
    require_yaml,
    say,
    write_text,
)
from flight_cli.words import (
    airframe_names,
    argument,
    json_option,
    map_names,
    option,
    rare_option,
    require_unused,
    scenario_names,
    warn,
    write_option,
)
from flight_core.files import display_path
from flight_core.outcome import FlightEnded
from flight_core.parameters import ParameterError, require, require_channels
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_design.gains.gain_design import selected_observer
from flight_design.gains.ideal_control import ChannelPairing
from flight_design.gains.relaxation import reason_against_gains
from flight_design.gains.requirement import PHASE_MARGIN, Requirement, requirement
from flight_design.identification.bridge_identification import AMPLITUDE
from flight_design.identification.innovation_filters import Actuation, recording
from flight_design.identification.jsbsim_identification import STEP_MARGIN, IdentifiedAircraft
from flight_design.identification.jsbsim_identification import identify_jsbsim as identify_aircraft
from flight_design.identification.manoeuvre import manoeuvre_result
from flight_design.identification.model_identification import (
    Identification,
    identify_model,
    model_yaml,
)
from flight_log.log_content import StoredFile
from flight_log.tape_reader import RecordedRun, read_run
from rise_di_controller.params import ControllerConfig

CANNOT_FLY = 3
REFLY_MARGIN = 0.03  # s
OF_LOG = ("scenario", "delay", "namespace", "refly")
OF_JSBSIM = ("observer", "guidance", "learn", "command")
OF_MARGINS = ("phase_margin", "accept")
"""Options that only a log has, that only JSBSim has, and that require margins."""
BESIDE_BRIDGE = "none beside --bridge"


@dataclass(frozen=True, kw_only=True)
class Identify:
    """Identify an aircraft of JSBSim by linearisation, or A and B from the log of a flight.

    For an aircraft of JSBSim it also selects gains, flies the aircraft and writes a scenario for
    `rise-di fly`. A model from a log is accepted if it predicts the held-out part of the flight
    better than the nominal airframe does. With --bridge, it excites each input of the aircraft
    behind a channel map by itself, open loop; --write is then the folder for a scenario that flies
    it.

    Exit status: 0, 2 bad input or a model that is refused, 3 the aircraft does not trim or does not
    fly.
    """

    source: str | None = argument(
        "jsbsim:NAME or jsbsim:PATH, an aircraft of JSBSim; or a log: the folder of a run, or an "
        "MCAP file. Leave it out to fly the experiment of --bridge."
    )
    speed: float | None = option("True airspeed at which to trim and fly, m/s.")
    altitude: float | None = option("Altitude above sea level at which to trim and fly, m.")
    airframe: str | None = option(
        "With a log: name or file (.yaml) of the nominal airframe.", autocompletion=airframe_names
    )
    write: Path | None = write_option(
        "Scenario file; by default jsbsim_NAME.yaml, which must not exist yet. With a log: "
        "airframe file for the model, beside which a page is written. With --bridge: folder for "
        "the files that fly the aircraft."
    )
    scenario: str | None = rare_option(
        "With a log: scenario with the lags and the delay of the controller; by default that in "
        "the log.",
        autocompletion=scenario_names,
    )
    delay: float | None = rare_option(
        "With a log: delay of u, s; by default that of the scenario. A flight in one process has "
        "none."
    )
    namespace: str | None = rare_option(
        "With a log: namespace of the aircraft, if the log holds several."
    )
    refly: bool = rare_option(
        "With a log: fly its scenario in this process with a feedforward and an observer of the "
        "model.",
        default=False,
    )
    observer: bool = option(
        "With JSBSim: add an extended-state observer from Omega and the lags.", default=False
    )
    guidance: bool = option(
        "With JSBSim: fly and write guidance by rule in place of the pulses.", default=False
    )
    learn: bool = option(
        "With JSBSim: write a scenario that learns A and B in flight.", default=False
    )
    margin: float | None = rare_option(
        "Least delay margin that the loop with an observer must have, s; by default 0.03, with "
        "JSBSim 0.015."
    )
    bridge: str | None = option(
        "Excite the aircraft behind a channel map, or read the log of such a flight.",
        metavar="MAP",
        autocompletion=map_names,
    )
    amplitude: float | None = rare_option(
        "With --bridge: amplitude of the excitation as a fraction of each input's limit; by "
        "default 0.2."
    )
    phase_margin: float | None = rare_option(
        "With JSBSim or --bridge: least phase margin of the loop, deg; by default 45."
    )
    accept: bool = rare_option(
        "Accept a phase margin below 40 deg, and gains whose margins fall short.", default=False
    )
    command: list[str] | None = rare_option(
        "With JSBSim: a property of the model that takes an input, and its value at full command; "
        "may be repeated.",
        metavar="INPUT:PROPERTY=VALUE",
    )
    link_delay: float | None = rare_option(
        "With --bridge and a log of rise-di import: delay that the link adds to that in the log, "
        "s; by default that of the map."
    )
    as_json: bool = json_option()

    def execute(self) -> None:
        """Identify an aircraft of JSBSim, one behind a bridge, or a log."""
        log = self._log()
        if self.bridge is not None:
            self._identify_behind_bridge(self.bridge, log)
            return
        for name in ("link_delay", "amplitude"):
            require_unused(self, [name], "--bridge beside it")
        require(
            self.margin is None or self.refly or self.observer or self.learn,
            "margin",
            self.margin,
            "--refly, --observer or --learn beside it",
        )
        require(
            not (self.observer and self.learn),
            "observer",
            "--learn beside it",
            "one of the two: a learner designs its own observer",
        )
        if log is None:
            self._identify_jsbsim()
            return
        expected = "the folder of a run, an MCAP file, or jsbsim:NAME"
        require(log.exists(), str(log), "no such file or folder", expected)
        self._identify_log(log)

    def _log(self) -> Path | None:
        """Return the log that the source names, or None for an aircraft or without a source."""
        if self.source is None or self.source.startswith(PREFIX):
            return None
        log = Path(self.source)
        is_name = self.bridge is None and self.speed is not None and not log.exists()
        return None if is_name else log

    def _needed(self) -> Requirement:
        """Return the margins that the gains must have."""
        phase_margin = PHASE_MARGIN if self.phase_margin is None else self.phase_margin
        return requirement(phase_margin, accept=self.accept)

    def _identify_behind_bridge(self, channel_map: str, log: Path | None) -> None:
        require(log is not None or self.source is None, "aircraft", self.source, BESIDE_BRIDGE)
        require_unused(self, ("altitude", "airframe", "margin", *OF_LOG, *OF_JSBSIM), BESIDE_BRIDGE)
        if self.write is None:
            raise ParameterError(
                "identify: found too few arguments, expected --write beside --bridge"
            )
        speed = self.speed
        require(speed is None or 0.0 < speed < math.inf, "speed", f"{speed}", "above 0 m/s")
        later = self.link_delay
        require(later is None or 0.0 <= later < math.inf, "link_delay", later, "0 or more")
        BridgeExperiment(
            map_name=channel_map,
            speed=speed,
            folder=self.write,
            amplitude=AMPLITUDE if self.amplitude is None else self.amplitude,
            log=log,
            needed=self._needed(),
            accept=self.accept,
            link_delay=later,
        ).identify(as_json=self.as_json)

    def _identify_jsbsim(self) -> None:
        aircraft = self.source
        if aircraft is None or self.speed is None or self.altitude is None:
            raise ParameterError(
                "identify: found too few arguments, expected a log, or an aircraft with --speed "
                "and --altitude"
            )
        require_unused(self, ("airframe", *OF_LOG), "a log in place of the aircraft")
        name = _jsbsim_name(aircraft)
        require(0.0 < self.speed < math.inf, "--speed", self.speed, "above 0 m/s")
        require(0.0 <= self.altitude < math.inf, "--altitude", self.altitude, "0 m or more")
        path = self._scenario_path(name)
        console = Console(quiet=self.as_json)
        identified_aircraft = self._identified_aircraft(name, self.speed, self.altitude, console)
        lack = None
        if not self.accept and not identified_aircraft.failure:
            # It takes as long as everything before. If it came after the tables, one would think
            # that the command has ended.
            with console.status("what would meet the margins"):
                lack = reason_against_gains(identified_aircraft.selection)
        write_text("write", path, identified_aircraft.text)
        if self.as_json:
            print_json(identified_as_json(identified_aircraft, path))
        else:
            show_identified(console, identified_aircraft)
            say(console, f"scenario: {display_path(path)}")
        if identified_aircraft.failure:
            title = identified_aircraft.condition.title
            warn(f"error: {title} does not fly: {identified_aircraft.failure}")
            raise typer.Exit(CANNOT_FLY)
        if lack is not None:
            where = f"{display_path(path)}, which says so in its first line; --accept takes it"
            raise ParameterError(f"identify: {lack}; the gains are in {where}")

    def _scenario_path(self, name: str) -> Path:
        """Return the path of the scenario, which may replace a file only if --write names it."""
        path = self.write or Path(f"jsbsim_{Path(name).stem}.yaml")
        expected = "a file to write over, or another"
        is_new = self.write is not None or not path.exists()
        require(is_new, "write", f"none, and {path} exists", expected)
        require_yaml("write", path)
        return path

    def _identified_aircraft(
        self, name: str, speed: float, altitude: float, console: Console
    ) -> IdentifiedAircraft:
        """Linearise an aircraft, select its gains and fly it, or exit if it has no trim."""
        margin = STEP_MARGIN if self.margin is None else self.margin
        texts: dict[str, str] = {}
        for text in self.command or []:
            channel, _, paths = text.partition(":")
            texts[channel] = f"{texts.get(channel, '')} {paths}".strip()
        try:
            with console.status("trim") as status:
                return identify_aircraft(
                    name,
                    speed,
                    altitude,
                    status.update,
                    margin if self.observer or self.learn else None,
                    guided=self.guidance,
                    learns=self.learn,
                    requirement=self._needed(),
                    named=named_properties(texts, "--command"),
                )
        except FlightEnded as error:
            warn(f"error: {error}")
            raise typer.Exit(CANNOT_FLY) from None

    def _identify_log(self, log: Path) -> None:
        """Identify a model from a log, show it and write it.

        Raises ParameterError if the model is refused.
        """
        require_unused(self, ("speed", "altitude", *OF_JSBSIM, *OF_MARGINS), "none beside a log")
        require(
            self.airframe is not None,
            "airframe",
            "none",
            "the nominal airframe of the log, a name or a file (.yaml)",
        )
        nominal = load_airframe(self.airframe or "")
        if self.write is not None:
            require_yaml("--write", self.write)
        recorded_run = read_run(log, self.namespace, scenario_file(self.scenario))
        recorded_run.require()
        warn_of_lacks(recorded_run)
        if recorded_run.scenario is None:
            raise ParameterError(
                f"{log}: found a log without its scenario, expected --scenario NAME with the "
                "controller's lags"
            )
        console = Console(quiet=self.as_json)
        identification = self._identified_model(recorded_run, recorded_run.scenario, nominal)
        _show_model(console, identification)
        if identification.refusal:
            raise ParameterError(f"{log}: {identification.refusal}")
        if self.write is not None:
            _write_model(console, identification, log, self.write)
        again = None
        if self.refly:
            with console.status("flying with the model"):
                again = _refly(
                    recorded_scenario(recorded_run.scenario),
                    recorded_run.tape,
                    identification.airframe,
                    REFLY_MARGIN if self.margin is None else self.margin,
                )
            _show_flights_of_model(console, again, _units(identification))
        if self.as_json:
            refly_figures = {} if again is None else {"refly": again._asdict()}
            print_json(_model_as_json(identification, self.write) | refly_figures)

    def _identified_model(
        self, recorded_run: RecordedRun, scenario: StoredFile, nominal: Airframe
    ) -> Identification:
        """Search for the model on the log, and show a progress bar."""
        controller = recorded_parameters(scenario)
        delay = controller.delay if self.delay is None else self.delay
        actuation = _actuation(controller, nominal, delay)
        samples = recording(recorded_run.tape, nominal)
        pairing = ChannelPairing(controller.outputs, controller.inputs)
        with progress_bar(*COUNT_COLUMNS, quiet=self.as_json) as bar:
            show = partial(bar.update, bar.add_task("search"))
            identification = identify_model(samples, nominal, actuation, pairing, show)
            show(completed=1, total=1)
        return identification


def _jsbsim_name(aircraft: str) -> str:
    """Return the name of an aircraft of JSBSim without its prefix. Raises ParameterError."""
    require(
        aircraft.startswith(PREFIX),
        "aircraft",
        f"{aircraft!r}",
        f"an aircraft of JSBSim, {PREFIX}NAME or {PREFIX}PATH",
    )
    try:
        return require_aircraft(aircraft)
    except ParameterError as error:
        # The option --airframe belongs to a log.
        raise ParameterError(f"aircraft{str(error).removeprefix('airframe')}") from None


def _write_model(console: Console, identification: Identification, log: Path, path: Path) -> None:
    """Write the airframe file, and the page of the innovations."""
    write_text("--write", path, model_yaml(identification, str(log)))
    page = path.with_suffix(".html")
    write_text("--write", page, page_html(_innovation_page(identification, log.name)))
    say(console, f"model: {display_path(path)}, innovations: {display_path(page)}")


class _Reflight(NamedTuple):
    """Rms errors of a recorded flight and of the same flight with another model, SI, by output.

    The second flight has the feedforward and the observer of that model.
    """

    origin: str  # where the observer's gains come from
    recorded: dict[str, float]
    again: dict[str, float]
    outcome: str


def _refly(scenario: Scenario, tape: Tape, model: Airframe, margin: float) -> _Reflight:
    """Fly a log's scenario again in this process, with the feedforward and observer of a model."""
    selected = selected_observer(scenario.rise_di(), scenario, model, margin)
    again = simulate(replace(scenario, controller=selected.controller))
    return _Reflight(
        selected.origin, manoeuvre_result(tape).rms, manoeuvre_result(again).rms, str(again.outcome)
    )


def _show_flights_of_model(
    console: Console, again: _Reflight, units: dict[str, DisplayUnit]
) -> None:
    headings = ["flight", *(f"{name}\n{unit.unit}" for name, unit in units.items())]
    table = new_table("\nRms of the error", headings)
    for title, rms in (("recorded", again.recorded), ("with the model", again.again)):
        table.add_row(title, *(f"{rms[name] * unit.factor:.3g}" for name, unit in units.items()))
    print_table(console, table)
    say(console, f"{again.origin}; outcome: {again.outcome}")


def _actuation(controller: ControllerConfig, nominal: Airframe, delay: float) -> Actuation:
    """Return the lags and the delay of a controller's loop, in the order of the airframe."""
    require(0.0 <= delay < math.inf, "--delay", delay, "0 s or more")
    for key, names, expected in (
        ("controller.outputs", controller.outputs, nominal.outputs),
        ("controller.inputs", controller.inputs, tuple(nominal.inputs)),
    ):
        require_channels(key, names, expected, f"the channels of the airframe {nominal.name}")
    lag = dict(zip(controller.inputs, controller.lag, strict=True))
    return Actuation(np.array([lag[name] for name in nominal.inputs]), delay)


def _show_model(console: Console, identification: Identification) -> None:
    print_table(
        console, entry_table(f"A and B of {identification.airframe.name}", identification.entries)
    )
    headings = ("output", "nominal\nrms", "\nwhiteness", "identified\nrms", "\nwhiteness")
    table = new_table("\nInnovations of the held-out samples, one of three seconds", headings)
    for i, (name, unit) in enumerate(_units(identification).items()):
        figures = [
            (model.rms[i] * unit.factor, model.whiteness[i])
            for model in (identification.before, identification.after)
        ]
        table.add_row(
            f"{name} ({unit.unit})", *(f"{figure:.3g}" for figure in chain.from_iterable(figures))
        )
    print_table(console, table)
    gain = identification.after.log_likelihood - identification.before.log_likelihood
    say(
        console,
        f"whiteness: 1 for white noise; change of the log-likelihood of a sample: {gain:+.3g}",
    )


def _units(identification: Identification) -> dict[str, DisplayUnit]:
    units = identification.airframe.units_of_outputs()
    return {name: display_unit(unit) for name, unit in units.items()}


def _innovation_page(identification: Identification, name: str) -> Page:
    """Make a page of the innovations of the nominal and of the identified model over the flight.

    The held-out seconds are shaded.
    """
    t = identification.recorded.t - identification.recorded.t[0]
    before, after = (
        Signal(np.round(t * NANOSECONDS).astype(np.int64), identification.airframe.outputs, r)
        for r in identification.innovations
    )
    held_out = [
        Interval(label="held out", start=start, stop=stop, colour=GUST, labelled=False)
        for start, stop in mask_spans(t, identification.held_out)
    ]
    context = PlotContext(
        runs={},
        units=_units(identification),
        intervals=held_out,
        end=float(t[-1]),
        samples=SampleStore(),
    )
    curves = {
        "nominal": Curve(before, ERROR, start_ns=0),
        "identified": Curve(after, PLANT, start_ns=0),
    }
    figure = time_series_figure(context, curves)
    section = Section(
        "Innovations",
        "y minus its prediction from the samples before; shaded: not used in the fit",
        figure,
    )
    likelihoods = (
        f"{identification.before.log_likelihood:.4g} nominal, "
        f"{identification.after.log_likelihood:.4g} identified"
    )
    return Page(
        title=f"Model of {identification.airframe.name} from {name}",
        lines=[f"log-likelihood of a held-out sample: {likelihoods}"],
        blocks=[section],
        samples=context.samples,
    )


def _model_as_json(identification: Identification, path: Path | None) -> dict[str, Any]:
    outputs = identification.airframe.outputs
    return {
        "airframe": identification.airframe.name,
        "entries": entries_as_json(identification.entries),
        "held_out": {
            model: {
                "rms": dict(zip(outputs, innovations.rms.tolist(), strict=True)),
                "whiteness": dict(zip(outputs, innovations.whiteness.tolist(), strict=True)),
                "log_likelihood": innovations.log_likelihood,
            }
            for model, innovations in (
                ("nominal", identification.before),
                ("identified", identification.after),
            )
        },
        "model": None if path is None else str(path),
    }
