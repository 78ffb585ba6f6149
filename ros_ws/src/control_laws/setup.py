# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from setuptools import setup

setup(
    name="control_laws",
    version="0.1.0",
    description="Control laws other than RISE-DI, each a module of equations.",
    license="Apache-2.0",
    packages=["control_laws"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/control_laws"]),
        ("share/control_laws", ["package.xml"]),
    ],
)
