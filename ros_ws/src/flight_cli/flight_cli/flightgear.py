# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The FlightGear output of `rise-di watch`: the pose of a running flight as packets."""

import math
import re
import socket

from flight_cli.route_options import parse_origin
from flight_core.environment import require_ros_environment
from flight_core.installation import require_package
from flight_core.parameters import ParameterError, require


def show_in_flightgear(to: str, origin: str, altitude: float, namespace: str, rate: float) -> None:
    """Send the pose of a running flight to FlightGear at HOST:PORT, until the flight ends.

    `origin`: LAT,LON in degrees of north = east = 0; `altitude` above sea of altitude 0, m; `rate`
    of packets, Hz.
    """
    place = parse_origin(origin)
    require(math.isfinite(altitude), "altitude", altitude, "a number")
    host, _, port = to.rpartition(":")
    fits = bool(host) and re.fullmatch(r"[0-9]{1,5}", port) is not None and 0 < int(port) < 1 << 16
    require(fits, "flightgear", repr(to), "an address and a port, as in 127.0.0.1:5500")
    address = _reached(to, host, int(port))
    require_package("rclpy", "")
    require_ros_environment()
    from flight_bringup.client import FlightGearClient  # noqa: PLC0415 - loads rclpy, which other commands do not need

    with FlightGearClient(namespace) as client:
        client.wait()
        print(
            f"sending to {to}; start FlightGear: fgfs --fdm=null "
            f"--native-fdm=socket,in,{rate:g},,{port},udp",
            flush=True,
        )
        client.send(address, place, altitude, rate)


def _reached(to: str, host: str, port: int) -> tuple[str, int]:
    """The address of a host, to which this one has a route. Raises ParameterError."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
            trial.connect((host, port))  # sends nothing
            address, _ = trial.getpeername()
    except (OSError, UnicodeError) as error:  # UnicodeError for a name that no host can have
        reason = error.strerror if isinstance(error, OSError) else error
        raise ParameterError(
            f"flightgear: found {to!r} ({reason}), expected a host that this one reaches"
        ) from None
    return address, port
