# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from setuptools import setup

setup(
    name="flight_recorder",
    version="0.1.0",
    description="Records the topics of a flight to a rosbag2-layout MCAP bag.",
    license="Apache-2.0",
    packages=["flight_recorder"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/flight_recorder"]),
        ("share/flight_recorder", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["recorder = flight_recorder.main:main"]},
)
