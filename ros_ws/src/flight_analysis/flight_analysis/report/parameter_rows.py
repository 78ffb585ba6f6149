# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""List the parameters of a flight that differ from their defaults or have no default."""

from collections.abc import Iterator

from flight_analysis.closed_loop.scenario import SCHEMAS, Scenario
from flight_core.fields import REQUIRED
from flight_core.parameters import Config, flatten
from flight_log.log_messages import shown

NONE = "none"
LEFT_OUT = ("recorder.", "flight.")  # sections about the log and the run, not the flight


def parameter_rows(scenario: Scenario) -> list[tuple[str, str, str]]:
    """Return name, flown value and default of each parameter that differs from its default, SI.

    Parameters without a default come last. Their rows have the text NONE in place of a default.
    """
    rows: list[tuple[str, str, str]] = []
    for section in SCHEMAS:
        if (config := getattr(scenario, section)) is not None:
            rows += _rows(config, f"{section}.")
    flown = [row for row in rows if not row[0].startswith(LEFT_OUT)]
    return sorted(flown, key=lambda row: row[2] == NONE)


def _rows(config: Config, prefix: str) -> Iterator[tuple[str, str, str]]:
    for name, field in type(config).model_fields.items():
        value = getattr(config, name)
        if isinstance(value, Config):
            yield from _rows(value, f"{prefix}{name}.")
        elif value != field.default:
            has_default = field.default is not REQUIRED and field.default is not None
            default = _text(field.default) if has_default else NONE
            tree = config.model_dump()[name]
            for key, flown in flatten({name: tree}):
                yield f"{prefix}{key}", _text(flown), default


def _text(value: object) -> str:
    return shown(list(value) if isinstance(value, tuple) else value)
