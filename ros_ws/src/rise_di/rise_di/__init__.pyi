# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
# The names of the interface, each with its module: type checkers read them here, and __init__.py loads them from here.

from aircraft_sim.airframe import (
    Airframe as Airframe,
    airframes as airframes,
    load_airframe as load_airframe,
)
from flight_analysis.closed_loop.loop_margins import LoopMargins as LoopMargins, margins as margins
from flight_analysis.closed_loop.replay import (
    ReplayResult as ReplayResult,
    recorded_scenario as recorded_scenario,
    replay as replay,
)
from flight_analysis.closed_loop.scenario import (
    Scenario as Scenario,
    scenario_yaml as scenario_yaml,
)
from flight_analysis.closed_loop.scenario_library import (
    find_scenario as find_scenario,
    scenarios as scenarios,
)
from flight_analysis.closed_loop.simulate import simulate as simulate
from flight_analysis.metrics import error_metrics as error_metrics
from flight_analysis.report.account import best_error_over as best_error
from flight_analysis.report.data_frame import data_frame as data_frame
from flight_analysis.report.report import Report as Report, report as report
from flight_analysis.report.run_folder import FlightResult as FlightResult
from flight_analysis.report.run_folder import read_accounted as read_run
from flight_analysis.report.summary import RecordedFlight as RecordedFlight, summarise as summarise
from flight_bringup.fly import fly_and_report as fly
from flight_core.fields import Field as Field
from flight_core.parameters import (
    NonNegatives as NonNegatives,
    ParameterError as ParameterError,
    Positives as Positives,
    require_length as require_length,
)
from flight_core.tape import Signal as Signal, Tape as Tape
from flight_core.vectors import (
    Array as Array,
    StampedVector as StampedVector,
    array_namespace as array_namespace,
)
from flight_design.gains.airframe_properties import airframe_facts as airframe_facts
from flight_design.gains.gain_design import check_gains as check_gains, select_gains as select_gains
from flight_design.gains.gain_selection import (
    GainAssessment as GainAssessment,
    Selection as Selection,
)
from flight_design.gains.gain_yaml import as_yaml as gains_yaml
from flight_design.learning.scenario_learner import learner as learner
from flight_log.tape_reader import RecordedRun as RecordedRun
from rise_di.c_code import Exported as Exported, export as export
from rise_di.campaigns import (
    CampaignResult as CampaignResult,
    fly_campaign as fly_campaign,
    resume_campaign as resume_campaign,
)
from rise_di.flight_env import FlightEnv as FlightEnv, FlightVectorEnv as FlightVectorEnv
from rise_di.own_airframe import NewAirframe as NewAirframe, new_airframe as new_airframe
from rise_di.own_loop import Loop as Loop, as_control as as_control, fly_plant as fly_plant
from rise_di_controller.control_law import (
    ControlLaw as ControlLaw,
    Measurements as Measurements,
    TunedLaw as TunedLaw,
    without_limits as without_limits,
)
from rise_di_controller.controller import Controller as Controller
from rise_di_controller.decomposition import decompose as decompose
from rise_di_controller.law import (
    LawParams as LawParams,
    LawState as LawState,
    Sign as Sign,
    engage as engage,
    step as step,
)
from rise_di_controller.laws import names as laws
from rise_di_controller.laws import schema as law_schema
from rise_di_controller.params import ControllerConfig as ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig as RiseDiConfig
from rise_di_controller.saturation import (
    Limits as Limits,
    limited_integral as limited_integral,
    saturate as saturate,
)

__version__: str
