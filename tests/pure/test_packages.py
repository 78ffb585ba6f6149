# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that every package is a correct ament_python package whose files agree and are installed."""

import configparser
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from xml.etree import ElementTree

from ros_ws.src.conftest import SOURCES, TESTS, files_of
from tests.pure.test_import_rule import imported

INSTALLED = SOURCES.parent / "install"
PACKAGES = sorted(path.parent for path in SOURCES.glob("*/package.xml"))
EXECUTABLES = {
    "aircraft_sim": "aircraft",
    "autopilot_bridge": "bridge",
    "reference_model": "reference_model",
    "flight_guidance": "guidance",
    "flight_design": "learner",
    "rise_di_controller": "controller",
    "flight_recorder": "recorder",
    "flight_cli": "rise-di",
}
TEST_DEPENDENCIES = {"python3-hypothesis", "python3-pytest", "python3-pytest-timeout"}

# The keys of rosdep (rosdep/python.yaml of ros/rosdistro); a ROS package is its own key.
PYTHON3 = ("jinja2", "matplotlib", "numpy", "psutil", "rich", "scipy", "tornado", "typer", "yaml")
# which depends on it
KEYS = {name: f"python3-{name}" for name in PYTHON3} | {"markupsafe": "python3-jinja2"}
# Without a key, or (rosbags) with one for pip, which Ubuntu 24.04 refuses for its own Python.
WITHOUT_KEY = {
    "cma",
    "control",
    "dask",
    "distributed",
    "foxglove",
    "gymnasium",
    "jax",
    "jsbsim",
    "lz4",
    "mcap",
    "polars",
    "pymavlink",
    "pyulog",
    "rosbags",
    "zstandard",
}


def check_packages(mistakes: Callable[[Path], Iterable[object]]) -> None:
    """Fail with the mistakes in all packages, one in each line."""
    lines = [f"{package.name}: {mistake}" for package in PACKAGES for mistake in mistakes(package)]
    assert not lines, "\n".join(lines)


def test_package_files_agree_with_each_other() -> None:
    check_packages(disagreements)


def disagreements(package: Path) -> list[str]:
    """Return the statements about a package's files that are not true."""
    name = package.name
    root = ElementTree.parse(package / "package.xml").getroot()
    setup = (package / "setup.py").read_text()
    email = root.find("maintainer[@email]")
    config = configparser.ConfigParser()
    config.read(package / "setup.cfg")
    statements = {
        "name": root.findtext("name") == name,
        "licence": root.findtext("license") == "Apache-2.0",
        "build type": root.findtext("export/build_type") == "ament_python",
        "version from package.xml": 'version=ElementTree.parse("package.xml").findtext("version")'
        in setup,
        "extra test, by which colcon test chooses pytest": 'extras_require={"test": ["pytest"]}'
        in setup,
        "test dependencies": {node.text for node in root.findall("test_depend")}
        == TEST_DEPENDENCIES,
        # colcon builds a package with an e-mail it cannot parse as plain Python, with a warning
        # only
        "e-mail": email is not None
        and re.fullmatch(r"[\w.-]+@[\w-]+(\.[\w-]+)+", email.attrib["email"]) is not None,
        "scripts where ros2 run looks": config["install"]["install_scripts"] == f"$base/lib/{name}",
        "resource": (package / "resource" / name).is_file(),
        "types for users (PEP 561)": (package / name / "py.typed").is_file(),
    }
    return [statement for statement, holds in statements.items() if not holds]


def test_packages_declare_all_that_they_import() -> None:
    check_packages(undeclared)


def undeclared(package: Path) -> set[str]:
    """Return the imported foreign packages without an exec_depend."""
    root = ElementTree.parse(package / "package.xml").getroot()
    declared = {node.text for node in root.findall("exec_depend")}
    sources = [path for path in package.rglob("*.py") if path.name != "setup.py"]
    external = (
        set().union(*map(imported, sources))
        - sys.stdlib_module_names
        - {package.name}
        - WITHOUT_KEY
    )
    return {KEYS.get(name, name) for name in external} - declared


def test_the_wheel_holds_every_package_and_law() -> None:
    project = tomllib.loads((SOURCES.parents[1] / "pyproject.toml").read_text())
    held = project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert held == [f"ros_ws/src/{package.name}/{package.name}" for package in PACKAGES]
    (laws,) = project["project"]["entry-points"].values()
    setup = (SOURCES / "control_laws" / "setup.py").read_text()
    assert laws == dict(re.findall(r'"(\w+) = ([\w.]+:\w+)"', setup))


def test_packages_citation_and_changelog_have_one_version() -> None:
    root = SOURCES.parents[1]
    files = [*PACKAGES, root / "examples" / "pid_law"]
    versions = {ElementTree.parse(package / "package.xml").findtext("version") for package in files}
    cited = re.search(r"^version: (.+)$", (root / "CITATION.cff").read_text(), re.MULTILINE)
    newest = re.search(
        r"^## (\d\S*) - \d{4}-\d\d-\d\d$", (root / "CHANGELOG.md").read_text(), re.MULTILINE
    )
    assert cited is not None
    assert newest is not None
    assert versions == {cited[1]} == {newest[1]}


def test_each_folder_of_tests_is_of_a_package() -> None:
    levels = [TESTS / level for level in ("pure", "nodes", "ros")]
    folders = {
        path.name for level in levels for path in level.iterdir() if any(path.rglob("test_*.py"))
    }
    assert folders == {package.name for package in PACKAGES}


def test_pytest_runs_the_tests_of_a_package() -> None:
    """The command pytest is run in the folder of a package, with the arguments of `colcon test`."""
    command = [sys.executable, "-m", "pytest", "-o", "cache_dir=cache", "--collect-only", "-qq"]
    done = subprocess.run(
        command, cwd=SOURCES / "flight_recorder", capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout
    assert set(re.findall(r"test_\w+\.py", done.stdout)) == {
        path.name for path in files_of("flight_recorder")
    }


def test_page_on_ros_names_what_rosdep_cannot_install() -> None:
    page = (SOURCES.parents[1] / "docs" / "ros.md").read_text()
    assert not {name for name in WITHOUT_KEY if f"`{name.replace('_', '-')}`" not in page}


def test_packages_install_their_data_files() -> None:
    check_packages(uninstalled_data)


def uninstalled_data(package: Path) -> set[Path]:
    """Return the data files that setup.py does not name.

    A symlinked build has all files of the package folder.
    """
    setup = (package / "setup.py").read_text()
    named = {
        pattern
        for data in re.findall(r"package_data=\{[^}]*\}", setup)
        for pattern in re.findall(r'"([^"]+)"', data)
    }
    code = package / package.name
    data = {
        path for path in code.rglob("*") if path.is_file() and path.suffix not in {".py", ".pyc"}
    }
    return data - {path for pattern in named for path in code.glob(pattern)}


def test_packages_are_installed_with_their_index_entry() -> None:
    check_packages(missing_entries)


def missing_entries(package: Path) -> list[Path]:
    share = INSTALLED / package.name / "share"
    entries = [
        share / "ament_index" / "resource_index" / "packages" / package.name,
        share / package.name / "package.xml",
    ]
    return [path for path in entries if not path.exists()]


def test_executables_are_where_ros2_run_looks() -> None:
    paths = [
        INSTALLED / package / "lib" / package / executable
        for package, executable in EXECUTABLES.items()
    ]
    assert [path for path in paths if not os.access(path, os.X_OK)] == []


def test_every_source_file_states_its_licence() -> None:
    root = SOURCES.parents[1]
    files = [
        *SOURCES.rglob("*.py"),
        *(root / "tests").rglob("*.py"),
        *(root / "benchmarks").rglob("*.py"),
    ]
    unmarked = [
        path
        for path in files
        if "SPDX-License-Identifier: Apache-2.0" not in path.read_text()[:200]
    ]
    assert not unmarked
