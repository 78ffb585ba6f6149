# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check the matrices of an aircraft against the laws of physics.

The laws are those of kinematics, gravity, trim speed, and the sign and the size of a control. The
name of a state says which quantity it is: V, u, v, w are speeds; alpha, beta, theta, phi, psi are
angles; p, q, r are angular rates; h and altitude are heights. The axes are FRD. A state of any
other name is not checked, but VT and other spellings of these names are refused. Source of the
identities: the linear equations of motion about straight flight, B. L. Stevens, F. L. Lewis,
Aircraft Control and Simulation, 2nd ed. (2003), sec. 3.7; B. Etkin, L. D. Reid, Dynamics of
Flight, 3rd ed. (1996), eq. (4.9,18).
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np

from flight_core.parameters import ParameterError
from flight_core.units import ANGLE, ANGULAR_RATE, GRAVITY, LENGTH, SPEED, quantity
from flight_core.vectors import FloatArray

KINDS = {
    **dict.fromkeys(("V", "u", "v", "w"), (SPEED, "a speed, as m/s, ft/s or kt")),
    **dict.fromkeys(("alpha", "beta", "theta", "phi", "psi"), (ANGLE, "an angle, as rad or deg")),
    **dict.fromkeys(("p", "q", "r"), (ANGULAR_RATE, "an angular rate, as rad/s or deg/s")),
    **dict.fromkeys(("h", "altitude"), (LENGTH, "a height, as m or ft")),
}
"""Dimension of a state, by the names that textbooks use, and the dimension in words."""
OF_RATES = {
    "theta": "q r phi",
    "phi": "p q r theta phi",
    "psi": "q r theta phi",
    "h": None,
    "altitude": None,
}
"""States whose derivative is pure kinematics, which no force changes, and the states that may enter
this derivative; None if any state may."""

# Ranges of accepted fractions of an expected value.
TURNED = (0.7, 1.02)  # of a value that is multiplied by the cosine of a trim angle of up to 45 deg
COUPLED = (0.6, 1.35)  # of V0, to which the force of a rate, Z_q or Y_r, is added
# Accepted fractions of the change of lift with speed that follows if lift equals weight.
# Compressibility and thrust alter this change. Published aircraft have 0.78 to 1.02.
LIFT = (0.3, 2.8)
# Largest accepted entry, SI, in the row of theta, phi or psi at a state of KINDS that OF_RATES does
# not list for this row.
FOREIGN = 0.02
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
"""Expected entries of A in straight flight without bank, by row and column: sign, value in SI, and
the range of accepted fractions of this value."""

EFFECTS = {
    "nose down": ("q", -1.0), "pitch down": ("q", -1.0), "nose up": ("q", 1.0),
    "pitch up": ("q", 1.0),
    "roll right": ("p", 1.0), "right wing down": ("p", 1.0), "roll left": ("p", -1.0),
    "left wing down": ("p", -1.0),
    "nose right": ("r", 1.0), "yaw right": ("r", 1.0), "nose left": ("r", -1.0),
    "yaw left": ("r", -1.0),
    "more thrust": ("V u", 1.0), "more power": ("V u", 1.0),
}  # fmt: skip
"""Phrases that `positive` of an input may contain, with the state that the input then moves, and
the sign of the motion."""

CONTROLS = {
    "elevator": ("q", "alpha w", 0.06, 12.0),
    "aileron": ("p", "beta v", 0.015, 8.0),
    "rudder": ("r", "beta v", 0.015, 8.0),
}
"""For each input: the rate that it moves, the angle of the flow, and a range of strengths.

The strength is the effect divided by stiffness plus damping, see `_strengths`. Published aircraft
have 0.27 to 3.3 for the elevator, 0.04 to 0.93 for the aileron, and 0.04 to 1.1 for the rudder. If
a column of B is per deg but is taken to be per rad, the strength is wrong by the factor 57.
"""


class LinearModel(NamedTuple):
    """The linear model of an airframe, in the units of the airframe file."""

    name: str
    states: Mapping[str, str]  # units by state
    effects: Mapping[str, str]  # effect of a positive value, by input
    inputs: tuple[str, ...]  # units of the inputs
    speed: float  # V0, m/s
    file_A: FloatArray  # (n, n)
    file_B: FloatArray  # (n, m)
    gravity: FloatArray  # (n, n), SI, sine terms for small angles

    def matrix_a(self) -> FloatArray:
        """Return A with gravity, SI."""
        unit = np.array([quantity(unit).si for unit in self.states.values()])
        return np.asarray(self.file_A * unit[:, None] / unit + self.gravity)

    def matrix_b(self) -> FloatArray:
        """Return B, SI."""
        row = np.array([quantity(unit).si for unit in self.states.values()])
        column = np.array([quantity(unit).si for unit in self.inputs])
        return np.asarray(self.file_B * row[:, None] / column)

    @property
    def angular(self) -> frozenset[str]:
        """Names of the inputs that are angles, which are control surfaces."""
        units = zip(self.effects, self.inputs, strict=True)
        return frozenset(name for name, unit in units if quantity(unit).dimension == ANGLE)


class Finding(NamedTuple):
    """A contradiction to physics: what the airframe file says, and what is expected."""

    key: str
    actual: str
    expected: str


def check(model: LinearModel) -> None:
    """Raise ParameterError for the first contradiction to physics."""
    finding = next(contradictions(model), None)
    if finding is None:
        return
    skip = "(identities: false in the file skips this check)"
    raise ParameterError(
        f"airframe {model.name}: {finding.key}: found {finding.actual}, "
        f"expected {finding.expected} {skip}"
    )


def contradictions(model: LinearModel) -> Iterator[Finding]:
    """Yield the contradictions to physics: first of units, then of A, then of B."""
    yield from _dimensions(model)
    yield from _entries(model)
    yield from _kinematic_rows(model)
    yield from _dampings(model)
    yield from _effects(model)
    yield from _strengths(model)


def _dimensions(model: LinearModel) -> Iterator[Finding]:
    for name, unit in model.states.items():
        # V, as textbooks write it, in place of vt
        book_name = "V" if name.lower() == "vt" else name.lower()
        if name not in KINDS and book_name in KINDS:
            yield Finding(
                f"states.{name}", name, f"{book_name}: the name by which a state is checked"
            )
        dimension, words = KINDS.get(name, (None, ""))
        if dimension is not None and quantity(unit).dimension != dimension:
            yield Finding(f"states.{name}", unit, words)


def _entries(model: LinearModel) -> Iterator[Finding]:
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
    for (row, column), (sign, symbol, (least, most)) in EXPECTED.items():
        row = "altitude" if row == "h" and "altitude" in names else row  # noqa: PLW2901 - the two names of a height
        if row not in names or column not in names or (V0 == 0.0 and "V0" in symbol):
            continue
        entry = float(model.matrix_a()[names.index(row), names.index(column)])
        expected = sign * values[symbol]
        # A multirotor hovers, so its entries have no V0.
        left_out = entry == 0.0 and (
            symbol.startswith("2 g") or (symbol == "V0" and not model.angular)
        )
        if least <= entry / expected <= most or left_out:
            continue
        about = f"{'-' if sign < 0.0 else ''}{symbol} = {expected:.4g}" if symbol else f"{sign:.0f}"
        at_speed = f" at the speed {V0:.4g} m/s" if "V0" in symbol else ""
        yield Finding("A", f"{row}_dot = {entry:.4g} {column} in SI", about + at_speed)


def _kinematic_rows(model: LinearModel) -> Iterator[Finding]:
    names = list(model.states)
    scale = float(np.max(np.abs(model.matrix_b()), initial=0.0))
    for row in (name for name in OF_RATES if name in names):
        i = names.index(row)
        entering = OF_RATES[row]
        for column in KINDS if entering is not None else ():
            if column in names and column not in str(entering).split():
                value = float(model.matrix_a()[i, names.index(column)])
            else:
                value = 0.0
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


def _dampings(model: LinearModel) -> Iterator[Finding]:
    for i, name in enumerate(model.states):
        damping = float(model.matrix_a()[i, i])
        if name in {"p", "q", "r", "alpha", "beta", "w", "v"} and damping > 0.0:
            yield Finding(
                "A", f"{name}_dot = {damping:.4g} {name}", "0 or less: air damps this motion"
            )


def _effects(model: LinearModel) -> Iterator[Finding]:
    names = list(model.states)
    for k, (name, text) in enumerate(model.effects.items()):
        phrase = next((phrase for phrase in EFFECTS if phrase in text.lower()), None)
        if phrase is None:
            continue
        rows, sign = EFFECTS[phrase]
        row = next((row for row in rows.split() if row in names), None)
        value = 0.0 if row is None else float(model.matrix_b()[names.index(row), k])
        if row is not None and value * sign <= 0.0:
            yield Finding(
                f"inputs.{name}",
                f"{row}_dot = {value:.4g} {name} beside {phrase!r}",
                f"{'more' if sign > 0 else 'less'} than 0",
            )


def _strengths(model: LinearModel) -> Iterator[Finding]:
    """Yield a contradiction for each control of implausible size.

    The size is the angular acceleration per rad of the control, divided by the sum of stiffness and
    damping. For pitch this sum is |M_alpha| + |M_q| (|M_q| + |Z_alpha|).
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
            range_text = f"{least * scale:.2g} to {most * scale:.2g} for an aircraft with this A"
            yield Finding(
                f"inputs.{name}.unit",
                f"{rate}_dot = {model.matrix_b()[i, k]:.3g} {name} in SI",
                range_text,
            )
