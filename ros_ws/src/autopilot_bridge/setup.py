# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="autopilot_bridge",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="Bridge to an autopilot, in place of the simulated aircraft: y and u through a "
    "channel map.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=["autopilot_bridge"],
    package_data={"autopilot_bridge": ["py.typed", "maps/*.yaml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/autopilot_bridge"]),
        ("share/autopilot_bridge", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["bridge = autopilot_bridge.main:main"]},
)
