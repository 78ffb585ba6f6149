# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="flight_cli",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="The rise-di command of the RISE-DI flight stack, one file a command.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=["flight_cli"],
    package_data={"flight_cli": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/flight_cli"]),
        ("share/flight_cli", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["rise-di = flight_cli.cli:main"]},
)
