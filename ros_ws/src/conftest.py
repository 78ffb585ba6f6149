# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The tests of each package in tests/, for `colcon test`, which runs pytest in the folder of a package."""

from pathlib import Path

import pytest

SOURCES = Path(__file__).resolve().parent
TESTS = SOURCES.parents[1] / "tests"

MODULES = {
    "flight_core": "pure: authentication fields file_writing parameters publisher_lock scheduling text vectors",
    "flight_log": "pure: bag follow full_disk log_contents playback recorded_before repair",
    "flight_ros": "pure: lockstep_inputs ticker; ros: fuzz_messages health messages rclpy_private security",
    "reference_model": "pure: live_commands reference_model; ros: live_commands",
    "flight_guidance": "pure: feasibility guidance guided_flight route_file; ros: guidance",
    "rise_di_controller": "pure: any_plant decomposition engagement feedforward guard law paper_identities saturation schedule"
    " signs; ros: controller",
    "aircraft_sim": "pure: actuators aircraft airframe_library disturbance faults_in_flight jsbsim pose sensors turbulence"
    " uncertainty; ros: aircraft",
    "autopilot_bridge": "pure: autopilot_examples bridge channel_map; ros: bridge published_messages",
    "flight_recorder": "ros: recorder killed_recorder",
    "control_laws": "pure: excitation laws observer_design rival_laws; ros: laws",
    "flight_analysis": "pure: bridge_identification check_signs export gains guided_report identification layouts lyapunov"
    " margins metrics model_identification observer_selection observer_theory replay report report_page response_identification"
    " servo_world simulate; ros: replay",
    "flight_campaign": "pure: campaign compare fleet",
    "flight_bringup": "pure: launch_files; ros: flight real_time_flight lockstep node_state nodes own_aircraft policy"
    " faults/faults faults/lockstep_faults",
    "flight_view": "pure: view view_control view_foxglove view_page; ros: control",
    "rise_di": "pure: rise_di",
    "flight_cli": "pure: cli report_command; ros: play; fuzz: fuzz_command_line",
}
"""Packages with the modules of their tests by folder: "ros: recorder" is tests/ros/test_recorder.py."""

WHOLE_TREE = (
    "pure: containers docs evidence guidance_benchmark host_delays import_rule packages symbols;"
    " ros: message_packages; docs: commands pages; fuzz: fuzz_files fuzz_regressions"
)
"""Modules that test pages, tools, measuring programs or the packages together; `make test` runs them."""


def files(modules: str) -> list[Path]:
    """The files of modules by folder."""
    listed = (part.split(":") for part in modules.split(";"))
    paths = ((TESTS / folder.strip() / name) for folder, names in listed for name in names.split())
    return [path.with_name(f"test_{path.name}.py") for path in paths]


def pytest_configure(config: pytest.Config) -> None:
    """Run the tests of the package whose folder pytest was started in."""
    modules = MODULES.get(config.invocation_params.dir.name)
    if modules is not None and config.args_source is config.ArgsSource.INVOCATION_DIR:
        config.args = [str(path) for path in files(modules)]
