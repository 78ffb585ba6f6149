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

import numpy as np

from flight_analysis.linear_loop.guarantee import Guarantee
from flight_analysis.linear_loop.loop_margins import LinearLoop
from flight_core.parameters import require


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
    content = {
        **sources,
        **linear.nominal._asdict(),
        **box._asdict(),
        **linear.loop._asdict(),
        "law": linear.law._asdict(),
        "size": promise.stable / float(box.part.max()),
        "parts": promise.proof,
    }
    text = json.dumps(content, sort_keys=True, default=np.ndarray.tolist)
    digest = hashlib.sha256(text.encode()).hexdigest()
    return json.dumps(content | {"digest": digest}, default=np.ndarray.tolist) + "\n"
