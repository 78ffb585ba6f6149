# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from setuptools import setup

setup(
    name="flight_analysis",
    version="0.1.0",
    description="Flights without ROS: the closed loop in one process, MCAP bag to tape, metrics, the report page.",
    license="Apache-2.0",
    packages=["flight_analysis"],
    package_data={"flight_analysis": ["page.*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/flight_analysis"]),
        ("share/flight_analysis", ["package.xml"]),
    ],
)
