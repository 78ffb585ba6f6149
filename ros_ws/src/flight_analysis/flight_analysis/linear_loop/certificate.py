# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write a guarantee to a file that can be checked without this package, and keep guarantees.

A certificate contains the sampled loop in numbers, the box of its uncertain entries, and the steps
of the proof. The script examples/check_certificate.py checks it. The script computes the motion
over a period again, and bounds the error of the Legendre coefficients that are left out.

Guarantees are also kept in the folder rise-di/guarantees in $XDG_CACHE_HOME, or in ~/.cache, under
the digest of their loop. The report of a flight computes no guarantee. It shows the guarantee that
was kept for the flown loop.
"""

import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flight_analysis.linear_loop.guarantee import Guarantee, Unstable, Zeros
from flight_analysis.linear_loop.loop_margins import LinearLoop
from flight_analysis.linear_loop.saturation import LimitGuarantee
from flight_analysis.linear_loop.told import Standing
from flight_core.files import write_file
from flight_core.parameters import require

BOUND = 6  # version of the method by which this stack bounds a loop


def certificate(linear: LinearLoop, guarantee: Guarantee, sources: Mapping[str, str]) -> str:
    """Return the certificate of a guarantee as JSON.

    Args:
        linear: The loop, with the box of the guarantee. The size of this box does not matter.
        guarantee: The guarantee of this loop.
        sources: The files from which the loop was built, by name: SHA-256 of the airframe and of
            the scenario, and the text of the exported constants.

    Raises:
        ParameterError: The guarantee proves nothing, or u can be late in a part of the loop in
            which all entries are exact.
    """
    require(guarantee.stable > 0.0, "certificate", "no stable box", "a loop with a guarantee")
    parts = [{key: part[key] for key in ("entries", "steps")} for part in guarantee.proof]
    proof: dict[str, Any] = {**sources, "parts": parts}
    if guarantee.late:
        expected = "an entry that deviates in each part with a late u"
        exact = "a part with exact entries alone"
        require(all(part["entries"] for part in parts), "certificate", exact, expected)
        m = len(linear.inputs)
        t = np.zeros((math.ceil(guarantee.late / linear.loop.period - 1e-9), m))
        for part in guarantee.proof:
            for place, level in part.get("levels", []):
                t[divmod(place, m)] = level
        proof["late"] = {"time": guarantee.late, "t": t}
    return _text(linear, guarantee.stable, proof)


def limit_certificate(
    linear: LinearLoop, guarantee: LimitGuarantee, sources: Mapping[str, str]
) -> str:
    """Return the certificate of a guarantee with a limit of one input, as JSON."""
    limit = {"input": guarantee.input, **guarantee.multiplier._asdict()}
    return _text(linear, guarantee.size, {**sources, "parts": guarantee.proof, "limit": limit})


def _text(linear: LinearLoop, deviation: float, proof: Mapping[str, Any]) -> str:
    """Return a loop with its box and a proof as JSON, for the relative deviation that is proved."""
    box = linear.box
    assert box is not None  # noqa: S101 - a guarantee has a box
    content = {
        **proof,
        "states": linear.plant_states,
        "outputs": linear.outputs,
        "inputs": linear.inputs,
        **linear.nominal._asdict(),
        **{name: value for name, value in box._asdict().items() if name != "zeros" or value},
        **linear.loop._asdict(),
        "law": linear.law._asdict(),
        "loop": linear.digest,
        "size": deviation / box.largest,
    }
    text = json.dumps(content, sort_keys=True, default=np.ndarray.tolist)
    digest = hashlib.sha256(text.encode()).hexdigest()
    return json.dumps(content | {"digest": digest}, default=np.ndarray.tolist) + "\n"


def keep(guarantee: Guarantee) -> None:
    """Store a guarantee in the folder of guarantees, for the pages of later flights.

    Nothing is stored if u can be late, or if the folder cannot be written.
    """
    if guarantee.late:
        return
    path = _path(guarantee.loop)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, json.dumps(guarantee.as_json() | {"proof": guarantee.proof}))
    except OSError:
        return


def kept_guarantee(linear: LinearLoop) -> Guarantee | None:
    """Return the guarantee that was kept for a loop, if it holds for the aircraft that flies.

    Returns None if no guarantee is kept, if its file is damaged, or if `unstated` gives a reason
    not to state the guarantee.
    """
    guarantee = _kept(linear)
    return None if guarantee is None or unstated(linear, guarantee) else guarantee


def unstated(linear: LinearLoop, guarantee: Guarantee) -> tuple[str, ...]:
    """Return the reasons why a guarantee cannot be stated for the aircraft that flies.

    The result is empty if the guarantee can be stated. A guarantee holds for a linear loop and for
    the aircraft within its box. So a reason is an effect that the linear loop does not contain, or
    an aircraft outside of the box.
    """
    reasons = [each.sentence for each in linear.differences if each.standing is not Standing.TAKEN]
    return (*reasons, *_beyond_box(linear, guarantee))


def beyond_kept(linear: LinearLoop) -> tuple[str, ...]:
    """Return a sentence if the aircraft lies outside the box of the guarantee kept for its loop.

    The result is empty if the aircraft lies inside this box, or if no guarantee is kept.
    """
    guarantee = _kept(linear)
    return () if guarantee is None else _beyond_box(linear, guarantee)


def _beyond_box(linear: LinearLoop, guarantee: Guarantee) -> tuple[str, ...]:
    if linear.off <= guarantee.stable:
        return ()
    ends = math.floor(1e3 * guarantee.stable) / 10.0
    off = f"the aircraft is {100.0 * linear.off:.1f} % off"
    return (f"aircraft.uncertainty: {off}, the guarantee ends at {ends:.1f} %: none is stated",)


def _kept(linear: LinearLoop) -> Guarantee | None:
    try:
        content: dict[str, Any] = json.loads(_path(linear.digest).read_bytes())
        content["unstable"] = _unstable(content["unstable"])
        content["exact"] = tuple(content["exact"])
        if (zeros := content["zeros_alone"]) is not None:
            content["zeros_alone"] = Zeros(zeros["stable"], _unstable(zeros["unstable"]))
        return Guarantee(**{field: content[field] for field in Guarantee._fields})
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _unstable(content: dict[str, Any] | None) -> Unstable | None:
    if content is None:
        return None
    late = tuple(map(tuple, content["late"]))
    return Unstable(**(content | {"late": late}))


def _path(loop: str) -> Path:
    """Return the file in which a guarantee is kept, given the digest of its loop."""
    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(caches) / "rise-di" / "guarantees" / f"{loop}.{BOUND}.json"
