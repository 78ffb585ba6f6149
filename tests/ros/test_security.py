# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Attacks from this host and from another one, with and without a key: message authentication, replay protection, transport."""

import json
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.conftest import REPOSITORY
from tests.recordings import scenario_file
from tests.ros.conftest import Process, Start
from tests.ros.peer import INPUTS, Peer

from flight_analysis.closed_loop.scenario import Scenario
from flight_core.authentication import MessageAuthenticator
from flight_core.vectors import ChannelError, require_not_future
from flight_ros.messages import Decoder, Encoder
from flight_ros.topics import U
from flight_ros.transport import LOOPBACK_PROFILE, open_to_network

pytestmark = pytest.mark.package("flight_ros")

Keys = tuple[Path, Path]
PEER_TOPICS = ("/diagnostics",)
KEY, OTHER_KEY = bytes(range(32)), bytes(range(1, 33))
PATIENCE = 5.0
"""s of an attack. A successful one takes 1 s on an idle host (discovery 0.1 s, then y at 500 Hz)."""


# Message authentication


def make_authenticator(topic: str = "/u", key: bytes = KEY, since_ns: int | None = None) -> MessageAuthenticator:
    return MessageAuthenticator(key, topic, since_ns)


def u_message(stamp_ns: int, authenticator: MessageAuthenticator | None = None) -> bytes:
    return Encoder(INPUTS, "/controller#1", authenticator).encode(stamp_ns, np.array([0.1, 0.2, 0.3, 0.4]))


def take(decoder: Decoder, raw: bytes) -> None:
    sample = decoder.decode(raw)
    assert sample is not None
    with decoder.once(sample.stamp_ns):
        pass


def rejection(decoder: Decoder, raw: bytes) -> str:
    with pytest.raises(ChannelError) as rejected:
        take(decoder, raw)
    return rejected.value.reason


@pytest.mark.parametrize("authenticator", [None, make_authenticator()], ids=["no key", "key"])
def test_a_signed_sample_is_decoded_with_the_key_and_without_one(authenticator: MessageAuthenticator | None) -> None:
    decoder = Decoder(INPUTS, authenticator)
    for stamp_ns in (5, 6, 7):  # the later ones have a known layout
        sample = decoder.decode(u_message(stamp_ns, make_authenticator()))
        assert sample is not None
        assert (sample.stamp_ns, sample.sender, sample.value.tolist()) == (stamp_ns, "/controller#1", [0.1, 0.2, 0.3, 0.4])


@given(st.data())
def test_a_signed_sample_with_a_changed_byte_is_rejected(data: st.DataObject) -> None:
    raw = bytearray(u_message(5, make_authenticator()))
    place = data.draw(st.integers(0, len(raw) - 1))
    raw[place] ^= data.draw(st.integers(1, 255))
    decoder = Decoder(INPUTS, make_authenticator())
    decoder.decode(u_message(4, make_authenticator()))
    assert rejection(decoder, bytes(raw)) == "mac"


@given(st.binary(max_size=300))
def test_arbitrary_bytes_are_rejected(raw: bytes) -> None:
    assert rejection(Decoder(INPUTS, make_authenticator()), raw) == "mac"


@pytest.mark.parametrize(
    "authenticator",
    [None, make_authenticator(key=OTHER_KEY), make_authenticator("/two/u"), make_authenticator("/y")],
    ids=["no key", "another key", "another aircraft", "y"],
)
def test_a_sample_without_the_key_or_for_another_topic_is_rejected(authenticator: MessageAuthenticator | None) -> None:
    assert rejection(Decoder(INPUTS, make_authenticator()), u_message(5, authenticator)) == "mac"


def test_replay_protection_accepts_a_sample_once_and_none_from_before_the_start() -> None:
    decoder = Decoder(INPUTS, make_authenticator(since_ns=100))
    assert rejection(decoder, u_message(100, make_authenticator())) == "order"
    take(decoder, u_message(101, make_authenticator()))
    for stamp_ns in (101, 90):
        assert rejection(decoder, u_message(stamp_ns, make_authenticator())) == "order"
    assert rejection(decoder, u_message(2**30, make_authenticator(key=OTHER_KEY))) == "mac"  # without effect on the last stamp
    take(decoder, u_message(102, make_authenticator()))


def test_a_signed_sample_that_is_refused_for_another_reason_makes_no_earlier_one_stale() -> None:
    decoder = Decoder(INPUTS, make_authenticator(since_ns=100))
    with pytest.raises(ChannelError, match="conflicting publisher"), decoder.once(2**30):
        raise ChannelError("sender", "conflicting publisher /controller#2 ignored")
    take(decoder, u_message(101, make_authenticator()))


def test_a_signed_sample_that_was_ahead_of_the_clock_cannot_be_replayed_when_its_time_comes() -> None:
    decoder = Decoder(INPUTS, make_authenticator(since_ns=100))
    with pytest.raises(ChannelError, match="ahead of the clock"), decoder.once(10**9):
        require_not_future(10**9, 200, 100)
    take(decoder, u_message(101, make_authenticator()))
    assert rejection(decoder, u_message(10**9, make_authenticator())) == "order"
    take(decoder, u_message(10**9 + 1, make_authenticator()))


def test_without_a_key_a_message_has_no_code() -> None:
    signed, plain = u_message(5, make_authenticator()), u_message(5)
    assert plain == Encoder(INPUTS, "/controller#1").encode(5, np.array([0.1, 0.2, 0.3, 0.4]))
    assert b";mac=" not in plain
    assert signed == u_message(5, make_authenticator())  # signed bytes are repeatable, as lockstep requires


# Attacks from this host


@pytest.fixture
def keys(tmp_path: Path) -> Keys:
    """Two key files: the one of the flight, and another one."""
    made = tmp_path / "key", tmp_path / "other"
    for path, key in zip(made, (KEY, OTHER_KEY), strict=True):
        path.write_bytes(key)
        path.chmod(0o600)
    return made


def aircraft(start_node: Start, *arguments: str, within: tuple[str, ...] = ()) -> Process:
    return start_node("aircraft_sim", *arguments, within=within).wait_for("ready")


def environment(**variables: str) -> tuple[str, ...]:
    return ("env", f"PYTHONPATH={REPOSITORY}", *(f"{name}={value}" for name, value in variables.items()))


ON_LOOPBACK = environment(FASTRTPS_DEFAULT_PROFILES_FILE=str(LOOPBACK_PROFILE), ROS_AUTOMATIC_DISCOVERY_RANGE="SYSTEM_DEFAULT")


def received(attacker: Process) -> int:
    """Number of samples of y that the attacker received until its end."""
    attacker.succeed()
    return int(json.loads(attacker.lines[-1])["received"])


ACCEPTED, REJECTED = "receiving u from", "sample refused"


@pytest.mark.parametrize(
    ("node_key", "attacker_key", "logged", "not_logged"),
    [
        (None, None, "receiving u from /controller#1", REJECTED),
        (0, None, "no message authentication code", ACCEPTED),
        (0, 1, "wrong message authentication code", ACCEPTED),
        (0, 0, "receiving u from /controller#1", REJECTED),
    ],
    ids=["by default", "no key", "another key", "the key"],
)
def test_a_process_of_this_host_receives_y_and_commands_u_unless_it_lacks_the_key(
    node_key: int | None, attacker_key: int | None, logged: str, not_logged: str, start: Start, start_node: Start, keys: Keys
) -> None:
    node = aircraft(start_node, *(() if node_key is None else ("-p", f"key_file:={keys[node_key]}")))
    key = () if attacker_key is None else (str(keys[attacker_key]),)
    assert received(start("tests.ros.attacker", "30", *key, within=ON_LOOPBACK)) > 0  # y is not encrypted
    node.wait_for(logged)
    assert not_logged not in node.output


def test_a_replayed_u_is_rejected_also_after_a_restart(start_node: Start, keys: Keys, peer_node: Peer) -> None:
    before = time.time_ns()
    first = aircraft(start_node, "-p", f"key_file:={keys[0]}")
    publisher = peer_node.node.create_publisher(U.type, U.name, 10)
    encoder = Encoder(INPUTS, "/controller#1", make_authenticator())
    recorded: list[bytes] = []

    def send() -> None:
        recorded.append(encoder.encode(time.time_ns(), np.zeros(4)))
        publisher.publish(recorded[-1])

    peer_node.until(lambda: "receiving u from" in first.output, each=send)
    replayed = recorded[-1]
    peer_node.until(partial(peer_node.counted, "refused u: order"), each=lambda: publisher.publish(replayed))
    first.interrupt().succeed()
    # A restarted aircraft has no memory of the last stamp, but rejects samples from before its start.
    peer_node.received["/diagnostics"].clear()
    second = aircraft(start_node, "-p", f"key_file:={keys[0]}")
    peer_node.until(partial(peer_node.counted, "refused u: order"), each=lambda: publisher.publish(replayed))
    peer_node.until(partial(peer_node.counted, "refused u: mac"), each=lambda: publisher.publish(u_message(before)))
    assert "receiving u from" not in second.output


def test_a_second_controller_with_the_key_and_newer_stamps_does_not_take_over(
    start_node: Start, keys: Keys, peer_node: Peer
) -> None:
    node = aircraft(start_node, "-p", f"key_file:={keys[0]}")
    publisher = peer_node.node.create_publisher(U.type, U.name, 10)
    first, second = (Encoder(INPUTS, f"/controller#{number}", make_authenticator()) for number in (1, 2))
    late_ns = 20_000_000  # as with a y that is 20 ms late

    def send(*others: Encoder) -> None:
        stamp_ns = time.time_ns() - late_ns
        publisher.publish(first.encode(stamp_ns, np.zeros(4)))
        for other in others:
            publisher.publish(other.encode(stamp_ns, np.zeros(4)))  # of the same y
            publisher.publish(other.encode(time.time_ns(), np.zeros(4)))

    peer_node.until(lambda: "receiving u from /controller#1" in node.output, each=send)
    # 200 of them, two at a time, last 0.5 s or more. The age limit of u, after which the same node in another process takes
    # over, is 0.2 s.
    peer_node.until(partial(peer_node.counted, "refused u: sender", 200), each=lambda: send(second))
    assert not peer_node.counted("refused u: order")
    assert "receiving u from /controller#2" not in node.output


def test_a_keyed_flight_is_signed_and_replays_exactly(start: Start, osprey_gust: Scenario, keys: Keys, tmp_path: Path) -> None:
    keyed = {node: {"key_file": str(keys[0])} for node in ("aircraft", "reference_model", "controller")}
    scenario = scenario_file(tmp_path / "keyed.yaml", osprey_gust.path, **keyed)
    flight = start("flight_cli.cli", "fly", str(scenario), "--lockstep", "--duration", "2", "--runs", str(tmp_path / "runs"))
    flight.succeed()
    node = start("flight_cli.cli", "replay", str(tmp_path / "runs" / "latest")).succeed()
    assert "every bit equal" in node.output


@pytest.mark.parametrize(
    ("content", "mode", "sentence"),
    [
        (KEY, 0o640, "found {path} with mode 0640, expected a file of 32 bytes that its owner alone can read"),
        (KEY[:31], 0o600, "found {path} of 31 bytes, expected a file of 32 bytes"),
        (KEY + b"\n", 0o600, "found {path} of more than 32 bytes, expected"),
        (None, 0, "{path} cannot be read (No such file or directory), expected"),
    ],
)
def test_an_invalid_key_is_an_error(content: bytes | None, mode: int, sentence: str, start_node: Start, tmp_path: Path) -> None:
    path = tmp_path / "bad"
    if content is not None:
        path.write_bytes(content)
        path.chmod(mode)
    node = start_node("aircraft_sim", "-p", f"key_file:={path}")
    assert node.end() == 2
    assert f"error: aircraft.key_file: {sentence.format(path=path)}" in node.output


# Sockets


class EarlierProcess(psutil.Process):
    """As psutil has it before release 6."""

    connections = psutil.Process.net_connections

    @property
    def net_connections(self) -> None:  # type: ignore[override]
        """Raise AttributeError."""
        raise AttributeError


@pytest.mark.parametrize("process", [psutil.Process, EarlierProcess])
def test_a_socket_on_all_interfaces_is_found_in_spite_of_the_loopback_profile(
    process: type[psutil.Process], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(psutil, "Process", process)
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", str(LOOPBACK_PROFILE))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as local:
        opened.bind(("0.0.0.0", 0))  # noqa: S104 - on purpose, for nothing to read
        local.bind(("127.0.0.1", 0))
        found = open_to_network()
        assert f"0.0.0.0:{opened.getsockname()[1]}" in found
        assert not any(one.endswith(f":{local.getsockname()[1]}") for one in found)


# Attacks from another host: a separate network namespace, connected by a pair of virtual Ethernet devices


class Hosts(NamedTuple):
    """The commands that start a process on each of two hosts."""

    first: tuple[str, ...]
    second: tuple[str, ...]


def wait_until(condition: Callable[[Any], bool], argument: Any) -> None:
    deadline = time.monotonic() + 5.0
    while not condition(argument):
        assert time.monotonic() < deadline
        time.sleep(0.01)


def is_separate(holder: subprocess.Popen[bytes]) -> bool:
    """Whether the process has left this network namespace, or has ended."""
    own, other = Path("/proc/self/ns/net"), Path(f"/proc/{holder.pid}/ns/net")
    return holder.poll() is not None or other.readlink() != own.readlink()


def is_up(show_link: list[str]) -> bool:
    return b"state UP" in subprocess.run(show_link, capture_output=True, check=False).stdout


@pytest.fixture
def hosts() -> Iterator[Hosts]:
    """Two hosts on one network. Skipped without the permission to create them."""
    unshare, nsenter, ip = (shutil.which(command) or "" for command in ("unshare", "nsenter", "ip"))
    if not (unshare and nsenter and ip):
        pytest.skip("no unshare, nsenter (util-linux) or ip (iproute2) here")
    holders = [subprocess.Popen([unshare, "--net", "sleep", "300"], stderr=subprocess.PIPE) for _ in range(2)]
    try:
        places = [(nsenter, f"--net=/proc/{holder.pid}/ns/net") for holder in holders]
        for holder in holders:
            wait_until(is_separate, holder)
            if holder.poll() is not None:
                assert holder.stderr is not None
                pytest.skip(f"no network namespace for this user: {holder.stderr.read().decode().strip()}")
        name = f"rd{holders[0].pid % 100_000}"
        first, second = (holder.pid for holder in holders)
        pair = f"link add {name} netns {first} type veth peer name {name} netns {second}"
        made = subprocess.run([ip, *pair.split()], capture_output=True, text=True, check=False)
        if made.returncode:
            pytest.skip(f"no virtual Ethernet devices for this user: {made.stderr.strip()}")
        for number, place in enumerate(places, start=1):
            for command in (f"addr add 10.77.0.{number}/24 dev {name}", f"link set {name} up", "link set lo up"):
                subprocess.run([*place, ip, *command.split()], check=True)
        for place in places:  # it takes up to a second, and Fast DDS ignores a device that is not up
            wait_until(is_up, [*place, ip, "link", "show", name])
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
    """The environment of a process with network transport."""
    profile = tmp_path / "open.xml"
    profile.write_text(OPEN_PROFILE, encoding="utf-8")
    discovery = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "ROS_STATIC_PEERS": "10.77.0.1;10.77.0.2"}
    return environment(FASTRTPS_DEFAULT_PROFILES_FILE=str(profile), **discovery)


def test_by_default_another_host_neither_receives_y_nor_commands_u(
    start: Start, start_node: Start, hosts: Hosts, on_network: tuple[str, ...]
) -> None:
    node = aircraft(start_node, within=hosts.first)
    assert received(start("tests.ros.attacker", f"{PATIENCE}", within=(*hosts.second, *on_network))) == 0
    assert "receiving u from" not in node.output
    assert "sample refused" not in node.output  # no sample has arrived


@pytest.mark.parametrize("keyed", [False, True], ids=["no key", "key"])
def test_with_a_network_profile_another_host_receives_y_and_commands_u_unless_there_is_a_key(
    keyed: bool, start: Start, start_node: Start, hosts: Hosts, on_network: tuple[str, ...], keys: Keys
) -> None:
    key = ("-p", f"key_file:={keys[0]}") if keyed else ()
    node = aircraft(start_node, *key, within=(*hosts.first, *on_network))
    assert received(start("tests.ros.attacker", "30", within=(*hosts.second, *on_network))) > 0
    node.wait_for("no message authentication code" if keyed else "receiving u from /controller#1")
    assert (ACCEPTED in node.output) is not keyed
