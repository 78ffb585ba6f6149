# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di gains`: select gains by Theorem 1 and by the engineering procedure, or check those of a scenario."""

import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from aircraft_sim.airframe import Airframe, load_airframe
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.design import gain_selection
from flight_analysis.design.gain_conditions import Condition, failing
from flight_analysis.design.gain_selection import GainAssessment, Study
from flight_analysis.design.nominal import sizes
from flight_analysis.design.observer_selection import (
    gains_by_rule,
    gains_of_search,
    model_for,
    with_aircraft_observer,
)
from flight_bringup.scenarios import find_scenario
from flight_campaign import tuned_gains
from flight_cli.output import new_table, parse_numbers, print_json, write_text
from flight_core.parameters import ParameterError, require
from rise_di_controller.linear_loop import MAX_DELAY_MARGIN
from rise_di_controller.rise_di import RiseDiConfig

CONDITION_FAILS = 1
OBSERVER_LAWS, OBJECTIVE = ("rise_observer", "pi_observer"), "gust_turbulence"
"""Laws and cost of a search whose gains are taken: those of the least cost. PI is RISE-DI with a sign that is an integral."""
SIDES = {"at least": ">=", "at most": "<=", "above": ">"}
MEANINGS = {
    "lag product": "crossover lag product, bandwidth times the lag of the loop (actuator, 1.5 periods, delay), rad: times 57.3"
    " it is the phase in deg that the lag costs at the crossover",
    "softening": "width of the softened sign in time, beside the lag of the loop: narrower than that the loop is unstable",
    "response": "how much one unit of scaled input changes y_dot, abs(Omega_ii) input_scale; bandwidth = K x response",
}
"""Terms of the table and their meaning."""
MESSAGES = 3.0  # of y: the age limit of the law, at least
HEADER = "# SPDX-FileCopyrightText: RISE-DI contributors\n# SPDX-License-Identifier: Apache-2.0\n#\n"


def gains(
    airframe: Annotated[str, typer.Argument(help="Name of an airframe, or path of an airframe file (.yaml).")],
    uncertainty: Annotated[float, typer.Option(help="Largest relative deviation of each entry of A and B.")] = 0.3,
    scenario: Annotated[str, typer.Option(help="Scenario with the commands, the gusts and the loop.")] = "osprey_servo",
    rate: Annotated[float | None, typer.Option(help="Rate of the law in Hz; by default that of the scenario.")] = None,
    y_rate: Annotated[
        float | None,
        typer.Option(help="Rate of y in Hz: a period above that of the law counts as delay, and y is stale after three."),
    ] = None,
    lag: Annotated[str | None, typer.Option(help="Lags of the actuators in s, in the airframe's order: 0.02,0.1")] = None,
    delay: Annotated[float | None, typer.Option(help="Pure delay in s; by default that of the scenario.")] = None,
    inputs: Annotated[str | None, typer.Option(help="Input of each output, in the airframe's order: rudder,aileron")] = None,
    gamma_2: Annotated[float, typer.Option(help="gamma_2 of Lemma 1 in 1/s. It is an assumption: nothing bounds it.")] = 0.0,
    samples: Annotated[
        int, typer.Option(min=0, max=10_000, help="Number of uncertain airframes for the bounds of the theorem.")
    ] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the uncertain airframes.")] = 1,
    write: Annotated[Path | None, typer.Option(help="File for the engineering gains, as a section of a scenario.")] = None,
    feedforward: Annotated[
        bool, typer.Option("--feedforward", help="Write the airframe too, as the model of the feedforward (an extension).")
    ] = False,
    observer: Annotated[
        bool, typer.Option("--observer", help="Write feedforward and observer, and the gains beside them (an extension).")
    ] = False,
    model: Annotated[
        str | None, typer.Option(help="Airframe that the observer takes as its model, as rise-di identify --log writes it.")
    ] = None,
    margin: Annotated[float, typer.Option(help="Least delay margin of the nominal loop with the observer, s.")] = 0.03,
    check: Annotated[
        bool, typer.Option("--check", help="Check the gain set of the scenario instead of selecting one.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON, nothing else.")] = False,
) -> None:
    """Select gains for an airframe by Theorem 1 and by the engineering procedure, and show every condition on both.

    Exit status: 0; 1 if a condition of the loop fails with --check; 2 bad input.
    """
    chosen, frame = find_scenario(scenario), load_airframe(airframe)
    require(rate is None or 1.0 <= rate <= 1000.0, "--rate", rate, "1 to 1000 Hz")
    require(delay is None or 0.0 <= delay <= MAX_DELAY_MARGIN, "--delay", delay, f"0 to {MAX_DELAY_MARGIN:g} s")
    require(y_rate is None or 1.0 <= y_rate <= 1000.0, "--y-rate", y_rate, "1 to 1000 Hz")
    require(0.0 <= gamma_2 < math.inf, "--gamma-2", gamma_2, "0 or more, 1/s")
    options = {
        "rate": rate,
        "delay": delay if y_rate is None else _delay_with(y_rate, chosen, rate, delay),
        "lag": None if lag is None else _parse_lags(lag, frame),
    }
    loop: dict[str, Any] = {name: value for name, value in options.items() if value is not None}
    paired = tuple(inputs.split(",")) if inputs else ()
    setting = gain_selection.loop_setting(chosen, gamma_2)._replace(inputs=paired, feedforward=feedforward, **loop)
    age = max(setting.base.max_age, MESSAGES / (y_rate or math.inf))
    setting = setting._replace(base=setting.base.model_copy(update={"max_age": age}))
    if check:
        for option, given in (("--write", write is not None), ("--feedforward", feedforward), ("--observer", observer)):
            require(not given, option, "it beside --check", "one of them: --check selects nothing to write")
        own_loop = not loop and inputs is None
        require(own_loop, "--check", "it beside another loop", "the scenario's own rate, lag, delay and inputs")
        known, named = chosen.controller.outputs, f"airframe {frame.name}"
        require(sorted(known) == sorted(frame.outputs), named, ", ".join(frame.outputs), f"the outputs {', '.join(known)}")
    require(observer or model is None, "--model", model, "--observer beside it: it is the observer's model")
    require(0.0 <= margin <= MAX_DELAY_MARGIN, "--margin", margin, f"0 to {MAX_DELAY_MARGIN:g} s")
    known_model = frame if model is None else load_airframe(model)
    console = Console(quiet=as_json)
    origin = ""
    with console.status("simulating the ideal control on uncertain airframes"):
        found = gain_selection.study_airframe(frame, gain_selection.manoeuvre(chosen, frame), uncertainty, samples, seed)
        if check:
            answers, text = {"scenario": gain_selection.check_gains(chosen, found, gamma_2)}, None
        else:
            selection = gain_selection.select_gains(found, setting)
            if observer:
                controller, origin = observed(selection.engineering.controller, chosen, known_model, margin)
                selection = selection._replace(engineering=gain_selection.assess_gains(found, controller, setting))
            answers = {"theorem": selection.theorem, "engineering": selection.engineering}
            if observer:
                answers = {"observer": selection.engineering}
            text = gain_selection.as_yaml(selection)
    if write is not None and text is not None:
        write_text("--write", write, HEADER + text)
    if as_json:
        print_json(_as_json(found, answers, seed))
    else:
        _show(console, found, answers)
        if origin:
            console.print(origin, highlight=False, soft_wrap=True)
        if write is not None:
            console.print(f"gains: {write}")
    if check and failing(answers["scenario"].loop):
        raise typer.Exit(CONDITION_FAILS)


def _delay_with(y_rate: float, scenario: Scenario, rate: float | None, delay: float | None) -> float:
    """The delay, s, with a y that is slower than the law.

    The law steps with each y, so the lag of sampling is 1.5 periods of y. Those of the law are counted from its own rate.
    """
    declared = scenario.controller.delay if delay is None else delay
    return declared + 1.5 * max(1.0 / y_rate - 1.0 / (rate or scenario.controller.rate), 0.0)


def observed(controller: RiseDiConfig, scenario: Scenario, model: Airframe, margin: float) -> tuple[RiseDiConfig, str]:
    """A controller with feedforward and observer of a model, and a sentence on its gains.

    The gains are those that `rise-di compare --tune` found in the scenario, or in one that ships with its airframe and lags,
    where the model has the same states; else they follow from the lags by a rule. Of several gain sets it is the one that the
    delay margin changes least, then the one of the least cost.
    """
    noises = scenario.aircraft.sensors.noise or (0.0,) * len(controller.outputs)
    by_name = dict(zip(scenario.aircraft.channels().outputs, noises, strict=True))
    perfect = sizes(model.states[name] for name in controller.outputs) / 100.0  # noise in place of none, of a perfect sensor
    noise = np.array([by_name[name] or least for name, least in zip(controller.outputs, perfect, strict=True)])
    nominal = model_for(model, controller, noise)
    tuned = _tuned_scenario(scenario)
    results = {law: tuned_gains.find(tuned, law, OBJECTIVE) for law in OBSERVER_LAWS}
    searched = sorted(((one.cost, law, one) for law, one in results.items() if one is not None), key=lambda one: one[0])
    candidates = [(gains_by_rule(nominal, tuple(model.gusts), model.speed), "gains by a rule from the lags, a start")]
    if searched and tuple(scenario.aircraft.load()[0].states) == tuple(model.states):
        origins = (f"gains of a search in {tuned.name}, law {law} on {OBJECTIVE}" for _, law, _ in searched)
        of_search = (gains_of_search(one.gains, nominal.total_lag) for _, _, one in searched)
        candidates = list(zip(of_search, origins, strict=True))
    selected, refusal = [], None
    for gains, origin in candidates:
        try:
            selected.append((with_aircraft_observer(controller, model, gains, noise, margin), origin))
        except ParameterError as error:  # another gain set may have the margin
            refusal = error
    if refusal is not None and not selected:
        raise refusal
    # the first, of the least cost, where several need none
    found, origin = min(selected, key=lambda one: float(np.prod(one[0].relaxation)))
    factors = zip(found.controller.outputs, found.relaxation.tolist(), strict=True)
    relaxed = ", ".join(f"{output} {factor:.2f}" for output, factor in factors if factor > 1.0)
    lowered = f"; for the margin K / and effort x {relaxed}" if relaxed else ""
    return found.controller, f"observer of {model.name}: {origin}{lowered}; delay margin {1e3 * found.delay_margin:.0f} ms"


def _tuned_scenario(scenario: Scenario) -> Scenario:
    """The scenario itself if it has tuned gains, else one that ships with the same airframe and actuators and has them."""
    shipped = (find_scenario(path.stem) for path in sorted(tuned_gains.TUNED.glob("*.yaml")))
    own = scenario.aircraft.airframe, scenario.aircraft.actuators.lag
    alike = (one for one in shipped if (one.aircraft.airframe, one.aircraft.actuators.lag) == own)
    return next((one for one in (scenario, *alike) if tuned_gains.load(tuned_gains.tuned_file(one))), scenario)


def _parse_lags(text: str, airframe: Airframe) -> dict[str, float]:
    """Lags by input from "0.02,0.1", or from one value for all. Raises ParameterError."""
    names = list(airframe.inputs)
    values = parse_numbers(text)
    require(bool(values), "--lag", repr(text), "seconds separated by commas")
    values = values * len(names) if len(values) == 1 else values
    require(len(values) == len(names), "--lag", f"{len(values)} values", f"one for all or one for each of {', '.join(names)}")
    require(all(0.0 <= value < math.inf for value in values), "--lag", text, "seconds, 0 or more")
    return dict(zip(names, values, strict=True))


def _show(console: Console, found: Study, answers: dict[str, GainAssessment]) -> None:
    first = next(iter(answers.values()))
    outputs = first.controller.outputs
    samples = len(found.A) - 1
    title = f"Gains for {found.airframe.name}, A and B +-{100 * found.uncertainty:g} % ({samples} samples); K, Lambda in 1/s,"
    headings = [heading for name in answers for heading in (f"{name}\nK", "\nLambda", "\nbeta")]
    table = new_table(f"{title} beta in units of y / s^2", ["channel", "D", *headings], left=("channel",))
    for i, (output, name) in enumerate(zip(outputs, first.controller.inputs, strict=True)):
        row = [f"{output} by {name}", f"{first.controller.D[i]:+d}"]
        for answer in answers.values():
            params = answer.controller.law_params()
            row += [f"{params.K[i]:.4g}", f"{params.Lambda[i]:.3g}", f"{params.beta[i]:.4g}"]
        table.add_row(*row)
    console.print(table)
    for name, answer in answers.items():
        console.print(f"{name}: {_format_delay_margin(found, answer)}", highlight=False, soft_wrap=True)

    for part, heading in (("theorem", "Theorem 1"), ("loop", "The loop")):
        headings = [text for name in answers for text in (f"{name}\nvalue and bound", "\nmargin")]
        table = new_table(f"\n{heading}", ["condition", *headings], left=("condition",), wrapped=("condition",))
        for row_ in zip(*(getattr(answer, part) for answer in answers.values()), strict=True):
            table.add_row(_condition_name(row_, outputs), *(cell for condition in row_ for cell in _cells(condition)))
        console.print(table)
    gamma_2 = first.bounds.gamma_2[0]
    console.print(
        f"margin: a condition holds above 1 and fails (!) below; ~ is an estimate: gamma_2 = {gamma_2:g} 1/s is an assumption",
        soft_wrap=True,
    )
    for word, meaning in MEANINGS.items():
        console.print(f"{word}: {meaning}", highlight=False, soft_wrap=True)
    for name, answer in answers.items():
        failed = answer.failing
        console.print(f"{name}: {'every condition holds' if not failed else f'{len(failed)} conditions fail'}", highlight=False)
        for condition in failed if len(answers) == 1 else ():
            console.print(f"  {condition.sentence(outputs)}", highlight=False)


def _condition_name(row: tuple[Condition, ...], outputs: tuple[str, ...]) -> str:
    """Name of a row, with the channel if it is the same in every gain set."""
    where = {None if condition.channel is None else outputs[condition.channel] for condition in row}
    channel = where.pop() if len(where) == 1 else None
    return row[0].name + (f" of {channel}" if channel else "") + (" ~" if row[0].estimate else "")


def _format_delay_margin(found: Study, answer: GainAssessment) -> str:
    if answer.delay_margin is None:
        return "no linear loop (literal sign)"
    if answer.delay_margin == 0.0:
        return "predicted delay margin none: the linear loop is unstable with this lag"
    each = zip(answer.controller.outputs, answer.channel_margins, strict=True)
    alone = ", ".join(f"{output} {_milliseconds(margin)}" for output, margin in each)
    margin = f"predicted delay margin {_milliseconds(answer.delay_margin)}; in one channel alone: {alone}"
    return f"{margin}; {speed_of_margin(found, answer)}"


def speed_of_margin(found: Study, answer: GainAssessment) -> str:
    """Up to which speed a delay margin above 0 lasts with fixed gains."""
    ratio = gain_selection.stable_speed_ratio(found, answer.controller)
    if math.isinf(ratio):
        return f"it lasts beyond {gain_selection.MAX_SPEED_RATIO:g} times the trim speed"
    return f"it lasts up to {ratio * found.airframe.speed:.3g} m/s, {ratio:.3g} of the trim speed, without a schedule"


def _stable_speed_ratio(found: Study, answer: GainAssessment) -> float | None:
    """The ratio; None where the literal sign has no linear loop, or without a limit."""
    if answer.delay_margin is None:
        return None
    ratio = gain_selection.stable_speed_ratio(found, answer.controller)
    return ratio if math.isfinite(ratio) else None


def _milliseconds(margin: float) -> str:
    return f"{1e3 * margin:.0f} ms" if math.isfinite(margin) else "over 500 ms"


def _cells(condition: Condition) -> tuple[str, str]:
    margin = "" if math.isnan(condition.margin) else f"{condition.margin:.2g}"
    side = SIDES[condition.side]
    return f"{condition.found:.4g} {side} {condition.bound:.4g}", margin if condition.holds else f"[red]{margin} ![/red]"


def _as_json(found: Study, answers: dict[str, GainAssessment], seed: int) -> dict[str, Any]:
    inputs = list(found.airframe.inputs)
    return {
        "airframe": found.airframe.name,
        "uncertainty": found.uncertainty,
        "samples": len(found.A) - 1,
        "seed": seed,
        "slew": dict(zip(inputs, found.slew.tolist(), strict=True)),
        "slew_calm": dict(zip(inputs, found.slew_undisturbed.tolist(), strict=True)),
    } | {
        name: {
            "controller": answer.controller.model_dump(exclude_none=True),
            "delay_margin": answer.delay_margin,
            "channel_margins": answer.channel_margins,
            "stable_speed_ratio": _stable_speed_ratio(found, answer),
            "bounds": {key: getattr(answer.bounds, key).tolist() for key in ("U", "N_d", "gamma_2")}
            | {"rho": answer.bounds.rho},
            "conditions": [
                {
                    "name": condition.name,
                    "part": part,
                    "channel": None if condition.channel is None else answer.controller.outputs[condition.channel],
                    "found": condition.found,
                    condition.side.replace(" ", "_"): condition.bound,
                    "margin": condition.margin,
                    "holds": condition.holds,
                    "estimate": condition.estimate,
                }
                for part in ("theorem", "loop")
                for condition in getattr(answer, part)
            ],
        }
        for name, answer in answers.items()
    }
