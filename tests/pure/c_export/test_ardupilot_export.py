# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di export --ardupilot`: the files compile beside a stub of ArduPlane's headers.

Each name that the shell takes from ArduPlane is in the stub.
"""

import shutil
from pathlib import Path

import pytest
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
    """In float also under the flag of ArduPilot that makes constants float."""
    code = folder / SHELLS["ardupilot"].place
    stub = f"-I{REPOSITORY / 'tests' / 'ardupilot'}"
    shell = ["g++", "-std=gnu++17", *WARNINGS, "-Wno-unused-parameter", stub]
    build([*shell, "-c", "-o", str(tmp_path / "o"), "rise_di.cpp"], code)
    is_float = "RISE_DI_FLOAT32 1 " in (code / "rise_di_parameters.h").read_text()
    flags = ["-fsingle-precision-constant"] if is_float else []
    for name in ("rise_di.c", "rise_di_rates.c", "rise_di_table.c"):
        build(["gcc", "-std=gnu11", *WARNINGS, *flags, "-c", "-o", str(tmp_path / "o"), name], code)
    assert (folder / "hooks.txt").read_text().count("rise_di") == 2


def test_refuses_a_yaw_rate_and_an_unknown_autopilot(tmp_path: Path) -> None:
    """The rudder coordinates turns in ArduPlane: nothing there gives a yaw rate to follow."""
    three = REPOSITORY / "examples" / "px4_airplane" / "rates.yaml"
    with refusing("controller.outputs: found q, p, r, expected some of p, q: ArduPlane"):
        write_module("ardupilot", find_scenario(str(three)), tmp_path, float32=True)
    with refusing("autopilot: found inav, expected one of px4, ardupilot"):
        export(str(RATES), tmp_path, autopilot="inav", proof=False)
