# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="rise_di",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="The Python interface of the stack in one import; needs no ROS.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=["rise_di"],
    package_data={"rise_di": ["py.typed", "*.pyi"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/rise_di"]),
        ("share/rise_di", ["package.xml"]),
    ],
)
