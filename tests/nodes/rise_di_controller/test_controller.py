# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test the controller's node.

The tests cover bumpless engagement, the failsafe for stale inputs, malformed samples, parameters,
the lifecycle and overruns.
"""

import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import Header, String
from tests.nodes.world import OUTPUTS, World, diagnostics, parameters, stamp_ns, world_of

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_core.modes import Mode
from flight_core.rates import NANOSECONDS, nanoseconds
from flight_ros.messages import Encoder, to_message
from flight_ros.topics import STATE
from rise_di_controller.node import ControllerNode

PERIOD, MAX_AGE = 0.01, 0.1  # s, of the ticks, and of y and y_m, as in the default scenario
CHANGED: dict[str, Any] = {"k_g": 3.0, "Lambda": [1, 1, 1, 1], "beta": [10.0, 10.0, 10.0, 5.0]}
EXACT = 1e-12  # of values that are multiplied once
MS = 1_000_000  # ns


class Flight:
    """A controller, and the publisher of its y and y_m."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.y = 0.01  # of each channel; y_m is 0
        self.node: Any = world.start(ControllerNode)

    def send(self) -> None:
        """Publish y and y_m with the present stamp."""
        self.world.send("/y_m", dict.fromkeys(OUTPUTS, 0.0))
        self.world.send("/y", dict.fromkeys(OUTPUTS, self.y))

    def run(self, duration: float, *, silent: bool = False) -> None:
        """Run for a duration, s. If `silent`, there is no y and no y_m."""
        self.world.run(duration, None if silent else self.send)

    def engage(self) -> "Flight":
        """Run until the law has been engaged for a fifth of a second."""
        self.world.until(lambda: self.mode == Mode.ENGAGED, "engaged", self.send)
        self.run(0.2)
        return self

    @property
    def mode(self) -> float:
        """Return the mode of the last tick, or NaN before the first."""
        return self.world.last("/internals").get("mode", math.nan)

    def column(self, name: str, begin: int = 0) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Return a channel of `internals` from a tick on."""
        return np.array(
            [sample.channels[name] for sample in self.world.vectors("/internals")[begin:]]
        )

    def at(self, begin: int = 0) -> np.ndarray[Any, np.dtype[np.int64]]:
        """Return the instants of the ticks, ns of the system clock."""
        samples = self.world.vectors("/internals")[begin:]
        return np.array(
            [sample.stamp_ns + nanoseconds(sample.channels["age"]) for sample in samples]
        )

    def u(self, begin: int = 0) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Return the published inputs, (N, m)."""
        return np.array(
            [[*sample.channels.values()] for sample in self.world.vectors("/u")[begin:]]
        )

    def call(self, kind: Any, name: str, **fields: Any) -> Any:
        """Return the response of a service of the controller."""
        return self.world.call(f"/controller/{name}", kind.Request(**fields))

    def set(self, **values: object) -> tuple[bool, str]:
        """Set parameters at once, and return whether this succeeded, and why not."""
        messages = [
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
        ]
        result = self.call(
            SetParametersAtomically, "set_parameters_atomically", parameters=messages
        ).result
        return result.successful, result.reason

    def values(self, *names: str) -> list[float]:
        """Return parameters of the type double."""
        return [
            value.double_value
            for value in self.call(GetParameters, "get_parameters", names=list(names)).values
        ]

    def transition(self, number: int) -> bool:
        """Request a transition, and return whether it succeeded."""
        return bool(
            self.call(ChangeState, "change_state", transition=Transition(id=number)).success
        )

    @property
    def state(self) -> int:
        """Return the lifecycle state."""
        return int(self.call(GetState, "get_state").current_state.id)


@contextmanager
def flying(scenario: Scenario, **values: object) -> Iterator[Flight]:
    """Yield a controller of a scenario with other parameters."""
    updates = parameters({f"controller.{name}": value for name, value in values.items()})
    with world_of("--params-file", str(scenario.path), *updates) as world:
        yield Flight(world)


@pytest.fixture
def flight(osprey_gust: Scenario) -> Iterator[Flight]:
    with flying(osprey_gust) as flight:
        yield flight


def test_forged_y_in_the_name_of_the_aircraft_is_held_and_told_until_it_ends(
    flight: Flight,
) -> None:
    """Either y may be the forged one.

    A publisher with a name of its own is refused, and the law flies on.
    """
    flight.engage()
    rogue = flight.world.publisher(JointState, "/y", node="/rogue")
    encoder = Encoder(OUTPUTS, "/peer#1")
    errors = flight.node.log.lines

    def forge() -> None:
        flight.send()
        rogue.publish(encoder.encode(flight.world.clock.time_ns(), np.full(4, 0.03)))

    begin = len(flight.at())
    flight.world.run(1.0, forge)
    modes = flight.column("mode", begin)
    assert set(modes[flight.at(begin) > flight.at(begin)[0] + nanoseconds(0.15)]) <= {
        Mode.HOLD,
        Mode.RAMP,
        Mode.TRIM,
    }
    line = "[ERROR] /y: sample refused: two publishers send under the name /peer#1: none is taken"
    assert line in errors
    assert "[ERROR] /y: published by /peer, /rogue, expected one node" in errors
    assert "two publishers send under the name" in diagnostics(flight.world, "/controller")[0]
    rogue.leave()
    flight.run(0.9)
    assert flight.mode != Mode.ENGAGED, "a second after the last witness at the earliest"
    flight.run(0.4)
    assert flight.mode == Mode.ENGAGED


def test_relay_of_old_samples_stops_nothing(flight: Flight) -> None:
    flight.engage()
    relay = flight.world.publisher(JointState, "/y", node="/relay")
    old = flight.world.sent["/y"][0][1]

    def both() -> None:
        flight.send()
        relay.publish(old)

    flight.world.run(1.0, both)
    assert flight.mode == Mode.ENGAGED


def test_engages_bumpless_from_zero(flight: Flight) -> None:
    flight.engage()
    assert (flight.u()[0] == 0).all()
    assert flight.column("e.q")[0] == 0.01


def test_failsafe_holds_u_ramps_to_trim_re_engages_bumpless(osprey_gust: Scenario) -> None:
    """Mode and u are functions of the time since y became stale."""
    hold, ramp, y = 0.1, 1.5, 0.05
    with flying(osprey_gust, hold=hold, ramp=ramp) as flight:
        flight.y = y
        flight.engage()
        last = flight.world.vectors("/y")[-1].stamp_ns
        begin = len(flight.world.sent["/internals"]) - 1  # the last tick with a new y
        flight.run(MAX_AGE + hold + ramp + 0.1, silent=True)
        resumed = len(flight.world.sent["/internals"])
        flight.run(0.1)
        mode = flight.column("mode", begin)
        at = flight.at(begin)
        u = flight.u(begin)
        failsafe = int(np.flatnonzero(mode == Mode.HOLD)[0])
        # the first tick at which y is stale
        assert 0 < at[failsafe] - last - nanoseconds(MAX_AGE) <= nanoseconds(PERIOD)
        during = slice(failsafe, resumed - begin)
        scale = np.clip(1.0 - ((at[during] - at[failsafe]) / NANOSECONDS - hold) / ramp, 0.0, 1.0)
        assert (
            mode[during].tolist()
            == np.select([scale == 1.0, scale > 0.0], [Mode.HOLD, Mode.RAMP], Mode.TRIM).tolist()
        )
        u_held = u[failsafe - 1]
        assert np.abs(u_held).min() > 0.0
        assert np.abs(u[during] - np.outer(scale, u_held)).max() <= EXACT
        assert (u[during][scale == 1.0] == u_held).all()
        assert (u[during][scale == 0.0] == 0.0).all()

        # bumpless transfer: re-engaged at the present u, then steps no larger than those of the law
        # at a constant e
        law = osprey_gust.controller.law_params()
        again = resumed - begin + int(np.flatnonzero(mode[resumed - begin :] == Mode.ENGAGED)[0])
        dt = flight.column("dt", begin)
        assert dt[again] == 0.0
        assert (u[again] == u[again - 1]).all()
        change = np.abs(np.diff(u[again:], axis=0))
        assert (change > 0.0).all()
        assert (
            change
            <= np.outer(dt[again + 1 :], law.input_scale * (law.K * law.Lambda * y + law.beta))
            + EXACT
        ).all()


def test_stopped_controller_re_engages_from_trim(osprey_gust: Scenario) -> None:
    with flying(osprey_gust, hold=0.1, ramp=0.2) as flight:
        flight.engage()
        assert np.abs(flight.u()[-1]).max() > 1e-3
        with flight.world.stopped(flight.node):
            flight.run(0.6)  # beyond its age limit, hold and ramp
        before = len(flight.world.sent["/u"])
        flight.run(0.1)
        assert (flight.u()[before] == 0.0).all()
        assert any("overrun of 0.6" in line for line in flight.node.log.lines)


def test_tick_that_is_stopped_half_way_publishes_no_old_u(
    flight: Flight, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The aircraft has already started its failsafe, so an old u would make the actuators jump."""
    flight.engage()
    ages: list[float] = []
    clock = flight.world.clock
    flight.world.create_subscription(
        JointState, "/u", lambda u: ages.append((clock.time_ns() - stamp_ns(u)) / NANOSECONDS), 1
    )
    (y,) = (each for each in flight.world.subscriptions if each.topic_name == "/y")
    take = y.take_message

    def stopped(kind: type, raw: bool) -> Any:
        monkeypatch.setattr(y, "take_message", take)
        clock.sleep(MAX_AGE + 2 * PERIOD)
        return take(kind, raw)

    monkeypatch.setattr(y, "take_message", stopped)
    flight.run(0.3)
    assert len(ages) > 10
    assert max(ages) <= MAX_AGE


def test_overrun_of_controller_does_not_free_publisher_lock(osprey_gust: Scenario) -> None:
    with flying(osprey_gust, hold=0.1, ramp=0.2) as flight:
        flight.engage()
        with flight.world.stopped(flight.node):
            flight.run(0.6, silent=True)  # beyond age limit, hold and ramp
        # the first sample that the controller takes
        flight.world.send("/y", dict.fromkeys(OUTPUTS, 1.0), "/foreign")
        flight.run(0.1)
        assert flight.node.refusals.counts["y: sender"] == 1
        assert set(flight.column("y.q")) == {0.01}


def test_another_publisher_takes_over_once_u_is_at_trim(osprey_gust: Scenario) -> None:
    hold, ramp = 0.2, 0.3
    with flying(osprey_gust, hold=hold, ramp=ramp) as flight:
        flight.engage()
        last_ns = flight.world.vectors("/y")[-1].stamp_ns

        def send() -> None:
            for topic in ("/y_m", "/y"):
                flight.world.send(topic, dict.fromkeys(OUTPUTS, 0.5), "/another")

        flight.world.until(
            lambda: flight.world.last("/internals")["y.q"] == 0.5,
            "the y of another publisher",
            send,
        )
        taken_ns = flight.at()[-1]
        assert (
            0 < taken_ns - last_ns - nanoseconds(MAX_AGE + hold + ramp) <= nanoseconds(2 * PERIOD)
        )


HOUR_AHEAD = 3600.0


@pytest.mark.parametrize(
    "message, age, reason",
    [
        (to_message(0, OUTPUTS, np.array([math.nan, 0.0, 0.0, 0.0]), "/peer#1"), None, "y: finite"),
        (to_message(0, ("q", "V", "p", "x"), np.zeros(4), "/peer#1"), None, "y: name"),
        (
            JointState(header=Header(frame_id="/peer#1"), name=list(OUTPUTS), position=[1.0]),
            None,
            "y: length",
        ),
        (None, MAX_AGE + 2 * PERIOD, "y: old"),
        (None, -HOUR_AHEAD, "y: future"),
    ],
    ids=("not a number", "wrong names", "wrong length", "old stamp", "future stamp"),
)
def test_malformed_sample_refused_counted_and_never_used(
    message: JointState | None, age: float | None, reason: str, flight: Flight
) -> None:
    flight.engage()

    def send_both() -> None:
        flight.send()
        if message is None:
            flight.world.send("/y", dict.fromkeys(OUTPUTS, 99.0), age=age or 0.0)
        else:
            flight.world.publish("/y", message)

    flight.world.run(1.5, send_both)
    assert flight.node.refusals.counts.keys() == {reason}
    assert int(diagnostics(flight.world, "/controller")[1][f"refused {reason}"]) > 100
    assert set(flight.column("mode")) == {Mode.ENGAGED}
    assert set(flight.column("y.q")) == {0.01}


def test_impossible_sample_refused_counted_and_never_used(flight: Flight) -> None:
    flight.engage()

    def send_both() -> None:
        flight.world.send("/y", dict.fromkeys(OUTPUTS, 0.0) | {"q": 1e308})
        flight.send()  # of the same instant: a lost sample does not take the place of another

    flight.world.run(1.5, send_both)
    assert int(diagnostics(flight.world, "/controller")[1]["refused y: implausible"]) > 100
    assert set(flight.column("mode")) == {Mode.ENGAGED}
    assert set(flight.column("y.q")) == {0.01}


def test_gains_change_in_flight_bumpless(osprey_gust: Scenario) -> None:
    with flying(osprey_gust, sign="soft") as flight:
        flight.y = 0.2
        flight.engage()
        since = len(flight.world.sent["/internals"]) - 1
        assert flight.set(**CHANGED) == (True, "")
        assert "[INFO] k_g: 1.0 -> 3.0" in flight.node.log.lines
        flight.run(0.1)
        assert len(set(flight.column("parameters", since))) == 2  # those before and after
        # With e = y the law moves u by K Lambda e dt + beta dt in a tick; the new gains alone would
        # move it by more than 2 e.
        laws = [
            scenario.controller.law_params()
            for scenario in (osprey_gust, osprey_gust.vary(controller=CHANGED))
        ]
        rate = np.max(
            [law.input_scale * (law.K * law.Lambda * flight.y + law.beta) for law in laws], axis=0
        )
        change = np.abs(np.diff(flight.u(since), axis=0))
        assert (change <= np.outer(flight.column("dt", since)[1:], rate) + EXACT).all()


def test_saturation_limits_can_be_added_in_flight(flight: Flight) -> None:
    flight.engage()
    assert flight.set(upper=[0.001, 0.001, 0.001, 0.001]) == (True, "")
    before = len(flight.world.sent["/u"])
    flight.y = -0.2
    flight.run(1.0)
    assert flight.u()[-1] == pytest.approx(0.001, rel=1e-9)  # to rounding
    assert flight.u(before).max() <= 0.001
    assert not flight.set(upper=[-1.0, 1.0, 1.0, 1.0])[0]  # trim would be outside


@pytest.mark.parametrize(
    "changes, sentence",
    [
        ({"k_g": -1.0}, "controller.k_g: found -1.0, expected greater than 0"),
        (
            {"beta": [1.0, math.nan, 1.0, 1.0]},
            "controller.beta[1]: found nan, expected a finite number",
        ),
        ({"k_g": 2.0, "sign": "smooth"}, "controller.sign: found 'smooth', expected"),
        ({"rate": 200.0}, "read-only"),
        ({"k_gg": 1.0}, "undeclared parameter"),
        (
            {"use_sim_time": True},
            "controller.use_sim_time: found True, expected no change: a node chooses its clock",
        ),
    ],
)
def test_invalid_change_rejected_with_reason_and_has_no_effect(
    changes: dict[str, Any], sentence: str, flight: Flight
) -> None:
    flight.engage()
    successful, reason = flight.set(**changes)
    assert not successful
    assert sentence in reason
    assert flight.values("k_g", "rate") == [1.0, 100.0]
    before = len(flight.world.sent["/u"])
    flight.run(0.1)
    assert len(flight.world.sent["/u"]) > before + 5


def test_parameters_of_several_nodes_set_none(flight: Flight) -> None:
    """`ros2 param load` joins the sections of a file.

    So max_age may be the value of the aircraft's section.
    """
    messages = [
        Parameter(name, value=value).to_parameter_msg()
        for name, value in (("max_age", 0.7), ("step", 0.002))
    ]
    results = flight.call(SetParameters, "set_parameters", parameters=messages).results
    assert [result.successful for result in results] == [False, False]
    assert (
        results[0].reason == "found step, expected parameters of /controller alone; nothing is set"
    )
    assert flight.values("max_age") == [0.1]


def test_waits_for_configure_and_activate_without_autostart(osprey_gust: Scenario) -> None:
    with flying(osprey_gust, autostart="false") as flight:
        assert any("waiting to be configured" in line for line in flight.node.log.lines)
        assert flight.state == State.PRIMARY_STATE_UNCONFIGURED
        assert flight.transition(Transition.TRANSITION_CONFIGURE)
        flight.run(0.2)
        assert not flight.world.sent["/u"]
        assert flight.transition(Transition.TRANSITION_ACTIVATE)
        flight.engage()
        assert flight.transition(Transition.TRANSITION_DEACTIVATE)
        flight.run(0.1)
        assert flight.mode == Mode.INACTIVE


def test_deactivated_controller_publishes_trim_but_standby_that_was_never_activated_nothing(
    osprey_gust: Scenario,
) -> None:
    """A bridge engages only with a fresh u.

    The u of a standby would conflict with another controller.
    """
    with flying(osprey_gust, autostart="false") as flight:
        assert flight.transition(Transition.TRANSITION_CONFIGURE)
        flight.run(0.3)
        assert not flight.world.sent["/u"]
        flight.run(0.5, silent=True)  # longer than max_age: y is stale, so the law does not engage
        assert flight.transition(Transition.TRANSITION_ACTIVATE)
        assert flight.transition(Transition.TRANSITION_DEACTIVATE)
        flight.run(0.2)
        assert len(flight.u()) > 5
        assert not flight.u().any()
        assert not flight.world.sent["/internals"]


def test_controller_that_starts_inactive_publishes_trim_until_activated(
    osprey_gust: Scenario,
) -> None:
    with flying(osprey_gust, start_active="false") as flight:
        flight.run(0.3)
        assert flight.state == State.PRIMARY_STATE_INACTIVE
        assert len(flight.u()) > 20
        assert not flight.u().any()
        assert not flight.world.sent["/internals"]
        assert flight.transition(Transition.TRANSITION_ACTIVATE)
        flight.engage()


def test_invalid_transition_refused_and_node_goes_on(flight: Flight) -> None:
    flight.engage()
    assert not flight.transition(Transition.TRANSITION_ACTIVATE)
    assert any("[ERROR] request rejected: " in line for line in flight.node.log.lines)
    before = len(flight.world.sent["/u"])
    flight.run(0.3)
    assert len(flight.world.sent["/u"]) > before + 20


def test_tick_rate_is_kept_over_overruns(flight: Flight) -> None:
    """Deadlines are absolute.

    After an overrun a tick is late, and the skipped ticks are counted.
    """
    flight.engage()
    flight.run(2.0, silent=True)  # in the failsafe each tick publishes internals
    begin = len(flight.world.sent["/internals"]) - 1
    before = missed(flight)
    for periods in (3.4, 5.0, 1.2, 7.9):
        with flight.world.stopped(flight.node):
            flight.world.run(periods * PERIOD)
        flight.run(0.1, silent=True)
    flight.run(1.0, silent=True)
    number = flight.column("number")
    late = flight.column("late", begin)
    assert number.tolist() == [*range(1, len(number) + 1)]  # none is lost
    assert ((late >= 0.0) & (late < PERIOD)).all()
    assert late.max() > 0.0
    deadlines = flight.at(begin) - np.array([nanoseconds(value) for value in late])
    steps, remainder = np.divmod(np.diff(deadlines), nanoseconds(PERIOD))
    assert (remainder == 0).all()
    assert (steps > 0).all()
    assert (steps - 1).sum() == missed(flight) - before
    assert missed(flight) - before >= 3 + 4 + 0 + 7 - 1


def missed(flight: Flight) -> int:
    """Return how many missed ticks the diagnostics count."""
    return int(diagnostics(flight.world, "/controller")[1]["missed ticks"])


def test_clock_of_ticks_outlives_step_of_system_clock_and_step_is_told(flight: Flight) -> None:
    flight.engage()
    for step, sentence in (
        (-5.0, "set by -5.000 s: this node keeps its own time"),
        (0.0, "set by +5.000 s: it is correct again"),
    ):
        flight.world.clock.step_ns = nanoseconds(step)
        age = step  # the publishers keep their time, too

        def send(age: float = age) -> None:
            flight.world.send("/y_m", dict.fromkeys(OUTPUTS, 0.0), age=age)
            flight.world.send("/y", dict.fromkeys(OUTPUTS, 0.01), age=age)

        flight.world.run(1.5, send)
        assert any(
            f"[ERROR] the system clock was {sentence}" in line for line in flight.node.log.lines
        )
    assert set(flight.column("mode")) == {Mode.ENGAGED}


@pytest.mark.parametrize(
    "begin, cause",
    [
        (None, "no publisher"),
        (
            lambda flight: flight.world.publisher(JointState, "/y"),
            "no sample of its publisher arrives",
        ),
        (
            lambda flight: flight.world.publisher(String, "/y"),
            "/peer publishes std_msgs/msg/String, expected sensor_msgs",
        ),
        (lambda flight: flight.world.send("/y", {"q": 0.0}), "samples refused, the last"),
    ],
)
def test_waiting_for_y_is_told_with_its_cause(
    begin: Callable[[Flight], object] | None, cause: str, flight: Flight
) -> None:
    def meanwhile() -> None:
        if begin is not None and "refused" in cause:
            begin(flight)

    if begin is not None and "refused" not in cause:
        begin(flight)
    flight.world.run(3.5, meanwhile)
    waits = [
        line for line in flight.node.log.lines if line.startswith("[WARNING] waiting for /y: ")
    ]
    assert len(waits) == 1
    assert cause in waits[0]
    flight.world.run(2.0, meanwhile)
    # every 2 s
    assert sum(line.startswith("[WARNING] waiting for /y: ") for line in flight.node.log.lines) == 2


@pytest.mark.parametrize("is_sent", [False, True])
def test_node_of_a_user_that_waits_for_the_topic_start_in_vain_is_named(
    flight: Flight, *, is_sent: bool
) -> None:
    """If a user starts the nodes by hand, nobody may publish `start`."""
    flight.world.publisher(JointState, "/y")
    flight.world.subscribe(Time, "/start", STATE, "/my_aircraft", raw=False)
    if is_sent:
        flight.world.publisher(Time, "/start")
    flight.world.run(3.5)
    (line,) = [line for line in flight.node.log.lines if "waiting for /y: no sample" in line]
    assert line.endswith("; a node waits for the topic start, which nobody publishes") != is_sent


@pytest.mark.parametrize("rate, named", [(9.0, True), (20.0, True), (50.0, False), (200.0, False)])
def test_rate_of_y_too_low_for_max_age_is_named_once_with_its_mend(
    rate: float, named: bool, flight: Flight
) -> None:
    """At 9 Hz the law engages and holds in turns. At 20 Hz it does so after two late samples."""
    next_ns = 0

    def send(paused: bool = False) -> None:
        nonlocal next_ns
        flight.world.send("/y_m", dict.fromkeys(OUTPUTS, 0.0))
        if flight.world.clock.now_ns >= next_ns and not paused:
            flight.world.send("/y", dict.fromkeys(OUTPUTS, 0.0))
            next_ns = flight.world.clock.now_ns + nanoseconds(1.0 / rate)

    for _ in range(3):
        flight.world.run(1.5, send)
        flight.world.run(0.15, lambda: send(paused=True))
    assert Mode.HOLD in set(flight.column("mode"))
    lines = [line for line in flight.node.log.lines if "fit into max_age" in line]
    assert len(lines) == named
    if named:
        match = re.search(
            r"/y: ([\d.]+) samples a second, of which [\d.]+ fit into max_age = 0.1 s: send 30 ",
            lines[0],
        )
        assert match
        assert float(match[1]) == pytest.approx(rate, rel=0.1)


def test_long_max_age_is_named_at_start_and_in_flight(osprey_gust: Scenario) -> None:
    with flying(osprey_gust, max_age=2.0) as flight:
        lines = [
            line
            for line in flight.node.log.lines
            if "[WARNING] max_age = 2 s: the failsafe begins 2 s after" in line
        ]
        assert len(lines) == 1
        for max_age in (0.1, 9.0):
            assert flight.set(max_age=max_age) == (True, "")
        assert [
            line for line in flight.node.log.lines if "failsafe begins 9 s after the last y" in line
        ]
        assert not [line for line in flight.node.log.lines if "failsafe begins 0.1 s" in line]


def test_sample_without_stamp_is_no_old_one(flight: Flight) -> None:
    flight.run(0.1)
    flight.world.send("/y", dict.fromkeys(OUTPUTS, 0.0), age=flight.world.clock.time())
    flight.run(0.1)
    assert any("/y: sample refused: no stamp" in line for line in flight.node.log.lines)


def test_node_waits_for_the_next_whole_period(flight: Flight) -> None:
    """The node waits until 1 ms after a whole period of the system clock.

    By then, y and y_m of this instant have arrived.
    """
    flight.engage()
    assert set(flight.at() % (10 * MS)) == {MS}


def test_controller_that_was_shut_down_publishes_nothing(flight: Flight) -> None:
    """A deactivated node ramps u to trim, and one that was shut down is silent.

    The aircraft has a failsafe for this.
    """
    flight.engage()
    assert flight.transition(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert flight.state == State.PRIMARY_STATE_FINALIZED
    flight.run(0.05)
    before = {topic: len(flight.world.sent[topic]) for topic in ("/u", "/internals")}
    flight.run(1.5)
    assert {topic: len(flight.world.sent[topic]) for topic in before} == before
    assert diagnostics(flight.world, "/controller")[0] == "shut down: no u comes any more"


@pytest.mark.parametrize(
    "changes",
    [
        {"observer.margin": 0.0},
        {"observer.part": 0.3},
        {"observer.fade": 3.0},
        {"feedforward.lead": [0.03, 0.03, 0.03, 0.1]},
        {"observer.F": [0.0]},
        {"k_g": 2.0, "observer.margin": 0.0},
    ],
)
def test_models_of_an_operator_are_refused_in_flight(changes: dict[str, Any]) -> None:
    """A proposal of a learner is proved before it flies, and its margin cannot be set by hand."""
    with flying(find_scenario("osprey_observer")) as flight:
        flight.engage()
        before = flight.values("observer.margin", "observer.part", "observer.fade", "k_g")
        successful, reason = flight.set(**changes)
        assert not successful
        assert "expected a change at a restart only" in reason
        assert flight.values("observer.margin", "observer.part", "observer.fade", "k_g") == before
        assert flight.set(hold=0.3) == (True, "")
