# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="flight_campaign",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="Monte Carlo campaigns over thousands of uncertain aircraft, tuning and "
    "comparison of control laws.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=["flight_campaign", "flight_campaign.batch", "flight_campaign.comparison"],
    package_data={"flight_campaign": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/flight_campaign"]),
        ("share/flight_campaign", ["package.xml"]),
    ],
)
