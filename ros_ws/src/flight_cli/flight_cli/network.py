# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di network`: the profile of the middleware for nodes on several hosts, and a check of the
network between the hosts.
"""

import os
from pathlib import Path
from typing import Annotated

import typer

from flight_cli.words import option
from flight_core.environment import require_ros_environment
from flight_core.installation import require_package

FAILED = 1


def network(
    peers: Annotated[
        str,
        option(
            "IPv4 addresses of all hosts, this one's among them; the same on each host.",
            metavar="A,B",
        ),
    ],
    write: Annotated[Path, option("File to write the profile to.", metavar="FILE")] = Path(
        "network.xml"
    ),
    check: Annotated[
        bool,
        option(
            "Then wait for the same command on the other hosts: who receives whom, delays, clocks.",
            "--check",
        ),
    ] = False,
    timeout: Annotated[
        float, option("How long to wait for the other hosts, s.", min=1.0, max=3600.0)
    ] = 20.0,
) -> None:
    """Write the profile of the middleware for nodes on several hosts: unicast between their
    addresses, without multicast.

    Exit status: 0 written, and with --check every host receives and is received; 1 a host does not;
    2 bad input.
    """
    require_package("rclpy", "")
    require_ros_environment()
    from flight_bringup.client import NetworkClient, domain_ports, write_profile  # noqa: PLC0415 - loads rclpy

    own_host, hosts, environment = write_profile(peers, write)
    print(
        f"{write}: this host is {own_host}. In each shell that starts a node, a flight or a "
        "tool here:"
    )
    print(f"  export {' '.join(f'{name}={value}' for name, value in environment.items())}")
    if not check:
        return
    os.environ.update(environment)
    others = [address for address in hosts if address != own_host]
    print(f"waiting for {', '.join(others)}: rise-di network --peers {peers} --check", flush=True)
    with NetworkClient(own_host, hosts) as client:
        received, clocks = client.exchange(timeout)
    first, last = domain_ports()
    for address in others:
        if address in clocks:
            clock = clocks[address]
            print(
                f"{address}: received, receives this host; delay {1e3 * clock.delay:.1f} ms, "
                f"its clock is {clock}"
            )
        elif address in received:
            print(
                f"{address}: received, does not receive this host: open UDP ports {first} to "
                f"{last} there"
            )
        else:
            print(
                f"{address}: not received: start the command there; check the address, and UDP "
                f"ports {first} to {last} here"
            )
    if len(clocks) < len(others):
        raise typer.Exit(FAILED)
