# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The exported code as a shared library for Python, and as a co-simulation unit of FMI 2.0."""

import ctypes
import shutil
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from c_export.events import GUARD_TICK, RESTART, START, Recording
from c_export.proof import CODE, FLAGS, PARAMETERS, SOURCE, build
from flight_core.parameters import ParameterError
from flight_core.text import printable
from flight_core.vectors import FloatArray
from rise_di_controller.rise_di_config import RiseDiConfig

_POINTER = ctypes.c_void_p


class CController:
    """A controller in C, with the calls of `rise_di_controller.controller.Controller`; p values of
    u.
    """

    def __init__(self, library: Path, p: int) -> None:
        self._p = p
        self._library = ctypes.CDLL(str(library))
        self._library.library_bytes.restype = ctypes.c_int64
        self._memory = ctypes.create_string_buffer(self._library.library_bytes())
        self._u = np.zeros(p)
        if not self._library.library_start(self._memory):
            raise ParameterError(
                "the exported code: its compiler does not compute what is written, expected one "
                "with its flags"
            )

    def take_y(self, stamp_ns: int, value: FloatArray, now_ns: int) -> int:
        """Take a sample of y; returns rise_di_status, 0 for a sample taken."""
        return self._take(1, stamp_ns, value, now_ns)

    def take_y_m(self, stamp_ns: int, value: FloatArray, now_ns: int) -> int:
        """Take a sample of y_m, as `take_y` does."""
        return self._take(0, stamp_ns, value, now_ns)

    def _take(self, is_y: int, stamp_ns: int, value: FloatArray, now_ns: int) -> int:
        sample = np.ascontiguousarray(value, dtype=np.float64)
        integers = (ctypes.c_int64(number) for number in (is_y, stamp_ns, now_ns))
        return int(
            self._library.library_take(self._memory, *integers, _POINTER(sample.ctypes.data))
        )

    def tick(self, now_ns: int, *, active: bool = True) -> tuple[FloatArray, int]:
        """A tick: u, and the mode, -1 where no u is to be sent."""
        arguments = (ctypes.c_int64(now_ns), ctypes.c_int64(active), _POINTER(self._u.ctypes.data))
        mode = int(self._library.library_tick(self._memory, *arguments))
        return self._u.copy(), mode

    def replay(self, recording: Recording) -> FloatArray:
        """The u of each tick of a log, `events.run_recording`, shape (T, p)."""
        events = recording.events
        ticks = events[events["kind"] == GUARD_TICK]
        before = np.zeros(len(events), dtype=np.int64)  # what the event before a tick is
        before[1:] = 4 * (events["kind"] == START)[:-1] + 8 * (events["kind"] == RESTART)[:-1]
        flags = ticks["flag"] + before[events["kind"] == GUARD_TICK]
        integers = [
            np.ascontiguousarray(values)
            for values in (ticks["now_ns"], ticks["stamp_ns"], flags, ticks["offset_ns"])
        ]
        reals = [np.ascontiguousarray(ticks[name]) for name in ("y", "y_m")]
        u = np.zeros((len(ticks), self._p))
        addresses = (_POINTER(values.ctypes.data) for values in (*integers, *reals, u))
        self._library.library_replay(self._memory, ctypes.c_int64(len(ticks)), *addresses)
        return u


def build_library(code: Path, compiler: Sequence[str], path: Path) -> Path:
    """Compile exported code of float64 to a shared library for CController. Raises
    ParameterError.
    """
    return _shared(code, compiler, "library.c", path)


def _shared(code: Path, compiler: Sequence[str], program: str, path: Path) -> Path:
    with tempfile.TemporaryDirectory(prefix="rise_di_export_") as name:
        folder = Path(name)
        for file in (*(code / part for part in (*CODE, PARAMETERS)), SOURCE / program):
            shutil.copyfile(file, folder / file.name)
        build([*compiler, *FLAGS, "-fPIC", "-shared", "-o", str(path.absolute()), program], folder)
    return path


VALUE_REFERENCES = {
    "y": 0,
    "y_m": 100,
    "u": 200,
    "active": 300,
    "y_new": 301,
    "y_m_new": 302,
    "mode": 400,
}
"""Value references of the first channel of each group, those of fmu.c."""


def model_description(controller: RiseDiConfig, scenario: str) -> str:
    """modelDescription.xml of the unit. Inputs y, y_m, active, y_new, y_m_new; outputs u and mode;
    a step is a tick.
    """
    groups = {"y": controller.outputs, "y_m": controller.outputs, "u": controller.effectors}
    variables = []
    for group, names in groups.items():
        for i, name in enumerate(names):
            attributes = (
                f"name={quoteattr(printable(f'{group}.{name}'))} "
                f'valueReference="{VALUE_REFERENCES[group] + i}"'
            )
            if group == "u":
                variables.append(
                    f'<ScalarVariable {attributes} causality="output" '
                    'variability="discrete"><Real/></ScalarVariable>'
                )
            else:
                kind = 'causality="input" variability="discrete"'
                variables.append(
                    f'<ScalarVariable {attributes} {kind}><Real start="0"/></ScalarVariable>'
                )
    for name in ("active", "y_new", "y_m_new"):
        attributes = (
            f'name="{name}" valueReference="{VALUE_REFERENCES[name]}" '
            'causality="input" variability="discrete"'
        )
        variables.append(f'<ScalarVariable {attributes}><Boolean start="true"/></ScalarVariable>')
    attributes = (
        f'name="mode" valueReference="{VALUE_REFERENCES["mode"]}" causality="output" '
        'variability="discrete"'
    )
    variables.append(f"<ScalarVariable {attributes}><Integer/></ScalarVariable>")
    begin = 2 * len(controller.outputs) + 1
    outputs = [*range(begin, begin + len(controller.effectors)), len(variables)]
    unknowns = "".join(f'<Unknown index="{index}"/>' for index in outputs)
    model_attributes = (
        f"modelName={quoteattr(printable(f'RISE-DI {scenario}'))} "
        f'guid="{controller.digest():012x}" '
        'generationTool="rise-di export" variableNamingConvention="structured"'
    )
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<fmiModelDescription fmiVersion="2.0" {model_attributes}>',
        '<CoSimulation modelIdentifier="rise_di" canHandleVariableCommunicationStepSize="true"/>',
        f'<DefaultExperiment startTime="0" stepSize="{1.0 / controller.rate!r}"/>',
        "<ModelVariables>",
        *variables,
        "</ModelVariables>",
        f"<ModelStructure><Outputs>{unknowns}</Outputs><InitialUnknowns>{unknowns}</InitialUnknowns></ModelStructure>",
        "</fmiModelDescription>",
    ]
    return "\n".join(lines) + "\n"


def build_fmu(
    code: Path, compiler: Sequence[str], controller: RiseDiConfig, scenario: str, path: Path
) -> Path:
    """Compile exported code to a co-simulation unit of FMI 2.0 for this machine (linux64). Raises
    ParameterError.
    """
    with tempfile.TemporaryDirectory(prefix="rise_di_fmu_") as name:
        library = _shared(code, compiler, "fmu.c", Path(name) / "rise_di.so")
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("modelDescription.xml", model_description(controller, scenario))
            archive.write(library, "binaries/linux64/rise_di.so")
            for part in (*(code / name for name in (*CODE, PARAMETERS)), SOURCE / "fmu.c"):
                archive.write(part, f"sources/{part.name}")
    return path
