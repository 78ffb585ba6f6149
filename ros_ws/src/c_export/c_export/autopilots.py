# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The controller of body rates inside an autopilot: the exported C code, source/rates that decides
which controller flies, and the autopilot's shell, source/px4 or source/ardupilot.
"""

import shutil
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from c_export.constants import exportable
from c_export.proof import SOURCE, write_code
from flight_analysis.closed_loop.scenario import Scenario
from flight_core.files import write_file, writing
from flight_core.parameters import require
from rise_di_controller.params import ControllerConfig

AXES: Mapping[str, int] = MappingProxyType({"p": 0, "q": 1, "r": 2})
"""Channels of y and the axes of autopilots: roll, pitch, yaw."""

MODULE = "src/modules/rise_di_control"
VEHICLE = "ArduPlane"
SAMPLES = 8  # kept: y_m is stepped past each y, so a tick needs the newest y and two of y_m
SLOWEST, FASTEST = 0.6, 1.6  # of the trim speed: where the dynamic pressure is clipped

FILES = {
    "src/CMakeLists.txt": "set(config_module_list_external modules/rise_di_control PARENT_SCOPE)\n",
    "msg/CMakeLists.txt": "set(config_msg_list_external RiseDiStatus.msg PARENT_SCOPE)\n",
    "extras.txt": "fw_rate_control stop\nfw_rate_control start vtol\nrise_di_control start\n",
}
"""Texts of PX4 that are equal for every scenario."""

HOOKS = """ArduPlane/Plane.h, in class Plane, beside void stabilize();
    void rise_di();
ArduPlane/Plane.cpp, in scheduler_tasks, behind FAST_TASK(stabilize),
    FAST_TASK(rise_di),
"""
"""The two lines that ArduPlane needs beside the files."""

MESSAGE = """# Rate controller of RISE-DI: a cycle, in the order {channels}
uint8 ORB_QUEUE_LENGTH = 16  # the logger misses no tick
uint64 timestamp         # [us]
uint64 timestamp_sample  # [us] of y
uint64 parameters        # digest of the scenario's
uint32 number            # of the ticks since the law engaged
uint8 mode               # rise_di_mode
uint8 refusal            # rise_di_refusal; 0: RISE-DI flies
float64[{m}] y           # [rad/s] that the law took; else the rates
float64[{m}] y_m         # [rad/s] at the instant of y
float64[{m}] e           # [rad/s] y - y_m
float64[{m}] u           # units of the input
float64[{m}] u_end       # abs(u) of the torque of 1 at this airspeed
float64 y_m_offset       # [s] of the newest y_m after y
"""


def write_px4(
    scenario: Scenario, folder: Path, *, float32: bool, samples: int = SAMPLES
) -> list[Path]:
    """Write the module to a folder, for `make px4_sitl EXTERNAL_MODULES_LOCATION=FOLDER`. Raises
    ParameterError.

    The outputs are body rates; an input of u at the upper end stop of its actuator is a torque of
    1, with the sign of D.
    """
    outputs = scenario.controller.outputs
    files = _write(
        scenario, folder, MODULE, "px4", AXES, "PX4 controls the speed",
        float32=float32, samples=samples,
    )  # fmt: skip
    message = MESSAGE.format(channels=", ".join(outputs), m=len(outputs))
    return [*files, *_texts({**FILES, "msg/RiseDiStatus.msg": message}, folder)]


def write_ardupilot(
    scenario: Scenario, folder: Path, *, float32: bool, samples: int = SAMPLES
) -> list[Path]:
    """Write the files of a fast task of ArduPlane to a folder, for its tree; hooks.txt has two
    lines of it. Raises ParameterError.

    The outputs are q, p or both; an input of u at the upper end stop is a deflection of 45 degrees.
    """
    axes = {name: axis for name, axis in AXES.items() if name != "r"}
    files = _write(
        scenario, folder, VEHICLE, "ardupilot", axes,
        "ArduPlane controls the speed and coordinates turns by the rudder",
        float32=float32, samples=samples,
    )  # fmt: skip
    return [*files, *_texts({"hooks.txt": HOOKS}, folder)]


def _write(
    scenario: Scenario,
    folder: Path,
    place: str,
    shell: str,
    axes: Mapping[str, int],
    reason: str,
    *,
    float32: bool,
    samples: int,
) -> list[Path]:
    """Write code, source/rates and a shell to `place` in a folder, for outputs among `axes`."""
    controller = exportable(scenario.controller)
    outputs = controller.outputs
    expected = f"some of {', '.join(sorted(axes))}: {reason}"
    require(set(outputs) <= set(axes), "controller.outputs", ", ".join(outputs), expected)
    require(
        controller.allocation is None,
        "controller.allocation",
        "a section",
        "none: the autopilot allocates the torque",
    )
    code = folder / place
    model = scenario.reference_model
    files = write_code(controller, scenario.name, code, model, float32=float32, samples=samples)
    with writing(shell, folder, "a folder that can"):
        for part in ("rates", shell):
            for source in sorted((SOURCE / part).iterdir()):
                files.append(Path(shutil.copyfile(source, code / source.name)))
    return [*files, *_texts({"rise_di_axes.h": _axes(scenario, "F" if float32 else "")}, code)]


def _texts(texts: Mapping[str, str], folder: Path) -> list[Path]:
    """Write texts by their names to a folder."""
    with writing("export", folder, "a folder that can"):
        for name, text in texts.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_file(folder / name, text)
    return [folder / name for name in texts]


def _axes(scenario: Scenario, suffix: str) -> str:
    """The text of rise_di_axes.h: axes, torque of a unit of u, and the speed at which it holds."""
    controller = scenario.controller
    channels = scenario.aircraft.channels()
    upper = dict(zip(channels.inputs, scenario.aircraft.actuators.upper or (), strict=False))
    per_u = []
    for name, sign in zip(controller.inputs, exportable(controller).D, strict=True):
        end = upper.get(name) or 0.0
        require(
            end > 0.0, "aircraft.actuators.upper", f"no end stop of {name}", "that of the torque 1"
        )
        per_u.append(f"{float(sign / end).hex()}{suffix}")
    speed = channels.speed
    lines = [
        (
            "/* Axes, signs and sizes of the autopilot for the channels of the scenario, written "
            "by `rise-di export`. */"
        ),
        "#ifndef RISE_DI_AXES_H",
        "#define RISE_DI_AXES_H",
        (
            f"#define RISE_DI_AXES {{{', '.join(str(AXES[name]) for name in controller.outputs)}}} "
            "/* roll 0, pitch 1, yaw 2 */"
        ),
        f"#define RISE_DI_TORQUE_PER_U {{{', '.join(per_u)}}}",
        (
            f"#define RISE_DI_SCALED {int(speed > 0.0)} /* 1: the torque follows the dynamic "
            "pressure */"
        ),
        f"#define RISE_DI_SPEED ((rise_di_real){speed!r}) /* m/s */",
        f"#define RISE_DI_SLOWEST {SLOWEST * speed!r}F",
        f"#define RISE_DI_FASTEST {FASTEST * speed!r}F",
        *_observer_limits(controller, suffix),
        "#endif",
    ]
    return "\n".join(lines) + "\n"


def _observer_limits(controller: ControllerConfig, suffix: str) -> list[str]:
    """The limits of u_o in those of u: the part of their magnitude, and its change in a second."""
    observer = exportable(controller).observer
    if observer is None:
        return []
    slew = observer.part / observer.within
    return [
        f"#define RISE_DI_OBSERVER_PART ((rise_di_real){observer.part.hex()}{suffix})",
        f"#define RISE_DI_OBSERVER_SLEW ((rise_di_real){slew.hex()}{suffix}) /* 1/s */",
    ]
