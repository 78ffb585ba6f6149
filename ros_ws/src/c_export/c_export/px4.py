# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The controller of body rates as an external module of PX4: the exported C code, and files of
source/px4 around it.
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

AXES: Mapping[str, int] = MappingProxyType({"p": 0, "q": 1, "r": 2})
"""Channels of y and their axes of PX4: roll, pitch, yaw."""

MODULE = "src/modules/rise_di_control"
SAMPLES = 8  # kept: y_m is stepped past each y, so a tick needs the newest y and two of y_m
SLOWEST, FASTEST = 0.6, 1.6  # of the trim speed: where the dynamic pressure is clipped

FILES = {
    "src/CMakeLists.txt": "set(config_module_list_external modules/rise_di_control PARENT_SCOPE)\n",
    "msg/CMakeLists.txt": "set(config_msg_list_external RiseDiStatus.msg PARENT_SCOPE)\n",
    "extras.txt": "fw_rate_control stop\nfw_rate_control start vtol\nrise_di_control start\n",
}
"""Texts that are equal for every scenario."""

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
    controller = exportable(scenario.controller)
    outputs = controller.outputs
    expected = "some of p, q, r: PX4 controls the speed"
    require(set(outputs) <= set(AXES), "controller.outputs", ", ".join(outputs), expected)
    require(
        controller.allocation is None,
        "controller.allocation",
        "a section",
        "none: PX4 allocates the torque",
    )
    module = folder / MODULE
    files = write_code(
        controller,
        scenario.name,
        module,
        scenario.reference_model,
        float32=float32,
        samples=samples,
    )
    message = MESSAGE.format(channels=", ".join(outputs), m=len(outputs))
    texts = {
        **FILES,
        "msg/RiseDiStatus.msg": message,
        f"{MODULE}/rise_di_px4.h": _map(scenario, "F" if float32 else ""),
    }
    with writing("px4", folder, "a folder that can"):
        for source in sorted((SOURCE / "px4").iterdir()):
            files.append(Path(shutil.copyfile(source, module / source.name)))
        for name, text in texts.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            write_file(folder / name, text)
    return [*files, *(folder / name for name in texts)]


def _map(scenario: Scenario, suffix: str) -> str:
    """The text of rise_di_px4.h: axes, torque of a unit of u, and the speed at which it holds."""
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
            "/* Axes, signs and sizes of PX4 for the channels of the scenario, written by `rise-di "
            "export`. */"
        ),
        "#ifndef RISE_DI_PX4_H",
        "#define RISE_DI_PX4_H",
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
        "#endif",
    ]
    return "\n".join(lines) + "\n"
