# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Measure when the probe of the inputs finds each stuck surface of ArduPlane over MAVLink.

False alarms are counted too.
"""

import math
import time
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from benchmarks.autopilot_flights import EXAMPLE, FOLDER, flying, on_the_ground

from flight_core.rates import NANOSECONDS, seconds
from flight_log.tape_reader import read_run

if TYPE_CHECKING:
    from tests.sitl.kit import ArduPlane

SERVOS = {"elevator": 2, "aileron": 1, "rudder": 4}
REPEATS = 3
HEALTHY_FOR = 15.0  # time engaged before a surface sticks, s: two windows of the probe
LONGEST = 30.0  # time within which the probe has to find a stuck surface, s
QUIET = 600.0  # time engaged without a fault in each of KINDS, s
TURN = 45.0  # time from one turn under guidance to the next, s
SPEED = 23.9  # airspeed that guidance holds, m/s
KINDS = {"calm": (0.0, 0.0, False), "guided": (0.0, 0.0, True), "wind": (8.0, 0.5, True)}
"""Flights without a fault: SIM_WIND_SPD, SIM_WIND_TURB, and whether guidance turns and climbs; if
not, guidance holds."""


def probe() -> dict[str, Any]:
    """Let each surface stick in level flight in calm air, then fly all KINDS without a fault."""
    from tests.sitl.kit import OVERRIDE_TIME, ArduPlane  # noqa: PLC0415 - after the kit's place is known

    plane = ArduPlane(FOLDER / "probe")
    with flying(plane, SIM_SERVO_SPEED=0.03, RC_OVERRIDE_TIME=OVERRIDE_TIME):
        channel_map = plane.mavlink_map()
        times = {
            f"{surface} {number}": stuck(plane, channel_map, surface)
            for surface, number in product(SERVOS, range(1, REPEATS + 1))
        }
        quiet = {name: unfailed(plane, channel_map, name) for name in KINDS}
    return {"stuck": times, "quiet": quiet}


def probed(plane: "ArduPlane", program: Mapping[str, Any]) -> Path:
    """Write the scenario of the example with a probe, under guidance; return its file.

    Guidance follows the program, or holds if the program is empty.
    """
    from tests.sitl.kit import guided_scenario  # noqa: PLC0415 - as above

    content = yaml.safe_load(guided_scenario(EXAMPLE, program, SPEED))
    content["/**/controller"]["ros__parameters"]["probe"] = {"window": 6.0}
    if not program:
        del content["/**/guidance"]["ros__parameters"]["program"]
    scenario = plane.folder / "probed.yaml"
    scenario.write_text(yaml.safe_dump(content))
    return scenario


def stuck(plane: "ArduPlane", channel_map: str, surface: str) -> float:
    """Let a surface stick; return the time until the controller releases because of it, s.

    The time is infinite if a release has another reason, or if there is no release.
    """
    number = SERVOS[surface]
    ends = {f"SERVO{number}_MIN": -1.0, f"SERVO{number}_MAX": 1.0, f"SERVO{number}_TRIM": 0.0}
    healthy = dict(zip(ends, (1100.0, 1900.0, 1500.0), strict=True))
    with plane.engaged(probed(plane, {}), channel_map, 200.0) as flight:
        time.sleep(HEALTHY_FOR)
        plane.state()  # writes the log
        pulses = plane.log("SERVO_OUTPUT_RAW", f"servo{number}_raw")[1]
        pulse = round(float(np.mean(pulses[-50:])))
        began = time.time()
        for name, shift in ends.items():
            plane.say("param", name, f"{pulse + shift:g}")
        while time.time() - began < LONGEST and not flight.has_logged("RELEASE"):
            time.sleep(0.1)
        for name, value in healthy.items():
            plane.say("param", name, f"{value:g}")
    (engagement,) = read_run(plane.run).engagements or []
    if engagement.stop_ns is None or not engagement.reason.startswith(f"{surface} does not answer"):
        return math.inf
    return engagement.stop_ns / NANOSECONDS - began


def unfailed(plane: "ArduPlane", channel_map: str, name: str) -> dict[str, Any]:
    """Fly one of KINDS without a fault, and return its figures.

    They are the seconds engaged, the false alarms, the number of tests of the probe, the least
    effect of each surface in any test, and whether the flight replays.
    """
    speed, turbulence, turns = KINDS[name]
    plane.say("param", "SIM_WIND_SPD", f"{speed:g}")
    plane.say("param", "SIM_WIND_TURB", f"{turbulence:g}")
    plane.level()
    starts = np.arange(15.0, QUIET, TURN).tolist()
    altitude = plane.state()["alt"] - plane.home
    program = plane.turns(starts, altitude, SPEED) if turns else {}
    with plane.engaged(probed(plane, program), channel_map, QUIET) as flight:
        flight.end(QUIET + 100.0)
    log = read_run(plane.run)
    (engagement,) = log.engagements or []
    effects = log.tape["effects"]
    stop_ns = engagement.stop_ns or int(effects.stamp_ns[-1])
    return {
        "seconds": seconds(stop_ns - engagement.start_ns),
        "reason": engagement.reason,
        "false alarms": int("probe" in engagement.reason),
        "tests": len(effects.stamp_ns),
        "least effect": {surface: float(effects[surface].min()) for surface in SERVOS},
        "replayed": on_the_ground("replay", str(plane.run)).returncode == 0,
    }
