# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di network`, which writes the middleware's profile for several hosts.

It can also check the network between the hosts.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import typer

from flight_cli.words import REQUIRED, option, write_option
from flight_core.environment import require_ros_environment
from flight_core.installation import require_package

FAILED = 1


@dataclass(frozen=True, kw_only=True)
class Network:
    """Write the profile of the middleware for nodes on several hosts.

    The nodes then communicate by unicast between their addresses, without multicast. Exit status: 0
    written and, with --check, every host receives and is received; 1 a host does not; 2 bad input.
    """

    peers: str = option(
        "IPv4 addresses of all hosts, including this one. Give the same on each host.",
        default=REQUIRED,
        metavar="A,B",
    )
    write: Path = write_option(
        "File to write the profile to.", default=Path("network.xml"), metavar="FILE"
    )
    check: bool = option(
        "Then wait for the same command on the other hosts, and show who receives whom, the delays "
        "and the clocks.",
        default=False,
    )
    timeout: float = option(
        "How long to wait for the other hosts, s.", default=20.0, min=1.0, max=3600.0
    )

    def execute(self) -> None:
        """Write the profile and, with --check, check the network."""
        require_package("rclpy", "")
        require_ros_environment()
        from flight_bringup.client import write_profile  # noqa: PLC0415 - loads rclpy

        own_host, hosts, environment = write_profile(self.peers, self.write)
        print(
            f"{self.write}: this host is {own_host}. In each shell that starts a node, a flight or "
            "a tool here:"
        )
        print(f"  export {' '.join(f'{name}={value}' for name, value in environment.items())}")
        if self.check:
            os.environ.update(environment)
            self._exchange(own_host, hosts)

    def _exchange(self, own_host: str, hosts: Sequence[str]) -> None:
        """Exchange messages with the other hosts, and print for each whether both sides receive."""
        from flight_bringup.client import NetworkClient, domain_ports  # noqa: PLC0415 - loads rclpy

        others = [address for address in hosts if address != own_host]
        command = f"rise-di network --peers {self.peers} --check"
        print(f"waiting for {', '.join(others)}: {command}", flush=True)
        with NetworkClient(own_host, hosts) as client:
            heard_hosts, clocks = client.exchange(self.timeout)
        ports = "UDP ports {} to {}".format(*domain_ports())
        for address in others:
            if address in clocks:
                clock = clocks[address]
                sentence = f"received, receives this host; delay {1e3 * clock.delay:.1f} ms, "
                sentence += f"its clock is {clock}"
            elif address in heard_hosts:
                sentence = f"received, does not receive this host: open {ports} there"
            else:
                sentence = "not received: start the command there; check the address, and "
                sentence += f"{ports} here"
            print(f"{address}: {sentence}")
        if len(clocks) < len(others):
            raise typer.Exit(FAILED)
