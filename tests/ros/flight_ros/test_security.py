# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test attacks from this host and from another: reception of y, forged u, transport."""

import json
import shutil
import subprocess
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pytest
from tests.conftest import REPOSITORY
from tests.ros.conftest import Process, Start
from tests.ros.waiting import until

from flight_ros.transport import LOOPBACK_PROFILE

PATIENCE = 5.0
"""s of an attack. A successful one takes 1 s on an idle host (discovery 0.1 s, then y at 500
Hz)."""


# Attacks from this host


def aircraft(start_node: Start, *arguments: str, within: tuple[str, ...] = ()) -> Process:
    return start_node("aircraft_sim", *arguments, within=within).wait_for("ready")


def environment(**variables: str) -> tuple[str, ...]:
    return (
        "env",
        f"PYTHONPATH={REPOSITORY}",
        *(f"{name}={value}" for name, value in variables.items()),
    )


ON_LOOPBACK = environment(
    FASTRTPS_DEFAULT_PROFILES_FILE=str(LOOPBACK_PROFILE),
    ROS_AUTOMATIC_DISCOVERY_RANGE="SYSTEM_DEFAULT",
)


def received(attacker: Process) -> int:
    """Return how many samples of y the attacker received until its end."""
    attacker.succeed()
    return int(json.loads(attacker.lines[-1])["received"])


def test_process_of_this_host_receives_y_and_commands_u(start: Start, start_node: Start) -> None:
    node = aircraft(start_node)
    assert received(start("tests.ros.attacker", "30", within=ON_LOOPBACK)) > 0
    node.wait_for("receiving u from /controller#1")
    assert "sample refused" not in node.output


# Attacks from another host: a separate network namespace, connected by a pair of virtual Ethernet
# devices


class Hosts(NamedTuple):
    """The commands that start a process on each of two hosts."""

    first: tuple[str, ...]
    second: tuple[str, ...]


def is_separate(holder: subprocess.Popen[bytes]) -> bool:
    """Return whether the process has left this network namespace, or has ended."""
    own_namespace = Path("/proc/self/ns/net")
    holder_namespace = Path(f"/proc/{holder.pid}/ns/net")
    return holder.poll() is not None or holder_namespace.readlink() != own_namespace.readlink()


def is_up(show_link: list[str]) -> bool:
    return b"state UP" in subprocess.run(show_link, capture_output=True, check=False).stdout


@pytest.fixture
def hosts() -> Iterator[Hosts]:
    """Yield two hosts on one network. The test is skipped without the permission to create them."""
    unshare, nsenter, ip = (shutil.which(command) or "" for command in ("unshare", "nsenter", "ip"))
    if not (unshare and nsenter and ip):
        pytest.skip("no unshare, nsenter (util-linux) or ip (iproute2) here")
    holders = [
        subprocess.Popen([unshare, "--net", "sleep", "300"], stderr=subprocess.PIPE)
        for _ in range(2)
    ]
    try:
        places = [(nsenter, f"--net=/proc/{holder.pid}/ns/net") for holder in holders]
        for holder in holders:
            until(partial(is_separate, holder), "a namespace of its own")
            if holder.poll() is not None:
                assert holder.stderr is not None
                pytest.skip(
                    f"no network namespace for this user: {holder.stderr.read().decode().strip()}"
                )
        name = f"rd{holders[0].pid % 100_000}"
        first, second = (holder.pid for holder in holders)
        pair = f"link add {name} netns {first} type veth peer name {name} netns {second}"
        result = subprocess.run([ip, *pair.split()], capture_output=True, text=True, check=False)
        if result.returncode:
            pytest.skip(f"no virtual Ethernet devices for this user: {result.stderr.strip()}")
        for number, place in enumerate(places, start=1):
            for command in (
                f"addr add 10.77.0.{number}/24 dev {name}",
                f"link set {name} up",
                "link set lo up",
            ):
                subprocess.run([*place, ip, *command.split()], check=True)
        # it takes up to a second, and Fast DDS ignores a device that is not up
        for place in places:
            until(partial(is_up, [*place, ip, "link", "show", name]), "a device that is up")
        yield Hosts(*places)
    finally:
        for holder in holders:
            holder.kill()
            holder.communicate()


OPEN_PROFILE = """<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <transport_descriptors>
    <transport_descriptor><transport_id>udp</transport_id><type>UDPv4</type></transport_descriptor>
  </transport_descriptors>
  <participant profile_name="open" is_default_profile="true"><rtps>
    <userTransports><transport_id>udp</transport_id></userTransports><useBuiltinTransports>false</useBuiltinTransports>
  </rtps></participant>
</profiles>
"""  # UDP alone: namespaces of one host share its memory, which hosts do not


@pytest.fixture
def on_network(tmp_path: Path) -> tuple[str, ...]:
    """Return the environment of a process with network transport."""
    profile = tmp_path / "open.xml"
    profile.write_text(OPEN_PROFILE)
    discovery = {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
        "ROS_STATIC_PEERS": "10.77.0.1;10.77.0.2",
    }
    return environment(FASTRTPS_DEFAULT_PROFILES_FILE=str(profile), **discovery)


def test_second_host_has_access_by_network_profile_alone(
    start: Start, start_node: Start, hosts: Hosts, on_network: tuple[str, ...]
) -> None:
    """Without the profile, the second host neither receives y nor commands u.

    With it, each host reports the other one.
    """
    node = aircraft(start_node, within=hosts.first)
    assert (
        received(start("tests.ros.attacker", f"{PATIENCE}", within=(*hosts.second, *on_network)))
        == 0
    )
    assert "receiving u from" not in node.output
    assert "sample refused" not in node.output  # no sample has arrived
    node.interrupt().succeed()

    node = aircraft(start_node, within=(*hosts.first, *on_network))
    assert received(start("tests.ros.attacker", "30", within=(*hosts.second, *on_network))) > 0
    node.wait_for("receiving u from /controller#1")
    node.interrupt().succeed()

    arguments = ("flight_cli.cli", "network", "--peers", "10.77.0.1,10.77.0.2", "--check")
    first, second = (
        start(*arguments, "--write", f"{k}.xml", within=(*place, *environment()))
        for k, place in enumerate((hosts.first, hosts.second))
    )
    for host, peer_address in ((first.succeed(), "10.77.0.2"), (second.succeed(), "10.77.0.1")):
        (line,) = (line for line in host.lines if line.startswith(f"{peer_address}: "))
        assert "received, receives this host; delay" in line
        assert "its clock is 0.00" in line  # hosts of one computer share the clock
