# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from setuptools import setup

setup(
    name="flight_campaign",
    version="0.1.0",
    description="Monte Carlo campaigns over thousands of uncertain aircraft, tuning and comparison of control laws.",
    license="Apache-2.0",
    packages=["flight_campaign"],
    package_data={"flight_campaign": ["tuned/*.yaml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/flight_campaign"]),
        ("share/flight_campaign", ["package.xml"]),
    ],
)
