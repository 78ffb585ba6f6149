# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Select the transport of the middleware: loopback only, unless the user configures a profile.

Fast DDS silently uses all interfaces if it cannot read its profile. So the file is checked before
rclpy starts, and the sockets are checked afterwards.
"""

import os
from importlib.resources import files
from pathlib import Path
from xml.etree import ElementTree

from flight_core.environment import PROFILE_VARIABLE, require_ros_environment

DISCOVERY_VARIABLE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
LOOPBACK_PROFILE = Path(str(files("flight_ros"))) / "loopback.xml"


def environment() -> dict[str, str]:
    """Return the environment variables that select the loopback transport.

    Returns {} if the user has configured a profile.
    """
    if PROFILE_VARIABLE in os.environ:
        return {}
    # SYSTEM_DEFAULT leaves discovery to the profile, while LOCALHOST would add shared memory.
    return {PROFILE_VARIABLE: str(LOOPBACK_PROFILE), DISCOVERY_VARIABLE: "SYSTEM_DEFAULT"}


def prepare() -> None:
    """Set the environment before rclpy starts.

    Raises ParameterError if the profile cannot be read as XML, and whenever
    `require_ros_environment` does.
    """
    require_ros_environment()
    os.environ.update(environment())
    profile = os.environ[PROFILE_VARIABLE]
    try:
        ElementTree.parse(profile)  # noqa: S314 - a configuration file of the user, not foreign input
    except (OSError, ElementTree.ParseError) as error:
        from flight_core.parameters import ParameterError  # noqa: PLC0415 - see flight_ros.startup

        raise ParameterError(
            f"{PROFILE_VARIABLE}: {profile} cannot be read ({error}), expected a Fast DDS profile"
        ) from None


def open_to_network() -> list[str]:
    """Return the UDP sockets of this process that are open on all interfaces.

    With the loopback profile there should be none. The sockets of any other profile are not
    examined, because a user has chosen it, and the result is empty.
    """
    if os.environ.get(PROFILE_VARIABLE) != str(LOOPBACK_PROFILE):
        return []
    import psutil  # noqa: PLC0415 - see flight_ros.startup

    process = psutil.Process()
    # psutil before 6, such as 5.9 of Ubuntu 24.04, calls this method `connections`
    connections = getattr(process, "net_connections", None) or process.connections
    sockets = connections(kind="udp")
    return [
        f"{s.laddr.ip}:{s.laddr.port}"
        for s in sockets
        if s.laddr and s.laddr.ip in ("0.0.0.0", "::")  # noqa: S104 - compared, not bound
    ]
