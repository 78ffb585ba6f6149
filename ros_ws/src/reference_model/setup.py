# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="reference_model",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="Reference model of the RISE-DI flight stack: commands u_m(t) and x_m_dot = A_m "
    "x_m + B_m u_m, y_m = C x_m.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=["reference_model"],
    package_data={"reference_model": ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/reference_model"]),
        ("share/reference_model", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["reference_model = reference_model.main:main"]},
)
