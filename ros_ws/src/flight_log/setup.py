# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="flight_log",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="Writes, reads, scans and repairs the log of a flight, a rosbag2 bag, without ROS.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=["flight_log"],
    package_data={"flight_log": ["py.typed", "*.yaml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/flight_log"]),
        ("share/flight_log", ["package.xml"]),
    ],
)
