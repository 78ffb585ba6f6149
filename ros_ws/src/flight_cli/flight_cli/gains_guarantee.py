# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute, print and write what `rise-di gains guarantee` proves."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console

from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.uncertainty import Spread, as_yaml, with_entries
from flight_analysis.closed_loop.scenario import scenario_yaml
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.linear_loop import certificate as certificates
from flight_analysis.linear_loop.certificate import keep, unstated
from flight_analysis.linear_loop.delay_margin import MAX_DELAY_MARGIN
from flight_analysis.linear_loop.guarantee import LARGEST, Guarantee, loop_guarantee, zeros_alone
from flight_analysis.linear_loop.input_margins import disk_gain, disk_phase
from flight_analysis.linear_loop.loop_margins import LinearLoop
from flight_analysis.linear_loop.told import Standing
from flight_analysis.report.margin_figures import decibels, guarantee_rows, guarantee_text
from flight_campaign.equipment import published, scenario_with_equipment
from flight_cli.output import LICENCE, new_table, print_table, require_writable, say, write_text
from flight_cli.words import warn
from flight_core.arguments import as_number
from flight_core.files import display_path, writing
from flight_core.parameters import require
from flight_design.gains.first_scenario import (
    COMMANDED,
    airframe_to_check,
    controller_alone,
    scenario_to_check,
)
from flight_design.gains.gain_selection import GainAssessment, loop_with_box
from rise_di.c_code import certificate_sources
from rise_di_controller.params import ControllerConfig

FARTHER = 1.2  # factor on the deviations of the first unstable aircraft that makes it diverge
FORMS = (".3f", ".1f", ".1f", ".3f")  # formats of the columns of a guarantee


def warn_of_controller_alone(scenario: str) -> None:
    """Print which aircraft is assumed if a file has only a controller."""
    if controller_alone(scenario) is not None:
        others = f"commands and gusts of {COMMANDED}, lags and delay as it was told"
        warn(f"note: {scenario} has a controller alone: {others}")


def require_guarantee(
    *,
    airframe: str,
    scenario: str,
    late: float,
    worst: Path | None,
    certificate: Path | None,
) -> None:
    """Check that the options do not contradict each other, and that a guarantee can be computed.

    Raises ParameterError if not.
    """
    as_number(late, "late", 0.0, MAX_DELAY_MARGIN, "s")
    if controller_alone(scenario) is not None:
        require(worst is None, "worst", f"no aircraft in {scenario}", "a scenario that flies one")
    # These checks come before the proof, which can take minutes.
    _require_worst(worst, airframe, scenario)
    if certificate is not None:
        require_writable("certificate", certificate)


def proved(
    answer: GainAssessment[ControllerConfig], late: float, report: Callable[[str], None]
) -> Guarantee:
    """Return the guarantee of a loop, and store it for the report pages of this loop's flights.

    The guarantee is about a box of entries of A and B that may deviate. If entries that are 0 in
    the file are not in the box, the guarantee also says how far these may deviate while all others
    are exact. `report` gets a sentence for each step. Raises ParameterError before the proof if the
    aircraft has no linear loop.
    """
    loop = answer.loop_with_box()
    require_linear(loop)
    guarantee = loop_guarantee(loop, late, report)
    if not answer.study.spread.zeros:
        report("proving how far the entries that are 0 in the file may go")
        zeros = answer.study._replace(uncertainty=0.0, spread=Spread(zeros=1.0))
        alone = zeros_alone(loop_with_box(zeros, answer.controller), late)
        guarantee = guarantee._replace(zeros_alone=alone)
    keep(guarantee)
    return guarantee


def require_linear(loop: LinearLoop) -> None:
    """Check that the aircraft that flies has a linear loop. Raises ParameterError if not."""
    for each in loop.differences:
        expected = "the aircraft of a linear loop for a guarantee"
        require(each.standing is Standing.TAKEN, "guarantee", each.fact, expected)


def write_certificate(
    path: Path | None, loop: LinearLoop, guarantee: Guarantee, airframe: str, scenario: str
) -> list[str]:
    """Write the certificate of a guarantee, if a path is given.

    Returns a sentence if the law has no C constants from which a checker could compute the loop.
    """
    if path is None:
        return []
    facts = "; ".join(each.fact for each in loop.differences)
    found = f"no stable box ({facts})" if facts else "no stable box"
    require(guarantee.stable > 0.0, "--certificate", found, "a loop with a guarantee")
    frame = airframe_to_check(airframe, scenario_to_check(scenario))
    sources = certificate_sources(frame, scenario)
    write_text("certificate", path, certificates.certificate(loop, guarantee, sources.texts))
    return sources.notes()


def _require_worst(folder: Path | None, airframe: str, scenario: str) -> None:
    """Check that the scenario flies the airframe whose unstable variants are written.

    Raises ParameterError if not.
    """
    if folder is None:
        return
    base = find_scenario(scenario)
    expected = f"the aircraft of {base.name}, {base.aircraft.airframe}"
    require(not base.aircraft.is_jsbsim, "worst", airframe, "an aircraft of an airframe file")
    same = load_airframe(base.aircraft.airframe).name == load_airframe(airframe).name
    require(same, "worst", airframe, expected)


def write_unstable(
    folder: Path | None, guarantee: Guarantee, airframe: str, scenario: str
) -> list[str]:
    """Write the unstable aircraft nearest to the nominal one, if a folder is given.

    A second aircraft has the deviations of the first one, multiplied by FARTHER. Each is written as
    an airframe and a scenario that flies it. Returns a sentence for each aircraft, which says how
    far it deviates, and whether this is within `--uncertainty`.
    """
    if folder is None:
        return []
    base = find_scenario(scenario)
    frame = load_airframe(airframe)
    require(guarantee.unstable is not None, "worst", "no unstable aircraft", "a loop that has one")
    assert guarantee.unstable is not None  # noqa: S101 - for mypy
    names = zip(base.controller.inputs, base.controller.lag, strict=True)
    declared = {f"1/lag[{name}]": lag for name, lag in names}
    own = [f"1/{name}" for name in published(base)]
    others = [name for name in guarantee.unstable.entries if name in {*declared} - {*own}]
    require(not others, "worst", ", ".join(others), f"lags of the actuators of {base.name} alone")
    with writing("--worst", folder):
        folder.mkdir(parents=True, exist_ok=True)
    least_unstable = guarantee.unstable.deviation
    lines = []
    for factor, prefix in ((1.0, ""), (min(FARTHER, LARGEST / least_unstable), "farther_")):
        entries = {name: factor * value for name, value in guarantee.unstable.entries.items()}
        path = folder / f"{prefix}airframe.yaml"
        matrices = {name: value for name, value in entries.items() if name not in declared}
        write_text("worst", path, LICENCE + as_yaml(with_entries(frame, matrices)))
        lags = {
            name.removeprefix("1/"): declared[name] / (1.0 + value)
            for name, value in entries.items()
            if name in declared
        }
        varied = base.vary(aircraft={"airframe": str(path.absolute())})
        varied = scenario_with_equipment(varied, lags)
        flight = folder / f"{prefix}scenario.yaml"
        write_text("worst", flight, scenario_yaml(varied))
        deviation = factor * least_unstable
        place = "inside" if deviation <= guarantee.uncertainty else "outside"
        far = math.ceil(1e3 * deviation) / 10.0
        lines.append(
            f"unstable aircraft: {display_path(flight)}, {far:.1f} % off, "
            f"{place} the {100.0 * guarantee.uncertainty:g} % of --uncertainty"
        )
    return lines


def show_guarantee(
    console: Console, guarantee: Guarantee | None, checked: GainAssessment[ControllerConfig]
) -> None:
    """Print how the aircraft differs from what the controller was told, and what is proved.

    The guarantee is followed by a table of the disk margins, if there is one.
    """
    for difference in checked.study.differences:
        say(console, difference)
    if guarantee is None:
        return
    for line in guarantee_text(guarantee):
        say(console, line)
    study = checked.study
    for reason in unstated(checked.loop_with_box(), guarantee):
        say(console, reason)
    if {*study.spread.entries.values()} - {study.uncertainty}:
        say(console, "percentages: of the largest deviation, with the others in proportion")
    margins = checked.margins
    if not guarantee.is_proved or margins is None or margins.worst is None:
        return
    heads = ("input", "disk", "phase\ndeg", "gain\ndB", "worst found,\ndisk")
    title = f"\nDisk margins of every aircraft within +-{100 * guarantee.uncertainty:g} %"
    table = new_table(title, heads, left_aligned=("input",))
    for name, disk, least in guarantee_rows(guarantee, margins):
        size = np.array(disk)
        values = (np.degrees(disk_phase(size)), decibels(disk_gain(size)), least)
        table.add_row(
            name, *(f"{value:{form}}" for value, form in zip((disk, *values), FORMS, strict=True))
        )
    print_table(console, table)
