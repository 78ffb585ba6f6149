# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
# The names of the interface with their modules. Type checkers read them here, and __init__.py
# loads them from here.

from aircraft_sim.airframes.airframe import Airframe, airframes, load_airframe
from flight_analysis.closed_loop.replay import ReplayResult, recorded_scenario, replay
from flight_analysis.closed_loop.scenario import Scenario, scenario_yaml
from flight_analysis.closed_loop.scenario_library import find_scenario, scenarios
from flight_analysis.linear_loop.loop_margins import LoopMargins, margins
from flight_analysis.metrics.errors import error_metrics
from flight_analysis.report.account import best_error_over as best_error
from flight_analysis.report.data_frame import data_frame
from flight_analysis.report.recorded_flight import read_accounted as read_run
from flight_analysis.report.report import Report, report
from flight_analysis.report.run_report import FlightResult
from flight_analysis.report.summary import RecordedFlight, summarise
from flight_bringup.fly import fly_and_report as fly
from flight_core.fields import Field
from flight_core.parameters import NonNegatives, ParameterError, Positives, require_length
from flight_core.tape import Signal, Tape
from flight_core.vectors import Array, StampedVector, array_namespace
from flight_design.gains.airframe_properties import airframe_facts
from flight_design.gains.gain_design import check_gains, select_gains
from flight_design.gains.gain_selection import GainAssessment, Selection
from flight_design.gains.gain_yaml import selection_yaml as gains_yaml
from flight_design.learning.scenario_learner import learner
from flight_log.tape_reader import RecordedRun
from rise_di.c_code import Exported, export
from rise_di.campaigns import CampaignResult, fly_campaign, resume_campaign
from rise_di.flight_env import FlightEnv, FlightVectorEnv
from rise_di.in_memory import simulate
from rise_di.own_airframe import NewAirframe, new_airframe
from rise_di.own_loop import Loop, as_control, fly_plant
from rise_di.state_spaces import LinearSystems, linear_systems
from rise_di_controller.controller import Controller
from rise_di_controller.law.control_law import ControlLaw, Measurements, TunedLaw, without_limits
from rise_di_controller.law.decomposition import decompose
from rise_di_controller.law.law import LawParams, LawState, Sign, engage, step
from rise_di_controller.law.saturation import Limits, limited_integral, saturate
from rise_di_controller.laws import names as laws
from rise_di_controller.laws import schema as law_schema
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig

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
    "LinearSystems",
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
    "linear_systems",
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

__version__: str
