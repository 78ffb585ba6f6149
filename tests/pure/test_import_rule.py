# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test who may import whom, by one table.

The table is compared with the imports of every source file and with docs/architecture.md.
"""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from tests.conftest import REPOSITORY

SOURCES = REPOSITORY / "ros_ws" / "src"
ROS = {"rclpy", "ament_index_python", "launch", "launch_ros", "flight_ros"}
ROS_SUFFIXES = ("_msgs", "_interfaces", "_srvs")
CLIENTS = {"client.py", "control_client.py", "monitor.py", "player.py"}
ROS_FILES = {"node.py", "main.py"} | CLIENTS  # nodes, their executables, and clients of nodes
ROS_FOLDERS = {"flight_ros", "launch"}
IMPORTS: dict[str, set[str]] = {
    unit: set(units)
    for unit, units in yaml.safe_load(Path(__file__).with_name("imports.yaml").read_text()).items()
}
"""Which units of the stack a unit imports."""


def imported_modules(path: Path) -> set[str]:
    """Return the full names of all modules that a file imports, anywhere in the file.

    For `from a import b` these are a and a.b.
    """
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names


def imported(path: Path) -> set[str]:
    """Return the top-level names of all modules that a file imports."""
    return {name.split(".")[0] for name in imported_modules(path)}


def unit_of(module: str) -> str | None:
    """Return the unit of the table that a module belongs to, or None for a foreign module."""
    return next((unit for unit in IMPORTS if module == unit or module.startswith(f"{unit}.")), None)


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(SOURCES).with_suffix("").parts[1:])


def may_import_ros(path: Path) -> bool:
    return path.name in ROS_FILES or bool(ROS_FOLDERS & set(path.relative_to(SOURCES).parts[:-1]))


FILES = sorted(
    path
    for path in SOURCES.glob("*/**/*")
    if path.suffix in {".py", ".pyi"} and path.name != "setup.py"
)


def test_mathematics_never_imports_ros() -> None:
    """Only nodes, executables, clients, flight_ros and launch files import ROS."""
    foreign = [
        f"{path.relative_to(SOURCES)} imports {name}"
        for path in FILES
        if not may_import_ros(path)
        for name in imported(path)
        if name in ROS or name.endswith(ROS_SUFFIXES)
    ]
    assert not foreign, "\n".join(foreign)


def test_units_import_what_the_table_says() -> None:
    """No file imports more than the table says, and no unit imports less."""
    unused = {unit: set(units) for unit, units in IMPORTS.items()}
    wrong = []
    for path in FILES:
        if (unit := unit_of(module_of(path))) is None:
            continue
        units = {
            other_unit
            for module in imported_modules(path)
            if (other_unit := unit_of(module)) is not None
        } - {unit}
        ros = {"flight_ros"} if may_import_ros(path) else set()
        wrong += [
            f"{path.relative_to(SOURCES)} imports {name}" for name in units - IMPORTS[unit] - ros
        ]
        unused[unit] -= units
    wrong += [
        f"the table lets {unit} import {name}, which it does not"
        for unit, names in unused.items()
        for name in names
    ]
    assert not wrong, "\n".join(wrong)


def test_every_source_file_belongs_to_unit_of_table() -> None:
    # their units are their subpackages, and metrics
    packages = {"flight_analysis", "flight_design", "flight_design.main"}
    strays = [
        path for path in FILES if "launch" not in path.parts and unit_of(module_of(path)) is None
    ]
    assert {module_of(path).removesuffix(".__init__") for path in strays} <= packages


def test_no_unit_imports_itself_over_others() -> None:
    assert len(list(TopologicalSorter(IMPORTS).static_order())) == len(IMPORTS)  # raises CycleError


def test_no_file_imports_itself_over_others() -> None:
    """Imports inside functions and under TYPE_CHECKING count, because they only hide a circle."""
    files = {module_of(path).removesuffix(".__init__"): path for path in FILES}
    graph = {
        module: (imported_modules(path) & files.keys()) - {module} for module, path in files.items()
    }
    assert len(list(TopologicalSorter(graph).static_order())) == len(files)  # raises CycleError


def test_architecture_page_shows_table_in_layers() -> None:
    assert "(images/packages.svg)" in (REPOSITORY / "docs" / "architecture.md").read_text()
    drawing = ElementTree.parse(REPOSITORY / "docs" / "images" / "packages.svg")
    rows: dict[int, list[str]] = {}  # by distance from the top
    for text in drawing.iter("{http://www.w3.org/2000/svg}text"):
        rows.setdefault(round(float(text.attrib["y"])), []).append(text.text or "")
    sorter = TopologicalSorter(IMPORTS)
    sorter.prepare()
    for y in sorted(rows, reverse=True):  # a unit is right above the highest of those it imports
        layer = sorter.get_ready()
        assert rows[y] == sorted(layer)
        sorter.done(*layer)
    assert not sorter.is_active()


def modules_loaded_by(code: str) -> set[str]:
    """Return the top-level names of the modules that an interpreter has loaded after some code."""
    code = f"import sys\n{code}\nprint(*{{name.split('.')[0] for name in sys.modules}})"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(shown.stdout.split())


def test_command_line_shows_help_without_loading_what_commands_need() -> None:
    heavy = {
        "rclpy",
        "flight_ros",
        "numpy",
        "scipy",
        "pydantic",
        "jax",
        "plotly",
        "polars",
        "jsbsim",
        "rosbags",
    }
    assert not modules_loaded_by("from flight_cli.cli import application\napplication([])") & heavy


NODES = [
    "rise_di_controller",
    "reference_model",
    "flight_guidance",
    "autopilot_bridge",
    "flight_recorder",
    "aircraft_sim",
]


@pytest.mark.parametrize("node", NODES)
def test_node_loads_nothing_heavy_that_it_does_not_need(node: str) -> None:
    assert not modules_loaded_by(f"import {node}.node") & {
        "scipy",
        "jsbsim",
        "plotly",
        "jax",
        "rosbags",
    }


@pytest.mark.parametrize(
    "module", ["flight_analysis.report.run_report", "flight_analysis.closed_loop.simulate"]
)
def test_flight_loads_no_library_of_report(module: str) -> None:
    assert not modules_loaded_by(f"import {module}") & {
        "scipy",
        "plotly",
        "jinja2",
        "polars",
        "matplotlib",
        "ruamel",
    }


def test_private_names_of_rclpy_are_in_one_file() -> None:
    files = [
        str(path.relative_to(SOURCES))
        for path in FILES
        if path.name != "rclpy_private.py" and has_private_names(path)
    ]
    assert not files, "\n".join(files)


def has_private_names(path: Path) -> bool:
    """Return whether a file imports rclpy.impl, or imports rclpy and reads a `handle`."""
    text = path.read_text()
    nodes = list(ast.walk(ast.parse(text))) if "rclpy" in text else []
    modules = [node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module]
    reads_handle = any(isinstance(node, ast.Attribute) and node.attr == "handle" for node in nodes)
    return any(
        name.startswith("rclpy.impl") or (name.startswith("rclpy") and reads_handle)
        for name in modules
    )
