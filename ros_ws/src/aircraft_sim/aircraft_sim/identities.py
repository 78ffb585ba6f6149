# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What physics fixes in the matrices of an aircraft: kinematics, gravity, trim speed, the sign and
the size of a control.

The names of the states say what they are: V, u, v, w speeds, alpha, beta, theta, phi, psi angles,
p, q, r angular rates, h a height; FRD axes. A state of a different name is not checked, but VT
and further names of these are refused. Source of the identities: the linear equations of motion
about straight flight, B. L. Stevens, F. L. Lewis, Aircraft Control and Simulation, 2nd ed. (2003),
sec. 3.7; B. Etkin, L. D. Reid, Dynamics of Flight, 3rd ed. (1996), eq. (4.9,18).
"""

from collections.abc import Iterator, Mapping
from itertools import chain, combinations
from typing import NamedTuple

import numpy as np

from flight_core.parameters import ParameterError
from flight_core.units import ANGLE, ANGULAR_RATE, FOOT, GRAVITY, LENGTH, SPEED, quantity
from flight_core.vectors import FloatArray

KINDS = {
    **dict.fromkeys(("V", "u", "v", "w"), (SPEED, "a speed, as m/s, ft/s or kt")),
    **dict.fromkeys(("alpha", "beta", "theta", "phi", "psi"), (ANGLE, "an angle, as rad or deg")),
    **dict.fromkeys(("p", "q", "r"), (ANGULAR_RATE, "an angular rate, as rad/s or deg/s")),
    **dict.fromkeys(("h", "altitude"), (LENGTH, "a height, as m or ft")),
}
"""Dimension of the states that have a name of the field."""
OF_RATES = {
    "theta": "q r phi",
    "phi": "p q r theta phi",
    "psi": "q r theta phi",
    "h": None,
    "altitude": None,
}
"""States whose derivative no force changes, and the named states that enter it; None: any."""

TURNED = (0.7, 1.02)
COUPLED = (0.6, 1.35)
LIFT = (0.3, 2.8)
"""Accepted parts of an expected value: cos of a trim angle up to 45 deg; of V0 with the force of a
rate, Z_q or Y_r; of the change of lift = weight with speed, which compressibility and thrust
change: published aircraft have 0.78 to 1.02."""
FOREIGN = 0.02  # 1, the largest entry of an unrelated state in the row of an angle, SI
EXPECTED: Mapping[tuple[str, str], tuple[float, str, tuple[float, float]]] = {
    ("theta", "q"): (1.0, "", TURNED),
    ("phi", "p"): (1.0, "", TURNED),
    ("psi", "r"): (1.0, "", (0.95, 1.5)),
    ("V", "theta"): (-1.0, "g", TURNED),
    ("u", "theta"): (-1.0, "g", TURNED),
    ("v", "phi"): (1.0, "g", TURNED),
    ("beta", "phi"): (1.0, "g/V0", COUPLED),
    ("w", "q"): (1.0, "V0", COUPLED),
    ("v", "r"): (-1.0, "V0", COUPLED),
    ("alpha", "q"): (1.0, "", COUPLED),
    ("beta", "r"): (-1.0, "", COUPLED),
    ("alpha", "V"): (-1.0, "2 g/V0^2", LIFT),
    ("w", "V"): (-1.0, "2 g/V0", LIFT),
    ("h", "theta"): (1.0, "V0", COUPLED),
    ("h", "alpha"): (-1.0, "V0", COUPLED),
    ("h", "w"): (-1.0, "", TURNED),
}
"""Entries of A by row and column: sign, value in SI, and accepted parts; about straight flight
without bank."""

EFFECTS = {
    "nose down": ("q", -1.0), "pitch down": ("q", -1.0), "nose up": ("q", 1.0),
    "pitch up": ("q", 1.0),
    "roll right": ("p", 1.0), "right wing down": ("p", 1.0), "roll left": ("p", -1.0),
    "left wing down": ("p", -1.0),
    "nose right": ("r", 1.0), "yaw right": ("r", 1.0), "nose left": ("r", -1.0),
    "yaw left": ("r", -1.0),
    "more thrust": ("V u", 1.0), "more power": ("V u", 1.0),
}  # fmt: skip
"""What `positive` may say of an input: the states that it moves, and the sign."""

CONTROLS = {
    "elevator": ("q", "alpha w", 0.06, 12.0),
    "aileron": ("p", "beta v", 0.015, 8.0),
    "rudder": ("r", "beta v", 0.015, 8.0),
}
"""By input the rate that it moves, the angle of the flow, and the range of effect / (stiffness +
damping): `_strengths`.

Published aircraft have 0.27 to 3.3, 0.04 to 0.93 and 0.04 to 1.1. A column per deg taken per rad is
57 times off.
"""

FACTORS = {
    "degrees and radians": 180.0 / np.pi,
    "feet and metres": 1.0 / FOOT,
    "knots and m/s": 3600.0 / 1852.0,
    "knots and ft/s": FOOT * 3600.0 / 1852.0,
    "km/h and m/s": 3.6,
    "crad and rad": 100.0,
    "crad and deg": np.pi / 1.8,
}
"""Ratios of units that are taken for each other."""


class Model(NamedTuple):
    """The linear model of an airframe in the units of the file."""

    name: str
    states: Mapping[str, str]  # units
    effects: Mapping[str, str]  # what a positive value of an input does
    inputs: tuple[str, ...]  # units
    speed: float  # V0, m/s
    file_A: FloatArray  # (n, n)
    file_B: FloatArray  # (n, m)
    gravity: FloatArray  # (n, n), SI, sine terms for small angles

    def matrix_a(self) -> FloatArray:
        """A with gravity, SI."""
        unit = np.array([quantity(unit).si for unit in self.states.values()])
        return np.asarray(self.file_A * unit[:, None] / unit + self.gravity)

    def matrix_b(self) -> FloatArray:
        """B, SI."""
        row = np.array([quantity(unit).si for unit in self.states.values()])
        column = np.array([quantity(unit).si for unit in self.inputs])
        return np.asarray(self.file_B * row[:, None] / column)

    @property
    def angular(self) -> frozenset[str]:
        """The inputs that are angles: control surfaces."""
        units = zip(self.effects, self.inputs, strict=True)
        return frozenset(name for name, unit in units if quantity(unit).dimension == ANGLE)


class Finding(NamedTuple):
    """A contradiction: what the file has, what is expected, and a mend where the numbers tell."""

    key: str
    actual: str
    expected: str
    mend: str = ""
    mended: Model | None = None  # the model with the mend


def check(model: Model) -> None:
    """Raise ParameterError for the first contradiction, with the first mend of every contradiction:
    the finding's own, else a rearrangement of A or B.
    """
    findings = list(contradictions(model))
    if not findings:
        return
    key, actual, expected, mend, mended = findings[0]
    simplest = [] if mended is None else [(mend, mended)]
    mends = chain(simplest, rearranged(model))
    mend = next((text for text, changed in mends if not any(contradictions(changed))), mend)
    way_out = f": {mend}" if mend else ""
    skip = "(identities: false in the file skips this check)"
    raise ParameterError(
        f"airframe {model.name}: {key}: found {actual}, expected {expected}{way_out} {skip}"
    )


def contradictions(model: Model) -> Iterator[Finding]:
    """What contradicts physics, units first, then A, then B."""
    yield from _dimensions(model)
    yield from _entries(model)
    yield from _kinematic_rows(model)
    yield from _dampings(model)
    yield from _effects(model)
    yield from _strengths(model)


def rearranged(model: Model) -> Iterator[tuple[str, Model]]:
    """The model with the arrangement of A or B changed, and the sentence that says so."""
    A = model.file_A
    B = model.file_B
    names = list(model.states)
    inputs = list(model.effects)
    units = list(model.states.items())
    yield (
        "A is transposed: write a row a state derivative, a column a state",
        model._replace(file_A=A.T),
    )
    for order in _orders(len(inputs)):
        listed = ", ".join(inputs[k] for k in order)
        yield (
            f"the columns of B have the order {listed}",
            model._replace(file_B=B[:, np.argsort(order)]),
        )
    one_order = "A and B need one order of the states"
    for order in _orders(len(A)):
        listed = ", ".join(names[k] for k in order)
        place = np.argsort(order)
        renamed = model._replace(
            states=dict(units[k] for k in order), gravity=model.gravity[np.ix_(order, order)]
        )
        yield f"the matrices have the states in the order {listed}: name the states so", renamed
        yield f"the rows of A have the order {listed}", model._replace(file_A=A[place])
        yield f"the columns of A have the order {listed}", model._replace(file_A=A[:, place])
        yield f"the rows of B have the order {listed}: {one_order}", model._replace(file_B=B[place])
        both = model._replace(file_A=A[np.ix_(place, place)])
        yield f"A has the states in the order {listed}, unlike B: {one_order}", both


def _orders(count: int) -> Iterator[list[int]]:
    """Orders in which two of the items are exchanged."""
    for i, j in combinations(range(count), 2):
        order = list(range(count))
        order[i], order[j] = j, i
        yield order


def _dimensions(model: Model) -> Iterator[Finding]:
    for name, unit in model.states.items():
        known = "V" if name.lower() == "vt" else name.lower()  # as books have it
        if name not in KINDS and known in KINDS:
            yield Finding(f"states.{name}", name, f"{known}: the name by which a state is checked")
        dimension, words = KINDS.get(name, (None, ""))
        if dimension is not None and quantity(unit).dimension != dimension:
            near = {"w": "alpha", "v": "beta", "alpha": "w", "beta": "v"}.get(name)
            yield Finding(
                f"states.{name}",
                unit,
                words,
                f"a state in {unit} is {near} perhaps" if near else "",
            )


def _entries(model: Model) -> Iterator[Finding]:
    names = list(model.states)
    V0 = model.speed
    values = {
        "": 1.0,
        "g": GRAVITY,
        "V0": V0,
    }
    if V0 > 0.0:
        values |= {
            "g/V0": GRAVITY / V0,
            "2 g/V0": 2.0 * GRAVITY / V0,
            "2 g/V0^2": 2.0 * GRAVITY / V0**2,
        }
    right = dict.fromkeys(values, True)
    for (row, column), (sign, symbol, (least, most)) in EXPECTED.items():
        row = "altitude" if row == "h" and "altitude" in names else row  # noqa: PLW2901 - the two names of a height
        if row not in names or column not in names or (V0 == 0.0 and "V0" in symbol):
            continue
        entry = float(model.matrix_a()[names.index(row), names.index(column)])
        expected = sign * values[symbol]
        left_out = entry == 0.0 and (
            symbol.startswith("2 g") or (symbol == "V0" and not model.angular)
        )  # a multirotor hovers
        if least <= entry / expected <= most or left_out:
            continue
        right[symbol] = False
        key = "A"
        mend = _mend(entry / expected)
        if "V0" in symbol and right["g"] and entry * sign > 0.0:
            fits = f", and A fits {abs(entry):.4g} m/s" if symbol == "V0" else ""
            key = "speed"
            mend = f"speed is in m/s{fits}; {row} and {column} need the units of A"
        about = f"{'-' if sign < 0.0 else ''}{symbol} = {expected:.4g}" if symbol else f"{sign:.0f}"
        yield Finding(key, f"{row}_dot = {entry:.4g} {column} in SI", about, mend)


def _mend(ratio: float) -> str:
    """What a ratio of the found to the expected value tells."""
    if ratio == 0.0:
        return "the entry is missing"
    sign = "the sign is reversed" if ratio < 0.0 else ""
    size = abs(ratio)
    away = {
        words: min(abs(size / factor - 1.0), abs(size * factor - 1.0))
        for words, factor in FACTORS.items()
    }
    nearest = min(away, key=lambda words: away[words])
    if away[nearest] < 0.06:
        return f"{nearest} are mixed up, give each state the unit that A has" + (
            ", and " + sign if sign else ""
        )
    return sign


def _kinematic_rows(model: Model) -> Iterator[Finding]:
    names = list(model.states)
    scale = float(np.max(np.abs(model.matrix_b()), initial=0.0))
    for row in (name for name in OF_RATES if name in names):
        i = names.index(row)
        entering = OF_RATES[row]
        for column in KINDS if entering is not None else ():
            value = (
                float(model.matrix_a()[i, names.index(column)])
                if column in names and column not in str(entering).split()
                else 0.0
            )
            if abs(value) > FOREIGN:
                yield Finding(
                    "A", f"{row}_dot = {value:.4g} {column} in SI", f"no {column} in {row}_dot"
                )
        for k, name in enumerate(model.effects):
            if abs(model.matrix_b()[i, k]) > 1e-6 * scale:
                yield Finding(
                    "B",
                    f"{row}_dot = {model.matrix_b()[i, k]:.4g} {name}",
                    f"0: no input moves {row} at once",
                )


def _dampings(model: Model) -> Iterator[Finding]:
    for i, name in enumerate(model.states):
        damping = float(model.matrix_a()[i, i])
        if name in {"p", "q", "r", "alpha", "beta", "w", "v"} and damping > 0.0:
            yield Finding(
                "A", f"{name}_dot = {damping:.4g} {name}", "0 or less: air damps this motion"
            )


def _effects(model: Model) -> Iterator[Finding]:
    names = list(model.states)
    for k, (name, text) in enumerate(model.effects.items()):
        phrase = next((phrase for phrase in EFFECTS if phrase in text.lower()), None)
        if phrase is None:
            continue
        rows, sign = EFFECTS[phrase]
        row = next((row for row in rows.split() if row in names), None)
        value = 0.0 if row is None else float(model.matrix_b()[names.index(row), k])
        if row is not None and value * sign <= 0.0:
            mend = (
                f"correct `positive`, or the sign of the column {name} of B"
                if value
                else "the entry is missing"
            )
            reversed_column = np.where(np.arange(len(model.inputs)) == k, -1.0, 1.0)
            mended = model._replace(file_B=model.file_B * reversed_column)
            yield Finding(
                f"inputs.{name}",
                f"{row}_dot = {value:.4g} {name} beside {phrase!r}",
                f"{'more' if sign > 0 else 'less'} than 0",
                mend,
                mended if _moves_most(model, row, k) else None,
            )


def _strengths(model: Model) -> Iterator[Finding]:
    """Size of a control: angular acceleration per rad over stiffness + damping, |M_alpha| + |M_q|
    (|M_q| + |Z_alpha|).
    """
    names = list(model.states)
    for k, name in enumerate(model.effects):
        rate, flows, least, most = CONTROLS.get(name, ("", "", 0.0, 0.0))
        flow = next((state for state in flows.split() if state in names), None)
        if name not in model.angular or rate not in names or flow is None:
            continue
        i = names.index(rate)
        j = names.index(flow)
        stiffness = abs(model.matrix_a()[i, j]) * (model.speed if flow in "wv" else 1.0)
        scale = stiffness + abs(model.matrix_a()[i, i]) * (
            abs(model.matrix_a()[i, i]) + abs(model.matrix_a()[j, j])
        )
        ratio = abs(float(model.matrix_b()[i, k])) / scale if scale > 0.0 else least
        if not least <= ratio <= most:
            mend = ""
            mended = None
            units = model.inputs
            for unit in (*model.states.values(), "deg", "rad"):
                factor = quantity(units[k]).si / quantity(unit).si
                if quantity(unit).dimension == ANGLE and least <= ratio * factor <= most:
                    mend = f"B is per {unit}, and the unit {units[k]}?"
                    mended = model._replace(inputs=(*units[:k], unit, *units[k + 1 :]))
                    break
            known = f"{least * scale:.2g} to {most * scale:.2g} for an aircraft with this A"
            yield Finding(
                f"inputs.{name}.unit",
                f"{rate}_dot = {model.matrix_b()[i, k]:.3g} {name} in SI",
                known,
                mend,
                mended,
            )


def _moves_most(model: Model, row: str, k: int) -> bool:
    """Whether no control surface moves a state at once by more than input k."""
    effects = np.abs(model.matrix_b()[list(model.states).index(row)])
    surfaces = [name in model.angular for name in model.effects]
    return bool(effects[k] >= np.max(effects[surfaces], initial=0.0))
