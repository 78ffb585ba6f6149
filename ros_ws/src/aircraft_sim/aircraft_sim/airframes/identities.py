# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check the matrices of an aircraft against the laws of physics.

The laws concern kinematics, gravity, trim speed, and the sign and the size of a control. The
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


class Kind(NamedTuple):
    """The kind of quantity that a state is, such as a speed or an angle."""

    dimension: tuple[int, ...]
    words: str  # the dimension in words, with units as examples


class Expected(NamedTuple):
    """An entry of A that follows from physics."""

    sign: float
    symbol: str  # size, a key of `_sizes`
    fractions: tuple[float, float]  # range of accepted fractions of this size
    may_be_left_out: bool = False  # whether 0 is accepted, too


class Effect(NamedTuple):
    """A motion of the aircraft, as the phrases for the effects of inputs name it."""

    states: tuple[str, ...]  # possible names of the state that moves
    sign: float


class Control(NamedTuple):
    """The plausible strength of a control, see `_strengths`."""

    rate: str  # angular rate that it moves
    flows: tuple[str, ...]  # possible names of the angle of the flow
    least: float
    most: float


KINDS = {
    **dict.fromkeys(("V", "u", "v", "w"), Kind(SPEED, "a speed, as m/s, ft/s or kt")),
    **dict.fromkeys(
        ("alpha", "beta", "theta", "phi", "psi"), Kind(ANGLE, "an angle, as rad or deg")
    ),
    **dict.fromkeys(("p", "q", "r"), Kind(ANGULAR_RATE, "an angular rate, as rad/s or deg/s")),
    **dict.fromkeys(("h", "altitude"), Kind(LENGTH, "a height, as m or ft")),
}
"""Kinds of the states, by the names that textbooks use."""
OF_RATES = {
    "theta": ("q", "r", "phi"),
    "phi": ("p", "q", "r", "theta", "phi"),
    "psi": ("q", "r", "theta", "phi"),
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
EXPECTED: Mapping[tuple[str, str], Expected] = {
    ("theta", "q"): Expected(1.0, "", TURNED),
    ("phi", "p"): Expected(1.0, "", TURNED),
    ("psi", "r"): Expected(1.0, "", (0.95, 1.5)),
    ("V", "theta"): Expected(-1.0, "g", TURNED),
    ("u", "theta"): Expected(-1.0, "g", TURNED),
    ("v", "phi"): Expected(1.0, "g", TURNED),
    ("beta", "phi"): Expected(1.0, "g/V0", COUPLED),
    ("w", "q"): Expected(1.0, "V0", COUPLED),
    ("v", "r"): Expected(-1.0, "V0", COUPLED),
    ("alpha", "q"): Expected(1.0, "", COUPLED),
    ("beta", "r"): Expected(-1.0, "", COUPLED),
    ("alpha", "V"): Expected(-1.0, "2 g/V0^2", LIFT, may_be_left_out=True),
    ("w", "V"): Expected(-1.0, "2 g/V0", LIFT, may_be_left_out=True),
    ("h", "theta"): Expected(1.0, "V0", COUPLED),
    ("h", "alpha"): Expected(-1.0, "V0", COUPLED),
    ("h", "w"): Expected(-1.0, "", TURNED),
}
"""Expected entries of A in straight flight without bank, by row and column, SI. A file may leave
out the change of lift with speed."""

NOSE_UP, NOSE_DOWN = (Effect(("q",), sign) for sign in (1.0, -1.0))
ROLL_RIGHT, ROLL_LEFT = (Effect(("p",), sign) for sign in (1.0, -1.0))
NOSE_RIGHT, NOSE_LEFT = (Effect(("r",), sign) for sign in (1.0, -1.0))
FASTER = Effect(("V", "u"), 1.0)
EFFECTS = {
    "nose down": NOSE_DOWN, "pitch down": NOSE_DOWN, "nose up": NOSE_UP, "pitch up": NOSE_UP,
    "roll right": ROLL_RIGHT, "right wing down": ROLL_RIGHT, "roll left": ROLL_LEFT,
    "left wing down": ROLL_LEFT,
    "nose right": NOSE_RIGHT, "yaw right": NOSE_RIGHT, "nose left": NOSE_LEFT,
    "yaw left": NOSE_LEFT,
    "more thrust": FASTER, "more power": FASTER,
}  # fmt: skip
"""Phrases that `positive` of an input may contain, and the motion that the input then causes."""

CONTROLS = {
    "elevator": Control("q", ("alpha", "w"), 0.06, 12.0),
    "aileron": Control("p", ("beta", "v"), 0.015, 8.0),
    "rudder": Control("r", ("beta", "v"), 0.015, 8.0),
}
"""Ranges of the strengths of the control surfaces.

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
        kind = KINDS.get(name)
        if kind is not None and quantity(unit).dimension != kind.dimension:
            yield Finding(f"states.{name}", unit, kind.words)


def _entries(model: LinearModel) -> Iterator[Finding]:
    names = list(model.states)
    sizes = _sizes(model.speed)
    for (row, column), (sign, symbol, (least, most), may_be_left_out) in EXPECTED.items():
        row = "altitude" if row == "h" and "altitude" in names else row  # noqa: PLW2901 - the two names of a height
        if row not in names or column not in names or symbol not in sizes:
            continue
        entry = float(model.matrix_a()[names.index(row), names.index(column)])
        expected = sign * sizes[symbol]
        # An aircraft without control surfaces is a multirotor. Its A holds for hover, where the
        # terms with V0 vanish.
        may_be_zero = may_be_left_out or (symbol == "V0" and not model.angular)
        if least <= entry / expected <= most or (may_be_zero and entry == 0.0):
            continue
        about = f"{'-' if sign < 0.0 else ''}{symbol} = {expected:.4g}" if symbol else f"{sign:.0f}"
        at_speed = f" at the speed {model.speed:.4g} m/s" if "V0" in symbol else ""
        yield Finding("A", f"{row}_dot = {entry:.4g} {column} in SI", about + at_speed)


def _sizes(V0: float) -> dict[str, float]:
    """Return the sizes of expected entries at the speed V0, m/s, SI, by symbol.

    At the speed 0 there are none with V0.
    """
    constant = {"": 1.0, "g": GRAVITY}
    if V0 == 0.0:
        return constant
    return constant | {
        "V0": V0,
        "g/V0": GRAVITY / V0,
        "2 g/V0": 2.0 * GRAVITY / V0,
        "2 g/V0^2": 2.0 * GRAVITY / V0**2,
    }


def _kinematic_rows(model: LinearModel) -> Iterator[Finding]:
    names = list(model.states)
    scale = float(np.max(np.abs(model.matrix_b()), initial=0.0))
    for row in (name for name in OF_RATES if name in names):
        i = names.index(row)
        entering = OF_RATES[row]
        foreign = () if entering is None else (name for name in KINDS if name not in entering)
        for column in (name for name in foreign if name in names):
            value = float(model.matrix_a()[i, names.index(column)])
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
        states, sign = EFFECTS[phrase]
        row = next((state for state in states if state in names), None)
        if row is None:
            continue
        value = float(model.matrix_b()[names.index(row), k])
        if value * sign <= 0.0:
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
        if name not in CONTROLS or name not in model.angular:
            continue
        rate, flows, least, most = CONTROLS[name]
        flow = next((state for state in flows if state in names), None)
        if rate not in names or flow is None:
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
