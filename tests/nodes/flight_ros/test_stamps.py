# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that each input of a node refuses a stamp too far behind or ahead of the clock.

The bound is the age limit of the input.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.conftest import REPOSITORY
from tests.nodes.world import world_of

from aircraft_sim.node import AircraftNode
from autopilot_bridge.node import BridgeNode
from autopilot_bridge.params import load_map
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_bringup.graph import (
    AIRCRAFT,
    CONTROLLER,
    GUIDANCE,
    REFERENCE_MODEL,
    NodeSpec,
    parameter_overrides,
)
from flight_core.channels import POSE
from flight_core.rates import NANOSECONDS, nanoseconds
from flight_guidance.node import GuidanceNode
from flight_guidance.reach import AUTHORITY
from flight_ros.flight_node import FlightNode
from flight_ros.messages import Encoder
from reference_model.node import ReferenceModelNode
from rise_di_controller.node import ControllerNode

SCENARIO = find_scenario("osprey_route")
MAP = REPOSITORY / "examples" / "maps" / "ardupilot_2024.yaml"
NODES: Mapping[NodeSpec, type[FlightNode[Any]]] = {
    CONTROLLER: ControllerNode,
    AIRCRAFT: AircraftNode,
    REFERENCE_MODEL: ReferenceModelNode,
    GUIDANCE: GuidanceNode,
}
NOW_NS = 1000 * NANOSECONDS
CONTROLLER_AGE = SCENARIO.controller.max_age
GUIDANCE_AGE = SCENARIO.guidance.max_age if SCENARIO.guidance else 0.0
DELAY = 0.05  # s, of the sensors of the aircraft
U_M_AGE = SCENARIO.reference_model.live.max_age
U_AGE = SCENARIO.aircraft.max_age + DELAY
LIMITS = {
    "controller": {"y": CONTROLLER_AGE, "y_m": CONTROLLER_AGE},
    "aircraft": {"u": U_AGE},
    "reference_model": {"u_m": U_M_AGE},
    "guidance": dict.fromkeys(("y", "pose", "target", "internals", "authority"), GUIDANCE_AGE),
}
"""Age limits, s, by node and topic."""
# an operator has the system clock; the last `authority` before a step is awaited
LOCKSTEP_UNBOUNDED = {"target", "authority"}
WITHOUT_STAMP = {"clock", "recorded", "route"}  # the flight time, the end of the log, a plan
NAMES = {
    "y": SCENARIO.controller.outputs,
    "y_m": SCENARIO.controller.outputs,
    "u": SCENARIO.controller.inputs,
    "effects": SCENARIO.controller.inputs,
    "u_m": SCENARIO.reference_model.outputs,
    "pose": POSE,
    "target": ("heading",),
    "internals": ("mode",),
    "authority": AUTHORITY,
}


def require_bounds(made: FlightNode[Any], limits: Mapping[str, float]) -> None:
    """Assert that each receiver accepts exactly the stamps within the limit of its topic.

    The limit applies behind and ahead of the clock.
    """
    receivers = {receiver.subscription.topic.name: receiver for receiver in made.receivers}
    for topic, limit in limits.items():
        encoder = Encoder(NAMES[topic], "/publisher")
        for k, offset in enumerate(
            (-10.0, -1.01 * limit, -0.99 * limit, 0.0, 0.99 * limit, 1.01 * limit, 10.0)
        ):
            message = encoder.encode(
                NOW_NS + nanoseconds(offset), np.full(len(NAMES[topic]), 0.01 * k)
            )
            assert receivers[topic].take_message(message, NOW_NS) is (abs(offset) <= limit), (
                topic,
                offset,
            )
        assert made.refusals.counts == {f"{topic}: old": 2, f"{topic}: future": 2}
        made.refusals.counts.clear()


@pytest.mark.parametrize("lockstep", [False, True])
@pytest.mark.parametrize("spec", NODES)
def test_each_input_is_bounded_both_ways(spec: NodeSpec, lockstep: bool, tmp_path: Path) -> None:
    overrides = parameter_overrides(spec, SCENARIO, tmp_path, 0.0, lockstep=lockstep)
    overrides = {**overrides, "sensors.delay": DELAY} if spec is AIRCRAFT else overrides
    learns = {"authority_rate": 10.0} if spec is GUIDANCE else {}
    overrides = {**overrides, **learns}
    parameters = (
        word for name, value in overrides.items() for word in ("-p", f"{name}:={json.dumps(value)}")
    )
    with world_of("--params-file", str(SCENARIO.path), *parameters) as world:
        made = world.make(NODES[spec])
        topics = {subscription.topic.name for subscription in made.polled_subscriptions}
        bounded = topics - WITHOUT_STAMP - (LOCKSTEP_UNBOUNDED if lockstep else set())
        limits = LIMITS[made.get_name()]
        assert bounded <= limits.keys()
        assert lockstep or bounded == limits.keys()  # lockstep has fewer inputs
        require_bounds(made, {topic: limits[topic] for topic in bounded})


def test_u_of_the_bridge_is_bounded_both_ways() -> None:
    """The topics of the autopilot are tested elsewhere.

    The test is in tests/pure/autopilot_bridge/test_bridge.py.
    """
    channel_map = load_map(str(MAP))
    limit = channel_map.silence.max_age + max(row.max_age for row in channel_map.outputs.values())
    with world_of("-p", f"map:={MAP}") as world:
        made = world.make(BridgeNode)
        from_controller = {"u": limit, "effects": limit}
        require_bounds(made, from_controller)
        topics = {subscription.topic.name for subscription in made.polled_subscriptions}
        assert topics - from_controller.keys() <= channel_map.topics.keys()
