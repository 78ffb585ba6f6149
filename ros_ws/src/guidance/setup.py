# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="guidance",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="Guidance of the RISE-DI flight stack: attitude, altitude, course and routes outside the control law.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=["guidance"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/guidance"]),
        ("share/guidance", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["guidance = guidance.main:main"]},
)
