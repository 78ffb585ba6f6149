# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="flight_learner",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="Learner of the RISE-DI flight stack: identifies A and B in flight and proposes an observer to the controller.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=["flight_learner"],
    package_data={"flight_learner": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/flight_learner"]),
        ("share/flight_learner", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["learner = flight_learner.main:main"]},
)
