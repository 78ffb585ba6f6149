# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Who can hear y and have a u flown: from another host, from this one, with a key and without (docs/security.md)."""

import json
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.conftest import REPOSITORY
from tests.ros.conftest import Process, Start
from tests.ros.peer import Peer, peer

from flight_analysis.closed_loop.scenario import Scenario
from flight_core.authentication import MessageAuthenticator
from flight_core.vectors import ChannelError
from flight_ros.messages import Decoder, Encoder
from flight_ros.topics import U
from flight_ros.transport import LOOPBACK_PROFILE

INPUTS = ("elevator", "thrust", "aileron", "rudder")
KEY, OTHER_KEY = bytes(range(32)), bytes(range(1, 33))
PATIENCE = 5.0
"""s that an outsider tries. One that gets through does so within 1 s on an idle machine (discovery 0.1 s, then y at 500 Hz)."""

BUSY = 120.0
"""s that a busy machine is left for what takes 1 s on an idle one: the start of a process, for the most part."""


# Signed samples, as bytes


def sealed(topic: str = "/u", key: bytes = KEY, since_ns: int | None = None) -> MessageAuthenticator:
    return MessageAuthenticator(key, topic, since_ns)


def u_message(stamp_ns: int, seal: MessageAuthenticator | None = None) -> bytes:
    return Encoder(INPUTS, "/controller#1", seal).encode(stamp_ns, np.array([0.1, 0.2, 0.3, 0.4]))


def refusal(decoder: Decoder, raw: bytes) -> str:
    with pytest.raises(ChannelError) as refused:
        decoder.decode(raw)
    return refused.value.reason


@pytest.mark.parametrize("seal", [None, sealed()], ids=["no key", "key"])
def test_a_signed_sample_is_read_with_the_key_and_by_those_who_have_none(seal: MessageAuthenticator | None) -> None:
    decoder = Decoder(INPUTS, seal)
    for stamp_ns in (5, 6, 7):  # the later ones take the short way
        sample = decoder.decode(u_message(stamp_ns, sealed()))
        assert sample is not None
        assert (sample.stamp_ns, sample.sender, sample.value.tolist()) == (stamp_ns, "/controller#1", [0.1, 0.2, 0.3, 0.4])


@given(st.data())
def test_no_changed_byte_of_a_signed_sample_passes(data: st.DataObject) -> None:
    raw = bytearray(u_message(5, sealed()))
    place = data.draw(st.integers(0, len(raw) - 1))
    raw[place] ^= data.draw(st.integers(1, 255))
    decoder = Decoder(INPUTS, sealed())
    decoder.decode(u_message(4, sealed()))
    assert refusal(decoder, bytes(raw)) == "mac"


@given(st.binary(max_size=300))
def test_no_bytes_of_others_pass(raw: bytes) -> None:
    assert refusal(Decoder(INPUTS, sealed()), raw) == "mac"


@pytest.mark.parametrize(
    "seal",
    [None, sealed(key=OTHER_KEY), sealed("/two/u"), sealed("/y")],
    ids=["no key", "another key", "another aircraft", "y"],
)
def test_a_sample_without_the_key_or_for_another_topic_is_refused(seal: MessageAuthenticator | None) -> None:
    assert refusal(Decoder(INPUTS, sealed()), u_message(5, seal)) == "mac"


def test_signed_samples_are_let_in_once_and_none_from_before_the_start() -> None:
    decoder = Decoder(INPUTS, sealed(since_ns=100))
    assert refusal(decoder, u_message(100, sealed())) == "order"
    assert decoder.decode(u_message(101, sealed())) is not None
    for stamp_ns in (101, 90):
        assert refusal(decoder, u_message(stamp_ns, sealed())) == "order"
    assert refusal(decoder, u_message(2**30, sealed(key=OTHER_KEY))) == "mac"  # and moves nothing
    assert decoder.decode(u_message(102, sealed())) is not None


def test_without_a_key_the_bytes_are_as_ever() -> None:
    signed, plain = u_message(5, sealed()), u_message(5)
    assert plain == Encoder(INPUTS, "/controller#1").encode(5, np.array([0.1, 0.2, 0.3, 0.4]))
    assert b";mac=" not in plain
    assert signed == u_message(5, sealed())  # in lockstep signed bytes repeat too


# This host


@pytest.fixture
def keys(tmp_path: Path) -> tuple[Path, Path]:
    """Two key files: that of the flight, and another one."""
    made = tmp_path / "key", tmp_path / "other"
    for path, key in zip(made, (KEY, OTHER_KEY), strict=True):
        path.write_bytes(key)
        path.chmod(0o600)
    return made


def aircraft(start: Start, scenario: Scenario, *told: str, within: tuple[str, ...] = ()) -> Process:
    process = start("aircraft_sim.main", "--ros-args", "--params-file", str(scenario.path), *told, within=within)
    process.wait_for("ready", BUSY)
    return process


def environment(**variables: str) -> tuple[str, ...]:
    return ("env", f"PYTHONPATH={REPOSITORY}", *(f"{name}={value}" for name, value in variables.items()))


ON_LOOPBACK = environment(FASTRTPS_DEFAULT_PROFILES_FILE=str(LOOPBACK_PROFILE), ROS_AUTOMATIC_DISCOVERY_RANGE="SYSTEM_DEFAULT")


def heard(outsider: Process) -> int:
    """How many y it heard, once it has ended."""
    assert outsider.end(BUSY) == 0, outsider.output
    return int(json.loads(outsider.lines[-1])["heard"])


def test_by_default_any_process_of_this_machine_hears_y_and_has_its_u_flown(start: Start, osprey_gust: Scenario) -> None:
    flown = aircraft(start, osprey_gust)
    assert heard(start("tests.ros.outsider", "30", within=ON_LOOPBACK)) > 0
    flown.wait_for("receiving u from /controller#1")


@pytest.mark.parametrize("number", [0, 1], ids=["no key", "another key"])
def test_with_a_key_no_process_of_this_machine_without_it_has_its_u_flown(
    number: int, start: Start, osprey_gust: Scenario, keys: tuple[Path, Path]
) -> None:
    flown = aircraft(start, osprey_gust, "-p", f"key_file:={keys[0]}")
    attacker = start("tests.ros.outsider", "30", *([str(keys[1])] if number else []), within=ON_LOOPBACK)
    assert heard(attacker) > 0  # what stays open: it can listen
    flown.wait_for("it is signed with another key" if number else "it is not signed")
    assert "receiving u from" not in flown.output


def test_with_the_key_it_is_flown(start: Start, osprey_gust: Scenario, keys: tuple[Path, Path]) -> None:
    flown = aircraft(start, osprey_gust, "-p", f"key_file:={keys[0]}")
    assert heard(start("tests.ros.outsider", "30", str(keys[0]), within=ON_LOOPBACK)) > 0
    flown.wait_for("receiving u from /controller#1")
    assert "sample refused" not in flown.output


@pytest.fixture
def peer_node() -> Iterator[Peer]:
    with peer(topics=("/diagnostics",)) as made:
        yield made


def counted(peer_node: Peer, reason: str) -> Callable[[], bool]:
    """Whether the diagnostics say that u were refused for it."""

    def is_counted() -> bool:
        values = [value for array in peer_node.received["/diagnostics"] for status in array.status for value in status.values]
        return any(value.key == f"refused u: {reason}" and int(value.value) > 0 for value in values)

    return is_counted


def test_what_was_overheard_is_not_flown_again(
    start: Start, osprey_gust: Scenario, keys: tuple[Path, Path], peer_node: Peer
) -> None:
    before = time.time_ns()
    first = aircraft(start, osprey_gust, "-p", f"key_file:={keys[0]}")
    publisher = peer_node.node.create_publisher(U.type, U.name, 10)
    sealed_u = Encoder(INPUTS, "/controller#1", sealed())
    overheard: list[bytes] = []

    def send() -> None:
        overheard.append(sealed_u.encode(time.time_ns(), np.zeros(4)))
        publisher.publish(overheard[-1])

    peer_node.until(lambda: "receiving u from" in first.output, BUSY, each=send)
    again = overheard[-1]
    peer_node.until(counted(peer_node, "order"), BUSY, each=lambda: publisher.publish(again))
    first.interrupt()
    assert first.end(BUSY) == 0
    # An aircraft that is started anew remembers nothing, and refuses what is older than itself.
    peer_node.received["/diagnostics"].clear()
    second = aircraft(start, osprey_gust, "-p", f"key_file:={keys[0]}")
    peer_node.until(counted(peer_node, "order"), BUSY, each=lambda: publisher.publish(again))
    peer_node.until(counted(peer_node, "mac"), BUSY, each=lambda: publisher.publish(u_message(before)))
    assert "receiving u from" not in second.output


def test_a_flight_with_a_key_is_flown_and_signed(
    start: Start, osprey_gust: Scenario, keys: tuple[Path, Path], tmp_path: Path
) -> None:
    text = osprey_gust.path.read_text(encoding="utf-8")
    for name in ("aircraft", "reference_model", "controller"):
        text = text.replace(f"/**/{name}:\n  ros__parameters:\n", f"/**/{name}:\n  ros__parameters:\n    key_file: {keys[0]}\n")
    scenario = tmp_path / "keyed.yaml"
    scenario.write_text(text, encoding="utf-8")
    flight = start("flight_cli.cli", "fly", str(scenario), "--lockstep", "--duration", "2", "--runs", str(tmp_path / "runs"))
    assert flight.end(BUSY) == 0, flight.output
    flown = start("flight_cli.cli", "replay", str(tmp_path / "runs" / "latest"))
    assert flown.end(BUSY) == 0, flown.output
    assert "every bit equal" in flown.output


@pytest.mark.parametrize(
    ("content", "mode", "sentence"),
    [
        (KEY, 0o640, "with mode 0640, expected a file of 32 bytes that its owner alone can read"),
        (KEY[:31], 0o600, "of 31 bytes, expected a file of 32 bytes"),
        (KEY + b"\n", 0o600, "of more than 32 bytes, expected"),
        (None, 0, "cannot be read (No such file or directory), expected"),
    ],
)
def test_a_key_file_that_is_none_stops_the_node(
    content: bytes | None, mode: int, sentence: str, start: Start, osprey_gust: Scenario, tmp_path: Path
) -> None:
    path = tmp_path / "bad"
    if content is not None:
        path.write_bytes(content)
        path.chmod(mode)
    node = start("aircraft_sim.main", "--ros-args", "--params-file", str(osprey_gust.path), "-p", f"key_file:={path}")
    assert node.end(BUSY) == 2
    assert f"error: aircraft.key_file: found {path} {sentence}" in node.output or sentence in node.output


# Another host: a network namespace of its own, joined by a pair of virtual Ethernet devices


class Hosts(NamedTuple):
    """What to start a process with on each of two hosts, and the address of the first."""

    first: tuple[str, ...]
    second: tuple[str, ...]
    address: str


@pytest.fixture
def hosts() -> Iterator[Hosts]:
    """Two hosts on one network. Skipped where this user may not make any."""
    unshare, nsenter, ip = (shutil.which(command) or "" for command in ("unshare", "nsenter", "ip"))
    if not (unshare and nsenter and ip):
        pytest.skip("no unshare, nsenter (util-linux) or ip (iproute2) here")
    holders = [subprocess.Popen([unshare, "--net", "sleep", "300"], stderr=subprocess.PIPE) for _ in range(2)]
    try:
        places = [(nsenter, f"--net=/proc/{holder.pid}/ns/net") for holder in holders]
        own = Path("/proc/self/ns/net").readlink()
        for holder in holders:
            deadline = time.monotonic() + 5.0
            while holder.poll() is None and Path(f"/proc/{holder.pid}/ns/net").readlink() == own:
                assert time.monotonic() < deadline
                time.sleep(0.01)
            if holder.poll() is not None:
                assert holder.stderr is not None
                pytest.skip(f"no network namespace for this user: {holder.stderr.read().decode().strip()}")
        name = f"rd{holders[0].pid % 100_000}"
        pair = [ip, "link", "add", name, "netns", str(holders[0].pid), "type", "veth"]
        pair += ["peer", "name", name, "netns", str(holders[1].pid)]
        made = subprocess.run(pair, capture_output=True, text=True, check=False)
        if made.returncode:
            pytest.skip(f"no virtual Ethernet devices for this user: {made.stderr.strip()}")
        for number, place in enumerate(places, start=1):
            for command in (
                ["addr", "add", f"10.77.0.{number}/24", "dev", name],
                ["link", "set", name, "up"],
                ["link", "set", "lo", "up"],
            ):
                subprocess.run([*place, ip, *command], check=True)
        for place in places:  # Linux says so up to a second later, and Fast DDS passes over a device that is not up
            deadline = time.monotonic() + 5.0
            while (
                "state UP"
                not in subprocess.run([*place, ip, "link", "show", name], capture_output=True, text=True, check=False).stdout
            ):
                assert time.monotonic() < deadline
                time.sleep(0.01)
        yield Hosts(places[0], places[1], "10.77.0.1")
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
"""  # UDP alone: namespaces of one machine share its memory, which hosts do not


@pytest.fixture
def on_network(tmp_path: Path) -> tuple[str, ...]:
    """The environment of a process whose transport is the network."""
    profile = tmp_path / "open.xml"
    profile.write_text(OPEN_PROFILE, encoding="utf-8")
    return environment(
        FASTRTPS_DEFAULT_PROFILES_FILE=str(profile),
        ROS_AUTOMATIC_DISCOVERY_RANGE="SUBNET",
        ROS_STATIC_PEERS="10.77.0.1;10.77.0.2",
    )


def test_by_default_nobody_on_another_host_hears_y_or_has_its_u_flown(
    start: Start, osprey_gust: Scenario, hosts: Hosts, on_network: tuple[str, ...]
) -> None:
    flown = aircraft(start, osprey_gust, within=hosts.first)
    assert heard(start("tests.ros.outsider", f"{PATIENCE}", within=(*hosts.second, *on_network))) == 0
    assert "receiving u from" not in flown.output
    assert "sample refused" not in flown.output  # not even an attempt has arrived


def test_on_a_network_of_its_own_profile_another_host_hears_y_and_has_its_u_flown(
    start: Start, osprey_gust: Scenario, hosts: Hosts, on_network: tuple[str, ...]
) -> None:
    flown = aircraft(start, osprey_gust, within=(*hosts.first, *on_network))
    assert heard(start("tests.ros.outsider", "30", within=(*hosts.second, *on_network))) > 0
    flown.wait_for("receiving u from /controller#1")


def test_on_a_network_with_a_key_another_host_hears_y_but_has_no_u_flown(
    start: Start, osprey_gust: Scenario, hosts: Hosts, on_network: tuple[str, ...], keys: tuple[Path, Path]
) -> None:
    flown = aircraft(start, osprey_gust, "-p", f"key_file:={keys[0]}", within=(*hosts.first, *on_network))
    assert heard(start("tests.ros.outsider", "30", within=(*hosts.second, *on_network))) > 0
    flown.wait_for("it is not signed")
    assert "receiving u from" not in flown.output
