# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="rise_di_controller",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="RISE dynamic inversion: a control law that uses the measured output only, its "
    "guard, and a ROS 2 node with a fixed rate.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=[
        "rise_di_controller",
        "rise_di_controller.law",
        "rise_di_controller.guard",
        "rise_di_controller.extensions",
        "rise_di_controller.learning",
    ],
    package_data={"rise_di_controller": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/rise_di_controller"]),
        ("share/rise_di_controller", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["controller = rise_di_controller.main:main"]},
)
