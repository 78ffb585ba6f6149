# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write the controller of a scenario as C99 with a proof, as `rise-di export` does."""

import hashlib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.uncertainty import as_yaml
from c_export.autopilots import SAMPLES, SHELLS, write_module
from c_export.constants import exportable, header
from c_export.drawn import drawn_calls, drawn_commands, drawn_standstill, drawn_steps
from c_export.events import Recording, flight_recordings, parameter_sets, run_recording
from c_export.library import Units, build_fmu, si_units
from c_export.proof import (
    CERTIFICATE,
    FMU,
    PARAMETERS,
    REPORT,
    Proof,
    compilers,
    proof_report,
    prove,
    words,
    write_code,
)
from flight_analysis.closed_loop.scenario import Scenario, scenario_yaml
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.linear_loop.certificate import certificate, kept_guarantee
from flight_analysis.linear_loop.loop_margins import is_literal, scenario_loop
from flight_analysis.report.margin_figures import guarantee_text
from flight_core.arguments import FilePath, as_number, as_path
from flight_core.files import write_file, writing
from flight_core.outcome import Refusal
from flight_core.parameters import RATES, ParameterError, require
from flight_core.rates import period_ns, seconds
from flight_core.text import printable
from flight_design.gains.first_scenario import controller_alone
from flight_design.learning.scenario_learner import with_last_model
from flight_log.tape_reader import RecordedRun, read_run
from rise_di_controller.guard.guard import SAMPLE_BUFFER_SIZE
from rise_di_controller.rise_di_config import RiseDiConfig

PART = 50_000  # number of drawn steps in a recording
LONGEST = 20.0  # longest flight if no duration is given, s


class Material(NamedTuple):
    """The parameters and recordings with which a proof compares C and Python."""

    sets: list[RiseDiConfig]  # parameter sets; the code begins with the first
    recordings: Iterator[Recording]
    line: str  # a line for the report of the proof


class Exported(NamedTuple):
    """An exported controller.

    Attributes:
        files: The files that were written.
        proof: The proof, or None without a proof.
        report: The text of the report.
    """

    files: list[Path]
    proof: Proof | None
    report: str


def export(
    scenario: FilePath | Scenario,
    folder: FilePath,
    *,
    run: FilePath | RecordedRun | None = None,
    float32: bool = False,
    duration: float | None = None,
    drawn: int = 50_000,
    seed: int = 1,
    compiler: Sequence[str] = (),
    runner: str = "",
    fmu: bool = False,
    autopilot: str | None = None,
    samples: int | None = None,
    rate: float | None = None,
    proof: bool = True,
) -> Exported:
    """Write the controller of a scenario as C99, compile the code and prove it.

    In double precision the proof shows that C and Python give the same bits. If a guarantee is
    stored for the loop, its certificate is written, too.

    Args:
        scenario: Name, path of a scenario file (.yaml), or a Scenario.
        folder: Folder for the code and the report of the proof.
        run: A recorded flight, whose ticks replace the flights and random inputs of the proof. If
            the scenario learns, the last model of this flight is exported instead, and the proof
            has its own flights and random inputs.
        float32: Whether to compute in single precision. The proof then bounds the difference of u.
        duration: Duration of each flight of the proof, s. If None, it is the scenario's, at
            most 20 s.
        drawn: Number of random steps in the proof. There are none in single precision, or if the
            ticks of `run` are used.
        seed: Seed of the random inputs.
        compiler: Commands of C compilers. If empty, they are gcc and clang.
        runner: Command that starts a program of the compiler, such as qemu-aarch64 for a cross
            compiler.
        fmu: Whether to write a co-simulation unit of FMI 2.0, too.
        autopilot: "px4" or "ardupilot" to write the code as a part of this autopilot, or None.
        samples: Number of samples of y and of y_m that the controller keeps, 4 or more. If None, it
            is 8 inside an autopilot, else 100.
        rate: Rate of the law, the reference model and y, Hz, in place of the scenario's. The
            observer is discretised for it.
        proof: Whether to compile and prove the code.

    Returns:
        The files, the proof and the text of the report. `proof.is_proved` says whether C computed
        what Python computes in every comparison.

    Raises:
        ParameterError: The controller has no C code, no compiler runs, or the folder cannot be
            written.

    Examples:
        >>> exported = rise_di.export("osprey_servo", "c", proof=False)
        >>> exported.files[0].name
        'rise_di.h'
    """
    source = find_scenario(scenario)
    if run is not None and source.has_learner():
        source = with_last_model(source, run if isinstance(run, RecordedRun) else read_run(run))
        run = None  # several models flew in its ticks, but only the last one is exported
    if rate is not None:
        source = at_rate(source, rate)
    folder = as_path(folder, "c", "the path of a folder")
    title = printable(source.name)  # the name of a file may have any character
    controller = exportable(source.controller)
    commands = compilers(compiler) if proof or fmu else []
    starter = words(runner, "runner", "a command such as qemu-aarch64") if runner else []
    code, files, buffer_size = _write(source, folder, autopilot, samples, float32=float32)
    if fmu:
        units = _units(source, controller)
        files.append(build_fmu(code, commands[0], controller, title, folder / FMU, units))
    stated = _certified(source, code / PARAMETERS)
    if stated is not None:
        with writing("c", folder):
            write_file(folder / CERTIFICATE, stated[0])
        files.append(folder / CERTIFICATE)
    if not proof:
        return Exported(files, None, "")
    if run is None:
        length = min(source.flight.duration, LONGEST) if duration is None else duration
        flight = source.vary(flight={"duration": length})
        material = _flights(flight, 0 if float32 else drawn, seed, buffer_size)
    else:
        material = _logged(run, controller, title)
    proved = prove(
        code, commands, material.sets, material.recordings, float32=float32, runner=starter
    )
    text = proof_report(proved, title) + material.line
    if stated is not None:
        text = stated[1] + text
    with writing("c", folder):
        write_file(folder / REPORT, text)
    return Exported([*files, folder / REPORT], proved, text)


def at_rate(scenario: Scenario, rate: float) -> Scenario:
    """Return a scenario with the law, the reference model and y at another rate, Hz.

    The step of the simulation becomes the longest that divides the new period in whole ns and is
    not longer than before. Raises ParameterError if the rate is not within RATES, if the controller
    has no C code, or if the observer has less than the required delay margin at this rate.
    """
    rate = as_number(rate, "rate", *RATES, "Hz")
    controller = exportable(scenario.controller)
    changes: dict[str, Any] = {"rate": rate}
    if controller.observer is not None:
        nominal = controller.nominal()
        assert nominal is not None  # noqa: S101 - an observer needs it
        changes["observer"] = controller.observer.at_rate(rate, nominal).model_dump()
    period = period_ns(rate, "rate")
    fewest = math.ceil(seconds(period) / scenario.aircraft.step)
    steps = next(count for count in range(fewest, period + 1) if period % count == 0)
    return scenario.vary(
        controller=changes,
        reference_model={"rate": rate},
        aircraft={"rate": rate, "step": seconds(period // steps)},
    )


class CertificateSources(NamedTuple):
    """The files from which the loop of a certificate was built, as the certificate names them."""

    texts: dict[str, str]  # "airframe" and "scenario" as SHA-256, "constants" as the text itself
    refusal: Refusal | None = None  # why there are no constants

    def notes(self) -> list[str]:
        """Say that there are no constants, and why; an empty list if there are some."""
        return [] if self.refusal is None else [f"certificate without constants: {self.refusal}"]


def certificate_sources(airframe: Airframe, scenario: FilePath | Scenario) -> CertificateSources:
    """Return the sources from which the loop of a certificate was built.

    The constants are the text of rise_di_parameters.h as `export` writes it by default. A law that
    C cannot express has no constants. A section `controller` without a scenario has neither
    constants nor a scenario.
    """
    texts = {"airframe": _sha256(as_yaml(airframe))}
    if controller_alone(scenario) is not None:
        refusal = Refusal("a section controller alone has no reference model")
        return CertificateSources(texts, refusal)
    flight = find_scenario(scenario)
    texts["scenario"] = _sha256(scenario_yaml(flight))
    try:
        controller = exportable(flight.controller)
    except ParameterError as error:
        return CertificateSources(texts, Refusal(str(error)))
    texts["constants"] = header(
        controller,
        printable(flight.name),
        flight.reference_model,
        float32=False,
        samples=SAMPLE_BUFFER_SIZE,
    )
    return CertificateSources(texts)


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _certified(scenario: Scenario, constants: Path) -> tuple[str, str] | None:
    """Return the certificate of a loop's guarantee, and a line of text on what it guarantees.

    The guarantee is the one that `rise-di gains guarantee` has stored for the loop of the scenario.
    `constants` is the file of the C constants, whose text goes into the certificate. Returns None
    if no guarantee of a stable loop is stored, for an aircraft of JSBSim, and for a controller that
    samples the literal sign, which has no linear loop.
    """
    if scenario.aircraft.is_jsbsim or is_literal(scenario.controller):
        return None
    loop = scenario_loop(scenario, scenario.controller, 1)
    guarantee = kept_guarantee(loop)
    if guarantee is None or not guarantee.stable:
        return None
    frame = load_airframe(scenario.aircraft.airframe)
    sources = certificate_sources(frame, scenario).texts | {"constants": constants.read_text()}
    stated = f"{CERTIFICATE}: {guarantee_text(guarantee)[0]}\n"
    return certificate(loop, guarantee, sources), stated


def _write(
    scenario: Scenario, folder: Path, autopilot: str | None, samples: int | None, *, float32: bool
) -> tuple[Path, list[Path], int]:
    """Write the code, alone or for an autopilot.

    Returns the folder of the code, all files, and the number of samples that the code keeps.
    """
    if autopilot is None:
        buffer_size = samples or SAMPLE_BUFFER_SIZE
        controller = exportable(scenario.controller)
        title = printable(scenario.name)
        model = scenario.reference_model
        files = write_code(controller, title, folder, model, float32=float32, samples=buffer_size)
        return folder, files, buffer_size
    require(autopilot in SHELLS, "autopilot", autopilot, f"one of {', '.join(SHELLS)}")
    buffer_size = samples or SAMPLES
    files = write_module(autopilot, scenario, folder, float32=float32, samples=buffer_size)
    return folder / SHELLS[autopilot].place, files, buffer_size


def _units(scenario: Scenario, controller: RiseDiConfig) -> Units:
    """Return the SI units of the outputs and of the commands of a scenario."""
    channels = scenario.aircraft.channels()
    outputs = [channels.outputs[name] for name in controller.outputs]
    commands = [channels.inputs[name] for name in controller.effectors]
    return Units(si_units(outputs), si_units(commands))


def _logged(run: FilePath | RecordedRun, controller: RiseDiConfig, title: str) -> Material:
    """Return the parameters and the ticks of a recorded flight.

    The `line` of the result says in how many ticks Python computes exactly the u of the log. Raises
    ParameterError if the flight had other parameters.
    """
    sets, recording, equal = run_recording(run if isinstance(run, RecordedRun) else read_run(run))
    same = sets[0].digest() == controller.digest()
    require(same, "run", "a flight with other parameters", f"the parameters of {title}")
    line = f"{equal} of {recording.ticks} ticks have the u of the log to the bit\n"
    return Material(sets, iter([recording]), line)


def _flights(scenario: Scenario, drawn: int, seed: int, samples: int) -> Material:
    """Return simulated flights of a scenario and random inputs, with several parameter sets."""
    sets = parameter_sets(exportable(scenario.controller))
    return Material(sets, _recordings(scenario, sets, drawn, seed, samples), "")


def _recordings(
    scenario: Scenario, sets: Sequence[RiseDiConfig], drawn: int, seed: int, samples: int
) -> Iterator[Recording]:
    """Yield the recordings that a proof compares: simulated flights, and random inputs.

    The random inputs are commands of the reference model, calls of the controller, samples that
    stand still, and single steps of the law. `drawn` is the number of single steps, and there are a
    tenth as many calls. If it is 0, only flights and commands are recorded. The steps are divided
    into recordings that fit into memory.
    """
    yield from flight_recordings(scenario, sets, samples)
    yield drawn_commands(scenario.reference_model, max(drawn // 10, 1000), seed)
    if drawn:
        yield drawn_calls(sets, max(drawn // 10, 100), seed, samples)
        yield drawn_standstill(sets, max(drawn // 20, 100), seed, samples)
        each = -(-drawn // len(sets))
        for index in range(len(sets)):
            for begin in range(0, each, PART):
                yield drawn_steps(sets, index, min(PART, each - begin), seed + index + begin)
