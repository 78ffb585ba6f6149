# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="flight_view",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="The live page of the RISE-DI flight stack: charts, horizon and 3-D scene of a "
    "flight from its growing log.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=["flight_view"],
    package_data={"flight_view": ["py.typed", "page/*.html", "page/*.css", "page/*.js"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/flight_view"]),
        ("share/flight_view", ["package.xml"]),
    ],
)
