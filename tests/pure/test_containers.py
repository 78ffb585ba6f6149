# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the Dockerfiles and the compose file against the tree, without a container engine."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from tests.conftest import REPOSITORY, invoke

from autopilot_bridge.params import LIBRARY

DOCKER = REPOSITORY / "docker"
AUTOPILOT: dict[str, dict[str, Any]] = yaml.safe_load((DOCKER / "autopilot.yaml").read_text())[
    "services"
]
DOCKERFILES = sorted(DOCKER.glob("Dockerfile*"))
COMPOSE: dict[str, Any] = yaml.safe_load((DOCKER / "compose.yaml").read_text())
SERVICES: dict[str, dict[str, Any]] = COMPOSE["services"]


def instructions(dockerfile: Path) -> list[tuple[str, str]]:
    """Return each instruction of a Dockerfile with its arguments, in order."""
    lines = [
        line for line in dockerfile.read_text().splitlines() if line and not line.startswith("#")
    ]
    joined = re.sub(r"\s*\\\n\s*", " ", "\n".join(lines)).splitlines()
    return [(word, rest) for word, _, rest in (line.partition(" ") for line in joined)]


@pytest.mark.parametrize("dockerfile", DOCKERFILES, ids=lambda path: path.name)
def test_image_is_small_and_user_is_not_root(dockerfile: Path) -> None:
    words = instructions(dockerfile)
    stages = [index for index, (word, _) in enumerate(words) if word == "FROM"]
    assert len(stages) == 2, "one stage to build, one to run"
    last = dict(words[stages[-1] :])
    assert int(last["USER"]) > 0, "a number, which needs no user list of the image"
    assert last["VOLUME"] == "/runs"
    assert not re.search(
        r"\bpip\b|build-essential|gcc|colcon", " ".join(rest for _, rest in words[stages[-1] :])
    )
    bases = [rest.partition("=")[2] for word, rest in words if word == "ARG" and "BASE=" in rest]
    assert all(
        re.fullmatch(r"[\w./-]+:[\w.-]+", base) and not base.endswith(":latest") for base in bases
    )


def test_no_service_has_a_network() -> None:
    # One network namespace with the loopback interface only; the stack's DDS profile uses it.
    assert SERVICES["recorder"]["network_mode"] == "none"
    assert {
        service["network_mode"] for name, service in SERVICES.items() if name != "recorder"
    } == {"service:recorder"}
    for service in SERVICES.values():
        assert not service.keys() & {
            "ports",
            "networks",
            "privileged",
            "user",
            "pid",
            "ipc",
            "environment",
        }
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert service["read_only"] is True


def test_only_link_of_autopilot_is_open() -> None:
    """The topics of the agent and of the flight are on one loopback interface.

    It has the stack's own profile.
    """
    agent = AUTOPILOT["agent"]
    flight = AUTOPILOT["flight"]
    assert AUTOPILOT.keys() == {"agent", "flight"}
    (profile,) = agent["volumes"]
    source, target, access = profile.split(":")
    assert (
        DOCKER / source
    ).resolve() == REPOSITORY / "ros_ws" / "src" / "flight_ros" / "flight_ros" / "loopback.xml"
    assert (DOCKER / source).is_file()
    assert agent["environment"] == {"FASTRTPS_DEFAULT_PROFILES_FILE": target}
    assert access == "ro"
    (port,) = agent["ports"]
    assert port == f"{agent['command'][-1]}:{agent['command'][-1]}/udp"
    assert flight["network_mode"] == "service:agent"
    assert not flight.keys() & {
        "ports",
        "networks",
        "privileged",
        "user",
        "pid",
        "ipc",
        "environment",
    }
    for service in AUTOPILOT.values():
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert service["restart"] == "no"


def test_flight_of_autopilot_is_dry_unless_it_told_to_send(tmp_path: Path) -> None:
    """The command is expanded by compose without variables, except for the scenario.

    The command ends at the scenario, which does not exist.
    """
    command = re.sub(
        r"\$\{SCENARIO:\?[^}]*\}", str(tmp_path / "absent.yaml"), AUTOPILOT["flight"]["command"]
    )
    words = re.sub(r"\$\{\w+:-(.*?)\}", r"\1", command).split()
    assert words[0] == "rise-di"
    assert "--send" not in words
    assert (LIBRARY / f"{words[words.index('--bridge') + 1]}.yaml").is_file()
    done = invoke(*words[1:])
    assert str(done.exception).startswith("scenario"), done.output  # no option is unknown
