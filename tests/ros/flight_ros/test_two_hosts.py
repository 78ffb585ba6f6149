# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test an aircraft and its controller on two hosts.

The hosts are network namespaces, and the network between them has a delay and a loss.
"""

import re
import shutil
import signal
import struct
import subprocess
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from tests.ros.conftest import Start, settable_clock
from tests.ros.flight_ros.test_security import environment, is_separate
from tests.ros.waiting import until

from flight_ros.network import network_profile

pytestmark = pytest.mark.alone

ADDRESSES = ("10.45.0.1", "10.45.0.2")
DELAY, LOSS = 0.010, 0.05  # s one way; share
OFFSET_NS = -50_000_000  # of the clock of the aircraft
REPORTS = 3  # of the aircraft, one a second


def test_age_of_u_is_right_and_pulled_cable_ends_in_failsafe(
    start: Start, start_node: Start, tmp_path: Path
) -> None:
    """The aircraft computes the age of u with its own clock alone, and the measured age is equal.

    A node without code of the stack measures it.
    """
    unshare, nsenter, ip = (shutil.which(command) or "" for command in ("unshare", "nsenter", "ip"))
    if not (unshare and nsenter and ip and Path("/dev/net/tun").exists()):
        pytest.skip("no unshare, nsenter (util-linux), ip (iproute2) or /dev/net/tun here")
    holders = [
        subprocess.Popen([unshare, "--net", "sleep", "300"], stderr=subprocess.PIPE)
        for _ in ADDRESSES
    ]
    try:
        for holder in holders:
            until(partial(is_separate, holder), "a namespace of its own")
            if holder.poll() is not None:
                pytest.skip("no network namespace for this user")
        relay = start(
            "tests.ros.relay",
            *(str(holder.pid) for holder in holders),
            str(DELAY),
            str(LOSS),
            within=environment(),
        )
        relay.wait_for("up")
        (step := tmp_path / "step").write_bytes(struct.pack("=q", OFFSET_NS))
        clocks: tuple[dict[str, str], ...] = (
            {},
            {"LD_PRELOAD": str(settable_clock(tmp_path)), "FAULTS_CLOCK": str(step)},
        )
        hosts = []
        for holder, address, clock in zip(holders, ADDRESSES, clocks, strict=True):
            place = (nsenter, f"--net=/proc/{holder.pid}/ns/net")
            for command in (
                "link set lo up",
                f"addr add {address}/24 dev net0",
                "link set net0 up",
            ):
                subprocess.run([*place, ip, *command.split()], check=True)
            (profile := tmp_path / f"{address}.xml").write_text(network_profile(address, ADDRESSES))
            variables = {
                "FASTRTPS_DEFAULT_PROFILES_FILE": str(profile),
                "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT",
            }
            hosts.append((*place, *environment(**variables, **clock)))
        controller = start_node("rise_di_controller", within=hosts[0])
        start_node("reference_model", within=hosts[0])
        stopwatch = start("tests.ros.stopwatch", within=hosts[1])
        aircraft = start_node("aircraft_sim", within=hosts[1])
        # 0.05 s, as estimated from samples that wait in the relay and for a tick
        controller.wait_for(f"the clock of /aircraft#{aircraft.popen.pid} is 0.0")
        stopwatch.until(lambda: len(stopwatch.lines) > REPORTS, "the reports of the aircraft")
        rows = [re.fullmatch("told (.*) measured (.*)", line) for line in stopwatch.lines]
        age_told, age_measured = np.array(
            [[float(value) for value in row.groups()] for row in rows if row][1:]
        ).T
        # The aircraft looks for u every 2 ms, 1 ms late on average. Measured 0.5 to 1.2 ms; a
        # second clock would give 50 ms.
        assert np.median(np.abs(age_told - age_measured)) < 0.002, (age_told, age_measured)
        assert np.median(age_told) > 2 * DELAY
        relay.popen.send_signal(signal.SIGUSR1)
        controller.wait_for("ENGAGED -> HOLD")
        controller.wait_for("-> RAMP")
        controller.wait_for("RAMP -> ENGAGED")
    finally:
        for holder in holders:
            holder.kill()
            holder.communicate()
