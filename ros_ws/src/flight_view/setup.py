# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from setuptools import setup

setup(
    name="flight_view",
    version="0.1.0",
    description="The live page of the RISE-DI flight stack: charts, horizon and 3-D scene of a flight from its growing log.",
    license="Apache-2.0",
    packages=["flight_view"],
    package_data={"flight_view": ["page/*.html", "page/*.css", "page/*.js"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/flight_view"]),
        ("share/flight_view", ["package.xml"]),
    ],
)
