# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write a module that lets the exported controller fly body rates inside an autopilot.

The module has three parts. The first is the exported C code. The second, source/rates, decides
whether this controller or the autopilot's own one flies. The third, source/px4 or source/ardupilot,
connects the code to the autopilot, and is called the shell.
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from c_export.constants import exportable
from c_export.proof import SOURCE, write_code
from flight_analysis.closed_loop.scenario import Scenario
from flight_core.files import write_file, writing
from flight_core.parameters import require
from rise_di_controller.extensions.schedule import TORQUE_SPEEDS

AXES: Mapping[str, int] = MappingProxyType({"p": 0, "q": 1, "r": 2})
"""Channels of y, with the number of the axis in autopilots: roll, pitch, yaw."""

# Number of samples of y, and of y_m, that the code keeps. Before it takes a y, the module steps the
# reference model up to the instant of this y or past it. So a tick needs only the newest y and two
# samples of y_m.
SAMPLES = 8

HOOKS = """ArduPlane/Plane.h, in class Plane, beside void stabilize();
    void rise_di();
ArduPlane/Plane.cpp, in scheduler_tasks, behind FAST_TASK(stabilize),
    FAST_TASK(rise_di),
"""
"""The two lines that must be added to files of ArduPlane."""

MESSAGE = """# A cycle of the rate controller of RISE-DI. The arrays have the channels {channels}.
uint8 ORB_QUEUE_LENGTH = 16  # the logger misses no tick
uint64 timestamp         # [us]
uint64 timestamp_sample  # [us] instant of y
uint64 parameters        # digest of the controller's parameters in the scenario
uint32 number            # number of the tick since the law engaged
uint8 mode               # rise_di_mode
uint8 refusal            # rise_di_refusal; 0 if RISE-DI flies
float64[{m}] y           # [rad/s] y that the law took; the rates if RISE-DI does not fly
float64[{m}] y_m         # [rad/s] y_m at the instant of y
float64[{m}] e           # [rad/s] y - y_m
float64[{m}] u           # u in the units of the input
float64[{m}] u_end       # abs(u) at which the torque is 1 at this airspeed
float64 y_m_offset       # [s] instant of the newest y_m minus instant of y
float32 rate             # [Hz] measured rate of the samples; 0 if it is not measured yet
"""

TOPICS = """rise_di_status
vehicle_angular_velocity
vehicle_torque_setpoint
vehicle_thrust_setpoint
vehicle_rates_setpoint
airspeed_validated 100
actuator_armed
actuator_motors 100
actuator_outputs 100
actuator_servos 100
airspeed 1000
battery_status 200
control_allocator_status 200
cpuload
differential_pressure 1000
distance_sensor 1000
esc_status 250
estimator_innovation_test_ratios 500
estimator_sensor_bias 1000
estimator_status 200
estimator_status_flags 500
failsafe_flags
failure_detector_status 100
home_position
input_rc 500
manual_control_setpoint 200
manual_control_switches
mission_result
navigator_status
offboard_control_mode 100
parameter_update
position_controller_status 500
position_setpoint_triplet 200
rate_ctrl_status 200
rtl_time_estimate 1000
sensor_baro 1000
sensor_combined
sensor_gps 1000
sensor_mag 1000
sensor_selection
sensors_status_imu 200
system_power 500
tecs_status 200
telemetry_status 1000
trajectory_setpoint 200
vehicle_acceleration 50
vehicle_air_data 200
vehicle_attitude 50
vehicle_attitude_setpoint 50
vehicle_command
vehicle_command_ack
vehicle_control_mode
vehicle_global_position 200
vehicle_imu 500
vehicle_imu_status 1000
vehicle_land_detected
vehicle_local_position 100
vehicle_local_position_setpoint 100
vehicle_magnetometer 200
vehicle_status
wind 1000
"""
"""Topics that PX4 logs instead of its default topics, with the least interval in ms, if any. The
topics of the module and of `tune` come first. The default topics of PX4 1.16 (logged_topics.cpp)
follow, because the log would lack them otherwise."""

PX4 = {
    "logger_topics.txt": TOPICS,
    "src/CMakeLists.txt": "set(config_module_list_external modules/rise_di_control PARENT_SCOPE)\n",
    "msg/CMakeLists.txt": "set(config_msg_list_external RiseDiStatus.msg PARENT_SCOPE)\n",
    "extras.txt": "fw_rate_control stop\nfw_rate_control start vtol\nrise_di_control start\n",
    "msg/RiseDiStatus.msg": MESSAGE,
}

PX4_MULTICOPTER: Mapping[str, str] = MappingProxyType(
    {"fw_rate_control": "mc_rate_control", "virtual_fw": "virtual_mc"}
)
"""Module and topics of PX4 for a multicopter, which replace those for a fixed wing."""
TORQUES = {"roll", "pitch", "yaw"}  # inputs of a multicopter


HEADER = """/* Axes, signs and sizes of the autopilot for the channels of the scenario, written by `rise-di export`. */
#ifndef RISE_DI_AXES_H
#define RISE_DI_AXES_H
#define RISE_DI_AXES {{{axes}}} /* roll 0, pitch 1, yaw 2 */
#define RISE_DI_TORQUE_PER_U {{{per_u}}}
#define RISE_DI_SCALED {scaled} /* 1: the torque follows the dynamic pressure */
#define RISE_DI_SPEED ((rise_di_real){speed!r}) /* m/s */
#define RISE_DI_SLOWEST {slowest!r}F
#define RISE_DI_FASTEST {fastest!r}F
#define RISE_DI_OBSERVER_PART {part} /* limits of u_o as a fraction of the limits of u */
#define RISE_DI_OBSERVER_SLEW {slew} /* 1/s, largest rate of u_o as a fraction of the limits of u */
#endif
"""  # noqa: E501 - a text as it is written


class Shell(NamedTuple):
    """The code that connects a controller to an autopilot. Its files are in source/NAME."""

    place: str  # place of the code in the folder
    axes: str  # outputs that the controller can have
    reason: str  # why it can have no other outputs
    texts: Mapping[str, str]  # further files by name; `{channels}` and `{m}` are filled in
    # words of the shell and their replacements for a multicopter; {} if it flies none
    multicopter: Mapping[str, str] = MappingProxyType({})


SHELLS = {
    "px4": Shell(
        "src/modules/rise_di_control", "pqr", "PX4 controls the speed", PX4, PX4_MULTICOPTER
    ),
    "ardupilot": Shell(
        "ArduPlane",
        "pq",
        "ArduPlane controls the speed and coordinates turns by the rudder",
        {"hooks.txt": HOOKS},
    ),
}


def write_module(
    autopilot: str,
    scenario: Scenario,
    folder: Path,
    *,
    float32: bool,
    samples: int = SAMPLES,
) -> list[Path]:
    """Write the module for an autopilot, with the exported controller inside, to a folder.

    For PX4 the folder is EXTERNAL_MODULES_LOCATION. For ArduPlane it has files for the source tree,
    and hooks.txt with two lines to add to the tree. Raises ParameterError if the scenario does not
    suit the autopilot, or if a file cannot be written.

    The outputs y are body rates. If u is at the upper end stop of its actuator, the autopilot gets
    a torque of 1 with the sign of D. In ArduPlane this torque is a deflection of 45 degrees. While
    the exported controller (RISE-DI) does not fly, PX4 flies by its fw_rate_control, or by
    mc_rate_control for a multicopter.
    """
    shell = SHELLS[autopilot]
    controller = exportable(scenario.controller)
    outputs = controller.outputs
    words = _words_of_vehicle(shell, scenario)
    expected = f"some of {', '.join(shell.axes)}: {shell.reason}"
    require(set(outputs) <= set(shell.axes), "controller.outputs", ", ".join(outputs), expected)
    require(
        controller.allocation is None,
        "controller.allocation",
        "a section",
        "none: the autopilot allocates the torque",
    )
    code = folder / shell.place
    model = scenario.reference_model
    files = write_code(controller, scenario.name, code, model, float32=float32, samples=samples)
    channels = {"channels": ", ".join(outputs), "m": len(outputs)}
    texts = {name: text.format(**channels) for name, text in shell.texts.items()}
    for part in ("rates", autopilot):
        for source in sorted((SOURCE / part).iterdir()):
            texts[f"{shell.place}/{source.name}"] = source.read_text("utf-8")
    texts[f"{shell.place}/rise_di_axes.h"] = _axes(scenario, "F" if float32 else "")
    with writing("export", folder):
        for name, text in texts.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_file(folder / name, _with_words(text, words))
    return [*files, *(folder / name for name in texts)]


def _words_of_vehicle(shell: Shell, scenario: Scenario) -> Mapping[str, str]:
    """Return the words of the shell that must be replaced for a multicopter, with the new words.

    The shell is the code that connects the controller to the autopilot. The result is {} for a
    fixed wing. A fixed wing has a trim speed. A multicopter has none, and its inputs are torques
    about the axes. Raises ParameterError if the aircraft is neither.
    """
    channels = scenario.aircraft.channels()
    has_torques = set(scenario.controller.inputs) <= TORQUES
    if channels.speed > 0.0 and not has_torques:
        return {}
    found = f"{channels.speed:g} m/s with the inputs {', '.join(scenario.controller.inputs)}"
    fixed_wing = "a trim speed with surfaces as inputs (fixed wing)"
    is_multicopter = channels.speed == 0.0 and has_torques
    require(
        is_multicopter and bool(shell.multicopter),
        "aircraft.airframe",
        found,
        f"{fixed_wing} or none with some of roll, pitch, yaw (multicopter)"
        if shell.multicopter
        else fixed_wing,
    )
    return shell.multicopter


def _with_words(text: str, words: Mapping[str, str]) -> str:
    """Replace each word that is a key of `words` in a text by the value of this key."""
    for word, replacement in words.items():
        text = text.replace(word, replacement)
    return text


def _axes(scenario: Scenario, suffix: str) -> str:
    """Return the text of rise_di_axes.h.

    The header has the axis of each output, the torque per unit of u, and the airspeed at which this
    torque holds.
    """
    controller = scenario.controller
    channels = scenario.aircraft.channels()
    upper = dict(zip(channels.inputs, scenario.aircraft.actuators.upper or (), strict=False))
    per_u = []
    for name, sign in zip(controller.inputs, exportable(controller).D, strict=True):
        end = upper.get(name) or 0.0
        require(
            end > 0.0,
            "aircraft.actuators.upper",
            f"no end stop of {name}",
            "the deflection at a torque of 1",
        )
        per_u.append(f"{float(sign / end)!r}{suffix}")
    speed = channels.speed
    slowest, fastest = TORQUE_SPEEDS
    observer = exportable(controller).observer
    part = 0.0 if observer is None else observer.part
    slew = 0.0 if observer is None else part / observer.within
    return HEADER.format(
        axes=", ".join(str(AXES[name]) for name in controller.outputs),
        per_u=", ".join(per_u),
        scaled=int(speed > 0.0),
        speed=speed,
        slowest=slowest * speed,
        fastest=fastest * speed,
        part=f"{part!r}{suffix}",
        slew=f"{slew!r}{suffix}",
    )
