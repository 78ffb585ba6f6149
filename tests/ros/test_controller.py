# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The controller's node among peers that fail: engagement, stale and bad samples, parameters and transitions in flight."""

import math
import signal
import time
from collections.abc import Iterator

import numpy as np
import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from tests.ros.conftest import Process, Start
from tests.ros.peer import OUTPUTS, Peer, peer

from flight_analysis.closed_loop.scenario import Scenario
from flight_ros.messages import to_message
from rise_di_controller.guard import Mode


@pytest.fixture
def peer_node() -> Iterator[Peer]:
    with peer() as made:
        yield made


def controller(start: Start, scenario: Scenario, *arguments: str) -> Process:
    return start("rise_di_controller.main", "--ros-args", "--params-file", str(scenario.path), *arguments)


def engage(peer_node: Peer, y: float = 0.01) -> None:
    peer_node.until(
        lambda: Mode.ENGAGED in peer_node.modes() and len(peer_node.received["u"]) > 20, each=lambda: peer_node.send(y)
    )


def set_parameters(peer_node: Peer, **values: object) -> tuple[bool, str]:
    kinds = {float: ("double_value", ParameterType.PARAMETER_DOUBLE), str: ("string_value", ParameterType.PARAMETER_STRING)}
    request = SetParametersAtomically.Request()
    for name, value in values.items():
        if isinstance(value, list):
            integers = all(isinstance(item, int) for item in value)
            field, kind = (
                ("integer_array_value", ParameterType.PARAMETER_INTEGER_ARRAY)
                if integers
                else ("double_array_value", ParameterType.PARAMETER_DOUBLE_ARRAY)
            )
        else:
            field, kind = kinds[type(value)]
        request.parameters.append(Parameter(name=name, value=ParameterValue(type=kind, **{field: value})))
    result = peer_node.call(SetParametersAtomically, "controller/set_parameters_atomically", request).result
    return result.successful, result.reason


def test_engages_without_a_jump_from_zero(start: Start, osprey_gust: Scenario, peer_node: Peer) -> None:
    controller(start, osprey_gust)
    engage(peer_node)
    assert (peer_node.u()[0] == 0).all()
    first = peer_node.received["internals"][0]
    assert first.position[first.name.index("e.q")] == 0.01


def test_stale_inputs_are_held_ramped_to_trim_and_engaged_again(start: Start, osprey_gust: Scenario, peer_node: Peer) -> None:
    controller(start, osprey_gust, "-p", "hold:=0.1", "-p", "ramp:=0.2")
    engage(peer_node)
    peer_node.until(lambda: peer_node.modes()[-1] == Mode.TRIM)  # nothing is sent any more
    assert [Mode(mode) for mode in peer_node.modes()] == [Mode.ENGAGED, Mode.HOLD, Mode.RAMP, Mode.TRIM]
    u = peer_node.u()
    assert (u[-1] == 0).all()
    # on the ramp no step is larger than that of a 10 ms tick, twice as much where the machine was late
    biggest = np.abs(u).max(axis=0)
    ramp = np.abs(np.diff(u[-25:], axis=0)).max(axis=0)
    assert (ramp <= biggest * 0.01 / 0.2 * 4).all()
    peer_node.until(lambda: peer_node.modes()[-1] == Mode.ENGAGED, each=lambda: peer_node.send(0.05))
    engaged = next(m for m in reversed(peer_node.received["internals"]) if m.position[m.name.index("dt")] == 0.0)
    assert engaged.position[engaged.name.index("u.elevator")] == 0.0


def test_one_that_was_stopped_says_nothing_of_before_and_engages_from_where_u_was_let_go(
    start: Start, osprey_gust: Scenario, peer_node: Peer
) -> None:
    process = controller(start, osprey_gust, "-p", "hold:=0.1", "-p", "ramp:=0.2")
    engage(peer_node)
    peer_node.until(lambda: np.abs(peer_node.u()[-1]).max() > 1e-3, each=lambda: peer_node.send(0.05))
    process.popen.send_signal(signal.SIGSTOP)
    try:
        again = time.monotonic() + 0.6  # s: beyond its age limit, hold and ramp
        peer_node.until(lambda: time.monotonic() > again, each=lambda: peer_node.send(0.05))
        before = len(peer_node.received["u"])  # what it said last has arrived long since
    finally:
        process.popen.send_signal(signal.SIGCONT)
    peer_node.until(lambda: len(peer_node.received["u"]) > before + 2, each=lambda: peer_node.send(0.05))
    assert (peer_node.u()[before] == 0.0).all()


@pytest.mark.parametrize(
    ("name", "message", "reason"),
    [
        ("not a number", to_message(0, OUTPUTS, np.array([math.nan, 0.0, 0.0, 0.0]), "bad"), "y: finite"),
        ("wrong names", to_message(0, ("q", "V", "p", "x"), np.zeros(4), "bad"), "y: name"),
        ("wrong length", JointState(name=list(OUTPUTS), position=[1.0]), "y: length"),
        ("an old stamp", to_message(1, OUTPUTS, np.full(4, 99.0), "peer"), "y: order"),
        ("a stamp to come", to_message(time.time_ns() + 3600 * 10**9, OUTPUTS, np.full(4, 99.0), "peer"), "y: future"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_bad_sample_is_refused_counted_and_never_used(
    name: str, message: JointState, reason: str, start: Start, osprey_gust: Scenario, peer_node: Peer
) -> None:
    controller(start, osprey_gust)
    engage(peer_node)

    def send_both() -> None:
        peer_node.send(0.01)
        peer_node.publish("y", message)

    def counted() -> bool:
        values = [v for array in peer_node.received["/diagnostics"] for status in array.status for v in status.values]
        return any(value.key == f"refused {reason}" and int(value.value) > 0 for value in values)

    peer_node.until(counted, each=send_both)
    assert peer_node.modes()[-1] == Mode.ENGAGED
    used = [m.position[m.name.index("y.q")] for m in peer_node.received["internals"]]
    assert set(used) == {0.01}


def test_gains_change_in_flight_without_a_jump(start: Start, osprey_gust: Scenario, peer_node: Peer) -> None:
    process = controller(start, osprey_gust, "-p", "sign:=soft")
    engage(peer_node)
    for _ in range(20):  # between y samples u stands still, so a jump at the change would stand out
        peer_node.send(0.011)
    count = len(peer_node.received["u"])
    peer_node.until(lambda: len(peer_node.received["u"]) > count, each=lambda: peer_node.send(0.011))
    accepted = set_parameters(peer_node, k_g=3.0, Lambda=[1, 1, 1, 1], beta=[10.0, 10.0, 10.0, 5.0])
    assert accepted == (True, "")
    process.wait_for("k_g: 1.0 -> 3.0")
    count = len(peer_node.received["u"])
    peer_node.until(lambda: len(peer_node.received["u"]) > count + 5, each=lambda: peer_node.send(0.011))
    # With e = 0.01 the law moves u by K Lambda e dt + beta dt in a tick; the old gains would have jumped by K e.
    u = peer_node.u()
    law = osprey_gust.vary(controller={"k_g": 3.0}).controller.law()
    step = law.input_scale * (law.K * law.Lambda * 0.011 + law.beta) * 0.03 + law.input_scale * law.K * 0.001
    assert (np.abs(np.diff(u, axis=0)) <= step + 1e-9).all()


def test_limits_that_were_not_given_can_be_set_in_flight(start: Start, osprey_gust: Scenario, peer_node: Peer) -> None:
    controller(start, osprey_gust)
    engage(peer_node)
    assert set_parameters(peer_node, upper=[0.001, 0.001, 0.001, 0.001]) == (True, "")
    peer_node.received["u"].clear()
    peer_node.until(lambda: len(peer_node.u()) and (peer_node.u()[-1] == 0.001).all(), each=lambda: peer_node.send(-0.2))
    assert peer_node.u().max() == 0.001
    assert not set_parameters(peer_node, upper=[-1.0, 1.0, 1.0, 1.0])[0]  # trim would be outside


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"k_g": -1.0}, "controller.k_g: found -1.0, expected greater than 0"),
        ({"beta": [1.0, math.nan, 1.0, 1.0]}, "controller.beta[1]: found nan, expected a finite number"),
        ({"beta": [1.0, 2.0]}, "controller.beta: found 2 values, expected 4, one for each of q, p, r, V"),
        ({"k_g": 2.0, "sign": "smooth"}, "controller.sign: found 'smooth', expected"),
        ({"rate": 200.0}, "read-only"),
        ({"D": [-1, 1, 1, 1]}, "read-only"),
        ({"k_gg": 1.0}, "undeclared parameter"),
    ],
)
def test_a_bad_change_is_refused_with_its_reason_and_leaves_all_as_it_was(
    changes: dict[str, object], sentence: str, start: Start, osprey_gust: Scenario, peer_node: Peer
) -> None:
    controller(start, osprey_gust)
    engage(peer_node)
    successful, reason = set_parameters(peer_node, **changes)
    assert not successful
    assert sentence in reason
    request = GetParameters.Request(names=["k_g", "rate"])
    kept = peer_node.call(GetParameters, "controller/get_parameters", request).values
    assert [value.double_value for value in kept] == [1.0, 100.0]
    count = len(peer_node.received["u"])
    peer_node.until(lambda: len(peer_node.received["u"]) > count + 5, each=lambda: peer_node.send(0.01))


def transition(peer_node: Peer, number: int) -> bool:
    request = ChangeState.Request(transition=Transition(id=number))
    return bool(peer_node.call(ChangeState, "controller/change_state", request).success)


def test_waits_to_be_configured_and_activated_when_autostart_is_off(
    start: Start, osprey_gust: Scenario, peer_node: Peer
) -> None:
    process = controller(start, osprey_gust, "-p", "autostart:=false")
    process.wait_for("waiting to be configured")
    assert peer_node.call(GetState, "controller/get_state", GetState.Request()).current_state.label == "unconfigured"
    assert transition(peer_node, Transition.TRANSITION_CONFIGURE)
    assert peer_node.received["u"] == []
    assert transition(peer_node, Transition.TRANSITION_ACTIVATE)
    engage(peer_node)
    assert transition(peer_node, Transition.TRANSITION_DEACTIVATE)
    peer_node.until(lambda: peer_node.modes()[-1] == Mode.INACTIVE, each=lambda: peer_node.send(0.01))


def test_an_invalid_transition_does_not_end_the_node(start: Start, osprey_gust: Scenario, peer_node: Peer) -> None:
    process = controller(start, osprey_gust)
    engage(peer_node)
    client = peer_node.node.create_client(ChangeState, "controller/change_state")
    peer_node.until(client.service_is_ready)
    client.call_async(ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVATE)))
    peer_node.until(lambda: any("request refused" in line for line in process.lines), each=lambda: peer_node.send(0.01))
    count = len(peer_node.received["u"])
    peer_node.until(lambda: len(peer_node.received["u"]) > count + 20, each=lambda: peer_node.send(0.01))


def test_a_peer_of_another_type_or_quality_of_service_is_named(start: Start, osprey_gust: Scenario) -> None:
    with peer(topics=()) as peer_node:
        _check_that_unfitting_peers_are_named(start, osprey_gust, peer_node)


def _check_that_unfitting_peers_are_named(start: Start, osprey_gust: Scenario, peer_node: Peer) -> None:
    process = start("aircraft_sim.main", "--ros-args", "--params-file", str(osprey_gust.path))
    peer_node.node.create_publisher(Float64MultiArray, "u", QoSProfile(depth=1))
    process.wait_for("/u: /peer publishes std_msgs/msg/Float64MultiArray, expected sensor_msgs/msg/JointState")
    recorder = start("flight_recorder.main", "--ros-args", "--params-file", str(osprey_gust.path))
    peer_node.node.create_publisher(JointState, "truth", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    recorder.wait_for("/truth: quality of service of /peer does not fit")


def test_the_rate_is_kept_over_seconds(start: Start, osprey_gust: Scenario, peer_node: Peer) -> None:
    controller(start, osprey_gust)
    engage(peer_node)
    begin, count = time.monotonic(), len(peer_node.received["u"])
    peer_node.until(lambda: time.monotonic() - begin > 3.0, each=lambda: peer_node.send(0.01))
    # absolute deadlines: 100 Hz on the mean; the margin is for what is under way at both ends and a tick that found no new y
    assert 285 <= len(peer_node.received["u"]) - count <= 305
