# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="flight_recorder",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="Records the topics of a flight to a rosbag2-layout MCAP bag.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=["flight_recorder"],
    package_data={"flight_recorder": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/flight_recorder"]),
        ("share/flight_recorder", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["recorder = flight_recorder.main:main"]},
)
