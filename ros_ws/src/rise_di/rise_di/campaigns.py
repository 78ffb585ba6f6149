# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo campaigns, as `rise-di campaign` flies them on the cores of this machine."""

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
from flight_campaign.single_flights import flies_alone
from flight_core.arguments import FilePath, as_count, as_numbers_by_name, as_path
from flight_core.parameters import ParameterError, require
from flight_design.learning.scenario_learner import quick_learner

if TYPE_CHECKING:
    import polars as pl

Progress = Callable[[int, int], None]
"""Takes the number of flights so far, and that of all flights of a campaign."""


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

        The columns are the seed, the number, the factor of the sweep, divergence, loss of track,
        the figures and the drawn entries. The entries have names such as "A[q,alpha]",
        "B[V,thrust]", "lag[elevator]", "noise[q]" and "delay". The figures of a diverged aircraft
        are null.
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

    The report of the campaign is written, too. After Ctrl-C, `resume_campaign` continues.

    Args:
        scenario: Name, path of a scenario file (.yaml), or a Scenario.
        aircraft: Number of uncertain aircraft.
        uncertainty: Largest relative deviation of each entry of A and B, 0 to 1.
        entries: Entries that have their own deviation: {"A[q,alpha]": 0.6, "lag[elevator]": 0.5,
            "noise[q]": 0.5}; "lag" and "noise" mean all that have no entry of their own. {"delay":
            0.02} is the largest delay of u beyond the scenario's, s. Lags, noise and delay without
            an entry are those of the scenario.
        distribution: Distribution of the deviations: "uniform", "normal" with three standard
            deviations at the limit, or "corners".
        score: Units of the rms errors in the score by output, SI: {"q": 0.02}.
        wind: Whose A the wind acts through: "air_relative", that of each aircraft, or "published",
            that of the airframe; None takes the scenario's.
        seed: Seed of the aircraft.
        sweep: A parameter of the controller, or its value in one channel, and its factors:
            {"beta[V]": [0.5, 1.0, 2.0]}.
        duration: Duration of each flight, s; None takes that of the scenario.
        chunk: Aircraft computed at once; None takes 1000, on a GPU as many as its memory holds, and
            4 with a learner or a route.
        workers: Number of threads, or of processes with a learner or a route; None takes one per
            core. A script with processes must call this function under `if __name__ ==
            "__main__":`.
        runs: Folder in which the folder of the campaign is made.
        progress: Called with the flights so far and all flights, after each chunk.

    Returns:
        The folder, the report and the figures of the campaign.

    Raises:
        ParameterError: A campaign cannot fly the scenario, or cannot have these arguments.

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
        source, aircraft, uncertainty, seed, chunk, _sweep(sweep), wind, spread, units
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
        workers: Number of threads, or of processes with a learner or a route; None takes one per
            core.
        progress: Called with the flights so far and all flights, after each chunk.

    Returns:
        The folder, the report and the figures of the campaign.

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
    """Return threads of this process, or processes of this machine with a learner or a route."""
    count = None if workers is None else as_count(workers, "workers", 1)
    is_single = flies_alone(definition.scenario())
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
