# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read the models of other tools: python-control, SciPy, MATLAB, AVL, XFLR5."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flight_core.arguments import as_path
from flight_core.files import read_file
from flight_core.parameters import ParameterError, one_of, require
from flight_core.units import GRAVITY, in_si, quantity
from flight_core.vectors import FloatArray

SI_OF = {
    **dict.fromkeys(("V", "u", "v", "w"), "m/s"),
    **dict.fromkeys(("alpha", "beta", "theta", "phi", "psi"), "rad"),
    **dict.fromkeys(("p", "q", "r"), "rad/s"),
    **dict.fromkeys(("x", "y", "z", "h", "altitude"), "m"),
}
ALIASES = {
    "the": "theta",
    "th": "theta",
    "Phi": "phi",
    "Theta": "theta",
    "U": "u",
    "Q": "q",
    "P": "p",
    "R": "r",
    "W": "w",
}
"""Names of states in other tools."""
POSITIONS = ("x", "y", "z", "psi")
"""States of AVL that no equation of motion needs."""
MOVES = {
    "elevator": ("q", "nose up", "nose down"),
    "aileron": ("p", "roll right", "roll left"),
    "rudder": ("r", "nose right", "nose left"),
    "thrust": ("V", "more thrust", "less thrust"),
    "throttle": ("V", "more thrust", "less thrust"),
}
"""For each input: the output that it drives, and the effect of a positive value if the entry of B
is positive, and if it is negative."""


class ToolModel(NamedTuple):
    """The matrices of a model from another tool, in the units of `states` and `inputs`."""

    states: dict[str, str]  # units by state
    # by input: its unit, and its effect as `positive` if it is stated
    inputs: dict[str, dict[str, str]]
    A: FloatArray
    B: FloatArray
    C: FloatArray | None = None
    D: FloatArray | None = None
    outputs: tuple[str, ...] = ()  # names of the rows of C
    speed: float | None = None  # m/s
    note: str = ""  # says as what the file was read


def _states(units_by_name: Mapping[str, Any], labels: Sequence[str], n: int) -> dict[str, str]:
    """Return the units of the n states.

    The user gives them, or they follow from the names of the states in the model.
    """
    names = units_by_name or dict.fromkeys(labels, "")
    names_text = ", ".join(names) or "no names"
    require(
        len(names) == n,
        "states",
        f"{names_text} beside {n} rows of A",
        f"{n} names in the order of A: u: ft/s, w: ft/s, ...",
    )
    units = {}
    for name, unit in names.items():
        plain = ALIASES.get(name, name)
        if not unit and plain not in SI_OF:
            raise ParameterError(
                f"states: found {name!r} without a unit, expected a name of the field, or "
                f"{name}: UNIT"
            )
        units[plain] = unit or SI_OF[plain]
        quantity(units[plain], f"states.{name}")
    return units


def _inputs(
    units_by_name: Mapping[str, Any], labels: Sequence[str], m: int
) -> dict[str, dict[str, str]]:
    """Return units and effects of the m inputs.

    The user gives them, such as "rad nose down". Otherwise the unit is rad, or 1 for a thrust.
    """
    names = units_by_name or dict.fromkeys(labels, "")
    names_text = ", ".join(names) or "no names"
    require(
        len(names) == m,
        "inputs",
        f"{names_text} beside {m} columns of B",
        f"{m} names in the order of B: elevator: rad, ...",
    )
    channels = {}
    for name, text in names.items():
        if isinstance(text, Mapping):
            channels[name] = {key: str(value) for key, value in text.items()}
            continue
        unit, _, positive = str(text).strip().partition(" ")
        unit = unit or ("1" if name in {"thrust", "throttle"} else "rad")
        quantity(unit, f"inputs.{name}")
        channels[name] = {"unit": unit, "positive": positive.strip()}
    return channels


def read_model(
    source: Any,
    states: Mapping[str, Any],
    inputs: Mapping[str, Any],
    speed: float | None,
    body: Mapping[str, str | float],
) -> ToolModel:
    """Read the model from a `source` of `import_airframe`.

    Raises ParameterError if the file cannot be read or has none of the known forms, or if an
    argument is given that this form does not need.
    """
    no_body = "none: it belongs to AVL's stability derivatives"
    if not isinstance(source, str | Path):
        require(not body, next(iter(body), ""), "a value beside a state space", no_body)
        return _state_space(source, states, inputs)
    path = as_path(source, "source", "a state space, or the path of a file")
    content = read_file(path, f"model {path}", "a model: .mat, .yaml, or a text of AVL or XFLR5")
    if path.suffix == ".mat":
        require(not body, next(iter(body), ""), "a value beside a MAT-file", no_body)
        return _matlab(path, states, inputs)
    text = content.decode("utf-8", errors="replace")
    if re.search(r"\bCLa\s*=", text) and re.search(r"\bSref\s*=", text):
        require(
            not states,
            "states",
            "names beside AVL's derivatives",
            "none: the states are V, alpha, q, theta, beta, p, r, phi",
        )
        return _avl_derivatives(text, inputs, speed, body)
    require(not body, next(iter(body), ""), f"a value beside {path.name}", no_body)
    if "Longitudinal state matrix" in text or "Lateral state matrix" in text:
        return _xflr5(text, states, inputs)
    if (header := _avl_header(text)) is not None:
        return _avl_matrix(text, header, states, inputs, speed)
    expected = (
        "a .mat or .yaml file, AVL's system matrix or stability derivatives, or XFLR5's "
        "state matrices"
    )
    raise ParameterError(f"model {path}: found none of these, expected {expected}")


def _finite(matrix: Any, key: str) -> FloatArray:
    require(not np.iscomplexobj(matrix), key, "complex numbers", "a real matrix")
    try:
        values = np.atleast_2d(np.asarray(matrix, dtype=np.float64))
    except (TypeError, ValueError):
        raise ParameterError(
            f"{key}: found {type(matrix).__name__}, expected a real matrix"
        ) from None
    require(
        values.ndim == 2 and bool(np.isfinite(values).all()),
        key,
        "an entry that is not finite",
        "a matrix of finite numbers",
    )
    return values


def _square(A: FloatArray, B: FloatArray) -> None:
    n = len(A)
    require(A.shape == (n, n), "A", f"a shape of {A.shape}", "as many columns as rows")
    require(len(B) == n, "B", f"{len(B)} rows beside {n} of A", f"{n}, one a state")


def _state_space(system: Any, states: Mapping[str, Any], inputs: Mapping[str, Any]) -> ToolModel:
    """Read a StateSpace of python-control or SciPy through its attributes."""
    if not all(hasattr(system, key) for key in "ABCD"):
        raise ParameterError(
            f"source: found {type(system).__name__}, expected a state space: control.ss or "
            "scipy.signal.StateSpace"
        )
    sampled = getattr(system, "dt", None)
    require(
        not sampled,
        "source",
        f"a sampled system of period {sampled}",
        "a continuous one: control.d2c, or the model before c2d",
    )
    A = _finite(system.A, "A")
    B = _finite(system.B, "B")
    _square(A, B)

    def labels(attribute: str) -> list[str]:
        texts = [str(label) for label in getattr(system, attribute, None) or ()]
        return [] if any(re.fullmatch(r"[a-z]+\[\d+\]", label) for label in texts) else texts

    state_labels = labels("state_labels")
    input_labels = labels("input_labels")
    return ToolModel(
        states=_states(states, state_labels, len(A)),
        inputs=_inputs(inputs, input_labels, B.shape[1]),
        A=A,
        B=B,
        C=_finite(system.C, "C"),
        D=_finite(system.D, "D"),
        outputs=tuple(labels("output_labels")),
    )


def _matlab(path: Path, states: Mapping[str, Any], inputs: Mapping[str, Any]) -> ToolModel:
    """Read A, B, C, D of a .mat file, or of a structure in the file.

    StateName, InputName and OutputName have the names.
    """
    from scipy.io import loadmat  # noqa: PLC0415 - for .mat alone
    from scipy.io.matlab import MatReadError  # noqa: PLC0415

    try:
        content = loadmat(path, simplify_cells=True)
    except (MatReadError, NotImplementedError, ValueError, OSError, TypeError) as error:
        way_out = "a MAT-file of version 7 or less: save('model.mat', '-struct', 'model', '-v7')"
        raise ParameterError(
            f"model {path}: found {type(error).__name__}, expected {way_out}"
        ) from None
    groups = [content, *(value for value in content.values() if isinstance(value, dict))]
    group = next((group for group in groups if {"A", "B"} <= {*map(str.upper, group)}), None)
    if group is None:
        keys_text = ", ".join(key for key in content if not key.startswith("__")) or "nothing"
        way_out = (
            "A and B: m = struct('A', sys.A, 'B', sys.B); save('model.mat', '-struct', 'm', '-v7')"
        )
        raise ParameterError(f"model {path}: found {keys_text}, expected {way_out}")
    keys = {key.upper(): key for key in group if len(key) == 1}

    def names(*spellings: str) -> list[str]:
        value = next((group[key] for key in spellings if key in group), ())
        return [str(text).strip() for text in np.atleast_1d(value) if str(text).strip()]

    A = _finite(group[keys["A"]], "A")
    columns = np.asarray(group[keys["B"]])
    B = _finite(columns[:, None] if columns.ndim == 1 else columns, "B")
    _square(A, B)
    C, D = (_finite(group[keys[key]], key) if key in keys else None for key in "CD")
    return ToolModel(
        states=_states(states, names("StateName", "states", "state_names"), len(A)),
        inputs=_inputs(inputs, names("InputName", "inputs", "input_names"), B.shape[1]),
        A=A,
        B=B,
        C=C,
        D=D,
        outputs=tuple(names("OutputName", "outputs", "output_names")),
        note=f"A and B of {path.name}",
    )


def _numbers(line: str) -> list[float]:
    return [
        float(word)
        for word in re.findall(
            r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+)?", line.replace("D", "E")
        )
    ]


def _rows(lines: Sequence[str], count: int, columns: int, key: str) -> FloatArray:
    rows = [
        row
        for line in lines
        if len(row := _numbers(re.sub(r"^\s*[A-Za-z]+\s", " ", line))) == columns
    ][:count]
    require(len(rows) == count, key, f"{len(rows)} rows of {columns} numbers", f"{count}")
    return np.array(rows)


def _xflr5(text: str, states: Mapping[str, Any], inputs: Mapping[str, Any]) -> ToolModel:
    """Read the longitudinal and the lateral 4 x 4 matrix from a log of XFLR5, SI.

    Each control has two matrices, one for the longitudinal and one for the lateral motion. Their
    entries are per rad.
    """
    lines = text.splitlines()

    def block(title: str, columns: int) -> list[FloatArray]:
        starts = [i for i, line in enumerate(lines) if title in line]
        return [_rows(lines[i + 1 : i + 9], 4, columns, title) for i in starts]

    longitudinal, lateral = (
        block(f"{word} state matrix", 4) for word in ("Longitudinal", "Lateral")
    )
    controls = [block(f"{word} control matrix", 1) for word in ("Longitudinal", "Lateral")]
    require(
        len(longitudinal) == len(lateral) == 1,
        "state matrices",
        f"{len(longitudinal)} of them",
        "a log of one analysis",
    )
    require(
        len(controls[0]) == len(controls[1]) > 0,
        "control matrices",
        "none",
        "an analysis with controls (polar of type 7)",
    )
    A = np.block([[longitudinal[0], np.zeros((4, 4))], [np.zeros((4, 4)), lateral[0]]])
    B = np.vstack([np.hstack(blocks) for blocks in controls])
    sets = re.findall(r"Control [Mm]atrices for set (\S+)", text)
    channels = _inputs(inputs, [_control(name) for name in sets], B.shape[1])
    V0 = float(np.hypot(A[1, 2], A[0, 2]))
    return ToolModel(
        _states(states, ["u", "w", "q", "theta", "v", "p", "r", "phi"], 8),
        channels,
        A,
        B,
        speed=V0,
        note="XFLR5's matrices",
    )


def _control(name: str) -> str:
    """Return elevator, aileron or rudder for a name that begins like it, otherwise the name."""
    return next(
        (full for full in ("elevator", "aileron", "rudder") if name.lower().startswith(full[:3])),
        name,
    )


def _avl_header(text: str) -> tuple[int, list[str], list[str]] | None:
    """Find the header of AVL's system matrix: its line number, the states and the controls."""
    for i, line in enumerate(text.splitlines()):
        words = line.replace("|", " | ").split()
        if words[:4] == ["u", "w", "q", "the"]:
            bar = words.index("|") if "|" in words else len(words)
            return i, words[:bar], words[bar + 1 :]
    return None


def _avl_matrix(
    text: str,
    header: tuple[int, list[str], list[str]],
    states: Mapping[str, Any],
    inputs: Mapping[str, Any],
    speed: float | None,
) -> ToolModel:
    """Read AVL's system matrix, SI.

    The axes are x forward and z down, or x aft and z up, whichever fits physics.
    """
    line, names, controls = header
    require(
        bool(controls),
        "system matrix",
        "no controls after the states",
        "a geometry with CONTROL lines",
    )
    n = len(names)
    m = len(controls)
    table = _rows(
        [row.replace("|", " ") for row in text.splitlines()[line + 1 :]], n, n + m, "system matrix"
    )
    dynamic = [i for i, name in enumerate(names) if name not in POSITIONS]
    A = table[np.ix_(dynamic, dynamic)]
    B = table[dynamic][:, n:]
    units = _states(states, [names[i] for i in dynamic], len(dynamic))
    channels = _inputs(inputs or {_control(name): "deg" for name in controls}, (), m)
    V0 = float(np.hypot(A[1, 2], A[0, 2])) if speed is None else speed
    flip = np.array([-1.0 if name in {"u", "w", "p", "r", "phi"} else 1.0 for name in units])
    aft = ToolModel(
        units,
        channels,
        flip[:, None] * A * flip,
        flip[:, None] * B,
        speed=V0,
        note="AVL's system matrix, its axes turned",
    )
    forward = ToolModel(units, channels, A, B, speed=V0, note="AVL's system matrix")
    w, q = (list(units).index(name) for name in ("w", "q"))
    return forward if A[w, q] > 0.0 else aft


BODY = {
    "mass": "kg",
    "Ixx": "kg*m^2",
    "Iyy": "kg*m^2",
    "Izz": "kg*m^2",
    "Ixz": "kg*m^2",
    "density": "kg/m^3",
}
"""Values of the aircraft, with units, that AVL's file of derivatives lacks. Ixz is 0 by default."""
DERIVATIVES = "Sref Cref Bref Alpha CLtot CDtot CLa CYb Clb Cma Cnb CYp Clp Cnp CLq Cmq CYr Clr Cnr"


def _avl_derivatives(
    text: str, inputs: Mapping[str, Any], speed: float | None, body: Mapping[str, str | float]
) -> ToolModel:
    """Derive linear equations about level flight in stability axes from AVL's derivatives.

    Derivatives with respect to alpha_dot are left out. Source: R. C. Nelson, Flight Stability and
    Automatic Control, 2nd ed. (1998), tables 3.5, 3.6, eqs. (4.51), (5.33).
    """
    if speed is None:
        raise ParameterError("speed: found none, expected the trim speed beside AVL's derivatives")
    mass, Ixx, Iyy, Izz, Ixz, rho, length = _avl_body(body)
    value = _avl_values(text)
    S, c, b = value["Sref"] * length**2, value["Cref"] * length, value["Bref"] * length
    V0, alpha, CL, CD = speed, np.radians(value["Alpha"]), value["CLtot"], value["CDtot"]
    qS = 0.5 * rho * V0**2 * S
    weights = qS * CL / (mass * GRAVITY)
    level = "1: speed, mass and density of level flight at this CL"
    require(0.8 < weights < 1.25, "CLtot", f"a lift of {weights:.3g} times the weight", level)
    CD_CL = 2.0 * CL * S / (np.pi * b**2 * value.get("e", 0.8))  # derivative of the induced drag
    CD_alpha = value.get("CDa", CD_CL * value["CLa"])
    # Inertias of the stability axes.
    cosine, sine = np.cos(alpha), np.sin(alpha)
    Ix = Ixx * cosine**2 + Izz * sine**2 - 2.0 * Ixz * sine * cosine
    Iz = Ixx * sine**2 + Izz * cosine**2 + 2.0 * Ixz * sine * cosine
    cross = 0.5 * (Ixx - Izz) * np.sin(2.0 * alpha) + Ixz * np.cos(2.0 * alpha)
    inverse = np.linalg.inv(np.array([[Ix, -cross], [-cross, Iz]]))
    per_V, half_c, half_b = qS / (mass * V0), c / (2.0 * V0), b / (2.0 * V0)
    # lengths that multiply the derivatives with respect to beta, p and r
    scale = np.array([1.0, half_b, half_b])
    lateral = np.array([[value[f"C{row}{by}"] for by in "bpr"] for row in "Yln"]) * scale
    # Longitudinal motion V, alpha, q, theta, then lateral motion beta, p, r, phi.
    A = np.zeros((8, 8))
    A[0, [0, 1, 3]] = -2.0 * CD * per_V, GRAVITY - qS / mass * CD_alpha, -GRAVITY
    A[1, :3] = -2.0 * CL / V0, -(value["CLa"] + CD), -value["CLq"] * half_c
    A[1, :3] *= per_V
    A[1, 2] += 1.0
    A[2, 1:3] = qS * c / Iyy * value["Cma"], qS * c / Iyy * value["Cmq"] * half_c
    A[3, 2] = A[7, 5] = 1.0
    A[4, 4:7] = per_V * lateral[0] - [0.0, 0.0, 1.0]
    A[4, 7] = GRAVITY / V0
    A[5:7, 4:7] = qS * b * inverse @ lateral[1:]
    controls = _avl_controls(text, inputs)
    B = np.zeros((8, len(controls)))
    for k, number in enumerate(controls.values()):
        lift, side, roll, pitch, yaw = (
            value.get(f"C{row}d{number}", value.get(f"C{row}d{number:02d}", 0.0)) for row in "LYlmn"
        )
        B[:3, k] = -CD_CL * lift * qS / mass, -per_V * lift, qS * c / Iyy * pitch
        B[4, k] = per_V * side
        B[5:7, k] = qS * b * inverse @ np.array([roll, yaw])
    units = _states({}, ["V", "alpha", "q", "theta", "beta", "p", "r", "phi"], 8)
    channels = _inputs({name: inputs.get(name) or "deg" for name in controls}, (), len(controls))
    note = "AVL's stability derivatives, without the ones by alpha_dot"
    return ToolModel(units, channels, A, B, speed=V0, note=note)


def _avl_body(body: Mapping[str, str | float]) -> list[float]:
    """Return the values of BODY in SI, and AVL's unit of length in m."""
    if unknown := [key for key in body if key not in {*BODY, "length"}]:
        raise ParameterError(
            f"{unknown[0]}: unknown, expected {one_of([*BODY, 'length'], unknown[0])}"
        )
    if missing := [key for key in BODY if key not in body and key != "Ixz"]:
        raise ParameterError(
            f"{missing[0]}: found none, expected it beside AVL's derivatives, as in "
            f"{missing[0]} 3.2 {BODY[missing[0]]}"
        )
    values = {key: in_si(body.get(key, 0.0), key, unit) for key, unit in BODY.items()}
    for key, number in values.items():
        require(number > 0.0 or key == "Ixz", key, f"{number:g}", "more than 0")
    length = body.get("length", 1.0)
    unit = f"1 {length}" if isinstance(length, str) else length
    return [*values.values(), in_si(unit, "length", "m")]


def _avl_values(text: str) -> dict[str, float]:
    """Read the file that AVL's command ST writes, and return its numbers by name."""
    require(
        "X aft" not in text,
        "axes",
        "geometric axes, x aft",
        "standard axes, x forward (OPER, option O)",
    )
    pairs = re.findall(r"([A-Za-z][A-Za-z0-9']*)\s*=\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)", text)
    value = {key: float(number) for key, number in pairs}
    absent = ", ".join(key for key in DERIVATIVES.split() if key not in value)
    require(not absent, "stability derivatives", f"no {absent}", "the file of the command ST")
    return value


def _avl_controls(text: str, inputs: Mapping[str, Any]) -> dict[str, int]:
    """Return the numbers of controls in AVL's file, by name.

    The names are taken from `inputs`. If there are no inputs, they are the usual ones.
    """
    numbers = {
        _control(name): int(number) for name, number in re.findall(r"(\S+)\s+d0?(\d+)\b", text)
    }
    controls = {name: numbers[name] for name in (inputs or MOVES) if name in numbers}
    names_text = ", ".join(numbers) or "none"
    require(
        bool(controls),
        "inputs",
        f"the controls {names_text}",
        "elevator, aileron or rudder, or the names of yours as inputs",
    )
    return controls
