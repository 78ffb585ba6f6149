# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Print gains, margins and errors of the aircraft of JSBSim that trim, as CSV.

Each aircraft has two speeds. The gains are those that `rise-di identify` finds. If it refuses
gains, a random search tries to find some, which would refute the refusal.

python -m benchmarks.jsbsim_gains c172p t6texan2

A refusal says that the search for gains does not reach a phase margin of 45 deg, or of
--phase-margin. FIVE refusals are drawn at random. For each, random factors on the integrals and the
bandwidths are tried, within wider bounds than those of the search.
"""

import argparse
import csv
import math
import sys
import time
from pathlib import Path

import numpy as np
import yaml

from aircraft_sim.jsbsim.jsbsim_aircraft import OUTPUTS
from flight_analysis.linear_loop.input_margins import input_margins
from flight_core.outcome import FlightEnded
from flight_core.parameters import ParameterError
from flight_design.gains.gain_selection import Selection, gain_candidates, gain_sets
from flight_design.gains.relaxation import binding
from flight_design.gains.requirement import least_fraction
from flight_design.identification.jsbsim_identification import IdentifiedAircraft, identify_jsbsim

CONDITIONS = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
FIVE = 5
SECONDS = 10.0  # processor time for the random search of one refusal
WIDEST = np.log([[4000.0], [200.0]])  # logarithms of the largest factors on integral and bandwidth
FRESH = 0.3  # share of the tries that are drawn anywhere; the others lie near the best one so far
SPREAD = 0.4  # standard deviation of the step from the best try, in the logarithm of a factor
AIRS = ("calm", "turbulence")
HEADINGS = (
    "aircraft",
    "speed, m/s",
    "altitude, m",
    "gains for 45 deg",
    "least phase margin, deg",
    "largest sensitivity",
    "delay margin, ms",
    *(
        f"rms of {name} in {air}, {unit}"
        for air in AIRS
        for name, unit in (("q", "mrad/s"), ("p", "mrad/s"), ("r", "mrad/s"), ("V", "m/s"))
    ),
    "flights",
    "gains for {:g} deg",
    "random search",
)


def verdict(selection: Selection) -> str:
    """Say whether a selection has the margins, or name the bound that binds."""
    if not selection.engineering.unmet:
        return "found"
    return f"refused: {binding(selection).sentence(selection.chosen.outputs)}"


def figures(identified: IdentifiedAircraft) -> list[str]:
    """Return the margins of the nominal loop, and the errors of the flights."""
    margins = identified.selection.engineering.margins
    if margins is None:
        return [""] * (3 + len(AIRS) * len(OUTPUTS))
    nominal = margins.nominal
    rms = [identified.flights[air].rms for air in AIRS]
    errors = [
        "" if name not in row else f"{row[name] * (1.0 if name == 'V' else 1e3):.3g}"
        for row in rms
        for name in ("q", "p", "r", "V")
    ]
    phase = math.degrees(float(nominal.phase.min()))
    sensitivity = float(nominal.sensitivity.max())
    return [f"{phase:.1f}", f"{sensitivity:.2f}", f"{1e3 * margins.delay:.1f}", *errors]


def searched(selection: Selection) -> str:
    """Try random factors for SECONDS on a refused selection, and say what they find."""
    build = gain_candidates(selection.study, selection.setting)
    generator = np.random.default_rng(1)
    m = len(selection.chosen.outputs)
    best = -1.0
    place = np.zeros((2, m))
    begin = time.process_time()
    tries = 0
    while best < 1.0 and time.process_time() - begin < SECONDS:
        tries += 1
        step = SPREAD * generator.standard_normal((2, m))
        fresh = best < 0.0 or generator.random() < FRESH
        trial = generator.random((2, m)) * WIDEST if fresh else np.clip(place + step, 0.0, WIDEST)
        loop = build(*np.exp(trial)).loop
        margins = input_margins(loop.nominal, loop.law, loop.loop, together=False)
        if np.isfinite(margins.phase).all():
            fraction = least_fraction(margins, selection.setting.requirement)
            if fraction > best:
                best = fraction
                place = trial
    if best < 1.0:
        return f"none in {tries} tries, at most {best:.0%} of the goals"
    return f"REFUTED in {tries} tries by {np.exp(place).round(2).tolist()}"


def main() -> None:
    """Print a row for each condition."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("aircraft", nargs="*", default=list(CONDITIONS))
    parser.add_argument("--phase-margin", type=float, default=60.0)
    options = parser.parse_args()
    rows: list[list[str]] = []
    refusals: list[tuple[list[str], Selection]] = []
    for name in options.aircraft:
        for speed, altitude in CONDITIONS[name]:
            print(f"{name} at {speed} m/s", file=sys.stderr)
            row = [name, f"{speed:g}", f"{altitude:g}"]
            rows.append(row)
            try:
                identified = identify_jsbsim(name, speed, altitude)
            except (FlightEnded, ParameterError) as error:
                row.append(f"{error}")
                continue
            selection = identified.selection
            requirement = selection.setting.requirement._replace(
                phase=math.radians(options.phase_margin)
            )
            more = gain_sets(selection.study, selection.setting._replace(requirement=requirement))
            row += [
                verdict(selection),
                *figures(identified),
                str(identified.failure or "completed"),
                verdict(more),
            ]
            print(", ".join(row), file=sys.stderr)
            refusals += [(row, each) for each in (selection, more) if each.engineering.unmet]
    for k in np.random.default_rng(1).permutation(len(refusals))[:FIVE]:
        row, selection = refusals[k]
        phase = math.degrees(selection.setting.requirement.phase)
        row.append(f"{phase:g} deg: {searched(selection)}")
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow([heading.format(options.phase_margin) for heading in HEADINGS])
    writer.writerows(rows)


if __name__ == "__main__":
    main()
