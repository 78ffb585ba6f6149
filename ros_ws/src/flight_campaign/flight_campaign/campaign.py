# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Run a Monte Carlo campaign: thousands of uncertain aircraft fly one scenario, in chunks.

An interrupted campaign can be resumed. The folder of a campaign has its definition and a table for
each completed chunk. At the end it also has the summary and the report.
"""

import logging
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aircraft_sim.airframes.airframe import load_airframe
from aircraft_sim.uncertainty import (
    Spread,
    WindEffect,
    drawn_entries,
    sampled_matrices,
)
from flight_analysis.closed_loop.scenario import SCHEMAS, Scenario
from flight_analysis.linear_loop.certificate import kept_guarantee
from flight_analysis.linear_loop.guarantee import Guarantee
from flight_analysis.linear_loop.loop_margins import LoopMargins, margins, scenario_loop
from flight_campaign import equipment, single_flights
from flight_campaign.batch.campaign_course import Course, build_course
from flight_campaign.definition import Definition, Sweep
from flight_campaign.engines import Engine, Job
from flight_campaign.influence import RANKED, influence
from flight_campaign.rows import Chunk, encode_chunk, join_chunks, tally_of
from flight_campaign.single_flights import MakeLearner
from flight_campaign.statistics import Tally, score_units
from flight_core.files import replacing, write_file, writing
from flight_core.parameters import ParameterError, require
from rise_di_controller.law.control_law import TunedLaw

if TYPE_CHECKING:
    import polars as pl

    from flight_campaign.batch.batch_loop import Vehicle

DEFINITION = "campaign.json"
CHUNKS = "chunks"
OUT_OF_MEMORY = "RESOURCE_EXHAUSTED"  # word in an error of JAX
LOGGER = logging.getLogger(__name__)
# how many aircraft fit into memory at once, by the JSON of the definition, after a chunk did not
# fit
_FITTING: dict[str, int] = {}
MARGIN_AIRCRAFT = 200  # number of first aircraft of a case whose loop is checked for stability


def _permitted_units(scenario: Scenario, units: Mapping[str, float]) -> dict[str, float]:
    """Return the score's unit for each output. Raises ParameterError if a unit does not fit."""
    outputs = scenario.controller.outputs
    stated_units = dict(units)
    for name, unit in stated_units.items():
        require(
            name in outputs,
            "score",
            repr(name),
            f"an output of the controller: {', '.join(outputs)}",
        )
        require(
            math.isfinite(unit) and unit > 0.0,
            f"score.{name}",
            f"{unit:g}",
            "a unit of rms error above 0, SI",
        )
    require(
        scenario.guidance is None or not stated_units,
        "score",
        "a unit",
        "none: the score of a mission is its cross-track error",
    )
    if scenario.guidance is None:
        score_units(outputs, scenario.aircraft.channels().outputs, stated_units)
    return stated_units


def define(
    scenario: Scenario,
    *,
    aircraft: int,
    uncertainty: float,
    seed: int,
    chunk: int | None = None,
    sweep: Sweep | None = None,
    wind: WindEffect | None = None,
    spread: Spread | None = None,
    units: Mapping[str, float] | None = None,
) -> Definition:
    """Define a campaign over a scenario.

    If `wind` or `spread` is None, it comes from the scenario's `aircraft.uncertainty`. `units` has
    units of the score by output, SI, which replace the usual ones. If `chunk` is None, the number
    of aircraft in a chunk is chosen for the device, or for flights one by one. Raises
    ParameterError if a campaign cannot fly the scenario.
    """
    if sweep is not None:
        sweep.scaled(scenario.controller, 1.0)
    if single_flights.is_flown_alone(scenario):
        single_flights.require_single_flights(scenario)
    else:
        build_course(scenario)
    # Each aircraft of the campaign has different entries.
    nominal = scenario.vary(aircraft={"uncertainty": {}})
    spread = scenario.aircraft.uncertainty.spread() if spread is None else spread
    spread = spread._replace(entries=equipment.expanded(spread.entries, scenario))
    stated_units = _permitted_units(scenario, units or {})
    airframe_spread = spread._replace(entries=equipment.matrix_entries(spread.entries))
    sampled_matrices(
        load_airframe(scenario.aircraft.airframe),
        part_A=uncertainty,
        part_B=uncertainty,
        seed=seed,
        first=0,
        count=1,
        spread=airframe_spread,
    )
    values = {
        "name": scenario.name,
        "sections": {
            name: section.model_dump(mode="json")
            for name in SCHEMAS
            if (section := getattr(nominal, name)) is not None
        },
        "aircraft": aircraft,
        "uncertainty": uncertainty,
        "wind": scenario.aircraft.uncertainty.wind if wind is None else wind,
        "seed": seed,
        "chunk": chunk or _default_chunk(scenario, aircraft),
        "sweep": sweep,
        "entries": dict(spread.entries),
        "distribution": spread.distribution,
        "score_units": stated_units,
    }
    definition = Definition.validate_mapping(values, "campaign")
    for case in range(definition.cases):
        definition.scenario(case)
    return definition


def _default_chunk(scenario: Scenario, aircraft: int) -> int:
    """Return the default number of aircraft that fly at once."""
    if aircraft < 1:
        return 1
    if single_flights.is_flown_alone(scenario):
        return single_flights.CHUNK
    from flight_campaign.batch.device import chunk_of_device  # noqa: PLC0415 - JAX, which the command needs only for flights

    return chunk_of_device(aircraft)


def fly_chunk(text: str, job: Job, learner: MakeLearner | None = None) -> bytes:
    """Fly a chunk of a campaign, and return its rows as Parquet.

    `text` is the definition as JSON. The rows depend only on `text` and on the job. `learner` makes
    the learner of a scenario. Raises ParameterError if an aircraft does not fit into memory.
    """
    definition = Definition.model_validate_json(text)
    if single_flights.is_flown_alone(definition.scenario()):
        figures = single_flights.fly_chunk_singly(definition, job, learner)
    else:
        figures = fly_chunk_figures(text, job)
    return encode_chunk(figures, definition.seed, definition.factor(job[0]))


def fly_chunk_figures(text: str, job: Job) -> Chunk:
    """Fly a chunk of a campaign, in parts if it does not fit into memory at once."""
    definition = Definition.model_validate_json(text)
    case, chunk = job
    first = chunk * definition.chunk
    end = first + definition.size(job)
    size = _FITTING.get(text, definition.chunk)
    parts: list[Chunk] = []
    while first < end:
        # The last part has as many aircraft as the others, so that nothing is compiled again.
        # Surplus aircraft are dropped.
        count = min(size, end - first)
        try:
            parts.append(_fly_at_once(text, case, first, count, size))
        except (MemoryError, RuntimeError) as error:
            # JAX raises a RuntimeError if the memory does not suffice
            if isinstance(error, RuntimeError) and OUT_OF_MEMORY not in str(error):
                raise
            if size == 1:
                demand = "an aircraft that needs more memory than there is"
                raise ParameterError(
                    f"chunk: found {demand}, expected shorter delays of the aircraft"
                ) from None
            half = -(-size // 2)
            LOGGER.warning(f"chunk: {size} aircraft do not fit into memory: {half} fly at once")
            size = _FITTING[text] = half
        else:
            first += count
    return join_chunks(parts)


def _fly_at_once(text: str, case: int, first: int, count: int, size: int) -> Chunk:
    """Fly `size` aircraft together, from number `first` on, and return the first `count`."""
    from flight_campaign.batch import batch  # noqa: PLC0415 - JAX, which the command needs only for flights
    from flight_campaign.batch.device import turn  # noqa: PLC0415 - as above
    from flight_campaign.drawn_fleet import drawn_fleet  # noqa: PLC0415 - as above

    definition = Definition.model_validate_json(text)
    shared = _prepare(text, case)
    scenario, course, law = shared.scenario, shared.course, shared.law
    # drawn while another chunk flies
    fleet_of_chunk = drawn_fleet(definition, scenario, first, size)
    with turn():
        fleet, equipped = fleet_of_chunk.on_device(course, shared.vehicle)
        flight_result = batch.fly(fleet, equipped, course, law.control_law, law.params)
        result = batch.on_host(flight_result)
    rms, largest, slew = (part[:, :count] for part in (result.rms, result.max, result.slew))
    outputs = scenario.controller.outputs
    inputs = scenario.controller.effectors
    figures = {"score": definition.score(rms)}
    for kind, names, values in (
        ("rms", outputs, rms),
        ("max", outputs, largest),
        ("slew", inputs, slew),
    ):
        figures |= {f"{kind}.{name}": row for name, row in zip(names, values, strict=True)}
    entries = {name: value[:count] for name, value in fleet_of_chunk.entries().items()}
    return Chunk(first, result.diverged[:count], figures, entries)


@dataclass(frozen=True, kw_only=True)
class _Shared:
    """What all chunks of a case share."""

    scenario: Scenario
    course: Course
    vehicle: "Vehicle"
    law: TunedLaw


@lru_cache(maxsize=8)
def _prepare(text: str, case: int) -> _Shared:
    """Prepare what all chunks of a case share."""
    from flight_campaign.batch import batch  # noqa: PLC0415 - as above

    scenario = Definition.model_validate_json(text).scenario(case)
    law = scenario.controller.tuned_law()
    course = build_course(scenario)
    return _Shared(
        scenario=scenario,
        course=course,
        vehicle=batch.vehicle(scenario),
        law=law._replace(params=batch.shared(law.params)),
    )


class MonteCarlo:
    """A campaign and the folder in which it is stored."""

    def __init__(self, folder: Path, definition: Definition) -> None:
        self.folder = folder
        self.definition = definition

    @classmethod
    def begin(cls, folder: Path, definition: Definition) -> "MonteCarlo":
        """Begin a new campaign in an existing folder that is empty."""
        campaign = cls(folder, definition)
        (folder / CHUNKS).mkdir()
        _write(folder / DEFINITION, definition.model_dump_json(indent=1))
        return campaign

    @classmethod
    def resume(cls, folder: Path) -> "MonteCarlo":
        """Load the campaign in a folder. Raises ParameterError if the folder has no campaign."""
        try:
            definition = Definition.model_validate_json(
                (folder / DEFINITION).read_text(encoding="utf-8")
            )
        except (OSError, ValueError) as error:
            raise ParameterError(
                f"{folder}: found no campaign ({error}), expected the folder of one"
            ) from None
        with writing("", folder, "the folder of a campaign, which can"):
            (folder / CHUNKS).mkdir(exist_ok=True)
        return cls(folder, definition)

    def missing(self) -> list[Job]:
        """Return the chunks that have no file yet."""
        return [job for job in self.definition.jobs() if not self._path(job).exists()]

    def fly(self, engine: Engine, learner: MakeLearner | None = None) -> Iterator[int]:
        """Fly the missing chunks, and yield the number of flights of each completed chunk.

        `learner` makes the learner of a scenario.
        """
        for job, table in engine(
            partial(fly_chunk, self.definition.model_dump_json(), learner=learner), self.missing()
        ):
            _write(self._path(job), table)
            yield self.definition.size(job)

    def tally(self, case: int) -> Tally:
        """Return the statistics of a case, summed in the order of the chunks.

        Raises ParameterError if a file is damaged.
        """
        total = Tally()
        for job in self._flown():
            if job[0] == case:
                total += tally_of(self._read(job))
        return total

    def rows(self, case: int | None = None) -> "pl.LazyFrame":
        """Return the table of the completed chunks of a case or of all cases, in their order.

        The rows are ordered by case and number. `flight_campaign.rows` defines the columns.
        """
        import polars as pl  # noqa: PLC0415 - some tenths of a second

        return pl.scan_parquet(
            [self._path(job) for job in self._flown() if case in {None, job[0]}], glob=False
        )

    def write_rows(self, path: Path) -> None:
        """Write the table as one Parquet file, chunk by chunk. Raises OSError if that fails."""
        with replacing(path) as stream:
            self.rows().sink_parquet(stream)

    def margins(self, case: int) -> LoopMargins | None:
        """Return the nominal margins of a case, and the worst margins in its box of uncertainty.

        Returns None if there is no linear loop.
        """
        definition = self.definition
        scenario = self.definition.scenario(case)
        try:
            return margins(
                scenario,
                min(definition.aircraft, MARGIN_AIRCRAFT),
                definition.uncertainty,
                definition.seed,
                definition.spread,
            )
        except ParameterError:
            return None

    def guarantee(self, case: int) -> Guarantee | None:
        """Return the stability guarantee that was computed for the loop of a case.

        Returns None if there is no guarantee. If lags or delays are drawn it also returns None,
        because a guarantee assumes exact lags and delays.
        """
        definition = self.definition
        if any(equipment.is_of_loop(entry) for entry in definition.entries):
            return None
        scenario = definition.scenario(case)
        part = definition.uncertainty
        spread = definition.spread
        try:
            return kept_guarantee(
                scenario_loop(scenario, scenario.controller, 0, part, spread=spread)
            )
        except ParameterError:
            return None

    def _flown(self) -> list[Job]:
        return [job for job in self.definition.jobs() if self._path(job).exists()]

    def influence(self, case: int, worst: int) -> dict[str, Any]:
        """Return how strongly each drawn entry correlates with the score of a case, by ranks.

        `worst` is the number of the worst aircraft in the case.
        """
        import polars as pl  # noqa: PLC0415 - as above

        rows = self.rows(case)
        airframe = load_airframe(self.definition.scenario().aircraft.airframe)
        matrices = drawn_entries(airframe, airframe.matrix_a()[None], airframe.matrix_b()[None])
        published = {name: float(value[0]) for name, value in matrices.items()}
        published |= equipment.references(self.definition.scenario(), self.definition.entries)
        parts = {
            name: self.definition.entries.get(name, self.definition.uncertainty)
            for name in published
        }
        parts |= {equipment.DELAY: 1.0}
        return influence(
            rows.head(RANKED).collect(),
            rows.filter(pl.col("number") == worst).collect(),
            published,
            parts,
        )

    def _read(self, job: Job) -> "pl.DataFrame":
        import polars as pl  # noqa: PLC0415 - as above

        path = self._path(job)
        size = self.definition.size(job)
        try:
            table = pl.read_parquet(path, glob=False)
        except pl.exceptions.PolarsError:
            table = pl.DataFrame()
        again = (
            f"the figures of {size} aircraft of this campaign; remove the file, and the "
            "same command flies them again"
        )
        require(table.height == size, str(path), f"{table.height or 'none'}", again)
        return table

    def _path(self, job: Job) -> Path:
        case, chunk = job
        return self.folder / CHUNKS / f"{case}-{chunk:06d}.parquet"


def _write(path: Path, content: str | bytes) -> None:
    with writing("", path, "a writable folder and space on the disk"):
        write_file(path, content)
