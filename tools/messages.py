# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Build ROS 2 message packages for this interpreter from their sources.

ROS 2 itself comes from PyPI.

    make messages PACKAGE=px4_msgs SOURCE=../px4_msgs
    make messages PACKAGE=mavros_msgs SOURCE="../mavros ../geographic_info"
        # the package, and what it depends on
    make messages PACKAGE=px4_msgs SOURCE=../px4_msgs MESSAGES="VehicleOdometry AirspeedValidated"

It installs into the virtual environment, so that every process of the stack finds the package. It
needs a C and a C++ compiler and the headers of Python. If ROS 2 is installed in full, `colcon
build` does the same.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import time
from collections.abc import Iterator, Mapping, Sequence
from graphlib import TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from catkin_pkg.packages import find_packages
from rosidl_adapter.parser import (
    MessageSpecification,
    parse_action_file,
    parse_message_file,
    parse_service_file,
)

BUILD = Path(__file__).resolve().parents[1] / "build" / "messages"
KINDS = ("msg", "srv", "action")
# what CMake's find_package says if a package is missing
MISSING = re.compile(r'package configuration\s+file\s+provided\s+by\s+"(\w+)"')
LAST_LINES = 15  # lines that are shown of the output of a failed step


class MessagesError(Exception):
    """The packages cannot be built. The sentence says what to change."""


class Source(NamedTuple):
    """A ROS package with its sources."""

    folder: Path
    dependencies: frozenset[str]


def find_sources(folders: Sequence[Path]) -> dict[str, Source]:
    """Find the ROS packages below `folders`."""
    sources = {}
    for folder in folders:
        if not folder.is_dir():
            raise MessagesError(
                f"SOURCE: found {folder}, expected a folder with the sources of message packages"
            )
        for path, package in find_packages(str(folder)).items():
            dependencies = (*package.build_depends, *package.build_export_depends)
            sources[package.name] = Source(
                folder / path, frozenset(dependency.name for dependency in dependencies)
            )
    return sources


def in_order(package: str, sources: Mapping[str, Source]) -> list[str]:
    """Return the package and those of its dependencies that are among the sources.

    Each package comes after the packages on which it depends.
    """
    if package not in sources:
        raise MessagesError(
            f"PACKAGE: found {package or 'none'}, expected one of SOURCE: "
            f"{', '.join(sorted(sources)) or 'none'}"
        )
    graph, waiting = dict[str, frozenset[str]](), [package]
    while waiting:
        name = waiting.pop()
        if name not in graph:
            folder = sources[name].folder
            if not (folder / "CMakeLists.txt").is_file():
                raise MessagesError(
                    f"SOURCE: found no CMakeLists.txt in {folder}, expected sources, not an "
                    "installed package"
                )
            graph[name] = sources[name].dependencies & sources.keys()
            waiting += graph[name]
    return list(TopologicalSorter(graph).static_order())


def specifications(package: str, path: Path) -> Iterator[MessageSpecification]:
    """Yield the messages of which an interface file consists."""
    if path.suffix == ".msg":
        yield parse_message_file(package, str(path))
    elif path.suffix == ".srv":
        service = parse_service_file(package, str(path))
        yield from (service.request, service.response)
    else:
        action = parse_action_file(package, str(path))
        yield from (action.goal, action.result, action.feedback)


def closure(package: str, source: Path, names: Sequence[str]) -> set[str]:
    """Return the named interfaces of a package, and what they contain of the same package.

    An interface that they contain is followed into its own fields. Raises MessagesError for a name
    that the package does not have.
    """
    files = {path.stem: path for kind in KINDS for path in (source / kind).glob(f"*.{kind}")}
    unknown = [name for name in names if name not in files]
    if unknown:
        raise MessagesError(
            f"MESSAGES: found {', '.join(unknown)}, expected interfaces of {package}, as in "
            f"{source}"
        )
    waiting, order = list(names), set[str]()
    while waiting:
        name = waiting.pop()
        if name not in order:
            order.add(name)
            fields = [
                field.type for spec in specifications(package, files[name]) for field in spec.fields
            ]
            waiting += [kind.type for kind in fields if kind.pkg_name == package]
    return order


def copy_of_part(package: str, source: Path, names: Sequence[str], target: Path) -> Path:
    """Copy a package to `target`, with only the named interfaces and those that they contain.

    CMakeLists.txt of the copy does not list any other interface. Returns `target`.
    """
    packages = closure(package, source, names)
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target, ignore=shutil.ignore_patterns(".*"))
    lists = target / "CMakeLists.txt"
    text = lists.read_text(encoding="utf-8")
    for path in [
        path
        for kind in KINDS
        for path in (target / kind).glob(f"*.{kind}")
        if path.stem not in packages
    ]:
        path.unlink()
        text = re.sub(rf'"?\b{path.parent.name}/{re.escape(path.name)}"?', "", text)
    lists.write_text(text, encoding="utf-8")
    return target


def point_at_this_python(prefix: Path) -> None:
    """Let the CMake files of the wheels name the headers of this Python and of its numpy.

    Before, they name the headers of the Python that built the wheels. Raises MessagesError if the
    headers of this Python are not installed.
    """
    include = sysconfig.get_path("include")
    if not Path(include, "Python.h").is_file():
        raise MessagesError(
            f"no {include}/Python.h: install the headers of Python, with apt-get install "
            "python3-dev on Debian"
        )
    for path in prefix.glob("share/*/cmake/export_*__rosidl_generator_pyExport.cmake"):
        text = path.read_text(encoding="utf-8")
        fixed = re.sub(r'[^;"]*/numpy/(_core|core)/include', np.get_include(), text)
        fixed = re.sub(r'[^;"]*/include/python3\.\d+', include, fixed)
        if fixed != text:
            path.write_text(fixed, encoding="utf-8")


def run(log: Path, prefix: Path, *command: str) -> None:
    """Run a step of a build, with the packages of this environment and of `prefix` alone.

    Its output goes to a log. Raises MessagesError if the step fails.
    """
    # If the user has sourced another ROS 2, its packages would mix with those of the wheels.
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in {"CMAKE_PREFIX_PATH", "PYTHONPATH"}
    }
    environment["AMENT_PREFIX_PATH"] = f"{prefix}{os.pathsep}{sys.prefix}"
    with log.open("a", encoding="utf-8") as file:
        process = subprocess.run(
            command, env=environment, stdout=file, stderr=subprocess.STDOUT, check=False
        )
    if process.returncode == 0:
        return
    text = log.read_text(encoding="utf-8")
    if missing := MISSING.search(text):
        sentence = (
            f"{log.stem} needs {missing[1]}, which is neither installed nor below "
            "SOURCE: add the folder that holds it"
        )
        raise MessagesError(sentence)
    end = "\n".join(text.splitlines()[-LAST_LINES:])
    raise MessagesError(f"{log.stem} does not build; the whole output is in {log}\n{end}")


def build(package: str, source: Path, prefix: Path, jobs: int) -> None:
    """Build one package and install it below `prefix`."""
    folder, log = BUILD / package, BUILD / f"{package}.log"
    folder.mkdir(parents=True, exist_ok=True)
    log.write_text("", encoding="utf-8")
    cmake, ninja = (str(Path(sys.executable).parent / name) for name in ("cmake", "ninja"))
    run(
        log, prefix, cmake, "--fresh", "-G", "Ninja", "-S", str(source), "-B", str(folder),
        f"-DCMAKE_MAKE_PROGRAM={ninja}",
        f"-DCMAKE_PREFIX_PATH={prefix};{sys.prefix}", f"-DCMAKE_INSTALL_PREFIX={prefix}",
        f"-DPython3_EXECUTABLE={sys.executable}", "-DBUILD_TESTING=OFF",
    )  # fmt: skip
    run(log, prefix, ninja, "-C", str(folder), "-j", str(jobs), "install")


def main(arguments: Sequence[str] | None = None) -> int:
    """Build a package and those that it needs; return 2, with a sentence, if that fails."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("package")
    parser.add_argument(
        "sources", nargs="+", type=Path, help="folders below which the packages are"
    )
    parser.add_argument(
        "--messages",
        nargs="+",
        default=[],
        help="interfaces of the package to build; without it, all",
    )
    parser.add_argument("--jobs", type=int, default=2, help="steps at a time, each of some 0.3 GB")
    parser.add_argument(
        "--prefix",
        type=Path,
        default=Path(sys.prefix),
        help="where to install; by default this environment",
    )
    options = parser.parse_args(arguments)
    try:
        sources = find_sources([folder.resolve() for folder in options.sources])
        order = in_order(options.package, sources)
        for compiler in ("cc", "c++"):
            if shutil.which(compiler) is None:
                raise MessagesError(
                    f"no {compiler} here: install a C and a C++ compiler, with apt-get install "
                    "g++ on Debian"
                )
        point_at_this_python(Path(sys.prefix))
        for name in order:
            source, start = sources[name].folder, time.monotonic()
            if name == options.package and options.messages:
                source = copy_of_part(name, source, options.messages, BUILD / f"{name}.source")
            print(
                f"{name}: builds from {sources[name].folder}; the output is in {BUILD / name}.log",
                flush=True,
            )
            build(name, source, options.prefix.resolve(), options.jobs)
            print(
                f"{name}: installed in {options.prefix} after {time.monotonic() - start:.0f} s",
                flush=True,
            )
    except MessagesError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
