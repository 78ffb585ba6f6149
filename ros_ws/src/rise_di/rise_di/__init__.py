# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The Python interface of the RISE-DI flight stack, in one import. A name loads its module at its
first use; none needs ROS.

    import rise_di

    scenario = rise_di.find_scenario("osprey_servo").vary(controller={"beta": [2.0, 2.0, 1.0, 1.0]})
    tape = rise_di.simulate(scenario)
    q, t = tape["y"]["q"], tape.time("y")

The names keep their meaning within a minor version; see CHANGELOG.md.
"""

from importlib import import_module
from typing import TYPE_CHECKING

__all__ = [
    "Airframe",
    "Array",
    "CampaignResult",
    "ControlLaw",
    "Controller",
    "ControllerConfig",
    "Exported",
    "Field",
    "FlightEnv",
    "FlightResult",
    "FlightVectorEnv",
    "GainAssessment",
    "LawParams",
    "LawState",
    "Limits",
    "Loop",
    "LoopMargins",
    "Measurements",
    "NewAirframe",
    "NonNegatives",
    "ParameterError",
    "Positives",
    "RecordedFlight",
    "RecordedRun",
    "ReplayResult",
    "Report",
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
    "array_namespace",
    "as_control",
    "best_error",
    "check_gains",
    "data_frame",
    "decompose",
    "engage",
    "error_metrics",
    "export",
    "find_scenario",
    "fly",
    "fly_campaign",
    "fly_plant",
    "gains_yaml",
    "law_schema",
    "laws",
    "learner",
    "limited_integral",
    "load_airframe",
    "margins",
    "new_airframe",
    "read_run",
    "recorded_scenario",
    "replay",
    "report",
    "require_length",
    "resume_campaign",
    "saturate",
    "scenario_yaml",
    "scenarios",
    "select_gains",
    "simulate",
    "step",
    "summarise",
    "without_limits",
]

if TYPE_CHECKING:  # for type checkers and completion; a test compares these imports with HOMES
    from aircraft_sim.airframe import Airframe, airframes, load_airframe
    from flight_analysis.closed_loop.loop_margins import LoopMargins, margins
    from flight_analysis.closed_loop.replay import ReplayResult, recorded_scenario, replay
    from flight_analysis.closed_loop.scenario import Scenario, scenario_yaml
    from flight_analysis.closed_loop.scenario_library import find_scenario, scenarios
    from flight_analysis.closed_loop.simulate import simulate
    from flight_analysis.metrics import error_metrics
    from flight_analysis.report.account import best_error_over as best_error
    from flight_analysis.report.data_frame import data_frame
    from flight_analysis.report.report import Report, report
    from flight_analysis.report.run_folder import FlightResult
    from flight_analysis.report.run_folder import read_accounted as read_run
    from flight_analysis.report.summary import RecordedFlight, summarise
    from flight_bringup.fly import fly_and_report as fly
    from flight_core.fields import Field
    from flight_core.parameters import NonNegatives, ParameterError, Positives, require_length
    from flight_core.tape import Signal, Tape
    from flight_core.vectors import Array, StampedVector, array_namespace
    from flight_design.gains.airframe_properties import airframe_facts
    from flight_design.gains.gain_design import check_gains, select_gains
    from flight_design.gains.gain_selection import GainAssessment, Selection
    from flight_design.gains.gain_yaml import as_yaml as gains_yaml
    from flight_design.learning.scenario_learner import learner
    from flight_log.tape_reader import RecordedRun
    from rise_di.c_code import Exported, export
    from rise_di.campaigns import CampaignResult, fly_campaign, resume_campaign
    from rise_di.flight_env import FlightEnv, FlightVectorEnv
    from rise_di.own_airframe import NewAirframe, new_airframe
    from rise_di.own_loop import Loop, as_control, fly_plant
    from rise_di_controller.control_law import ControlLaw, Measurements, TunedLaw, without_limits
    from rise_di_controller.controller import Controller
    from rise_di_controller.decomposition import decompose
    from rise_di_controller.law import LawParams, LawState, Sign, engage, step
    from rise_di_controller.laws import names as laws
    from rise_di_controller.laws import schema as law_schema
    from rise_di_controller.params import ControllerConfig
    from rise_di_controller.rise_di_config import RiseDiConfig
    from rise_di_controller.saturation import Limits, limited_integral, saturate

    __version__: str
else:  # type checkers would take a module with __getattr__ to have any name
    HOMES = {
        "aircraft_sim.airframe": ("Airframe", "airframes", "load_airframe"),
        "flight_analysis.closed_loop.loop_margins": ("LoopMargins", "margins"),
        "flight_analysis.closed_loop.replay": ("ReplayResult", "recorded_scenario", "replay"),
        "flight_analysis.closed_loop.scenario": ("Scenario", "scenario_yaml"),
        "flight_analysis.closed_loop.simulate": ("simulate",),
        "flight_design.gains.airframe_properties": ("airframe_facts",),
        "flight_design.gains.gain_selection": ("GainAssessment", "Selection"),
        "flight_design.gains.gain_yaml": ("as_yaml as gains_yaml",),
        "flight_analysis.metrics": ("error_metrics",),
        "flight_analysis.report.account": ("best_error_over as best_error",),
        "flight_analysis.report.data_frame": ("data_frame",),
        "flight_analysis.report.report": ("Report", "report"),
        "flight_analysis.report.run_folder": ("FlightResult", "read_accounted as read_run"),
        "flight_analysis.report.summary": ("RecordedFlight", "summarise"),
        "flight_bringup.fly": ("fly_and_report as fly",),
        "flight_analysis.closed_loop.scenario_library": ("find_scenario", "scenarios"),
        "flight_core.fields": ("Field",),
        "flight_core.parameters": ("NonNegatives", "ParameterError", "Positives", "require_length"),
        "flight_core.tape": ("Signal", "Tape"),
        "flight_core.vectors": ("Array", "StampedVector", "array_namespace"),
        "flight_log.tape_reader": ("RecordedRun",),
        "rise_di.c_code": ("Exported", "export"),
        "rise_di.campaigns": ("CampaignResult", "fly_campaign", "resume_campaign"),
        "rise_di.flight_env": ("FlightEnv", "FlightVectorEnv"),
        "flight_design.gains.gain_design": ("check_gains", "select_gains"),
        "flight_design.learning.scenario_learner": ("learner",),
        "rise_di.own_airframe": ("NewAirframe", "new_airframe"),
        "rise_di.own_loop": ("Loop", "as_control", "fly_plant"),
        "rise_di_controller.control_law": (
            "ControlLaw",
            "Measurements",
            "TunedLaw",
            "without_limits",
        ),
        "rise_di_controller.controller": ("Controller",),
        "rise_di_controller.decomposition": ("decompose",),
        "rise_di_controller.law": ("LawParams", "LawState", "Sign", "engage", "step"),
        "rise_di_controller.laws": ("names as laws", "schema as law_schema"),
        "rise_di_controller.params": ("ControllerConfig",),
        "rise_di_controller.rise_di_config": ("RiseDiConfig",),
        "rise_di_controller.saturation": ("Limits", "limited_integral", "saturate"),
    }
    """The names by the module that holds each, as an import statement has them."""

    _HOME: dict[str, tuple[str, str]] = {}
    for _module, _names in HOMES.items():
        _HOME |= {name.split(" as ")[-1]: (_module, name.split(" as ")[0]) for name in _names}

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
