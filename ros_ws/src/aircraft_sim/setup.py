# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="aircraft_sim",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="Simulated aircraft of the RISE-DI flight stack: x_dot = A x + f(x, t) + B u, y "
    "= C x, with gusts.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=[
        "aircraft_sim",
        "aircraft_sim.airframes",
        "aircraft_sim.atmosphere",
        "aircraft_sim.plant",
        "aircraft_sim.jsbsim",
    ],
    package_data={"aircraft_sim": ["py.typed", "airframes/*.yaml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/aircraft_sim"]),
        ("share/aircraft_sim", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["aircraft = aircraft_sim.main:main"]},
)
