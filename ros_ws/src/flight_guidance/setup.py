# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="flight_guidance",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="Guidance of the RISE-DI flight stack: attitude, altitude, course and routes "
    "outside the control law.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=[
        "flight_guidance",
        "flight_guidance.routes",
        "flight_guidance.fence",
        "flight_guidance.steering",
        "flight_guidance.modes",
        "flight_guidance.multicopter",
    ],
    package_data={"flight_guidance": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/flight_guidance"]),
        ("share/flight_guidance", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["guidance = flight_guidance.main:main"]},
)
