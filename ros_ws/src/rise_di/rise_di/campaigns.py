# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly Monte Carlo campaigns on the cores of this machine, as `rise-di campaign` does."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from numpy.typing import ArrayLike

from aircraft_sim.uncertainty import Distribution, WindEffect
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.report.run_folder import REPORT, new_run
from flight_campaign import engines
from flight_campaign.campaign import MonteCarlo, define
from flight_campaign.campaign_report import write_results
from flight_campaign.definition import Definition, Sweep
from flight_campaign.single_flights import is_flown_alone
from flight_core.arguments import FilePath, as_count, as_numbers_by_name, as_path
from flight_core.parameters import ParameterError, require
from flight_design.learning.scenario_learner import quick_learner

if TYPE_CHECKING:
    import polars as pl

Progress = Callable[[int, int], None]
"""A function that takes the number of flights so far, and the number of all flights of a
campaign."""


class CampaignResult(NamedTuple):
    """A campaign that has flown.

    Attributes:
        folder: Folder of the campaign.
        report: Page of the report.
        figures: Content of summary.json.
    """

    folder: Path
    report: Path
    figures: dict[str, Any]

    def rows(self) -> "pl.DataFrame":
        """Return a table with a row for each aircraft, SI.

        The columns are the seed, the number of the aircraft, the factor of the sweep, divergence,
        loss of track, the metrics and the drawn entries. The entries have names such as
        "A[q,alpha]", "B[V,thrust]", "lag[elevator]", "noise[q]" and "delay". The metrics of a
        diverged aircraft are null.
        """
        return MonteCarlo.resume(self.folder).rows().collect()


def fly_campaign(
    scenario: FilePath | Scenario,
    aircraft: int = 1000,
    *,
    uncertainty: float = 0.3,
    entries: Mapping[str, float] | None = None,
    distribution: Distribution | None = None,
    score: Mapping[str, float] | None = None,
    wind: WindEffect | None = None,
    seed: int = 1,
    sweep: Mapping[str, ArrayLike] | None = None,
    duration: float | None = None,
    chunk: int | None = None,
    workers: int | None = None,
    runs: FilePath = "runs",
    progress: Progress | None = None,
) -> CampaignResult:
    """Fly thousands of uncertain aircraft around the airframe of a scenario.

    This also writes the report of the campaign. After Ctrl-C, `resume_campaign` continues it.

    Args:
        scenario: Name, path of a scenario file (.yaml), or a Scenario.
        aircraft: Number of uncertain aircraft.
        uncertainty: Largest relative deviation of each entry of A and B, 0 to 1.
        entries: Largest relative deviations by name, as in {"A[q,alpha]": 0.6, "lag[elevator]":
            0.5, "noise[q]": 0.5}. "lag" and "noise" stand for all lags and noises that are not
            named. {"delay": 0.02} adds a delay of u of up to 0.02 s. Lags, noise and delay without
            an entry are as in the scenario.
        distribution: Distribution of the deviations: "uniform", "normal" with three standard
            deviations at the limit, or "corners".
        score: Units of the rms errors in the score by output, SI, as in {"q": 0.02}.
        wind: The A through which the wind acts: each aircraft's own for "air_relative", or the
            airframe's for "published". If None, the scenario decides.
        seed: Seed of the aircraft.
        sweep: A parameter of the controller, or its value in one channel, and factors for it, as in
            {"beta[V]": [0.5, 1.0, 2.0]}.
        duration: Duration of each flight, s. If None, it is the scenario's.
        chunk: Number of aircraft computed at once. If None, it is 4 with a learner or a route, on a
            GPU as many as fit into its memory, and otherwise 1000.
        workers: Number of threads, or of processes with a learner or a route. If None, there is one
            for each core. A script with processes must call this function under `if __name__ ==
            "__main__":`.
        runs: Folder in which the folder of the campaign is created.
        progress: Called after each chunk with the number of flights so far and in total.

    Returns:
        The folder, the report and the metrics of the campaign.

    Raises:
        ParameterError: A campaign cannot fly the scenario, or an argument is invalid.

    Examples:
        >>> scenario = rise_di.find_scenario("osprey_servo", duration=0.1)
        >>> rise_di.fly_campaign(scenario, 2, workers=1).rows().height
        2
    """
    engines.require_jax()
    source = find_scenario(scenario, duration)
    spread = source.aircraft.uncertainty.spread()
    if entries is not None:
        spread = spread._replace(
            entries=as_numbers_by_name(entries, "entries", '{"A[q,alpha]": 0.6}')
        )
    if distribution is not None:
        spread = spread._replace(distribution=distribution)
    units = None if score is None else as_numbers_by_name(score, "score", '{"q": 0.02}')
    definition = define(
        source,
        aircraft=aircraft,
        uncertainty=uncertainty,
        seed=seed,
        chunk=chunk,
        sweep=_sweep(sweep),
        wind=wind,
        spread=spread,
        units=units,
    )
    quick_learner(source)  # refuses a scenario with which the aircraft could not learn
    flies = _engine(definition, workers)
    report = _progress(progress)
    folder = new_run(source, as_path(runs, "runs", "the path of a folder"), "campaign-")
    return _fly(MonteCarlo.begin(folder, definition), flies, report)


def resume_campaign(
    folder: FilePath, *, workers: int | None = None, progress: Progress | None = None
) -> CampaignResult:
    """Fly the aircraft that an interrupted campaign has not flown.

    Args:
        folder: The folder of the campaign.
        workers: Number of threads, or of processes with a learner or a route. If None, there is one
            for each core.
        progress: Called after each chunk with the number of flights so far and in total.

    Returns:
        The folder, the report and the metrics of the campaign.

    Raises:
        ParameterError: The folder has no campaign.

    Examples:
        >>> scenario = rise_di.find_scenario("osprey_servo", duration=0.1)
        >>> campaign = rise_di.fly_campaign(scenario, 2, workers=1)
        >>> rise_di.resume_campaign(campaign.folder).figures == campaign.figures
        True
    """
    engines.require_jax()
    campaign = MonteCarlo.resume(as_path(folder, "folder", "the folder of a campaign"))
    return _fly(campaign, _engine(campaign.definition, workers), _progress(progress))


def _engine(definition: Definition, workers: int | None) -> engines.Engine:
    """Return the engine, which uses processes with a learner or a route, and threads otherwise."""
    count = None if workers is None else as_count(workers, "workers", 1)
    is_single = is_flown_alone(definition.scenario())
    return engines.dask(count, on_devices=False) if is_single else engines.threads(count)


def _progress(progress: Progress | None) -> Progress:
    require(
        progress is None or callable(progress),
        "progress",
        progress,
        "a function of the flights so far and of all flights",
    )
    return progress or (lambda flown, total: None)


def _sweep(sweep: Mapping[str, ArrayLike] | None) -> Sweep | None:
    if sweep is None:
        return None
    if not isinstance(sweep, Mapping) or len(sweep) != 1:
        raise ParameterError(
            f'sweep: found {sweep!r}, expected one parameter and its factors, as in {{"beta": '
            f"[0.5, 1.0, 2.0]}}"
        )
    ((parameter, factors),) = sweep.items()
    return Sweep.validate_mapping({"parameter": parameter, "factors": factors}, "sweep")


def _fly(campaign: MonteCarlo, engine: engines.Engine, progress: Progress) -> CampaignResult:
    definition = campaign.definition
    missing = campaign.missing()
    total = definition.aircraft * definition.cases
    count = total - sum(definition.size(job) for job in missing)
    for flights in campaign.fly(engine, quick_learner):
        count += flights
        progress(count, total)
    figures, _ = write_results(campaign)
    return CampaignResult(campaign.folder, campaign.folder / REPORT, figures)
