# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Make the profile of the middleware for nodes on several hosts.

The profile is unicast over UDP, and only between the addresses of the hosts.
"""

import ipaddress
import re
from collections.abc import Collection, Sequence

from flight_core.parameters import ParameterError, require
from flight_ros.transport import LOOPBACK_PROFILE

PEER_RANGE = 20  # largest number of participants that discovery finds on each host
ANNOUNCEMENT_NS = 500_000_000
"""Period in which a participant announces itself, ns. It sends an announcement to each of the
PEER_RANGE ports of each host. With the period of the loopback profile, 0.1 s, five nodes would send
1000 packets a second to each host."""
FIRST_PORT = 7400  # DDSI-RTPS 2.3
PORTS_A_DOMAIN = 250  # section 9.6.1.1


def addresses(text: str) -> tuple[str, ...]:
    """Return the addresses in a text like "10.0.0.1,10.0.0.2".

    Raises ParameterError if the text does not have two or more different IPv4 addresses of hosts.
    """
    hosts = tuple(part.strip() for part in text.split(","))
    for address in hosts:
        try:
            host = ipaddress.IPv4Address(address)
        except ValueError:
            raise ParameterError(
                f"--peers: found {address!r}, expected IPv4 addresses, as in 10.0.0.1,10.0.0.2"
            ) from None
        is_usable = not (host.is_unspecified or host.is_multicast or host.is_loopback)
        require(is_usable, "--peers", repr(address), "the address of a host on the network")
    require(
        len(set(hosts)) == len(hosts) >= 2,
        "--peers",
        repr(text),
        "two or more addresses, each once, this host's among them",
    )
    return hosts


def own_address(peers: Sequence[str], local: Collection[str]) -> str:
    """Return which of the peers' addresses belongs to this host.

    `local` has the addresses of the interfaces of this host. Raises ParameterError unless exactly
    one of the peers is among them.
    """
    matches = [address for address in peers if address in local]
    own = ", ".join(sorted(local)) or "none"
    require(
        len(matches) == 1,
        "--peers",
        f"{len(matches)} addresses of this host ({own})",
        "one of them, and the addresses of the other hosts",
    )
    return matches[0]


def network_profile(own_host: str, peers: Sequence[str]) -> str:
    """Return the profile of the middleware for this host and its peers.

    The profile is the loopback profile, with the address of this host in place of 127.0.0.1. The
    hosts are the initial peers in the profile.
    """
    text = LOOPBACK_PROFILE.read_text(encoding="utf-8")
    locators = "".join(
        f"<locator><udpv4><address>{address}</address></udpv4></locator>" for address in peers
    )
    hosts = ", ".join(peers)
    about = (
        f"<!-- Fast DDS over UDP, unicast alone, bound to {own_host}, for hosts {hosts}; "
        "written by rise-di network. -->"
    )
    for pattern, value in (
        (r"<!--.*?-->", about),
        (r"(?s)(?<=<initialPeersList>).*?(?=</initialPeersList>)", locators),
        (
            r"(?s)(?<=<interfaceWhiteList>).*?(?=</interfaceWhiteList>)",
            f"<address>{own_host}</address>",
        ),
        (r"(?<=<maxInitialPeersRange>)\d+", str(PEER_RANGE)),
        (
            r"(?s)(?<=<leaseAnnouncement>)(\s*<sec>0</sec>\s*<nanosec>)\d+",
            rf"\g<1>{ANNOUNCEMENT_NS}",
        ),
        ("udp_loopback", "udp_network"),
        ('profile_name="loopback"', 'profile_name="network"'),
    ):
        text, count = re.subn(pattern, value, text, flags=re.DOTALL)
        require(count > 0, str(LOOPBACK_PROFILE), f"no {pattern}", "the profile of this version")
    return text


def ports(domain: int) -> tuple[int, int]:
    """Return the first and the last UDP port of a domain."""
    first = FIRST_PORT + PORTS_A_DOMAIN * domain
    return first, first + PORTS_A_DOMAIN - 1
