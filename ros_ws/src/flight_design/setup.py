# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="flight_design",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="Design of a RISE-DI flight control law: gains, identification, learning in "
    "flight.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=[
        "flight_design",
        "flight_design.gains",
        "flight_design.identification",
        "flight_design.learning",
    ],
    package_data={"flight_design": ["py.typed", "gains/tuned/*.yaml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/flight_design"]),
        ("share/flight_design", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["learner = flight_design.main:main"]},
)
