# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="pid_law",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="PID control, an example of a control law for rise_di_controller.",
    license="Apache-2.0",
    packages=["pid_law"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pid_law"]),
        ("share/pid_law", ["package.xml", "osprey_pid.yaml"]),
    ],
    entry_points={"rise_di_controller.laws": ["pid = pid_law.pid:PidConfig"]},
)
