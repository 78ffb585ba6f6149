# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
from xml.etree import ElementTree

from setuptools import setup

setup(
    name="control_laws",
    version=ElementTree.parse("package.xml").findtext("version"),
    description="Control laws other than RISE-DI, each a module of equations; the controller "
    "flies the laws that need only y.",
    license="Apache-2.0",
    extras_require={"test": ["pytest"]},
    packages=["control_laws"],
    package_data={"control_laws": ["py.typed"]},
    entry_points={
        "rise_di_controller.laws": [
            "pi = control_laws.pi:PiConfig",
            "l1 = control_laws.l1:L1Config",
            "lqg = control_laws.lqg:LqgConfig",
            "indi = control_laws.indi:IndiConfig",
            "lqi = control_laws.lqi:LqiConfig",
            "mackunis = control_laws.mackunis:MacKunisConfig",
            "excitation = control_laws.excitation:ExcitationConfig",
        ]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/control_laws"]),
        ("share/control_laws", ["package.xml"]),
    ],
)
