# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Analysis of flights without ROS: the closed loop in one process, design, metrics, the report.

The Python interface is the package `rise_di`. The names that this package had in version 0.2 work with a warning.
"""

import warnings
from importlib import import_module
from types import MappingProxyType
from typing import Any

_FORMER = MappingProxyType(
    {
        "RecordedRun": "flight_log.tape_reader",
        "ReplayResult": "flight_analysis.closed_loop.replay",
        "Scenario": "flight_analysis.closed_loop.scenario",
        "Signal": "flight_core.tape",
        "Tape": "flight_core.tape",
        "best_error": "flight_analysis.metrics",
        "data_frame": "flight_analysis.report.data_frame",
        "error_metrics": "flight_analysis.metrics",
        "load_scenario": "flight_analysis.closed_loop.scenario",
        "read_run": "flight_log.tape_reader",
        "recorded_scenario": "flight_analysis.closed_loop.replay",
        "replay": "flight_analysis.closed_loop.replay",
        "simulate": "flight_analysis.closed_loop.simulate",
        "summarise": "flight_analysis.report.summary",
    }
)
_NEW = MappingProxyType({"load_scenario": "find_scenario"})


def __getattr__(name: str) -> Any:
    """A name of version 0.2, with a warning that has the name in `rise_di`."""
    if name not in _FORMER:
        raise AttributeError(f"module 'flight_analysis' has no attribute {name!r}")
    now = f"the name is rise_di.{_NEW.get(name, name)} now; flight_analysis.{name} ends with the next minor version"
    warnings.warn(f"flight_analysis.{name}: {now}", FutureWarning, stacklevel=2)
    return getattr(import_module(_FORMER[name]), name)
