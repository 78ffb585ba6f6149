# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from glob import glob
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="flight_analysis",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="Flights without ROS: scenarios, the closed loop in one process, metrics, the "
    "report page.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=[
        "flight_analysis",
        "flight_analysis.closed_loop",
        "flight_analysis.linear_loop",
        "flight_analysis.metrics",
        "flight_analysis.report",
    ],
    package_data={
        "flight_analysis": [
            "py.typed",
            "layouts/*",
            "scenarios/*.yaml",
            "report/*.jinja",
            "report/*.css",
            "report/*.js",
            "report/scene/*",
            "report/vendor/*",
        ]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/flight_analysis"]),
        ("share/flight_analysis", ["package.xml"]),
        ("share/flight_analysis/layouts", sorted(glob("flight_analysis/layouts/*"))),
        ("share/flight_analysis/scenarios", sorted(glob("flight_analysis/scenarios/*.yaml"))),
    ],
)
