# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="flight_ros",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="Shared ROS code of the RISE-DI flight stack: topics, parameters, messages as "
    "named vectors, ticker, base class of a node.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=["flight_ros"],
    package_data={"flight_ros": ["py.typed", "loopback.xml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/flight_ros"]),
        ("share/flight_ros", ["package.xml"]),
    ],
)
