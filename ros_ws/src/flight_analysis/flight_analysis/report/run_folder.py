# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Create the folder of a run before its flight, with the files that its log attaches."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from aircraft_sim.jsbsim.jsbsim_files import model_files
from aircraft_sim.uncertainty import as_yaml
from flight_analysis.closed_loop.scenario import ParameterOverrides, Scenario, scenario_yaml
from flight_core.files import comment, dump_yaml, write_file, writing
from flight_core.parameters import ParameterError, require
from flight_log.bag import LogAttachments
from flight_log.provenance import provenance
from flight_log.tape_reader import PARAMETERS

SUMMARY = "summary.json"
REPORT = "report.html"
# attachments of the log
AIRFRAME = "airframe.yaml"
AIRCRAFT = "aircraft.zip"
PROVENANCE = "provenance.yaml"


def new_run(scenario: Scenario, runs: Path, kind: str = "") -> Path:
    """Create the folder of a new run, runs/<UTC stamp>-<kind><scenario>.

    `kind` is a prefix such as "replay-". Raises ParameterError if the folder cannot be created.
    """
    place = str(runs.absolute())
    is_text = not any("\ud800" <= character <= "\udfff" for character in place)
    require(
        is_text, "runs", ascii(place), "a folder with a name in UTF-8, as logs and reports hold it"
    )
    latest = runs / "latest"
    is_free = latest.is_symlink() or not latest.exists()
    require(
        is_free, str(latest), "a file or folder", "none: this name is for a link to the newest run"
    )
    stem = f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{kind}{scenario.name}"
    for name in (stem, *(f"{stem}-{k}" for k in range(2, 100))):
        run = (runs / name).absolute()
        with writing("runs", runs), suppress(FileExistsError):
            run.mkdir(parents=True)
            return run
    raise ParameterError(f"runs: found 99 runs in {runs} that began in this second, expected fewer")


def remove_empty(*runs: Path) -> None:
    """Remove the folders of runs that are empty, and keep the others.

    A folder is empty if its flight was interrupted before it began.
    """
    for run in runs:
        with suppress(OSError):
            run.rmdir()


def attachments_for(
    scenario: Scenario,
    run: Path,
    overrides: Mapping[str, ParameterOverrides] | None = None,
    further: Sequence[Path] = (),
    replaced: Sequence[str] = (),
) -> LogAttachments:
    """Write the files that describe a run, and return all files that its log attaches.

    The files are the scenario, the airframe or the user's model of JSBSim, every parameter after
    validation, the `further` files, and the provenance. New files are written into the folder of
    the run. `overrides` are parameters of the scenario's nodes by the name of the node, or None for
    a flight without nodes. `replaced` names the nodes of this package that other nodes replaced,
    and the attachments state this. Raises ParameterError if a file cannot be written.
    """
    unflown = {
        name: comment([f"not started: {name}, because another node took its place"])
        for name in replaced
    }
    parameters = "".join(unflown.values()) + scenario_yaml(scenario, overrides)
    attached = [_write(run / PARAMETERS, parameters), *further]
    if not scenario.aircraft.is_jsbsim:
        airframe = as_yaml(scenario.aircraft.sampled_airframe())
        attached.append(_write(run / AIRFRAME, unflown.get("aircraft", "") + airframe))
    elif (model := Path(scenario.aircraft.flight_condition().name)).is_absolute():
        attached.append(_write(run / AIRCRAFT, model_files(model).archive()))
    notes = _write(run / PROVENANCE, dump_yaml(provenance(), flow=False))
    return LogAttachments(scenario.path, tuple(attached), notes)


def _write(path: Path, text: str | bytes) -> Path:
    with writing("", path, "a writable folder and space on the disk"):
        write_file(path, text)
    return path


def folder_of(run: Path) -> Path:
    """Return the folder of a run, given this folder, its log, or a link such as runs/latest."""
    return run.resolve() if run.is_dir() else run.resolve().parent
