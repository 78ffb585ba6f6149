# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di identify`, for an aircraft of JSBSim, behind a bridge, or in a log."""

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import typer
from rich.console import Console

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.jsbsim.jsbsim_aircraft import named_properties, require_aircraft
from flight_analysis.closed_loop.replay import recorded_parameters, recorded_scenario
from flight_cli.bridge_experiment import BridgeExperiment
from flight_cli.identified_aircraft import identified_as_json, show_identified
from flight_cli.identified_model import (
    fly_again,
    model_as_json,
    show_flights_of_model,
    show_model,
    write_model,
)
from flight_cli.log_options import log_namespace, log_scenario, scenario_file, warn_of_lacks
from flight_cli.output import (
    COUNT_COLUMNS,
    print_json,
    progress_bar,
    require_yaml,
    say,
    write_text,
)
from flight_cli.words import (
    REQUIRED,
    airframe_names,
    argument,
    json_option,
    map_names,
    option,
    rare_option,
    warn,
    write_option,
)
from flight_core.files import display_path
from flight_core.outcome import FlightEnded
from flight_core.parameters import ParameterError, require, require_channels
from flight_design.gains.ideal_control import ChannelPairing
from flight_design.gains.relaxation import reason_against_gains
from flight_design.gains.requirement import PHASE_MARGIN, requirement
from flight_design.identification.bridge_identification import AMPLITUDE
from flight_design.identification.innovation_filters import Actuation, recording
from flight_design.identification.jsbsim_identification import STEP_MARGIN, IdentifiedAircraft
from flight_design.identification.jsbsim_identification import identify_jsbsim as identify_aircraft
from flight_design.identification.model_identification import Identification, identify_model
from flight_log.log_content import StoredFile
from flight_log.tape_reader import RecordedRun, read_run
from rise_di_controller.params import ControllerConfig

CANNOT_FLY = 3
REFLY_MARGIN = 0.03  # delay margin, s, of a flight that is flown again


def _phase_margin_option() -> Any:
    """Declare the option --phase-margin of gains that are selected for an identified aircraft."""
    return rare_option("Least phase margin of the loop, deg.", default=PHASE_MARGIN)


def _accept_option() -> Any:
    """Declare the option --accept of gains that are selected for an identified aircraft."""
    text = "Accept a phase margin below 40 deg, and gains whose margins fall short."
    return rare_option(text, default=False)


@dataclass(frozen=True, kw_only=True)
class Jsbsim:
    """Linearise an aircraft of JSBSim, select its gains, fly it, and write a scenario of it.

    Exit status: 0; 2 for bad input, or if the gains fall short of the margins, in which case the
    scenario is written all the same; 3 if the aircraft does not trim or does not fly.
    """

    aircraft: str = argument(
        "Name of an aircraft of JSBSim, or the path of your own, with a / in it, as in ./NAME: its "
        "XML file or folder.",
        default=REQUIRED,
    )
    speed: float = option("True airspeed at which to trim and fly, m/s.", default=REQUIRED)
    altitude: float = option(
        "Altitude above sea level at which to trim and fly, m.", default=REQUIRED
    )
    write: Path | None = write_option(
        "Scenario file; by default jsbsim_NAME.yaml, which must not exist yet."
    )
    observer: bool = option(
        "Add an extended-state observer from Omega and the lags.", default=False
    )
    guidance: bool = option(
        "Fly with guidance, whose parameters follow from the other sections, in place of the "
        "pulses, and write it into the scenario.",
        default=False,
    )
    learn: bool = option("Write a scenario that learns A and B in flight.", default=False)
    margin: float | None = rare_option(
        "With --observer or --learn: least delay margin that the loop with an observer must have, "
        "s; by default 0.015."
    )
    phase_margin: float = _phase_margin_option()
    accept: bool = _accept_option()
    command: list[str] | None = rare_option(
        "A property of the model that takes an input, and its value at full command; may be "
        "repeated.",
        metavar="INPUT:PROPERTY=VALUE",
    )
    as_json: bool = json_option()

    def execute(self) -> None:
        """Identify the aircraft, write its scenario, and print the result and the path."""
        observes = self.observer or self.learn
        expected = "--observer or --learn beside it"
        require(self.margin is None or observes, "margin", self.margin, expected)
        require(
            not (self.observer and self.learn),
            "observer",
            "--learn beside it",
            "one of the two: a learner designs its own observer",
        )
        name = _jsbsim_name(self.aircraft)
        require(0.0 < self.speed < math.inf, "speed", self.speed, "above 0 m/s")
        require(0.0 <= self.altitude < math.inf, "altitude", self.altitude, "0 m or more")
        path = self._scenario_path(name)
        console = Console(quiet=self.as_json)
        identified_aircraft = self._identified_aircraft(name, console)
        lack = None
        if not self.accept and not identified_aircraft.failure:
            # This takes as long as everything before it. If it came after the tables, users would
            # think that the command has ended.
            with console.status("searching for what would meet the margins"):
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
            where = f"{display_path(path)}, whose first line says this; --accept accepts them"
            raise ParameterError(f"identify: {lack}; the gains are in {where}")

    def _scenario_path(self, name: str) -> Path:
        """Return where to write the scenario. It may only exist already if --write names it."""
        path = self.write or Path(f"jsbsim_{Path(name).stem}.yaml")
        expected = f"--write {path} to replace it, or another file"
        is_new = self.write is not None or not path.exists()
        require(is_new, "--write", f"no file, and {path} exists", expected)
        require_yaml("write", path)
        return path

    def _identified_aircraft(self, name: str, console: Console) -> IdentifiedAircraft:
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
                    self.speed,
                    self.altitude,
                    status.update,
                    margin if self.observer or self.learn else None,
                    guided=self.guidance,
                    learns=self.learn,
                    requirement=requirement(self.phase_margin, accept=self.accept),
                    named=named_properties(texts, "--command"),
                )
        except FlightEnded as error:
            warn(f"error: {error}")
            raise typer.Exit(CANNOT_FLY) from None


@dataclass(frozen=True, kw_only=True)
class Log:
    """Identify A and B of an airframe from the log of a flight.

    The model is accepted if it predicts the held-out part of the flight better than the nominal
    airframe does.

    Exit status: 0; 2 for bad input, or if the model is refused.
    """

    log: Path = argument("The folder of a run, or an MCAP file.", default=REQUIRED)
    airframe: str = option(
        "Name or file (.yaml) of the nominal airframe.",
        default=REQUIRED,
        autocompletion=airframe_names,
    )
    write: Path | None = write_option(
        "Airframe file for the model, beside which a page is written."
    )
    scenario: str | None = log_scenario()
    namespace: str | None = log_namespace()
    delay: float | None = option(
        "Delay of u, s; by default as in the scenario. A flight in one process has none."
    )
    refly: bool = option(
        "Fly the scenario in this process with a feedforward and an observer for the model.",
        default=False,
    )
    margin: float | None = rare_option(
        "With --refly: least delay margin that the loop with an observer must have, s; by default "
        "0.03."
    )
    as_json: bool = json_option()

    def execute(self) -> None:
        """Identify the model, print it and write it.

        Raises ParameterError if the model is refused.
        """
        require(self.margin is None or self.refly, "margin", self.margin, "--refly beside it")
        expected = "the folder of a run, or an MCAP file"
        require(self.log.exists(), str(self.log), "no such file or folder", expected)
        nominal = load_airframe(self.airframe)
        if self.write is not None:
            require_yaml("--write", self.write)
        recorded_run = read_run(self.log, self.namespace, scenario_file(self.scenario))
        recorded_run.require()
        warn_of_lacks(recorded_run)
        if recorded_run.scenario is None:
            raise ParameterError(
                f"{self.log}: found a log without its scenario, expected --scenario NAME with the "
                "controller's lags"
            )
        console = Console(quiet=self.as_json)
        identification = self._identified_model(recorded_run, recorded_run.scenario, nominal)
        show_model(console, identification)
        if identification.refusal:
            raise ParameterError(f"{self.log}: {identification.refusal}")
        if self.write is not None:
            write_model(console, identification, self.log, self.write)
        again = None
        if self.refly:
            with console.status("flying with the model"):
                again = fly_again(
                    recorded_scenario(recorded_run.scenario),
                    recorded_run.tape,
                    identification.airframe,
                    REFLY_MARGIN if self.margin is None else self.margin,
                )
            show_flights_of_model(console, again, identification)
        if self.as_json:
            print_json(model_as_json(identification, self.write, again))

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


@dataclass(frozen=True, kw_only=True)
class Bridge:
    """Excite the inputs of the aircraft behind a channel map one at a time, open loop.

    From the response it selects gains, and writes a scenario that flies the aircraft. With --run it
    reads the log of such a flight, or one of `rise-di import`, and flies nothing.

    Exit status: 0; 2 for bad input, or if the experiment is refused.
    """

    channel_map: str = argument(
        "Name or file (.yaml) of the channel map.",
        default=REQUIRED,
        metavar="MAP",
        autocompletion=map_names,
    )
    write: Path = write_option("Folder for the files that fly the aircraft.", default=REQUIRED)
    speed: float | None = option(
        "True airspeed in trim, m/s, if the map has the airspeed. Leave it out for a hover."
    )
    run: Path | None = option(
        "Log of an experiment, or of rise-di import, to read instead of flying."
    )
    amplitude: float = rare_option(
        "Amplitude of the excitation as a fraction of each input's limit.", default=AMPLITUDE
    )
    phase_margin: float = _phase_margin_option()
    accept: bool = _accept_option()
    link_delay: float | None = rare_option(
        "With a log of rise-di import: delay that the link adds to the delay in the log, s; by "
        "default the delay of the map."
    )
    as_json: bool = json_option()

    def execute(self) -> None:
        """Fly the experiment or read its log; write the airframe, and the scenario with gains."""
        speed = self.speed
        require(speed is None or 0.0 < speed < math.inf, "speed", speed, "above 0 m/s")
        later = self.link_delay
        require(later is None or 0.0 <= later < math.inf, "link_delay", later, "0 or more")
        log = self.run
        expected = "the folder of a run, or an MCAP file"
        require(log is None or log.exists(), "run", log, expected)
        BridgeExperiment(
            map_name=self.channel_map,
            speed=speed,
            folder=self.write,
            amplitude=self.amplitude,
            log=log,
            needed=requirement(self.phase_margin, accept=self.accept),
            accept=self.accept,
            link_delay=later,
        ).identify(as_json=self.as_json)


def _jsbsim_name(aircraft: str) -> str:
    """Return the name or the path of an aircraft of JSBSim. Raises ParameterError without one."""
    try:
        return require_aircraft(aircraft)
    except ParameterError as error:
        # The key in a scenario is `airframe`, but the argument is called `aircraft`.
        raise ParameterError(f"aircraft{str(error).removeprefix('airframe')}") from None


def _actuation(controller: ControllerConfig, nominal: Airframe, delay: float) -> Actuation:
    """Return the lags and the delay of a controller's loop, with inputs in the airframe's order."""
    require(0.0 <= delay < math.inf, "--delay", delay, "0 s or more")
    for key, names, expected in (
        ("controller.outputs", controller.outputs, nominal.outputs),
        ("controller.inputs", controller.inputs, tuple(nominal.inputs)),
    ):
        require_channels(key, names, expected, f"the channels of the airframe {nominal.name}")
    lag = dict(zip(controller.inputs, controller.lag, strict=True))
    return Actuation(np.array([lag[name] for name in nominal.inputs]), delay)
