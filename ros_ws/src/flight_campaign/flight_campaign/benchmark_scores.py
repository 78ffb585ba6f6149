# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The public benchmark: an entry flies every set in chunks that an interrupted run keeps, and one
file has the scores.
"""

import json
import secrets
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from aircraft_sim.uncertainty import gust_directions, sampled_matrices
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.metrics import best_error
from flight_campaign import batch, batch_matrices, missions
from flight_campaign.batch import Stepper
from flight_campaign.batch_loop import FleetResult
from flight_campaign.benchmark_course import Course, build_course
from flight_campaign.benchmark_entry import BenchmarkEntry, Step, Task, entered, stepped, task_of
from flight_campaign.benchmark_sets import (
    AFTER,
    BEFORE,
    RELEASE_LENGTH,
    SETS,
    UNCERTAINTY,
    VERSION,
    Sets,
    seed_of,
)
from flight_campaign.engines import Engine, Job
from flight_campaign.missions import Mission
from flight_campaign.rows import Chunk, encode
from flight_campaign.statistics import LOSS_OF_TRACK_SCORE, score, score_units
from flight_core.fields import Field
from flight_core.files import is_file, write_file, writing
from flight_core.outcome import COMPLETED, INTERRUPTED
from flight_core.parameters import Config, ParameterError, require
from flight_core.rates import seconds
from flight_core.vectors import FloatArray
from rise_di_controller.controller import Controller, ControlOutput
from rise_di_controller.guard import TickInputs
from rise_di_controller.params import ControllerConfig

if TYPE_CHECKING:
    import polars as pl

DEFINITION = "benchmark.json"
CHUNKS = "chunks"
SCORES = "scores.json"
ENTRY = "entry"  # folder of the sources
CHUNK = 50  # aircraft of a set that fly at once


class Definition(Config):
    """All inputs of the scores, except the arithmetic of the CPU."""

    version: int = Field(ge=1, le=10_000, description="the version of the sets")
    digest: str  # of the sets
    release: str = Field(description="the hash that fresh seeds come from; empty: the fixed seeds")
    aircraft: int = Field(ge=1, le=100_000, description="how many aircraft a set has")
    entry: str
    sees: str
    knows: str
    source: str  # SHA-256 of gains and modules of the entry
    stack: str  # its version
    not_flown: dict[str, str]  # a sentence for each set that the entry takes no part in

    def jobs(self) -> Iterator[Job]:
        """The chunks, each (number of the set, chunk)."""
        for number, (name, flight_set) in enumerate(SETS.items()):
            if name not in self.not_flown:
                yield from (
                    (number, chunk)
                    for chunk in range(-(-flight_set.aircraft(self.aircraft) // CHUNK))
                )

    def size(self, job: Job) -> int:
        """Number of aircraft of a chunk."""
        return min(CHUNK, [*SETS.values()][job[0]].aircraft(self.aircraft) - job[1] * CHUNK)

    @property
    def flights(self) -> int:
        """Number of flights of all sets."""
        return sum(map(self.size, self.jobs()))


def define(flights: "Flights", aircraft: int, stack: str) -> Definition:
    """The definition of a run. Raises ParameterError for an entry that flies no set."""
    entry = flights.entry
    not_flown = flights.not_flown()
    flies = len(not_flown) < len(SETS)
    require(
        flies,
        entry.name,
        next(iter(not_flown.values()), ""),
        "an entry that flies one set at least",
    )
    values: dict[str, Any] = {key: getattr(entry, key) for key in ("sees", "knows", "source")}
    values |= {
        "version": VERSION,
        "digest": flights.sets.digest(),
        "release": flights.sets.release,
        "aircraft": aircraft,
        "entry": entry.name,
        "stack": stack,
        "not_flown": not_flown,
    }
    return Definition.validate_mapping(values, "benchmark")


def drawn_release(folder: Path) -> str:
    """The hash of a run in a folder, else one drawn at random, from which the seeds come:
    unknown before the run has flown.
    """
    if not is_file(folder / DEFINITION):
        return secrets.token_hex(RELEASE_LENGTH // 2)
    text = (folder / DEFINITION).read_text(encoding="utf-8")
    return Definition.validate_mapping(json.loads(text), DEFINITION).release


class Benchmark:
    """A run of the benchmark and its folder, which keeps the sources of the entry. A folder with
    chunks of the same definition is continued.
    """

    def __init__(
        self,
        folder: Path,
        definition: Definition,
        sources: Mapping[str, bytes] = MappingProxyType({}),
    ) -> None:
        self.folder = folder
        self.definition = definition
        path = folder / DEFINITION
        if is_file(path):
            same = path.read_text(encoding="utf-8") == definition.model_dump_json(indent=1)
            require(
                same,
                "--output",
                f"{folder} with another entry, version or option",
                "another folder, or remove this one",
            )
        with writing("--output", folder, "a folder that can"):
            for name in (CHUNKS, ENTRY):
                (folder / name).mkdir(parents=True, exist_ok=True)
            for name, content in sources.items():
                write_file(folder / ENTRY / name, content)
            write_file(path, definition.model_dump_json(indent=1))

    def missing(self) -> list[Job]:
        """The chunks without a file."""
        return [job for job in self.definition.jobs() if not self._path(job).exists()]

    def fly(self, flights: "Flights", engine: Engine) -> Iterator[int]:
        """Fly the missing chunks; yields the number of flights of each completed one. Raises
        ParameterError for a wrong u.
        """
        for job, table in engine(
            partial(flights.fly, aircraft=self.definition.aircraft), self.missing()
        ):
            with writing("--output", self.folder, "a folder that can"):
                write_file(self._path(job), table)
            yield self.definition.size(job)

    def scores(self) -> dict[str, Any]:
        """The scores of all sets, and their file."""
        definition = self.definition
        scored = {name: self._scores(number, name) for number, name in enumerate(SETS)}
        stated = definition.model_dump()
        benchmark = {key: stated[key] for key in ("version", "digest", "release", "aircraft")}
        entry = {"name": definition.entry}
        entry |= {key: stated[key] for key in ("sees", "knows", "source")}
        scores = {"benchmark": benchmark, "entry": entry, "stack": definition.stack, "sets": scored}
        with writing("--output", self.folder, "a folder that can"):
            write_file(self.folder / SCORES, json.dumps(scores, indent=1, allow_nan=False) + "\n")
        return scores

    def _scores(self, number: int, name: str) -> dict[str, Any]:
        import polars as pl  # noqa: PLC0415 - some tenths of a second

        title = {"title": SETS[name].title}
        if (reason := self.definition.not_flown.get(name)) is not None:
            return title | {"not_flown": reason}
        paths = [self._path(job) for job in self.definition.jobs() if job[0] == number]
        return title | scores_of(pl.concat([pl.read_parquet(path) for path in paths]))

    def _path(self, job: Job) -> Path:
        return self.folder / CHUNKS / f"{[*SETS][job[0]]}-{job[1]:03d}.parquet"


class _Prepared(NamedTuple):
    """What all chunks of a set share."""

    task: Task
    law: ControllerConfig | Step
    scenario: Scenario
    course: Course | None  # None: one aircraft in one process
    mission: Mission | None
    windows: tuple[int, ...]  # ticks


class Flights:
    """The flights of an entry."""

    def __init__(self, entry: BenchmarkEntry, sets: Sets) -> None:
        self.entry = entry
        self.sets = sets
        self._prepared: dict[str, _Prepared] = {}

    def not_flown(self) -> dict[str, str]:
        """A sentence for each set that the entry takes no part in. Raises ParameterError for a
        section that is none.
        """
        reasons = {}
        for name in SETS:
            task = task_of(name, self.sets)
            law = entered(self.entry, task)
            if law is None:
                reasons[name] = f"the entry has no law for {task.airframe}"
                continue
            try:
                self._prepared[name] = self._prepare(name, task, law)
            except ParameterError as error:
                reasons[name] = str(error)
        return reasons

    def _prepare(self, name: str, task: Task, law: ControllerConfig | Step) -> _Prepared:
        scenario = self.sets.scenario(name)
        if isinstance(law, ControllerConfig):
            scenario = scenario.vary(controller=law)
        if not SETS[name].fleet:
            return _Prepared(task, law, scenario, None, None, ())
        course = build_course(scenario)
        mission = None if scenario.guidance is None else missions.build(scenario, course)
        return _Prepared(
            task,
            law,
            scenario,
            course,
            mission,
            tuple(round(edge * task.rate) for edge in SETS[name].edges),
        )

    def fly(self, job: Job, aircraft: int) -> bytes:
        """Fly a chunk of a benchmark of `aircraft`: its rows as Parquet."""
        name = [*SETS][job[0]]
        chunk = job[1]
        prepared = self._prepared[name]
        seed = seed_of(name, self.sets.release, "aircraft")
        if prepared.course is None:
            return encode(_fly_alone(self.entry, prepared), seed, 1.0)
        first = chunk * CHUNK
        size = min(CHUNK, SETS[name].aircraft(aircraft) - chunk * CHUNK)
        return encode(_fly_fleet(self.entry, prepared, seed, first, size), seed, 1.0)


def _fly_fleet(
    entry: BenchmarkEntry, prepared: _Prepared, seed: int, first: int, size: int
) -> Chunk:
    """Fly uncertain aircraft first, first + 1, ..., as in a campaign."""
    scenario = prepared.scenario
    course = prepared.course
    assert course is not None  # noqa: S101 - for the type checker
    airframe = scenario.aircraft.nominal_airframe()
    A, B = sampled_matrices(airframe, UNCERTAINTY, UNCERTAINTY, seed, first, size)
    directions = gust_directions(airframe, A, scenario.aircraft.uncertainty.wind)
    late = round(SETS[prepared.task.set].late / course.period)
    aircraft = batch_matrices.assemble(
        A, B, scenario.aircraft.plant(), course, late=late, gust_directions=directions
    )
    vehicle = batch.vehicle(scenario)
    if isinstance(prepared.law, ControllerConfig):
        law = prepared.law.tuned_law()
        params = batch.shared(law.params)
        result = batch.fly(
            aircraft, vehicle, course, law.control_law, params, prepared.mission, prepared.windows
        )
    else:
        result = _stepped(
            Stepper(aircraft, vehicle, course, prepared.mission, prepared.windows),
            entry,
            prepared,
            size,
        )
    return Chunk(first, np.asarray(result.diverged), _figures(result, prepared), {})


def _stepped(
    flights: Stepper, entry: BenchmarkEntry, prepared: _Prepared, size: int
) -> FleetResult:
    """Fly a function, one for each aircraft. That of a diverged aircraft is not called any more."""
    steps = [entered(entry, prepared.task) for _ in range(size)]
    u = np.zeros((len(prepared.task.inputs), size))
    for _ in range(flights.ticks):
        y, y_m = flights.sense()
        bounded = flights.bounded
        t = flights.t
        for k, step in enumerate(steps):
            if bounded[k] and callable(step):
                u[:, k] = stepped(step, t, y[:, k], y_m[:, k], prepared.task)
        flights.advance(u)
    return flights.result()


def _figures(result: FleetResult, prepared: _Prepared) -> dict[str, FloatArray]:
    """Figures by name, (N,) each, SI; the score of a window has the name "score.30-60"."""
    outputs = prepared.task.outputs
    inputs = prepared.task.inputs
    unit = score_units(outputs, prepared.scenario.aircraft.channels().outputs)
    if result.mission is None:
        figures = {"score": score(np.asarray(result.rms), unit)}
    else:
        figures = {name: np.asarray(values) for name, values in result.mission.items()}
    for kind, names, values in (("rms", outputs, result.rms), ("slew", inputs, result.slew)):
        figures |= {
            f"{kind}.{name}": row for name, row in zip(names, np.asarray(values), strict=True)
        }
    edges = (0.0, *SETS[prepared.task.set].edges, prepared.scenario.flight.duration)
    if len(edges) > 2:  # more than one window
        for begin, end, rms in zip(edges, edges[1:], np.asarray(result.windows), strict=False):
            figures[f"score.{begin:g}-{end:g}"] = score(rms, unit)
    return figures


class _FunctionController(Controller):
    """A function in place of the guarded law of a flight in one process: called once a tick with
    the newest y and y_m.
    """

    def __init__(self, parameters: ControllerConfig, step: Step, task: Task) -> None:
        super().__init__(parameters)
        self._step = step
        self._task = task
        self.names = ()

    def tick(self, now_ns: int, late_ns: int = 0, *, active: bool = True) -> ControlOutput | None:
        """The u of the function."""
        y = self._y[-1]
        y_m = self._y_m[-1]
        t = seconds(now_ns)
        u = stepped(self._step, t, y.value, y_m.value, self._task)
        inputs = TickInputs(
            y.stamp_ns,
            y.value,
            y_m.value,
            seconds(y_m.stamp_ns - y.stamp_ns),
            seconds(self.period_ns),
        )
        return ControlOutput(y.stamp_ns, u, inputs, lambda: np.zeros(0))


def _fly_alone(entry: BenchmarkEntry, prepared: _Prepared) -> Chunk:
    """Fly the aircraft of the scenario in one process."""
    law = entered(entry, prepared.task)
    if isinstance(law, ControllerConfig) or law is None:
        tape = simulate(prepared.scenario)
    else:
        tape = simulate(
            prepared.scenario, control=partial(_FunctionController, step=law, task=prepared.task)
        )
    if tape.outcome == INTERRUPTED:
        raise KeyboardInterrupt
    _, e = best_error(tape)
    rms = np.sqrt(np.mean(e.values**2, axis=0))
    u = tape["u"]
    slew = np.abs(np.diff(u.values, axis=0)).sum(axis=0) / prepared.scenario.flight.duration
    unit = score_units(e.names, prepared.scenario.aircraft.channels().outputs)
    figures = {"score": score(rms[:, None], unit)}
    for kind, names, values in (("rms", e.names, rms), ("slew", u.names, slew)):
        figures |= {
            f"{kind}.{name}": np.array([value]) for name, value in zip(names, values, strict=True)
        }
    return Chunk(0, np.array([tape.outcome != COMPLETED]), figures, {})


def scores_of(rows: "pl.DataFrame") -> dict[str, Any]:
    """The scores of a set. A lost aircraft counts LOSS_OF_TRACK_SCORE; rms and slew are of those
    that did not diverge.

    `over_time` has the mean score of each window, and `recovery` that of the window AFTER over that
    of BEFORE.
    """
    flown = ~rows["diverged"].to_numpy()

    def values(name: str) -> FloatArray:
        return rows[name].fill_null(np.inf).to_numpy()

    def counted(name: str) -> FloatArray:
        return np.minimum(values(name), LOSS_OF_TRACK_SCORE)

    def means(kind: str) -> dict[str, float | None]:
        names = [name for name in rows.columns if name.startswith(kind)]
        return {
            name.removeprefix(kind): float(values(name)[flown].mean()) if flown.any() else None
            for name in names
        }

    total = counted("score")
    scores: dict[str, Any] = {
        "aircraft": len(rows),
        "lost": int((total >= LOSS_OF_TRACK_SCORE).sum()),
    }
    scores |= {
        "score": {"mean": float(total.mean()), "worst": float(total.max())},
        "rms": means("rms."),
        "slew": means("slew."),
    }
    names = [name for name in rows.columns if name.startswith("score.")]
    if names:
        windows = {name.removeprefix("score."): float(counted(name).mean()) for name in names}
        scores |= {"over_time": windows, "recovery": windows[AFTER] / windows[BEFORE]}
    return scores
