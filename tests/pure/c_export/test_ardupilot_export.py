# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test `rise-di export --ardupilot`: the files compile with a stub of ArduPlane's headers.

The stub has each name that the shell takes from ArduPlane.
"""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from pytest import approx
from tests.conftest import REPOSITORY, refusing

from c_export.autopilots import SHELLS, write_module
from c_export.proof import build
from flight_analysis.closed_loop.scenario_library import find_scenario
from rise_di.c_code import export

pytestmark = pytest.mark.skipif(
    shutil.which("g++") is None, reason="no g++ on this machine, which compiles the shell"
)
RATES = REPOSITORY / "examples" / "arduplane" / "rates.yaml"
WARNINGS = ["-O2", "-Wall", "-Wextra", "-Werror", "-Wshadow", "-Wfloat-equal", "-Wdouble-promotion"]


@pytest.fixture(scope="module", params=["double", "float"])
def folder(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    folder = tmp_path_factory.mktemp("ardupilot")
    write_module("ardupilot", find_scenario(str(RATES)), folder, float32=request.param == "float")
    return folder


def test_compiles_beside_a_stub_of_arduplane(folder: Path, tmp_path: Path) -> None:
    """The float version also compiles with ArduPilot's flag that makes constants float."""
    code = folder / SHELLS["ardupilot"].place
    stub = f"-I{REPOSITORY / 'tests' / 'ardupilot'}"
    shell = ["g++", "-std=gnu++17", *WARNINGS, "-Wno-unused-parameter", stub]
    build([*shell, "-c", "-o", str(tmp_path / "o"), "rise_di.cpp"], code)
    is_float = "RISE_DI_FLOAT32 1 " in (code / "rise_di_parameters.h").read_text()
    flags = ["-fsingle-precision-constant"] if is_float else []
    for name in ("rise_di.c", "rise_di_rates.c", "rise_di_table.c"):
        build(["gcc", "-std=gnu11", *WARNINGS, *flags, "-c", "-o", str(tmp_path / "o"), name], code)
    assert (folder / "hooks.txt").read_text().count("rise_di") == 2


def flown(folder: Path, work: Path, *words: str) -> list[tuple[float, str]]:
    """Return what the task tells in a flight on a host, with instants, under the traps of SITL."""
    code = folder / SHELLS["ardupilot"].place
    stub = REPOSITORY / "tests" / "ardupilot"
    for name in ("rise_di", "rise_di_rates"):
        build(["gcc", "-std=gnu11", "-O1", "-c", "-o", str(work / f"{name}.o"), f"{name}.c"], code)
    program = work / "task"
    objects = [str(work / "rise_di.o"), str(work / "rise_di_rates.o")]
    shell = ["g++", "-std=gnu++17", "-O1", f"-I{stub}", "-o", str(program), "rise_di.cpp"]
    build([*shell, str(stub / "host.cpp"), *objects], code)
    done = subprocess.run(
        [str(program), *words], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0  # a trap ends the process by SIGFPE
    told = re.findall(r"^told (\S+) (.*)$", done.stdout, re.MULTILINE)
    return [(float(instant), text) for instant, text in told]


def test_flies_under_the_floating_point_traps_of_sitl(folder: Path, tmp_path: Path) -> None:
    """The self-test divides by 0 on purpose, which had ended ArduPlane's SITL in its first loop.

    The log has an instant of its own in each loop, also while the spare flies.
    """
    instants, texts = zip(*flown(folder, tmp_path), strict=True)
    assert instants == approx((2.0, 4.0), abs=0.02)
    assert texts == ("RISE-DI: RISE-DI flies (200 Hz)", "RISE-DI: off (200 Hz)")


def test_leaves_the_autotune_to_the_spare(folder: Path, tmp_path: Path) -> None:
    """AUTOTUNE judges ArduPlane's own controllers by the response to their output."""
    told = flown(folder, tmp_path, "autotune")
    assert [text for _, text in told] == ["RISE-DI: no rate control in this mode (200 Hz)"]


def test_says_what_the_switch_needs(folder: Path, tmp_path: Path) -> None:
    """Without scripting, ArduPlane refuses RCx_OPTION 300 and does not arm."""
    code = folder / SHELLS["ardupilot"].place
    stub = f"-I{REPOSITORY / 'tests' / 'ardupilot'}"
    words = [
        "g++",
        "-std=gnu++17",
        "-DAP_SCRIPTING_ENABLED=0",
        stub,
        "-fsyntax-only",
        "rise_di.cpp",
    ]
    done = subprocess.run(words, cwd=code, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "RCx_OPTION 300 needs AP_SCRIPTING_ENABLED 1" in done.stderr


def test_refuses_a_yaw_rate_and_an_unknown_autopilot(tmp_path: Path) -> None:
    """In ArduPlane the rudder coordinates turns, so that there is no yaw rate to follow."""
    three = REPOSITORY / "examples" / "px4_airplane" / "rates.yaml"
    with refusing("controller.outputs: found q, p, r, expected some of p, q: ArduPlane"):
        write_module("ardupilot", find_scenario(str(three)), tmp_path, float32=True)
    with refusing("autopilot: found inav, expected one of px4, ardupilot"):
        export(str(RATES), tmp_path, autopilot="inav", proof=False)
