# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A guarantee as a file that is checked without this stack: examples/check_certificate.py.

The file has the sampled loop in numbers, the box of its entries, and the steps of the proof. The
checker computes the motion over a period again, and bounds what the Legendre coefficients leave
out.
"""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from flight_analysis.linear_loop.guarantee import Guarantee
from flight_analysis.linear_loop.loop_margins import LinearLoop
from flight_core.parameters import require

COVERED = (
    "covered: each aircraft of the box, constant in time, in the linear loop with these lags, this "
    "delay and this period; no mode grows by more than 1e-6 a tick"
)
NOT_COVERED = (
    "not covered: limits and rates of the inputs, errors beyond the width of the softened sign, "
    "lags and delays other than these, a late or missed tick, a schedule, deviations that change "
    "in time, disk margins"
)


def certificate(linear: LinearLoop, promise: Guarantee, sources: Mapping[str, str]) -> str:
    """The certificate of a guarantee, JSON.

    Args:
        linear: The loop, with the box of the guarantee, of any size.
        promise: Its guarantee, u in time.
        sources: SHA-256 of what the loop is of, by name.

    Raises:
        ParameterError: Nothing is proved, or u may be late: the coefficients of a late u have no
            bound of what they leave out.
    """
    require(promise.stable > 0.0, "certificate", "no stable box", "a loop with a guarantee")
    require(promise.late == 0.0, "certificate", f"u up to {promise.late:g} s late", "u in time")
    box = linear.box
    assert box is not None and promise.proof  # noqa: S101, PT018 - a guarantee has both
    nominal = linear.nominal
    largest = float(box.part.max())
    within = np.floor(1e3 * promise.stable * box.part / largest) / 10.0
    entries = ", ".join(
        f"{name} {part:g}" for name, part in zip(box.names, within.tolist(), strict=True)
    )
    content: dict[str, Any] = {
        "claim": [f"stable for each deviation within, %: {entries}", COVERED, NOT_COVERED],
        **sources,
        "names": box.names,
        "size": promise.stable / largest,
        "A": nominal.A.tolist(),
        "B": nominal.B.tolist(),
        "C": nominal.C.tolist(),
        "E": box.E.tolist(),
        "F": box.F.tolist(),
        "G": box.G.tolist(),
        "law": {name: matrix.tolist() for name, matrix in linear.law._asdict().items()},
        "lag": linear.loop.lag.tolist(),
        "delay": linear.loop.delay,
        "period": linear.loop.period,
        "parts": promise.proof,
    }
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    return json.dumps(content | {"digest": digest}) + "\n"
