# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The Python interface of the RISE-DI flight stack, in one import. A name loads its module at its first use; none needs ROS.

    import rise_di

    scenario = rise_di.find_scenario("osprey_gust").vary(controller={"beta": [2.0, 2.0, 1.0, 1.0]})
    tape = rise_di.simulate(scenario)
    q, t = tape["y"]["q"], tape.time("y")

The names keep their meaning within a minor version; see CHANGELOG.md.
"""

from importlib import import_module
from typing import TYPE_CHECKING

__all__ = [
    "Airframe",
    "ControlLaw",
    "Controller",
    "LawParams",
    "LawState",
    "Measurements",
    "ParameterError",
    "RecordedRun",
    "ReplayResult",
    "RiseDiConfig",
    "Scenario",
    "Selection",
    "Sign",
    "Signal",
    "StampedVector",
    "Tape",
    "TunedLaw",
    "airframe_facts",
    "airframes",
    "best_error",
    "check_gains",
    "data_frame",
    "decompose",
    "engage",
    "error_metrics",
    "find_scenario",
    "gains_yaml",
    "law_schema",
    "laws",
    "load_airframe",
    "margins",
    "read_run",
    "recorded_scenario",
    "replay",
    "scenario_yaml",
    "scenarios",
    "select_gains",
    "simulate",
    "step",
    "summarise",
]

if TYPE_CHECKING:  # for type checkers and completion; a test compares these imports with HOMES
    from aircraft_sim.airframe import Airframe, airframes, load_airframe
    from flight_analysis.closed_loop.margins import margins
    from flight_analysis.closed_loop.replay import ReplayResult, recorded_scenario, replay
    from flight_analysis.closed_loop.scenario import Scenario, scenario_yaml
    from flight_analysis.closed_loop.simulate import simulate
    from flight_analysis.design.airframe_properties import airframe_facts
    from flight_analysis.design.gain_selection import Selection
    from flight_analysis.design.gain_selection import as_yaml as gains_yaml
    from flight_analysis.metrics import best_error, error_metrics
    from flight_analysis.report.data_frame import data_frame
    from flight_analysis.report.summary import summarise
    from flight_bringup.scenarios import find_scenario, scenarios
    from flight_core.parameters import ParameterError
    from flight_core.tape import Signal, Tape
    from flight_core.vectors import StampedVector
    from flight_log.tape_reader import RecordedRun, read_run
    from rise_di.gain_design import check_gains, select_gains
    from rise_di_controller.control_law import ControlLaw, Measurements, TunedLaw
    from rise_di_controller.controller import Controller
    from rise_di_controller.decomposition import decompose
    from rise_di_controller.law import LawParams, LawState, Sign, engage, step
    from rise_di_controller.laws import names as laws
    from rise_di_controller.laws import schema as law_schema
    from rise_di_controller.rise_di import RiseDiConfig

    __version__: str
else:  # type checkers would take a module with __getattr__ to have any name
    HOMES = {
        "aircraft_sim.airframe": ("Airframe", "airframes", "load_airframe"),
        "flight_analysis.closed_loop.margins": ("margins",),
        "flight_analysis.closed_loop.replay": ("ReplayResult", "recorded_scenario", "replay"),
        "flight_analysis.closed_loop.scenario": ("Scenario", "scenario_yaml"),
        "flight_analysis.closed_loop.simulate": ("simulate",),
        "flight_analysis.design.airframe_properties": ("airframe_facts",),
        "flight_analysis.design.gain_selection": ("Selection", "as_yaml as gains_yaml"),
        "flight_analysis.metrics": ("best_error", "error_metrics"),
        "flight_analysis.report.data_frame": ("data_frame",),
        "flight_analysis.report.summary": ("summarise",),
        "flight_bringup.scenarios": ("find_scenario", "scenarios"),
        "flight_core.parameters": ("ParameterError",),
        "flight_core.tape": ("Signal", "Tape"),
        "flight_core.vectors": ("StampedVector",),
        "flight_log.tape_reader": ("RecordedRun", "read_run"),
        "rise_di.gain_design": ("check_gains", "select_gains"),
        "rise_di_controller.control_law": ("ControlLaw", "Measurements", "TunedLaw"),
        "rise_di_controller.controller": ("Controller",),
        "rise_di_controller.decomposition": ("decompose",),
        "rise_di_controller.law": ("LawParams", "LawState", "Sign", "engage", "step"),
        "rise_di_controller.laws": ("names as laws", "schema as law_schema"),
        "rise_di_controller.rise_di": ("RiseDiConfig",),
    }
    """The names by the module that holds each, as an import statement has them."""

    _HOME = {name.split(" as ")[-1]: (module, name.split(" as ")[0]) for module, names in HOMES.items() for name in names}

    def __getattr__(name: str) -> object:
        """Load the module of a name at the first use of the name."""
        if name == "__version__":
            from importlib.metadata import version  # noqa: PLC0415 - needs as long as all else here

            value: object = version("rise-di")
        elif name in _HOME:
            module, attribute = _HOME[name]
            value = getattr(import_module(module), attribute)
        else:
            raise AttributeError(f"module 'rise_di' has no attribute {name!r}")
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        return [*__all__, "__version__"]
