# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check the signs D of a pairing of inputs and outputs against Omega = C B."""

from collections.abc import Sequence

import numpy as np

from flight_core.parameters import ParameterError, require
from flight_core.vectors import FloatArray
from flight_design.gains.ideal_control import ChannelPairing
from rise_di_controller.law.decomposition import MANY, DecompositionError, coupling, search, signs

MAX_COUPLING = 10.0
"""Upper bound of max abs(U - I) for a pairing of inputs and outputs. The value is 25 on the
`osprey` with aileron and rudder swapped, 13.6 on the first edition's Aerosonde, which neither
procedure stabilises behind servos, and at most 2.2 on the other airframes of the library."""


def signs_of_pairing(
    Omega: FloatArray,
    channels: ChannelPairing,
    D: Sequence[int] | None = None,
    input_signs: Sequence[int] | None = None,
) -> FloatArray:
    """Return the signs D of a pairing of inputs with outputs, shape (m,).

    Omega = C B, (m, m), is in the order of the channels, and its inputs have the signs of the
    airframe. `input_signs` has -1 for an input whose sign is flipped between law and airframe. If
    the input of channel k is flipped, D_k changes its sign, and no other entry of D does. If `D` is
    given, it is checked and not computed. The checks are made in this order:

    - Omega has a decomposition S D U, and max abs(U - I) is at most 10.
    - The input signs fit the D that is given.
    - D fits Omega.

    If a check fails, raises ParameterError. The error names the value that contradicts Omega, and
    one that fits Omega.
    """
    m = len(Omega)
    flips = np.ones(m) if input_signs is None else np.array(input_signs, dtype=np.float64)
    try:
        largest = coupling(Omega)
        problem = f"max abs(U - I) = {largest:.3g}" if largest > MAX_COUPLING else ""
    except DecompositionError as error:
        problem = f"no D, for leading minor {error.minor} is zero"
    if problem:
        named = ", ".join(f"{output}-{name}" for output, name in zip(*channels, strict=True))
        fits = (
            "inputs that can be paired: "
            f"{'no order of these' if m <= MANY else 'none of three orders that were tried'} can"
        )
        if better := search(Omega, MAX_COUPLING):
            pairs = (
                f"{channels.outputs[i]}-{channels.inputs[j]}"
                for i, j in zip(*better[:2], strict=True)
            )
            fits = f"another pairing: {', '.join(pairs)}"
        raise ParameterError(f"controller.inputs: found {named} with {problem}, expected {fits}")
    actual = signs(Omega) * flips
    stated = actual if D is None else np.array(D, dtype=np.float64)
    wrong = [name for name, a, b in zip(channels.inputs, actual, stated, strict=True) if a != b]
    if input_signs is not None:
        fit = (flips * actual * stated).astype(int).tolist()
        expected = f"{fit} for D = {stated.astype(int).tolist()}: {', '.join(wrong)} the other way"
        require(not wrong, "input_signs", list(input_signs), expected)
    expected = (
        f"{actual.astype(int).tolist()}, the signs of the minors of C B; or flip "
        f"{', '.join(wrong)} and keep D"
    )
    require(not wrong, "controller.D", stated.astype(int).tolist(), expected)
    return np.asarray(actual)
