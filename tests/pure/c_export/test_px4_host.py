# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the module RiseDiControl.cpp on a host, where tests/px4 has topics and parameters of PX4.

A flight lasts 8 s at 250 Hz, with RDI_EN 1 from 2 s on and with an event. The tests check what the
module publishes and tells.
"""

import re
import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

import pytest
from pytest import approx
from tests.conftest import REPOSITORY
from tests.pure.c_export.test_px4_export import quadrotor

from c_export.autopilots import SHELLS, write_module
from c_export.proof import FLAGS, build
from flight_analysis.closed_loop.scenario_library import find_scenario

pytestmark = pytest.mark.skipif(
    shutil.which("g++") is None, reason="no g++ on this machine, which compiles the module"
)
STUB = REPOSITORY / "tests" / "px4"
CYCLES = 2000
SANITIZED = ("-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


class Flown(NamedTuple):
    """What a flight published last, how often, and what it told."""

    published: int
    not_numbers: int
    thrust: float
    wanted: float
    torque: float
    told: list[tuple[float, str]]


def compiled(module: Path, host: str) -> None:
    """Compile the module with its host as the program `module`."""
    source = (module / "RiseDiControl.cpp").read_text("utf-8")
    for header in re.findall(r"#include <(.*)>", source):
        path = module / "px4" / header
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text('#include "px4.h"\n')
    (module / "host.cpp").write_text(host)
    flags = [flag for flag in FLAGS if not flag.startswith(("-std", "-O", "-pedantic"))]
    for name in ("rise_di", "rise_di_rates"):
        build(["gcc", "-std=c99", *flags, *SANITIZED, "-c", f"{name}.c"], module)
    build(
        [
            "g++",
            "-std=gnu++14",
            *flags,
            "-Wno-unused-parameter",
            *SANITIZED,
            "-Ipx4",
            f"-I{STUB}",
            "-o",
            "module",
            "RiseDiControl.cpp",
            "host.cpp",
            "rise_di.o",
            "rise_di_rates.o",
        ],
        module,
    )


@pytest.fixture(scope="module", params=["fixed wing", "multicopter"])
def program(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("host")
    scenario = find_scenario(str(REPOSITORY / "examples" / "px4_airplane" / "rates.yaml"))
    host = (STUB / "host.cpp").read_text("utf-8")
    if request.param == "multicopter":
        scenario = quadrotor(folder)
        host = re.sub(r"send\((\w+)_fw,", r"send(\1_mc,", host)
    write_module("px4", scenario, folder, float32=False)
    module = folder / SHELLS["px4"].place
    compiled(module, host)
    return module / "module"


def flown(program: Path, *words: str) -> Flown:
    """Run a flight with an event. A finding of a sanitizer ends it."""
    environment = {"ASAN_OPTIONS": "detect_leaks=0"}  # the module lives to the end, as in PX4
    done = subprocess.run(
        [str(program), *words],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
        env=environment,
    )
    assert done.returncode == 0, done.stderr
    told = re.findall(r"^told (\S+) (.*?)\s*$", done.stdout, re.MULTILINE)
    figures = re.search(
        r"published (\d+) (\d+) not_numbers (\d+) thrust (\S+) wanted (\S+) torque (\S+)",
        done.stdout,
    )
    assert figures is not None
    assert figures[1] == figures[2]  # torque and thrust go together
    return Flown(
        published=int(figures[1]),
        not_numbers=int(figures[3]),
        thrust=float(figures[4]),
        wanted=float(figures[5]),
        torque=float(figures[6]),
        told=[(float(instant), text) for instant, text in told],
    )


def texts(flight: Flown, word: str) -> list[float]:
    """Return the instants at which a text with a word was told."""
    return [instant for instant, text in flight.told if word in text]


def test_takes_over_and_hands_on_the_thrust(program: Path) -> None:
    flight = flown(program)
    assert texts(flight, "RISE-DI flies")[0] == approx(2.0, abs=0.01)
    assert flight.published == CYCLES
    assert flight.thrust == flight.wanted
    assert texts(flight, "late thrust") == []
    assert texts(flight, "refused while armed")


def test_hands_on_the_spare_in_the_cycle_of_its_rates(program: Path) -> None:
    """In SIH, a tenth of the torques of mc_rate_control came after the rates, a period late."""
    flight = flown(program, "behind")
    assert flight.published == CYCLES
    assert texts(flight, "late torque") == []


def test_publishes_nothing_where_the_spare_never_did(program: Path) -> None:
    """Another controller may publish the same topics, if extras.txt was forgotten."""
    flight = flown(program, "never")
    assert flight.published == 0
    assert texts(flight, "the spare does not publish")[0] == approx(2.0, abs=0.01)


def test_silent_spare_is_an_emergency_and_the_thrust_goes_on(program: Path) -> None:
    flight = flown(program, "spare", "4")
    assert texts(flight, "is silent, no fall-back, land") == [approx(4.04, abs=0.01)]
    assert flight.published == CYCLES
    assert flight.thrust == flight.wanted  # 0.42 at 4 s, 0.60 at the end


@pytest.mark.parametrize(
    "event, text, instant",
    [
        ("off", "does not fly: off", 4.0),
        ("age", "maximum age not within", 4.0),
        ("setpoint", "stale setpoint", 5.0),  # COM_OF_LOSS_T later
        ("rates", "stale rates", 4.04),
    ],
)
def test_falls_back_and_tells(program: Path, event: str, text: str, instant: float) -> None:
    flight = flown(program, event, "4")
    assert texts(flight, text)[0] == approx(instant, abs=0.01)
    assert flight.not_numbers == 0


def test_setting_that_was_wrong_before_is_told_at_the_switch(program: Path) -> None:
    """At 200 Hz in PX4's SIH, the refusal was there before RDI_EN was 1, and was not told."""
    flight = flown(program, "age", "1")
    text = "RISE-DI does not fly: maximum age not within 0.01 to 1 s"
    assert texts(flight, text) == [approx(2.0, abs=0.01)]


def test_status_has_the_whole_reason(program: Path) -> None:
    """PX4 cuts its lines at 127 characters."""
    flight = flown(program, "slow")
    reason = "rates slower than the controller: export it with --rate"
    assert flight.told[-2][1] == f"refusal: {reason}"
    assert texts(flight, f"RISE-DI does not fly: {reason} (rates 200 Hz)") == [
        approx(2.0, abs=0.01)
    ]


@pytest.mark.parametrize("event", ["nan_torque", "nan_thrust", "nan_rates"])
@pytest.mark.parametrize("instant", ["1", "4"])
def test_nan_is_never_published(program: Path, event: str, instant: str) -> None:
    flight = flown(program, event, instant)
    assert flight.not_numbers == 0
    assert len(texts(flight, "RISE-DI flies")) == 2 + (event == "nan_rates" and instant == "4")
