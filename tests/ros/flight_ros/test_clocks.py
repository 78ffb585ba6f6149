# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the clocks of other nodes: what a node says about a clock that differs."""

import re
import struct
from functools import partial
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from tests.ros.conftest import Start, settable_clock
from tests.ros.peer import peer

from flight_core.rates import NANOSECONDS
from flight_ros.topics import DIAGNOSTICS


def test_refusal_names_clock_of_the_other_node(start_node: Start, tmp_path: Path) -> None:
    """The aircraft's clock is 0.15 s behind, and `max_age` of the controller is 0.1 s."""
    (step := tmp_path / "step").write_bytes(struct.pack("=q", -150 * NANOSECONDS // 1000))
    shifted = ("env", f"LD_PRELOAD={settable_clock(tmp_path)}", f"FAULTS_CLOCK={step}")
    controller = start_node("rise_di_controller")
    aircraft = start_node("aircraft_sim", within=shifted)
    name = f"/aircraft#{aircraft.popen.pid}"
    estimate = rf"the clock of {name} is (0\.\d+) s behind this one"

    # the first estimate has the delays of a busy host, and one within 5 ms is not told again
    def told(sentence: str) -> bool:
        return any(
            float(offset) == pytest.approx(0.15, abs=0.01)
            for offset in re.findall(sentence, controller.output)
        )

    controller.until(
        partial(told, f"{estimate}: the system clock of this host was set"),
        "the difference of the clocks, told",
    )
    controller.until(
        partial(told, f"old: {estimate}"), "the refusal, with the difference of the clocks"
    )
    with peer(topics=()) as peer_node:
        offsets: list[float] = []

        def take(message: DiagnosticArray) -> None:
            values = {
                value.key: value.value for status in message.status for value in status.values
            }
            offsets.extend(float(values[key]) for key in [f"clock of {name} (s)"] if key in values)

        peer_node.node.create_subscription(DIAGNOSTICS.type, DIAGNOSTICS.name, take, 10)
        peer_node.until(
            lambda: any(offset == pytest.approx(-0.15, abs=0.002) for offset in offsets),
            "the difference of the clocks in the diagnostics",
        )
