# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Every package is a correct ament_python package: its files agree, and it is installed."""

import configparser
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from ros_ws.src.conftest import MODULES, SOURCES, TESTS, WHOLE_TREE, files
from tests.conftest import ALONE, SLOW
from tests.pure.test_import_rule import imported

INSTALLED = SOURCES.parent / "install"
PACKAGES = sorted(path.parent for path in SOURCES.glob("*/package.xml"))
EXECUTABLES = {
    "aircraft_sim": "aircraft",
    "autopilot_bridge": "bridge",
    "reference_model": "reference_model",
    "flight_guidance": "guidance",
    "rise_di_controller": "controller",
    "flight_recorder": "recorder",
    "flight_cli": "rise-di",
}

# The keys of rosdep (rosdep/python.yaml of ros/rosdistro); a ROS package is its own key.
PYTHON3 = ("jinja2", "matplotlib", "numpy", "psutil", "rich", "scipy", "tornado", "typer", "yaml")
KEYS = {name: f"python3-{name}" for name in PYTHON3} | {"markupsafe": "python3-jinja2"}  # which depends on it
# Without a key, or (rosbags) with one for pip, which Ubuntu 24.04 refuses for its own Python.
WITHOUT_KEY = {"cma", "distributed", "foxglove", "jax", "jsbsim", "lz4", "mcap", "polars", "rosbags", "zstandard"}


@pytest.mark.parametrize("package", PACKAGES, ids=lambda path: path.name)
def test_package_files_agree_with_each_other(package: Path) -> None:
    name = package.name
    root = ElementTree.parse(package / "package.xml").getroot()
    setup = (package / "setup.py").read_text(encoding="utf-8")
    assert root.findtext("name") == name
    assert root.findtext("license") == "Apache-2.0"
    assert root.findtext("export/build_type") == "ament_python"
    assert 'version=ElementTree.parse("package.xml").findtext("version")' in setup
    assert 'extras_require={"test": ["pytest"]}' in setup  # by which colcon test chooses pytest
    tested_with = {node.text for node in root.findall("test_depend")}
    assert tested_with == {"python3-hypothesis", "python3-pytest", "python3-pytest-timeout"}
    # colcon builds a package with an e-mail it cannot parse as plain Python, with a warning only
    maintainer = root.find("maintainer")
    assert maintainer is not None
    assert re.fullmatch(r"[\w.-]+@[\w-]+(\.[\w-]+)+", maintainer.attrib["email"])
    config = configparser.ConfigParser()
    config.read(package / "setup.cfg")
    assert config["install"]["install_scripts"] == f"$base/lib/{name}"
    assert (package / "resource" / name).is_file()


@pytest.mark.parametrize("package", PACKAGES, ids=lambda path: path.name)
def test_package_declares_all_that_it_imports(package: Path) -> None:
    root = ElementTree.parse(package / "package.xml").getroot()
    declared = {node.text for node in root.findall("exec_depend")}
    sources = [path for path in package.rglob("*.py") if path.name != "setup.py"]
    external = set().union(*map(imported, sources)) - sys.stdlib_module_names - {package.name} - WITHOUT_KEY
    assert {KEYS.get(name, name) for name in external} <= declared


def test_packages_citation_and_changelog_have_one_version() -> None:
    root = SOURCES.parents[1]
    files = [*PACKAGES, root / "examples" / "pid_law"]
    versions = {ElementTree.parse(package / "package.xml").findtext("version") for package in files}
    cited = re.search(r"^version: (.+)$", (root / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE)
    newest = re.search(r"^## (\d\S*) - \d{4}-\d\d-\d\d$", (root / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert cited is not None
    assert newest is not None
    assert versions == {cited[1]} == {newest[1]}


def test_every_test_is_of_one_package_or_of_the_whole_tree() -> None:
    listed = [path for modules in (*MODULES.values(), WHOLE_TREE) for path in files(modules)]
    assert set(MODULES) == {package.name for package in PACKAGES}
    assert sorted(listed) == sorted(path for path in TESTS.rglob("test_*.py") if path.parts[len(TESTS.parts)] != "sitl")


def test_pytest_in_the_folder_of_a_package_runs_its_tests_as_colcon_asks_for_them() -> None:
    command = [sys.executable, "-m", "pytest", "-o", "cache_dir=cache", "--collect-only", "-qq"]
    done = subprocess.run(command, cwd=SOURCES / "flight_core", capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert set(re.findall(r"test_\w+\.py", done.stdout)) == {path.name for path in files(MODULES["flight_core"])}


def test_the_page_on_ros_names_what_rosdep_cannot_install() -> None:
    page = (SOURCES.parents[1] / "docs" / "ros.md").read_text(encoding="utf-8")
    assert not {name for name in WITHOUT_KEY if f"`{name.replace('_', '-')}`" not in page}


@pytest.mark.parametrize("package", PACKAGES, ids=lambda path: path.name)
def test_package_installs_its_data_files(package: Path) -> None:
    # A symlinked build has all files of the package folder, whether or not setup.py names them.
    setup = (package / "setup.py").read_text(encoding="utf-8")
    named = {pattern for data in re.findall(r"package_data=\{[^}]*\}", setup) for pattern in re.findall(r'"([^"]+)"', data)}
    code = package / package.name
    data = {path for path in code.rglob("*") if path.is_file() and path.suffix not in {".py", ".pyc"}}
    assert data <= {path for pattern in named for path in code.glob(pattern)}


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


def test_the_modules_that_the_tests_mark_exist() -> None:
    tests = SOURCES.parents[1] / "tests"
    assert {tests / "pure" / f"test_{name}.py" for name in SLOW} <= {*tests.glob("pure/*.py")}
    assert {path.stem.removeprefix("test_") for path in tests.glob("ros/**/test_*.py")} >= ALONE


def test_every_source_file_states_its_licence() -> None:
    root = SOURCES.parents[1]
    files = [*SOURCES.rglob("*.py"), *(root / "tests").rglob("*.py"), *(root / "benchmarks").rglob("*.py")]
    unmarked = [path for path in files if "SPDX-License-Identifier: Apache-2.0" not in path.read_text(encoding="utf-8")[:200]]
    assert not unmarked
