# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Mathematics never imports ROS: shown by walking the imports of every source file."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

SOURCES = Path(__file__).resolve().parents[2] / "ros_ws" / "src"
ROS = {"rclpy", "ament_index_python", "launch", "launch_ros", "flight_ros"}
OF_ROS = {"node.py", "main.py"}  # a package's node, and its executable
ROS_SUFFIXES = ("_msgs", "_interfaces", "_srvs")
MAY = {  # which packages of the stack a package's maths may import
    "flight_core": set(),
    "reference_model": {"flight_core"},
    "rise_di_controller": {"flight_core"},
    "aircraft_sim": {"flight_core"},
    "autopilot_bridge": {"flight_core"},
    "flight_recorder": {"flight_core"},
    "flight_analysis": {"flight_core", "reference_model", "rise_di_controller", "aircraft_sim", "flight_recorder"},
}


def imported(path: Path) -> set[str]:
    """Top-level names of all modules that a file imports, wherever in the file."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names.add(node.module)
    return {name.split(".")[0] for name in names}


def may_import_ros(path: Path) -> bool:
    return path.name in OF_ROS or {"flight_ros", "launch"} & set(path.relative_to(SOURCES).parts[:-1])  # type: ignore[return-value]


FILES = sorted(path for path in SOURCES.glob("*/**/*.py") if path.name != "setup.py")


def test_there_are_sources_to_check() -> None:
    assert len(FILES) > 30


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(SOURCES)))
def test_only_nodes_flight_ros_and_launch_files_import_ros(path: Path) -> None:
    if may_import_ros(path):
        return
    foreign = {name for name in imported(path) if name in ROS or name.endswith(ROS_SUFFIXES)}
    assert not foreign, f"{path.relative_to(SOURCES)} imports {foreign}"


@pytest.mark.parametrize("package", sorted(MAY))
def test_a_package_imports_only_the_packages_before_it(package: str) -> None:
    ours = {path.name for path in SOURCES.iterdir()}
    for path in (SOURCES / package / package).glob("**/*.py"):
        if path.name not in OF_ROS:
            assert (imported(path) & ours) - {package} <= MAY[package], path.name


def test_the_guard_would_notice_an_import(tmp_path: Path) -> None:
    bad = tmp_path / "law.py"
    bad.write_text("def f():\n    import rclpy.node\n", encoding="utf-8")
    assert "rclpy" in imported(bad)


def test_the_command_line_starts_without_loading_ros() -> None:
    code = "import sys, flight_bringup.cli; print([m for m in sys.modules if m.split('.')[0] in ('rclpy', 'flight_ros')])"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "[]"
