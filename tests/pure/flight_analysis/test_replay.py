# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that a replay equals the recorded flight to the last bit.

This is true through failsafes and lost samples, and a single changed bit is found.
"""

import contextlib
import csv
import json
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.conftest import invoke, refusing
from tests.joint_states import parameter_event
from tests.recordings import EPOCH, MS, scenario_file, truncate
from typer.testing import Result

from aircraft_sim.airframes.airframe import load_airframe
from flight_analysis.closed_loop.replay import OPEN_LOOP, ReplayResult, replay
from flight_analysis.closed_loop.replay_ticks import vary
from flight_analysis.closed_loop.scenario import load_scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.modes import Mode
from flight_core.parameters import ParameterError
from flight_core.tape import Signal, Tape
from flight_core.vectors import ChannelError, FloatArray, StampedVector
from flight_design.gains.feedforward_model import with_feedforward
from flight_log.bag import BagWriter, LogAttachments
from flight_log.stored_messages import PARAMETER_EVENT, parameter_changes
from flight_log.tape_reader import read_run
from flight_log.tape_writer import write_run
from rise_di_controller.controller import Controller
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig

pytestmark = pytest.mark.slow

GUST = find_scenario("osprey_gust", 4.0).vary(
    aircraft={"gusts": {"vertical": {"start": 1.0, "speed": 10.12, "length": 15.24}}}
)
SERVO = find_scenario("osprey_servo", 4.0)
LEADING = with_feedforward(SERVO.controller, load_airframe("osprey"))
LOST = {
    "rate": 100.0,
    "sensors": {"noise": [0.0017, 0.03, 0.0017, 0.0017], "delay": 0.01, "dropout": 0.6, "seed": 3},
}
SHORT = {"max_age": 0.025, "hold": 0.01, "ramp": 0.03}
SCENARIOS = {
    "osprey_gust": GUST,
    "osprey_servo": SERVO,
    "literal sign": GUST.vary(controller={"sign": "literal"}),
    "feedforward": SERVO.vary(controller=LEADING.model_dump()),
    "all limits reached": GUST.vary(
        controller={"lower": [-0.01] * 4, "upper": [0.002] * 4, "slew": [0.05, 0.05, 0.05, 0.02]}
    ),
    "samples late and lost": SERVO.vary(aircraft=LOST, controller=SHORT),
    "feedforward, samples late and lost": SERVO.vary(
        aircraft=LOST, controller=LEADING.model_dump() | SHORT
    ),
}


@cache
def flown(name: str) -> Tape:
    """Return the flight of one of SCENARIOS, which is flown once for all tests."""
    return simulate(SCENARIOS[name])


@cache
def busy_flown(name: str) -> Tape:
    """Return the same flight with the commands of BUSY."""
    return simulate(SCENARIOS[name].vary(reference_model={"pulses": BUSY}))


def equal(result: ReplayResult) -> bool:
    return result.is_equal() and bool(result.checked.all())


@pytest.mark.parametrize("name", SCENARIOS)
def test_replay_equals_flight_in_every_bit(name: str) -> None:
    scenario = SCENARIOS[name]
    tape = flown(name)
    result = replay(tape, scenario.controller)
    assert equal(result), result.first()
    assert len(result.number) == len(tape["internals"].stamp_ns) > 100
    assert result.notes == ()
    # each scenario does what its name says
    log = tape["internals"]
    if "limits" in name:
        assert set(log.group("limited").values.ravel()) == {0.0, 1.0, 2.0}
    if "lost" in name:
        assert set(log["mode"]) == {Mode.ENGAGED, Mode.HOLD, Mode.RAMP, Mode.TRIM}
        assert (log["dt"] == 0).sum() > 5
    assert bool(log.group("u_ff").values.any()) is ("feedforward" in name)


class Tick(NamedTuple):
    """The events before a tick and in it."""

    y_age: int | None = 2  # ms, of the y that arrived; None without one
    y_m_age: int | None = 0
    late: int = 0  # us
    active: bool = True
    event: str = ""  # "configured" again, or "replaced" by another controller
    changes: tuple[Mapping[str, Any], ...] = ()  # of the parameters, in order


def driven(parameters: ControllerConfig, ticks: Sequence[Tick], start_ns: int = EPOCH) -> Tape:
    """Return the log of a controller with these events."""
    outputs = parameters.outputs
    controller = Controller(parameters)
    rows: dict[str, list[tuple[int, FloatArray]]] = {"y": [], "y_m": [], "u": [], "internals": []}
    for k, tick in enumerate(ticks):
        now_ns = start_ns + k * controller.period_ns + tick.late * 1000
        for name, age, take in (
            ("y", tick.y_age, controller.take_y),
            ("y_m", tick.y_m_age, controller.take_y_m),
        ):
            if age is None:
                continue
            t = k / parameters.rate - age / 1e3
            phase = 1.0 if name == "y" else 0.9
            sample = StampedVector(
                now_ns - age * MS, 0.05 * np.sin(7.0 * t * phase + np.arange(len(outputs)))
            )
            rows[name].append((sample.stamp_ns, sample.value))
            with contextlib.suppress(ChannelError):  # out of order
                take(sample, now_ns)
        if tick.event == "configured":
            controller.restart()
        elif tick.event == "replaced":
            controller = Controller(parameters)
        for change in tick.changes:
            parameters = vary(parameters, change)
            controller.retune(parameters)
        output = controller.tick(now_ns, tick.late * 1000, active=tick.active)
        # else u is at trim before the first engagement
        if output is not None and controller.has_internals:
            rows["u"].append((output.stamp_ns, output.u))
            rows["internals"].append((output.stamp_ns, output.internals))
    names = {"y": outputs, "y_m": outputs, "u": parameters.inputs, "internals": controller.names}
    return Tape(
        {name: signal(names[name], samples) for name, samples in rows.items() if samples}, start_ns
    )


def signal(names: Sequence[str], samples: Sequence[tuple[int, FloatArray]]) -> Signal:
    """Return samples sorted by stamp, as the reader of logs does."""
    stamps = np.array([stamp for stamp, _ in samples], dtype=np.int64)
    order = np.argsort(stamps, kind="stable")
    return Signal(stamps[order], tuple(names), np.array([value for _, value in samples])[order])


FLY = Tick()
LOST_Y = Tick(y_age=None)
LOST_Y_M = Tick(y_m_age=None)
OFF = Tick(active=False)
AGES = st.one_of(st.none(), st.integers(0, 30))
EVENTS = st.sampled_from(["", "", "", "", "configured", "replaced"])
ACTIVE = st.sampled_from([True, True, True, False])
TICKS = st.lists(
    st.builds(Tick, AGES, AGES, st.integers(0, 9000), ACTIVE, EVENTS, st.just(())), min_size=2
)
QUICK = {"max_age": 0.03, "hold": 0.02, "ramp": 0.03}
PATIENT = vary(GUST.controller, {"max_age": 0.03, "hold": 0.05, "ramp": 0.2})


@settings(deadline=None)
@given(ticks=TICKS, hold=st.booleans(), with_feedforward=st.booleans())
def test_replay_equals_flight_with_late_and_lost_samples(
    ticks: list[Tick], hold: bool, with_feedforward: bool
) -> None:
    changes = QUICK | {"on_deactivate": "hold" if hold else "trim", "slew": [0.3] * 4}
    parameters = vary(LEADING if with_feedforward else GUST.controller, changes)
    result = replay(driven(parameters, [FLY, FLY, *ticks]), parameters)
    assert equal(result), result.first()


MODES: dict[str, tuple[list[Tick], list[Mode]]] = {
    "y lost": (
        [LOST_Y] * 40 + [FLY] * 3,
        [Mode.ENGAGED, Mode.HOLD, Mode.RAMP, Mode.TRIM, Mode.ENGAGED],
    ),
    # y is fresh but unused
    "y_m lost": ([LOST_Y_M] * 12 + [FLY] * 3, [Mode.ENGAGED, Mode.HOLD, Mode.RAMP, Mode.ENGAGED]),
    "deactivated": ([OFF] * 4 + [FLY] * 3, [Mode.ENGAGED, Mode.INACTIVE, Mode.ENGAGED]),
    "activated without y": (
        [Tick(y_age=None, active=False)] * 5 + [LOST_Y] * 2 + [FLY] * 3,
        [Mode.ENGAGED, Mode.INACTIVE, Mode.HOLD, Mode.ENGAGED],
    ),
    # its stamp is older
    "engaged by a late y": (
        [LOST_Y] * 5 + [Tick(y_age=20, y_m_age=20)] * 3,
        [Mode.ENGAGED, Mode.HOLD, Mode.ENGAGED],
    ),
    "configured again": ([Tick(event="configured")] + [FLY] * 3, [Mode.ENGAGED]),
    "late": ([Tick(late=8000), LOST_Y, LOST_Y, FLY], [Mode.ENGAGED]),  # dt of 38 ms
}


@pytest.mark.parametrize("events, modes", MODES.values(), ids=MODES)
def test_a_replay_passes_the_same_modes(events: list[Tick], modes: list[Mode]) -> None:
    result = replay(driven(PATIENT, [FLY] * 20 + events), PATIENT)
    assert equal(result), result.first()
    recorded = result.recorded[:, result.names.index("mode")].tolist()
    assert [mode for k, mode in enumerate(recorded) if k == 0 or recorded[k - 1] != mode] == modes


def flipped(value: float) -> float:
    """Return a float64 with the lowest bit of its fraction changed."""
    return float((np.array([value]).view(np.int64) ^ 1).view(np.float64)[0])


@pytest.mark.parametrize(
    "name, channel",
    [*(("osprey_gust", k) for k in range(4)), ("osprey_servo", 1), ("feedforward", 0)],
)
def test_one_bit_of_one_gain_is_found(name: str, channel: int) -> None:
    scenario = SCENARIOS[name]
    gains = list(scenario.rise_di().Lambda)
    gains[channel] = flipped(gains[channel])
    tape = busy_flown(name)
    assert equal(replay(tape, scenario.controller))
    for result in (
        replay(tape, vary(scenario.controller, {"Lambda": gains})),
        replay(tape, scenario.controller, vary(scenario.controller, {"Lambda": gains})),
    ):
        assert not result.is_equal()
        # from the first tick on, even where rounding hides the bit in all of u
        assert result.other_parameters.all()
        first = result.first()
        if scenario.controller.outputs[channel] == "V":
            continue  # Lambda e is 1e-3 of u there, and its last bit may change no u
        assert first is not None
        assert first.ulps is not None
        assert first.ulps > 0
        assert first.channel == f"u.{scenario.controller.inputs[channel]}"
        assert not result.is_different()[result.number < first.number].any()


BUSY = {
    "q": {"start": [0.5], "stop": [1.5], "value": [0.1]},
    "V": {"start": [0.2], "stop": [3.0], "value": [1.5]},
    "p": {"start": [0.3], "stop": [1.8], "value": [0.4]},
    "r": {"start": [0.4], "stop": [1.4], "value": [0.03]},
}


@pytest.mark.parametrize(
    "topic, channels",
    [
        (
            "internals",
            [
                "dt",
                "u.rudder",
                "u_free.rudder",
                "u_trim.rudder",
                "Pi.r",
                "integral_e.r",
                "e.r",
                "e_0.r",
                "y.r",
            ],
        ),
        ("u", ["rudder"]),
        ("y", ["r"]),
    ],
)
def test_one_bit_of_one_sample_found_and_only_there(topic: str, channels: list[str]) -> None:
    tape = busy_flown("osprey_gust")
    for channel in channels:
        row = np.searchsorted(tape[topic].stamp_ns, 1_000 * MS)
        values = tape[topic].values.copy()
        column = tape[topic].names.index(channel)
        values[row, column] = flipped(values[row, column])
        damaged = replace(
            tape, signals={**tape.signals, topic: replace(tape[topic], values=values)}
        )
        result = replay(damaged, GUST.controller)
        first = result.first()
        assert first is not None
        assert (first.number, first.t) == (101, 1.0)
        assert first.ulps == 1 or topic == "y" or channel == "y.r"  # a bit of y is more in u
        # The next tick starts from the logged state.
        assert result.number[result.is_different().any(axis=1)].max() <= 102


def test_differences_counted_in_units_in_last_place() -> None:
    cases = (
        (1.0, math.nextafter(1.0, 2), 1),
        (-5e-324, 5e-324, 2),
        (0.0, -0.0, 0),
        (1.0, math.nan, None),
    )
    for recorded, computed, ulps in cases:
        yes = np.ones(1, dtype=bool)
        result = ReplayResult(
            names=("u.a",),
            number=np.ones(1, dtype=np.int64),
            t=np.zeros(1),
            recorded=np.array([[recorded]]),
            computed=np.array([[computed]]),
            checked=yes,
            other_parameters=~yes,
            notes=(),
        )
        first = result.first()
        assert first is not None  # zeros of different sign differ
        assert first.ulps == ulps


def without(tape: Tape, keep: Callable[[FloatArray], Any]) -> Tape:
    """Return the log without some ticks.

    Only those samples of `internals` and `u` are kept whose numbers `keep` accepts.
    """
    kept = np.asarray(keep(tape["internals"]["number"]), dtype=bool)
    pair = {name: tape[name] for name in ("internals", "u")}
    signals = {
        name: Signal(signal.stamp_ns[kept], signal.names, signal.values[kept])
        for name, signal in pair.items()
    }
    return replace(tape, signals={**tape.signals, **signals})


@pytest.mark.parametrize("name", ["osprey_gust", "feedforward"])
def test_log_without_beginning_checked_after_first_tick(name: str) -> None:
    scenario = SCENARIOS[name]
    result = replay(without(flown(name), lambda number: number > 100), scenario.controller)
    assert result.first() is None
    assert result.checked.tolist() == [False] + [True] * 300
    assert result.notes == (
        "the log begins with sample 101 of internals: earlier ones are missing",
        "1 ticks not checked: the log does not hold the state before them",
    )


@settings(deadline=None, max_examples=50)
@given(ticks=TICKS, lost=st.sets(st.integers(1, 60)), leading=st.booleans())
def test_lost_samples_of_log_cause_no_differences(
    ticks: list[Tick], lost: set[int], leading: bool
) -> None:
    parameters = vary(LEADING if leading else GUST.controller, QUICK)
    tape = without(
        driven(parameters, [FLY, FLY, *ticks]), lambda number: ~np.isin(number, list(lost))
    )
    if len(tape["internals"].stamp_ns):
        assert replay(tape, parameters).first() is None


def test_gains_changed_in_flight_differ_from_tick_of_change() -> None:
    gains = {"k_g": 2.0, "Lambda": [3.0, 4.0, 2.0, 1.0], "upper": [0.02] * 4}
    tape = driven(GUST.controller, [FLY] * 30 + [Tick(changes=(gains,))] + [FLY] * 30)
    result = replay(tape, GUST.controller)
    first = result.first()
    assert first is not None
    assert first.number == 30
    assert (~result.other_parameters).tolist() == [True] * 29 + [False] * 31
    # With the change from the log every bit is equal.
    result = replay(tape, GUST.controller, changes=[gains])
    assert equal(result), result.first()
    assert result.notes == ("parameters changed before tick 30: Lambda, k_g, upper",)


def test_changes_of_the_same_parameters_are_one_note() -> None:
    """A module whose limits follow the airspeed changes them a thousand times in a flight."""
    limits = [{"upper": [0.02 + 0.001 * k] * 4} for k in range(25)]
    ticks = [Tick(changes=(change,)) for change in limits]
    tape = driven(GUST.controller, [FLY] * 30 + ticks + [Tick(changes=({"k_g": 2.0},)), FLY])
    result = replay(tape, GUST.controller, changes=[*limits, {"k_g": 2.0}])
    assert equal(result), result.first()
    assert result.notes == (
        "parameters changed before tick 30 and 24 later ones: upper",
        "parameters changed before tick 55: k_g",
    )


def test_replay_applies_successive_gain_changes_one_by_one() -> None:
    changes: list[dict[str, Any]] = [{"k_g": 2.0}, {"Lambda": [3.0, 4.0, 2.0, 1.0]}]
    changes += [{"k_g": 3.3}, {"slew": [0.2] * 4}, {"k_g": 1.0}]
    ticks = (
        [FLY] * 30
        + [Tick(changes=(*changes[:3],))]
        + [FLY] * 10
        + [Tick(changes=(change,)) for change in changes[3:]]
    )
    result = replay(driven(GUST.controller, ticks + [FLY] * 5), GUST.controller, changes=changes)
    assert equal(result), result.first()
    assert [note.split(": ")[1] for note in result.notes] == ["Lambda, k_g", "slew", "k_g"]
    # A change that is missing in the log is not guessed.
    lost = replay(driven(GUST.controller, ticks), GUST.controller, changes=changes[2:])
    assert not lost.is_equal()
    assert lost.notes == ()


def test_open_loop_equals_controller_on_recorded_inputs() -> None:
    others = vary(
        GUST.controller,
        {"Lambda": [3.0, 3.0, 3.0, 1.0], "beta": [20.0, 20.0, 8.0, 6.0], "upper": [0.01] * 4},
    )
    tape = flown("osprey_gust")
    controller = Controller(others)
    us = []
    for number, (stamp_ns, y) in enumerate(
        zip(tape["y"].stamp_ns.tolist(), tape["y"].values, strict=True)
    ):
        order = [tape["y"].names.index(name) for name in others.outputs]
        controller.take_y(StampedVector(stamp_ns, y[order]), stamp_ns)
        controller.take_y_m(StampedVector(stamp_ns, tape["y_m"].values[number][order]), stamp_ns)
        if (
            stamp_ns % controller.period_ns == 0
            and (output := controller.tick(stamp_ns)) is not None
        ):
            us.append(output.u)
    result = replay(tape, GUST.controller, others)
    assert result.group(result.computed, "u").values.tobytes() == np.array(us).tobytes()
    assert result.notes == (OPEN_LOOP,)
    assert (
        np.abs(
            result.group(result.computed, "u").values - result.group(result.recorded, "u").values
        ).max()
        > 1e-3
    )


def test_a_log_of_other_channels_is_refused() -> None:
    tape = simulate(GUST.vary(flight={"duration": 0.1}))
    log = tape["internals"]
    less = replace(
        tape, signals={"internals": Signal(log.stamp_ns, ("mood", *log.names[1:]), log.values)}
    )
    sentence = (
        "internals: found no mode, also mood, expected the channels of the scenario in the log"
    )
    with refusing(sentence):
        replay(less, GUST.controller)
    with refusing("the log: found no sample of internals"):
        replay(Tape({"y": tape["y"]}), GUST.controller)
    swapped = vary(GUST.controller, {"outputs": ["p", "q", "r", "V"]})
    with refusing(r"controller.outputs: found p, q, r, V, expected q, p, r, V, as recorded"):
        replay(tape, GUST.controller, swapped)


def test_change_to_same_value_changes_no_bit() -> None:
    # A bumpless change solves for Pi, which rounds.
    set_again = driven(GUST.controller, [FLY] * 20 + [Tick(changes=({"k_g": 1.0},))] + [FLY] * 20)
    left_alone = driven(GUST.controller, [FLY] * 41)
    assert set_again["internals"].values.tobytes() == left_alone["internals"].values.tobytes()


def busy_scenario(folder: Path, **controller: object) -> Path:
    """Return the default scenario for 2 s, with commands on all channels and changed parameters."""
    flight = {"duration": 2.0}
    reference_model = {"pulses": BUSY}
    path = folder / "busy.yaml"
    return scenario_file(
        path, GUST.path, flight=flight, reference_model=reference_model, controller=controller
    )


@pytest.fixture(scope="module")
def tape(tmp_path_factory: pytest.TempPathFactory) -> Tape:
    return simulate(load_scenario(busy_scenario(tmp_path_factory.mktemp("scenario"))))


@pytest.fixture
def run(tape: Tape, tmp_path: Path) -> Path:
    return write_run(tape, tmp_path / "run", LogAttachments(busy_scenario(tmp_path))).parent


def command(*arguments: str) -> Result:
    return invoke("replay", *arguments)


def test_the_command_counts_the_ticks(run: Path) -> None:
    result = command(str(run))
    assert (result.exit_code, result.stdout) == (0, "201 ticks, every bit equal\n")


def test_command_finds_one_bit_of_one_gain_in_scenario_of_log(tape: Tape, tmp_path: Path) -> None:
    gains = [flipped(5.0), 5.0, 3.0, 0.5]
    run = write_run(
        tape, tmp_path / "run", LogAttachments(busy_scenario(tmp_path, Lambda=gains))
    ).parent
    result = command(str(run))
    assert result.exit_code == 1
    first, count, note = result.stdout.splitlines()
    number = re.match(
        r"tick (\d+) differs first, at t = .* s: u.elevator recorded .*, computed .*, [1-9]\d* "
        r"ULP$",
        first,
    )
    assert number is not None
    assert re.match(r"201 ticks, \d+ differ, the last at t = .* s; u_free in \d+, u in \d+", count)
    assert note.startswith(
        "note: 201 ticks, from tick 1 at t = 0 s on, had other parameters than the log "
        "holds: the controller got another file than the recorder (with its file: `rise-di replay "
        "RUN --scenario FILE`)"
    )
    mended = command(str(run), "--scenario", str(busy_scenario(tmp_path)))
    assert (mended.exit_code, mended.stdout) == (0, "201 ticks, every bit equal\n")
    # the same by --set, on the log with the right ones, and as JSON
    right = write_run(tape, tmp_path / "right", LogAttachments(busy_scenario(tmp_path))).parent
    result = command(str(right), "--set", f"controller.Lambda={gains}", "--json")
    assert result.exit_code == 1
    summary = json.loads(result.stdout)
    assert (summary["equal"], summary["open_loop"], summary["ticks"]) == (False, True, 201)
    assert summary["first"]["number"] == int(number[1])


def test_log_cut_short_checked_as_far_as_it_goes(run: Path) -> None:
    truncate(run, 0.75)
    summary = json.loads(command(str(run), "--json").stdout)
    assert summary["equal"]
    assert 20 < summary["ticks"] == summary["checked"] < 201
    assert any("is truncated" in note for note in summary["notes"])


def test_other_gains_shown_beside_what_was_recorded(run: Path, tmp_path: Path) -> None:
    csv_file = tmp_path / "u.csv"
    gains = ("--set", "controller.k_g=3.0", "--set", "controller.upper=[0.01, 1, 1, 1]")
    result = command(str(run), *gains, "--csv", str(csv_file))
    assert result.exit_code == 1
    assert result.stdout.count(OPEN_LOOP) == 1  # in the notes
    assert re.search(r"^ *elevator( +[\d.e-]+){4} *$", result.stdout, re.MULTILINE)
    with csv_file.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    piped = command(str(run), *gains, "--csv", "-")
    assert piped.stdout.splitlines() == csv_file.read_text().splitlines()
    assert OPEN_LOOP in piped.stderr
    log = read_run(run).tape["internals"]
    assert [float(row["u.elevator.recorded"]) for row in rows] == log["u.elevator"].tolist()
    assert max(float(row["u.elevator.computed"]) for row in rows) == 0.01


@pytest.mark.parametrize(
    "setting, sentence",
    [
        ("controller.k_g=-1", "controller.k_g: found -1, expected greater than 0"),
        (
            "aircraft.rate=1",
            "--set: found 'aircraft.rate=1', expected a parameter of the controller and its value",
        ),
    ],
)
def test_an_invalid_setting_is_one_sentence(setting: str, sentence: str, run: Path) -> None:
    result = command(str(run), "--set", setting)
    assert isinstance(result.exception, ParameterError)
    assert str(result.exception).startswith(sentence)
    assert len(str(result.exception).splitlines()) == 1


def test_changes_of_parameters_read_from_log(tmp_path: Path) -> None:
    clock = {"use_sim_time": True}
    events = [
        parameter_event("/one/controller", {"Lambda": [1.0, 2.0], **clock}, stamp_ns=2000 * MS),
        # not in the order of their stamps
        parameter_event(
            "/controller",
            {"sign": "soft"},
            new={"k_g": 2.5},
            deleted={"upper": None},
            stamp_ns=1000 * MS + 5,
        ),
        parameter_event("/controller", {"upper": [1.0, 2.0]}, stamp_ns=1000 * MS),
        parameter_event("/aircraft", {"k_g": 9.0}, stamp_ns=1),
        parameter_event("/controller", {}, new=clock, stamp_ns=2),
    ]
    with BagWriter(tmp_path / "run") as bag:
        channel = bag.add_topic("/parameter_events", PARAMETER_EVENT, "")
        for number, message in enumerate(events):
            bag.write(channel, number, number, number, message)
    nodes = ("/controller", "/one/controller")
    fields = RiseDiConfig.model_fields
    assert {node: parameter_changes(tmp_path / "run", node, fields) for node in nodes} == {
        "/controller": [{"upper": [1.0, 2.0]}, {"k_g": 2.5, "sign": "soft", "upper": None}],
        "/one/controller": [{"Lambda": [1.0, 2.0]}],
    }
    # of a flight that `ros2 bag record` recorded the log beside holds attachments alone
    with BagWriter(tmp_path / "launched") as bag:
        bag.add_metadata("rise_di_flight", {})
    (tmp_path / "run").rename(tmp_path / "launched" / "rosbag2")
    assert len(parameter_changes(tmp_path / "launched", "/controller", fields)) == 2
