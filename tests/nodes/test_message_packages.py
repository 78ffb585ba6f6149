# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test `make messages` with two small packages, which are built and imported.

One of them contains messages of the other.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from tools import messages
from tools.messages import MessagesError, closure, find_sources, in_order, main

PACKAGE_XML = """<?xml version="1.0"?>
<package format="3">
  <name>{name}</name><version>1.0.0</version><description>For a test</description>
  <maintainer email="test@example.org">test</maintainer><license>Apache-2.0</license>
  <buildtool_depend>ament_cmake</buildtool_depend><buildtool_depend>rosidl_default_generators</buildtool_depend>
  {depends}
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
"""
CMAKE = """cmake_minimum_required(VERSION 3.8)
project({name})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
{found}
rosidl_generate_interfaces(${{PROJECT_NAME}} {files} DEPENDENCIES {dependencies})
ament_export_dependencies(rosidl_default_runtime)
ament_package()
"""


def write_package(folder: Path, name: str, files: dict[str, str], dependencies: list[str]) -> None:
    """Write an interface package as its authors do."""
    for path, text in files.items():
        (folder / name / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / name / path).write_text(text)
    depends = "".join(f"<depend>{dependency}</depend>" for dependency in dependencies)
    found = "\n".join(f"find_package({dependency} REQUIRED)" for dependency in dependencies)
    listed = " ".join(f'"{path}"' for path in files)
    (folder / name / "package.xml").write_text(PACKAGE_XML.format(name=name, depends=depends))
    text = CMAKE.format(name=name, found=found, files=listed, dependencies=" ".join(dependencies))
    (folder / name / "CMakeLists.txt").write_text(text)


@pytest.fixture
def sources(tmp_path: Path) -> Path:
    """Return the sources of plane_msgs and air_msgs.

    State of plane_msgs has a Wind of air_msgs and a Mode of its own. Drift has a Wind.
    """
    plane = {
        "msg/State.msg": "std_msgs/Header header\nair_msgs/Wind wind\nMode[2] modes\n",
        "msg/Mode.msg": "uint8 mode\n",
        "msg/Drift.msg": "std_msgs/Header header\nair_msgs/Wind wind\n",
        "srv/Arm.srv": "bool arm\n---\nMode mode\n",
    }
    write_package(tmp_path / "plane", "plane_msgs", plane, ["std_msgs", "air_msgs"])
    write_package(tmp_path / "air", "air_msgs", {"msg/Wind.msg": "float32[3] v\n"}, ["std_msgs"])
    return tmp_path


@pytest.fixture(autouse=True)
def build_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setattr(messages, "BUILD", tmp_path / "build")
    return tmp_path / "build"


def test_package_built_after_those_that_it_contains_messages_of(sources: Path) -> None:
    assert in_order("plane_msgs", find_sources([sources])) == ["air_msgs", "plane_msgs"]
    # air_msgs may be installed
    assert in_order("plane_msgs", find_sources([sources / "plane"])) == ["plane_msgs"]


def test_installed_package_in_place_of_sources_is_one_sentence(sources: Path) -> None:
    (sources / "air" / "air_msgs" / "CMakeLists.txt").unlink()
    with pytest.raises(
        MessagesError, match=r"SOURCE: found no CMakeLists\.txt in .*air_msgs, expected sources"
    ):
        in_order("plane_msgs", find_sources([sources]))


def test_part_of_package_holds_what_messages_contain(sources: Path) -> None:
    plane = sources / "plane" / "plane_msgs"
    assert closure("plane_msgs", plane, ["State"]) == {"State", "Mode"}
    assert closure("plane_msgs", plane, ["Arm"]) == {"Arm", "Mode"}
    with pytest.raises(
        MessagesError, match="MESSAGES: found Speed, expected interfaces of plane_msgs"
    ):
        closure("plane_msgs", plane, ["State", "Speed"])


def test_package_that_is_not_among_sources_refused(
    sources: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["px4_msgs", str(sources)]) == 2
    assert (
        "PACKAGE: found px4_msgs, expected one of SOURCE: air_msgs, plane_msgs"
        in capsys.readouterr().err
    )
    assert main(["px4_msgs", str(sources / "nowhere")]) == 2
    assert (
        "nowhere, expected a folder with the sources of message packages" in capsys.readouterr().err
    )


needs_compiler = pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler here")


@needs_compiler
def test_a_missing_dependency_is_named(
    sources: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plane_msgs", str(sources / "plane"), "--prefix", str(tmp_path / "prefix")]) == 2
    expected = (
        "plane_msgs needs air_msgs, which is neither installed nor below SOURCE: add the "
        "folder that holds it"
    )
    assert expected in capsys.readouterr().err


@needs_compiler
def test_built_packages_are_imported_and_serialized(
    sources: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    prefix = tmp_path / "prefix"
    assert (
        main(["plane_msgs", str(sources), "--messages", "Drift", "--prefix", str(prefix)]) == 0
    ), capsys.readouterr().err
    (site_packages,) = prefix.glob("lib/python3*/site-packages")
    program = """
from rclpy.serialization import deserialize_message, serialize_message
from plane_msgs import msg
drift = msg.Drift()
drift.wind.v = [1.0, 2.0, 3.0]
copy = deserialize_message(serialize_message(drift), msg.Drift)
print(copy.wind.v.tolist(), hasattr(msg, "State"))
"""
    libraries = f"{prefix / 'lib'}{os.pathsep}{os.environ['LD_LIBRARY_PATH']}"
    environment = {**os.environ, "PYTHONPATH": str(site_packages), "LD_LIBRARY_PATH": libraries}
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.strip() == "[1.0, 2.0, 3.0] False", done.stderr
