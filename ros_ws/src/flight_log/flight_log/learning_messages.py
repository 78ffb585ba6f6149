# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write and read the messages of the topic `learning`, without ROS.

These messages say what became of the proposals of a learner.
"""

import json
from typing import Any

from flight_core.rates import NANOSECONDS
from flight_log.named_vectors import typestore

LEARNING = "learning"
DIAGNOSTIC_ARRAY = "diagnostic_msgs/msg/DiagnosticArray"
# Levels of diagnostic_msgs/msg/DiagnosticStatus.
OK = 0
WARN = 1


def learning_message(stamp_ns: int, kind: str, sentence: str, *, level: int) -> bytes:
    """Return a message of the topic LEARNING on an event, as the controller publishes it.

    `level` is OK or WARN.
    """
    store = typestore()
    types = {
        name: store.types[f"diagnostic_msgs/msg/{name}"]
        for name in ("DiagnosticArray", "DiagnosticStatus", "KeyValue")
    }
    stamp = store.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, NANOSECONDS))
    header = store.types["std_msgs/msg/Header"](stamp, "in_process")
    event = types["KeyValue"]("event", json.dumps(kind))
    status = types["DiagnosticStatus"](level, LEARNING, sentence, "", [event])
    return bytes(store.serialize_cdr(types["DiagnosticArray"](header, [status]), DIAGNOSTIC_ARRAY))


def stamped_sentence(message: Any) -> tuple[int, str]:
    """Return the stamp, ns, and the sentence of a message of LEARNING, or "" if it has none."""
    stamp = message.header.stamp
    return stamp.sec * NANOSECONDS + stamp.nanosec, " ".join(
        status.message for status in message.status
    )
