# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that a lockstep flight of the nodes is equal to the byte to the loop in one process.

This is tested with each law and with guidance.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from tests.nodes.world import INPUTS, OUTPUTS, World, world_of
from tests.other_laws import SECTIONS, example_installed
from tests.recordings import scenario_file
from tests.ros.flight_bringup.test_lockstep import ROUGH

from aircraft_sim.node import AircraftNode
from flight_analysis.closed_loop.scenario import Scenario, load_scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_bringup.graph import ONE_PROCESS, parameter_overrides
from flight_core.channels import POSE
from flight_core.outcome import FlightEnded
from flight_core.rates import NANOSECONDS
from flight_guidance.guidance_state import Lateral
from flight_guidance.node import GuidanceNode
from flight_ros.event_loop import require_input
from flight_ros.flight_node import FlightNode
from flight_ros.messages import Encoder, instant
from flight_ros.topics import LIVELINESS
from reference_model.node import ReferenceModelNode
from rise_di_controller.node import ControllerNode

PULSES = {
    "q": {"start": [0.2], "stop": [1.0], "value": [0.1]},
    "p": {"start": [0.4], "stop": [1.4], "value": [0.4]},
}


@contextmanager
def lockstep(scenario: Scenario, folder: Path) -> Iterator[tuple[World, list[FlightNode[Any]]]]:
    """Return the nodes of a flight in lockstep, without a recorder."""
    values = parameter_overrides(ONE_PROCESS, scenario, folder, 0.0, lockstep=True)
    words = (
        word for name, value in values.items() for word in ("-p", f"{name}:={json.dumps(value)}")
    )
    kinds = (
        ReferenceModelNode,
        *((GuidanceNode,) if scenario.guidance else ()),
        ControllerNode,
        AircraftNode,
    )
    with world_of("--params-file", str(scenario.path), *words) as world:
        yield world, [world.make(kind) for kind in kinds]


def flown(scenario: Scenario, folder: Path) -> World:
    """Return the world after the flight."""
    with lockstep(scenario, folder) as (world, nodes):
        while any(node.advance() for node in nodes):
            pass
        assert [message.value for message in world.messages("/node_state")] == ["completed"]
        return world


def require_equal(world: World, scenario: Scenario) -> None:
    """Assert that each sample of the loop in one process was published, to the byte.

    No other sample may have been published.
    """
    tape = simulate(scenario)
    assert {"y", "y_m", "u", "internals", "truth"} <= tape.signals.keys()
    for name, signal in tape.signals.items():
        messages = [sample for sample in world.vectors(f"/{name}") if sample.channels]
        assert [sample.stamp_ns for sample in messages] == signal.stamp_ns.tolist(), name
        values = np.array(
            [[sample.channels[channel] for channel in signal.names] for sample in messages]
        )
        assert values.tobytes() == signal.values.tobytes(), name


def varied(folder: Path, name: str, **sections: Any) -> Scenario:
    """Return a second of a scenario with commands, disturbances and lost samples.

    The given sections are changed.
    """
    changes = {"flight": {"duration": 1.0}, "aircraft": ROUGH, **sections}
    return load_scenario(scenario_file(folder / "varied.yaml", find_scenario(name).path, **changes))


@pytest.mark.parametrize("name", ["osprey_observer", "osprey_turbulence", "osprey_gust"])
def test_scenario_flies_in_lockstep_as_in_one_process(name: str, tmp_path: Path) -> None:
    scenario = varied(tmp_path, name, reference_model={"pulses": PULSES})
    require_equal(flown(scenario, tmp_path), scenario)


@pytest.mark.parametrize("law", ["l1", "pid"])
def test_other_law_flies_in_lockstep_as_in_one_process(law: str, tmp_path: Path) -> None:
    with example_installed(tmp_path) if law == "pid" else nullcontext():
        file = scenario_file(
            tmp_path / "law.yaml",
            find_scenario("osprey_servo").path,
            aircraft=ROUGH,
            flight={"duration": 1.0},
        )
        tree = yaml.safe_load(file.read_text())
        tree["/**/controller"]["ros__parameters"] = SECTIONS[law]
        tree["/**/reference_model"]["ros__parameters"]["pulses"] = PULSES
        file.write_text(yaml.safe_dump(tree))
        scenario = load_scenario(file)
        require_equal(flown(scenario, tmp_path), scenario)


def test_guided_flight_in_lockstep_is_that_of_one_process_and_goes_home_without_a_link(
    tmp_path: Path,
) -> None:
    lost_link = {"home": {"link_timeout": 1.0}, "origin": [47.38, 8.54, 400.0]}
    scenario = varied(tmp_path, "osprey_route", guidance=lost_link, flight={"duration": 2.0})
    world = flown(scenario, tmp_path)
    require_equal(world, scenario)
    assert world.last("/guidance")["mode.lateral"] == Lateral.ORBIT
    # One at each instant but the first: y takes 10 ms.
    assert len([sample for sample in world.vectors("/u_m") if sample.channels]) == 100
    assert len(world.sent["/odometry"]) == 20  # 2 s at 10 Hz


FOREIGN = (
    b"",
    b"\x00\x01",
    Encoder((), "").encode(0, np.zeros(0)),
    Encoder((), "/foreign").encode(10 * NANOSECONDS, np.zeros(0)),
    Encoder(OUTPUTS, "/foreign").encode(0, np.ones(4)),
    Encoder(INPUTS, "/controller").encode(0, np.ones(4)),
    Encoder(OUTPUTS, "/aircraft").encode(0, np.ones(4)),
    Encoder(POSE, "/aircraft").encode(0, np.ones(len(POSE))),
    Encoder(OUTPUTS, "/reference_model").encode(0, np.ones(4)),
    Encoder(("phi", *OUTPUTS), "/guidance").encode(0, np.ones(5)),
    bytes(20_000),
    instant(1_700_000_000 * NANOSECONDS),
)


@pytest.mark.parametrize(
    "name, topic",
    [
        ("osprey_gust", "/y"),
        ("osprey_gust", "/y_m"),
        ("osprey_gust", "/u"),
        ("osprey_gust", "/clock"),
        ("osprey_route", "/y"),
        ("osprey_route", "/pose"),
        ("osprey_route", "/u_m"),
    ],
)
def test_messages_of_a_foreign_publisher_change_no_bit_of_a_lockstep_flight(
    name: str, topic: str, tmp_path: Path
) -> None:
    scenario = varied(tmp_path, name, flight={"duration": 0.5})
    with lockstep(scenario, tmp_path) as (world, nodes):
        (kind,) = {each.msg_type for each in world.subscriptions if each.topic_name == topic}
        rounds = 0
        while any(node.advance() for node in nodes):
            rounds += 1
            for raw in FOREIGN if rounds > 20 else ():
                # The flight has begun. The foreign publisher has sent few messages, or many.
                world.deliver(topic, kind, raw, 1 if rounds % 2 else 10**6)
        world.sent[topic] = [sent for sent in world.sent[topic] if sent[1] not in FOREIGN]
        require_equal(world, scenario)


def test_flight_that_waits_for_a_refused_sample_ends_with_the_reason(
    osprey_gust: Scenario, tmp_path: Path
) -> None:
    with lockstep(osprey_gust, tmp_path) as (world, nodes):
        # For the first y and the next.
        for sender in ("/controller", "/second"):
            world.publisher(JointState, "/u").publish(
                Encoder(INPUTS, sender).encode(0, np.zeros(4))
            )
        aircraft = nodes[-1]
        advance_ns = world.clock.monotonic_ns()
        while aircraft.advance():
            pass
        assert aircraft.awaited_topic() == "/u"
        reason = "conflicting publisher /second ignored: already receiving from /controller"
        with pytest.raises(
            FlightEnded, match=f"^timed out waiting for /u: a sample was refused: {reason}$"
        ):
            require_input([aircraft], advance_ns, True)
        require_input([aircraft], advance_ns + 1, True)  # one that was refused before is no cause
        with pytest.raises(FlightEnded, match="timed out waiting for /u: no message in 30 s"):
            require_input([aircraft], advance_ns + 1, False)


def test_node_names_and_passes_on_the_role_that_a_peer_reports(
    osprey_gust: Scenario, tmp_path: Path
) -> None:
    """A reference model reports the loss of the controller.

    A report about the node itself, or about no role, has no effect.
    """
    with lockstep(osprey_gust, tmp_path) as (world, nodes):
        aircraft = nodes[-1]
        peer = world.publisher(String, "/alive/reference_model", LIVELINESS)
        for role in ("aircraft", "autopilot"):
            peer.publish(String(data=role))
            aircraft.require_flight()
        peer.publish(String(data="controller"))
        with pytest.raises(FlightEnded, match="lost contact with controller"):
            aircraft.require_flight()
        assert [message.data for message in world.messages("/alive/aircraft")] == ["controller"]
