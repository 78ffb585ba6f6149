# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that a flight succeeds only if it shows what was asked for.

Faults are injected, and status 0 is only allowed for errors like those of the flight without the
fault.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tests.closed_loop import calm_osprey

import rise_di
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.metrics.errors import best_error
from flight_analysis.report.account import Account
from flight_analysis.report.linear_flight import Reach, _reach, _share_within, error_pair
from flight_analysis.report.shortfalls import judge
from flight_analysis.report.tracking import saturation_notes
from flight_core.modes import Mode
from flight_core.outcome import COMPLETED, Aim, End, Outcome, Refusal, Shortfall
from flight_core.rates import seconds
from flight_core.tape import Signal, Tape
from flight_core.vectors import FloatArray, StampedVector
from rise_di_controller.controller import Controller

T = 20.0  # s
FAULT = 5.0  # s
WHOLE = Account(end=T, topics={}, lacks=())
LEAST = {"V": 0.2}  # m/s, an error that no user sees
LEAST_RATE = 0.02  # rad/s, the same: 1 deg/s


@cache
def servo() -> Scenario:
    """Return osprey_servo at 100 Hz, with commands, gusts and noise."""
    return find_scenario("osprey_servo").vary(
        flight={"duration": T},
        aircraft={"rate": 100.0, "step": 0.005},
        reference_model={"rate": 100.0},
    )


@cache
def healthy() -> Tape:
    return rise_di.simulate(servo())


def with_faults(scenario: Scenario, *faults: str) -> Scenario:
    actuators = scenario.aircraft.actuators.model_dump() | {"faults": list(faults)}
    return scenario.vary(aircraft={"actuators": actuators})


def worst_rms(tape: Tape) -> dict[str, float]:
    """Return the largest rms error over 10 s for each output."""
    _, error = best_error(tape)
    count = round(10.0 / float(np.median(np.diff(error.stamp_ns))) * 1e9)
    worst = {}
    for name in error.names:
        total = np.concatenate([[0.0], np.cumsum(error[name] ** 2)])
        worst[name] = float(np.sqrt((total[count:] - total[:-count]).max() / count))
    return worst


def times_healthy(tape: Tape) -> float:
    """Return the largest ratio of an error to the error of the flight without a fault.

    It is taken over the outputs that a user sees.
    """
    largest = worst_rms(healthy())
    ratios = []
    for name, rms in worst_rms(tape).items():
        ratios.append(rms / (largest[name] + LEAST.get(name, LEAST_RATE) / 2.0))
    return max(ratios)


def test_healthy_flight_is_completed() -> None:
    assert healthy().outcome == COMPLETED


# those nearest to the limit, on both sides and of each effector, and a loop that diverges
EFFECTOR_FAULTS = (
    *("elevator lost 5", "elevator loose 5 0.05", "thrust weak 5 0.7", "rudder stuck 5"),
    *("aileron weak 5 0.3", "aileron slow 5 0.3", "aileron loose 5 0.05", "rudder weak 5 -1"),
)


@pytest.mark.parametrize("fault", EFFECTOR_FAULTS)
def test_effector_fault_is_told_by_its_error(fault: str) -> None:
    """A fault with more than 3 times the healthy error must be told.

    One with less than 1.5 times must not, and in between both are right.
    """
    tape = rise_di.simulate(with_faults(servo(), fault))
    times = times_healthy(tape)
    if tape.outcome.status == 0:
        assert times < 3.0
    else:
        assert times > 1.5
        assert tape.outcome.shortfalls[0].figures


def test_effector_without_a_task_may_be_stuck() -> None:
    """Without commands, gusts and noise of p and r, the aileron has nothing to do."""
    calm = servo().vary(
        reference_model={"pulses": {}}, aircraft={"gusts": {}, "sensors": {"noise": [0.0] * 4}}
    )
    assert rise_di.simulate(with_faults(calm, "aileron stuck 5")).outcome == COMPLETED


def test_airspeed_of_another_simulator_is_told() -> None:
    """The elevator sticks at its trim after 10 s, which shows in V.

    The aircraft then climbs by 5 deg without a command. V, whose command is constant, is off by 0.6
    m/s. Without the fault it is off by 0.1 m/s.
    """
    c172p = find_scenario("jsbsim_c172p", duration=30.0)
    (shortfall,) = rise_di.simulate(with_faults(c172p, "elevator stuck 10")).outcome.shortfalls
    assert (shortfall.aim, shortfall.figures["output"]) == (Aim.ERROR, "V")


def test_airspeed_in_turbulence_of_another_simulator_is_allowed_for() -> None:
    """Turbulence of sigma = 2 m/s changes V as much.

    The engine is too slow to prevent it.
    """
    turbulence = {"altitude": 1219.2, "sigma": 2.0, "seed": 4}
    rough = find_scenario("jsbsim_c172p", duration=20.0).vary(aircraft={"turbulence": turbulence})
    outcome = rise_di.simulate(rough).outcome
    assert outcome.status == 0
    (allowance,) = outcome.allowances
    assert (allowance.figures["output"], allowance.figures["is_noise"]) == ("V", False)
    assert str(outcome).startswith("completed; V off by 1.")
    assert str(outcome).endswith(" m/s rms, allowed for wind")


def test_unknown_drag_in_wind_is_allowed_for() -> None:
    """The wind changes V, and thereby an unknown drag.

    This leaves 0.7 m/s rms in the last second.
    """
    turbulence = {"altitude": 1219.2, "sigma": 0.85, "seed": 6}
    light = find_scenario("jsbsim_c172p", duration=15.0).vary(aircraft={"turbulence": turbulence})
    assert rise_di.simulate(light).outcome == COMPLETED


def test_noise_beyond_that_of_the_file_is_a_fault() -> None:
    """The noise of p is increased in flight.

    The log has this noise, and the sensor is not declared to have it.
    """
    noises = list(servo().aircraft.sensors.noise)
    noises[2] = 0.15
    louder = servo().vary(aircraft={"sensors": {"noise": noises}})
    tape = rise_di.simulate(louder)
    assert tape.outcome.status == 0
    assert judge(COMPLETED, tape, servo(), WHOLE).status == 4


STORMS: dict[str, dict[str, object]] = {
    # the actuators cannot follow the law: 6 rad/s rms asked of 5.2 rad/s
    "noise of p": {"sensors": {"noise": [0.0017, 0.03, 0.2, 0.0017]}},
    "gust of 40 m/s": {"gusts": {"vertical": {"start": 10.0, "speed": 40.0, "length": 15.0}}},
    "train of gusts": {
        "gusts": {"lateral": {"start": 3.0, "speed": 8.0, "length": 15.0, "every": 1.3}}
    },
    "head wind that the thrust cannot hold": {
        "gusts": {"longitudinal": {"start": 4.0, "speed": 25.0, "length": 200.0}}
    },
}


@pytest.mark.parametrize("storm", STORMS.values(), ids=STORMS)
def test_aircraft_that_noise_or_wind_shakes_is_told(storm: dict[str, object]) -> None:
    """More than 3 deg/s rms is twice what severe turbulence leaves.

    For V, the bound is 2 m/s.
    """
    outcome = rise_di.simulate(servo().vary(aircraft=storm)).outcome
    assert {shortfall.aim for shortfall in outcome.shortfalls} == {Aim.ERROR}


def test_severe_turbulence_is_allowed_for_and_said() -> None:
    """The turbulence is 45 kt at 20 ft by MIL-F-8785C."""
    turbulence = {"altitude": 100.0, "wind": 23.0, "seed": 1}
    outcome = rise_di.simulate(servo().vary(aircraft={"turbulence": turbulence})).outcome
    assert outcome.status == 0
    assert outcome.allowances
    assert all(allowance.sentence.endswith("allowed for wind") for allowance in outcome.allowances)


def test_wind_that_the_end_stops_cannot_hold_is_no_excuse() -> None:
    """In the same turbulence, an elevator with a range of one degree cannot control q.

    It is off by 3.2 deg/s rms.
    """
    actuators = servo().aircraft.actuators
    degree = [0.02, *actuators.upper[1:]]
    short = {"lower": [-limit for limit in degree], "upper": degree}
    outcome = rise_di.simulate(
        servo().vary(
            aircraft={
                "turbulence": {"altitude": 100.0, "wind": 23.0, "seed": 1},
                "actuators": actuators.model_dump() | short,
            }
        )
    ).outcome
    assert [shortfall.aim for shortfall in outcome.shortfalls] == [Aim.ERROR]
    assert "q off by" in outcome.shortfalls[0].sentence


def test_noise_of_a_measured_error_counts_twice() -> None:
    """Without truth, the bound of an error includes twice the rms of the noise.

    It also includes 0.1 rad/s, and what the commands leave.
    """
    calm = servo().vary(reference_model={"pulses": {}}, aircraft={"gusts": {}})
    tape = rise_di.simulate(calm)
    noise = 0.005 * np.random.default_rng(2).standard_normal(len(tape["y"].stamp_ns))
    statuses = {}
    for offset in (0.105, 0.115):
        y = tape["y"].values.copy()
        y[:, 2] = offset + noise
        signals = dict(tape.signals) | {"y": Signal(tape["y"].stamp_ns, tape["y"].names, y)}
        del signals["truth"]
        outcome = judge(COMPLETED, replace(tape, signals=signals), calm, WHOLE)
        statuses[offset] = outcome.status
    assert statuses == {0.105: 0, 0.115: 4}


Sample = Callable[[float, StampedVector], StampedVector | None]


def value(change: Callable[[FloatArray], FloatArray]) -> Sample:
    """Return a fault that changes the values of y from FAULT on."""

    def sample(t: float, y: StampedVector) -> StampedVector:
        return y._replace(value=change(y.value.copy())) if t >= FAULT else y

    return sample


def ahead(t: float, y: StampedVector) -> StampedVector:
    """Return y with its stamp 1 s ahead from FAULT on."""
    return y._replace(stamp_ns=y.stamp_ns + 10**9) if t >= FAULT else y


def swapped(y: FloatArray) -> FloatArray:
    """Exchange V with p, and r with q."""
    return y[[3, 2, 1, 0]]


SENSORS: dict[str, Sample] = {
    "channels swapped": value(swapped),
    "q off by 0.3 rad/s": value(lambda y: y + np.array([0.3, 0.0, 0.0, 0.0])),
    "V off by 5 m/s": value(lambda y: y + np.array([0.0, 5.0, 0.0, 0.0])),
    "stamps 1 s ahead": ahead,
    "no y": lambda t, y: y if t < FAULT else None,
}


@pytest.mark.parametrize("fault", SENSORS.values(), ids=SENSORS)
def test_fault_of_y_is_told(fault: Sample) -> None:
    class Faulty(Controller):
        def take_y(self, sample: StampedVector, now_ns: int) -> Refusal | None:
            sample_with_fault = fault(seconds(now_ns), sample)
            return None if sample_with_fault is None else super().take_y(sample_with_fault, now_ns)

    outcome = rise_di.simulate(servo(), control=Faulty).outcome
    aims = {shortfall.aim for shortfall in outcome.shortfalls}
    assert outcome.end is not End.COMPLETED or aims & {Aim.ENGAGEMENT, Aim.ERROR}
    assert outcome.status in {3, 4}


def test_law_that_gets_no_y_in_time_never_flew() -> None:
    """Each y is 0.15 s old, and `max_age` is 0.1 s."""
    late = servo().vary(flight={"duration": 2.0}, aircraft={"sensors": {"delay": 0.15}})
    outcome = rise_di.simulate(late).outcome
    assert (outcome.status, str(outcome)) == (3, "never flew: the controller never engaged")


def test_bounds_of_y_that_keep_the_law_from_flying_are_told() -> None:
    """Most of the time y is beyond its bounds, so the aircraft flies in trim."""
    narrow = servo().vary(controller={"y_max": [0.004, 0.004, 0.004, 0.08]})
    outcome = rise_di.simulate(narrow).outcome
    assert Aim.ENGAGEMENT in {shortfall.aim for shortfall in outcome.shortfalls}
    assert outcome.status == 4


def with_modes(mode: Mode, first: int, stop: int) -> Tape:
    """Return the healthy flight with these ticks in a mode."""
    internals = healthy()["internals"]
    values = internals.values.copy()
    values[first:stop, internals.names.index("mode")] = mode
    signals = dict(healthy().signals)
    signals["internals"] = Signal(internals.stamp_ns, internals.names, values)
    return replace(healthy(), signals=signals)


def off_by_1_rad_per_s(tape: Tape, first: int, stop: int) -> Tape:
    """Return a flight whose true p is off at these samples."""
    truth = tape["truth"]
    values = truth.values.copy()
    values[first:stop, truth.names.index("x.p")] += 1.0
    signals = dict(tape.signals) | {"truth": Signal(truth.stamp_ns, truth.names, values)}
    return replace(tape, signals=signals)


@pytest.mark.parametrize("switch", ["autostart", "start_active"])
def test_law_that_was_not_asked_to_fly_is_no_shortfall(switch: str) -> None:
    """In a dry run, whoever activates the controller decides when it flies."""
    asleep = with_modes(Mode.INACTIVE, 0, 2001)
    manual = servo().vary(controller={switch: False})
    assert judge(COMPLETED, asleep, manual, WHOLE) == COMPLETED
    paused = off_by_1_rad_per_s(with_modes(Mode.INACTIVE, 800, 1200), 800, 1200)
    assert judge(COMPLETED, paused, manual, WHOLE) == COMPLETED


@pytest.mark.parametrize("first", [0, 50, 1700])
def test_law_that_somebody_deactivates_is_told(first: int) -> None:
    """The scenario starts the law active.

    So its commands should be flown from the first u to the end.
    """
    (shortfall,) = judge(
        COMPLETED, with_modes(Mode.INACTIVE, first, 2001), servo(), WHOLE
    ).shortfalls
    assert shortfall.aim is Aim.ENGAGEMENT
    assert shortfall.figures["share"] == pytest.approx(first / 2001.0)


def test_error_while_somebody_has_deactivated_the_law_is_told() -> None:
    """One second is less than a tenth of the flight, but the aircraft was off in it."""
    paused = off_by_1_rad_per_s(with_modes(Mode.INACTIVE, 800, 900), 800, 900)
    (shortfall,) = judge(COMPLETED, paused, servo(), WHOLE).shortfalls
    assert (shortfall.aim, shortfall.figures["output"]) == (Aim.ERROR, "p")


def test_error_before_the_law_engaged_is_none_of_the_law() -> None:
    """The law engages 1.5 s after its first u."""
    late = off_by_1_rad_per_s(with_modes(Mode.TRIM, 0, 150), 0, 150)
    assert judge(COMPLETED, late, servo(), WHOLE) == COMPLETED
    after = off_by_1_rad_per_s(with_modes(Mode.TRIM, 0, 150), 150, 300)
    assert judge(COMPLETED, after, servo(), WHOLE).status == 4


def test_late_loop_is_told_with_its_cycle() -> None:
    """The u is late by 80 ms, and the margin is 47 ms.

    The rates of the servos bound the oscillation.
    """
    late = servo().vary(aircraft={"actuators": {"delay": 0.08}})
    assert rise_di.margins(late).delay < 0.08
    outcome = rise_di.simulate(late).outcome
    assert outcome.status == 4
    assert any("a cycle of " in shortfall.sentence for shortfall in outcome.shortfalls)


@cache
def on_first_leg() -> tuple[Tape, Scenario]:
    """Return five seconds of a route whose landing at the second waypoint is far from the zone."""
    route = {
        "north": [0.0, 1500.0, 3000.0, 4500.0, 6000.0],
        "east": [0.0, 300.0, 300.0, 300.0, 300.0],
        "altitude": [0.0, 0.0, -60.0, 0.0, 0.0],
    }
    box = {"north": [2900.0, 3100.0, 3100.0, 2900.0], "east": [290.0, 290.0, 310.0, 310.0]}
    scenario = calm_osprey(5.0, route=route, landing={"waypoint": 2}, touchdown=box)
    return rise_di.simulate(scenario), scenario


def test_microburst_that_the_thrust_cannot_hold_is_told() -> None:
    """The flight is guided, with nonlinear kinematics, and V is off by 5 m/s."""
    burst = find_scenario("osprey_microburst")
    section = burst.aircraft.microburst
    assert section is not None
    strong = section.model_dump() | {"speed": 14.0}
    # a fifth of the samples, for a test in a fifth of the time
    coarse = {"microburst": strong, "rate": 100.0, "step": 0.005}
    tape = rise_di.simulate(burst.vary(aircraft=coarse, reference_model={"rate": 100.0}))
    assert tape.outcome.status in {3, 4}


def test_landing_does_not_swallow_what_else_was_short() -> None:
    """A landing leaves the other shortfalls in the outcome.

    The aircraft touches down on the first leg, far from the zone, and half of the log is missing.
    """
    tape, scenario = on_first_leg()
    half = WHOLE._replace(lacks=("u 250 of 501 samples",))
    outcome = judge(Outcome(End.LANDED, "osprey landed at t = 5 s"), tape, scenario, half)
    aims = [shortfall.aim for shortfall in outcome.shortfalls]
    assert aims == [Aim.ROUTE, Aim.TOUCHDOWN, Aim.LOG]
    assert outcome.status == 4
    beside = outcome.shortfalls[1].sentence
    assert str(outcome) == f"osprey landed at t = 5 s, 3 shortfalls; worst: {beside}"
    assert outcome.details == (
        "legs 0 to 1 not flown",
        "log incomplete: u 250 of 501 samples",
    )


def shortfall_on_leg(
    aim: Aim, topic: str, name: str, value: float | FloatArray, **guidance: object
) -> Shortfall:
    """Return the shortfall of one kind that other values of `name` cause.

    They last for two seconds of the first leg.
    """
    tape, scenario = on_first_leg()
    signal = tape[topic]
    values = signal.values.copy()
    t = tape.time(topic)
    values[(t >= 1.0) & (t < 3.0 - 1e-6), signal.names.index(name)] = value
    signals = dict(tape.signals) | {topic: Signal(signal.stamp_ns, signal.names, values)}
    if topic != "truth":
        # an aircraft whose true state nobody knows
        del signals["truth"]
    scenario = scenario.vary(guidance=guidance)
    outcome = judge(COMPLETED, replace(tape, signals=signals), scenario, WHOLE)
    (shortfall,) = [each for each in outcome.shortfalls if each.aim is aim]
    return shortfall


def test_flight_below_its_ground_is_told() -> None:
    """The flight is up to 10 m below the touch-down point of its landing for two seconds."""
    heights = np.linspace(-61.0, -70.0, 200)
    below = shortfall_on_leg(Aim.GROUND, "truth", "pose.altitude", heights)
    assert below.figures == pytest.approx({"below_s": 2.0, "deepest_m": 10.0})


@pytest.mark.parametrize("topic, name", [("truth", "x.V"), ("guidance", "y.V")])
def test_flight_below_its_stall_speed_is_told(topic: str, name: str) -> None:
    """V is 13 m/s below the trim speed of 25 m/s for two seconds, in truth or as measured."""
    slow = shortfall_on_leg(Aim.STALL, topic, name, -13.0, stall_speed=15.0, landing=None)
    assert slow.figures == pytest.approx(
        {"least": 12.0, "stall_speed": 15.0, "below_s": 2.0}, abs=0.05
    )
    assert slow.sentence == "V down to 12.0 m/s, below the stall speed of 15 m/s for 2.0 s"


def test_flight_outside_of_its_fence_is_told() -> None:
    """The flight is 30 m east of a field that ends at 700 m, for two seconds."""
    field = {"north": [-900.0, 900.0, 900.0, -900.0], "east": [-700.0, -700.0, 700.0, 700.0]}
    route = {"north": [0.0, 300.0], "east": [0.0, 0.0], "altitude": [0.0, 0.0]}
    outside = shortfall_on_leg(
        Aim.FENCE,
        "truth",
        "pose.east",
        730.0,
        fence={"field": field},
        route=route,
        landing=None,
        touchdown=None,
    )
    assert outside.figures == pytest.approx({"outside_s": 2.0, "farthest_m": 30.0})
    assert outside.sentence == "outside of the fence for 2.0 s, 30 m at most"


def test_guidance_that_the_log_lacks_is_left_to_the_account() -> None:
    """The account says which topics a log lacks, and the rest of the flight is judged."""
    tape, scenario = on_first_leg()
    signals = {name: signal for name, signal in tape.signals.items() if name != "guidance"}
    assert judge(COMPLETED, replace(tape, signals=signals), scenario, WHOLE) == COMPLETED


def test_leg_that_ends_before_the_aircraft_was_on_it_is_told() -> None:
    tape, scenario = on_first_leg()
    log = tape["guidance"]
    values = log.values.copy()
    half = len(values) // 2
    values[half:, log.names.index("leg")] = 1.0
    values[half, log.names.index("missed")] = 321.0
    signals = dict(tape.signals) | {"guidance": Signal(log.stamp_ns, log.names, values)}
    outcome = judge(COMPLETED, replace(tape, signals=signals), scenario, WHOLE)
    missed = next(each for each in outcome.shortfalls if each.aim is Aim.ROUTE)
    assert missed.sentence == "missed leg 0 by 321 m"
    assert missed.figures == {"leg": 0, "missed_m": 321.0}


def test_part_of_u_that_the_actuators_can_follow() -> None:
    """The inputs are sines of 1 Hz with an rms of 0.5, 0.5 and 1.

    Three times the rms is 1.5, 1.5 and 3.
    """
    t = np.arange(0.0, 10.0, 0.01)
    u = np.sin(2.0 * np.pi * t)[:, None] * np.sqrt(2.0) * [0.5, 0.5, 1.0]
    slow = 3.0 * 2.0 * np.pi * 0.5
    reach = Reach(np.array([2.0, 2.0, 2.0]), np.array([np.inf, slow / 4.0, np.inf]))
    assert _share_within(reach, u, 0.01) == pytest.approx([1.0, 0.25, 2.0 / 3.0], rel=1e-3)


def test_input_behind_an_allocation_reaches_as_far_as_its_first_effector() -> None:
    twin = find_scenario("osprey_twin")
    allocation = twin.controller.allocation
    assert allocation is not None
    T = np.reshape(allocation.T, (len(allocation.effectors), -1))
    actuators = twin.aircraft.actuators
    reach = _reach(twin.controller, twin.aircraft)
    for i, column in enumerate(T.T):
        for limits, whole in ((actuators.upper, reach.travel), (actuators.rate, reach.rate)):
            parts = np.abs(column * whole[i]) / np.array(limits)
            assert parts.max() == pytest.approx(1.0)


def test_error_before_a_late_engagement_hides_nothing() -> None:
    """An error before a late engagement does not hide later errors.

    The law engages 0.2 s late, and the flight is hardly longer than the part that is judged.
    """

    class Late(Controller):
        def take_y(self, sample: StampedVector, now_ns: int) -> Refusal | None:
            t = seconds(now_ns)
            if t < 0.2:
                return None
            if 2.0 <= t < 6.0:
                wrong = sample.value * np.array([1.0, 1.0, -1.0, 1.0]) + 0.5
                sample = sample._replace(value=wrong)
            return super().take_y(sample, now_ns)

    short = servo().vary(flight={"duration": 10.1})
    assert rise_di.simulate(short, control=Late).outcome.status == 4


def test_drift_of_a_sensor_is_no_noise() -> None:
    drifting = servo().vary(aircraft={"sensors": {"drift": [0.0, 2.0, 0.0, 0.0]}})
    assert rise_di.simulate(drifting).outcome.status == 4


def test_lost_samples_of_a_sensor_are_no_shortfall() -> None:
    lossy = servo().vary(flight={"duration": 10.0}, aircraft={"sensors": {"dropout": 0.2}})
    assert rise_di.simulate(lossy).outcome == COMPLETED


def test_law_that_is_too_weak_for_its_commands_is_told() -> None:
    """With a thousandth of the gain, the linear loop does not follow the commands either."""
    scale = np.array(servo().controller.input_scale) / 1000.0
    weak = servo().vary(controller={"input_scale": scale.tolist()})
    assert rise_di.simulate(weak).outcome.status == 4


def test_truth_of_another_simulator_tells_no_wind() -> None:
    """The truth has only the outputs, so the floor is the one of an unknown wind."""
    truth = healthy()["truth"]
    names = tuple(f"x.{name}" for name in servo().controller.outputs)
    values = np.stack([truth[name] for name in names], axis=1)
    signals = dict(healthy().signals) | {"truth": Signal(truth.stamp_ns, names, values)}
    flight = replace(healthy(), signals=signals)
    assert judge(COMPLETED, flight, servo(), WHOLE) == COMPLETED
    pair = error_pair(flight, servo().controller, servo().aircraft)
    assert pair is not None
    assert pair.knowledge == (False, False)


def test_error_that_is_not_a_number_is_told() -> None:
    truth = healthy()["truth"]
    values = truth.values.copy()
    values[500:503] = np.nan
    signals = dict(healthy().signals) | {"truth": Signal(truth.stamp_ns, truth.names, values)}
    (lack,) = judge(COMPLETED, replace(healthy(), signals=signals), servo(), WHOLE).shortfalls
    assert (lack.aim, "not a number" in lack.sentence) == (Aim.LOG, True)
    values[1200:, truth.names.index("x.p")] += 1.0  # what comes later is told as well
    outcome = judge(COMPLETED, replace(healthy(), signals=signals), servo(), WHOLE)
    assert [each.aim for each in outcome.shortfalls] == [Aim.LOG, Aim.ERROR]


STAMPS = np.arange(4000, dtype=np.int64) * 10_000_000  # 40 s at 100 Hz
TIME = STAMPS / 1e9


def of_input(u_free: FloatArray) -> Tape:
    """Return a flight whose controller limited an input to 1."""
    u = np.clip(u_free, -1.0, 1.0)
    names = ("limited.rudder", "u_free.rudder", "u.rudder")
    values = np.stack([(u != u_free).astype(float), u_free, u], axis=1)
    return Tape({"internals": Signal(STAMPS, names, values)})


def test_input_from_limit_to_limit_is_a_note() -> None:
    """A sine of twice the limit is beyond it for two thirds of the time."""
    (note,) = saturation_notes(of_input(2.0 * np.sin(7.0 * TIME)))
    assert note.startswith("rudder went from limit to limit in 67 % of 10 s")


@pytest.mark.parametrize(
    "u_free",
    [
        pytest.param(np.full(4000, 2.0), id="a climb at full throttle"),
        pytest.param(1.1 * np.sin(7.0 * TIME), id="a sine just beyond the limits"),
        pytest.param(np.where(TIME < 4.0, 2.0 * np.sin(7.0 * TIME), 0.0), id="four seconds"),
    ],
)
def test_saturation_of_a_sound_loop_is_no_note(u_free: FloatArray) -> None:
    assert saturation_notes(of_input(u_free)) == []


def test_plant_that_the_law_loses_is_told() -> None:
    """In the user's plant, the first input has the opposite effect."""
    scenario = find_scenario("osprey_servo")
    x = np.zeros(4)

    def plant(t: float, u: FloatArray, dt: float) -> FloatArray:
        effect = np.array([-1.0, 1.0, 1.0, 1.0]) / np.array(scenario.controller.input_scale)
        x[:] = np.clip(x + dt * (effect * u + 0.01), -3.0, 3.0)
        return x.copy()

    tape = rise_di.fly_plant(plant, scenario.controller, scenario.reference_model, 15.0)
    assert tape.outcome.status != 0
