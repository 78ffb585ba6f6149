# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The controller's node among peers that fail: engagement, stale and bad samples, parameters and transitions in flight."""

import math
import os
import signal
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

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
from flight_core.rates import NANOSECONDS, nanoseconds
from flight_core.vectors import FloatArray
from flight_ros.messages import to_message
from flight_ros.topics import RECORD
from rise_di_controller.guard import Mode

Instants = np.ndarray[Any, np.dtype[np.int64]]

PERIOD_NS = NANOSECONDS // 100  # of the ticks, as in the default scenario
MAX_AGE_NS = NANOSECONDS // 10  # of y and y_m, as in the default scenario
PATIENT = ("-p", "max_age:=2.0")  # where nothing is to grow stale, on a busy machine either

STOPS = 4  # each moves what would drift by up to a period

CHANGED: dict[str, Any] = {"k_g": 3.0, "Lambda": [1, 1, 1, 1], "beta": [10.0, 10.0, 10.0, 5.0]}

KERNEL_TICK_NS = NANOSECONDS // os.sysconf("SC_CLK_TCK")

EXACT = 1e-12  # of what is multiplied once


@pytest.fixture
def peer_node() -> Iterator[Peer]:
    """Receives all from the first sample on, as a recorder does, also where it is matched late or held back."""
    with peer(qos=RECORD) as made:
        yield made


class Ticks(NamedTuple):
    """What the ticks say of themselves in `internals`, N of them; instants in ns of the system clock."""

    number: Instants  # (N,) of the sample
    mode: Instants  # (N,)
    stamp: Instants  # (N,) of the y used; of the tick where none is
    at: Instants  # (N,) the tick's own instant
    late: Instants  # (N,) how long after its deadline that is
    dt: FloatArray  # (N,) s, given to the law
    offset: FloatArray  # (N,) s, of the newest y_m from the y used
    u: FloatArray  # (N, m)


def ticks(peer_node: Peer) -> Ticks:
    """All that were heard. None may be lost: the numbers count up by one."""
    heard = peer_node.received["internals"]
    names = heard[0].name
    values = np.array([message.position for message in heard])
    stamp = np.array([stamp_ns(message) for message in heard])
    at = stamp + np.array([nanoseconds(age) for age in values[:, names.index("age")]])
    late = np.array([nanoseconds(late) for late in values[:, names.index("late")]])
    number, mode = (values[:, names.index(name)].astype(np.int64) for name in ("number", "mode"))
    dt, offset = (values[:, names.index(name)] for name in ("dt", "y_m_offset"))
    u = values[:, [k for k, name in enumerate(names) if name.startswith("u.")]]
    assert number.tolist() == list(range(1, len(number) + 1))
    return Ticks(number, mode, stamp, at, late, dt, offset, u)


def channel(message: JointState, name: str) -> float:
    return float(message.position[message.name.index(name)])


def stamp_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * NANOSECONDS + int(message.header.stamp.nanosec)


class HeldBack:
    """How long the machine has held up the ticks of a process: their thread was ready, and had to wait for a processor."""

    def __init__(self, process: Process) -> None:
        self._process = process
        self._before_ns = self._counted_ns()

    def _counted_ns(self) -> int:
        """Waited for those of Linux, and these for those of a virtual machine's host.

        Source: proc_pid_schedstat(5), second figure; proc_stat(5), eighth figure.
        """
        waited = int(Path(f"/proc/{self._process.popen.pid}/schedstat").read_text(encoding="ascii").split()[1])
        return waited + int(Path("/proc/stat").read_text(encoding="ascii").split()[8]) * KERNEL_TICK_NS

    def most_ns(self) -> int:
        """Since this was made; the host's share is counted in whole ticks of the kernel, so one more may have begun."""
        return self._counted_ns() - self._before_ns + KERNEL_TICK_NS


def controller(start: Start, scenario: Scenario, *arguments: str) -> Process:
    return start("rise_di_controller.main", "--ros-args", "--params-file", str(scenario.path), *arguments)


def engage(peer_node: Peer, y: float = 0.01) -> None:
    peer_node.until(
        lambda: Mode.ENGAGED in peer_node.modes() and len(peer_node.received["u"]) > 20, each=lambda: peer_node.send(y)
    )


def set_parameters(peer_node: Peer, each: Callable[[], None] | None = None, **values: object) -> tuple[bool, str]:
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
    result = peer_node.call(SetParametersAtomically, "controller/set_parameters_atomically", request, each).result
    return result.successful, result.reason


def test_engages_without_a_jump_from_zero(start: Start, osprey_gust: Scenario, peer_node: Peer) -> None:
    controller(start, osprey_gust)
    engage(peer_node)
    assert (peer_node.u()[0] == 0).all()
    first = peer_node.received["internals"][0]
    assert first.position[first.name.index("e.q")] == 0.01


def test_stale_inputs_are_held_ramped_to_trim_and_engaged_again(start: Start, osprey_gust: Scenario, peer_node: Peer) -> None:
    """Judged at each tick's own instant, so that ticks may come late or be missed, but not do another thing."""
    hold_ns, ramp_ns, y = NANOSECONDS // 10, NANOSECONDS, 0.05
    process = controller(start, osprey_gust, "-p", "hold:=0.1", "-p", "ramp:=1.0")
    engage(peer_node)
    held_back = HeldBack(process)
    peer_node.until(lambda: peer_node.modes()[-1] == Mode.HOLD)  # nothing is sent any more
    held_back_ns = held_back.most_ns()
    peer_node.until(lambda: peer_node.modes()[-1] == Mode.TRIM)
    silent = len(ticks(peer_node).number)
    heard = peer_node.received["internals"]
    peer_node.until(lambda: sum(channel(one, "dt") > 0.0 for one in heard[silent:]) >= 3, each=lambda: peer_node.send(y))
    flown = ticks(peer_node)

    # lost with the first tick at which the last y or y_m is too old
    lost = int(np.flatnonzero(flown.mode[:silent] == Mode.ENGAGED)[-1]) + 1
    oldest = flown.stamp[lost - 1] + min(nanoseconds(flown.offset[lost - 1]), 0)
    assert flown.at[lost] - oldest > MAX_AGE_NS
    assert flown.at[lost] - flown.late[lost] - oldest <= MAX_AGE_NS + PERIOD_NS + held_back_ns

    # then held, and on a straight line to trim: mode and u are those of the instant
    alone = slice(lost, silent)
    at, mode, u, u_lost = flown.at[alone], flown.mode[alone], flown.u[alone], flown.u[lost - 1]
    assert (np.diff(at) >= 0).all()
    share = np.clip(1.0 - (at - at[0] - hold_ns) / ramp_ns, 0.0, 1.0)
    expected = np.select([share == 1.0, share > 0.0], [Mode.HOLD, Mode.RAMP], Mode.TRIM)
    assert mode.tolist() == expected.tolist()
    assert set(mode) == {Mode.HOLD, Mode.RAMP, Mode.TRIM}
    assert np.abs(u_lost).min() > 0.0
    assert np.abs(u - np.outer(share, u_lost)).max() <= EXACT
    assert (u[share == 1.0] == u_lost).all()
    assert (u[share == 0.0] == 0.0).all()

    # what is published is what is logged
    logged = dict(zip(at.tolist(), u.tolist(), strict=True))
    published = [message for message in peer_node.received["u"] if stamp_ns(message) in logged]
    assert len(published) > len(logged) / 2  # a tick that is held up for too long does not publish
    assert all(message.position.tolist() == logged[stamp_ns(message)] for message in published)

    # engaged from where u was, and from there on with no more than the steps of the law, e being constant
    law = osprey_gust.controller.law()
    again = silent + int(np.flatnonzero(flown.mode[silent:] == Mode.ENGAGED)[0])
    assert flown.dt[again] == 0.0
    assert (flown.u[again] == flown.u[again - 1]).all()
    flies = again + np.flatnonzero(flown.dt[again:] > 0.0)
    moved, dt = np.abs(flown.u[flies] - flown.u[flies - 1]), flown.dt[flies]
    assert (moved > 0.0).all()
    assert (moved <= np.outer(dt, law.input_scale * (law.K * law.Lambda * y + law.beta)) + EXACT).all()


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
    controller(start, osprey_gust, *PATIENT)
    engage(peer_node)

    def send_both() -> None:
        peer_node.send(0.01)
        peer_node.publish("y", message)

    def counted() -> bool:
        values = [v for array in peer_node.received["/diagnostics"] for status in array.status for v in status.values]
        return any(value.key == f"refused {reason}" and int(value.value) > 0 for value in values)

    peer_node.until(counted, each=send_both)
    assert peer_node.modes() == [Mode.ENGAGED]
    used = [m.position[m.name.index("y.q")] for m in peer_node.received["internals"]]
    assert set(used) == {0.01}


def test_gains_change_in_flight_without_a_jump(start: Start, osprey_gust: Scenario, peer_node: Peer) -> None:
    process = controller(start, osprey_gust, "-p", "sign:=soft", *PATIENT)
    engage(peer_node, 0.0)
    y, heard = 0.2, peer_node.received["internals"]

    def send() -> None:
        peer_node.send(y)

    peer_node.until(lambda: channel(heard[-1], "y.q") == y, each=send)
    since = len(heard) - 1
    accepted = set_parameters(peer_node, send, **CHANGED)
    assert accepted == (True, "")
    process.wait_for("k_g: 1.0 -> 3.0")
    count = len(heard)
    peer_node.until(lambda: len(heard) > count + 5, each=send)
    # With e = y the law moves u by K Lambda e dt + beta dt in a tick; the new gains alone would have moved it by more than 2 e.
    flown = ticks(peer_node)
    assert len({channel(one, "parameters") for one in heard[since:]}) == 2  # those before and after
    laws = [one.controller.law() for one in (osprey_gust, osprey_gust.vary(controller=CHANGED))]
    rate = np.max([law.input_scale * (law.K * law.Lambda * y + law.beta) for law in laws], axis=0)
    moved = np.abs(np.diff(flown.u[since:], axis=0))
    assert (moved <= np.outer(flown.dt[since + 1 :], rate) + EXACT).all()


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
    changes: dict[str, Any], sentence: str, start: Start, osprey_gust: Scenario, peer_node: Peer
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
    peer_node.until(lambda: any("request rejected" in line for line in process.lines), each=lambda: peer_node.send(0.01))
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
    recorder.wait_for("/truth: /peer publishes with incompatible quality of service")


def test_the_rate_is_kept_over_seconds(start: Start, osprey_gust: Scenario, peer_node: Peer) -> None:
    """Deadlines are absolute: a tick that was held up comes late, or is skipped and counted; none after it is moved."""
    process = controller(start, osprey_gust, "-p", "max_age:=1.0")
    engage(peer_node)
    held_back, begin_ns, stopped_ns = HeldBack(process), time.time_ns(), 0
    peer_node.until(lambda: time.time_ns() - begin_ns > NANOSECONDS, each=lambda: peer_node.send(0.01))
    peer_node.until(lambda: peer_node.modes()[-1] == Mode.HOLD)  # nothing is sent any more: from here on each tick publishes
    silent_ns = stamp_ns(peer_node.received["internals"][-1])
    peer_node.until(lambda: len(missed(peer_node, silent_ns)) >= 1)
    for _ in range(STOPS):
        stopped_ns += stop_for(process, peer_node, 5 * PERIOD_NS)
        count = len(peer_node.received["internals"])
        peer_node.until(lambda: len(peer_node.received["internals"]) > count + 1)  # noqa: B023
    counted_ns = max(missed(peer_node, silent_ns))
    peer_node.until(lambda: max(missed(peer_node, silent_ns)) > counted_ns)
    counted = missed(peer_node, silent_ns)
    peer_node.until(lambda: stamp_ns(peer_node.received["internals"][-1]) > max(counted))
    again_ns = time.time_ns()
    peer_node.until(lambda: time.time_ns() - again_ns > NANOSECONDS, each=lambda: peer_node.send(0.01))
    held_back_ns = held_back.most_ns() + stopped_ns

    flown = ticks(peer_node)
    assert ((flown.late >= 0) & (flown.late < PERIOD_NS)).all()
    steps, rest = np.divmod(np.diff(flown.at - flown.late), PERIOD_NS)
    assert (rest == 0).all()
    assert (steps > 0).all()
    # what is skipped, where each tick publishes, is what is counted
    for (earlier_ns, before), (later_ns, after) in pairwise(counted.items()):
        skipped = (steps - 1)[(flown.at[1:] > earlier_ns) & (flown.at[1:] <= later_ns)]
        assert skipped.sum() == after - before
    total = list(counted.values())
    assert total[-1] - total[0] >= 4 * STOPS
    # no more is missed than the machine made it miss
    total = list(missed(peer_node, begin_ns).values())
    assert (total[-1] - total[0]) * PERIOD_NS <= held_back_ns
    # After all that the ticks still have the clock of the sender: most y are flown after they were sent, some soon after. One
    # that comes while its tick is held up is flown by a tick that was due before.
    age = (flown.at - flown.stamp)[(flown.mode == Mode.ENGAGED) & (flown.stamp > again_ns)]
    assert len(age) > 0
    assert np.median(age) >= 0
    assert age.min() < PERIOD_NS


def stop_for(process: Process, peer_node: Peer, pause_ns: int) -> int:
    """SIGSTOP, then SIGCONT; how long it was at most, ns."""
    begin_ns = time.monotonic_ns()
    process.popen.send_signal(signal.SIGSTOP)
    try:
        stopped_ns = time.monotonic_ns()
        peer_node.until(lambda: time.monotonic_ns() - stopped_ns > pause_ns)
    finally:
        process.popen.send_signal(signal.SIGCONT)
    return time.monotonic_ns() - begin_ns


def missed(peer_node: Peer, since_ns: int) -> dict[int, int]:
    """How many ticks the diagnostics count as missed, by the instant of the report, ns."""
    heard = [message for message in peer_node.received["/diagnostics"] if stamp_ns(message) > since_ns]
    return {
        stamp_ns(message): int(next(value.value for value in message.status[0].values if value.key == "missed ticks"))
        for message in heard
    }
