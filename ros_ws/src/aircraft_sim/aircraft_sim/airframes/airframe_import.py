# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Make airframes from the models of other tools.

The tools are python-control, SciPy, MATLAB, AVL, XFLR5, and anything with named matrices.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from aircraft_sim.airframes import identities
from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.airframes.model_readers import MOVES, ToolModel, read_model
from flight_core.parameters import ParameterError, one_of, require
from flight_core.units import GRAVITY, in_si, quantity
from flight_core.vectors import FloatArray

Named = str | Mapping[str, Any] | Sequence[str]
"""Names with units: "u: ft/s, w: ft/s", a dictionary, or a list of names of states in SI."""

AIR = {"longitudinal": ("V", "u"), "lateral": ("beta", "v"), "vertical": ("alpha", "w")}
"""For each axis of the wind, the states that measure motion relative to the air."""


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
    """Make an airframe from a model of another tool.

    Returns the airframe, and a sentence that says how the model was read. The airframe is checked
    against physics.

    Args:
        source: A state space of python-control or SciPy, or the path of a MATLAB file (.mat), of an
            airframe file (.yaml), or of a text of AVL (system matrix, or stability derivatives) or
            XFLR5 (state matrices).
        name: Name of the airframe; if empty, the name of the file.
        speed: Trim speed, a number in m/s or with a unit: "176 ft/s".
        states: Names of the states in the order of A, with units: "u: ft/s, w: ft/s, q: rad/s,
            theta: rad".
        inputs: Names of the inputs in the order of B, with units and effects: "elevator: rad nose
            down, thrust: 1 more thrust".
        outputs: At most as many outputs as inputs. They are names of states, names of rows of C
            with units ("V: ft/s"), or sums: "q, V = 0.987 u + 0.163 w". If empty, they are those of
            q, V, p, r that elevator, thrust, aileron and rudder move.
        thrust: Whether to add an input thrust, in units of the weight along the flight path, to a
            model without a thrust.
        text: Where the numbers of the model come from, as text for the airframe.
        body: mass, Ixx, Iyy, Izz, Ixz and density for the derivatives of AVL, and `length`, AVL's
            unit of length.

    Raises ParameterError with one sentence.
    """
    label = str(source) if isinstance(source, str | Path) else type(source).__name__
    entered_speed = None if speed is None else in_si(speed, "speed", "m/s")
    if isinstance(source, str | Path) and Path(source).suffix in {".yaml", ""}:
        options = {"speed": speed, "states": states, "inputs": inputs, "outputs": outputs}
        options |= {"thrust": thrust, "text": text, **body}
        return _of_file(source, name, options), f"airframe file {label}"
    named_states = _named(states, "states")
    named_inputs = _named(inputs, "inputs")
    model = read_model(source, named_states, named_inputs, entered_speed, body)
    speed_used = entered_speed if entered_speed is not None else model.speed
    if speed_used is None:
        raise ParameterError("speed: found none, expected the trim speed, as 53.6 or 176 ft/s")
    title = name or Path(label).stem
    _check_identities(model, title, speed_used)
    if thrust:
        model = _with_thrust(model)
    frame = _airframe(
        model, title, speed_used, outputs, text or f"{model.note or 'matrices'} of {label}"
    )
    return frame, model.note or f"matrices of {label}"


def _of_file(source: str | Path, name: str, options: Mapping[str, Any]) -> Airframe:
    """Load an airframe file, and rename the airframe if `name` is not empty.

    Raises ParameterError if another option is given.
    """
    for key, value in options.items():
        require(not value, key, f"{value!r} beside an airframe file", "none: the file has it")
    airframe = load_airframe(source)
    return airframe.model_copy(update={"name": name}) if name else airframe


def _named(names: Named, key: str) -> dict[str, Any]:
    """Return the text of the unit of each state or input by its name, with the effect if stated.

    `names` may be such a mapping, a text like "u: ft/s, w: ft/s", or names without units, whose
    texts are then "".
    """
    if isinstance(names, str):
        parts = [part.strip() for part in names.split(",")] if names.strip() else []
        split = [(part.partition(":")[0].strip(), part.partition(":")[2].strip()) for part in parts]
        require(len({name for name, _ in split}) == len(split), key, names, "each name once")
        return dict(split)
    if isinstance(names, Mapping):
        return dict(names)
    return dict.fromkeys(names, "")


def _check_identities(model: ToolModel, name: str, speed: float) -> None:
    """Check that a model obeys the identities of physics at a trim speed in m/s.

    Raises ParameterError if not.
    """
    effects = {key: channel.get("positive", "") for key, channel in model.inputs.items()}
    units = tuple(channel["unit"] for channel in model.inputs.values())
    none = np.zeros_like(model.A)
    identities.check(
        identities.LinearModel(
            name=name,
            states=model.states,
            effects=effects,
            inputs=units,
            speed=speed,
            file_A=model.A,
            file_B=model.B,
            gravity=none,
        )
    )


def _with_thrust(model: ToolModel) -> ToolModel:
    """Add an input `thrust`, a force along the flight path in units of the weight.

    The input adds g times its value to V_dot or u_dot.
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
    model: ToolModel, name: str, speed: float, outputs: str | Sequence[str], source: str
) -> Airframe:
    names = list(model.states)
    if isinstance(outputs, str) and outputs:
        output_names = [part.strip() for part in outputs.split(",")]
    else:
        output_names = list(outputs)
    output_names = output_names or _default_outputs(model)
    fewer = f"{len(model.inputs)} or fewer, as many as inputs or fewer"
    require(
        0 < len(output_names) <= len(model.inputs),
        "outputs",
        ", ".join(output_names) or "none",
        fewer,
    )
    labels = model.outputs if model.C is not None and len(model.outputs) == len(model.C) else ()
    rows, units = _rows_of_outputs(model, output_names, labels)
    outputs_of_rows = list(rows)
    selects = all(
        output in names and np.array_equal(row, np.eye(len(names))[names.index(output)])
        for output, row in rows.items()
    )
    # Write the content of an airframe file, with C and D only if needed.
    values: dict[str, Any] = {
        "name": name,
        "source": source,
        "speed": speed,
        "states": model.states,
        "inputs": {
            key: channel | {"positive": channel.get("positive") or _effect(model, key)}
            for key, channel in model.inputs.items()
        },
        "outputs": outputs_of_rows,
        "A": model.A.tolist(),
        "B": model.B.tolist(),
    }
    if not selects:
        values |= {"C": np.array([*rows.values()]).tolist(), "output_units": units}
    if model.D is not None and np.any(model.D):
        row_numbers = [
            labels.index(output) for output in outputs_of_rows if output in labels
        ] or list(range(len(model.D)))
        values["D"] = model.D[row_numbers].tolist()
    frame = Airframe.validate_mapping(values, f"airframe {name}")
    return Airframe.validate_mapping(
        frame.model_dump(exclude_defaults=True) | {"gusts": _gusts(frame)}, f"airframe {name}"
    )


def _rows_of_outputs(
    model: ToolModel, outputs: Sequence[str], labels: Sequence[str]
) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Return the row of C of each output, and the unit of each output that is no state, by name.

    `labels` name the rows of C in the model.
    """
    names = list(model.states)
    identity = np.eye(len(names))
    own_C = model.C
    if own_C is not None and np.array_equal(own_C, identity):
        own_C = None
    rows: dict[str, FloatArray] = {}
    units = {}
    for k, text in enumerate(outputs):
        output, unit, row = _output(text, names)
        require(output not in rows, "outputs", f"{output} twice", "each once")
        if row is None and own_C is not None and output in labels:
            row = own_C[labels.index(output)]
        elif row is None and own_C is not None and not labels and len(own_C) == len(outputs):
            row = own_C[k]
        elif row is None:
            if output not in names:
                raise ParameterError(
                    f"outputs: found {output!r}, expected {one_of(names, output)}, a row of C, "
                    "or a sum: V = 0.99 u + 0.1 w"
                )
            row = identity[names.index(output)]
        rows[output] = row
        if output not in names:
            terms = {model.states[names[j]] for j in np.flatnonzero(row)}
            units[output] = unit or (terms.pop() if len(terms) == 1 else "")
    return rows, units


def _output(text: str, names: Sequence[str]) -> tuple[str, str, FloatArray | None]:
    """Read name, unit and row of C of an output: "q", "V: ft/s", "V = 0.987 u + 0.163 w"."""
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


def _default_outputs(model: ToolModel) -> list[str]:
    """Return the output of each input: q for elevator, V for thrust, p for aileron, r for rudder.

    In body axes V = u cos(alpha_0) + w sin(alpha_0). The terms of q in u_dot and w_dot give
    alpha_0.
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


def _effect(model: ToolModel, name: str) -> str:
    """Say how a positive value of an input moves the aircraft, from the sign of B."""
    state, up, down = MOVES.get(name, ("", "", ""))
    state = "u" if state == "V" and "V" not in model.states else state
    if state not in model.states:
        return "not stated"
    value = model.B[list(model.states).index(state), list(model.inputs).index(name)]
    if value > 0.0:
        return up
    return down if value < 0.0 else "not stated"


def _gusts(frame: Airframe) -> dict[str, dict[str, float]]:
    """Return the effect of wind on x_dot by axis and state, for the section `gusts` of a file.

    Each effect is the x_dot of a wind w with w / V0 = 1. It is minus the column of A that belongs
    to the state of the motion relative to the air. Wind has no effect on angles and h.
    """
    A = frame.matrix_a()
    names = list(frame.states)
    gusts = {}
    for axis, states in AIR.items():
        state = next((state for state in states if state in names), None)
        if state is not None:
            per_speed = 1.0 if state in {"alpha", "beta"} else frame.speed
            column = -A[:, names.index(state)] * per_speed
            moved_states = {
                name: float(f"{value:.6g}")
                for name, value in zip(names, column, strict=True)
                if value != 0.0
            }
            gusts[axis] = {
                name: value
                for name, value in moved_states.items()
                if name not in {"theta", "phi", "psi", "h", "altitude"}
            }
    return gusts
