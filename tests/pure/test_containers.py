# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The Dockerfiles and the compose file against the tree, without a container engine."""

import re
import tomllib
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from autopilot_bridge.params import LIBRARY
from flight_analysis.closed_loop.scenario import SCHEMAS
from flight_cli.cli import application

ROOT = Path(__file__).resolve().parents[2]
DOCKER = ROOT / "docker"
INSTALLED = ROOT / "ros_ws" / "install"
AUTOPILOT: dict[str, dict[str, Any]] = yaml.safe_load((DOCKER / "autopilot.yaml").read_text(encoding="utf-8"))["services"]
DOCKERFILES = sorted(DOCKER.glob("Dockerfile*"))
COMPOSE: dict[str, Any] = yaml.safe_load((DOCKER / "compose.yaml").read_text(encoding="utf-8"))
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]
SAME_FROM_HERE = "# From here on the same in Dockerfile and Dockerfile.ros.\n"


def instructions(dockerfile: Path) -> list[tuple[str, str]]:
    """Each instruction of a Dockerfile with its arguments, in order."""
    lines = [line for line in dockerfile.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    joined = re.sub(r"\s*\\\n\s*", " ", "\n".join(lines)).splitlines()
    return [(word, rest) for word, _, rest in (line.partition(" ") for line in joined)]


def in_context(path: str) -> bool:
    """Whether a path is in the build context: the last pattern of .dockerignore that matches it, or a folder above, decides."""
    included = True
    for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines():
        pattern = line.removeprefix("!")
        above = [PurePosixPath(path), *PurePosixPath(path).parents][:-1]
        anywhere = pattern.startswith("**/")
        matches = any(fnmatchcase(part.name if anywhere else str(part), pattern.removeprefix("**/")) for part in above)
        if line and not line.startswith("#") and matches:
            included = line.startswith("!")
    return included


def pins(lock: Path) -> dict[str, tuple[set[str], int]]:
    """The versions of each package in a lock file, one for each Python where they differ, and the number of hashes."""
    packages: dict[str, tuple[set[str], int]] = {}
    for block in re.split(r"\n(?=\S)", lock.read_text(encoding="utf-8")):
        if match := re.match(r"([\w.-]+)==([^\s;]+)", block):
            versions, hashes = packages.get(match[1], (set(), 0))
            packages[match[1]] = versions | {match[2]}, hashes + block.count("--hash=sha256:")
    return packages


@pytest.mark.parametrize("dockerfile", DOCKERFILES, ids=lambda path: path.name)
def test_dockerfile_copies_files_of_build_context(dockerfile: Path) -> None:
    copies = [rest for word, rest in instructions(dockerfile) if word == "COPY" and not rest.startswith("--from=")]
    copied = [source for rest in copies for source in rest.split()[:-1]]
    assert copied
    for source in copied:
        assert (ROOT / source).exists(), source
        assert in_context(source), source


def test_the_build_context_holds_sources_only() -> None:
    package = "ros_ws/src/flight_core"
    outside = ["docs/x.md", "runs/latest", ".git/HEAD", ".venv/bin/python"]
    outside += [f"ros_ws/{folder}/x" for folder in ("build", "install", "log")]
    for path in (*outside, f"{package}/flight_core/__pycache__/rates.pyc", f"{package}/flight_core.egg-info/PKG-INFO"):
        assert not in_context(path), path
    assert in_context(f"{package}/flight_core/rates.py")


@pytest.mark.parametrize("dockerfile", DOCKERFILES, ids=lambda path: path.name)
def test_image_is_small_and_user_is_not_root(dockerfile: Path) -> None:
    words = instructions(dockerfile)
    stages = [index for index, (word, _) in enumerate(words) if word == "FROM"]
    assert len(stages) == 2, "one stage to build, one to run"
    last = dict(words[stages[-1] :])
    assert int(last["USER"]) > 0, "a number, which needs no user list of the image"
    assert last["VOLUME"] == "/runs"
    assert not re.search(r"\bpip\b|build-essential|gcc|colcon", " ".join(rest for _, rest in words[stages[-1] :]))
    bases = [rest.partition("=")[2] for word, rest in words if word == "ARG" and "BASE=" in rest]
    assert all(re.fullmatch(r"[\w./-]+:[\w.-]+", base) and not base.endswith(":latest") for base in bases)


def test_both_images_have_the_same_runtime() -> None:
    assert len({path.read_text(encoding="utf-8").partition(SAME_FROM_HERE)[2] for path in DOCKERFILES}) == 1
    assert len(DOCKERFILES) == 2


def test_images_use_uv_of_makefile() -> None:
    version = re.search(r"^UV_VERSION := (\S+)", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert version is not None
    for dockerfile in DOCKERFILES:
        assert re.findall(r"uv==(\S+) --hash=sha256:[0-9a-f]{64}", dockerfile.read_text(encoding="utf-8")) == [version[1]]


def test_the_package_lists_agree() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = [*project["dependencies"], *project["optional-dependencies"]["campaign"]]
    direct = {re.split(r"[<=>\[]", name)[0].lower() for name in needed}
    main, ros = pins(ROOT / "requirements.lock"), pins(DOCKER / "requirements-ros.lock")
    remedy = "make -C docker requirements-ros.lock"
    assert direct <= ros.keys(), remedy
    assert not {name for name in ros if name.startswith("ros-")}, "ROS 2 comes with the image"
    assert all(hashes for _, hashes in ros.values())
    assert ros["numpy"][0] == {"1.26.4"}, "Ubuntu 24.04's, which the messages are compiled with"
    others = ros.keys() - {"numpy", "scipy", "jax", "jaxlib", "ml-dtypes"}  # these follow numpy
    assert not {name for name in others if name in main and not ros[name][0] <= main[name][0]}, remedy


@pytest.mark.parametrize("name", SERVICES)
def test_service_starts_node_with_parameters_that_it_has(name: str) -> None:
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


def test_each_documented_container_starts_program_that_image_has() -> None:
    texts = [path.read_text(encoding="utf-8") for path in (DOCKER / "README.md", ROOT / ".ci" / "images")]
    commands = [match[1] for text in texts for match in re.finditer(r"docker run .*?(?<=\s)rise-di ([\w-]+)", text)]
    assert len(commands) > 3
    for command in commands:
        assert command == "rise-di" or list(INSTALLED.glob(f"*/lib/*/{command}")), command


def test_services_are_nodes_of_flight() -> None:
    assert SERVICES.keys() == {"aircraft", "reference_model", "controller", "recorder"}
    timed = {name for name, service in SERVICES.items() if any("start_time:=" in word for word in service["command"])}
    assert timed == {"aircraft", "reference_model"}  # the nodes with a t = 0


def test_no_service_has_a_network() -> None:
    # One network namespace with the loopback interface only; the stack's DDS profile uses it.
    assert SERVICES["recorder"]["network_mode"] == "none"
    assert {service["network_mode"] for name, service in SERVICES.items() if name != "recorder"} == {"service:recorder"}
    for service in SERVICES.values():
        assert not service.keys() & {"ports", "networks", "privileged", "user", "pid", "ipc", "environment"}
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert service["read_only"] is True


@pytest.mark.parametrize("name", SERVICES)
def test_service_has_health_check_grace_period_and_no_restart(name: str) -> None:
    service = SERVICES[name]
    image = dict(instructions(DOCKER / "Dockerfile"))["HEALTHCHECK"]
    command = yaml.safe_load(image[image.index("CMD [") + 4 :])
    assert service["healthcheck"] == {"test": ["CMD", *command, name]}  # with the image's intervals
    assert service["restart"] == "no"
    assert service["stop_grace_period"] == "5s"
    assert service["depends_on"] == ([] if name == "recorder" else ["recorder"])  # compose stops them in reverse order


def test_only_link_of_autopilot_is_open() -> None:
    """The agent's topics and the flight's are on one loopback interface, with the stack's own profile."""
    agent, flight = AUTOPILOT["agent"], AUTOPILOT["flight"]
    assert AUTOPILOT.keys() == {"agent", "flight"}
    (profile,) = agent["volumes"]
    source, target, access = profile.split(":")
    assert (DOCKER / source).resolve() == ROOT / "ros_ws" / "src" / "flight_ros" / "flight_ros" / "loopback.xml"
    assert (DOCKER / source).is_file()
    assert agent["environment"] == {"FASTRTPS_DEFAULT_PROFILES_FILE": target}
    assert access == "ro"
    (port,) = agent["ports"]
    assert port == f"{agent['command'][-1]}:{agent['command'][-1]}/udp"
    assert flight["network_mode"] == "service:agent"
    assert not flight.keys() & {"ports", "networks", "privileged", "user", "pid", "ipc", "environment"}
    for service in AUTOPILOT.values():
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert service["restart"] == "no"


def test_flight_of_autopilot_is_dry_unless_it_told_to_send(tmp_path: Path) -> None:
    """The command as compose expands it without variables, but for the scenario. It ends at the scenario, which is missing."""
    command = re.sub(r"\$\{SCENARIO:\?[^}]*\}", str(tmp_path / "absent.yaml"), AUTOPILOT["flight"]["command"])
    words = re.sub(r"\$\{\w+:-(.*?)\}", r"\1", command).split()
    assert words[0] == "rise-di"
    assert "--send" not in words
    assert (LIBRARY / f"{words[words.index('--bridge') + 1]}.yaml").is_file()
    done = CliRunner().invoke(application(["fly"]), words[1:])
    assert str(done.exception).startswith("scenario"), done.output  # no option is unknown
