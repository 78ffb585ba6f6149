# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Sampling of the sign in equation (21): residual errors and chatter by scheme, period and world.

python -m benchmarks.sampling          # periods of 20, 10 and 5 ms, a minute or two
python -m benchmarks.sampling --all    # 2 and 1 ms too
"""

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from math import ceil
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from rich import box
from rich.console import Console
from rich.progress import track
from rich.table import Table

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics import error_metrics, true_error
from flight_analysis.report.summary import display_units
from flight_core.parameters import ParameterError
from flight_core.tape import Signal, Tape
from flight_core.units import si_per_unit
from flight_core.vectors import FloatArray

WORLDS = {"paper": "no actuators", "servo": "actuators with lag, rate limits and end stops"}
PERIODS, SMALL_PERIODS = (0.02, 0.01, 0.005), (0.002, 0.001)  # s
WIDTH = 150  # characters, smallest width of the tables
MAX_STABLE_STEP = 0.0025  # s, of the integration
NO_SIGN = 1e-9  # times beta: the law is then a PI controller

# Gains that show the sign term: bandwidths K = 25, 20, 12, 3 rad/s of q, p, r, V, and beta far above its bound in calm air.
GAINS = {"k_g": 2.0, "k_d": [22.0, 17.0, 9.0], "Lambda": [3.0, 3.0, 2.0, 1.0], "delay": 0.0}
BETA = {"elevator": 4.0, "thrust": 50.0, "aileron": 15.0, "rudder": 15.0}  # deg/s and %/s

SINES = {
    "q": {"amplitude": 0.1, "frequency": 1.0},
    "V": {"amplitude": 1.0, "frequency": 0.3},
    "p": {"amplitude": 0.25, "frequency": 0.8, "phase": 0.4},
    "r": {"amplitude": 0.02, "frequency": 1.3},
}  # rad/s or m/s, rad/s, rad; the turn coordination adds to r
REST, MOVING = (50.0, 60.0), (10.0, 60.0)  # s, windows of the errors: after the last gust, after the first transient

GUST_BETA = (
    {"elevator": 30.0, "thrust": 130.0, "aileron": 15.0, "rudder": 60.0},
    {"elevator": 15.0, "thrust": 60.0, "aileron": 15.0, "rudder": 40.0},
)  # deg/s and %/s: above and below the slew of the ideal control in the gusts, 23, 114, 10 and 44
GUST_PERIODS = (0.01, 0.005)  # s


class Case(NamedTuple):
    """One flight and the window of its figures."""

    scenario: Scenario
    window: tuple[float, float]  # s


class Figures(NamedTuple):
    """Figures of one flight, channels in the airframe's order."""

    rms: FloatArray  # (m,) of the true error, SI
    activity: FloatArray  # (m,) mean abs(u_dot), units of the airframe file / s


def fly(case: Case) -> Figures:
    """Simulate a scenario in one process. Raises ParameterError for an invalid one."""
    tape = simulate(case.scenario)
    error = true_error_of(tape)
    start, stop = case.window
    t, t_u = error.stamp_ns / 1e9, tape.time("u")
    rms = np.array([error_metrics(error[name][(t >= start) & (t <= stop)]).rms for name in error.names])
    units, inside = display_units(case.scenario), (t_u >= start) & (t_u <= stop)
    slew = [
        np.mean(np.abs(np.diff(tape["u"][name][inside]) / np.diff(t_u[inside]))) * units[name].factor
        for name in case.scenario.aircraft.load()[0].inputs
    ]
    return Figures(rms, np.array(slew))


def true_error_of(tape: Tape) -> Signal:
    """The true error. Raises ParameterError for a tape without it."""
    error = true_error(tape)
    if error is None:
        raise ParameterError("truth: found no outputs, expected those of the simulated aircraft")
    return error


def scaled_beta(scenario: Scenario, rates: Mapping[str, float]) -> list[float]:
    """Beta in scaled inputs, in the law's order, of slew rates of the inputs in the airframe file's units."""
    airframe, _ = scenario.aircraft.load()
    controller = scenario.controller
    return [
        rates[name] * si_per_unit(airframe.inputs[name].unit) / scale
        for name, scale in zip(controller.inputs, controller.input_scale, strict=True)
    ]


def at_period(scenario: Scenario, period: float) -> Scenario:
    """The scenario with aircraft, reference model and controller at one rate: no delays."""
    rate = 1.0 / period
    return scenario.vary(
        aircraft={"rate": rate, "step": period / ceil(period / MAX_STABLE_STEP), "sensors": {}},
        reference_model={"rate": rate},
        controller={"rate": rate, "delay": 0.0},
    )


def schemes(world: str, period: float) -> dict[str, dict[str, Any]]:
    """Sections of the controller by scheme: the softened sign is 0.1 s wide without actuators, 3 total lags with them."""
    wide = {"softening": 3.0} if world == "servo" else {"softening": 0.1 / (1.5 * period), "lag": [0.0] * 4}
    soft = {"sign": "soft"} | wide
    return {"literal": {"sign": "literal"}, "implicit": {"sign": "implicit"}, "soft": soft, "PI": soft}


def sampling_scenario(base: Scenario, world: str, scheme: str, period: float, *, sine: bool) -> Scenario:
    """The flight of one cell: osprey_servo with the gains above, at rest after its gusts, or on sines in calm air."""
    beta = np.array(scaled_beta(base, BETA)) * (NO_SIGN if scheme == "PI" else 1.0)
    moved = base.vary(controller=GAINS | {"beta": beta.tolist()} | schemes(world, period)[scheme])
    if world == "paper":
        moved = moved.vary(aircraft={"actuators": {}})
    if sine:
        moved = moved.vary(aircraft={"gusts": {}}, reference_model={"pulses": {}, "sines": SINES})
    return at_period(moved, period)


def gust_scenario(base: Scenario, rates: Mapping[str, float], period: float, *, gusts: bool) -> Scenario:
    """The scenario osprey_gust with the implicit sign at another beta and period."""
    moved = base.vary(controller={"beta": scaled_beta(base, rates), "sign": "implicit"})
    moved = at_period(moved if gusts else moved.vary(aircraft={"gusts": {}}), period)
    # sampled every millisecond, also between the ticks
    return moved.vary(aircraft={"rate": 1000.0, "step": 0.001}, reference_model={"rate": 1000.0})


def cells(values: FloatArray, factor: float = 1.0) -> str:
    """Values with three digits, joined by slashes."""
    return " / ".join(f"{value:.3g}" if abs(value) >= 5e-4 else "0" for value in values * factor)


def new_table(title: str, columns: Sequence[str], texts: int) -> Table:
    """A table whose first columns hold text, the others figures."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for index, column in enumerate(columns):
        table.add_column(column, justify="left" if index < texts else "right", no_wrap=True)
    return table


def wide_console() -> Console:
    """Standard output, wide enough for the tables."""
    console = Console()
    console.width = max(console.width, WIDTH)
    return console


def main(
    include_small: Annotated[
        bool, typer.Option("--all", help="Periods of 2 and 1 ms too, which takes ten times as long.")
    ] = False,
    processes: Annotated[int, typer.Option(min=1, help="Flights at a time.")] = os.cpu_count() or 1,
) -> None:
    """Print rms errors and mean slew of the inputs for each sampling of the sign, by scheme and period."""
    servo, gust = find_scenario("osprey_servo"), find_scenario("osprey_gust")
    periods = PERIODS + (SMALL_PERIODS if include_small else ())
    rows = [(world, scheme, period) for world in WORLDS for scheme in schemes(world, 0.01) for period in periods]
    sampling = [
        Case(sampling_scenario(servo, *row, sine=sine), MOVING if sine else REST) for row in rows for sine in (False, True)
    ]
    gust_rows = [(rates, period) for rates in GUST_BETA for period in GUST_PERIODS]
    whole = (0.0, gust.flight.duration)
    gusty = [Case(gust_scenario(gust, *row, gusts=gusts), whole) for row in gust_rows for gusts in (True, False)]
    with ProcessPoolExecutor(processes) as pool:
        flights = pool.map(fly, sampling + gusty)
        results = list(track(flights, "flights", len(sampling + gusty), console=Console(stderr=True)))
    pairs = list(zip(results[::2], results[1::2], strict=True))
    console = wide_console()
    for world, meaning in WORLDS.items():
        table = new_table(
            f"{world} world ({meaning}): rms of the true error q / V / p / r in mrad/s and mm/s;"
            "\nmean slew of elevator / thrust / aileron / rudder in deg/s and %/s",
            ("sign", "dt (ms)", "at rest", "on sines", "slew at rest"),
            texts=1,
        )
        for (of, scheme, period), (rest, sine) in zip(rows, pairs[: len(rows)], strict=True):
            if of == world:
                table.add_row(scheme, f"{period * 1e3:g}", cells(rest.rms, 1e3), cells(sine.rms, 1e3), cells(rest.activity))
        console.print(table)
    table = new_table(
        "osprey_gust, implicit sign: rms of the true error q / V / p / r in mrad/s and mm/s;"
        "\nbeta of elevator / thrust / aileron / rudder in deg/s and %/s",
        ("beta", "dt (ms)", "with gusts", "calm"),
        texts=1,
    )
    for (rates, period), figures in zip(gust_rows, pairs[len(rows) :], strict=True):
        beta = cells(np.array(list(rates.values())))
        table.add_row(beta, f"{period * 1e3:g}", *(cells(errors.rms, 1e3) for errors in figures))
    console.print(table)


if __name__ == "__main__":
    typer.run(main)
