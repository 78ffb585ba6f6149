# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The controller's node: bumpless engagement, failsafe for stale inputs, malformed samples, parameters, lifecycle, overruns."""

import math
import os
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, Header
from tests.ros.conftest import Process, Start
from tests.ros.peer import OUTPUTS, Peer, peer, stamp_ns
from tests.ros.waiting import HostDelays

from flight_analysis.closed_loop.scenario import Scenario
from flight_core.modes import Mode
from flight_core.rates import NANOSECONDS, nanoseconds
from flight_core.vectors import FloatArray
from flight_ros.messages import to_message
from flight_ros.topics import RECORD

pytestmark = pytest.mark.package("rise_di_controller")

Instants = np.ndarray[Any, np.dtype[np.int64]]

PERIOD_NS = NANOSECONDS // 100  # of the ticks, as in the default scenario
MAX_AGE_NS = NANOSECONDS // 10  # of y and y_m, as in the default scenario
LONG_MAX_AGE = ("-p", "max_age:=2.0")  # no input times out, also on a busy host
STOPS = 4  # each would shift a schedule that drifts by up to a period
CHANGED: dict[str, Any] = {"k_g": 3.0, "Lambda": [1, 1, 1, 1], "beta": [10.0, 10.0, 10.0, 5.0]}
KERNEL_TICK_NS = NANOSECONDS // os.sysconf("SC_CLK_TCK")
EXACT = 1e-12  # of values that are multiplied once


@pytest.fixture
def peer_node() -> Iterator[Peer]:
    """Receives all samples from the first one on, like a recorder, even if it is matched late or delayed by the host."""
    with peer(qos=RECORD) as made:
        yield made


class Ticks(NamedTuple):
    """N ticks of the controller, from `internals`; instants in ns of the system clock."""

    number: Instants  # (N,) counts up from 1
    mode: Instants  # (N,)
    stamp: Instants  # (N,) of the y used; of the tick where it used none
    at: Instants  # (N,) when the tick began
    late: Instants  # (N,) from the deadline of the tick to its begin
    dt: FloatArray  # (N,) s, given to the law
    offset: FloatArray  # (N,) s, from the stamp of the y used to that of the newest y_m
    u: FloatArray  # (N, m)


def ticks(peer_node: Peer) -> Ticks:
    """All ticks so far. None may be lost: the numbers count up by one."""
    messages = peer_node.received["internals"]
    names = messages[0].name
    values = np.array([message.position for message in messages])
    stamp = np.array([stamp_ns(message) for message in messages])
    number, mode = (values[:, names.index(name)].astype(np.int64) for name in ("number", "mode"))
    age, late = (np.array([nanoseconds(value) for value in values[:, names.index(name)]]) for name in ("age", "late"))
    dt, offset = (values[:, names.index(name)] for name in ("dt", "y_m_offset"))
    u = values[:, [k for k, name in enumerate(names) if name.startswith("u.")]]
    assert number.tolist() == list(range(1, len(number) + 1))
    return Ticks(number, mode, stamp, stamp + age, late, dt, offset, u)


def channel(message: JointState, name: str) -> float:
    return float(message.position[message.name.index(name)])


class HostDelay:
    """Host scheduling delay of a process since this was made: its thread was ready, and waited for a processor."""

    def __init__(self, process: Process, host_delays: HostDelays) -> None:
        self._process, self._host_delays, self._begin = process, host_delays, time.time()
        self._before_ns = self._counted_ns()

    def _counted_ns(self) -> int:
        """Scheduling delay that Linux counts, and steal time that the host of a virtual machine reports.

        Source: proc_pid_schedstat(5), second figure; proc_stat(5), eighth figure.
        """
        waited = int(Path(f"/proc/{self._process.popen.pid}/schedstat").read_text(encoding="ascii").split()[1])
        return waited + int(Path("/proc/stat").read_text(encoding="ascii").split()[8]) * KERNEL_TICK_NS

    def limit_ns(self) -> int:
        """Upper limit of the delay. Steal time is counted in whole ticks of the kernel, so one more may have begun.

        A host that pauses all processes need not count it.
        """
        paused_ns = nanoseconds(self._host_delays.since(self._begin))
        return self._counted_ns() - self._before_ns + KERNEL_TICK_NS + paused_ns


def engage(peer_node: Peer, y: float = 0.01) -> None:
    peer_node.until(
        lambda: Mode.ENGAGED in peer_node.modes() and len(peer_node.received["u"]) > 20, each=lambda: peer_node.send(y)
    )


def set_parameters(peer_node: Peer, each: Callable[[], None] | None = None, **values: object) -> tuple[bool, str]:
    request = SetParametersAtomically.Request()
    request.parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    result = peer_node.call(SetParametersAtomically, "controller/set_parameters_atomically", request, each).result
    return result.successful, result.reason


def wait_for_messages(peer_node: Peer, topic: str, count: int, each: Callable[[], None] | None = None) -> None:
    """Wait for more than `count` new messages of a topic."""
    before = len(peer_node.received[topic])
    peer_node.until(lambda: len(peer_node.received[topic]) > before + count, each=each)


def test_engages_bumpless_from_zero(start_node: Start, peer_node: Peer) -> None:
    start_node("rise_di_controller")
    engage(peer_node)
    assert (peer_node.u()[0] == 0).all()
    assert channel(peer_node.received["internals"][0], "e.q") == 0.01


def test_failsafe_holds_u_ramps_to_trim_re_engages_bumpless(
    start_node: Start, osprey_gust: Scenario, peer_node: Peer, host_delays: HostDelays
) -> None:
    """Mode and u are checked at the instant of each tick. Ticks may overrun or be missed, with no other effect on u."""
    hold_ns, ramp_ns, y = NANOSECONDS // 10, nanoseconds(1.5), 0.05  # longer than a pause of the host
    process = start_node("rise_di_controller", "-p", "hold:=0.1", "-p", "ramp:=1.5")
    engage(peer_node)
    host_delay = HostDelay(process, host_delays)
    peer_node.until(lambda: peer_node.modes()[-1] == Mode.HOLD)  # y and y_m have stopped
    host_delay_ns = host_delay.limit_ns()
    peer_node.until(lambda: peer_node.modes()[-1] == Mode.TRIM)
    resumed = len(ticks(peer_node).number)
    messages = peer_node.received["internals"]
    peer_node.until(
        lambda: sum(channel(message, "dt") > 0.0 for message in messages[resumed:]) >= 3, each=lambda: peer_node.send(y)
    )
    log = ticks(peer_node)

    # the failsafe begins with the first tick at which the last y or y_m is stale
    begin = int(np.flatnonzero(log.mode[:resumed] == Mode.ENGAGED)[-1]) + 1
    oldest = log.stamp[begin - 1] + min(nanoseconds(log.offset[begin - 1]), 0)
    assert log.at[begin] - oldest > MAX_AGE_NS
    assert log.at[begin] - log.late[begin] - oldest <= MAX_AGE_NS + PERIOD_NS + host_delay_ns

    # u is held, then ramped to trim: mode and u are functions of the time since the failsafe began
    failsafe = slice(begin, resumed)
    at, mode, u, u_held = log.at[failsafe], log.mode[failsafe], log.u[failsafe], log.u[begin - 1]
    assert (np.diff(at) >= 0).all()
    scale = np.clip(1.0 - (at - at[0] - hold_ns) / ramp_ns, 0.0, 1.0)
    expected = np.select([scale == 1.0, scale > 0.0], [Mode.HOLD, Mode.RAMP], Mode.TRIM)
    assert mode.tolist() == expected.tolist()
    assert set(mode) == {Mode.HOLD, Mode.RAMP, Mode.TRIM}
    assert np.abs(u_held).min() > 0.0
    assert np.abs(u - np.outer(scale, u_held)).max() <= EXACT
    assert (u[scale == 1.0] == u_held).all()
    assert (u[scale == 0.0] == 0.0).all()

    # the published u is that of the log
    logged = dict(zip(at.tolist(), u.tolist(), strict=True))
    published = [message for message in peer_node.received["u"] if stamp_ns(message) in logged]
    assert len(published) > len(logged) / 2  # a tick that overruns by too much does not publish
    assert all(message.position.tolist() == logged[stamp_ns(message)] for message in published)

    # bumpless transfer: re-engaged at the present u, then steps no larger than those of the law at a constant e
    law = osprey_gust.controller.law_params()
    again = resumed + int(np.flatnonzero(log.mode[resumed:] == Mode.ENGAGED)[0])
    assert log.dt[again] == 0.0
    assert (log.u[again] == log.u[again - 1]).all()
    steps = again + np.flatnonzero(log.dt[again:] > 0.0)
    moved, dt = np.abs(log.u[steps] - log.u[steps - 1]), log.dt[steps]
    assert (moved > 0.0).all()
    assert (moved <= np.outer(dt, law.input_scale * (law.K * law.Lambda * y + law.beta)) + EXACT).all()


def test_stopped_controller_publishes_no_stale_u_and_re_engages_from_trim(start_node: Start, peer_node: Peer) -> None:
    process = start_node("rise_di_controller", "-p", "hold:=0.1", "-p", "ramp:=0.2")
    engage(peer_node)
    peer_node.until(lambda: np.abs(peer_node.u()[-1]).max() > 1e-3, each=lambda: peer_node.send(0.05))
    with process.stopped():
        peer_node.spin(0.6, each=lambda: peer_node.send(0.05))  # 0.6 s is beyond its age limit, hold and ramp
        before = len(peer_node.received["u"])  # all that was published before the stop has arrived
    peer_node.until(lambda: len(peer_node.received["u"]) > before + 2, each=lambda: peer_node.send(0.05))
    assert (peer_node.u()[before] == 0.0).all()


def test_overrun_of_controller_does_not_free_publisher_lock(start_node: Start, peer_node: Peer) -> None:
    process = start_node("rise_di_controller", "-p", "hold:=0.1", "-p", "ramp:=0.2")
    engage(peer_node)

    def conflict() -> None:
        peer_node.publish("y", to_message(time.time_ns(), OUTPUTS, np.ones(4), "/foreign"))

    def send_both() -> None:
        peer_node.send(0.01)  # first: after a pause of the host beyond age limit, hold and ramp any publisher may take over
        conflict()

    peer_node.spin(0.05)  # the controller takes all samples
    with process.stopped():
        peer_node.spin(0.6)  # beyond age limit, hold and ramp
        conflict()  # the first sample that the controller takes
    peer_node.until(lambda: peer_node.counted("refused y: sender"), each=send_both)
    assert {channel(message, "y.q") for message in peer_node.received["internals"]} == {0.01}


def test_another_publisher_takes_over_once_u_is_at_trim(start_node: Start, peer_node: Peer) -> None:
    hold, ramp = 0.2, 0.3
    start_node("rise_di_controller", "-p", f"hold:={hold}", "-p", f"ramp:={ramp}")
    engage(peer_node)
    last_ns = time.time_ns()
    peer_node.send()

    def send() -> None:
        for topic in ("y_m", "y"):
            peer_node.publish(topic, to_message(time.time_ns(), OUTPUTS, np.full(4, 0.5), "/another"))

    def taken() -> list[int]:
        return [stamp_ns(message) for message in peer_node.received["internals"] if channel(message, "y.q") == 0.5]

    peer_node.until(taken, each=send)
    assert taken()[0] - last_ns > MAX_AGE_NS + nanoseconds(hold + ramp) - PERIOD_NS  # y may be a period old


@pytest.mark.parametrize(
    ("name", "message", "reason"),
    [
        ("not a number", to_message(0, OUTPUTS, np.array([math.nan, 0.0, 0.0, 0.0]), "peer"), "y: finite"),
        ("wrong names", to_message(0, ("q", "V", "p", "x"), np.zeros(4), "peer"), "y: name"),
        ("wrong length", JointState(header=Header(frame_id="peer"), name=list(OUTPUTS), position=[1.0]), "y: length"),
        ("old stamp", to_message(1, OUTPUTS, np.full(4, 99.0), "peer"), "y: old"),
        ("future stamp", to_message(time.time_ns() + 3600 * 10**9, OUTPUTS, np.full(4, 99.0), "peer"), "y: future"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_malformed_sample_refused_counted_and_never_used(
    name: str, message: JointState, reason: str, start_node: Start, peer_node: Peer
) -> None:
    start_node("rise_di_controller", *LONG_MAX_AGE)
    engage(peer_node)

    def send_both() -> None:
        peer_node.send(0.01)
        peer_node.publish("y", message)

    peer_node.until(lambda: peer_node.counted(f"refused {reason}"), each=send_both)
    assert peer_node.modes() == [Mode.ENGAGED]
    assert {channel(message, "y.q") for message in peer_node.received["internals"]} == {0.01}


def test_gains_change_in_flight_bumpless(start_node: Start, osprey_gust: Scenario, peer_node: Peer) -> None:
    process = start_node("rise_di_controller", "-p", "sign:=soft", *LONG_MAX_AGE)
    engage(peer_node, 0.0)
    y, messages = 0.2, peer_node.received["internals"]

    def send() -> None:
        peer_node.send(y)

    peer_node.until(lambda: channel(messages[-1], "y.q") == y, each=send)
    since = len(messages) - 1
    assert set_parameters(peer_node, send, **CHANGED) == (True, "")
    process.wait_for("k_g: 1.0 -> 3.0")
    wait_for_messages(peer_node, "internals", 5, each=send)
    # With e = y the law moves u by K Lambda e dt + beta dt in a tick; the new gains alone would have moved it by more than 2 e.
    log = ticks(peer_node)
    assert len({channel(message, "parameters") for message in messages[since:]}) == 2  # those before and after
    laws = [scenario.controller.law_params() for scenario in (osprey_gust, osprey_gust.vary(controller=CHANGED))]
    rate = np.max([law.input_scale * (law.K * law.Lambda * y + law.beta) for law in laws], axis=0)
    moved = np.abs(np.diff(log.u[since:], axis=0))
    assert (moved <= np.outer(log.dt[since + 1 :], rate) + EXACT).all()


def test_saturation_limits_can_be_added_in_flight(start_node: Start, peer_node: Peer) -> None:
    start_node("rise_di_controller")
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
def test_invalid_change_rejected_with_reason_and_has_no_effect(
    changes: dict[str, Any], sentence: str, start_node: Start, peer_node: Peer
) -> None:
    start_node("rise_di_controller")
    engage(peer_node)
    successful, reason = set_parameters(peer_node, **changes)
    assert not successful
    assert sentence in reason
    request = GetParameters.Request(names=["k_g", "rate"])
    unchanged = peer_node.call(GetParameters, "controller/get_parameters", request).values
    assert [value.double_value for value in unchanged] == [1.0, 100.0]
    wait_for_messages(peer_node, "u", 5, each=lambda: peer_node.send(0.01))


def test_parameters_of_several_nodes_set_none(start_node: Start, peer_node: Peer) -> None:
    """`ros2 param load` joins the sections of a file: max_age may then be that of the aircraft."""
    start_node("rise_di_controller").wait_for("ready")
    request = SetParameters.Request()
    request.parameters = [
        Parameter(name, value=value).to_parameter_msg() for name, value in (("max_age", 0.7), ("step", 0.002))
    ]
    results = peer_node.call(SetParameters, "controller/set_parameters", request).results
    assert [result.successful for result in results] == [False, False]
    assert results[0].reason == "found step, expected parameters of /controller alone; nothing is set"
    request = GetParameters.Request(names=["max_age"])
    assert peer_node.call(GetParameters, "controller/get_parameters", request).values[0].double_value == 0.1


def test_waits_for_configure_and_activate_without_autostart(start_node: Start, peer_node: Peer) -> None:
    start_node("rise_di_controller", "-p", "autostart:=false").wait_for("waiting to be configured")
    assert peer_node.call(GetState, "controller/get_state", GetState.Request()).current_state.label == "unconfigured"
    assert peer_node.transition(Transition.TRANSITION_CONFIGURE)
    assert peer_node.received["u"] == []
    assert peer_node.transition(Transition.TRANSITION_ACTIVATE)
    engage(peer_node)
    assert peer_node.transition(Transition.TRANSITION_DEACTIVATE)
    peer_node.until(lambda: peer_node.modes()[-1] == Mode.INACTIVE, each=lambda: peer_node.send(0.01))


def test_deactivated_controller_publishes_trim_but_standby_that_was_never_activated_nothing(
    start_node: Start, peer_node: Peer
) -> None:
    """A bridge engages with a fresh u. Beside another controller the u of a standby would be a conflict."""
    start_node("rise_di_controller", "-p", "autostart:=false").wait_for("waiting to be configured")
    assert peer_node.transition(Transition.TRANSITION_CONFIGURE)
    peer_node.spin(0.3, each=lambda: peer_node.send(0.01))
    assert peer_node.received["u"] == []
    peer_node.spin(0.5)  # longer than max_age: y is stale, so the law does not engage
    assert peer_node.transition(Transition.TRANSITION_ACTIVATE)
    assert peer_node.transition(Transition.TRANSITION_DEACTIVATE)
    wait_for_messages(peer_node, "u", 5, each=lambda: peer_node.send(0.01))
    assert not any(any(u.position) for u in peer_node.received["u"])
    assert peer_node.received["internals"] == []


def test_controller_that_starts_inactive_publishes_trim_until_activated(start_node: Start, peer_node: Peer) -> None:
    start_node("rise_di_controller", "-p", "start_active:=false")
    peer_node.until(lambda: len(peer_node.received["u"]) > 20, each=lambda: peer_node.send(0.01))
    assert peer_node.call(GetState, "controller/get_state", GetState.Request()).current_state.label == "inactive"
    assert not any(any(u.position) for u in peer_node.received["u"])
    assert peer_node.received["internals"] == []
    assert peer_node.transition(Transition.TRANSITION_ACTIVATE)
    engage(peer_node)


def test_invalid_transition_refused_and_node_goes_on(start_node: Start, peer_node: Peer) -> None:
    process = start_node("rise_di_controller")
    engage(peer_node)
    client = peer_node.node.create_client(ChangeState, "controller/change_state")
    peer_node.until(client.service_is_ready)
    answer = client.call_async(ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVATE)))
    peer_node.until(answer.done, each=lambda: peer_node.send(0.01))
    assert not answer.result().success
    process.wait_for("request rejected: ")
    wait_for_messages(peer_node, "u", 20, each=lambda: peer_node.send(0.01))


def test_incompatible_type_and_quality_of_service_reported_with_peer(start_node: Start) -> None:
    with peer(topics=()) as peer_node:
        process = start_node("aircraft_sim")
        peer_node.node.create_publisher(Float64MultiArray, "u", QoSProfile(depth=1))
        process.wait_for("/u: /peer publishes std_msgs/msg/Float64MultiArray, expected sensor_msgs/msg/JointState")
        recorder = start_node("flight_recorder")
        peer_node.node.create_publisher(JointState, "truth", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
        recorder.wait_for("/truth: /peer publishes with incompatible quality of service")


def test_tick_rate_is_kept_over_overruns(start_node: Start, peer_node: Peer, host_delays: HostDelays) -> None:
    """Deadlines are absolute: after an overrun a tick is late, or skipped and counted. The deadlines after it do not move."""
    process = start_node("rise_di_controller", "-p", "max_age:=1.0")
    engage(peer_node)
    host_delay, begin_ns, stopped_ns = HostDelay(process, host_delays), time.time_ns(), 0
    peer_node.spin(1.0, each=lambda: peer_node.send(0.01))
    peer_node.until(lambda: peer_node.modes()[-1] == Mode.HOLD)  # y and y_m have stopped: each tick now publishes internals
    timeout_ns = stamp_ns(peer_node.received["internals"][-1])
    peer_node.until(lambda: len(missed(peer_node, timeout_ns)) >= 1)
    for _ in range(STOPS):
        stopped_ns += stop_for(process, peer_node, 5 * PERIOD_NS)
        wait_for_messages(peer_node, "internals", 1)
    counted_ns = max(missed(peer_node, timeout_ns))
    peer_node.until(lambda: max(missed(peer_node, timeout_ns)) > counted_ns)
    counted = missed(peer_node, timeout_ns)
    peer_node.until(lambda: stamp_ns(peer_node.received["internals"][-1]) > max(counted))
    again_ns = time.time_ns()
    peer_node.spin(1.0, each=lambda: peer_node.send(0.01))
    host_delay_ns = host_delay.limit_ns() + stopped_ns

    log = ticks(peer_node)
    assert ((log.late >= 0) & (log.late < PERIOD_NS)).all()
    steps, rest = np.divmod(np.diff(log.at - log.late), PERIOD_NS)
    assert (rest == 0).all()
    assert (steps > 0).all()
    # the skipped ticks are those that the diagnostics count
    for (earlier_ns, before), (later_ns, after) in pairwise(counted.items()):
        skipped = (steps - 1)[(log.at[1:] > earlier_ns) & (log.at[1:] <= later_ns)]
        assert skipped.sum() == after - before
    total = list(counted.values())
    assert total[-1] - total[0] >= 4 * STOPS
    # no more ticks are missed than the host scheduling delay and the stops explain
    total = list(missed(peer_node, begin_ns).values())
    assert (total[-1] - total[0]) * PERIOD_NS <= host_delay_ns
    # The ticks still have the clock of the publisher: most y are used after they were sent, some soon after. A y that
    # arrives during an overrun is used by a tick whose deadline was before it.
    age = (log.at - log.stamp)[(log.mode == Mode.ENGAGED) & (log.stamp > again_ns)]
    assert len(age) > 0
    assert np.median(age) >= 0
    assert age.min() < PERIOD_NS


def stop_for(process: Process, peer_node: Peer, pause_ns: int) -> int:
    """SIGSTOP, then SIGCONT; upper limit of the duration, ns."""
    begin_ns = time.monotonic_ns()
    with process.stopped():
        peer_node.spin(pause_ns / NANOSECONDS)
    return time.monotonic_ns() - begin_ns


def missed(peer_node: Peer, since_ns: int) -> dict[int, int]:
    """The missed ticks that the diagnostics count, by the instant of the report, ns."""
    return {
        stamp_ns(message): int(next(value.value for value in message.status[0].values if value.key == "missed ticks"))
        for message in peer_node.received["/diagnostics"]
        if stamp_ns(message) > since_ns
    }
