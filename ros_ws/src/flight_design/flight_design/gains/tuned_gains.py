# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read and write files of tuned gains: one per scenario, with gains by law and objective."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import yaml

from control_laws.catalogue import LAWS
from flight_analysis.closed_loop.scenario import Scenario
from flight_core.files import comment, read_yaml, write_file, writing
from flight_core.parameters import ParameterError

TUNED = Path(__file__).parent / "tuned"  # folder of the tuned gains, one file a scenario


class TuningResult(NamedTuple):
    """The tuned gains that a search has found, with their cost."""

    gains: dict[str, list[float]]
    cost: float
    seed: int  # seed of the best search
    costs: list[float]  # cost of each seed
    evaluations: int  # number of evaluations for each seed


class _Dumper(yaml.SafeDumper):
    """A YAML dumper that writes a tuning result in flow style, with a line or two per gain set."""


_Dumper.add_representer(
    TuningResult,
    lambda dumper, result: dumper.represent_mapping(
        "tag:yaml.org,2002:map", result._asdict(), flow_style=True
    ),
)


def tuned_file(scenario: Scenario) -> Path:
    """Return the path of the tuned gains of a scenario."""
    return TUNED / f"{scenario.name}.yaml"


def load(path: Path) -> dict[str, dict[str, TuningResult]]:
    """Load tuned gains by law and objective, or return {} if the file does not exist.

    Raises ParameterError if the file cannot be read.
    """
    if not path.exists():
        return {}
    return {law: dict(sets) for law, sets in _load(path, path.stat().st_mtime_ns).items()}


@lru_cache(maxsize=16)
def _load(path: Path, _changed_ns: int) -> dict[str, dict[str, TuningResult]]:
    """Load tuned gains, with a cache that holds as long as the file does not change.

    The cache matters because a learner designs every few seconds.
    """
    content = read_yaml(path, path.name, "a file of tuned gains")
    try:
        laws = content["laws"].items()
        results = {}
        for law, sets in laws:
            results[law] = {objective: TuningResult(**entry) for objective, entry in sets.items()}
    except (TypeError, KeyError, AttributeError) as error:
        raise ParameterError(
            f"{path.name}: found {error}, expected laws, each with gains by objective"
        ) from None
    return results


def find(scenario: Scenario, law: str, objective: str) -> TuningResult | None:
    """Return the tuned gains of a law in a scenario, or None if there are none.

    Raises ParameterError if the file cannot be read.
    """
    return load(tuned_file(scenario)).get(law, {}).get(objective)


def save(
    path: Path,
    results: Mapping[str, Mapping[str, TuningResult]],
    order: Sequence[str],
    command: str,
) -> None:
    """Write tuned gains, costs and the tuning command.

    The laws come in the order of the catalogue, and the objectives of each law as in `order`.
    Raises ParameterError if the file cannot be written.
    """
    known = set().union(*results.values())
    objectives = [name for name in order if name in known]
    head = (
        "# SPDX-FileCopyrightText: RISE-DI contributors\n# SPDX-License-Identifier: Apache-2.0\n#\n"
        "# Gains found by CMA-ES, in the law's order of channels and its scaled inputs; cost, "
        "seed, evaluations of a search.\n"
        + comment([f"Made by: {command} --tuning {','.join(objectives)}"])
    )
    names = [*(law for law in LAWS if law in results), *(law for law in results if law not in LAWS)]
    laws = {}
    for law in names:
        laws[law] = {name: results[law][name] for name in objectives if name in results[law]}
    text = yaml.dump(
        {"laws": laws}, Dumper=_Dumper, sort_keys=False, default_flow_style=False, width=160
    )
    with writing("", path, "a writable file of tuned gains"):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, head + text)
