# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo campaign: thousands of uncertain aircraft in one scenario, in chunks; an interrupted
campaign can be resumed.

The folder of a campaign holds its definition, a table for each completed chunk, and at the end its
figures and its report.
"""

import logging
import math
from collections.abc import Iterator, Mapping
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np

from aircraft_sim.airframe import load_airframe
from aircraft_sim.uncertainty import (
    Distribution,
    Spread,
    WindEffect,
    drawn_entries,
    sampled_matrices,
)
from flight_analysis.closed_loop.guarantee import Guarantee
from flight_analysis.closed_loop.kept_guarantee import kept
from flight_analysis.closed_loop.loop_margins import LoopMargins, margins, scenario_loop
from flight_analysis.closed_loop.scenario import SCHEMAS, Scenario, scenario_of
from flight_campaign import equipment, learning_flights
from flight_campaign.campaign_course import Course, build_course
from flight_campaign.engines import Engine, Job
from flight_campaign.influence import RANKED, influence
from flight_campaign.learning_flights import MakeLearner
from flight_campaign.rows import Chunk, encode, joined, tally_of
from flight_campaign.statistics import Tally, score, score_units
from flight_core.fields import Field
from flight_core.files import replacing, write_file, writing
from flight_core.parameters import Config, ParameterError, Positive, Positives, require
from flight_core.vectors import FloatArray
from rise_di_controller.control_law import TunedLaw
from rise_di_controller.params import ControllerConfig

if TYPE_CHECKING:
    import polars as pl

    from flight_campaign.batch_loop import Vehicle
    from flight_campaign.missions import Mission

DEFINITION = "campaign.json"
CHUNKS = "chunks"
OUT_OF_MEMORY = "RESOURCE_EXHAUSTED"  # in an error of JAX
LOGGER = logging.getLogger(__name__)
_FITTING: dict[str, int] = {}  # aircraft at once by definition, where a chunk did not fit
# aircraft at once that learn: the flight takes 3 % of the time, and few leave no core idle
LEARNING_CHUNK = 10
MARGIN_AIRCRAFT = 200  # aircraft of a case, the first ones, whose stability is counted


class Sweep(Config):
    """Factors of one parameter of the controller, or of its value in a channel; every aircraft
    flies with each of them.
    """

    parameter: str = Field(description="its name, as beta, or with a channel of y or u, as beta[V]")
    factors: Positives

    @property
    def name(self) -> str:
        """Name of the parameter, without the channel."""
        return self.parameter.partition("[")[0]

    def scaled(self, controller: ControllerConfig, factor: float) -> float | tuple[float, ...]:
        """The parameter times a factor, in the channel alone where one is named.

        A channel of u means the channel of y that it is paired with. Raises ParameterError for
        another parameter or channel.
        """
        swept = swept_parameters(controller)
        require(
            self.name in swept,
            "sweep",
            self.parameter,
            f"a parameter of the controller: {', '.join(swept)}",
        )
        value = getattr(controller, self.name)
        if self.name == self.parameter:
            return (
                tuple(factor * number for number in value)
                if isinstance(value, tuple)
                else factor * float(value)
            )
        m = len(controller.outputs)
        # k_d of (22) has none for the last
        by_channel = isinstance(value, tuple) and len(value) in (m - 1, m)
        require(
            by_channel, "sweep", self.parameter, f"{self.name}: it does not have a value a channel"
        )
        named = [
            *enumerate(controller.outputs[: len(value)]),
            *enumerate(controller.inputs[: len(value)]),
        ]
        places = [k for k, name in named if f"{self.name}[{name}]" == self.parameter]
        names = ", ".join(name for _, name in named)
        require(
            bool(places), "sweep", self.parameter, f"{self.name}[CHANNEL], CHANNEL one of {names}"
        )
        return tuple(
            factor * number if k == places[0] else number for k, number in enumerate(value)
        )


class Definition(Config):
    """All inputs of a campaign's figures, except the version of the stack and the arithmetic of the
    CPU.
    """

    name: str  # of the scenario
    sections: dict[str, dict[str, object]]  # of the scenario, every parameter
    aircraft: int = Field(ge=1, le=2**32, description="how many aircraft fly")
    uncertainty: float = Field(
        ge=0, lt=1, description="the largest part by which an entry of A and of B differs"
    )
    wind: WindEffect = Field(
        description="the effect of wind: by each aircraft's own A, or that of the airframe"
    )
    seed: int = Field(ge=0, lt=2**63, description="the seed of the aircraft")
    chunk: int = Field(ge=1, le=1_000_000, description="how many of them fly at once")
    sweep: Sweep | None = None
    entries: dict[str, Annotated[float, Field(ge=0, lt=1)]] = Field(
        default={}, description="the largest part of entries with one of their own, by name"
    )
    distribution: Distribution = Field(
        default="uniform", description="of the parts, within the largest"
    )
    score_units: dict[str, Positive] = Field(
        default={}, description="unit of an rms error in the score by output, SI, if its own"
    )

    @property
    def spread(self) -> Spread:
        """How the entries of A and B are drawn."""
        return Spread(equipment.matrix_entries(self.entries), self.distribution)

    def drawn_equipment(self, scenario: Scenario, first: int, count: int) -> dict[str, FloatArray]:
        """Lags, noise and delays of aircraft of a case, as `equipment.drawn`."""
        return equipment.drawn(
            scenario, Spread(self.entries, self.distribution), self.seed, first, count
        )

    def scenario(self, case: int = 0) -> Scenario:
        """The scenario of a case of the sweep, the airframe as published."""
        scenario = scenario_of(self.name, Path(self.name), self.sections)
        if self.sweep is None:
            return scenario
        scaled = self.sweep.scaled(scenario.controller, self.factor(case))
        return scenario.vary(controller={self.sweep.name: scaled})

    def aircraft_scenario(self, number: int, case: int = 0) -> Scenario:
        """The scenario of one aircraft of the campaign, as `rise-di fly` flies it."""
        uncertainty: dict[str, Any] = {
            "A": self.uncertainty,
            "B": self.uncertainty,
            "wind": self.wind,
            "seed": self.seed,
            "number": number,
        }
        entries = self.spread.entries
        scenario = self.scenario(case)
        uncertainty |= {
            "entries": [*entries],
            "parts": [*entries.values()],
            "distribution": self.distribution,
        }
        drawn = self.drawn_equipment(scenario, number, 1)
        equipped = equipment.with_equipment(
            scenario, {name: float(value[0]) for name, value in drawn.items()}
        )
        return equipped.vary(aircraft={"uncertainty": uncertainty})

    def score(self, rms: FloatArray) -> FloatArray:
        """The scores of N aircraft, (N,), of their rms errors, (m, N)."""
        scenario = self.scenario()
        units = scenario.aircraft.channels().outputs
        return score(rms, score_units(scenario.controller.outputs, units, self.score_units))

    @property
    def cases(self) -> int:
        """Number of flights of each aircraft."""
        return 1 if self.sweep is None else len(self.sweep.factors)

    def factor(self, case: int) -> float:
        """Factor of the swept parameter in a case."""
        return 1.0 if self.sweep is None else self.sweep.factors[case]

    def label(self, case: int) -> str:
        """The name of a case in tables."""
        return (
            self.name if self.sweep is None else f"{self.sweep.parameter} x {self.factor(case):g}"
        )

    def size(self, job: Job) -> int:
        """Number of aircraft of a chunk."""
        return min(self.chunk, self.aircraft - job[1] * self.chunk)

    def jobs(self) -> Iterator[Job]:
        """The chunks, each (case, chunk)."""
        chunks = -(-self.aircraft // self.chunk)
        return product(range(self.cases), range(chunks))


def swept_parameters(controller: ControllerConfig) -> list[str]:
    """Parameters that a sweep may multiply: the numbers of the law itself, and input_scale."""
    names = [
        name for name in type(controller).model_fields if name not in ControllerConfig.model_fields
    ]
    values = ((name, np.atleast_1d(getattr(controller, name))) for name in names)
    return [*(name for name, value in values if value.dtype == np.float64), "input_scale"]


def _permitted_units(scenario: Scenario, units: Mapping[str, float]) -> dict[str, float]:
    """The units of the score by output. Raises ParameterError for a unit beyond the scenario."""
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
    aircraft: int,
    uncertainty: float,
    seed: int,
    chunk: int | None = None,
    sweep: Sweep | None = None,
    wind: WindEffect | None = None,
    spread: Spread | None = None,
    units: Mapping[str, float] | None = None,
) -> Definition:
    """The definition of a campaign over a scenario.

    `wind` and `spread` None: those of the scenario's `aircraft.uncertainty`. `units` replaces units
    of the score by output, SI. `chunk` None: what is fast on the device, or LEARNING_CHUNK.

    Raises ParameterError if a campaign cannot fly it.
    """
    if sweep is not None:
        sweep.scaled(scenario.controller, 1.0)
    if scenario.learns():
        learning_flights.require_flyable(scenario)
    else:
        course = build_course(scenario)
        if scenario.guidance is not None:
            from flight_campaign import missions  # noqa: PLC0415 - JAX, which the command needs only for flights

            missions.build(scenario, course)
    # each aircraft of the campaign has its own
    published = scenario.vary(aircraft={"uncertainty": {}})
    spread = scenario.aircraft.uncertainty.spread() if spread is None else spread
    spread = spread._replace(entries=equipment.expanded(spread.entries, scenario))
    stated_units = _permitted_units(scenario, units or {})
    airframe_spread = spread._replace(entries=equipment.matrix_entries(spread.entries))
    sampled_matrices(
        load_airframe(scenario.aircraft.airframe),
        uncertainty,
        uncertainty,
        seed,
        0,
        1,
        airframe_spread,
    )
    values = {
        "name": scenario.name,
        "sections": {
            name: section.model_dump(mode="json")
            for name in SCHEMAS
            if (section := getattr(published, name)) is not None
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
    """How many aircraft fly at once."""
    if aircraft < 1:
        return 1
    if scenario.learns():
        return LEARNING_CHUNK
    from flight_campaign.device import chunk_of_device  # noqa: PLC0415 - JAX, as above

    return chunk_of_device(aircraft)


def fly_chunk(text: str, job: Job, learner: MakeLearner | None = None) -> bytes:
    """Fly a chunk of a campaign: its definition as JSON, the job -> its rows as Parquet. It has no
    other inputs.

    `learner` makes the learner of a scenario. Raises ParameterError for an aircraft that does not
    fit into memory.
    """
    definition = Definition.model_validate_json(text)
    if learner is not None and definition.scenario().learns():
        figures = learning_flights.fly_chunk(definition, job, learner)
    else:
        figures = fly_chunk_figures(text, job)
    return encode(figures, definition.seed, definition.factor(job[0]))


def fly_chunk_figures(text: str, job: Job) -> Chunk:
    """Fly a chunk of a campaign, in parts where the memory is too small for a chunk at once."""
    definition = Definition.model_validate_json(text)
    case, chunk = job
    first = chunk * definition.chunk
    end = first + definition.size(job)
    size = _FITTING.get(text, definition.chunk)
    parts: list[Chunk] = []
    while first < end:
        # The last part has the size of the others, so that nothing is compiled again; surplus
        # aircraft are dropped.
        count = min(size, end - first)
        try:
            parts.append(_fly_at_once(text, case, first, count, size))
        except (MemoryError, RuntimeError) as error:  # RuntimeError: of JAX
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
    return joined(parts)


def _fly_at_once(text: str, case: int, first: int, count: int, size: int) -> Chunk:
    """The first `count` of the `size` aircraft from number `first`, which fly at once. Those of a
    guided scenario fly missions.
    """
    from flight_campaign import batch  # noqa: PLC0415 - JAX, which the command needs only for flights
    from flight_campaign.device import turn  # noqa: PLC0415 - as above
    from flight_campaign.drawn_fleet import drawn_fleet  # noqa: PLC0415 - as above

    definition = Definition.model_validate_json(text)
    scenario, course, vehicle, law, mission = _prepare(text, case)
    drawn = drawn_fleet(definition, scenario, first, size)  # while the chunk before flies
    with turn():
        fleet, equipped = drawn.on_device(course, vehicle)
        flown = batch.fly(fleet, equipped, course, law.control_law, law.params, mission)
        result = batch.on_host(flown)
    rms, largest, slew = (part[:, :count] for part in (result.rms, result.max, result.slew))
    outputs = scenario.controller.outputs
    inputs = scenario.controller.effectors
    if result.mission is None:
        figures = {"score": definition.score(rms)}
    else:
        figures = {name: values[:count] for name, values in result.mission.items()}
    for kind, names, values in (
        ("rms", outputs, rms),
        ("max", outputs, largest),
        ("slew", inputs, slew),
    ):
        figures |= {f"{kind}.{name}": row for name, row in zip(names, values, strict=True)}
    entries = {name: value[:count] for name, value in drawn.entries().items()}
    return Chunk(first, result.diverged[:count], figures, entries)


class _Shared(NamedTuple):
    """Data that all chunks of a case share."""

    scenario: Scenario
    course: Course
    vehicle: "Vehicle"
    law: TunedLaw
    mission: "Mission | None"


@lru_cache(maxsize=8)
def _prepare(text: str, case: int) -> _Shared:
    """Data that all chunks of a case share."""
    from flight_campaign import batch, missions  # noqa: PLC0415 - as above

    scenario = Definition.model_validate_json(text).scenario(case)
    law = scenario.controller.tuned_law()
    course = build_course(scenario)
    mission = None if scenario.guidance is None else missions.build(scenario, course)
    return _Shared(
        scenario,
        course,
        batch.vehicle(scenario),
        law._replace(params=batch.shared(law.params)),
        mission,
    )


class Campaign:
    """A campaign and its folder."""

    def __init__(self, folder: Path, definition: Definition) -> None:
        self.folder = folder
        self.definition = definition

    @classmethod
    def begin(cls, folder: Path, definition: Definition) -> "Campaign":
        """A new campaign in an existing, empty folder."""
        campaign = cls(folder, definition)
        (folder / CHUNKS).mkdir()
        _write(folder / DEFINITION, definition.model_dump_json(indent=1))
        return campaign

    @classmethod
    def resume(cls, folder: Path) -> "Campaign":
        """The campaign of a folder. Raises ParameterError for a folder without one."""
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
        """The chunks without a file."""
        return [job for job in self.definition.jobs() if not self._path(job).exists()]

    def fly(self, engine: Engine, learner: MakeLearner | None = None) -> Iterator[int]:
        """Fly the missing chunks; yields the number of flights of each completed one.

        `learner` makes the learner of a scenario.
        """
        for job, table in engine(
            partial(fly_chunk, self.definition.model_dump_json(), learner=learner), self.missing()
        ):
            _write(self._path(job), table)
            yield self.definition.size(job)

    def tally(self, case: int) -> Tally:
        """Statistics of a case, summed in the order of the chunks. Raises ParameterError for a
        damaged file.
        """
        total = Tally()
        for job in self._flown():
            if job[0] == case:
                total += tally_of(self._read(job))
        return total

    def rows(self, case: int | None = None) -> "pl.LazyFrame":
        """The table of the completed chunks of a case or of all, ordered by case, then number;
        `rows` has the columns.
        """
        import polars as pl  # noqa: PLC0415 - some tenths of a second

        return pl.scan_parquet(
            [self._path(job) for job in self._flown() if case in {None, job[0]}], glob=False
        )

    def write_rows(self, path: Path) -> None:
        """Write the table as one Parquet file, chunk by chunk. Raises OSError."""
        with replacing(path) as stream:
            self.rows().sink_parquet(stream)

    def margins(self, case: int) -> LoopMargins | None:
        """Margins of the nominal aircraft and the worst found in the box of a case; None without a
        linear loop.
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
        """The guarantee that was computed for the loop of a case; None without one."""
        definition = self.definition
        scenario = definition.scenario(case)
        part = definition.uncertainty
        spread = definition.spread
        try:
            return kept(scenario_loop(scenario, scenario.controller, 0, part, spread=spread))
        except ParameterError:
            return None

    def _flown(self) -> list[Job]:
        return [job for job in self.definition.jobs() if self._path(job).exists()]

    def influence(self, case: int, worst: int) -> dict[str, Any]:
        """Rank correlations of the drawn entries with the score of a case; `worst` is the number of
        its worst aircraft.
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
    with writing("", path, "a folder and a disk that can"):
        write_file(path, content)
