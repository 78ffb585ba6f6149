# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Build the exported code as a library for Python, or as an FMI 2.0 co-simulation unit."""

import ctypes
import shutil
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from c_export.constants import TABLE, constants
from c_export.events import GUARD_TICK, RESTART, START, Recording
from c_export.proof import CODE, FLAGS, PARAMETERS, SOURCE, build
from flight_core.parameters import ParameterError
from flight_core.text import printable
from flight_core.units import quantity
from flight_core.vectors import FloatArray
from rise_di_controller.rise_di_config import RiseDiConfig

_POINTER = ctypes.c_void_p
MOST = float(np.finfo(np.float64).max)  # number that stands for infinity in the C code


class CController:
    """A controller in C with the methods of `rise_di_controller.controller.Controller`.

    `p` is the number of channels of u.
    """

    def __init__(self, library: Path, p: int) -> None:
        self._p = p
        self._library = ctypes.CDLL(str(library))
        self._library.library_bytes.restype = ctypes.c_int64
        self._memory = ctypes.create_string_buffer(self._library.library_bytes())
        self._u = np.zeros(p)
        if not self._library.library_start(self._memory):
            raise ParameterError(
                "the exported code: found a compiler that does not compute what is written, "
                "expected the flags of the proof"
            )

    def take_y(self, stamp_ns: int, value: FloatArray, now_ns: int) -> int:
        """Take a sample of y, and return its rise_di_status, which is 0 if it was accepted."""
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
        """Compute a tick, and return u and the mode. The mode is -1 if u must not be sent."""
        arguments = (ctypes.c_int64(now_ns), ctypes.c_int64(active), _POINTER(self._u.ctypes.data))
        mode = int(self._library.library_tick(self._memory, *arguments))
        return self._u.copy(), mode

    def replay(self, recording: Recording) -> FloatArray:
        """Compute every tick of a recorded flight in C, and return the u of each tick, (T, p).

        `recording` is a result of `run_recording`.
        """
        events = recording.events
        ticks = events[events["kind"] == GUARD_TICK]
        before = np.zeros(len(events), dtype=np.int64)  # code of the event before each tick
        kinds = events["kind"][:-1]
        before[1:] = np.select([kinds == START, kinds == RESTART], [4, 8])
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
    """Compile exported float64 code to a shared library, which `CController` can load.

    Raises ParameterError if the compiler fails.
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
    "parameter": 1000,
}
"""Value references of the first channel of each group, as in fmu.c. The value references of the
parameters follow from their order."""

TUNABLE: Mapping[str, str] = MappingProxyType(
    {
        "K": "diagonal of K (22), 1/s",
        "Lambda": "diagonal of Lambda (4), 1/s",
        "beta": "diagonal of beta (21), units of the output per s^2",
        "input_scale": "units of the input times s per unit of the output",
        "eps": "half-width of the softened sign, units of the output",
        "limits.lower": "lower limit of u from trim",
        "limits.upper": "upper limit of u from trim",
        "limits.rate": "limit of the rate of u, per s",
    }
)
"""Parameters that can change between two steps, with their meaning. Each has a value for each
channel.
"""


class Units(NamedTuple):
    """The SI units of the outputs and of the commands, in the order of the channels."""

    outputs: Sequence[str]
    commands: Sequence[str]


def si_units(units: Sequence[str]) -> tuple[str, ...]:
    """Convert the units of an airframe file to SI units, for example "deg/s" to "rad/s"."""
    return tuple(_unit_name(quantity(unit).dimension) for unit in units)


def _unit_name(dimension: tuple[int, int, int, int]) -> str:
    """Return the name of the SI unit whose exponents of rad, m, s and kg are given."""
    parts = list(zip(("rad", "m", "s", "kg"), dimension, strict=True))
    above = [_power(name, exponent) for name, exponent in parts if exponent > 0]
    below = [_power(name, -exponent) for name, exponent in parts if exponent < 0]
    return "/".join(["*".join(above) or "1", *below])


def _power(name: str, exponent: int) -> str:
    return name if exponent == 1 else f"{name}{exponent}"


def _definitions(units: Units) -> list[str]:
    """Return the XML lines of UnitDefinitions in modelDescription.xml."""
    lines = []
    for name in sorted({*units.outputs, *units.commands}):
        dimension = quantity(name).dimension
        exponents = zip(("rad", "m", "s", "kg"), dimension, strict=True)
        base = "".join(f' {unit}="{exponent}"' for unit, exponent in exponents if exponent)
        lines.append(f"<Unit name={quoteattr(name)}><BaseUnit{base}/></Unit>")
    return ["<UnitDefinitions>", *lines, "</UnitDefinitions>"]


def _channels(controller: RiseDiConfig, units: Units) -> list[str]:
    """Return the XML lines with the variables of y, y_m, u, the flags and the mode."""
    groups = {
        "y": (controller.outputs, units.outputs),
        "y_m": (controller.outputs, units.outputs),
        "u": (controller.effectors, units.commands),
    }
    variables = []
    for group, (names, group_units) in groups.items():
        is_input = group != "u"
        for i, (name, unit) in enumerate(zip(names, group_units, strict=True)):
            start = ' start="0"' if is_input else ""
            variables.append(
                _variable(
                    f"{group}.{name}",
                    VALUE_REFERENCES[group] + i,
                    "input" if is_input else "output",
                    f"<Real unit={quoteattr(unit)}{start}/>",
                )
            )
    for name in ("active", "y_new", "y_m_new"):
        content = '<Boolean start="true"/>'
        variables.append(_variable(name, VALUE_REFERENCES[name], "input", content))
    return [*variables, _variable("mode", VALUE_REFERENCES["mode"], "output", "<Integer/>")]


def _parameters(controller: RiseDiConfig) -> list[str]:
    """Return the XML lines with a variable for each channel of each parameter in TUNABLE."""
    variables = []
    place = VALUE_REFERENCES["parameter"]
    for member in constants(controller):
        if not isinstance(member.value, np.ndarray):
            continue
        if member.name in TUNABLE:
            _, least, largest = TABLE[member.name]
            bounds = {"min": least, "max": largest}
            limits = "".join(f' {key}="{x!r}"' for key, x in bounds.items() if np.isfinite(x))
            is_limit = member.name.startswith("limits.")
            names = controller.inputs if is_limit else controller.outputs
            for i, name in enumerate(names):
                value = float(np.nan_to_num(member.value[i], posinf=MOST, neginf=-MOST))
                variables.append(
                    _variable(
                        f"{member.name}.{name}",
                        place + i,
                        "parameter",
                        f'<Real{limits} start="{value!r}"/>',
                        TUNABLE[member.name],
                    )
                )
        place += member.value.size
    return variables


def _variable(
    name: str, reference: int, causality: str, content: str, description: str = ""
) -> str:
    variability = "tunable" if causality == "parameter" else "discrete"
    said = f" description={quoteattr(description)}" if description else ""
    return (
        f'<ScalarVariable name={quoteattr(printable(name))} valueReference="{reference}" '
        f'causality="{causality}" variability="{variability}"{said}>{content}</ScalarVariable>'
    )


DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName={name} guid="{guid}" generationTool="rise-di export" variableNamingConvention="structured">
<CoSimulation modelIdentifier="rise_di" canHandleVariableCommunicationStepSize="true" canGetAndSetFMUstate="true" canSerializeFMUstate="true">
<SourceFiles><File name="fmu.c"/></SourceFiles>
</CoSimulation>
{units}
<DefaultExperiment startTime="0" stepSize="{step!r}"/>
<ModelVariables>
{variables}
</ModelVariables>
<ModelStructure><Outputs>{unknowns}</Outputs><InitialUnknowns>{unknowns}</InitialUnknowns></ModelStructure>
</fmiModelDescription>
"""  # noqa: E501 - a text as it is written


def model_description(controller: RiseDiConfig, scenario: str, units: Units) -> str:
    """Return the text of modelDescription.xml.

    The inputs of the FMI unit are y, y_m, active, y_new and y_m_new. Its outputs are u and mode,
    and its parameters are listed in TUNABLE. A step of the unit is a tick of the controller.
    """
    variables = _channels(controller, units)
    begin = 2 * len(controller.outputs) + 1
    outputs = [*range(begin, begin + len(controller.effectors)), len(variables)]
    unknowns = "".join(f'<Unknown index="{index}"/>' for index in outputs)
    return DESCRIPTION.format(
        name=quoteattr(printable(f"RISE-DI {scenario}")),
        guid=f"{controller.digest():012x}",
        units="\n".join(_definitions(units)),
        step=1.0 / controller.rate,
        variables="\n".join([*variables, *_parameters(controller)]),
        unknowns=unknowns,
    )


def build_fmu(
    code: Path,
    compiler: Sequence[str],
    controller: RiseDiConfig,
    scenario: str,
    path: Path,
    units: Units,
) -> Path:
    """Compile exported code to an FMI 2.0 co-simulation unit for this machine (linux64).

    The unit also contains the sources, for other machines. Raises ParameterError if the compiler
    fails.
    """
    with tempfile.TemporaryDirectory(prefix="rise_di_fmu_") as name:
        library = _shared(code, compiler, "fmu.c", Path(name) / "rise_di.so")
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("modelDescription.xml", model_description(controller, scenario, units))
            archive.write(library, "binaries/linux64/rise_di.so")
            for part in (*(code / name for name in (*CODE, PARAMETERS)), SOURCE / "fmu.c"):
                archive.write(part, f"sources/{part.name}")
    return path
