# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from setuptools import setup

setup(
    name="autopilot_bridge",
    version="0.1.0",
    description="Bridge to an autopilot, in place of the simulated aircraft: y and u through a channel map.",
    license="Apache-2.0",
    packages=["autopilot_bridge"],
    package_data={"autopilot_bridge": ["maps/*.yaml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/autopilot_bridge"]),
        ("share/autopilot_bridge", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["bridge = autopilot_bridge.main:main"]},
)
