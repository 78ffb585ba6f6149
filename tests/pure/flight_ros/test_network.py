# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the middleware's profile for several hosts, and which addresses are refused."""

from xml.etree import ElementTree

import pytest
from tests.conftest import refusing

from flight_ros.network import addresses, network_profile, own_address, ports


def test_profile_is_bound_to_own_address_and_knows_all_hosts() -> None:
    root = ElementTree.fromstring(network_profile("10.0.0.2", ("10.0.0.1", "10.0.0.2")))
    assert [element.text for element in root.findall(".//{*}interfaceWhiteList/{*}address")] == [
        "10.0.0.2"
    ]
    assert [element.text for element in root.findall(".//{*}initialPeersList//{*}address")] == [
        "10.0.0.1",
        "10.0.0.2",
    ]
    assert "127.0.0.1" not in ElementTree.tostring(root, encoding="unicode")
    # Five participants announce themselves to 20 places of a host twice a second: 200 packets a
    # second.
    announcement = float(root.findtext(".//{*}leaseAnnouncement/{*}nanosec") or 0) / 1e9
    assert int(root.findtext(".//{*}maxInitialPeersRange") or 0) / announcement == 40.0


@pytest.mark.parametrize(
    "text",
    [
        "10.0.0.1,10.0.0.1",
        "10.0.0.1,127.0.0.1",
    ],
)
def test_addresses_of_no_hosts_refused(text: str) -> None:
    with refusing(r"^--peers: found "):
        addresses(text)


def test_own_address_is_the_one_of_an_interface() -> None:
    assert own_address(("10.0.0.1", "10.0.0.2"), {"10.0.0.2", "192.168.0.7"}) == "10.0.0.2"
    with refusing(r"found 0 addresses of this host \(192.168.0.7\)"):
        own_address(("10.0.0.1", "10.0.0.2"), {"192.168.0.7"})


def test_ports_are_those_of_the_wire_protocol() -> None:
    assert ports(1) == (7650, 7899)  # DDSI-RTPS 2.3, section 9.6.1.1: PB = 7400, DG = 250
