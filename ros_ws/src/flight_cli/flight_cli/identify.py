# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di identify`: an aircraft of JSBSim by step tests, with its scenario, or A and B of an
airframe from a flight's log.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from rich.console import Console

from aircraft_sim.airframe import Airframe, load_airframe
from aircraft_sim.jsbsim_aircraft import PREFIX, NamedProperties, named_properties, require_aircraft
from flight_analysis.closed_loop.replay import recorded_parameters, recorded_scenario
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics import mask_spans
from flight_analysis.report.figures import ERROR, GUST, PLANT
from flight_analysis.report.html import Line, Page, Section, page_html
from flight_analysis.report.plotting import (
    Curve,
    Interval,
    PlotContext,
    SampleStore,
    time_series_figure,
)
from flight_analysis.report.summary import DisplayUnit, display_unit
from flight_cli.bridge_experiment import identify_behind_bridge
from flight_cli.identified import identified_as_json, show_identified
from flight_cli.log_options import scenario_file, warn_of_lacks
from flight_cli.output import (
    COUNT_COLUMNS,
    entries_as_json,
    entry_table,
    new_table,
    print_json,
    progress_bar,
    require_yaml,
    say,
    write_text,
)
from flight_cli.words import WRITE, AsJson, argument, option, setting, warn
from flight_core.files import display_path
from flight_core.outcome import FlightEnded
from flight_core.parameters import ParameterError, require, require_channels
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_design.gains.gain_design import observed
from flight_design.gains.ideal_control import ChannelPairing
from flight_design.gains.relaxation import lacking as what_lacks
from flight_design.gains.requirement import PHASE_MARGIN, Requirement, requirement
from flight_design.identification.bridge_identification import AMPLITUDE
from flight_design.identification.innovation_filters import Actuation, recording
from flight_design.identification.manoeuvre import manoeuvre_result
from flight_design.identification.model_identification import Identification, model_yaml
from flight_design.identification.model_identification import identify as identify_model
from flight_design.identification.step_identification import identify as identify_aircraft
from flight_log.tape_reader import read_run
from rise_di_controller.params import ControllerConfig

CANNOT_FLY = 3
REFLY_MARGIN = 0.03  # s. Without A the model of the loop has no damping
STEP_MARGIN = 0.015  # and less margin than the aircraft.


def identify(
    source: Annotated[
        str | None,
        argument(
            "jsbsim:NAME or jsbsim:PATH, an aircraft of JSBSim; or a log: the folder of a "
            "run, or an MCAP file. None with --bridge alone."
        ),
    ] = None,
    speed: Annotated[float | None, option("True airspeed to trim and fly at, m/s.")] = None,
    altitude: Annotated[
        float | None, option("Altitude above sea level to trim and fly at, m.")
    ] = None,
    airframe: Annotated[
        str | None, option("With a log: the nominal airframe, a name or a file (.yaml).")
    ] = None,
    write: Annotated[
        Path | None,
        option(
            "Scenario file, by default jsbsim_NAME.yaml, which must not exist. With a log: "
            "airframe file for the model, with a page. With --bridge: folder for what flies it.",
            *WRITE,
        ),
    ] = None,
    scenario: Annotated[
        str | None,
        setting(
            "scenario",
            "With a log: scenario with lags and delay of the controller; by default that "
            "in the log.",
        ),
    ] = None,
    delay: Annotated[
        float | None,
        setting(
            "delay",
            "With a log: delay of u, s; by default that of the scenario. One process has none.",
        ),
    ] = None,
    namespace: Annotated[
        str | None,
        setting("namespace", "With a log: namespace of the aircraft, if it holds several."),
    ] = None,
    refly: Annotated[
        bool,
        setting(
            "refly",
            "With a log: fly its scenario with feedforward and observer of the model, in process.",
        ),
    ] = False,
    observer: Annotated[
        bool, option("Of JSBSim: add an extended-state observer from Omega and lags.", "--observer")
    ] = False,
    guidance: Annotated[
        bool,
        option("Of JSBSim: fly and write guidance by rule in place of the pulses.", "--guidance"),
    ] = False,
    learn: Annotated[
        bool, option("Of JSBSim: write a scenario that learns A and B in flight.", "--learn")
    ] = False,
    margin: Annotated[
        float | None,
        setting(
            "margin",
            "Least delay margin of the loop with an observer, s: 0.03, or 0.015 from step tests.",
        ),
    ] = None,
    bridge: Annotated[
        str | None,
        option(
            "Excite the aircraft behind a channel map, or read the log of such a flight.",
            metavar="MAP",
        ),
    ] = None,
    amplitude: Annotated[
        float | None,
        setting(
            "amplitude",
            "With --bridge: amplitude of the excitation, a part of each input's limit; 0.2.",
        ),
    ] = None,
    phase_margin: Annotated[
        float | None,
        setting(
            "phase_margin", "Of JSBSim, or with --bridge: least phase margin of the loop, deg; 45."
        ),
    ] = None,
    accept: Annotated[
        bool,
        setting(
            "accept",
            "Accept a phase margin below 40 deg, and gains whose margins fall short.",
        ),
    ] = False,
    commands: Annotated[
        list[str] | None,
        setting(
            "command",
            "Of JSBSim: a model's own property for an input, and its value at full "
            "command; repeat for more.",
            metavar="INPUT:PROPERTY=VALUE",
        ),
    ] = None,
    link_delay: Annotated[
        float | None,
        typer.Option(
            "--set link_delay",
            help="With --bridge and a log of rise-di import: delay of the link beyond the log, s; "
            "by default that of the map.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Identify an aircraft of JSBSim by step tests, or A and B of an airframe from the log of a
    flight.

    The step tests also select gains, fly the aircraft and write a scenario for `rise-di fly`. A
    model from a log is accepted if it predicts the part of the flight that it was not fitted to
    better than the nominal airframe. With --bridge, each input of the aircraft behind a channel map
    is excited by itself, open loop, and --write is the folder for a scenario that flies it.

    Exit status: 0, 2 bad input or a model that is refused, 3 the aircraft does not trim or does not
    fly.
    """
    needed = requirement(PHASE_MARGIN if phase_margin is None else phase_margin, accept=accept)
    log = None if source is None or source.startswith(PREFIX) else Path(source)
    if bridge is None and log is not None and not log.exists() and speed is not None:
        log = None  # the name of an aircraft without its prefix
    aircraft = source if log is None else None
    if bridge is not None:
        unused: dict[str, object] = {
            "aircraft": aircraft,
            "altitude": altitude,
            "airframe": airframe,
            "margin": margin,
            "scenario": scenario,
        }
        unused |= {
            "delay": delay,
            "refly": refly,
            "observer": observer,
            "guidance": guidance,
            "learn": learn,
        }
        _require_none(
            unused | {"namespace": namespace, "command": commands}, "none beside --bridge"
        )
        if write is None:
            raise ParameterError(
                "identify: found too few arguments, expected --write beside --bridge"
            )
        require(speed is None or 0.0 < speed < math.inf, "speed", f"{speed}", "above 0 m/s")
        part = AMPLITUDE if amplitude is None else amplitude
        require(
            link_delay is None or 0.0 <= link_delay < math.inf,
            "link_delay",
            link_delay,
            "0 or more",
        )
        identify_behind_bridge(bridge, speed, write, part, log, as_json, needed, accept, link_delay)
        return
    require(link_delay is None, "link_delay", link_delay, "--bridge beside it")
    require(amplitude is None, "amplitude", amplitude, "--bridge beside it")
    require(
        margin is None or refly or observer or learn,
        "margin",
        margin,
        "--set refly, --observer or --learn beside it",
    )
    require(
        not (observer and learn),
        "observer",
        "--learn beside it",
        "one of the two: a learner designs its own observer",
    )
    if log is not None:
        steps_only: dict[str, object] = {
            "speed": speed,
            "altitude": altitude,
            "observer": observer,
            "guidance": guidance,
            "learn": learn,
        }
        _require_none(
            steps_only | {"phase_margin": phase_margin, "accept": accept, "command": commands},
            "none beside a log",
        )
        require(
            airframe is not None,
            "airframe",
            "none",
            "the nominal airframe of the log, a name or a file (.yaml)",
        )
        nominal = load_airframe(airframe or "")
        refly_margin = (REFLY_MARGIN if margin is None else margin) if refly else None
        _identify_log(
            _Source(log, scenario, delay, namespace), nominal, write, refly_margin, as_json
        )
    elif aircraft is None or speed is None or altitude is None:
        raise ParameterError(
            "identify: found too few arguments, expected a log, or an aircraft with --speed and "
            "--altitude"
        )
    else:
        log_only = {
            "airframe": airframe,
            "scenario": scenario,
            "delay": delay,
            "namespace": namespace,
            "refly": refly,
        }
        _require_none(log_only, "a log in place of the aircraft")
        observer_margin = (STEP_MARGIN if margin is None else margin) if observer or learn else None
        texts: dict[str, str] = {}
        for text in commands or []:
            name, _, paths = text.partition(":")
            texts[name] = f"{texts.get(name, '')} {paths}".strip()
        flown = _Flown(observer_margin, guidance, learn, named_properties(texts, "--set command"))
        _identify_by_steps(aircraft, speed, altitude, write, flown, as_json, needed, accept)


def _require_none(values: Mapping[str, object], expected: str) -> None:
    """Raise ParameterError for the first option with a value."""
    for name, value in values.items():
        require(value in (None, False), name, f"{value}", expected)


class _Flown(NamedTuple):
    """What the scenario has beside the gains."""

    observer_margin: float | None  # s; None without an observer
    guided: bool
    learns: bool
    named: tuple[tuple[str, NamedProperties], ...]  # properties of the model by input


def _identify_by_steps(
    airframe: str,
    speed: float,
    altitude: float,
    output: Path | None,
    flown: _Flown,
    as_json: bool,
    needed: Requirement,
    accept: bool,
) -> None:
    require(
        airframe.startswith(PREFIX),
        "aircraft",
        f"{airframe!r}",
        f"an aircraft of JSBSim, {PREFIX}NAME or {PREFIX}PATH",
    )
    try:
        name = require_aircraft(airframe)
    except ParameterError as error:  # the option --airframe is that of a log
        raise ParameterError(f"aircraft{str(error).removeprefix('airframe')}") from None
    require(0.0 < speed < math.inf, "--speed", speed, "above 0 m/s")
    require(0.0 <= altitude < math.inf, "--altitude", altitude, "0 m or more")
    path = output or Path(f"jsbsim_{Path(name).stem}.yaml")
    require(
        output is not None or not path.exists(),
        "write",
        f"none, and {path} exists",
        "a file to write over, or another",
    )
    require_yaml("write", path)
    console = Console(quiet=as_json)
    try:
        with console.status("trim") as status:
            identified = identify_aircraft(
                name,
                speed,
                altitude,
                status.update,
                flown.observer_margin,
                guided=flown.guided,
                learns=flown.learns,
                needed=needed,
                named=flown.named,
            )
    except FlightEnded as error:
        warn(f"error: {error}")
        raise typer.Exit(CANNOT_FLY) from None
    write_text("write", path, identified.text)
    if as_json:
        print_json(identified_as_json(identified, path))
    else:
        show_identified(console, identified)
        console.print(f"scenario: {display_path(path)}", highlight=False)
    if identified.failure:
        warn(f"error: {identified.condition.title} does not fly: {identified.failure}")
        raise typer.Exit(CANNOT_FLY)
    if lacking := "" if accept else what_lacks(identified.selection):
        shown = f"{display_path(path)}, which says so in its first line; --set accept takes it"
        raise ParameterError(f"identify: {lacking}; the gains are in {shown}")


class _Source(NamedTuple):
    """The log, and what else tells of its flight."""

    log: Path
    scenario: str | None
    delay: float | None
    namespace: str | None


def _identify_log(
    source: _Source,
    nominal: Airframe,
    write: Path | None,
    refly_margin: float | None,
    as_json: bool,
) -> None:
    """Identify a model from a log, show it and write it. Raises ParameterError for a model that is
    refused.
    """
    if write is not None:
        require_yaml("--write", write)
    recorded = read_run(source.log, source.namespace, scenario_file(source.scenario))
    recorded.require()
    warn_of_lacks(recorded)
    if recorded.scenario is None:
        raise ParameterError(
            f"{source.log}: found a log without its scenario, expected --set scenario=NAME with "
            "the controller's lags"
        )
    controller = recorded_parameters(recorded.scenario)
    actuation = _actuation(
        controller, nominal, controller.delay if source.delay is None else source.delay
    )
    samples = recording(recorded.tape, nominal)
    console = Console(quiet=as_json)
    with progress_bar(*COUNT_COLUMNS, quiet=as_json) as bar:
        task = bar.add_task("search")
        show = partial(bar.update, task)
        identification = identify_model(
            samples, nominal, actuation, ChannelPairing(controller.outputs, controller.inputs), show
        )
        show(completed=1, total=1)
    _show_model(console, identification)
    if identification.refusal:
        raise ParameterError(f"{source.log}: {identification.refusal}")
    if write is not None:
        write_text("--write", write, model_yaml(identification, str(source.log)))
        page = write.with_suffix(".html")
        write_text("--write", page, page_html(_innovation_page(identification, source.log.name)))
        console.print(
            f"model: {display_path(write)}, innovations: {display_path(page)}", highlight=False
        )
    again = None
    if refly_margin is not None:
        with console.status("flying with the model"):
            again = _refly(
                recorded_scenario(recorded.scenario),
                recorded.tape,
                identification.airframe,
                refly_margin,
            )
        _show_flights_of_model(console, again, _units(identification))
    if as_json:
        print_json(
            _model_as_json(identification, write)
            | ({} if again is None else {"refly": again._asdict()})
        )


class _Reflight(NamedTuple):
    """Rms errors of a recorded flight and of the same one with feedforward and observer of a model,
    SI, by output.
    """

    origin: str  # of the observer's gains
    recorded: dict[str, float]
    again: dict[str, float]
    outcome: str


def _refly(scenario: Scenario, tape: Tape, model: Airframe, margin: float) -> _Reflight:
    """The scenario of a log, flown in this process under feedforward and observer of a model."""
    controller, origin = observed(scenario.rise_di(), scenario, model, margin)
    again = simulate(replace(scenario, controller=controller))
    return _Reflight(origin, manoeuvre_result(tape).rms, manoeuvre_result(again).rms, again.outcome)


def _show_flights_of_model(
    console: Console, again: _Reflight, units: dict[str, DisplayUnit]
) -> None:
    headings = ["flight", *(f"{name}\n{unit.unit}" for name, unit in units.items())]
    table = new_table("\nRms of the error", headings)
    for title, rms in (("recorded", again.recorded), ("with the model", again.again)):
        table.add_row(title, *(f"{rms[name] * unit.factor:.3g}" for name, unit in units.items()))
    console.print(table)
    say(console, f"{again.origin}; outcome: {again.outcome}")


def _actuation(controller: ControllerConfig, nominal: Airframe, delay: float) -> Actuation:
    """Lags and delay of a controller's loop, in the airframe's order."""
    require(0.0 <= delay < math.inf, "--delay", delay, "0 s or more")
    for key, names, expected in (
        ("controller.outputs", controller.outputs, nominal.outputs),
        ("controller.inputs", controller.inputs, tuple(nominal.inputs)),
    ):
        require_channels(key, names, expected, f"the channels of the airframe {nominal.name}")
    lag = dict(zip(controller.inputs, controller.lag, strict=True))
    return Actuation(np.array([lag[name] for name in nominal.inputs]), delay)


def _show_model(console: Console, identification: Identification) -> None:
    console.print(entry_table(f"A and B of {identification.airframe.name}", identification.entries))
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
    console.print(table)
    gain = identification.after.log_likelihood - identification.before.log_likelihood
    console.print(
        f"whiteness: 1 for white noise; change of the log-likelihood of a sample: {gain:+.3g}",
        highlight=False,
    )


def _units(identification: Identification) -> dict[str, DisplayUnit]:
    units = identification.airframe.units_of_outputs()
    return {name: display_unit(unit) for name, unit in units.items()}


def _innovation_page(identification: Identification, name: str) -> Page:
    """Innovations of the nominal and of the identified model over the flight, the held-out seconds
    shaded.
    """
    t = identification.recorded.t - identification.recorded.t[0]
    before, after = (
        Signal(np.round(t * NANOSECONDS).astype(np.int64), identification.airframe.outputs, r)
        for r in identification.innovations
    )
    held_out = [
        Interval("held out", start, stop, GUST, False)
        for start, stop in mask_spans(t, identification.held_out)
    ]
    context = PlotContext(Tape({}), _units(identification), held_out, float(t[-1]), SampleStore())
    figure = time_series_figure(
        context, {"nominal": Curve(before, ERROR), "identified": Curve(after, PLANT)}
    )
    section = Section(
        "Innovations",
        "y less its prediction from the samples before; shaded: not in the fit",
        figure,
    )
    likelihoods = (
        f"{identification.before.log_likelihood:.4g} nominal, "
        f"{identification.after.log_likelihood:.4g} identified"
    )
    line = Line(f"log-likelihood of a held-out sample: {likelihoods}")
    return Page(
        f"Model of {identification.airframe.name} from {name}",
        [line],
        [],
        [section],
        context.samples,
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
