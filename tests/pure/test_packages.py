# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Every package is a correct ament_python package, built and found."""

import configparser
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

SOURCES = Path(__file__).resolve().parents[2] / "ros_ws" / "src"
INSTALLED = SOURCES.parent / "install"
PACKAGES = sorted(path.parent for path in SOURCES.glob("*/package.xml"))
EXECUTABLES = {
    "aircraft_sim": "aircraft",
    "reference_model": "reference_model",
    "rise_di_controller": "controller",
    "flight_recorder": "recorder",
    "flight_bringup": "rise-di",
}


@pytest.mark.parametrize("package", PACKAGES, ids=lambda path: path.name)
def test_package_files_agree_with_each_other(package: Path) -> None:
    name = package.name
    root = ElementTree.parse(package / "package.xml").getroot()
    setup = (package / "setup.py").read_text(encoding="utf-8")
    assert root.findtext("name") == name
    assert root.findtext("license") == "Apache-2.0"
    assert root.findtext("export/build_type") == "ament_python"
    version = re.search(r'version="([^"]+)"', setup)
    assert version is not None
    assert root.findtext("version") == version.group(1)
    # colcon builds a package with an e-mail it cannot parse as plain Python, with a warning only
    maintainer = root.find("maintainer")
    assert maintainer is not None
    assert re.fullmatch(r"[\w.-]+@[\w-]+(\.[\w-]+)+", maintainer.attrib["email"])
    config = configparser.ConfigParser()
    config.read(package / "setup.cfg")
    assert config["install"]["install_scripts"] == f"$base/lib/{name}"
    assert (package / "resource" / name).is_file()


@pytest.mark.parametrize("package", PACKAGES, ids=lambda path: path.name)
def test_package_depends_on_what_it_imports_of_the_stack(package: Path) -> None:
    root = ElementTree.parse(package / "package.xml").getroot()
    declared = {node.text for node in root.findall("exec_depend")}
    ours = {path.name for path in PACKAGES} - {package.name}
    imported = set()
    for source in package.glob("*/*.py"):
        imported |= set(re.findall(r"^\s*(?:from|import) (\w+)", source.read_text(encoding="utf-8"), re.MULTILINE))
    assert (imported & ours) <= declared


@pytest.mark.parametrize("package", PACKAGES, ids=lambda path: path.name)
def test_package_is_installed_with_its_index_entry(package: Path) -> None:
    share = INSTALLED / package.name / "share"
    assert (share / "ament_index" / "resource_index" / "packages" / package.name).exists()
    assert (share / package.name / "package.xml").exists()


@pytest.mark.parametrize(("package", "executable"), EXECUTABLES.items())
def test_executable_is_where_ros2_run_looks(package: str, executable: str) -> None:
    path = INSTALLED / package / "lib" / package / executable
    assert path.is_file()
    assert path.stat().st_mode & 0o111


def test_every_source_file_states_its_licence() -> None:
    root = SOURCES.parents[1]
    files = [*SOURCES.rglob("*.py"), *(root / "tests").rglob("*.py"), *(root / "benchmarks").rglob("*.py")]
    unmarked = [path for path in files if "SPDX-License-Identifier: Apache-2.0" not in path.read_text(encoding="utf-8")[:200]]
    assert not unmarked
