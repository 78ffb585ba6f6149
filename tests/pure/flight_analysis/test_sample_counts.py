# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test how many samples a log should have, which depends on what flew.

A publisher that does not belong to the stack has a rate of its own, and so has /clock. Each
publisher is counted for itself.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.recordings import EPOCH

from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.report.account import Account, account
from flight_analysis.report.sample_counts import period_of
from flight_core.modes import Mode
from flight_core.rates import NANOSECONDS
from flight_core.tape import Process, Recording, Signal, Tape
from flight_log.flight_processes import admitted

END = 30.0  # s
Instants = NDArray[np.float64]


@pytest.fixture(scope="module")
def servo() -> Scenario:
    """Return osprey_servo, with y and y_m at 500 Hz and u at 100 Hz by its parameters."""
    return find_scenario("osprey_servo")


CHANNELS = {"u": ("elevator", "thrust", "aileron", "rudder")}


def signal(name: str, t: Instants, start_ns: int) -> Signal:
    """Return samples of a topic that are zero, at flight times in s."""
    stamp_ns = start_ns + np.round(t * NANOSECONDS).astype(np.int64)
    return Signal(stamp_ns, CHANNELS.get(name, ("q", "V", "p", "r")), np.zeros((len(t), 4)))


def internals(number: Instants, stamp_ns: NDArray[np.int64], age: float) -> Signal:
    """Return engaged ticks with the same age, s."""
    values = np.column_stack(
        [number, np.full(len(number), age), np.full(len(number), float(Mode.ENGAGED))]
    )
    return Signal(stamp_ns, ("number", "age", "mode"), values)


def flight(
    topics: dict[str, Instants],
    nodes: tuple[str, ...],
    *,
    start_ns: int = EPOCH,
    lost: dict[str, int] | None = None,
    is_by_clock: bool = False,
) -> Tape:
    """Return a log of topics, with ticks of the stack's controller if it is among the nodes."""
    signals = {name: signal(name, t, start_ns) for name, t in topics.items()}
    if "controller" in nodes:
        u_ns = signals["u"].stamp_ns
        signals["internals"] = internals(np.arange(1.0, len(u_ns) + 1.0), u_ns, 0.004)
    missing = lost or {}
    recording = {
        name: Recording(len(each.stamp_ns), lost=missing.get(name, 0))
        for name, each in signals.items()
    }
    processes = {
        f"/{node}#7": Process(ready_ns=None, first_ns=start_ns, last_ns=start_ns, samples=9)
        for node in nodes
    }
    return Tape(
        signals,
        start_ns,
        recording=recording,
        processes=processes,
        is_by_clock=is_by_clock,
    )


def timer(rate: float, jitter: float = 3e-4) -> Instants:
    """Return the instants of a foreign timer up to END, with a jitter in s."""
    ideal = np.arange(0.0, END, 1.0 / rate)
    return np.sort(ideal + np.random.default_rng(5).normal(0.0, jitter, len(ideal)))


def by_clock(step: float, period: float) -> Instants:
    """Return the newest whole period at each message of /clock.

    This is what a node of the stack stamps.
    """
    clock = np.arange(0.0, END, step) + 1e-9
    return np.asarray(np.unique(np.floor(clock / period) * period))


def whole(result: Account) -> bool:
    """Return whether an account tells of no loss."""
    return not (result.lacks or result.busy)


@pytest.mark.parametrize("step", [0.001, 0.0025, 1.0 / 300.0, 0.004, 0.005, 0.007, 0.01])
def test_clock_gives_the_rate_of_nodes_with_a_shorter_period(step: float, servo: Scenario) -> None:
    """No sample is lost at any step of /clock. The flight of docs/ros.md has a step of 0.005 s."""
    topics = {
        "y": np.arange(0.0, END, 0.01),
        "y_m": by_clock(step, 0.002),
        "u": np.arange(0.0, END, 0.01),
    }
    nodes = ("reference_model", "controller")
    tape = flight(topics, nodes, start_ns=3 * NANOSECONDS, is_by_clock=True)
    result = account(tape, servo)
    assert whole(result), (result.lacks, result.busy)
    assert result.topics["y_m"].expected == pytest.approx(len(topics["y_m"]), rel=0.01)


def test_node_that_skips_messages_of_clock_is_on_a_busy_host(servo: Scenario) -> None:
    """On average one in eight messages of /clock comes too late, at ten times real time."""
    keep = np.random.default_rng(2).random(6000) > 0.125
    y_m = np.unique(np.floor((np.arange(0.0, END, 0.005)[keep] + 1e-9) / 0.002) * 0.002)
    topics = {"y": np.arange(0.0, END, 0.01), "y_m": y_m, "u": np.arange(0.0, END, 0.01)}
    nodes = ("reference_model", "controller")
    tape = flight(topics, nodes, start_ns=3 * NANOSECONDS, is_by_clock=True)
    result = account(tape, servo)
    assert "y_m were never sent" in result.busy
    assert result.topics["y_m"].share == pytest.approx(0.875, abs=0.02)


@pytest.mark.parametrize("rate", [20.0, 70.0, 100.0, 250.0])
@pytest.mark.parametrize("topic", ["y", "y_m", "u"])
def test_foreign_publisher_has_the_rate_of_its_log(
    topic: str, rate: float, servo: Scenario
) -> None:
    """A foreign publisher has the rate that its log shows.

    The aircraft, the reference model or the controller is foreign, and the other nodes are from the
    stack.
    """
    of_stack = {"y": 500.0, "y_m": 500.0, "u": 100.0}
    topics = {name: np.arange(0.0, END, 1.0 / own) for name, own in of_stack.items()}
    topics[topic] = timer(rate)
    nodes = {"y": "aircraft", "y_m": "reference_model", "u": "controller"}
    del nodes[topic]
    if topic == "y":  # u comes with a new y
        topics["u"] = topics["y"] if rate < 100.0 else topics["u"]
    else:
        topics["truth"] = topics["y"]
    result = account(flight(topics, tuple(nodes.values())), servo)
    assert whole(result), (result.lacks, result.busy)


LOSSES: dict[str, Callable[[Instants], NDArray[np.bool_]]] = {
    "30 % lost": lambda t: np.random.default_rng(1).random(len(t)) > 0.3,
    "60 % lost": lambda t: np.random.default_rng(1).random(len(t)) > 0.6,
    "a pause of 2 s": lambda t: (t < 11.0) | (t > 13.0),
    "an end half-way": lambda t: t < END / 2.0,
}


@pytest.mark.parametrize(
    "loss, is_numbered",
    [
        ("30 % lost", True),
        ("30 % lost", False),
        ("60 % lost", True),
        ("a pause of 2 s", False),
        ("an end half-way", False),
    ],
)
@pytest.mark.parametrize("topic", ["y", "y_m"])
def test_loss_of_a_foreign_publisher_is_told(
    topic: str, loss: str, is_numbered: bool, servo: Scenario
) -> None:
    """The foreign publisher sends at 100 Hz.

    Messages that the recorder lost leave gaps in the numbers, and messages that were never sent do
    not. If 60 % were never sent at random, no stretch is complete, and nothing shows the rate.
    """
    t = timer(100.0)
    keep = LOSSES[loss](t)
    missing = int(np.count_nonzero(~keep)) if is_numbered else 0
    topics = {"y": np.arange(0.0, END, 0.002), "y_m": np.arange(0.0, END, 0.002)}
    topics |= {"u": np.arange(0.0, END, 0.01), topic: t[keep]}
    nodes = ("controller", "reference_model" if topic == "y" else "aircraft")
    if topic == "y_m":
        topics["truth"] = topics["y"]
    result = account(flight(topics, nodes, lost={topic: missing}), servo)
    assert any(lack.startswith(f"{topic} ") for lack in result.lacks)
    assert "busy" not in result.busy  # the cause of a foreign publisher is not known
    share = result.topics[topic].share
    assert share == pytest.approx(np.mean(keep), abs=0.06)


@pytest.mark.parametrize("period", [0.007, 0.008, 0.01, 0.012])
def test_timer_by_a_coarse_clock_has_its_mean_period(period: float) -> None:
    """A timer of rclpy by a /clock of 0.005 s has intervals of one or two steps of the clock."""
    t = np.unique(np.ceil(np.arange(0.0, END, period) / 0.005 - 1e-9) * 0.005)
    stamp_ns = np.round(t * NANOSECONDS).astype(np.int64)
    assert period_of(stamp_ns, 0, 1) == pytest.approx(period * NANOSECONDS, rel=0.01)


def test_two_senders_of_u_count_each_for_itself(servo: Scenario) -> None:
    """Another controller sends four ticks, numbered 1 to 4, among those of the flight.

    The u of the flight is still complete.
    """
    t = np.arange(0.0, END, 0.01)
    tape = flight(
        {"y": np.arange(0.0, END, 0.002), "y_m": np.arange(0.0, END, 0.002), "u": t},
        ("aircraft", "reference_model", "controller"),
    )
    assert beside(tape, servo).topics["u"].share == 1.0
    half = np.arange(len(t)) % 2 == 0
    signals = {name: tape[name].where(half) for name in ("u", "internals")}
    lossy = beside(replace(tape, signals={**tape.signals, **signals}), servo)
    assert lossy.topics["u"].share == pytest.approx(0.5, abs=0.01)


def beside(tape: Tape, scenario: Scenario) -> Account:
    """Return the account of a flight whose u has four samples from another controller.

    They are in the middle of the flight.
    """
    other_ns = EPOCH + round(15.001 * NANOSECONDS) + np.arange(4) * 10_000_000
    merged = {}
    other = {
        "u": Signal(other_ns, CHANNELS["u"], np.ones((4, 4))),
        "internals": internals(np.arange(1.0, 5.0), other_ns, 0.004),
    }
    for name, of_other in other.items():
        signal = tape[name]
        stamp_ns = np.concatenate([signal.stamp_ns, of_other.stamp_ns])
        order = np.argsort(stamp_ns, kind="stable")
        sender = np.repeat(np.array([0, 1], np.int16), [len(signal.stamp_ns), 4])
        values = np.concatenate([signal.values, of_other.values])
        merged[name] = admitted(Signal(stamp_ns[order], signal.names, values[order], sender[order]))
    return account(replace(tape, signals={**tape.signals, **merged}), scenario)


def test_next_publisher_counts_from_the_end_of_the_first() -> None:
    """There are two publishers at 100 Hz.

    The second one is refused until the first one ends at 1 s.
    """
    stamp_ns = np.repeat(np.arange(0, 3 * NANOSECONDS, 10_000_000), 2)
    sender = np.tile(np.array([0, 1], np.int16), len(stamp_ns) // 2)
    keep = (sender == 1) | (stamp_ns < NANOSECONDS)
    both = Signal(stamp_ns, ("q",), np.zeros((len(stamp_ns), 1)), sender).where(keep)
    result = admitted(both)
    assert result.sender is not None
    assert np.all(result.sender[:99] == 0)
    assert np.all(result.sender[101:] == 1)
    assert len(result.stamp_ns) == pytest.approx(300, abs=1)


@pytest.mark.parametrize("duration", [None, END - 1.0])
def test_ticks_before_t_0_are_neither_expected_nor_found(
    duration: float | None, servo: Scenario
) -> None:
    """With y and y_m from a user's nodes, the law can engage 1 s before t = 0.

    No tick is lost then.
    """
    topics = {"y": timer(100.0) - 1.0, "y_m": timer(500.0), "u": np.arange(-1.0, END, 0.01)}
    tape = replace(flight(topics, ("controller",)), duration=duration)
    result = account(tape, servo)
    for name in ("u", "internals"):
        assert result.topics[name].expected == result.topics[name].found, name
    assert not [sentence for sentence in result.lacks if "u " in sentence]
