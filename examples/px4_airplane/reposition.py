# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Send PX4 to a place, as "Go to location" of a ground station does.

The command goes over the loopback profile of the stack.

    .venv/bin/python examples/px4_airplane/reposition.py LATITUDE LONGITUDE ALTITUDE
        # degrees, degrees, m above sea level

It sends DO_REPOSITION (MAVLink command 192) for 3 s, for the first message of a new publisher can
be lost.
"""

import argparse
import sys
import time

RATE, DURATION = 10.0, 3.0  # Hz, s
WAIT = 10.0  # s, for PX4's agent


def main() -> None:
    """Send the command; exit status 1 without PX4."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, unit in (
        ("latitude", "degrees"),
        ("longitude", "degrees"),
        ("altitude", "m above sea level"),
    ):
        parser.add_argument(name, type=float, help=unit)
    place = parser.parse_args()
    try:
        import rclpy  # noqa: PLC0415 - after the arguments: --help and an error are immediate
        from px4_msgs.msg import VehicleCommand  # noqa: PLC0415 - not on PyPI
        from rclpy.qos import qos_profile_sensor_data  # noqa: PLC0415

        from flight_ros import transport  # noqa: PLC0415
    except ModuleNotFoundError as error:
        sys.exit(
            f"error: {error}; `make messages PACKAGE=px4_msgs SOURCE=FOLDER` builds px4_msgs "
            "(docs/autopilots.md)"
        )
    transport.prepare()
    rclpy.init()
    node = rclpy.create_node("reposition")
    publisher = node.create_publisher(
        VehicleCommand, "/fmu/in/vehicle_command", qos_profile_sensor_data
    )
    command = VehicleCommand(
        command=192,
        param1=-1.0,  # the speed stays
        param2=1.0,  # into Hold
        param4=float("nan"),  # the heading stays PX4's choice
        param5=place.latitude,
        param6=place.longitude,
        param7=place.altitude,
        target_system=1,
        target_component=1,
        source_system=1,
        from_external=True,
    )
    begin = time.monotonic()
    while not publisher.get_subscription_count():
        if time.monotonic() - begin > WAIT:
            sys.exit(
                f"error: found no subscriber of {publisher.topic_name}: start PX4 and its "
                "agent, with the stack's profile"
            )
        time.sleep(0.1)
    for _ in range(round(RATE * DURATION)):
        publisher.publish(command)
        time.sleep(1.0 / RATE)
    rclpy.shutdown()
    print(f"sent to {place.latitude}, {place.longitude}, {place.altitude} m above sea level")


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
