# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="flight_core",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="Basics of the RISE-DI flight stack without ROS: parameters, named vectors, "
    "rates, integrators, scenario files, the tape.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=["flight_core"],
    package_data={"flight_core": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/flight_core"]),
        ("share/flight_core", ["package.xml"]),
    ],
)
