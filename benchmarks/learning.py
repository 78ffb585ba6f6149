# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Learning in the air: errors of uncertain aircraft before and after, beside the law alone, the file's model and the true one.

python -m benchmarks.learning --aircraft 10     # osprey_learn at +-30 % and +-50 %, in turbulence: 20 s an aircraft
python -m benchmarks.learning --air calm

A row an aircraft goes to the file of results. Run again, it flies those that are missing. It draws docs/images/learning.png.
"""

import json
from enum import StrEnum
from io import BytesIO
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from matplotlib.figure import Figure
from PIL import Image
from rich.progress import track

from aircraft_sim.airframe import Airframe, load_airframe
from aircraft_sim.turbulence import MODERATE
from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_bringup.scenarios import find_scenario
from flight_campaign.statistics import score_units
from flight_core.parameters import ParameterError
from flight_core.tape import Tape
from rise_di.gain_design import observed
from rise_di.learning import learner
from rise_di_controller.learning import Event

IMAGE = Path(__file__).parents[1] / "docs" / "images" / "learning.png"
SEED, UNCERTAINTIES = 11, (0.3, 0.5)
WINDOWS = ((0.0, 14.0), (14.0, 24.0), (24.0, 34.0), (34.0, 60.0))  # s: the first model flies at 14 s at the earliest
PALETTE = 32  # colours of the picture
MARGIN, WITHIN = 0.03, 1.1  # s; an error within 10 % of that of the true model
COLOURS = {"alone": "#888888", "file": "#d08020", "learner": "#2060b0", "true": "#208050"}
LABELS = {"alone": "the law alone", "file": "model of the file", "learner": "learner", "true": "true model"}


class Air(StrEnum):
    """The air of all flights of an aircraft."""

    TURBULENCE = "turbulence"
    CALM = "calm"


class Row(NamedTuple):
    """One aircraft: scores in WINDOWS, by controller; empty where no observer has the margins."""

    air: str
    uncertainty: float
    number: int
    scores: dict[str, list[float]]
    learned: list[float]  # s, flight times at which a model began to fly
    events: list[str]
    replayed: bool


def scenario(air: str, uncertainty: float, number: int) -> Scenario:
    """osprey_learn at 100 Hz with an aircraft, wind and noise of its own."""
    sampled = {"A": uncertainty, "B": uncertainty, "seed": SEED, "number": number}
    wind = {"turbulence": MODERATE | {"seed": 1000 + number} if air == Air.TURBULENCE else None}
    shipped = find_scenario("osprey_learn")
    noise = {"noise": shipped.aircraft.sensors.noise, "seed": 1000 + number}
    aircraft = {"rate": 100.0, "step": 0.005, "uncertainty": sampled, "sensors": noise} | wind
    return shipped.vary(aircraft=aircraft, reference_model={"rate": 100.0})


def scores(tape: Tape) -> list[float]:
    """Sum over the outputs of the true rms error in units of a score, in each window."""
    y_m, truth, t = tape["y_m"], tape["truth"], tape.time("y_m")
    outputs = tuple(y_m.names)
    e = np.stack([truth[f"x.{name}"] - y_m[name] for name in outputs], axis=1)
    units = score_units(outputs, load_airframe("osprey").units_of_outputs())
    return [float(np.sum(np.sqrt(np.mean(e[(t >= first) & (t < last)] ** 2, axis=0)) / units)) for first, last in WINDOWS]


def fly(air: str, uncertainty: float, number: int) -> Row:
    """Fly an aircraft with the law alone, the observers of the file and of the true model, and the learner."""
    chosen, events = scenario(air, uncertainty, number), list[Event]()
    alone, learn = chosen.vary(controller={"learn": None}), learner(chosen)

    def with_model(model: Airframe) -> list[float]:
        try:
            return scores(simulate(alone.vary(controller=observed(alone.rise_di(), alone, model, MARGIN)[0])))
        except ParameterError:
            return []

    tape = simulate(chosen, learn=learn, announce=events.append)
    found = {
        "alone": scores(simulate(alone)),
        "file": with_model(load_airframe("osprey")),
        "learner": scores(tape),
        "true": with_model(chosen.aircraft.sampled_airframe()),
    }
    learned = [event.stamp_ns / 1e9 for event in events if event.change]
    sentences = [f"{event.stamp_ns / 1e9:g} s: {event.sentence}" for event in events]
    return Row(air, uncertainty, number, found, learned, sentences, replay(tape).equal())


def plot(rows: list[Row]) -> Figure:
    """The score in each window, an aircraft a line and the mean a thick line, a panel an uncertainty."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    for axis, uncertainty in zip(figure.subplots(1, len(UNCERTAINTIES), sharey=True), UNCERTAINTIES, strict=True):
        chosen = [row for row in rows if row.uncertainty == uncertainty]
        for name, colour in COLOURS.items():
            lines = np.array([row.scores[name] for row in chosen if row.scores[name]])
            if name == "learner" and len(lines):
                axis.plot(lines.T, color=colour, linewidth=0.5, alpha=0.5)
            if len(lines):
                axis.plot(lines.mean(axis=0), color=colour, linewidth=2.2, marker="o", label=LABELS[name])
        axis.set_xticks(range(len(WINDOWS)), [f"{first:g} to {last:g} s" for first, last in WINDOWS])
        axis.set_title(f"A and B +-{100 * uncertainty:g} %, {len(chosen)} aircraft: score", fontsize=10, loc="left")
        axis.set_ylim(bottom=0.0)
        axis.grid(color="#dddddd", linewidth=0.6)
        axis.spines[["top", "right"]].set_visible(False)
        axis.legend(frameon=False, fontsize=9)
    return figure


def report(rows: list[Row], air: str, uncertainty: float) -> str:
    """Means and worst of the last window, and how many aircraft are near the true model or worse than the law alone."""
    chosen = [row for row in rows if (row.air, row.uncertainty) == (air, uncertainty) and row.scores["true"]]
    last = {name: np.array([row.scores[name][-1] if row.scores[name] else np.nan for row in chosen]) for name in COLOURS}
    means = ", ".join(f"{LABELS[name]} {np.nanmean(values):.2f} ({np.nanmax(values):.2f})" for name, values in last.items())
    near = np.mean(last["learner"] <= WITHIN * last["true"])
    worse, replayed = int(np.sum(last["learner"] > last["alone"])), sum(row.replayed for row in chosen)
    first = np.median([row.learned[0] for row in chosen if row.learned])
    return (
        f"{air}, +-{100 * uncertainty:g} %, {len(chosen)} aircraft, {WINDOWS[-1][0]:g} to {WINDOWS[-1][1]:g} s: {means}; within"
        f" {100 * (WITHIN - 1.0):.0f} % of the true model {100 * near:.0f} %, worse than the law alone {worse}, first model at"
        f" {first:g} s (median), replay equal {replayed}"
    )


def main(
    aircraft: Annotated[int, typer.Option(help="Aircraft of each uncertainty.")] = 10,
    air: Annotated[Air, typer.Option(help="The air.")] = Air.TURBULENCE,
    results: Annotated[Path, typer.Option(help="File of results, a row an aircraft.")] = Path("learning.jsonl"),
) -> None:
    """Fly the aircraft that are missing in the results, print the figures and draw the picture."""
    lines = results.read_text(encoding="utf-8").splitlines() if results.exists() else []
    rows = [Row(**json.loads(line)) for line in lines]
    known = {(row.air, row.uncertainty, row.number) for row in rows}
    cases: list[tuple[Any, ...]] = [(air, p, number) for number in range(aircraft) for p in UNCERTAINTIES]
    for case in track([case for case in cases if case not in known], "aircraft"):
        rows.append(fly(*case))
        with results.open("a", encoding="utf-8") as file:
            file.write(json.dumps(rows[-1]._asdict()) + "\n")
    for uncertainty in UNCERTAINTIES:
        print(report(rows, air, uncertainty))
    if air == Air.TURBULENCE:
        rendered = BytesIO()
        plot([row for row in rows if row.air == air]).savefig(rendered, dpi=110)
        Image.open(rendered).convert("RGB").quantize(PALETTE).save(IMAGE, optimize=True)


if __name__ == "__main__":
    typer.run(main)
