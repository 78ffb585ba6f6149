# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from glob import glob
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="flight_bringup",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="Launch files, process runner, monitor and player of the RISE-DI flight stack.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=["flight_bringup", "flight_bringup.launch"],
    package_data={"flight_bringup": ["py.typed", "security/*.xml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/flight_bringup"]),
        ("share/flight_bringup", ["package.xml"]),
        ("share/flight_bringup/launch", sorted(glob("launch/*.launch.py"))),
        ("share/flight_bringup/security", sorted(glob("flight_bringup/security/*.xml"))),
    ],
)
