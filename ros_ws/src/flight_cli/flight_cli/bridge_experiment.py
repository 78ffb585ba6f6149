# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find gains for the aircraft behind a channel map, as `rise-di identify bridge` does.

A channel map says which field of an autopilot's messages is which channel. The aircraft is excited
in flight, and the result is a scenario that flies it.
"""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from autopilot_bridge.params import ChannelMap, load_map
from control_laws.excitation import ExcitationConfig
from flight_analysis.closed_loop.replay import recorded_parameters
from flight_analysis.closed_loop.scenario import load_scenario
from flight_analysis.report.run_folder import new_run
from flight_bringup.fly import fly_over_topics
from flight_bringup.graph import find_autopilot
from flight_cli.log_options import warn_of_lacks
from flight_cli.output import flight_progress, new_table, print_json, print_table, say
from flight_core.channels import RATES_AND_SPEED
from flight_core.files import (
    display_path,
    dump_yaml,
    link_latest,
    parse_yaml,
    write_file,
    writing,
)
from flight_core.outcome import Refusal
from flight_core.parameters import ParameterError, require
from flight_core.rates import NANOSECONDS
from flight_core.tape import Tape
from flight_core.text import sentences
from flight_design.gains.requirement import Requirement
from flight_design.identification.bridge_identification import (
    Experiment,
    IdentifiedChannels,
    channel_models,
    channel_pairs,
    experiment,
    has_airspeed,
    join,
    map_text,
    measured_trims,
    over_link,
    reason_against_experiment,
    require_envelope,
    within_range,
)
from flight_design.identification.flying_scenario import Flyable, flying_scenario
from flight_design.identification.log_import import COMMANDS, median_trims, require_map_of_import
from flight_design.identification.open_loop_fit import FASTEST_ZERO, ChannelModel
from flight_design.identification.response_identification import Response, identify_response
from flight_design.identification.sign_check import OPEN_LOOP
from flight_log.tape_reader import read_run

GUIDED = 600.0  # duration of a flight under guidance, s


@dataclass(frozen=True, kw_only=True)
class BridgeExperiment:
    """An experiment on the aircraft behind a channel map: it is flown, or read from its log.

    The results, an airframe and a scenario, are written to `folder`. If the log was imported, the
    gains allow for `link_delay`, s, in addition to the delay in the log. If `link_delay` is None,
    the delay in the channel map is used.
    """

    map_name: str
    speed: float | None  # trim speed, m/s; if None, the speed of the map, or hover
    folder: Path
    amplitude: float  # as a fraction of each input's limit
    log: Path | None  # log of an experiment; if None, it is flown
    needed: Requirement
    accept: bool  # whether gains with too small margins are accepted
    link_delay: float | None

    def identify(self, *, as_json: bool) -> None:
        """Fly the experiment or read its log; write the airframe, and the scenario with gains."""
        channel_map = load_map(self.map_name)
        self._require_fit(channel_map)
        console = Console(quiet=as_json)
        run = self._excite(console, channel_map) if self.log is None else self.log
        tape, spans, early_end = _engaged(run, channel_map)
        try:
            trims, response, channels = _identified(console, channel_map, tape, spans, self.speed)
        except ParameterError as error:
            raise ParameterError(sentences(str(error), early_end)) from None
        channels = self._with_link(console, channel_map, channels, imported=COMMANDS in tape)
        channel_map, narrower = within_range(channel_map, trims)
        for sentence in narrower:
            say(console, sentence)
        flyable = self._flyable(channel_map, channels)
        # Take the name of the run, not `latest`.
        written_map = map_text(channel_map, trims, run.resolve().name)
        files = {"airframe": flyable.airframe, "scenario": flyable.scenario, "map": written_map}
        guidance_scenario = guided_scenario(flyable.scenario, channel_map, self.speed)
        if guidance_scenario is not None:
            files["guided"] = guidance_scenario
        _write(self.folder, files)
        load_scenario(self.folder / "scenario.yaml")
        if guidance_scenario is not None:
            load_scenario(self.folder / "guided.yaml")
        if as_json:
            print_json(_as_json(response, channels, flyable, trims, self.folder))
            return
        _show_gains(console, channels, response, flyable)
        scenario = shlex.quote(str(self.folder / "scenario.yaml"))
        map_copy = shlex.quote(str(self.folder / "map.yaml"))
        say(console, f"to fly it: rise-di fly {scenario} --bridge {map_copy} --send")
        if guidance_scenario is not None:
            path = shlex.quote(str(self.folder / "guided.yaml"))
            say(console, f"under guidance: {path} in its place")

    def _require_fit(self, channel_map: ChannelMap) -> None:
        """Check that the options fit the channel map, before anything flies.

        Raises ParameterError if not.
        """
        expected = "above 0 and at most 1, a fraction of the limits of the map"
        require(0.0 < self.amplitude <= 1.0, "amplitude", self.amplitude, expected)
        has_speed = self.speed is not None or not has_airspeed(channel_map)
        require(has_speed, "--speed", "none", "the airspeed in trim, m/s: the map has one")
        fits = self.folder.is_dir() or not self.folder.exists()
        require(fits, "--write", self.folder, "a folder, or the name of a new one")
        if self.log is None:
            require_envelope(channel_map)

    def _excite(self, console: Console, channel_map: ChannelMap) -> Path:
        """Fly the experiment, and return the folder of its run."""
        airframe = self.folder / "experiment_airframe.yaml"
        scenario = self.folder / "experiment.yaml"
        plan = experiment(channel_map, self.speed, self.amplitude, str(airframe.resolve()))
        _write(self.folder, {airframe.stem: plan.airframe, scenario.stem: plan.scenario})
        flight_scenario = load_scenario(scenario)
        _announce(console, plan, flight_scenario.flight.duration, hovers=self.speed is None)
        run = new_run(flight_scenario, Path("runs"))
        with flight_progress(flight_scenario.flight.duration, quiet=console.quiet) as (
            progress,
            announce,
        ):
            outcome = fly_over_topics(
                flight_scenario,
                run,
                progress,
                autopilot=find_autopilot(self.map_name, dry_run=False),
                announce=announce,
                engaged_for=plan.controller.duration,
            )
        link_latest(run)
        say(console, f"outcome: {outcome}\nlog:     {display_path(run)}")
        return run

    def _with_link(
        self,
        console: Console,
        channel_map: ChannelMap,
        channels: IdentifiedChannels,
        *,
        imported: bool,
    ) -> IdentifiedChannels:
        """Add the delay of the link to the identified channels if the log was imported.

        An imported log was written on board, so it lacks this delay.
        """
        expected = "a log of rise-di import: an experiment over the link contains its delay"
        require(imported or self.link_delay is None, "link_delay", self.link_delay, expected)
        if not imported:
            return channels
        later = channel_map.link_delay if self.link_delay is None else self.link_delay
        _show_link(console, channel_map, later)
        return over_link(channels, later or 0.0)

    def _flyable(self, channel_map: ChannelMap, channels: IdentifiedChannels) -> Flyable:
        """Return the airframe and the scenario with gains.

        Raises ParameterError if the margins fall short.
        """
        airframe = str((self.folder / "airframe.yaml").resolve())
        flyable = flying_scenario(channel_map, channels, self.speed, airframe, self.needed)
        expected = "the margins, or --accept"
        require(self.accept or flyable.lack is None, "identify", flyable.lack, expected)
        return flyable


def guided_scenario(scenario: str, channel_map: ChannelMap, speed: float | None) -> str | None:
    """Return the text of the scenario, with guidance instead of commands over time.

    Returns None if guidance cannot fly the aircraft, because the channel map lacks the pose, the
    rates or the airspeed.
    """
    if speed is None or not channel_map.pose or not {*RATES_AND_SPEED} <= {*channel_map.outputs}:
        return None
    content = parse_yaml(scenario.encode(), "scenario", "a scenario")
    commands = content["/**/reference_model"]["ros__parameters"]
    for key in ("pulses", "coordinated_turn"):
        commands.pop(key, None)
    commands["live"] = {"speed": speed}
    content["/**/flight"]["ros__parameters"]["duration"] = GUIDED
    max_age = max(row.max_age for row in channel_map.pose.values())
    content["/**/guidance"] = {"ros__parameters": {"max_age": max_age}}
    heading = [line for line in scenario.splitlines() if line.startswith("#")]
    return "\n".join([*heading, dump_yaml(content)])


def _identified(
    console: Console,
    channel_map: ChannelMap,
    tape: Tape,
    spans: list[tuple[int, int]],
    speed: float | None,
) -> tuple[dict[str, float], Response, IdentifiedChannels]:
    """Find the trims, the step responses and the channels of an experiment, and print them.

    Raises ParameterError if the result for a channel is not certain.
    """
    pairing, _ = channel_pairs(channel_map)
    if COMMANDS in tape:
        trims = median_trims(tape[COMMANDS])
    else:
        trims = measured_trims(channel_map, tape["bridge/would_send"], spans[0][0])
    response = identify_response(
        tape["y"], tape["u"], pairing.outputs, pairing.inputs, engaged=spans
    )
    engaged_time = sum(stop - start for start, stop in spans) / NANOSECONDS
    _show_response(console, channel_map.name, response, trims, engaged_time)
    models = channel_models(channel_map, tape, spans, speed)
    _show_models(console, response, models)
    return trims, response, join(channel_map, response, models)


def _write(folder: Path, files: Mapping[str, str]) -> None:
    """Write YAML files by name into a folder, which is created if it does not exist."""
    with writing("--write", folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            write_file(folder / f"{name}.yaml", content)


def _announce(console: Console, plan: Experiment, duration: float, *, hovers: bool) -> None:
    """Print the plan of the experiment before it begins."""
    controller = plan.controller
    table = new_table(
        f"Excitation, {controller.duration:.0f} s open loop after engagement, one input after "
        "another",
        ("input", "amplitude", "doublets, s", "multisine, s", "Hz"),
    )
    for i, name in enumerate(controller.inputs):
        width = controller.width[i]
        band = f"{controller.lowest[i]:g} to {controller.highest[i]:g}"
        table.add_row(
            name,
            f"{controller.amplitude[i]:.3g}",
            f"{2 * width:g}, {4 * width:g}",
            f"{controller.period[i]:g}",
            band,
        )
    print_table(console, table)
    say(
        console,
        f"{'Hover' if hovers else 'Fly straight and level'}, in the mode in which the map "
        "engages, then in another terminal: rise-di engage (within"
        f" {duration - controller.duration:.0f} s). The pilot's override, rise-di engage --off "
        "and Ctrl-C end it at any time.",
    )


def _engaged(
    run: Path, channel_map: ChannelMap
) -> tuple[Tape, list[tuple[int, int]], Refusal | None]:
    """Return the tape of an experiment and the spans in which the bridge was engaged, ns.

    The third result says why the experiment ended early, or is None. A log of `rise-di import` is a
    single span. Raises ParameterError if the log has no engagement, or if the flight had feedback,
    because u then follows y.
    """
    recorded_run = read_run(run)
    warn_of_lacks(recorded_run)
    tape = recorded_run.tape
    engagements = recorded_run.engagements
    if COMMANDS in tape:
        require_map_of_import(channel_map, recorded_run)
        recorded_run.require("y", "u")
        return tape, [(int(tape["u"].stamp_ns[0]), int(tape["u"].stamp_ns[-1]))], None
    parameters = (
        None if recorded_run.scenario is None else recorded_parameters(recorded_run.scenario)
    )
    law = "not recorded" if parameters is None else parameters.law
    require(
        law == OPEN_LOOP,
        f"{run}: law",
        law,
        f"{OPEN_LOOP}: the log of an experiment, or of rise-di import",
    )
    for topic in ("y", "u", "bridge/would_send"):
        require(topic in tape, str(run), f"no {topic}", "a log of a flight with a bridge")
    if not engagements:
        raise ParameterError(
            f"{run}: found no engagement, expected a flight in which the bridge was engaged"
        )
    spans = [
        (engagement.start_ns, engagement.stop_ns or int(tape["u"].stamp_ns[-1]))
        for engagement in engagements
    ]
    early_end = None
    if isinstance(parameters, ExcitationConfig):
        early_end = reason_against_experiment(engagements, parameters.duration)
    return tape, spans, early_end


def _digits(value: float, digits: int) -> str:
    """Write a value with a number of significant digits, without an exponent if it is below 1e6.

    A narrow column would cut off the exponent.
    """
    return f"{float(f'{value:.{digits}g}'):g}"


def _show_response(
    console: Console,
    name_of_map: str,
    response: Response,
    trims: dict[str, float],
    engaged_time: float,
) -> None:
    headings = ("input", "trim", "moves", "Omega", "+-", "lag", "+-", "delay", "+-")
    table = new_table(
        f"Response of the aircraft behind {name_of_map}, {response.seconds:.0f} s without gaps "
        f"of {engaged_time:.0f} s engaged; SI, standard errors",
        headings,
        left_aligned=("input", "moves"),
    )
    table.collapse_padding = True  # nine columns have to fit into a terminal of 80 characters
    for i, (name, output) in enumerate(zip(response.inputs, response.outputs, strict=True)):
        pairs = (
            (response.Omega[i, i], response.Omega_deviation[i, i]),
            (response.lag[i], response.lag_deviation[i]),
            (response.delay[i], response.delay_deviation[i]),
        )
        cells = [f"{trims[name]:.3g}", f"{output}_dot"]
        for value, deviation in pairs:
            cells += [_digits(value, 3), _digits(deviation, 2)]
        table.add_row(name, *cells)
    print_table(console, table)


def _show_models(console: Console, response: Response, models: list[ChannelModel | None]) -> None:
    parameters = ("input", "Omega", "lag", "delay", "damping", "stiffness", "zero", "misfit")
    table = new_table("Models of the channels, SI, fitted to the output error", parameters)
    estimates = ("channel", "abs(y / u)", "+-", "y behind u, rad", "+-", "used")
    loop = new_table(
        "The models at the frequency of the loop, standard errors",
        estimates,
        left_aligned=("channel", "used"),
    )
    for output, name, model in zip(response.outputs, response.inputs, models, strict=True):
        channel = f"{output} by {name}"
        if model is not None:
            values = (
                model.Omega,
                model.lag,
                model.delay,
                model.damping,
                model.stiffness,
                model.slow / model.Omega,
            )
            table.add_row(
                name, *(f"{value:.3g}" for value in values), f"{100 * model.misfit:.0f} %"
            )
            numbers = chain.from_iterable(model.at_loop_frequency())
            loop.add_row(
                channel,
                *(f"{value:.3g}" for value in numbers),
                "model" if model.is_usable else "step response",
            )
    print_table(console, table)
    print_table(console, loop)
    # If the model of a channel is not certain, its gains come from its step response.
    uncertain = [
        name
        for name, model in zip(response.outputs, models, strict=True)
        if model is None or not model.is_usable
    ]
    if uncertain:
        say(
            console,
            f"{', '.join(uncertain)}: no certain model without a zero above {FASTEST_ZERO:g} "
            f"1/s. The law takes {uncertain[0]}_dot = Omega u from the step response. Its "
            "feedforward then has no damping, and its integral follows from the bandwidth alone.",
        )


def _show_link(console: Console, channel_map: ChannelMap, link_delay: float | None) -> None:
    """Print for which delay of the link the gains hold.

    The log was written on board, so this delay is not in it.
    """
    if link_delay is None:
        sentence = (
            f"The map {channel_map.name} states no link_delay. Gains and margins are without the "
            "link: --link-delay SECONDS adds its delay."
        )
    else:
        sentence = (
            f"The log is of the autopilot's board. Gains and margins are for {1e3 * link_delay:.0f}"
            " ms of further delay over the link (link_delay)."
        )
    say(console, sentence)


def _show_gains(
    console: Console, channels: IdentifiedChannels, response: Response, flyable: Flyable
) -> None:
    controller = flyable.controller
    params = flyable.controller.law_params()
    table = new_table("Gains by lag and delay", ("channel", "bandwidth, rad/s", "Lambda, 1/s"))
    for i, (output, name) in enumerate(zip(controller.outputs, controller.inputs, strict=True)):
        place = response.outputs.index(output)
        bandwidth = params.K[i] * params.input_scale[i] * abs(channels.Omega[place, place])
        table.add_row(f"{output} by {name}", f"{bandwidth:.3g}", f"{params.Lambda[i]:.3g}")
    print_table(console, table)
    if flyable.delay_margin is not None:
        say(
            console,
            f"delay margin beyond the delay of the gains: {1e3 * flyable.delay_margin:.0f} ms",
        )


def _as_json(
    response: Response,
    channels: IdentifiedChannels,
    flyable: Flyable,
    trims: dict[str, float],
    folder: Path,
) -> dict[str, object]:
    def numbers(values: Any) -> dict[str, Any]:
        arrays = {
            key: value for key, value in values._asdict().items() if isinstance(value, np.ndarray)
        }
        return {key: value.tolist() for key, value in arrays.items()}

    return {
        "outputs": list(response.outputs),
        "inputs": list(response.inputs),
        "step_response": numbers(response),
        "channels": numbers(channels),
        "trim": trims,
        "delay_margin": flyable.delay_margin,
        "controller": flyable.controller.model_dump(exclude_defaults=True),
        "folder": str(folder),
    }
