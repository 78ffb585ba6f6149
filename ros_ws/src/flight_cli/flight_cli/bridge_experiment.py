# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The part of `rise-di identify` that excites the aircraft behind a channel map, and writes a scenario that flies it."""

import json
from pathlib import Path

import numpy as np
from rich.console import Console

from autopilot_bridge.params import ChannelMap, find_map, load_map
from flight_analysis.closed_loop.scenario import load_scenario
from flight_analysis.design.bridge_identification import (
    Experiment,
    channel_pairs,
    experiment,
    flying_scenario,
)
from flight_analysis.design.gain_selection import Selection
from flight_analysis.design.response_identification import Response, identify_response
from flight_analysis.metrics import engaged_spans
from flight_analysis.report.run_folder import new_run
from flight_bringup.fly import fly_over_topics
from flight_bringup.graph import find_autopilot
from flight_cli.output import CLOCK_COLUMNS, display_path, new_table, progress_bar, write_text
from flight_core.parameters import ParameterError, require
from flight_core.vectors import FloatArray
from flight_log.tape_reader import read_run


def identify_behind_bridge(
    map_name: str, speed: float, folder: Path, amplitude: float, log: Path | None, runs: Path, as_json: bool
) -> None:
    """Excite the aircraft behind a map, or read the log of such a flight, and write what flies it into `folder`."""
    channel_map = load_map(map_name)
    require(0.0 < amplitude <= 1.0, "--amplitude", amplitude, "above 0 and at most 1, a part of the limits of the map")
    require(folder.is_dir() or not folder.exists(), "--write", folder, "a folder, or the name of a new one")
    folder.mkdir(parents=True, exist_ok=True)
    console = Console(quiet=as_json)
    run = _excite(console, channel_map, map_name, speed, folder, amplitude, runs) if log is None else log
    response = _response(channel_map, run)
    _show_response(console, channel_map, response)
    airframe = folder / "airframe.yaml"
    selection, airframe_text, text = flying_scenario(channel_map, response, speed, str(airframe.resolve()))
    for path, content in ((airframe, airframe_text), (folder / "scenario.yaml", text)):
        write_text("--write", path, content)
    write_text("--write", folder / "map.yaml", find_map(map_name).read_text(encoding="utf-8"))
    load_scenario(folder / "scenario.yaml")
    if as_json:
        print(json.dumps(_as_json(response, selection, folder)))
        return
    _show_gains(console, selection)
    scenario, copied = folder / "scenario.yaml", folder / "map.yaml"
    console.print(f"to fly it: rise-di fly {scenario} --bridge {copied} --send", highlight=False, soft_wrap=True)


def _excite(
    console: Console, channel_map: ChannelMap, map_name: str, speed: float, folder: Path, amplitude: float, runs: Path
) -> Path:
    """Fly the experiment; the folder of its run."""
    airframe, scenario = folder / "experiment_airframe.yaml", folder / "experiment.yaml"
    planned = experiment(channel_map, speed, amplitude, str(airframe.resolve()))
    write_text("--write", airframe, planned.airframe)
    write_text("--write", scenario, planned.scenario)
    chosen = load_scenario(scenario)
    _announce(console, planned, chosen.flight.duration)
    run = new_run(chosen, runs)
    with progress_bar(*CLOCK_COLUMNS, quiet=console.quiet) as bar:
        task = bar.add_task("experiment", total=chosen.flight.duration, clock="", shown="")

        def progress(t: float, shown: str) -> None:
            bar.update(task, completed=t, clock=f"t = {t:5.1f} of {chosen.flight.duration:g} s", shown=shown)

        outcome = fly_over_topics(chosen, run, progress, autopilot=find_autopilot(map_name, dry_run=False))
    console.print(f"outcome: {outcome}\nlog:     {display_path(run)}", highlight=False)
    return run


def _announce(console: Console, planned: Experiment, duration: float) -> None:
    """The whole experiment, before it begins."""
    controller = planned.controller
    table = new_table(
        f"Excitation, {controller.duration:.0f} s open loop after engagement, one input after another",
        ("input", "amplitude", "doublets, s", "multisine, s", "Hz"),
        left=("input",),
    )
    for i, name in enumerate(controller.inputs):
        width, band = controller.width[i], f"{controller.lowest[i]:g} to {controller.highest[i]:g}"
        table.add_row(
            name, f"{controller.amplitude[i]:.3g}", f"{2 * width:g}, {4 * width:g}", f"{controller.period[i]:g}", band
        )
    console.print(table)
    console.print(
        f"Trim the aircraft in level flight, in the mode in which sticks move surfaces, then: rise-di engage (within"
        f" {duration - controller.duration:.0f} s). The pilot's override, rise-di engage --off and Ctrl-C end it at any time.",
        highlight=False,
        soft_wrap=True,
    )


def _response(channel_map: ChannelMap, run: Path) -> Response:
    """The response in the log of a run. Raises ParameterError for a log in which the bridge was never engaged."""
    tape, (pairing, _) = read_run(run).tape, channel_pairs(channel_map)
    for topic in ("y", "u", "internals"):
        require(topic in tape, str(run), f"no {topic}", "a log of a flight with a controller")
    spans = engaged_spans(tape)
    if not spans:
        raise ParameterError(f"{run}: found no engaged stretch, expected a flight in which the bridge was engaged")
    return identify_response(tape["y"], tape["u"], pairing.outputs, pairing.inputs, engaged=spans)


def _show_response(console: Console, channel_map: ChannelMap, response: Response) -> None:
    headings = ("input", "moves", "Omega_ii", "+-", "lag, s", "+-", "delay, s", "+-")
    table = new_table(
        f"Response of the aircraft behind {channel_map.name}, {response.seconds:.0f} s of log; SI, standard errors",
        headings,
        left=("input", "moves"),
    )
    for i, (name, output) in enumerate(zip(response.inputs, response.outputs, strict=True)):
        pairs = (
            (response.Omega[i, i], response.Omega_deviation[i, i]),
            (response.lag[i], response.lag_deviation[i]),
            (response.delay[i], response.delay_deviation[i]),
        )
        table.add_row(name, f"{output}_dot", *(f"{value:.3g}" for pair in pairs for value in pair))
    console.print(table)


def _show_gains(console: Console, selection: Selection) -> None:
    answer = selection.engineering
    controller, params = answer.controller, answer.controller.law_params()
    table = new_table("Gains by lag and delay", ("channel", "bandwidth, rad/s", "Lambda, 1/s"), left=("channel",))
    response = np.abs(np.diag(_in_law_order(selection))) * params.input_scale
    for i, (output, name) in enumerate(zip(controller.outputs, controller.inputs, strict=True)):
        table.add_row(f"{output} by {name}", f"{params.K[i] * response[i]:.3g}", f"{params.Lambda[i]:.3g}")
    console.print(table)
    if answer.delay_margin is not None:
        console.print(f"delay margin beyond the identified delay: {1e3 * answer.delay_margin:.0f} ms", highlight=False)


def _in_law_order(selection: Selection) -> FloatArray:
    airframe, controller = selection.study.airframe, selection.engineering.controller
    rows = [airframe.outputs.index(name) for name in controller.outputs]
    columns = [list(airframe.inputs).index(name) for name in controller.inputs]
    return np.asarray(selection.study.Omega[np.ix_(rows, columns)])


def _as_json(response: Response, selection: Selection, folder: Path) -> dict[str, object]:
    arrays = {key: value.tolist() for key, value in response._asdict().items() if isinstance(value, np.ndarray)}
    return {
        "outputs": list(response.outputs),
        "inputs": list(response.inputs),
        **arrays,
        "delay_margin": selection.engineering.delay_margin,
        "controller": selection.engineering.controller.model_dump(exclude_defaults=True),
        "folder": str(folder),
    }
