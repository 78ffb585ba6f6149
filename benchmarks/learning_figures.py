# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The figures and the picture of benchmarks.learning."""

import json
import math
from collections.abc import Iterator, Sequence

import numpy as np
from benchmarks import evidence
from benchmarks.evidence import row
from benchmarks.learning_flights import (
    ALARM_FLIGHT,
    CELLS,
    DAMAGED,
    LATE,
    SEED,
    SETTLED,
    UPDATE,
    WINDOWS,
    WITHIN,
    Cell,
    Row,
)
from benchmarks.tables import plain
from matplotlib.figure import Figure

from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.uncertainty import sampled_matrices
from control_laws.catalogue import LAWS
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_campaign.batch import batch
from flight_campaign.comparison import tuning
from flight_campaign.statistics import LOSS_OF_TRACK_SCORE
from flight_core.vectors import FloatArray
from flight_design.gains.tuned_gains import load, tuned_file

COLOURS = {"alone": "#888888", "file": "#d08020", "learner": "#2060b0", "true": "#208050"}
LABELS = {
    "alone": "the law alone",
    "file": "model of the file",
    "learner": "learner",
    "true": "true model",
}
RIVALS = ("rise", "pi", "l1", "indi", "lqg", "rise_observer")
OBJECTIVE = "gust_turbulence"
"""RIVALS are laws of the catalogue with the gains that ship. A search with the cost OBJECTIVE on
the airframe file, in the loop of osprey_servo, has found these gains. INDI measures the actuators
too."""


def figures(rows: Sequence[Row]) -> Iterator[evidence.Row]:
    """Return the figures of every cell, with their goals."""
    for name, cell in CELLS.items():
        chosen = [each for each in rows if each.cell == name]
        if chosen:
            yield row(f"{name}: aircraft", float(len(chosen)))
            yield row(
                f"{name}: replay equal",
                float(np.mean([each.replayed for each in chosen])),
                at_least=1.0,
            )
            yield row(
                f"{name}: update, mean",
                float(np.mean([each.update for each in chosen])),
                "s",
                at_most=UPDATE,
            )
            yield row(f"{name}: update, longest", max(each.longest for each in chosen), "s")
            yield from CELL_FIGURES[cell.kind](name, cell, chosen)


def learn_figures(name: str, cell: Cell, chosen: Sequence[Row]) -> Iterator[evidence.Row]:
    """Yield the figures of aircraft that learn, beside those of the others."""
    yield from scores(name, chosen)
    known = [each for each in chosen if not math.isnan(each.true)]
    shares = {"learn": 0.95 if cell.uncertainty < 0.5 else 0.9, "turning": 0.75, "rough": 0.75}
    near = shares.get(cell.kind)
    within = COUPLED_WITHIN if cell.kind == "coupled" else WITHIN
    share = float(np.mean([each.learner <= within * each.true for each in known]))
    yield row(
        f"{name}: share within {100 * (within - 1.0):.0f} % of the true model", share, at_least=near
    )
    worse = float(np.mean([each.learner > WORSE * each.file for each in chosen]))
    yield row(f"{name}: share 5 % worse than the model of the file", worse, at_most=0.05)
    for key in ("file", "learner", "true"):
        margins = [getattr(each, f"margin_{key}") for each in chosen]
        limit = 0.0 if key == "learner" else None
        subject = f"{name}: least delay margin left, {LABELS[key]}"
        yield row(subject, float(np.nanmin(margins)), "s", at_least=limit)
    yield row(
        f"{name}: worse than the law alone",
        float(sum(each.learner > each.alone for each in chosen)),
        at_most=0.0,
    )
    for key, label in LABELS.items():
        unstable = float(np.mean([getattr(each, f"late_{key}") for each in chosen]))
        limit = (0.0 if cell.uncertainty < 0.5 else 0.01) if key == "learner" else None
        yield row(
            f"{name}: share unstable with u {1e3 * LATE:.0f} ms late, {label}",
            unstable,
            at_most=limit,
        )
    begun = [each.first for each in chosen if not math.isnan(each.first)]
    yield row(f"{name}: without a model", float(len(chosen) - len(begun)))
    if begun:
        yield row(f"{name}: first model, median", float(np.median(begun)), "s")


def scores(name: str, chosen: Sequence[Row]) -> Iterator[evidence.Row]:
    """Yield the lost flights for each of LABELS, and mean and largest score of the others."""
    for key, label in LABELS.items():
        values = np.array([getattr(each, key) for each in chosen])
        flown = values[~np.isnan(values)]
        whole = values[np.isfinite(values)]
        if len(flown):
            lost = float(len(flown) - len(whole))
            yield row(f"{name}: lost, {label}", lost, at_most=0.0 if key == "learner" else None)
        if len(whole):
            yield row(f"{name}: score, {label}", float(np.mean(whole)))
            yield row(f"{name}: largest score, {label}", float(np.max(whole)))


def damage_figures(name: str, cell: Cell, chosen: Sequence[Row]) -> Iterator[evidence.Row]:
    """Yield scores from SETTLED on after damage, and how often a dead input was found in time."""
    yield from scores(name, chosen)
    yield row(
        f"{name}: lost with the learner and not with the law alone",
        float(sum(each.lost for each in chosen)),
        at_most=0.0,
    )
    if cell.kind == "weak":
        ratio = np.mean([each.learner for each in chosen]) / np.mean([each.true for each in chosen])
        yield row(f"{name}: mean over that of the true model", float(ratio), at_most=1.05)
        yield row(
            f"{name}: share found to have changed",
            float(np.mean([each.alarms > 0 for each in chosen])),
        )
        flown = [json.loads(each.windows) for each in chosen]
        for key, label in LABELS.items():
            yield from window_figures(
                name, label, np.array([each[key] for each in flown if key in each])
            )
        return
    right = [each.found == each.dead and each.found_at <= SETTLED for each in chosen]
    yield row(
        f"{name}: share found within {SETTLED - DAMAGED:.0f} s",
        float(np.mean(right)),
        at_least=0.95,
    )
    wrong = [each.found not in {"", each.dead} for each in chosen]
    yield row(f"{name}: another input found", float(sum(wrong)), at_most=0.0)


def window_figures(name: str, label: str, values: FloatArray) -> Iterator[evidence.Row]:
    """Yield the mean score over each of WINDOWS, from scores (N, W).

    A flight that was lost in any window does not count.
    """
    if len(whole := values[np.isfinite(values).all(axis=1)]):
        for (first, end), mean in zip(WINDOWS, whole.mean(axis=0), strict=True):
            yield row(f"{name}: score from {first:g} to {end:g} s, {label}", float(mean))


def alarm_figures(name: str, cell: Cell, chosen: Sequence[Row]) -> Iterator[evidence.Row]:
    """Yield the flight time without damage, and the number of false alarms in it."""
    yield row(f"{name}: flight time", ALARM_FLIGHT / 60.0 * len(chosen), "min")
    yield row(
        f"{name}: false alarms",
        float(sum(each.alarms + (each.found != "") for each in chosen)),
        at_most=0.0,
    )


COUPLED_WITHIN = 1.15
WORSE = 1.05
CELL_FIGURES = {
    "learn": learn_figures,
    "turning": learn_figures,
    "rough": learn_figures,
    "coupled": learn_figures,
    "untold": learn_figures,
    "weak": damage_figures,
    "dead": damage_figures,
    "alarm": alarm_figures,
}


def rival_figures(uncertainty: float, numbers: Sequence[int]) -> Iterator[evidence.Row]:
    """Yield the scores of the laws of RIVALS in the flight with gusts.

    Each law also flies it with u late by LATE; the figure is the share of aircraft that lose track.
    All aircraft have the same noise. The model and the gains of each law come from the airframe
    file.
    """
    benchmark = tuning.build_benchmark(find_scenario("osprey_observer"))
    tuned = load(tuned_file(find_scenario("osprey_servo")))
    A, B = sampled_matrices(
        load_airframe("osprey"), uncertainty, uncertainty, SEED, 0, max(numbers) + 1
    )
    of = np.tile(np.array(numbers), 2)
    late = np.repeat([0, round(LATE / benchmark.model.period)], len(numbers))
    flights = tuning.benchmark_fleet(A[of], B[of], late, tuning.GUST, benchmark)
    for name in RIVALS:
        law = LAWS[name]
        params = law.params(tuning.as_gains(tuned[name][OBJECTIVE]), benchmark.model)
        course = benchmark.courses[tuning.GUST][law.feedforward]
        flown = batch.fly(
            flights, benchmark.vehicle, course, law.control_law(benchmark.model), params
        )
        in_time, delayed = np.split(tuning.result_score(flown, benchmark.unit), 2)
        subject = f"rivals, +-{100 * uncertainty:.0f} %"
        yield row(f"{subject}: score, {law.title}", float(np.mean(in_time)))
        yield row(f"{subject}: largest score, {law.title}", float(np.max(in_time)))
        lost = float(np.mean(delayed > LOSS_OF_TRACK_SCORE))
        yield row(f"{subject}: share lost with u {1e3 * LATE:.0f} ms late, {law.title}", lost)


def plot(rows: Sequence[Row]) -> Figure:
    """Plot the score of every aircraft in the flight with gusts, a panel for each uncertainty.

    A bar shows the mean of a column.
    """
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    for axis, uncertainty in zip(figure.subplots(1, 2, sharey=True), (0.3, 0.5), strict=True):
        columns: dict[str, tuple[str, list[float]]] = {}
        for name, cell in CELLS.items():
            if cell.kind == "learn" and cell.uncertainty == uncertainty:
                chosen = [each for each in rows if each.cell == name]
                for key in ("alone", "file", "true"):
                    columns.setdefault(
                        LABELS[key].replace(" of", "\nof"),
                        (COLOURS[key], [getattr(each, key) for each in chosen]),
                    )
                columns[f"learned in\n{cell.air}"] = (
                    COLOURS["learner"],
                    [each.learner for each in chosen],
                )
        for place, (colour, values) in enumerate(columns.values()):
            spread = place + 0.5 * (np.arange(len(values)) / max(len(values) - 1, 1) - 0.5)
            axis.plot(spread, values, ".", color=colour, markersize=3, alpha=0.6)
            axis.plot(
                [place - 0.35, place + 0.35], [np.nanmean(values)] * 2, color=colour, linewidth=2.2
            )
        axis.set_xticks(range(len(columns)), list(columns), fontsize=7)
        plain(axis, f"A and B +-{100 * uncertainty:g} %: score", lines="y")
    # for both panels, once all points are drawn, because this ends the automatic limits
    axis.set_ylim(bottom=0.0)
    return figure
