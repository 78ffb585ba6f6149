# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check the theorem's assumptions on an airframe, with the matrices of the airframe.

The checks cover Remark 1 and Assumptions 1 and 3. Assumption 2 (f is C1, and f and f_dot are
bounded) needs no check, because f consists of gusts and sine terms, which the schema of an airframe
file bounds. Gusts and sine terms are C1, and their rates are bounded as long as the angular rates
are.
"""

from collections.abc import Sequence
from enum import StrEnum
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eig, eigvals, qr

from aircraft_sim.airframes.airframe import Airframe, airframes, load_airframe
from flight_core.arguments import FilePath
from flight_core.parameters import require
from flight_core.vectors import FloatArray
from flight_design.gains.effectors import LAW_INPUT
from rise_di_controller.extensions.feedforward import ZERO_REAL_PART
from rise_di_controller.law.decomposition import (
    MANY,
    DecompositionError,
    Pairing,
    coupling,
    leading_minors,
    search,
    signs,
)

ComplexArray = NDArray[np.complex128]

MAX_FINITE_ZERO = 1e4
"""1/s. The pencil has double zeros at infinity. Rounding may make them finite, but not less than
about 1e7, the inverse root of 2e-16. The largest finite zero in the library is 7.2."""

RANK_TOLERANCE = 1e-9
"""Singular values below this fraction of the largest one count as zero: rounding leaves 1e-15, and
published data have five digits."""


class ZeroDynamics(StrEnum):
    """Location of the invariant zeros of an airframe, which decides whether Assumption 3 holds."""

    STABLE = "stable"  # all in the open left half plane
    # some on the imaginary axis. Assumption 3 does not cover them, so an outer loop must control
    # the angles to which these zeros belong.
    MARGINAL = "marginal"
    UNSTABLE = "unstable"  # some in the right half plane: outside the theorem


class AirframeFacts(NamedTuple):
    """The properties of an airframe that decide whether the theorem applies to it, in SI."""

    name: str
    n: int
    m: int
    poles: ComplexArray  # (n,) eigenvalues of A, 1/s
    # finite invariant zeros of (A, B, C), 1/s; there are n - m of them if Omega is nonsingular
    zeros: ComplexArray
    Omega: FloatArray  # (m, m) C B
    minors: FloatArray  # (m,) leading minors of Omega
    D: FloatArray | None  # (m,) diagonal of D, None if a minor is (nearly) zero
    coupling: float | None  # `coupling` of Omega; None if a minor is (nearly) zero
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    # the change that makes D = I, as `search` finds it; None if none of the orders that were tried
    # has such a change
    pairing: Pairing | None
    zero_dynamics: ZeroDynamics
    is_controllable: bool  # Assumption 1
    # states that are integrals of outputs alone. Each of them gives a zero at the origin.
    integrated: tuple[str, ...]

    @property
    def is_in_theorem(self) -> bool:
        """Whether the theorem applies to the airframe.

        The theorem applies if Assumption 1 holds, if D of (10)-(11) exists, and if no zero lies in
        the right half plane. Zeros on the imaginary axis are allowed here, because an outer loop
        can control the angles to which these zeros belong.
        """
        return (
            self.is_controllable
            and self.D is not None
            and self.zero_dynamics is not ZeroDynamics.UNSTABLE
        )

    @property
    def remedy(self) -> str:
        """The change of pairs and signs that makes D = I, in words.

        Examples are "none needed", "flip rudder", and "pair p-rudder, r-aileron, flip rudder". If
        no change makes D = I, the text is "none".
        """
        if self.pairing is None:
            return "none" if self.m <= MANY else "none of three orders tried"
        outputs, inputs, input_signs, _ = self.pairing
        in_place = outputs == inputs == tuple(range(self.m))
        pairs = ", ".join(
            f"{self.outputs[i]}-{self.inputs[j]}" for i, j in zip(outputs, inputs, strict=True)
        )
        flips = ", ".join(
            self.inputs[j] for j, sign in zip(inputs, input_signs, strict=True) if sign < 0
        )
        steps = ([] if in_place else [f"pair {pairs}"]) + ([f"flip {flips}"] if flips else [])
        return ", ".join(steps) or "none needed"


def airframe_facts(airframe: FilePath | Airframe) -> AirframeFacts:
    """Compute poles, zeros, Omega = C B with D, and Assumptions 1 and 3 of an airframe, in SI.

    Source: Assumptions 1 and 3, equations (10)-(11) and Remark 1 of Tanyer, Tatlicioglu,
    Zergeroglu. The zeros are computed from the linear part (A, B, C), so f has no effect on them.
    If an airframe has more inputs than outputs, the pseudo-inverse of C B, in SI, combines them to
    m inputs of the law. A published A may contain gravity, which then affects poles and zeros.

    Args:
        airframe: Name in the library, path of an airframe file (.yaml), or an Airframe.

    Returns:
        The facts: `poles` (n,) and `zeros`, 1/s, `Omega` (m, m), `D` (m,) and the assumptions.

    Raises:
        ParameterError: No airframe has the name, or the file is invalid.

    Examples:
        >>> facts = rise_di.airframe_facts("osprey")
        >>> facts.poles.shape, facts.Omega.shape
        ((8,), (4, 4))
    """
    airframe = load_airframe(airframe)
    if len(airframe.inputs) > len(airframe.outputs):
        T = np.asarray(np.linalg.pinv(airframe.matrix_c() @ airframe.matrix_b()), dtype=np.float64)
        airframe = airframe.through(T, [f"{LAW_INPUT}{name}" for name in airframe.outputs])
    A = airframe.matrix_a()
    B = airframe.matrix_b()
    C = airframe.matrix_c()
    Omega, hidden, (_, unseen, _) = C @ B, np.logical_not(C.any(axis=0)), output_coordinates(C)
    zeros = invariant_zeros(A, B, C)
    try:
        D = signs(Omega)
        largest = coupling(Omega)
    except DecompositionError:
        D = None
        largest = None
    return AirframeFacts(
        name=airframe.name,
        n=len(A),
        m=len(Omega),
        poles=np.array(eigvals(A), dtype=np.complex128),
        zeros=zeros,
        Omega=Omega,
        minors=leading_minors(Omega),
        D=D,
        coupling=largest,
        outputs=airframe.outputs,
        inputs=tuple(airframe.inputs),
        pairing=search(Omega),
        zero_dynamics=zero_dynamics(zeros),
        is_controllable=is_controllable(A, B),
        integrated=tuple(
            state
            for i, state in enumerate(airframe.states)
            if hidden[i] and not B[i].any() and not (A[i] @ unseen).any()
        ),
    )


def library() -> list[AirframeFacts]:
    """Return the facts about every airframe of the library, by name.

    Raises ParameterError for an invalid file.
    """
    return [airframe_facts(load_airframe(name)) for name in airframes()]


def invariant_zeros(A: FloatArray, B: FloatArray, C: FloatArray) -> ComplexArray:
    """Find the invariant zeros, 1/s, in the order of their real parts.

    The zeros are the finite s at which Rosenbrock's pencil [[A - s I, B], [C, 0]] loses rank. The
    shapes are A (n, n), B (n, m), C (m, n). There are n - m zeros if C B is nonsingular. The zeros
    are the poles of the zero dynamics, which is the motion of the aircraft while y = 0. Source: H.
    H. Rosenbrock, "State-Space and Multivariable Theory", 1970.
    """
    n, m = B.shape
    pencil = np.block([[A, B], [C, np.zeros((m, m))]])
    weights = np.diag(np.concatenate([np.ones(n), np.zeros(m)]))
    numerators, denominators = eig(pencil, weights, right=False, homogeneous_eigvals=True)
    finite = np.abs(numerators) < MAX_FINITE_ZERO * np.abs(denominators)
    return np.sort_complex(numerators[finite] / denominators[finite])


def fastest_zero(A: FloatArray, B: FloatArray, C: FloatArray) -> float:
    """Return the largest real part of the zeros, 1/s, or minus infinity if there are no zeros.

    If the largest real part is above 0, the aircraft diverges while y is held.
    """
    return float(np.max(invariant_zeros(A, B, C).real, initial=-np.inf))


def output_coordinates(C: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return P (n, m), N (n, n - m) and H (n, n - m) with x = P y + N eta and eta = H' x.

    The three matrices split the state x into the outputs y and the n - m other coordinates eta. A
    QR decomposition of C with pivoting picks the m states on which y depends most. Raises
    ParameterError unless C (m, n) has full rank. If C selects states, P = C' and N = H.
    """
    m, n = C.shape
    _, R, pivots = qr(C, pivoting=True)
    require(
        abs(R[-1, m - 1]) > RANK_TOLERANCE * abs(R[0, 0]),
        "C",
        "rows that depend on each other",
        f"{m} independent outputs",
    )
    H = np.eye(n)[:, np.sort(pivots[m:])]
    inverse = np.asarray(np.linalg.inv(np.vstack([C, H.T])))
    return inverse[:, :m], inverse[:, m:], H


def marginal_sentence(facts: Sequence[AirframeFacts]) -> str | None:
    """Write a sentence that names the airframes with zeros on the imaginary axis.

    Assumption 3 does not cover such zeros. Returns None if there are no such airframes.
    """
    states = list(dict.fromkeys(chain.from_iterable(airframe.integrated for airframe in facts)))
    names = [airframe.name for airframe in facts if airframe.zero_dynamics is ZeroDynamics.MARGINAL]
    if not names:
        return None
    integrals = ""
    if states:
        verb = "integrates" if len(states) == 1 else "integrate"
        integrals = f": {', '.join(states)} {verb} the outputs"
    where = f"{integrals} ({', '.join(names)})"
    return (
        "Zeros at the origin are outside Assumption 3, an outer loop has to bound their "
        f"states{where}."
    )


def zero_dynamics(zeros: ComplexArray) -> ZeroDynamics:
    """Return in which half plane the invariant zeros lie, the poles of the zero dynamics (5)-(9).

    `zeros` has shape (n - m,), in 1/s. A zero is taken to lie on the imaginary axis if its real
    part is at most ZERO_REAL_PART in magnitude.
    """
    rightmost = float(np.max(zeros.real, initial=-np.inf))
    if rightmost > ZERO_REAL_PART:
        return ZeroDynamics.UNSTABLE
    return ZeroDynamics.MARGINAL if rightmost >= -ZERO_REAL_PART else ZeroDynamics.STABLE


def is_controllable(A: FloatArray, B: FloatArray) -> bool:
    """Return whether Assumption 1 holds, by the test of Popov, Belevitch and Hautus.

    The test is rank [A - s I, B] = n at every eigenvalue s of A. Shapes: A (n, n), B (n, m).
    """
    n = len(A)
    modes = (np.hstack([A - s * np.eye(n), B]) for s in eigvals(A))
    return all(int(np.linalg.matrix_rank(mode, rtol=RANK_TOLERANCE)) == n for mode in modes)
