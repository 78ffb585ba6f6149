# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Airframes from the models of other tools: python-control, SciPy, MATLAB, AVL, XFLR5, and matrices
with named states.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from aircraft_sim import identities
from aircraft_sim.airframe import Airframe, load_airframe
from flight_core.arguments import as_path
from flight_core.files import read_file
from flight_core.parameters import ParameterError, one_of, require
from flight_core.units import GRAVITY, in_si, quantity
from flight_core.vectors import FloatArray

Named = str | Mapping[str, Any] | Sequence[str]
"""Names with units: "u: ft/s, w: ft/s", a dictionary, or a list of names of states in SI."""

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
AIR = {"longitudinal": ("V", "u"), "lateral": ("beta", "v"), "vertical": ("alpha", "w")}
"""By axis of the wind the states that measure motion relative to the air."""
MOVES = {
    "elevator": ("q", "nose up", "nose down"),
    "aileron": ("p", "roll right", "roll left"),
    "rudder": ("r", "nose right", "nose left"),
    "thrust": ("V", "more thrust", "less thrust"),
    "throttle": ("V", "more thrust", "less thrust"),
}
"""Output that an input drives, and what it does if positive, by the sign of B."""


class Model(NamedTuple):
    """Matrices of a tool, in the units of `states` and `inputs`."""

    states: dict[str, str]  # units
    inputs: dict[str, dict[str, str]]  # unit, and positive: the effect, if it is stated
    A: FloatArray
    B: FloatArray
    C: FloatArray | None = None
    D: FloatArray | None = None
    outputs: tuple[str, ...] = ()  # names of the rows of C
    speed: float | None = None  # m/s
    note: str = ""  # of what the file was read as


def import_airframe(
    source: Any,
    *,
    name: str = "",
    speed: str | float | None = None,
    states: Named = (),
    inputs: Named = (),
    outputs: str | Sequence[str] = (),
    thrust: bool = False,
    text: str = "",
    **body: str | float,
) -> tuple[Airframe, str]:
    """An airframe from the model of another tool, checked against physics, and a sentence on what
    it was made of.

    Args:
        source: A state space of python-control or SciPy, or the path of a MATLAB file (.mat), of an
            airframe file (.yaml), or of a text of AVL (system matrix, or stability derivatives) or
            XFLR5 (state matrices).
        name: Name of the airframe; empty: that of the file.
        speed: Trim speed, a number in m/s or with a unit: "176 ft/s".
        states: Names of the states in the order of A, with units: "u: ft/s, w: ft/s, q: rad/s,
            theta: rad".
        inputs: Names of the inputs in the order of B, with units and effects: "elevator: rad nose
            down, thrust: 1 more thrust".
        outputs: As many as inputs, or fewer: names of states or of rows of C with units ("V:
            ft/s"), or sums: "q, V = 0.987 u + 0.163 w".
            Empty: q, V, p, r by elevator, thrust, aileron, rudder.
        thrust: Whether to add an input thrust in units of the weight along the flight path, for a
            model without a thrust.
        text: Where the figures come from.
        body: mass, Ixx, Iyy, Izz, Ixz, density of the aircraft of AVL's derivatives, and its unit
            of length, `length`.

    Raises ParameterError with one sentence.
    """
    label = str(source) if isinstance(source, str | Path) else type(source).__name__
    entered_speed = None if speed is None else in_si(speed, "speed", "m/s")
    if isinstance(source, str | Path) and Path(source).suffix in {".yaml", ""}:
        options = {
            "speed": speed,
            "states": states,
            "inputs": inputs,
            "outputs": outputs,
            "thrust": thrust,
            "text": text,
            **body,
        }
        for key, value in options.items():
            require(not value, key, f"{value!r} beside an airframe file", "none: the file has it")
        loaded = load_airframe(source)
        return (
            loaded.model_copy(update={"name": name}) if name else loaded
        ), f"airframe file {label}"
    named_states = _named(states, "states")
    named_inputs = _named(inputs, "inputs")
    model = _model(source, named_states, named_inputs, entered_speed, body)
    speed_used = entered_speed if entered_speed is not None else model.speed
    if speed_used is None:
        raise ParameterError("speed: found none, expected the trim speed, as 53.6 or 176 ft/s")
    title = name or Path(label).stem
    effects = {key: channel.get("positive", "") for key, channel in model.inputs.items()}
    units = tuple(channel["unit"] for channel in model.inputs.values())
    none = np.zeros_like(model.A)
    identities.check(
        identities.Model(title, model.states, effects, units, speed_used, model.A, model.B, none)
    )
    if thrust:
        model = _with_thrust(model)
    frame = _airframe(
        model, title, speed_used, outputs, text or f"{model.note or 'matrices'} of {label}"
    )
    return frame, model.note or f"matrices of {label}"


def _named(names: Named, key: str) -> dict[str, Any]:
    """Names and what is said of each; {} for none."""
    if isinstance(names, str):
        parts = [part.strip() for part in names.split(",")] if names.strip() else []
        split = [(part.partition(":")[0].strip(), part.partition(":")[2].strip()) for part in parts]
        require(len({name for name, _ in split}) == len(split), key, names, "each name once")
        return dict(split)
    if isinstance(names, Mapping):
        return dict(names)
    return dict.fromkeys(names, "")


def _states(named: Mapping[str, Any], labels: Sequence[str], n: int) -> dict[str, str]:
    """Units of the n states: as given, else by the names that the model carries."""
    names = named or dict.fromkeys(labels, "")
    known = ", ".join(names) or "no names"
    require(
        len(names) == n,
        "states",
        f"{known} beside {n} rows of A",
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


def _inputs(named: Mapping[str, Any], labels: Sequence[str], m: int) -> dict[str, dict[str, str]]:
    """Units and effects of the m inputs: as given ("rad nose down"), else rad, and 1 for thrust."""
    names = named or dict.fromkeys(labels, "")
    known = ", ".join(names) or "no names"
    require(
        len(names) == m,
        "inputs",
        f"{known} beside {m} columns of B",
        f"{m} names in the order of B: elevator: rad, ...",
    )
    read = {}
    for name, said in names.items():
        if isinstance(said, Mapping):
            read[name] = {key: str(value) for key, value in said.items()}
            continue
        unit, _, positive = str(said).strip().partition(" ")
        unit = unit or ("1" if name in {"thrust", "throttle"} else "rad")
        quantity(unit, f"inputs.{name}")
        read[name] = {"unit": unit, "positive": positive.strip()}
    return read


def _model(
    source: Any,
    states: Mapping[str, Any],
    inputs: Mapping[str, Any],
    speed: float | None,
    body: Mapping[str, str | float],
) -> Model:
    no_body = "none: it belongs to AVL's stability derivatives"
    if not isinstance(source, str | Path):
        require(not body, next(iter(body), ""), "it beside a state space", no_body)
        return _state_space(source, states, inputs)
    path = as_path(source, "source", "a state space, or the path of a file")
    content = read_file(path, f"model {path}", "a model: .mat, .yaml, or a text of AVL or XFLR5")
    if path.suffix == ".mat":
        require(not body, next(iter(body), ""), "it beside a MAT-file", no_body)
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
    require(not body, next(iter(body), ""), f"it beside {path.name}", no_body)
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


def _state_space(system: Any, states: Mapping[str, Any], inputs: Mapping[str, Any]) -> Model:
    """python-control's and SciPy's StateSpace, by their attributes."""
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

    named = labels("state_labels")
    driven = labels("input_labels")
    known = _states(states, named, len(A)), _inputs(inputs, driven, B.shape[1])
    return Model(
        *known, A, B, _finite(system.C, "C"), _finite(system.D, "D"), tuple(labels("output_labels"))
    )


def _matlab(path: Path, states: Mapping[str, Any], inputs: Mapping[str, Any]) -> Model:
    """A, B, C, D of a .mat file, or of a structure in the file; names in StateName, InputName,
    OutputName.
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
    known = (
        _states(states, names("StateName", "states", "state_names"), len(A)),
        _inputs(inputs, names("InputName", "inputs", "input_names"), B.shape[1]),
    )
    return Model(
        *known,
        A,
        B,
        C,
        D,
        tuple(names("OutputName", "outputs", "output_names")),
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


def _xflr5(text: str, states: Mapping[str, Any], inputs: Mapping[str, Any]) -> Model:
    """Both 4 x 4 matrices of XFLR5's log, SI; the control matrices are per rad, a set of both a
    control.
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
    return Model(
        _states(states, ["u", "w", "q", "theta", "v", "p", "r", "phi"], 8),
        channels,
        A,
        B,
        speed=V0,
        note="XFLR5's matrices",
    )


def _control(name: str) -> str:
    """elevator, aileron or rudder for a name that begins like these, else the name."""
    return next(
        (full for full in ("elevator", "aileron", "rudder") if name.lower().startswith(full[:3])),
        name,
    )


def _avl_header(text: str) -> tuple[int, list[str], list[str]] | None:
    """Line, states and controls of the header of AVL's system matrix."""
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
) -> Model:
    """AVL's system matrix, SI: the axes are those that physics confirms, x forward and z down, or x
    aft and z up.
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
    aft = Model(
        units,
        channels,
        flip[:, None] * A * flip,
        flip[:, None] * B,
        speed=V0,
        note="AVL's system matrix, its axes turned",
    )
    forward = Model(units, channels, A, B, speed=V0, note="AVL's system matrix")
    w, q = (list(units).index(name) for name in ("w", "q"))
    return forward if A[w, q] > 0.0 else aft


def _avl_derivatives(
    text: str, inputs: Mapping[str, Any], speed: float | None, body: Mapping[str, str | float]
) -> Model:
    """Linear equations about level flight in stability axes from AVL's stability derivatives,
    without those of alpha_dot.

    Source: R. C. Nelson, Flight Stability and Automatic Control, 2nd ed. (1998), tables 3.5, 3.6,
    eqs. (4.51), (5.33).
    """
    pairs = re.findall(r"([A-Za-z][A-Za-z0-9']*)\s*=\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)", text)
    value = {key: float(number) for key, number in pairs}
    dimensions = {
        "mass": "kg",
        "Ixx": "kg*m^2",
        "Iyy": "kg*m^2",
        "Izz": "kg*m^2",
        "Ixz": "kg*m^2",
        "density": "kg/m^3",
    }
    if unknown := [key for key in body if key not in {*dimensions, "length"}]:
        raise ParameterError(
            f"{unknown[0]}: unknown, expected {one_of([*dimensions, 'length'], unknown[0])}"
        )
    if missing := [key for key in dimensions if key not in body and key != "Ixz"]:
        raise ParameterError(
            f"{missing[0]}: found none, expected it beside AVL's derivatives, as in "
            f"{missing[0]} 3.2 {dimensions[missing[0]]}"
        )
    if speed is None:
        raise ParameterError("speed: found none, expected the trim speed beside AVL's derivatives")
    require(
        "X aft" not in text,
        "axes",
        "geometric axes, x aft",
        "standard axes, x forward (OPER, option O)",
    )
    mass, Ixx, Iyy, Izz, Ixz, rho = (
        in_si(body.get(key, 0.0), key, unit) for key, unit in dimensions.items()
    )
    for key, number in (("mass", mass), ("Ixx", Ixx), ("Iyy", Iyy), ("Izz", Izz), ("density", rho)):
        require(number > 0.0, key, f"{number:g}", "more than 0")
    needed = ["Sref", "Cref", "Bref", "Alpha", "CLtot", "CDtot", "CLa", "CYb", "Clb", "Cma", "Cnb"]
    needed += ["CYp", "Clp", "Cnp", "CLq", "Cmq", "CYr", "Clr", "Cnr"]
    absent = [key for key in needed if key not in value]
    require(
        not absent, "stability derivatives", f"no {', '.join(absent)}", "the file of the command ST"
    )
    length = in_si(
        body.get("length", 1.0)
        if not isinstance(body.get("length"), str)
        else f"1 {body['length']}",
        "length",
        "m",
    )
    S, c, b = value["Sref"] * length**2, value["Cref"] * length, value["Bref"] * length
    V0, alpha, CL, CD = speed, np.radians(value["Alpha"]), value["CLtot"], value["CDtot"]
    qS = 0.5 * rho * V0**2 * S
    lift = qS * CL / (mass * GRAVITY)
    level = "1: speed, mass and density of level flight at this CL"
    require(0.8 < lift < 1.25, "CLtot", f"a lift of {lift:.3g} times the weight", level)
    CD_alpha = value.get("CDa", 2.0 * CL * value["CLa"] * S / (np.pi * b**2 * value.get("e", 0.8)))
    cosine, sine = np.cos(alpha), np.sin(alpha)  # inertias of stability axes
    Ix = Ixx * cosine**2 + Izz * sine**2 - 2.0 * Ixz * sine * cosine
    Iz = Ixx * sine**2 + Izz * cosine**2 + 2.0 * Ixz * sine * cosine
    cross = 0.5 * (Ixx - Izz) * np.sin(2.0 * alpha) + Ixz * np.cos(2.0 * alpha)
    inverse = np.linalg.inv(np.array([[Ix, -cross], [-cross, Iz]]))
    per_V, half_c, half_b = qS / (mass * V0), c / (2.0 * V0), b / (2.0 * V0)
    A = np.zeros((8, 8))
    A[0, [0, 1, 3]] = -2.0 * CD * per_V, GRAVITY - qS / mass * CD_alpha, -GRAVITY
    A[1, :3] = (
        -2.0 * CL * per_V / V0,
        -per_V * (value["CLa"] + CD),
        1.0 - per_V * value["CLq"] * half_c,
    )
    A[2, 1:3] = qS * c / Iyy * value["Cma"], qS * c / Iyy * value["Cmq"] * half_c
    A[3, 2] = A[7, 5] = 1.0
    A[4, 4:] = (
        value["CYb"] * per_V,
        value["CYp"] * half_b * per_V,
        value["CYr"] * half_b * per_V - 1.0,
        GRAVITY / V0,
    )
    moments = np.array(
        [
            [value[f"C{row}b"], value[f"C{row}p"] * half_b, value[f"C{row}r"] * half_b]
            for row in "ln"
        ]
    )
    A[5:7, 4:7] = qS * b * inverse @ moments
    used = _avl_controls(text, inputs)
    B = np.zeros((8, len(used)))
    for k, number in enumerate(used.values()):
        effects = {
            row: value.get(f"C{row}d{number}", value.get(f"C{row}d{number:02d}", 0.0))
            for row in "LYlmn"
        }
        B[1, k], B[2, k], B[4, k] = (
            -per_V * effects["L"],
            qS * c / Iyy * effects["m"],
            per_V * effects["Y"],
        )
        B[0, k] = -2.0 * CL * effects["L"] * S / (np.pi * b**2 * value.get("e", 0.8)) * qS / mass
        B[5:7, k] = qS * b * inverse @ np.array([effects["l"], effects["n"]])
    units = _states({}, ["V", "alpha", "q", "theta", "beta", "p", "r", "phi"], 8)
    channels = _inputs({name: inputs.get(name) or "deg" for name in used}, (), len(used))
    return Model(
        units,
        channels,
        A,
        B,
        speed=V0,
        note="AVL's stability derivatives, without those of alpha_dot",
    )


def _avl_controls(text: str, inputs: Mapping[str, Any]) -> dict[str, int]:
    """The controls of AVL by number, of those that are named or have a name of the field."""
    numbered = {
        _control(name): int(number) for name, number in re.findall(r"(\S+)\s+d0?(\d+)\b", text)
    }
    used = {name: numbered[name] for name in (inputs or MOVES) if name in numbered}
    known = ", ".join(numbered) or "none"
    require(
        bool(used),
        "inputs",
        f"the controls {known}",
        "elevator, aileron or rudder, or the names of yours as inputs",
    )
    return used


def _with_thrust(model: Model) -> Model:
    """The model with an input thrust: V_dot, or u_dot, = g, in units of the weight along the flight
    path.
    """
    require(
        "thrust" not in model.inputs, "thrust", "an input thrust in the model", "none to add one"
    )
    state = next((name for name in AIR["longitudinal"] if name in model.states), None)
    if state is None:
        raise ParameterError(f"thrust: found the states {', '.join(model.states)}, expected V or u")
    column = np.zeros((len(model.A), 1))
    column[list(model.states).index(state)] = GRAVITY / quantity(model.states[state]).si
    channel = {"unit": "1", "positive": "more thrust, in units of the weight"}
    D = None if model.D is None else np.hstack([model.D, np.zeros((len(model.D), 1))])
    return model._replace(
        inputs=model.inputs | {"thrust": channel}, B=np.hstack([model.B, column]), D=D
    )


def _airframe(
    model: Model, name: str, speed: float, outputs: str | Sequence[str], source: str
) -> Airframe:
    names = list(model.states)
    wanted = (
        [part.strip() for part in outputs.split(",")]
        if isinstance(outputs, str) and outputs
        else list(outputs)
    )
    wanted = wanted or _default_outputs(model)
    fewer = f"{len(model.inputs)} or fewer, as many as inputs or fewer"
    require(0 < len(wanted) <= len(model.inputs), "outputs", ", ".join(wanted) or "none", fewer)
    rows = []
    shown = []
    units = {}
    identity = (
        model.C is not None
        and model.C.shape == (len(names),) * 2
        and np.array_equal(model.C, np.eye(len(names)))
    )
    labels = model.outputs if model.C is not None and len(model.outputs) == len(model.C) else ()
    for k, text in enumerate(wanted):
        output, unit, row = _output(text, names)
        if row is None and model.C is not None and not identity and output in labels:
            row = model.C[labels.index(output)]
        elif (
            row is None
            and model.C is not None
            and not identity
            and not labels
            and len(model.C) == len(wanted)
        ):
            row = model.C[k]
        elif row is None:
            if output not in names:
                raise ParameterError(
                    f"outputs: found {output!r}, expected {one_of(names, output)}, a row of C, "
                    "or a sum: V = 0.99 u + 0.1 w"
                )
            row = np.eye(len(names))[names.index(output)]
        rows.append(row)
        shown.append(output)
        if output not in names:
            terms = {
                model.states[state]
                for state, factor in zip(names, row, strict=True)
                if factor != 0.0
            }
            units[output] = unit or (terms.pop() if len(terms) == 1 else "")
    selects = all(
        output in names and np.array_equal(row, np.eye(len(names))[names.index(output)])
        for output, row in zip(shown, rows, strict=True)
    )
    values: dict[str, Any] = {
        "name": name,
        "source": source,
        "speed": speed,
        "states": model.states,
        "inputs": {
            key: channel | {"positive": channel.get("positive") or _effect(model, key)}
            for key, channel in model.inputs.items()
        },
        "outputs": shown,
        "A": model.A.tolist(),
        "B": model.B.tolist(),
    }
    if not selects:
        values |= {"C": np.array(rows).tolist(), "output_units": units}
    if model.D is not None and np.any(model.D):
        used = [labels.index(output) for output in shown if output in labels] or list(
            range(len(model.D))
        )
        values["D"] = model.D[used].tolist()
    frame = Airframe.validate_mapping(values, f"airframe {name}")
    return Airframe.validate_mapping(
        frame.model_dump(exclude_defaults=True) | {"gusts": _gusts(frame)}, f"airframe {name}"
    )


def _output(text: str, names: Sequence[str]) -> tuple[str, str, FloatArray | None]:
    """Name, unit and row of C of an output: "q", "V: ft/s", "V = 0.987 u + 0.163 w"."""
    name, equals, terms = (part.strip() for part in text.partition("="))
    if not equals:
        name, _, unit = (part.strip() for part in text.partition(":"))
        return name, unit, None
    row = np.zeros(len(names))
    parts = re.findall(r"([-+]?)\s*(\d*\.?\d*(?:[eE][-+]?\d+)?)\s*\*?\s*([A-Za-z_]\w*)", terms)
    spelled = "".join(f"{sign}{factor}{state}" for sign, factor, state in parts)
    require(
        spelled == re.sub(r"[\s*]", "", terms) != "",
        "outputs",
        repr(text),
        "a sum of states, as V = 0.987 u + 0.163 w",
    )
    for sign, factor, state in parts:
        require(state in names, "outputs", repr(text), f"states: {', '.join(names)}")
        row[names.index(state)] += (-1.0 if sign == "-" else 1.0) * float(factor or 1.0)
    return name, "", row


def _default_outputs(model: Model) -> list[str]:
    """q, V, p, r by elevator, thrust, aileron, rudder; V = u cos(alpha_0) + w sin(alpha_0) of body
    axes, by u_dot = -W0 q.
    """
    outputs = []
    for name in model.inputs:
        output = MOVES[name][0] if name in MOVES else ""
        if output == "V" and "V" not in model.states and {"u", "w", "q"} <= model.states.keys():
            u, w, q = (list(model.states).index(state) for state in ("u", "w", "q"))
            alpha = float(np.arctan2(-model.A[u, q], model.A[w, q]))
            output = (
                f"V = {np.cos(alpha):.6f} u {'-' if alpha < 0.0 else '+'} "
                f"{abs(np.sin(alpha)):.6f} w"
            )
        require(
            bool(output),
            "outputs",
            f"none beside the input {name}",
            "an output for each input, as in q, V",
        )
        outputs.append(output)
    return outputs


def _effect(model: Model, name: str) -> str:
    """What a positive value of an input does, from the sign of B."""
    state, up, down = MOVES.get(name, ("", "", ""))
    state = "u" if state == "V" and "V" not in model.states else state
    if state not in model.states:
        return "not stated"
    value = model.B[list(model.states).index(state), list(model.inputs).index(name)]
    return up if value > 0.0 else down if value < 0.0 else "not stated"


def _gusts(frame: Airframe) -> dict[str, dict[str, float]]:
    """What wind adds to x_dot, per w / V0: minus the column of the state that moves relative to the
    air; not to angles, h.
    """
    A = frame.matrix_a()
    names = list(frame.states)
    gusts = {}
    for axis, states in AIR.items():
        state = next((state for state in states if state in names), None)
        if state is not None:
            per_speed = 1.0 if state in {"alpha", "beta"} else frame.speed
            column = -A[:, names.index(state)] * per_speed
            moved = {
                name: float(f"{value:.6g}")
                for name, value in zip(names, column, strict=True)
                if value != 0.0
            }
            gusts[axis] = {
                name: value
                for name, value in moved.items()
                if name not in {"theta", "phi", "psi", "h", "altitude"}
            }
    return gusts
