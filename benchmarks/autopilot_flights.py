# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Start autopilots in software, let the stack fly them, and take the figures of a flight."""

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flight_core.rates import NANOSECONDS
from flight_core.tape import Tape
from flight_log.engagements import Engagement
from flight_log.tape_reader import read_run

if TYPE_CHECKING:
    from tests.sitl.kit import ArduPlane, Autopilot, Px4

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDER = REPOSITORY / "build" / "autopilots"
EXAMPLE = REPOSITORY / "examples" / "arduplane" / "scenario.yaml"
DELAYS = np.arange(0.0, 1.0, 0.01)  # delays of y behind y_m that `behind` tries, s


@contextmanager
def arduplane(servo: float, place: Path = FOLDER / "arduplane") -> Iterator["ArduPlane"]:
    """Yield an ArduPlane in flight.

    `servo` is its parameter SIM_SERVO_SPEED, and `place` the folder of its files.
    """
    from tests.sitl.kit import ArduPlane  # noqa: PLC0415 - after the kit's place is known

    with flying(ArduPlane(place), SIM_SERVO_SPEED=servo) as plane:
        yield plane


@contextmanager
def px4() -> Iterator["Px4"]:
    """Start PX4's airplane in flight; without an offboard heartbeat it changes to Hold."""
    from tests.sitl.kit import Px4  # noqa: PLC0415 - as above

    with flying(Px4(FOLDER / "px4"), COM_RCL_EXCEPT=7.0, COM_OBL_RC_ACT=5.0) as airplane:
        yield airplane


@contextmanager
def flying(autopilot: Any, **parameters: float) -> Iterator[Any]:
    """Start an autopilot with these parameters, take off, and yield it; stop it at the end."""
    try:
        autopilot.up(**parameters)
        autopilot.take_off()
        yield autopilot
    finally:
        autopilot.down()


def on_the_ground(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command of rise-di without an autopilot."""
    command = (sys.executable, "-m", "flight_cli.cli", *arguments)
    return subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - its own arguments


def tracking(autopilot: "Autopilot") -> dict[str, Any]:
    """Return the figures of the last flight.

    They are its engagements, its outcome, the rms errors while y_m is commanded, the delay of y
    behind y_m, the part of the time with u at a limit, and whether the flight replays.
    """
    summary = autopilot.summary()
    log = read_run(autopilot.run)
    replayed = on_the_ground("replay", str(autopilot.run)).returncode == 0
    return {
        "engaged": summary["engagements"],
        "outcome": summary["outcome"]["sentence"],
        "rms": {name: error["command"]["rms"] for name, error in summary["errors"].items()},
        "behind": {
            name: behind(log.tape, name, span)
            for span in log.engagements or []
            for name in log.tape["y"].names
        },
        "limited": {
            name: values["limited"]["magnitude"] for name, values in summary["inputs"].items()
        },
        "replayed": replayed,
    }


def behind(tape: Tape, name: str, engaged: Engagement) -> float:
    """Return the delay of y behind y_m in an engagement, s.

    It is the one of DELAYS by which y_m has to be late so that y - y_m has the smallest variance.
    The first second of the engagement does not count.
    """
    y = tape["y"]
    y_m = tape["y_m"]
    t = np.arange(
        engaged.start_ns + NANOSECONDS, engaged.stop_ns or int(y.stamp_ns[-1]), NANOSECONDS // 100
    )
    y_at_ticks = np.interp(t, y.stamp_ns, y[name])
    errors = [
        float(np.var(y_at_ticks - np.interp(t - delay * NANOSECONDS, y_m.stamp_ns, y_m[name])))
        for delay in DELAYS
    ]
    return float(DELAYS[int(np.argmin(errors))])


def stored(name: str) -> dict[str, Any]:
    """Return the stored result of a measurement; it is empty if there is none."""
    file = FOLDER / f"{name}.json"
    return dict(json.loads(file.read_text())["result"]) if file.is_file() else {}
