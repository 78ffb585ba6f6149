# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="c_export",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="The RISE-DI controller as C99 code, library and FMU, with a proof that it "
    "equals the Python controller.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=["c_export"],
    package_data={
        "c_export": [
            "py.typed",
            "source/*.*",
            "source/px4/*",
            "source/rates/*",
            "source/ardupilot/*",
        ]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/c_export"]),
        ("share/c_export", ["package.xml"]),
    ],
)
