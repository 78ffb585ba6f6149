# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read the age of u at the aircraft from the diagnostics.

This age is the delay of the whole loop, from the instant of y to the action of u.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
from rosbags.serde.errors import SerdeError

from flight_core.channels import AGE_OF_U
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal
from flight_log.learning_messages import DIAGNOSTIC_ARRAY
from flight_log.named_vectors import typestore

DIAGNOSTICS = "/diagnostics"
IN_MESSAGE = AGE_OF_U["mean"].encode()  # bytes that occur in a message with an age of u


def age_of_u(messages: Iterable[bytes], namespace: str) -> Signal | None:
    """Return the mean and the largest age of u, s, in each diagnostics report of an aircraft.

    A report covers the time since the previous report. `namespace` is the namespace of the
    aircraft. Returns None if there is no report of this aircraft.
    """
    rows: dict[int, list[float]] = {}
    for data in messages:
        try:
            report: Any = typestore().deserialize_cdr(data, DIAGNOSTIC_ARRAY)
            for status in report.status:
                values = {value.key: value.value for value in status.values}
                if status.name == f"{namespace}/aircraft" and AGE_OF_U["mean"] in values:
                    stamp = report.header.stamp
                    stamp_ns = stamp.sec * NANOSECONDS + stamp.nanosec
                    rows[stamp_ns] = [float(values[key]) for key in AGE_OF_U.values()]
        # Any node may publish /diagnostics, and a log may be damaged. The other reports still hold.
        except (SerdeError, LookupError, ValueError):
            continue
    stamps = sorted(rows)
    if rows:
        return Signal(
            np.array(stamps), tuple(AGE_OF_U), np.array([rows[stamp] for stamp in stamps])
        )
    return None
