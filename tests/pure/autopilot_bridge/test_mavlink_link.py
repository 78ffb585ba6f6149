# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the MAVLink link over UDP with a peer that is made with pymavlink alone."""

import hashlib
import re
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from pytest import approx
from tests.conftest import refusing
from tests.maps import named_map

from autopilot_bridge.channel_map import set_field
from autopilot_bridge.map_rows import LinkConfig
from autopilot_bridge.mavlink_link import COMPANION, Link, mavlink_type
from autopilot_bridge.params import ChannelMap
from flight_core.vectors import ChannelError

DENIED = 2  # MAV_RESULT_DENIED, which ArduPilot answers to a rate that it does not grant
STATION_SILENCE = 5.0  # s
SENDER = ("127.0.0.1", 14550)
PATIENCE = 5.0  # s, a guard: what is awaited takes some ms


class Peer:
    """An autopilot's end of a link. It answers requests for rates, and grants at most 40 Hz."""

    def __init__(
        self, port: int, system: int = 1, phrase: str = "", component: int = 1, kind: str = "udpout"
    ) -> None:
        self.connection: Any = mavutil.mavlink_connection(
            f"{kind}:127.0.0.1:{port}",
            source_system=system,
            source_component=component,
            dialect="ardupilotmega",
        )
        # Of MAVLink 2 from the begin: the parser that pymavlink makes at the first packet of
        # MAVLink 2 has no passphrase.
        self.connection.mav = mavlink.MAVLink(
            self.connection, srcSystem=system, srcComponent=component
        )
        self.connection.mav.robust_parsing, self.connection.first_byte = True, False
        if phrase:
            self.connection.setup_signing(hashlib.sha256(phrase.encode()).digest())
        self.requested: dict[int, float] = {}  # Hz by message

    def beat(self) -> None:
        """Send a heartbeat, armed and in MANUAL."""
        time.sleep(0.01)
        self.connection.mav.heartbeat_send(mavlink.MAV_TYPE_FIXED_WING, 3, 128, 0, 4)

    def attitude(self, pitchspeed: float, since_boot: float) -> None:
        """Send an ATTITUDE, rad/s, with the time since boot, s."""
        self.connection.mav.attitude_send(
            round(1e3 * since_boot), 0.0, 0.0, 0.0, 0.0, pitchspeed, 0.0
        )

    def received(self) -> list[Any]:
        """Return all messages that have arrived and were not taken yet."""
        return list(iter(self.connection.recv_msg, None))

    def answer(self) -> Any:
        """Return the next message, and answer it if it is a request."""
        message = self.connection.recv_match(blocking=True, timeout=0.05)
        if message is not None and message.get_type() == "COMMAND_LONG":
            self.requested[int(message.param1)] = 1e6 / message.param2
            result = 0 if 1e6 / message.param2 <= 40.0 else DENIED
            self.connection.mav.command_ack_send(message.command, result)
        return message


class Ends(NamedTuple):
    """A maker of links that listen on a free port, and of peers."""

    link: Callable[..., tuple[Link, int]]
    peer: Callable[..., Peer]

    def started(self, *names: str, **options: Any) -> Any:
        """Return a link that receives, its port, and the queues of messages with some names."""
        made, port = self.link(**options)
        queues = [made.listen(name) for name in names]
        made.start()
        return made, port, *queues


@pytest.fixture
def ends() -> Iterator[Ends]:
    links: list[Link] = []
    peers: list[Peer] = []

    def make(
        passphrase_file: str | None = None,
        kind: str = "udpin",
        at: int = 0,
        parameters: Sequence[str] = (),
        **rates: float,
    ) -> tuple[Link, int]:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            port = at or free.getsockname()[1]
        url = f"{kind}:127.0.0.1:{port}"
        config = LinkConfig(
            url=url, rates=rates, passphrase_file=passphrase_file, station_silence=STATION_SILENCE
        )
        links.append(Link(config, parameters))
        return links[-1], port

    def peer(port: int, **options: Any) -> Peer:
        peers.append(Peer(port, **options))
        return peers[-1]

    yield Ends(make, peer)
    for made in links:
        made.close()
    for end in peers:
        end.connection.close()


@pytest.fixture
def phrase(tmp_path: Path) -> str:
    """Return the file of a passphrase."""
    (tmp_path / "passphrase").write_text("a phrase\n")
    return str(tmp_path / "passphrase")


BEAT = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_FIXED_WING, 3, 128, 0, 4, 3)


def received(message: Any, system: int = 1, component: int = 1) -> Any:
    """Return a message as it is decoded after it was sent over a link."""
    packed = message.pack(mavlink.MAVLink(None, srcSystem=system, srcComponent=component))
    return mavlink.MAVLink(None).parse_char(packed)


class Clock:
    """A monotonic clock that the test sets, s."""

    now = 1000.0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr("autopilot_bridge.mavlink_link.time.monotonic", lambda: made.now)
    return made


def until(condition: Callable[[], object], each: Callable[[], object]) -> None:
    """Call `each` until the condition is true."""
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end
        each()


def test_rates_are_requested_one_by_one_and_a_denied_one_is_named(ends: Ends) -> None:
    made, port = ends.started(ATTITUDE=50.0, VFR_HUD=20.0)
    peer = ends.peer(port)
    peer.beat()
    until(lambda: made.problem("ATTITUDE") and len(peer.requested) == 2, peer.answer)
    assert peer.requested == {
        mavlink.MAVLINK_MSG_ID_ATTITUDE: approx(50.0),
        mavlink.MAVLINK_MSG_ID_VFR_HUD: approx(20.0),
    }
    assert str(made.problem()) == (
        "the autopilot denied 50 Hz of ATTITUDE (MAV_RESULT 2): ArduPilot grants 0.8 "
        "SCHED_LOOP_RATE"
    )
    assert made.problem("VFR_HUD") is None


def test_messages_of_the_autopilot_arrive_with_their_instant_and_those_of_others_do_not(
    ends: Ends,
) -> None:
    made, port, queue = ends.started("ATTITUDE")
    before = time.time_ns()
    ends.peer(port, system=2).connection.mav.attitude_send(1, 0.9, 0.9, 0.9, 0.9, 0.9, 0.9)
    peer = ends.peer(port)

    def send() -> None:
        peer.beat()
        peer.connection.mav.attitude_send(1, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)

    until(lambda: queue, send)
    assert [received.message.pitchspeed for received in queue] == [approx(0.5)] * len(queue)
    assert before <= queue[0].received_ns <= time.time_ns()
    assert made.conflict is None


def test_override_reaches_the_autopilot_and_leaves_other_channels(ends: Ends) -> None:
    made, port = ends.started()
    peer = ends.peer(port)
    peer.beat()
    message = mavlink_type("RC_CHANNELS_OVERRIDE")()
    for path, value in {
        **named_map("ardupilot_mavlink").messages["override"].values,
        "chan2_raw": 1612.4,
    }.items():
        set_field(message, path, value)
    taken: list[Any] = []

    def take() -> None:
        made.send(message)
        if (
            received := peer.answer()
        ) is not None and received.get_type() == "RC_CHANNELS_OVERRIDE":
            taken.append(received)

    until(lambda: taken, take)
    sent = taken[0]
    assert (sent.get_srcSystem(), sent.target_system, sent.target_component) == (255, 1, 1)
    # The channels are released, set, as is, as is.
    assert [getattr(sent, f"chan{n}_raw") for n in (1, 2, 5, 9)] == [0, 1612, 65535, 0]


def test_second_sender_is_conflict_is_not_taken_and_gets_nothing(ends: Ends) -> None:
    """Only one autopilot is flown, as on a topic.

    Another one may be a second aircraft, or a program of this host.
    """
    made, port, queue = ends.started("ATTITUDE")
    autopilot = ends.peer(port)
    second = ends.peer(port)
    autopilot.attitude(0.1, since_boot=50.0)
    until(lambda: queue, autopilot.received)
    second.attitude(0.9, since_boot=50.0)  # also with the right time since boot
    until(lambda: made.conflict, autopilot.received)
    locked, foreign = (end.connection.port.getsockname()[1] for end in (autopilot, second))
    assert str(made.conflict) == (
        f"a second sender, 127.0.0.1:{foreign}, sends as the autopilot: 127.0.0.1:{locked} was "
        "first and is taken alone"
    )
    assert str(made.conflict) in str(made.problem())
    autopilot.attitude(0.1, since_boot=50.1)
    until(lambda: len(queue) == 2, autopilot.received)
    assert [received.message.pitchspeed for received in queue] == [approx(0.1)] * 2
    overrides: list[Any] = []

    def send() -> None:
        made.send(mavlink_type("RC_CHANNELS_OVERRIDE")())
        overrides.extend(
            message
            for message in autopilot.received()
            if message.get_type() == "RC_CHANNELS_OVERRIDE"
        )

    until(lambda: len(overrides) >= 5, send)
    assert second.received() == []  # neither overrides nor heartbeats nor requests


def test_next_sender_gets_the_messages_once_the_first_one_is_silent(
    ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("autopilot_bridge.mavlink_link.SILENCE", 0.05)  # s
    made, port = ends.started(HEARTBEAT=5.0)
    first = ends.peer(port)
    second = ends.peer(port)
    until(first.received, first.beat)
    until(second.received, second.beat)
    first.received()
    messages: list[Any] = []

    def send() -> None:
        second.beat()
        made.send(mavlink_type("RC_CHANNELS_OVERRIDE")())
        messages.extend(second.received())

    until(lambda: "RC_CHANNELS_OVERRIDE" in [message.get_type() for message in messages], send)
    assert first.received() == []


def test_conflict_of_second_sender_ends_after_its_last_message(
    ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, port = ends.started()
    autopilot = ends.peer(port)
    second = ends.peer(port)
    autopilot.beat()
    until(lambda: made.conflict, second.beat)
    now = time.monotonic
    monkeypatch.setattr("autopilot_bridge.mavlink_link.time.monotonic", lambda: now() + 3.1)
    assert made.conflict is None


def test_second_clock_behind_the_address_of_the_autopilot_is_conflict(ends: Ends) -> None:
    """Two autopilots with one number behind a router have the same address.

    Their times since boot differ.
    """
    made, port, queue = ends.started("ATTITUDE")
    router = ends.peer(port)
    for pitchspeed, since_boot in (
        (0.1, 100.0),
        (0.9, 40.0),
        (0.1, 100.1),
        (0.9, 400.0),
        (0.1, 100.2),
    ):
        router.attitude(pitchspeed, since_boot)
    until(lambda: len(queue) == 3, router.received)
    assert [received.message.pitchspeed for received in queue] == [approx(0.1)] * 3
    assert str(made.conflict).endswith(
        " jumps: a second autopilot sends there, or it has started again"
    )


def test_messages_of_other_components_of_the_system_are_not_taken(ends: Ends) -> None:
    """A gimbal (component 154) and a companion computer (191) send an ATTITUDE of their own, too.

    They send it on the link or next to it.
    """
    made, port, queue = ends.started("ATTITUDE")
    autopilot = ends.peer(port)
    autopilot.attitude(0.1, since_boot=50.0)
    for component in (154, 191, 0):
        routed = mavlink.MAVLink(autopilot.connection, srcSystem=1, srcComponent=component)
        routed.attitude_send(50_000, 0.0, 0.0, 0.0, 0.0, 0.9, 0.0)
        ends.peer(port, component=component).attitude(0.9, since_boot=50.0)
    # Of the packets to one socket the last one is read last.
    autopilot.attitude(0.1, since_boot=50.1)
    until(lambda: len(queue) == 2, autopilot.received)
    assert [received.message.pitchspeed for received in queue] == [approx(0.1)] * 2
    assert made.conflict is None


def test_link_over_tcp_receives_and_sends(ends: Ends) -> None:
    autopilot = ends.peer(0, kind="tcpin")
    made, _ = ends.link(kind="tcp", at=autopilot.connection.listen.getsockname()[1])
    queue = made.listen("ATTITUDE")
    made.start()
    autopilot.received()  # accepts the call
    autopilot.attitude(0.1, since_boot=50.0)
    until(lambda: queue, autopilot.received)
    assert queue[0].message.pitchspeed == approx(0.1)
    messages: list[Any] = []

    def send() -> None:
        made.send(mavlink_type("RC_CHANNELS_OVERRIDE")())
        messages.extend(message.get_type() for message in autopilot.received())

    until(lambda: "RC_CHANNELS_OVERRIDE" in messages, send)


def test_second_sender_with_the_number_of_the_bridge_is_conflict(ends: Ends) -> None:
    made, port = ends.started()
    other = ends.peer(port, system=255)
    until(lambda: made.conflict, other.beat)
    assert "another sender" in str(made.conflict)
    assert "system 255 too" in str(made.conflict)


@pytest.mark.parametrize("name", ["RC_CHANNELS_OVERRIDE", "MANUAL_CONTROL"])
def test_joystick_of_a_ground_station_with_the_number_of_the_bridge_is_conflict(
    ends: Ends, name: str
) -> None:
    made, _ = ends.link()
    made._take(
        received(
            mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3),
            system=255,
            component=190,
        ),
        SENDER,
        0,
    )
    # It is the station itself, which FS_GCS_ENABL of the autopilot watches.
    assert made.conflict is None
    sticks = {
        "RC_CHANNELS_OVERRIDE": mavlink.MAVLink_rc_channels_override_message(1, 1, *[1500] * 8),
        "MANUAL_CONTROL": mavlink.MAVLink_manual_control_message(1, 0, 0, 0, 0, 0),
    }
    made._take(received(sticks[name], system=255, component=190), SENDER, 0)
    assert "has system 255 too" in str(made.conflict)
    assert "switch the joystick of a ground station off" in str(made.conflict)


def test_other_bridge_is_conflict(ends: Ends) -> None:
    made, port = ends.started()
    second = ends.peer(port, system=1)
    second.connection.mav.srcComponent = COMPANION
    until(lambda: made.conflict, second.beat)
    assert str(made.conflict) == f"another bridge is on udpin:127.0.0.1:{port}: end it"


def test_bridge_is_no_ground_station_but_by_the_messages_of_its_map(ends: Ends) -> None:
    """ArduPilot counts messages of its ground station for FS_GCS_ENABL.

    A dry run sends no message of the map, and so none as a ground station.
    """
    made, port = ends.started(parameters=("RC_OVERRIDE_TIME",), ATTITUDE=40.0)
    peer = ends.peer(port)
    messages = list[Any]()

    def take() -> None:
        peer.beat()
        messages.extend(filter(None, [peer.answer()]))

    until(
        lambda: (
            {"HEARTBEAT", "COMMAND_LONG", "PARAM_REQUEST_READ"}
            <= {message.get_type() for message in messages}
        ),
        take,
    )
    senders = {(message.get_srcSystem(), message.get_srcComponent()) for message in messages}
    assert senders == {(1, mavlink.MAV_COMP_ID_ONBOARD_COMPUTER4)}
    beat = next(message for message in messages if message.get_type() == "HEARTBEAT")
    assert (beat.type, beat.autopilot) == (
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
        mavlink.MAV_AUTOPILOT_INVALID,
    )
    made.send(mavlink_type("RC_CHANNELS_OVERRIDE")())
    messages.clear()
    until(lambda: any(message.get_type() == "RC_CHANNELS_OVERRIDE" for message in messages), take)
    override = next(message for message in messages if message.get_type() == "RC_CHANNELS_OVERRIDE")
    assert override.get_srcSystem() == 255
    messages.clear()
    until(lambda: any(message.get_type() == "HEARTBEAT" for message in messages), take)
    assert {
        message.get_srcSystem() for message in messages if message.get_type() == "HEARTBEAT"
    } == {1}  # also after it


def test_parameter_is_read_and_an_autopilot_that_starts_again_is_asked_again(
    ends: Ends, clock: Clock
) -> None:
    made, _ = ends.link(parameters=("RC_OVERRIDE_TIME",))
    value = mavlink.MAVLink_param_value_message(
        b"RC_OVERRIDE_TIME", 0.5, mavlink.MAV_PARAM_TYPE_REAL32, 1, 0
    )
    made._take(received(value, system=2), SENDER, 0)
    assert made.parameters == {}  # of another autopilot
    made._take(received(value), SENDER, 0)
    assert made.parameters == {"RC_OVERRIDE_TIME": 0.5}
    clock.now += 4.0
    made._take(received(BEAT), SENDER, 0)
    assert made.parameters == {}


def test_rate_that_is_taken_refuses_and_ends_an_engagement_with_rate_cause_and_mend(
    ends: Ends, clock: Clock
) -> None:
    made, _ = ends.link(ATTITUDE=40.0)
    attitude = received(mavlink.MAVLink_attitude_message(1, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6))

    def come(seconds: float, hz: float) -> None:
        for _ in range(round(seconds * hz)):
            clock.now += 1.0 / hz
            made._take(attitude, SENDER, 0)
            made._request(clock.now)

    come(1.0, 40.0)
    assert str(made.reason_against_engagement()) == "the rate of ATTITUDE is not known yet"
    come(2.0, 40.0)
    assert (made.reason_against_engagement(), made.end_reason()) == (None, None)
    made._to_request.clear()
    made._requested = None  # granted
    come(5.0, 4.0)
    rate = "ATTITUDE comes at 4 Hz, requested are 40 Hz"
    assert str(made.reason_against_engagement()).startswith(
        f"{rate}; requested again; a ground station on this link requests rates of its own"
    )
    assert str(made.reason_against_engagement()).endswith("give the bridge a port of its own")
    assert str(made.end_reason()) == f"{rate}; for 2 s"
    assert made._to_request == {"ATTITUDE": 40.0}
    assert made._requested is not None
    come(3.0, 40.0)
    assert made.end_reason() is None
    assert str(made.reason_against_engagement()).startswith("ATTITUDE came at 4 Hz")


def test_denied_rate_that_comes_all_the_same_is_no_problem(ends: Ends, clock: Clock) -> None:
    """A request for 50 Hz is denied, and the 40 Hz of an earlier one continue, which are 80 %."""
    made, _ = ends.link(ATTITUDE=50.0)
    attitude = received(mavlink.MAVLink_attitude_message(1, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6))
    made._take(attitude, SENDER, 0)
    made._requested = "ATTITUDE", clock.now
    made._take(received(mavlink.MAVLink_command_ack_message(511, DENIED)), SENDER, 0)
    assert str(made.problem()).startswith("the autopilot denied 50 Hz of ATTITUDE")
    for _ in range(120):
        clock.now += 0.025
        made._take(attitude, SENDER, 0)
        made._rates.step(clock.now)
    assert made.problem() is None


def test_ground_station_that_falls_silent_ends_the_engagement(ends: Ends, clock: Clock) -> None:
    """Overrides hide the station's silence from the autopilot.

    A station that was never heard is not missed.
    """
    made, _ = ends.link()
    made._take(received(BEAT), SENDER, 0)
    clock.now += 60.0
    assert made.end_reason() is None
    assert "no such station is heard: it acts after each release" in made.station()
    station = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)
    made._take(received(station, system=250, component=190), SENDER, 0)
    clock.now += 60.0
    assert made.end_reason() is None  # of another number: the autopilot does not watch it either
    made._take(received(station, system=255, component=190), SENDER, 0)
    assert (
        "ground station 255: station 255, which is heard, ends the engagement by 5 s of silence"
        in made.station()
    )
    clock.now += 4.9
    assert made.end_reason() is None
    clock.now += 0.2
    assert str(made.end_reason()) == "ground station 255 is silent for 5 s"
    made._take(received(station, system=255, component=190), SENDER, 0)
    assert made.end_reason() is None


@pytest.mark.parametrize(
    "parameters, dropped, watched",
    [
        ({"SYSID_MYGCS": 254}, "254, or SYSID_MYGCS to 255", 254),
        ({"MAV_GCS_SYSID": 254}, "254, or MAV_GCS_SYSID to 255", 254),
        (
            {"MAV_GCS_SYSID": 250, "MAV_GCS_SYSID_HI": 253},
            "250 to 253, or MAV_GCS_SYSID and MAV_GCS_SYSID_HI to a range with it",
            252,
        ),
        ({"MAV_GCS_SYSID": 255, "MAV_GCS_SYSID_HI": 0}, "", 255),
        ({"MAV_GCS_SYSID": 250, "MAV_GCS_SYSID_HI": 255}, "", 250),
    ],
)
def test_numbers_of_ground_stations_are_those_of_the_autopilot(
    ends: Ends, clock: Clock, parameters: dict[str, float], dropped: str, watched: int
) -> None:
    """The numbers are MAV_GCS_SYSID to MAV_GCS_SYSID_HI, and in earlier versions SYSID_MYGCS.

    Source: ArduPilot, GCS.h, sysid_is_gcs. Overrides of another number have no effect. The bridge
    sends as 255.
    """
    made, _ = ends.link()
    made._take(received(BEAT), SENDER, 0)
    for name, value in parameters.items():
        message = mavlink.MAVLink_param_value_message(name.encode(), value, 9, 1, 0)
        made._take(received(message), SENDER, 0)
    assert str(made.reason_against_engagement()).endswith(dropped)
    assert (made.reason_against_engagement() is not None) is bool(dropped)
    station = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)
    made._take(received(station, system=watched, component=190), SENDER, 0)
    clock.now += STATION_SILENCE + 0.1
    assert str(made.end_reason()).endswith("is silent for 5 s")
    sticks = mavlink.MAVLink_manual_control_message(1, 0, 0, 0, 0, 0)
    made._take(received(sticks, system=watched, component=190), SENDER, 0)
    assert "takes its RC overrides" in str(made.conflict)


def test_autopilot_of_another_number_is_named(ends: Ends, clock: Clock) -> None:
    made, _ = ends.link()
    made._take(received(BEAT, system=7), SENDER, 0)
    clock.now += 60.0
    assert "no message of system 1 over" in str(made.problem())
    assert "an autopilot is system 7 there: set link.system" in str(made.problem())


def test_ground_station_with_a_number_of_its_own_is_told_and_no_conflict(ends: Ends) -> None:
    made, port = ends.started()
    station = ends.peer(port, system=254)
    until(
        lambda: made.stations,
        lambda: station.connection.mav.heartbeat_send(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4),
    )
    assert made.stations == {254}
    assert made.conflict is None


def test_autopilot_that_signs_is_flown_with_its_passphrase_and_refused_without(
    ends: Ends, phrase: str
) -> None:
    made, port, queue = ends.started("HEARTBEAT", passphrase_file=phrase)
    other = ends.peer(port, phrase="another")
    until(lambda: made._refused, other.beat)
    assert not queue
    assert "is taken; messages without a valid signature come: the passphrase" in str(
        made.reason_against_engagement()
    )
    peer = ends.peer(port, phrase="a phrase")
    until(lambda: queue, peer.beat)
    taken: list[Any] = []  # the autopilot refuses what has no valid signature

    def take() -> None:
        peer.beat()
        taken.extend(filter(None, [peer.answer()]))

    until(lambda: taken, take)
    assert taken[0].get_signed()

    unsigned, port = ends.link()
    unsigned.start()
    until(lambda: unsigned.conflict, ends.peer(port, phrase="a phrase").beat)
    assert (
        str(unsigned.conflict)
        == "the autopilot signs its messages and drops others: set link.passphrase_file in the map"
    )


def test_autopilot_whose_clock_begins_again_is_not_told_to_have_another_passphrase(
    ends: Ends, phrase: str
) -> None:
    made, port, queue = ends.started("HEARTBEAT", passphrase_file=phrase)
    peer = ends.peer(port, phrase="a phrase")
    until(lambda: queue, peer.beat)
    signing = peer.connection.mav.signing
    signing.timestamp -= 600 * 100_000  # of 10 us each
    until(lambda: made._refused, peer.beat)
    assert re.match(
        r"messages with the right passphrase come, signed (59|60)\d s before the last ones",
        str(made._refused),
    )
    assert "the autopilot has started without the time" in str(made._refused)
    # A replay: the true sender goes on, and no problem is told.
    signing.timestamp += 1200 * 100_000
    until(lambda: len(queue) > 2, peer.beat)
    assert "signed" not in str(made.problem())
    until(
        lambda: "the passphrase differs" in str(made._refused),
        ends.peer(port, phrase="another").beat,
    )


def test_passphrase_holds_in_a_process_that_has_not_seen_mavlink_2(
    ends: Ends, phrase: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A connection of pymavlink begins with MAVLink 1, which has no signatures.

    If an earlier connection has set this variable, it does not.
    """
    monkeypatch.delenv("MAVLINK20", raising=False)
    made, port, queue = ends.started("HEARTBEAT", passphrase_file=phrase)
    until(lambda: made._refused, ends.peer(port).beat)
    assert not queue


def test_silence_of_the_autopilot_is_told(ends: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    made, port = ends.link()
    now = time.monotonic
    monkeypatch.setattr("autopilot_bridge.mavlink_link.time.monotonic", lambda: now() + 4.0)
    assert str(made.problem()) == f"no message of system 1 over udpin:127.0.0.1:{port} for 3 s"


@pytest.mark.parametrize("name, key", [("ardupilot", "mode"), ("ardupilot_mavlink", "param2")])
def test_map_of_ardupilot_asks_for_loiter_after_a_release_that_no_pilot_requested(
    name: str, key: str
) -> None:
    """The numbers of the modes are those that pymavlink has for ArduPlane.

    MAV_CMD are those of common.xml.
    """
    row = named_map(name).messages["mode_after"]
    assert row.when == "failsafe"
    assert (
        row.values[key]
        == {mode: number for number, mode in mavutil.mode_mapping_apm.items()}["LOITER"]
    )
    if name == "ardupilot_mavlink":
        assert row.values["command"] == mavlink.MAV_CMD_DO_SET_MODE
        assert row.values["param1"] == mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED


def test_wrong_map_or_message_is_one_sentence() -> None:
    with refusing("found no message ALTITUD, expected one of the dialect ardupilotmega"):
        mavlink_type("ALTITUD")
    with pytest.raises(ChannelError, match="chan1_raw cannot be 70000"):
        set_field(mavlink_type("RC_CHANNELS_OVERRIDE")(), "chan1_raw", 70000.0)
    content = named_map("ardupilot_mavlink").model_dump()
    for changes, sentence in (
        (
            {"link": None},
            "link: found none, expected one, for outputs.q of type mavlink/msg/ATTITUDE",
        ),
        ({"link": {**content["link"], "url": "serial"}}, "link.url: found 'serial'"),
        (
            {"link": {**content["link"], "rates": {"ATTITUD": 40.0}}},
            r"link\.rates\.ATTITUD: found a message",
        ),
    ):
        with refusing(sentence):
            ChannelMap.validate_mapping(content | changes, "map")


# pymavlink leaves its socket open.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_address_that_cannot_be_opened_is_one_sentence() -> None:
    with refusing(r"link\.url: found udpin:192\.0\.2\.1:14550, which cannot be opened"):
        Link(LinkConfig(url="udpin:192.0.2.1:14550"))  # an address of documentation, RFC 5737
