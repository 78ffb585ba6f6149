# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test lags of actuators as entries of a box.

They are compared with the closed form of an integrator, and with exact loops.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from pytest import approx
from scipy.optimize import brentq
from tests.conftest import invoke, refusing
from tests.pure.flight_analysis.test_certificate import run, signed
from tests.pure.flight_analysis.test_guarantee import LIMIT, PERIOD, integrator, radii

from aircraft_sim.uncertainty import UNIFORM, Spread
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.linear_loop import guarantee as guarantee_module
from flight_analysis.linear_loop.certificate import certificate
from flight_analysis.linear_loop.guarantee import Guarantee, loop_guarantee
from flight_analysis.linear_loop.loop_margins import (
    LEAST_LAG,
    LinearLoop,
    loop_margins,
    margins,
    scenario_loop,
    with_lags_pulled_out,
)
from flight_analysis.linear_loop.told import FlightFacts
from flight_analysis.linear_loop.uncertain_loop import uncertain_loop
from flight_core.vectors import FloatArray
from rise_di_controller.law.linear_loop import LinearPlant, LoopTiming

OSPREY = find_scenario("osprey_servo")
ENTRIES = {"1/lag[elevator]": 0.3, "1/lag[aileron]": 0.3}


def behind_actuator(k: float, lag: float, delay: float = 0.0) -> LinearLoop:
    """Return the loop u = -k y around y_dot = u_a, with the exact lag u_a_dot = (u - u_a) / lag."""
    return integrator(k, 0.0)._replace(loop=LoopTiming(np.array([lag]), delay, PERIOD))


def uncertain(exact: LinearLoop, part: float) -> LinearLoop:
    """Return the loop with a box of its lag."""
    assert exact.box is not None
    linear, box = with_lags_pulled_out(exact, exact.box, {0: part}, 1, UNIFORM)
    return linear._replace(box=box)


@pytest.mark.parametrize(("gain", "lag"), [(2.05, 0.02), (2.1, 0.025)])
def test_lag_of_integrator_may_rise_to_the_closed_form(gain: float, lag: float) -> None:
    """The lag may rise up to the closed form of the sampled loop.

    It is y+ = y - k y (T - lag g) + lag g u_a and u_a+ = e u_a - k y g, with e = exp(-T / lag) and
    g = 1 - e. A gain above 2 / T is only stable behind the actuator. At the slowest one, the
    determinant is 1.
    """

    def room(d: float) -> float:
        slower = lag / (1.0 + d)
        e = np.exp(-PERIOD / slower)
        g = 1.0 - e
        k = gain / PERIOD
        return float(1.0 - (1.0 - k * (PERIOD - slower * g)) * e - k * g * slower * g)

    limit = -brentq(room, -0.95, 0.0)
    assert 0.1 < limit < 0.9
    guarantee = loop_guarantee(uncertain(behind_actuator(gain / PERIOD, lag), 0.1))
    # above by the 1e-6 of the limit of stability at most; below by the level's room of 0.4 %
    assert 0.99 * limit < guarantee.stable < limit * (1.0 + 1e-5)
    assert guarantee.unstable is not None
    assert guarantee.unstable.entries["1/lag[u]"] == approx(-limit, rel=1e-2)


@pytest.mark.parametrize(("periods", "holds"), [(LEAST_LAG, True), (1.0, False)])
def test_two_coefficients_hold_a_lag_of_two_periods(periods: float, holds: bool) -> None:
    """The pole of an actuator is exp(-T (1 + d) / lag), and d is accurate to a thousandth."""
    linear = uncertain(behind_actuator(0.0, periods * PERIOD), 1.0)
    assert linear.box is not None
    loop = uncertain_loop(linear.nominal, linear.law, linear.loop, linear.box)
    off = []
    for d in (-0.9, -0.5, 0.5, 0.8):
        poles = np.linalg.eigvals(loop.at(np.array([0.0, d])).A).real
        exact = np.exp(-(1.0 + d) / periods)
        pole = poles[np.argmin(np.abs(poles - exact))]
        off.append(abs((-periods * np.log(pole) - 1.0) / d - 1.0))
    assert (max(off) < 1e-3) == holds


def test_late_input_behind_an_uncertain_actuator() -> None:
    """Each constant delay is stable up to 5 ms, and up to 10 ms an aircraft is unstable.

    No aircraft within 99 % is unstable, but two coefficients describe a lag only up to 80 %.
    """
    guarantee = loop_guarantee(uncertain(behind_actuator(80.0, 0.03), 0.3), 0.005)
    assert guarantee.unstable is None
    assert guarantee.stable == approx(0.8)
    for d in (-guarantee.stable, 0.0, guarantee.stable):
        for delay in (0.0, 0.002, 0.005):
            other = behind_actuator(80.0, 0.03 / (1.0 + d), delay)
            assert radii(other, np.zeros((1, 1)))[0] <= LIMIT
    first = loop_guarantee(uncertain(behind_actuator(70.0, 0.03), 0.3), 0.01).unstable
    assert first is not None
    lag = 0.03 / (1.0 + first.entries["1/lag[u]"])
    late, in_time = (behind_actuator(70.0, lag, delay) for delay in (0.01, 0.0))
    assert radii(late, np.zeros((1, 1)))[0] > LIMIT > radii(in_time, np.zeros((1, 1)))[0]


def exact_radii(linear: LinearLoop, deviations: FloatArray) -> FloatArray:
    """Return the spectral radii of loops with exact lags.

    The deviations, (N, k), are given by entry, and the lags come last.
    """
    plain = scenario_loop(OSPREY, OSPREY.controller, 1, 0.3)
    assert plain.box is not None
    assert linear.box is not None
    count = len(plain.box.names)
    places = [plain.inputs.index(name[6:-1]) for name in linear.box.names[count:]]
    found = []
    for d in deviations:
        lag = plain.loop.lag.copy()
        lag[places] /= 1.0 + linear.box.part[count:] * d[count:]
        slower = plain._replace(loop=plain.loop._replace(lag=lag))
        found.append(radii(slower, d[None, :count])[0])
    return np.array(found)


@pytest.fixture(scope="module")
def lags() -> LinearLoop:
    return scenario_loop(OSPREY, OSPREY.controller, 4, 0.3, 7, Spread(ENTRIES))


@pytest.fixture(scope="module")
def guarantee(lags: LinearLoop) -> Guarantee:
    """Return what is proved about stability, without disks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(guarantee_module, "FEWER_BOXES", 2)
        return loop_guarantee(lags)


def test_checker_proves_lags_and_refuses_other_ones(
    lags: LinearLoop, guarantee: Guarantee, tmp_path: Path
) -> None:
    content = json.loads(certificate(lags, guarantee, {}))
    assert content["loop"] == lags.digest
    assert content["states"][-2:] == ["u[elevator]", "u[aileron]"]
    done = run(content, tmp_path)
    assert done.returncode == 0, done.stderr
    percent = np.floor(1e3 * guarantee.stable) / 10.0
    assert f"1/lag[elevator] {percent:g} %" in done.stdout
    assert f"B[q,elevator] (B 2, 0) {percent:g} %" in done.stdout
    assert "lags [0.02, 0.02, 0.02, 0.1] s" in done.stdout
    entry, row = content["names"].index("1/lag[elevator]"), content["states"].index("u[elevator]")
    wrong: dict[str, tuple[str, int, int, float]] = {
        "a lag that deviates less": ("F", entry, row, 0.5),
        "an input that goes past its actuator": ("B", 2, 0, 1.0),
        "an actuator that follows another state": ("A", row, 0, 1.0),
    }
    for what, (key, i, j, change) in wrong.items():
        altered = json.loads(json.dumps(content))
        altered[key][i][j] += change
        refused = run(signed(altered), tmp_path)
        assert refused.returncode == 1, what
        assert "u[elevator]: found" in refused.stderr, what
    unnamed = signed(content | {"states": [*content["states"][:-1], "w"]})
    assert "actuators behind the others" in run(unnamed, tmp_path).stderr


def test_no_corner_with_exact_lags_is_unstable(lags: LinearLoop, guarantee: Guarantee) -> None:
    """None of 500 corners of A, B and the lags at the size of the guarantee is unstable.

    The first unstable corner that was found outside is unstable.
    """
    assert lags.box is not None
    assert guarantee.unstable is not None
    # without the lags it is 0.742
    assert 0.6 < guarantee.stable < guarantee.unstable.deviation < 1.1 * guarantee.stable
    signs = np.sign(np.random.default_rng(3).standard_normal((500, len(lags.box.names))))
    assert (exact_radii(lags, signs * guarantee.stable / 0.3) <= LIMIT).all()
    first = np.array([guarantee.unstable.entries.get(name, 0.0) for name in lags.box.names])
    assert exact_radii(lags, first[None] / lags.box.part)[0] > LIMIT


def test_nominal_margins_are_those_of_exact_lags(lags: LinearLoop) -> None:
    plain = loop_margins(scenario_loop(OSPREY, OSPREY.controller))
    found = margins(OSPREY, 2, 0.0, spread=Spread(ENTRIES))
    assert found.nominal.phase == approx(plain.nominal.phase, rel=1e-6)
    # the peak is sought from the modes, of which the plant has others
    assert found.nominal.disk == approx(plain.nominal.disk, rel=1e-4)
    assert found.delay == approx(plain.delay, abs=2e-6)
    assert found.worst is not None
    assert (found.worst.phase < plain.nominal.phase).any()


def test_samples_have_lags_of_their_own(lags: LinearLoop) -> None:
    rates = -np.diagonal(lags.plant.A, axis1=1, axis2=2)[:, -2:]
    plants = LinearPlant(*lags.plant)
    assert rates[0] == approx([50.0, 50.0])
    assert (np.abs(rates / 50.0 - 1.0) <= 0.3).all()
    assert len(np.unique(rates)) == 1 + 2 * 4
    # what is not named stays exact: thrust of 0.1 s, and the rudder
    assert sorted(lags.loop.lag) == approx([0.0, 0.0, 0.02, 0.1])
    assert plants.B[:, -2:].sum(axis=-1) == approx(rates)


@pytest.mark.parametrize(
    ("entries", "sentence"),
    [
        (
            {"lag[elevator]": 0.3},
            r"entry: found lag\[elevator\], expected a lag of 0.02 s or more",
        ),
        ({"1/lag[flap]": 0.3}, r"entry: found 1/lag\[flap\], expected a lag of 0.02 s or more"),
        ({"1/lag[elevator]": 1.0}, r"1/lag\[elevator\]: found 1.0, expected a part of 1 / lag"),
        ({"A[q,none]": 0.3}, r"entry: found A\[q,none\], expected an entry of the airframe"),
    ],
)
def test_unknown_entry_is_refused(entries: dict[str, float], sentence: str) -> None:
    with refusing(sentence):
        margins(OSPREY, 1, spread=Spread(entries))


@pytest.mark.parametrize("lag", [0.0, 0.019])
def test_lag_below_two_periods_is_refused(lag: float) -> None:
    """Such a lag moves more within a period than two coefficients can describe."""
    actuators = OSPREY.aircraft.actuators.model_dump() | {"lag": [lag, 0.1, 0.02, 0.02]}
    faster = OSPREY.vary(
        controller={"lag": [lag, 0.02, 0.02, 0.1]}, aircraft={"actuators": actuators}
    )
    first = faster.controller.inputs[0]
    with refusing(rf"entry: found 1/lag\[{first}\], expected a lag of 0.02 s or more"):
        margins(faster, 1, spread=Spread({f"1/lag[{first}]": 0.3}))


def test_lags_behind_an_allocation_are_those_of_the_law() -> None:
    twin = find_scenario("osprey_twin")
    name = twin.controller.inputs[0]
    linear = scenario_loop(twin, twin.controller, 1, 0.3, 1, Spread({f"1/lag[{name}]": 0.3}))
    assert linear.box is not None
    assert linear.box.names[-1] == f"1/lag[{name}]"
    assert linear.loop.lag[0] == 0.0 < twin.controller.lag[0]


@pytest.mark.usefixtures("coarse")
def test_command_takes_lags_and_writes_the_unstable_aircraft(tmp_path: Path) -> None:
    words = ["gains", "guarantee", "osprey", "--samples", "1", "--uncertainty", "0.3"]
    for name, part in ENTRIES.items():
        words += ["--entry", f"{name}={part}"]
    said = " ".join(invoke(*words, "--worst", str(tmp_path)).output.split())
    assert "1/lag[elevator] +-30 %" in said
    assert re.search(r"stable for every aircraft within \d\d\.\d % \(certificate", said), said
    flown = find_scenario(str(tmp_path / "farther_scenario.yaml"))
    lag = flown.aircraft.actuators.lag
    known = OSPREY.aircraft.actuators.lag
    assert lag != known
    by_input = dict(zip(flown.aircraft.channels().inputs, lag, strict=True))
    # the margins are those of the aircraft, and the controller was told of a loop that is stable
    true = {"lag": [by_input[name] for name in flown.controller.inputs]}
    assert not margins(flown).nominal.stable
    assert not margins(flown.vary(controller=true)).nominal.stable
    told = scenario_loop(flown, flown.controller, flight=FlightFacts(is_simulated=False))
    assert loop_margins(told).nominal.stable
