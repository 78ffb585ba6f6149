# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test `rise-di export`: C code against the Python controller, bit by bit.

Further tests use mutants of the C code, sanitizers and refusals.
"""

import ctypes
import json
import re
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import typer
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.conftest import refusing

from c_export.constants import TABLE, constants, exportable, packed
from c_export.drawn import drawn_calls, drawn_commands, drawn_standstill, drawn_steps
from c_export.events import (
    RETUNE,
    GuardSample,
    Recorder,
    Recording,
    flight_recordings,
    parameter_sets,
    run_recording,
)
from c_export.proof import (
    CODE,
    FLAGS,
    FLOAT32_BOUND,
    FMU,
    PARAMETERS,
    REPORT,
    SOURCE,
    Program,
    build,
    compilers,
    proof_report,
    prove,
    write_code,
)
from flight_analysis.closed_loop.replay_ticks import vary
from flight_analysis.closed_loop.scenario import Scenario, scenario_yaml
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.report.run_folder import attachments_for
from flight_cli.export import Export
from flight_core.modes import Mode
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS
from flight_core.vectors import ChannelError, StampedVector
from flight_log.log_content import StoredFile
from flight_log.tape_reader import RecordedRun
from flight_log.tape_writer import write_run
from rise_di_controller.controller import Controller, ControlOutput
from rise_di_controller.laws import AnyLaw
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig

GCC = shutil.which("gcc")
CROSS = shutil.which("aarch64-linux-gnu-gcc")
QEMU = shutil.which("qemu-aarch64")
FLAGS_OF_PX4 = (
    "-Os",
    "-freciprocal-math",
    "-fno-signed-zeros",
    "-fno-trapping-math",
    "-fno-math-errno",
)
PX4_FLAGS = (
    *FLAGS_OF_PX4,
    *re.findall(
        r"^\t\t(-f\S+)",
        (SOURCE / "px4" / "CMakeLists.txt").read_text(),
        re.MULTILINE,
    ),
)
"""What PX4 compiles with, and then the module."""
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        GCC is None, reason="no gcc on this machine, which compiles the exported code"
    ),
]
SCHEDULE = {"schedule": {"speed": 25.0}}
TWIN = find_scenario("osprey_twin").controller
PRIORITY = {"allocation": {**TWIN.model_dump()["allocation"], "priority": TWIN.inputs[::-1]}}
SCENARIOS: dict[str, Callable[[], Scenario]] = {
    "observer": lambda: find_scenario("osprey_observer"),
    # lost samples of more than ten periods within the age limit
    "fast feedforward": lambda: find_scenario("osprey_turbulence").vary(
        controller={"observer": None, "rate": 250.0}
    ),
    "schedule and allocation": lambda: find_scenario("osprey_twin").vary(
        controller=SCHEDULE | PRIORITY
    ),
}


class Case(NamedTuple):
    """Exported code, parameter sets and recordings of a scenario."""

    code: Path
    sets: list[RiseDiConfig]
    recordings: list[Recording]


def export_case(name: str, folder: Path) -> Case:
    """Return short flights at the controller's rate, 1500 random calls and 300 steps.

    The steps are with each parameter set. If Python is slow, there are a tenth of them.
    """
    rate = SCENARIOS[name]().controller.rate
    slow = {"rate": rate, "step": min(0.005, 1.0 / rate)}
    limits = {"bounds": {"q": 0.4, "p": 0.5}, "slew": {"p": 1.0, "r": 0.5}}
    model = {"rate": rate, "live": limits}
    # a short ramp: every mode fits into five seconds
    scenario = SCENARIOS[name]().vary(
        aircraft=slow,
        reference_model=model,
        controller={"ramp": 1.0},
        flight={"duration": 5.0},
    )
    sets = parameter_sets(exportable(scenario.controller))
    write_code(sets[0], name, folder, scenario.reference_model, float32=False)
    part = 10 if sets[0].allocation is None else 1
    steps = [drawn_steps(sets, k, 30 * part, k) for k in range(len(sets))]
    calls = [drawn_calls(sets, 150 * part, 3), drawn_standstill(sets, 200 * part, 4)]
    drawn = [*calls, any_numbers(sets), *steps]
    recordings = [
        *flight_recordings(scenario, sets),
        drawn_commands(scenario.reference_model, 900, 2),
        *drawn,
    ]
    return Case(folder, sets, recordings)


def any_numbers(sets: list[RiseDiConfig]) -> Recording:
    """Return ticks of the guard with y and y_m of any size, also infinite and NaN.

    The stamps reach both ends of int64.
    """
    rng = np.random.default_rng(5)
    recorder = Recorder(sets)
    m = len(sets[0].outputs)
    special = np.array(
        [0.0, 1e-320, 1.0, -30.0, 1e6, 1e150, -1e200, 1e308, -1.7e308, np.inf, -np.inf, np.nan]
    )
    with np.errstate(all="ignore"):
        for start_ns in (-(2**63) + 1, -(10**9), 2**63 - 3 * 10**9):
            recorder.begin()
            for k in range(200):
                y, y_m = 0.05 * rng.normal(size=(2, m)) if k % 3 else rng.choice(special, (2, m))
                now_ns = (
                    start_ns + 10_000_000 * k + int(rng.integers(-2_000_000, 2_000_000)) * (k > 0)
                )
                # inactive at first: with u = 0 nothing has to ramp
                recorder.guard_tick(now_ns, GuardSample(now_ns, y, y_m), active=k > 2)
            with suppress(ChannelError):
                recorder.take_y(StampedVector(-start_ns, np.zeros(m)), start_ns + 5 * 10**8)
            recorder.tick(-start_ns)
    return recorder.recording("any numbers")


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Case]:
    """Return the case of a scenario, which is made once."""
    return cache(lambda name: export_case(name, tmp_path_factory.mktemp("code")))


@pytest.fixture(scope="module", params=list(SCENARIOS))
def case(request: pytest.FixtureRequest, exported: Callable[[str], Case]) -> Case:
    return exported(str(request.param))


each_line = pytest.mark.parametrize("case", ["observer", "schedule and allocation"], indirect=True)
"""The cases that compile each line of the code between them."""


def test_every_bit_is_equal(case: Case) -> None:
    proof = prove(case.code, compilers(), case.sets, case.recordings, float32=False)
    assert proof.is_proved, proof_report(proof, "the case")
    assert proof.figures["data_bytes"] == 0  # no global
    assert proof.figures["multiply"] > 0 or shutil.which("g++") is None
    ticks = [recording for recording in case.recordings if recording.name != "drawn commands"]
    modes = np.concatenate([recording.integers[:, 2] for recording in ticks])
    assert set(modes.tolist()) == set(map(int, Mode))
    u, u_free = (
        np.concatenate([recording.reals[:, 4 * k : 4 * k + 4] for recording in ticks])
        for k in range(2)
    )
    assert 0.05 < (u != u_free).mean() < 0.95  # limits act in many ticks and not in many


@each_line
def test_sanitizers_find_nothing(case: Case, tmp_path: Path) -> None:
    flags = [
        *FLAGS,
        "-g",
        "-fsanitize=address,undefined",
        "-fno-sanitize-recover=all",
        "-Wno-error",
    ]
    program = Program(case.code, ["gcc"], case.sets, tmp_path, flags=flags)
    for recording in case.recordings[:5]:
        assert program.compare(recording).differing == 0


@each_line
@pytest.mark.parametrize(
    "flags",
    [("-O3", "-march=native", "-Wconversion", "-Wdouble-promotion", "-Wundef"), PX4_FLAGS],
    ids=["fastest", "as PX4"],
)
def test_bits_do_not_depend_on_optimisation(
    flags: tuple[str, ...], case: Case, tmp_path: Path
) -> None:
    # without a warning
    build(["gcc", *FLAGS, *flags, "-c", "-o", str(tmp_path / "rise_di.o"), "rise_di.c"], case.code)
    program = Program(
        case.code, ["gcc"], case.sets, tmp_path / "program", flags=[*FLAGS, *flags, "-Wno-error"]
    )
    assert all(program.compare(recording).differing == 0 for recording in case.recordings[2:6])


def test_contraction_does_not_start(exported: Callable[[str], Case], tmp_path: Path) -> None:
    """A fused multiply-add has a single rounding.

    Without -ffp-contract=off, the code does not start on a processor that has it.
    """
    if " fma " not in Path("/proc/cpuinfo").read_text():
        pytest.skip("no fused multiply-add on this processor")
    case = exported("observer")
    flags = [*FLAGS[:-1], "-mfma", "-ffp-contract=fast"]
    program = Program(case.code, ["gcc"], case.sets, tmp_path, flags=flags)
    with refusing("rise_di_start returns false"):
        program.compare(case.recordings[0])


@pytest.mark.skipif(
    not (CROSS and QEMU), reason="no aarch64-linux-gnu-gcc with qemu-aarch64 on this machine"
)
def test_proof_of_another_machine(case: Case) -> None:
    commands = [["aarch64-linux-gnu-gcc", "-static"]]
    proof = prove(
        case.code, commands, case.sets, case.recordings, float32=False, runner=["qemu-aarch64"]
    )
    assert proof.is_proved, proof_report(proof, "the case")
    assert "aarch64-linux-gnu-gcc" in proof.compilers[0]
    with refusing("runner: found no program 'qemu-of-nothing', expected a command such as"):
        export("osprey_servo", case.code, runner="qemu-of-nothing")


MUTANTS: dict[str, tuple[str, str]] = yaml.safe_load(
    Path(__file__).with_name("mutants.yaml").read_text()
)
"""Of each function of rise_di.c: a text of its body and what a mutant has instead."""

FUNCTION = re.compile(
    r"^(?:static )?(?:const )?\w+ \*?(\w+)\([^;{]*\) \{(?:[^\n]*\}\n|\n.*?^\}\n)",
    re.MULTILINE | re.DOTALL,
)


def bodies(source: str) -> dict[str, tuple[int, int]]:
    """Return the beginning and the end of each function."""
    return {match[1]: match.span() for match in FUNCTION.finditer(source)}


NUMBERS = {name: number for number, name in enumerate(MUTANTS)}
SWITCH = """\
#include <stdlib.h>
static int mutant;
__attribute__((constructor)) static void choose(void) { mutant = atoi(getenv("MUTANT")); }
"""


def with_mutants(source: str) -> str:
    """Return the code with a mutant of each function. MUTANT is the number of the one in use.

    All are in one program, because compiling takes longer than running.
    """
    places = bodies(source)
    assert set(places) == set(MUTANTS)
    # from the end of the file: the places before stay
    for name in sorted(MUTANTS, key=places.__getitem__, reverse=True):
        begin, end = places[name]
        old, new = MUTANTS[name]
        body = source[begin:end]
        assert old in body, name
        mutant = body.replace(old, new, 1).replace(f"{name}(", f"{name}_mutant(", 1)
        chosen = f"(mutant == {NUMBERS[name]} ? {name}_mutant(__VA_ARGS__) : ({name})(__VA_ARGS__))"
        source = f"{source[:end]}{mutant}#define {name}(...) {chosen}\n{source[end:]}"
    return SWITCH + source


def test_proof_finds_a_mutant_of_each_function(
    exported: Callable[[str], Case], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flags = ["-std=c99", "-O0", "-w", "-ffp-contract=off"]
    source = with_mutants((SOURCE / "rise_di.c").read_text())
    programs = []
    for name in ("observer", "schedule and allocation"):
        case = exported(name)
        program = Program(
            case.code, ["gcc"], case.sets, tmp_path / name, flags=flags, source=source
        )
        monkeypatch.setenv("MUTANT", "-1")
        assert not any(program.compare(recording).differing for recording in case.recordings)
        programs.append((program, case.recordings))
    survivors = []
    for name, number in NUMBERS.items():
        monkeypatch.setenv("MUTANT", str(number))
        if not any(is_found(*program) for program in programs):
            survivors.append(name)
    assert not survivors


def is_found(program: Program, recordings: list[Recording]) -> bool:
    """Return whether the proof distinguishes a mutant from the code."""
    with suppress(ParameterError):  # rise_di_start refuses what is not computed as written
        return any(program.compare(recording).differing for recording in recordings)
    return True


@pytest.mark.parametrize("name", ["observer", "schedule and allocation"])
def test_check_names_an_edit_out_of_bounds(
    name: str, exported: Callable[[str], Case], tmp_path: Path
) -> None:
    """Each set of the proof passes, and each value out of bounds is named.

    The values are each real number beyond each of its finite bounds, each NaN and each odd integer.
    """
    case = exported(name)
    build(
        ["gcc", *FLAGS, "-fPIC", "-shared", "-o", str(tmp_path / "table.so"), "rise_di_table.c"],
        case.code,
    )
    library = ctypes.CDLL(str(tmp_path / "table.so"))
    library.rise_di_check.restype = ctypes.c_char_p
    for config in case.sets:
        assert library.rise_di_check(packed(config, float32=False)) is None
    members = [(constant.name, constant.value) for constant in constants(case.sets[0])]
    good = packed(case.sets[0], float32=False)
    place = 8 * sum(np.size(value) for _, value in members if not isinstance(value, np.ndarray))
    for member, value in members:
        if isinstance(value, np.ndarray):
            _, least, largest = TABLE.get(member, ("", -np.inf, np.inf))
            outside = [np.nan, np.inf, *np.array([least * 1.01 - 1.0, largest * 1.01 + 1.0])]
            for k, edit in np.ndindex(value.size, len(outside)):
                wrong = bytearray(good)
                wrong[place + 8 * k : place + 8 * k + 8] = np.float64(outside[edit]).tobytes()
                assert library.rise_di_check(bytes(wrong)).decode() == member
            place += 8 * value.size
    odd = {"period_ns": 0, "max_age_ns": -1, "hold_ns": -1, "ramp_ns": -1, "slope_ns": 0, "sign": 3}
    for k, name_of_member in enumerate(list(dict(members))[:8]):
        if name_of_member in odd:
            odd_set = good[: 8 * k] + np.int64(odd[name_of_member]).tobytes() + good[8 * k + 8 :]
            assert name_of_member in library.rise_di_check(odd_set).decode()


POSITIVE = st.floats(1e-3, 1e3)
FOUR = st.tuples(POSITIVE, POSITIVE, POSITIVE, POSITIVE)


@pytest.fixture(scope="module")
def servo_program(tmp_path_factory: pytest.TempPathFactory) -> tuple[RiseDiConfig, Program]:
    config = exportable(find_scenario("osprey_servo").controller)
    folder = tmp_path_factory.mktemp("code")
    write_code(config, "osprey_servo", folder, float32=False)
    return config, Program(folder, ["gcc"], [config], tmp_path_factory.mktemp("program"))


@settings(
    deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.fixed_dictionaries(
        {
            "k_g": POSITIVE,
            "k_d": st.tuples(POSITIVE, POSITIVE, POSITIVE),
            "Lambda": FOUR,
            "beta": FOUR,
            "input_scale": FOUR,
            "omega": FOUR,
            "softening": FOUR,
            "upper": FOUR | st.none(),
            "slew": FOUR | st.none(),
            "D": st.tuples(*[st.sampled_from([1, -1])] * 4),
            "sign": st.sampled_from(["literal", "implicit", "soft"]),
            "max_age": st.floats(0.01, 1.0),
            "hold": st.floats(0.0, 1.0),
            "ramp": st.floats(0.0, 1.0),
        }
    ),
    st.integers(0, 2**32 - 1),
)
def test_drawn_parameters(
    servo_program: tuple[RiseDiConfig, Program], changes: dict[str, Any], seed: int
) -> None:
    config, program = servo_program
    sets = [config, exportable(vary(config, changes))]
    program.take(sets)
    assert program.compare(drawn_steps(sets, 1, 50, seed)).differing == 0
    assert program.compare(drawn_calls(sets, 60, seed)).differing == 0


def test_float32_is_within_its_bound(exported: Callable[[str], Case], tmp_path: Path) -> None:
    case = exported("observer")
    controller = SCENARIOS["observer"]().controller
    write_code(exportable(controller), "observer", tmp_path, float32=True)
    flights = case.recordings[:1]
    proof = prove(tmp_path, [["gcc"]], case.sets, flights, float32=True)
    assert proof.is_proved, proof_report(proof, "observer")
    assert all(0.0 < comparison.deviation < FLOAT32_BOUND for comparison in proof.comparisons)


def export(scenario: str, folder: Path, **words: Any) -> None:
    """Run `rise-di export`."""
    Export(scenario=scenario, folder=folder, **words).execute()


def test_command_writes_code_and_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as status:
        export(
            "osprey_servo",
            tmp_path,
            duration=1.0,
            drawn=1000,
            compiler=["gcc"],
            fmu=True,
            as_json=True,
        )
    result = json.loads(capsys.readouterr().out)
    assert (status.value.exit_code, result["proved"]) == (0, True)
    assert {Path(name).name for name in result["files"]} == {*CODE, PARAMETERS, REPORT, FMU}
    assert (tmp_path / "proof.txt").read_text().endswith("PROVED: every bit is equal\n")


def test_command_proves_with_a_recorded_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (run := tmp_path / "run").mkdir()
    scenario = find_scenario("osprey_gust", 0.5)
    write_run(simulate(scenario), run, attachments_for(scenario, run))
    with pytest.raises(typer.Exit) as status:
        export("osprey_gust", tmp_path / "c", run=run, compiler=["gcc"])
    assert status.value.exit_code == 0
    # the ticks of the log
    assert "51 of 51 ticks have the u of the log to the bit" in capsys.readouterr().out
    expected = "expected the parameters of osprey_servo"
    with refusing(f"run: found a flight with other parameters, {expected}"):
        export("osprey_servo", tmp_path / "c", run=run, compiler=["gcc"])


def test_wrong_code_is_not_proved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = tmp_path / "source"
    shutil.copytree(SOURCE, wrong)
    text = (wrong / "rise_di.c").read_text()
    (wrong / "rise_di.c").write_text(
        text.replace("dt * (e + before->e[i])", "dt * (e - before->e[i])")
    )
    monkeypatch.setattr("c_export.proof.SOURCE", wrong)
    with pytest.raises(typer.Exit) as status:
        export("osprey_servo", tmp_path / "c", duration=1.0, drawn=100, compiler=["gcc"])
    assert status.value.exit_code == 1
    assert "first in tick 1: u[0] is" in (tmp_path / "c" / "proof.txt").read_text()


def test_models_that_are_learned_are_refused() -> None:
    learns = find_scenario("osprey_learn")
    with refusing(r"^controller\.learn: found a section, expected none: C code replaces no model"):
        exportable(learns.controller)
    with refusing(r"^controller\.observer\.part: found 0\.0, expected more than 0"):
        exportable(learns.vary(controller={"learn": None}).controller)


def test_refusals_are_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    controller = find_scenario("osprey_servo").controller
    common = {
        key: value
        for key, value in controller.model_dump().items()
        if key in ControllerConfig.model_fields
    }
    pi = AnyLaw.validate_mapping(
        {**common, "law": "pi", "Lambda": [1.0] * 4, "K": [1.0] * 4}, "controller"
    )
    with refusing(
        r"^controller\.law: found pi, expected rise_di: C code exists for this law alone$"
    ):
        exportable(pi)
    monkeypatch.setenv("PATH", "")
    with refusing(
        "compiler: found none of gcc, clang on the PATH, expected one for the proof; --no-proof"
    ):
        export("osprey_servo", tmp_path)
    with refusing("compiler: found no program 'tcc', expected the command of a C compiler"):
        export("osprey_servo", tmp_path, compiler=["tcc"])
    with refusing(r"compiler: found .gcc '. \(No closing quotation\), expected the command of a C"):
        export("osprey_servo", tmp_path, compiler=["gcc '"])
    (tmp_path / "file").touch()
    with refusing(r"c: .*file"):
        export("osprey_servo", tmp_path / "file", without_proof=True)
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / REPORT).write_text("PROVED: every bit is equal\n")  # of an earlier export
    export("osprey_servo", tmp_path / "c", without_proof=True)
    assert not (tmp_path / "c" / REPORT).exists()


def test_proof_of_a_log_takes_changes_of_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    """New gains in flight are an event of the recording, and every u is the one of the log.

    Without the changes, the log is refused.
    """
    scenario = find_scenario("osprey_servo", 2.0)
    change = {"k_g": 2.0}
    tuned = vary(scenario.controller, change)

    class Tuned(Controller):
        def tick(
            self, now_ns: int, late_ns: int = 0, *, active: bool = True
        ) -> ControlOutput | None:
            if now_ns >= NANOSECONDS:
                self.retune(tuned)
            return super().tick(now_ns, late_ns, active=active)

    tape = simulate(scenario, control=Tuned)
    stored = StoredFile("osprey_servo.yaml", scenario_yaml(scenario).encode())
    run = RecordedRun(replace(tape, changes=(change,)), stored)
    sets, recording, equal = run_recording(run)
    assert [parameters.digest() for parameters in sets] == [
        scenario.controller.digest(),
        tuned.digest(),
    ]
    assert (recording.events["kind"] == RETUNE).sum() == 1
    assert equal == recording.ticks == 201
    with refusing("run: found parameters before tick 101 that no change of the log leads to"):
        run_recording(RecordedRun(tape, stored))
