# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Computed guarantees, kept by the loop.

A report shows the guarantee of the loop, and computes none. The folder is rise-di/guarantees in
$XDG_CACHE_HOME, or in ~/.cache. A file is named by the digest of the nominal loop and of the shape
of its box, so that a changed gain, airframe, allocation or deviation of an entry has none. The size
of the box is in the guarantee.
"""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from flight_analysis.linear_loop.guarantee import Guarantee, Unstable
from flight_analysis.linear_loop.loop_margins import LinearLoop
from flight_core.files import write_file

DIGITS = 10  # of the entries in the digest: two ways to the same loop differ by rounding
BOUND = 3  # counts the ways by which this stack has bounded a loop


def keep(linear: LinearLoop, promise: Guarantee) -> None:
    """Keep a guarantee with u in time. A folder that cannot be written keeps none."""
    if promise.late:
        return
    content = promise._asdict() | {"disk": promise.disk.tolist()}
    if promise.unstable is not None:
        content["unstable"] = promise.unstable._asdict()
    path = _path(linear)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, json.dumps(content, default=float))
    except OSError:
        return


def kept_guarantee(linear: LinearLoop) -> Guarantee | None:
    """The guarantee that was computed for a loop; None without one, or for a damaged file."""
    try:
        content: dict[str, Any] = json.loads(_path(linear).read_bytes())
        first = content["unstable"]
        content["unstable"] = None if first is None else Unstable(**first)
        content["disk"] = np.array(content["disk"], dtype=np.float64)
        return Guarantee(**content | {"inputs": tuple(content["inputs"])})
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _path(linear: LinearLoop) -> Path:
    nominal = linear.nominal
    loop = linear.loop
    arrays = [*nominal, *linear.law, loop.lag, np.array([loop.delay, loop.period, BOUND])]
    if linear.box is not None:
        box = linear.box
        size = box.part.max()
        arrays += [box.part / size, box.E, box.F / size, box.G / size]
    digest = hashlib.sha256()
    for array in arrays:
        digits = (f"{value + 0.0:.{DIGITS - 1}e}" for value in np.ravel(array).tolist())
        digest.update(f"{np.shape(array)} {' '.join(digits)}".encode())
    caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(caches) / "rise-di" / "guarantees" / f"{digest.hexdigest()}.json"
