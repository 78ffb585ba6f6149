# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di flightgear`: a running flight seen in FlightGear."""

import math
import re
import socket
from typing import Annotated

import typer

from flight_cli.route_options import parse_origin
from flight_core.environment import require_ros_environment
from flight_core.installation import require_package
from flight_core.parameters import ParameterError, require


def flightgear(
    origin: Annotated[str, typer.Option(metavar="LAT,LON", help="Where north = east = 0, degrees.")],
    altitude: Annotated[
        float, typer.Option(help="Altitude above sea of altitude 0 of the flight, m; 0 for an aircraft of JSBSim.")
    ] = 0.0,
    namespace: Annotated[str, typer.Option(help="Namespace of the aircraft.")] = "",
    to: Annotated[str, typer.Option(metavar="HOST:PORT", help="Where FlightGear listens.")] = "127.0.0.1:5500",
    rate: Annotated[float, typer.Option(min=1.0, max=100.0, help="Packets a second.")] = 30.0,
) -> None:
    """Send the pose of a running flight to FlightGear, until the flight ends or Ctrl-C.

    Exit status: 0 the flight ended, 2 bad input or no flight, 130 interrupted.
    """
    place = parse_origin(origin)
    require(math.isfinite(altitude), "--altitude", altitude, "a number")
    host, _, port = to.rpartition(":")
    fits = bool(host) and re.fullmatch(r"[0-9]{1,5}", port) is not None and 0 < int(port) < 1 << 16
    require(fits, "--to", repr(to), "an address and a port, as in 127.0.0.1:5500")
    address = _reached(to, host, int(port))
    require_package("rclpy", "")
    require_ros_environment()
    from flight_bringup.client import FlightGearClient  # noqa: PLC0415 - loads rclpy, which other commands do not need

    with FlightGearClient(namespace) as client:
        client.wait()
        print(f"sending to {to}; start FlightGear: fgfs --fdm=null --native-fdm=socket,in,{rate:g},,{port},udp", flush=True)
        client.send(address, place, altitude, rate)


def _reached(to: str, host: str, port: int) -> tuple[str, int]:
    """The address of a host, to which this one has a route. Raises ParameterError."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
            trial.connect((host, port))  # sends nothing
            address, _ = trial.getpeername()
    except (OSError, UnicodeError) as error:  # UnicodeError for a name that no host can have
        reason = error.strerror if isinstance(error, OSError) else error
        raise ParameterError(f"--to: found {to!r} ({reason}), expected a host that this one reaches") from None
    return address, port
