# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from setuptools import setup

setup(
    name="flight_log",
    version="0.1.0",
    description="Writes, reads, scans and repairs the log of a flight, a rosbag2 bag, without ROS.",
    license="Apache-2.0",
    packages=["flight_log"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/flight_log"]),
        ("share/flight_log", ["package.xml"]),
    ],
)
