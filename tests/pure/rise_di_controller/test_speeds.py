# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test an observer that is scheduled over the airspeed.

The tests cover the airframe at another speed, models between the speeds, flights with u late, and
replay.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pytest import approx
from tests.conftest import refusing

import rise_di
from aircraft_sim.airframes.airframe import Airframe, load_airframe
from aircraft_sim.airframes.airspeed import at_speed
from aircraft_sim.uncertainty import as_yaml
from flight_analysis.closed_loop.replay import replay
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_analysis.linear_loop.delay_margin import delay_margin
from flight_analysis.linear_loop.loop_margins import law_order
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS
from flight_core.vectors import StampedVector
from flight_design.gains.gain_design import selected_observer
from flight_design.gains.observer_search import SelectedObserver
from flight_design.identification.innovation_filters import Actuation
from flight_design.identification.model_refusals import best_known
from flight_design.learning.designs import Goal
from flight_design.learning.learner import Learner
from rise_di_controller.controller import Controller
from rise_di_controller.law.control_law import Measurements
from rise_di_controller.law.linear_loop import LinearPlant, LoopTiming, linear_law
from rise_di_controller.learning.proposals import Event, Learning, Proposal, design_changes
from rise_di_controller.rise_di_config import RiseDiConfig

pytestmark = pytest.mark.slow

FASTER, LATE = 1.32, 0.02  # of the trim speed; s
OSPREY = load_airframe("osprey")
SHIPPED = find_scenario("osprey_observer").vary(
    aircraft={"rate": 100.0, "step": 0.005},
    reference_model={"rate": 100.0},
    flight={"duration": 12.0},
)


@pytest.fixture(scope="module")
def scheduled() -> RiseDiConfig:
    """Return a controller with an observer for 0.7 to 1.4 of the trim speed."""
    speeds = (0.7, 1.4)
    return selected_observer(
        SHIPPED.rise_di(), SHIPPED, OSPREY, 0.03, uncertain=False, speeds=speeds
    ).controller


def margin(controller: RiseDiConfig, ratio: float) -> float:
    """Return the delay margin of a controller around the osprey at another speed, s."""
    frame = at_speed(OSPREY, ratio, "thrust")
    rows, columns = law_order(frame, controller)
    plant = LinearPlant(
        frame.matrix_a() + frame.matrix_gravity(),
        frame.matrix_b()[:, columns],
        frame.matrix_c()[rows],
    )
    return delay_margin(
        plant,
        linear_law(controller.tuned_law(), 4, 0.01),
        LoopTiming(np.array(controller.lag), 0.0, 0.01),
    )


def test_short_period_is_as_fast_as_the_aircraft_and_a_turn_as_wide() -> None:
    """Frequencies, and rates caused by a surface, grow in proportion to V.

    An aircraft of the same shape follows the same path at another speed.
    """
    places = [OSPREY.index(name) for name in ("alpha", "q")]
    faster = at_speed(OSPREY, 1.3, "thrust")
    before, after = (frame.matrix_a()[np.ix_(places, places)] for frame in (OSPREY, faster))
    assert np.sort_complex(np.linalg.eigvals(after)) == approx(
        1.3 * np.sort_complex(np.linalg.eigvals(before))
    )
    steady = [
        np.linalg.solve(A, frame.matrix_b()[places, 0])
        for A, frame in ((before, OSPREY), (after, faster))
    ]
    assert steady[1] == approx(steady[0] * np.array([1.0, 1.3]))  # alpha as before, q with V
    assert faster.matrix_gravity()[OSPREY.index("beta"), OSPREY.index("phi")] == approx(
        9.81 / (1.3 * 25.0), rel=0.01
    )
    vertical = faster.gust_direction("vertical")  # m/s of wind change alpha by 1 / V
    assert vertical == approx(-faster.matrix_a()[:, 1] / faster.speed, abs=0.003)
    assert faster.gust_direction("longitudinal") == approx(-faster.matrix_a()[:, 0])


@pytest.mark.parametrize("ratio", [0.7, 1.4])
def test_lift_balances_weight_at_each_speed(ratio: float) -> None:
    """In level flight A[alpha,V] is -2 g / V^2, and in the file of the osprey it is 4 % smaller."""
    faster = at_speed(OSPREY, ratio, "thrust")
    entry = faster.matrix_a()[OSPREY.index("alpha"), OSPREY.index("V")]
    assert entry == approx(-2.0 * 9.81 / (ratio * 25.0) ** 2, rel=0.05)


def test_margin_holds_from_slow_to_fast(scheduled: RiseDiConfig) -> None:
    # that of the shipped observer falls to 17 ms at 1.32 of the trim speed
    assert margin(SHIPPED.rise_di(), FASTER) < LATE
    for ratio in (0.7, 0.8, 1.0, 1.15, FASTER, 1.4):
        assert margin(scheduled.at_speed(ratio), ratio) > 0.03


def test_observer_of_the_speed_flies_where_the_fixed_one_is_lost(
    scheduled: RiseDiConfig, tmp_path: Path
) -> None:
    path = tmp_path / "fast.yaml"
    path.write_text(as_yaml(at_speed(OSPREY, FASTER, "thrust")))
    sensors = SHIPPED.aircraft.sensors.model_dump() | {"delay": LATE}
    fast = SHIPPED.vary(aircraft={"airframe": str(path), "sensors": sensors})
    largest = []
    for controller in (SHIPPED.rise_di(), scheduled.at_speed(FASTER)):
        truth = simulate(fast.vary(controller=controller))["truth"]
        largest.append(float(np.abs(truth["x.q"]).max()))
    assert largest[1] < 0.15  # rad/s: the command is 0.1
    assert largest[0] > 0.5


def test_law_at_a_steady_speed_is_that_of_its_models(scheduled: RiseDiConfig) -> None:
    zero = np.zeros(4)
    V = np.array([0.0, 0.0, 0.0, (FASTER - 1.0) * 25.0])
    rng = np.random.default_rng(1)
    outputs = []
    errors = rng.normal(size=(20, 4)) * np.array([0.01, 0.01, 0.01, 0.0])
    for controller in (scheduled, scheduled.at_speed(FASTER)):
        law, params = controller.tuned_law()
        state = law.engage(
            Measurements(y=V, y_m=V, y_m_dot=zero, u_trim=zero, u_before=zero), params
        )
        for e in errors:
            state, u = law.step(
                state,
                Measurements(y=V + e, y_m=V, y_m_dot=zero, u_trim=zero, u_before=zero),
                np.float64(0.01),
                params,
            )
        outputs.append(u)
    assert outputs[0] == approx(outputs[1], rel=1e-9)


def test_flight_over_speeds_has_no_jump_of_u_and_is_replayed_to_the_bit(
    scheduled: RiseDiConfig,
) -> None:
    pulse = {"V": {"start": [1.0], "stop": [9.0], "value": [6.0]}}
    scenario = SHIPPED.vary(controller=scheduled, reference_model={"pulses": pulse})
    tape = simulate(scenario)
    scale = tape["internals"]["scale.q"]
    assert scale.min() < 0.75
    assert replay(tape).is_equal()
    step = np.abs(np.diff(tape["u"].values, axis=0)).max(axis=0)
    fixed = np.abs(
        np.diff(simulate(scenario.vary(controller=SHIPPED.rise_di()))["u"].values, axis=0)
    ).max(axis=0)
    assert (step < 1.2 * fixed).all()  # noise of the sensors moves u of both


@pytest.mark.parametrize("key", ["B", "F"])
def test_other_models_at_another_speed_leave_u_as_it_is(scheduled: RiseDiConfig, key: str) -> None:
    """New models leave u as it is at 1.2 of the trim speed.

    With another B the feedforward starts again, and with another F the observer does.
    """
    values = scheduled.model_dump()
    loop = rise_di.Loop(scheduled)
    u = []
    values["schedule"]["fast"][key] = [0.8 * value for value in values["schedule"]["fast"][key]]
    for number in range(301):
        t = 0.01 * number
        y_m = np.array([0.05 * np.sin(2.0 * t), 0.0, 0.0, 5.0])
        if number == 300:
            loop.retune(RiseDiConfig.validate_mapping(values, "controller"))
        u.append(loop.step(t, y_m + 0.01 * np.sin(3.0 * t + np.arange(4)), y_m))
    step = np.abs(np.diff(u, axis=0))
    assert (step[-1] < 1.2 * step[200:-1].max(axis=0)).all()


@pytest.mark.parametrize(
    "changes, sentence",
    [
        (
            {"slow": None},
            "schedule: found a feedforward or an observer that holds at the trim speed alone",
        ),
        (
            {"slow": {"ratio": 1.1}},
            "schedule: found ratios of 1.1 and 1.4, expected one below 1 and one above",
        ),
        (
            {"fast": {"F": -1.0}},
            r"schedule, at 1.4 of the trim speed: observer.F: found a spectral radius",
        ),
    ],
)
def test_wrong_models_at_other_speeds_refused(
    scheduled: RiseDiConfig, changes: dict[str, Any], sentence: str
) -> None:
    values = scheduled.model_dump()
    for name, change in changes.items():
        if change is None:
            values["schedule"][name] = None
        elif "F" in change:  # a factor
            values["schedule"][name]["F"] = [
                change["F"] * value for value in values["schedule"][name]["F"]
            ]
        else:
            values["schedule"][name] |= change
    with refusing(sentence):
        RiseDiConfig.validate_mapping(values, "controller")


LEARNS = find_scenario("osprey_learn_speeds").rise_di()


class Learns:
    """A controller with a schedule and a learner, and the proposals of its flight.

    It flies at 1.2 of the trim speed for 6 s.
    """

    def __init__(self, scheduled: RiseDiConfig) -> None:
        self.change = design_changes(LEARNS, scheduled)
        self.model = RiseDiConfig.validate_mapping(LEARNS.changed(self.change), "controller")
        self.controller, self.events = Controller(LEARNS), list[Event]()
        self.learning = Learning(LEARNS, self.events.append, simulated=False)
        self.now_ns, self.u = 0, list[Any]()
        for _ in range(600):
            self.tick()

    def tick(self) -> None:
        """Run a tick with small errors along a motion of q."""
        self.now_ns += NANOSECONDS // 100
        t = self.now_ns / NANOSECONDS
        y_m = np.array([0.02 * np.sin(2.0 * t), 0.0, 0.0, 5.0])
        e = 0.005 * np.sin(3.0 * t + np.arange(4))
        self.controller.take_y(StampedVector(self.now_ns, y_m + e), self.now_ns)
        self.controller.take_y_m(StampedVector(self.now_ns, y_m), self.now_ns)
        self.controller.tick(self.now_ns)
        self.u.append(self.controller.state.u)
        self.learning.step(self.controller, self.now_ns)

    def propose(self, change: dict[str, Any]) -> str:
        """Return what the controller does with a proposal."""
        proposal = Proposal(
            stamp_ns=self.now_ns,
            start=LEARNS.digest(),
            flown=self.controller.digest,
            change=change,
            sentence="model",
        )
        self.learning.receive(proposal, self.controller, self.now_ns)
        said = len(self.events)
        while len(self.events) == said:
            self.tick()
        return self.events[-1].sentence


def test_learned_models_of_all_speeds_fly_and_go_back_at_once(
    scheduled: RiseDiConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight = Learns(scheduled)
    assert flight.propose(flight.change) == "flies model"
    assert flight.controller.digest == flight.model.digest()
    assert {"schedule.slow.Phi", "schedule.fast.F"} <= set(flight.change)
    state, (law, params) = flight.controller.state, flight.model.tuned_law()
    assert state.y is not None
    at_once = Measurements(
        y=state.y.value,
        y_m=state.y_m,
        y_m_dot=np.zeros(4),
        u_trim=state.u_trim + state.u_ff,
        u_before=state.u,
    )
    _, u = law.step(state.law, at_once, np.float64(1e-9), params)
    assert u == approx(state.u, abs=1e-6)
    monkeypatch.setattr(flight.controller, "diverging", lambda: ("q",))
    flight.tick()
    assert flight.controller.parameters == LEARNS


@pytest.mark.parametrize(
    "name, factor, sentence",
    [
        (
            "schedule.fast.F",
            -1.0,
            (
                "refused: controller.schedule, at 1.4 of the trim speed: observer.F: found a "
                "spectral radius"
            ),
        ),
        (
            "schedule.speed",
            2.0,
            "refused: controller.schedule: found 50.0 m/s, 1.0 s, models at 0.7 and 1.4 times it",
        ),
    ],
)
def test_lie_about_another_speed_is_refused(
    scheduled: RiseDiConfig, name: str, factor: float, sentence: str
) -> None:
    flight = Learns(scheduled)
    change = dict(flight.change)
    value = change[name]
    change[name] = factor * value if isinstance(value, float) else [factor * each for each in value]
    assert flight.propose(change).startswith(sentence)
    assert flight.controller.parameters == LEARNS


def no_design(start: RiseDiConfig, model: Airframe, goal: Goal) -> SelectedObserver:
    raise ParameterError("no design")


def test_effects_at_another_speed_are_reduced_to_the_trim_speed() -> None:
    """The record is flown at 1.24 of the trim speed.

    There the effects of the surfaces are 54 % larger.
    """
    faster = {"start": [0.0, 2.0], "stop": [100.0, 100.0], "value": [3.0, 3.0]}
    scenario = find_scenario("osprey_learn_speeds").vary(
        flight={"duration": 20.0},
        aircraft={"rate": 100.0, "step": 0.01, "turbulence": None},
        reference_model={
            "rate": 100.0,
            "pulses": {
                "V": faster,
                "q": {
                    "start": [9.0, 12.0, 15.0, 18.0],
                    "stop": [10.0, 13.0, 16.0, 19.0],
                    "value": [-0.1, 0.1, 0.1, -0.1],
                },
                "p": {
                    "start": [10.0, 13.0, 16.0, 19.0],
                    "stop": [11.0, 14.0, 17.0, 20.0],
                    "value": [0.4, -0.4, -0.5, 0.5],
                },
                "r": {"start": [11.0, 14.0], "stop": [12.0, 15.0], "value": [0.03, -0.03]},
            },
        },
    )
    ticks = simulate(scenario.vary(controller={"learn": None}))["internals"]
    actuation = Actuation(np.array([0.02, 0.1, 0.02, 0.02]), 0.0)
    learner = Learner(scenario.rise_di(), OSPREY, no_design, actuation)
    for stamp_ns, y, u in zip(
        ticks.stamp_ns.tolist(), ticks.group("y").values, ticks.group("u").values, strict=True
    ):
        learner.take(stamp_ns, y, u, 0)
    learner.propose(0)
    identification = learner.identification
    true = scenario.aircraft.sampled_airframe()
    file = OSPREY.matrix_b()
    assert identification is not None
    # the seconds of the climb in speed are left out
    assert 12.0 < len(identification.recorded.t) * 0.01 < 18.5
    for entry in best_known(identification.entries, true.outputs):
        place = true.index(entry.row), list(true.inputs).index(entry.column)
        assert entry.nominal == approx(file[place])
        error = true.matrix_b()[place] / file[place] - 1.0
        assert abs(entry.error - error) < max(3.0 * entry.deviation, 0.1), entry.name
