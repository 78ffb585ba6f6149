# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test wrappers of the exported code.

They are the library that replays logs, a caller of a library at 250 Hz, and the unit of FMI 2.0.
"""

import importlib.util
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from tests.conftest import REPOSITORY, refusing

from c_export.constants import exportable, packed
from c_export.events import run_recording
from c_export.library import CController, Units, build_fmu, build_library
from c_export.proof import FLAGS, build, write_code
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.modes import Mode
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS
from flight_core.tape import Tape
from flight_core.vectors import FloatArray, StampedVector
from flight_log.tape_reader import read_run
from rise_di.c_code import export
from rise_di_controller.controller import Controller
from rise_di_controller.rise_di_config import RiseDiConfig

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        shutil.which("gcc") is None,
        reason="no gcc on this machine, which compiles the exported code",
    ),
]
TAKEN, FUTURE, ORDER, NOT_FINITE, IMPLAUSIBLE = range(5)  # rise_di_status of rise_di.h


@pytest.fixture
def c_controller(tmp_path: Path) -> Callable[[RiseDiConfig], CController]:
    def build(config: RiseDiConfig) -> CController:
        write_code(config, "test", tmp_path / "code", float32=False)
        return CController(
            build_library(tmp_path / "code", ["gcc"], tmp_path / "rise_di.so"), len(config.outputs)
        )

    return build


def test_library_replays_a_log(
    tmp_path: Path, c_controller: Callable[[RiseDiConfig], CController]
) -> None:
    shutil.unpack_archive(
        REPOSITORY / "tests" / "recorded" / "osprey_servo.tar.xz", tmp_path, filter="data"
    )
    run = read_run(tmp_path / "osprey_servo")
    (config,), recording, _ = run_recording(run)
    u = c_controller(config).replay(recording)
    assert u.tobytes() == np.ascontiguousarray(run.tape["internals"].group("u").values).tobytes()


class Call(NamedTuple):
    """An instant of a caller, and the samples that have arrived since the last instant.

    A sample has a stamp and a value.
    """

    now_ns: int
    y: list[tuple[int, FloatArray]]
    y_m: list[tuple[int, FloatArray]]


def jittering_calls(count: int, seed: int) -> list[Call]:
    """Return calls at 250 Hz that are late by up to a quarter of a period.

    A fifth of y and a tenth of y_m are lost, and there is one second without y.
    """
    rng = np.random.default_rng(seed)
    calls = []
    for k in range(1, count):
        stamp_ns = k * NANOSECONDS // 250
        now_ns = stamp_ns + int(rng.integers(0, 1_000_000))
        y_m = 0.05 * np.sin(0.01 * k + np.arange(4.0))
        is_lost = rng.random(2) < (0.2, 0.1)
        y = (
            []
            if is_lost[0] or 500 <= k < 750
            else [(stamp_ns - int(rng.integers(0, 500_000)), y_m + 0.01 * rng.normal(size=4))]
        )
        calls.append(Call(now_ns, y, [] if is_lost[1] else [(stamp_ns, y_m)]))
    return calls


@pytest.mark.parametrize("name", ["osprey_servo", "osprey_observer"])
def test_caller_at_250_hz(name: str, c_controller: Callable[[RiseDiConfig], CController]) -> None:
    """The caller from the page on export has jitter and lost samples.

    u and mode are those of the Python controller.
    """
    controller = find_scenario(name).controller
    if controller.observer is None:  # the matrices of an observer hold at the rate of its design
        controller = (
            find_scenario(name)
            .vary(controller={"rate": 250.0}, aircraft={"rate": 250.0, "step": 0.004})
            .controller
        )
    python = Controller(controller)
    c = c_controller(exportable(controller))
    modes = set()
    largest = np.zeros(4)
    for call in jittering_calls(1500, 3):
        for stamp_ns, value in call.y_m:
            python.take_y_m(StampedVector(stamp_ns, value), call.now_ns)
            assert c.take_y_m(stamp_ns, value, call.now_ns) == TAKEN
        for stamp_ns, value in call.y:
            python.take_y(StampedVector(stamp_ns, value), call.now_ns)
            assert c.take_y(stamp_ns, value, call.now_ns) == TAKEN
        output = python.tick(call.now_ns)
        u, mode = c.tick(call.now_ns)
        assert mode == (-1 if output is None else python.mode)
        assert u.tobytes() == python.state.u.tobytes()
        modes.add(python.mode)
        largest = np.maximum(largest, np.abs(u))
    assert modes >= {Mode.ENGAGED, Mode.HOLD, Mode.RAMP}
    assert (largest > 0.0).all()


UNITS = Units(("rad/s", "rad/s", "rad/s", "m/s"), ("rad", "rad", "rad", "1"))
STEP = 0.01  # s


@pytest.fixture(scope="module")
def unit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fmu")
    config = exportable(find_scenario("osprey_observer").controller)
    write_code(config, "osprey_observer", folder / "code", float32=False)
    path = folder / "rise_di.fmu"
    return build_fmu(folder / "code", ["gcc"], config, "osprey_observer", path, UNITS)


def flown(unit: Path, tape: Tape, outputs: Sequence[str], **start: float) -> FloatArray:
    """Return the u of a unit along y and y_m of a tape, by FMPy, with other parameters."""
    fmpy = pytest.importorskip("fmpy", reason="FMPy is not installed: pip install fmpy")
    t = tape.time("internals")
    columns = {
        f"{group}.{name}": tape["internals"].group(group)[name]
        for group in ("y", "y_m")
        for name in outputs
    }
    signals = np.zeros(len(t), dtype=[("time", float), *((name, float) for name in columns)])
    signals["time"] = t
    for name, column in columns.items():
        signals[name] = column
    names = [f"u.{name}" for name in find_scenario("osprey_observer").controller.inputs]
    result = fmpy.simulate_fmu(
        str(unit),
        start_time=0.0,
        stop_time=float(t[-1]),
        output_interval=STEP,
        input=signals,
        output=names,
        start_values=start,
    )
    assert len(result) == len(t)
    return np.column_stack([result[name] for name in names])


def test_fmu_flies_to_the_bit(unit: Path, tmp_path: Path) -> None:
    """FMPy, an independent host of FMI, steps the unit with y and y_m of a flight.

    The flight is in one process. A gain that is set before the flight is the one in Python, and the
    sources compile with CMake.
    """
    scenario = find_scenario("osprey_observer", 5.0).vary(
        aircraft={"rate": 100.0, "step": 0.005}, reference_model={"rate": 100.0}
    )
    outputs = scenario.controller.outputs
    tape = simulate(scenario)
    u = tape["internals"].group("u").values[:-1]
    assert pytest.importorskip("fmpy.validation").validate_fmu(str(unit)) == []
    # valid after the step, whose begin has the stamp
    assert flown(unit, tape, outputs)[1:].tobytes() == u.tobytes()
    Lambda = scenario.rise_di().Lambda
    slower = scenario.vary(controller={"Lambda": (0.5 * Lambda[0], *Lambda[1:])})
    changed = simulate(slower)
    again = flown(unit, changed, outputs, **{f"Lambda.{outputs[0]}": 0.5 * Lambda[0]})
    assert again[1:].tobytes() == changed["internals"].group("u").values[:-1].tobytes()
    if shutil.which("cmake") is not None:
        with zipfile.ZipFile(unit) as packed:
            members = [name for name in packed.namelist() if not name.startswith("binaries/")]
            packed.extractall(tmp_path, members)
        by_cmake = pytest.importorskip("fmpy.build").build_platform_binary
        (tmp_path / "build").mkdir()
        by_cmake(str(tmp_path), build_dir=str(tmp_path / "build"))
        assert flown(tmp_path, tape, outputs)[1:].tobytes() == u.tobytes()


def test_fmu_state_is_taken_back_and_a_wrong_gain_is_refused(unit: Path) -> None:
    """From a saved state, also as bytes, the same steps give the same u."""
    fmpy = pytest.importorskip("fmpy", reason="FMPy is not installed: pip install fmpy")
    slave = pytest.importorskip("fmpy.fmi2").FMU2Slave
    description = fmpy.read_model_description(str(unit))
    references = {variable.name: variable.valueReference for variable in description.modelVariables}
    assert {variable.unit for variable in description.modelVariables} >= {"rad/s", "m/s", "rad"}
    folder = fmpy.extract(str(unit))
    instance = slave(guid=description.guid, unzipDirectory=folder, modelIdentifier="rise_di")
    instance.instantiate()
    instance.setupExperiment(startTime=0.0)
    instance.enterInitializationMode()
    instance.exitInitializationMode()

    def steps(begin: int, count: int) -> list[float]:
        u = []
        for k in range(begin, begin + count):
            instance.setReal([references["y.q"]], [0.1 * np.sin(0.1 * k)])
            instance.doStep(currentCommunicationPoint=STEP * k, communicationStepSize=STEP)
            u += instance.getReal([references["u.elevator"]])
        return u

    steps(0, 50)
    state = instance.getFMUstate()
    content = instance.serializeFMUstate(state)
    first = steps(50, 50)
    assert len(set(first)) > 40
    instance.setFMUstate(state)
    assert steps(50, 50) == first
    instance.setFMUstate(instance.deSerializeFMUstate(content))
    assert steps(50, 50) == first
    instance.setReal([references["Lambda.q"]], [-1.0])
    # discarded, and the law flies on unchanged
    with pytest.raises(Exception, match="fmi2DoStep failed with status 2"):
        steps(100, 1)
    instance.setReal([references["Lambda.q"]], [1.0])
    assert np.isfinite(steps(101, 1)).all()
    instance.freeInstance()
    shutil.rmtree(folder)


def test_program_of_the_page_flies(tmp_path: Path) -> None:
    page = (REPOSITORY / "docs" / "export.md").read_text()
    (tmp_path / "caller.c").write_text(page.partition("```c\n")[2].partition("```")[0])
    write_code(
        exportable(find_scenario("osprey_servo").controller),
        "osprey_servo",
        tmp_path,
        float32=False,
    )
    build(["gcc", *FLAGS, "-o", "caller", "caller.c", "rise_di.c"], tmp_path)
    assert subprocess.run(["./caller"], cwd=tmp_path, check=False).returncode == 0


CLANG = [["clang"]] if shutil.which("clang") else []
CLANG += [[sys.executable, "-m", "ziglang", "cc"]] if importlib.util.find_spec("ziglang") else []
FAST_MATH = (
    "-ffast-math",
    "-funsafe-math-optimizations",
    "-fassociative-math -fno-signed-zeros -fno-trapping-math",
    "-freciprocal-math",
    "-ffinite-math-only",
    "-fno-signed-zeros",
    "-freciprocal-math -fno-signed-zeros -fno-trapping-math",  # as PX4 has them
)
CPU = Path("/proc/cpuinfo")
MACROS = (
    "FAST_MATH",
    "ASSOCIATIVE_MATH",
    "RECIPROCAL_MATH",
    "FINITE_MATH_ONLY",
    "NO_SIGNED_ZEROS",
    "NO_TRAPPING_MATH",
)
WITHOUT_MACROS = [f"-U__{name}__" for name in MACROS]
"""As of a compiler that does not name its flags: clang has two of these macros."""

STARTER = """
#include "rise_di.h"
static const rise_di_parameters parameters = RISE_DI_PARAMETERS;
static rise_di_controller controller;
int main(void) {
    rise_di_real y[RISE_DI_M] = {0};
    rise_di_output output;
    if (rise_di_start(&controller, &parameters)) {
        return 0;
    }
    const bool refused = rise_di_take_y(&controller, 0, 0, y) == RISE_DI_NOT_STARTED &&
        rise_di_take_y_m(&controller, 0, 0, y) == RISE_DI_NOT_STARTED && !rise_di_tick(&controller, 0, true, &output);
    return refused ? 1 : 2;
}
"""  # noqa: E501 - a text as it is written


@pytest.fixture(scope="module")
def code(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the code of osprey_observer, and a program that starts it.

    It has a feedforward, and so the sine.
    """
    folder = tmp_path_factory.mktemp("code")
    write_code(
        exportable(find_scenario("osprey_observer").controller),
        "osprey_observer",
        folder,
        float32=False,
    )
    (folder / "starter.c").write_text(STARTER)
    return folder


def started(code: Path, compiler: Sequence[str], flags: Sequence[str]) -> int:
    """Return the exit status of the program, which is 0 if the controller starts.

    It is 1 if the controller does not start, and then refuses every call.
    """
    build([*compiler, *FLAGS, *flags, "-o", "starter", "starter.c", "rise_di.c"], code)
    return subprocess.run(["./starter"], cwd=code, check=False).returncode


@pytest.mark.parametrize(
    "flags", ["-O1 -ffast-math", *(f"-O3 {flags}" for flags in (FAST_MATH[0], *FAST_MATH[2:6]))]
)
def test_controller_does_not_start_under_flags_that_change_bits(flags: str, code: Path) -> None:
    """If no macro shows the flags, the test in rise_di_start does, also in the fastest code.

    Then 0.3 is not rounded to 0.
    """
    assert started(code, ["gcc"], [*flags.split(), *WITHOUT_MACROS]) == 1


WRONG_FLAGS = (
    *FAST_MATH,
    "-fno-trapping-math",
    "-fsingle-precision-constant",
    "-mfpmath=387",
    "-Ofast",
    "-mfma -ffp-contract=fast",
)
HAS_FMA = CPU.is_file() and " fma " in CPU.read_text()


def test_twelve_of_twelve_wrong_flags_are_refused(code: Path) -> None:
    """The compiler or rise_di_start refuses them.

    The last one needs a processor with a fused multiply-add.
    """

    def is_refused(flags: str) -> bool:
        try:
            return started(code, ["gcc"], flags.split()) == 1
        except ParameterError:
            return True

    assert len(WRONG_FLAGS) == 12
    possible = WRONG_FLAGS if HAS_FMA else WRONG_FLAGS[:-1]
    assert [flags for flags in possible if not is_refused(flags)] == []


def test_calls_before_the_start_are_refused(code: Path) -> None:
    """The memory is zero, as for a static controller."""
    (code / "early.c").write_text(
        STARTER.replace("rise_di_start(&controller, &parameters)", "(int)parameters.sign < 0")
    )
    build(
        ["gcc", *FLAGS, "-fsanitize=address,undefined", "-o", "early", "early.c", "rise_di.c"], code
    )
    assert subprocess.run(["./early"], cwd=code, check=False).returncode == 1


def test_wrong_samples_are_lost_as_by_controller(
    c_controller: Callable[[RiseDiConfig], CController],
) -> None:
    """The same samples are lost, and u has the same bits.

    The samples are a spike, a jump that stays, noise that grows, and a y_m beyond its bound.
    """
    config = exportable(find_scenario("osprey_observer").controller)
    rng = np.random.default_rng(4)
    python = Controller(config)
    c = c_controller(config)
    count = 0
    for k in range(700):
        now_ns = k * NANOSECONDS // 100
        y, y_m = (0.1 * np.sin(0.01 * k + np.arange(8.0)) + 0.002 * rng.normal(size=8)).reshape(
            2, 4
        )
        y = (
            y
            + {150: 35.0, 160: 1e3, 170: 1e6, 180: 1e308, 190: -3.0}.get(k, 0.0) * np.eye(4)[k % 3]
        )
        y = (
            y
            + (5.0 if 200 <= k < 300 else 0.0)
            + (5.0 * rng.normal(size=4) if 400 <= k < 450 else 0.0)
        )
        y_m = y_m + (1e9 if k == 350 else 0.0)
        for refusal, status in (
            (python.take_y_m(StampedVector(now_ns, y_m), now_ns), c.take_y_m(now_ns, y_m, now_ns)),
            (python.take_y(StampedVector(now_ns, y), now_ns), c.take_y(now_ns, y, now_ns)),
        ):
            assert status == (IMPLAUSIBLE if refusal else TAKEN)
            count += refusal is not None
        output = python.tick(now_ns)
        u, mode = c.tick(now_ns)
        assert mode == (-1 if output is None else python.mode)
        assert u.tobytes() == python.state.u.tobytes()
    assert count > 10  # 5 spikes, 2 at each end of the jump, 1 of y_m, some of the noise


def test_export_at_another_rate_is_the_loop_at_that_rate(tmp_path: Path) -> None:
    """For a period twice as long, Phi is Phi^2. A rate at which the loop is unstable is refused."""
    scenario = find_scenario("osprey_observer")
    controller = scenario.rise_di()
    nominal = controller.nominal()
    assert controller.observer is not None
    assert nominal is not None
    Phi, Gamma, H, L, _ = controller.observer.matrices(nominal)
    slow = controller.observer.at_rate(50.0, nominal)
    assert slow.rate == 50.0
    twice, driven, _, corrected, _ = slow.matrices(nominal)
    np.testing.assert_allclose(twice, Phi @ Phi, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(driven, Phi @ Gamma + Gamma, rtol=1e-9, atol=1e-12)
    again = L + L - L @ H @ L  # two corrections by the same y
    np.testing.assert_allclose(corrected, again, rtol=1e-9, atol=1e-12)
    exported = export(scenario, tmp_path, rate=125.0, duration=2.0, drawn=200)
    assert exported.proof is not None
    assert exported.proof.is_proved, exported.report
    assert "125 Hz" in (tmp_path / "rise_di_parameters.h").read_text()
    with refusing("found a spectral radius of"):  # too slow for this observer
        export(str(REPOSITORY / "examples/px4_airplane/rates_observer.yaml"), tmp_path, rate=200.0)


BYTES_OF_PARAMETERS = """
#include <cstdio>
#include "rise_di.h"
static const rise_di_parameters parameters = RISE_DI_PARAMETERS;
int main() { return std::fwrite(&parameters, sizeof parameters, 1, stdout) == 1 ? 0 : 1; }
"""


@pytest.mark.parametrize("float32", [False, True])
def test_constants_are_those_of_python_in_strict_cpp_14(tmp_path: Path, *, float32: bool) -> None:
    """Decimal digits give the same bits, because C++ before 17 has no hexadecimal ones.

    The gains are drawn over many powers of two, so that each number of a struct has other last
    bits.
    """
    rng = np.random.default_rng(8)
    scenario = find_scenario("osprey_observer")
    for k in range(5):
        scales = 2.0 ** rng.uniform(-20.0, 20.0, 4)
        config = exportable(scenario.vary(controller={"beta": scales}).controller)
        code = tmp_path / str(k)
        write_code(config, "drawn", code, float32=float32)
        (code / "bytes.cpp").write_text(BYTES_OF_PARAMETERS)
        flags = ["-std=c++14", "-pedantic-errors", "-Wall", "-Wextra", "-Werror"]
        build(["g++", *flags, "-o", "bytes", "bytes.cpp"], code)
        written = subprocess.run([str(code / "bytes")], capture_output=True, check=True).stdout
        assert written == packed(config, float32=float32)
