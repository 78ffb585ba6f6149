# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The images and the compose file fit the tree: what can be shown without a container engine."""

import re
import tomllib
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from typing import Any

import pytest
import yaml

from flight_analysis.closed_loop.scenario import SCHEMAS

ROOT = Path(__file__).resolve().parents[2]
DOCKER = ROOT / "docker"
INSTALLED = ROOT / "ros_ws" / "install"
DOCKERFILES = sorted(DOCKER.glob("Dockerfile*"))
COMPOSE: dict[str, Any] = yaml.safe_load((DOCKER / "compose.yaml").read_text(encoding="utf-8"))
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
SAME_FROM_HERE = "# From here on the same in Dockerfile and Dockerfile.ros.\n"


def instructions(dockerfile: Path) -> list[tuple[str, str]]:
    """Each instruction of a Dockerfile with its arguments, in order."""
    lines = [line for line in dockerfile.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    joined = re.sub(r"\s*\\\n\s*", " ", "\n".join(lines)).splitlines()
    return [(word, rest) for word, _, rest in (line.partition(" ") for line in joined)]


def sent(path: str) -> bool:
    """Whether .dockerignore lets a path into the build: the last pattern that fits it, or a folder it is in, decides."""
    inside = True
    for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines():
        pattern = line.removeprefix("!")
        above = [PurePosixPath(path), *PurePosixPath(path).parents][:-1]
        anywhere = pattern.startswith("**/")
        fits = any(fnmatchcase(part.name if anywhere else str(part), pattern.removeprefix("**/")) for part in above)
        if line and not line.startswith("#") and fits:
            inside = line.startswith("!")
    return inside


def pins(lock: Path) -> dict[str, tuple[set[str], int]]:
    """Of each package in a lock file: its versions, more than one where they depend on Python's, and how many hashes."""
    found: dict[str, tuple[set[str], int]] = {}
    for block in re.split(r"\n(?=\S)", lock.read_text(encoding="utf-8")):
        if match := re.match(r"([\w.-]+)==([^\s;]+)", block):
            versions, hashes = found.get(match[1], (set(), 0))
            found[match[1]] = versions | {match[2]}, hashes + block.count("--hash=sha256:")
    return found


@pytest.mark.parametrize("dockerfile", DOCKERFILES, ids=lambda path: path.name)
def test_what_a_dockerfile_copies_is_there_and_is_sent(dockerfile: Path) -> None:
    copied = [
        source
        for word, rest in instructions(dockerfile)
        if word == "COPY" and not rest.startswith("--from=")
        for source in rest.split()[:-1]
    ]
    assert copied
    for source in copied:
        assert (ROOT / source).exists(), source
        assert sent(source), source


def test_only_what_is_built_is_sent() -> None:
    for path in (
        ".git/HEAD",
        ".venv/bin/python",
        "runs/latest",
        "ros_ws/build/x",
        "ros_ws/install/x",
        "ros_ws/log/x",
        "docs/x.md",
    ):
        assert not sent(path), path
    package = "ros_ws/src/flight_core"
    assert not sent(f"{package}/flight_core/__pycache__/rates.pyc")
    assert not sent(f"{package}/flight_core.egg-info/PKG-INFO")
    assert sent(f"{package}/flight_core/rates.py")


@pytest.mark.parametrize("dockerfile", DOCKERFILES, ids=lambda path: path.name)
def test_an_image_is_small_and_its_user_is_not_root(dockerfile: Path) -> None:
    words = instructions(dockerfile)
    stages = [index for index, (word, _) in enumerate(words) if word == "FROM"]
    assert len(stages) == 2, "one stage that builds, one that flies"
    last = dict(words[stages[-1] :])
    assert int(last["USER"]) > 0, "by number, so that it can be checked without the image's list of users"
    assert last["VOLUME"] == "/runs"
    assert not re.search(r"\bpip\b|build-essential|gcc|colcon", " ".join(rest for _, rest in words[stages[-1] :]))
    bases = [rest.partition("=")[2] for word, rest in words if word == "ARG" and "BASE=" in rest]
    assert all(re.fullmatch(r"[\w./-]+:[\w.-]+", base) and not base.endswith(":latest") for base in bases)


def test_both_images_run_alike() -> None:
    assert len({path.read_text(encoding="utf-8").partition(SAME_FROM_HERE)[2] for path in DOCKERFILES}) == 1
    assert len(DOCKERFILES) == 2


def test_images_are_installed_by_the_same_uv_as_the_makefile() -> None:
    version = re.search(r"^UV_VERSION := (\S+)", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert version is not None
    for dockerfile in DOCKERFILES:
        assert re.findall(r"uv==(\S+) --hash=sha256:[0-9a-f]{64}", dockerfile.read_text(encoding="utf-8")) == [version[1]]


def test_the_lists_of_packages_agree() -> None:
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["dependency-groups"]
    direct = {re.split(r"[<=>\[]", name)[0].lower() for group in ("core", "report", "campaign") for name in groups[group]}
    main, ros = pins(ROOT / "requirements.lock"), pins(DOCKER / "requirements-ros.lock")
    mend = "make -C docker requirements-ros.lock"
    assert direct <= ros.keys(), mend
    assert not {name for name in ros if name.startswith("ros-")}, "ROS 2 comes with the image"
    assert all(hashes for _, hashes in ros.values())
    assert ros["numpy"][0] == {"1.26.4"}, "Ubuntu 24.04's, which the messages are compiled with"
    others = ros.keys() - {"numpy", "scipy", "jax", "jaxlib", "ml-dtypes"}  # these follow numpy
    assert not {name for name in others if name in main and not ros[name][0] <= main[name][0]}, mend


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_starts_its_node_with_parameters_that_it_has(name: str) -> None:
    executable, arguments, *words = SERVICES[name]["command"]
    assert list(INSTALLED.glob(f"*/lib/*/{executable}"))
    assert executable == name  # also the section of the scenario file
    assert arguments == "--ros-args"
    options = list(zip(words[::2], words[1::2], strict=True))
    (scenario,) = [word for option, word in options if option == "--params-file"]
    default = re.sub(r"\$\{SCENARIO:-(\w+)\}", r"\1", scenario)
    share = INSTALLED / "flight_bringup" / "share" / "flight_bringup"
    assert (share / PurePosixPath(default).relative_to("/opt/rise-di/install/share/flight_bringup")).is_file()
    assert {word.partition(":=")[0] for option, word in options if option == "-p"} <= SCHEMAS[name].model_fields.keys()
    assert {option for option, _ in options} <= {"--params-file", "-p"}


def test_services_are_the_nodes_of_a_flight() -> None:
    assert SERVICES.keys() == {"aircraft", "reference_model", "controller", "recorder"}
    told = {name for name, service in SERVICES.items() if any("start_time:=" in word for word in service["command"])}
    assert told == {"aircraft", "reference_model"}  # those that have a t = 0


def test_nothing_of_the_services_is_open_to_a_network() -> None:
    # one namespace with the loopback interface alone, which the stack's own profile of the middleware talks over
    assert SERVICES["recorder"]["network_mode"] == "none"
    assert {service["network_mode"] for name, service in SERVICES.items() if name != "recorder"} == {"service:recorder"}
    for service in SERVICES.values():
        assert not service.keys() & {"ports", "networks", "privileged", "user", "pid", "ipc", "environment"}
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert service["read_only"] is True


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_is_watched_ended_and_not_restarted(name: str) -> None:
    service = SERVICES[name]
    image = dict(instructions(DOCKER / "Dockerfile"))["HEALTHCHECK"]
    command = yaml.safe_load(image[image.index("CMD [") + 4 :])
    assert service["healthcheck"] == {"test": ["CMD", *command, name]}  # intervals are the image's
    assert service["restart"] == "no"
    assert service["stop_grace_period"] == "5s"
    assert service["depends_on"] == ([] if name == "recorder" else ["recorder"])  # compose ends them the other way round
