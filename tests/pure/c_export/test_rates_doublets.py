# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test doublets of the scenarios for PX4's airplane against a rate controller in PX4's form.

The aircraft has the bank, too. Gravity along a banked wing moves the sideslip, beta_dot += g/V0
phi, which the airframe of the rates does not know, but the feedforward of rates.yaml does. The air
is calm, and the gyro has the noise of PX4's simulator.
"""

import csv
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from pytest import approx
from tests.conftest import REPOSITORY

from aircraft_sim.airframes.airframe import load_airframe
from flight_analysis.closed_loop.scenario import Scenario
from flight_analysis.closed_loop.scenario_library import find_scenario
from flight_analysis.closed_loop.simulate import simulate
from flight_core.units import GRAVITY
from flight_design.identification.own_loop import own_loop

EXAMPLE = REPOSITORY / "examples" / "px4_airplane"
TABLE = REPOSITORY / "docs" / "evidence" / "tables" / "export-axes.csv"
AXES = ("q", "p", "r")
NOISE = np.array([0.07, 0.14, 0.028])  # rad/s, as in rates_observer.yaml
WINDOWS = {"q": (3.0, 4.7), "p": (6.0, 7.7), "r": (9.0, 10.7)}  # s, around each doublet
PERIOD = 0.004  # s
# of fw_rate_control, found by a search for the least error on this aircraft
PARAMETERS = {
    "FW_AIRSPD_TRIM": 11.5,
    "FW_PR_FF": 0.331,
    "FW_PR_P": 0.086,
    "FW_PR_I": 1.19,
    "FW_PR_IMAX": 0.4,
    "FW_RR_FF": 0.206,
    "FW_RR_P": 0.05,
    "FW_RR_I": 2.95,
    "FW_RR_IMAX": 0.4,
    "FW_YR_FF": 0.259,
    "FW_YR_P": 0.4155,
    "FW_YR_I": 10.0,
    "FW_YR_IMAX": 0.4,
}

Rows = NDArray[np.float64]


def with_bank() -> dict[str, object]:
    """Return the airframe of the rates with the state phi."""
    airframe = yaml.safe_load((EXAMPLE / "rates_airframe.yaml").read_text("utf-8"))
    states = [*airframe["states"], "phi"]
    A = np.zeros((6, 6))
    A[:5, :5] = airframe["A"]
    A[states.index("beta"), 5] = GRAVITY / airframe["speed"]
    A[5, states.index("p")] = 1.0
    airframe["states"]["phi"] = "rad"
    airframe["A"] = A.tolist()
    airframe["B"] = [*airframe["B"], [0.0, 0.0, 0.0]]
    return dict(airframe)


@pytest.fixture(scope="module")
def airframe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bank") / "airframe.yaml"
    path.write_text(yaml.safe_dump(with_bank(), sort_keys=False), "utf-8")
    return path


def rms(t: Rows, e: Rows) -> dict[str, Rows]:
    """Return the rms of each axis in each doublet, mrad/s, in the order of AXES."""
    return {
        name: 1e3 * np.sqrt(np.mean(e[(t >= start) & (t < stop)] ** 2, axis=0))
        for name, (start, stop) in WINDOWS.items()
    }


def flown(name: str, airframe: Path) -> tuple[dict[str, Rows], Rows, Rows]:
    """Return the errors of a scenario of the example in the doublets, and t and y_m."""
    scenario: Scenario = find_scenario(str(EXAMPLE / name)).vary(
        flight={"duration": 11.0},
        aircraft={"airframe": str(airframe), "sensors": {"noise": NOISE.tolist()}},
    )
    tape = simulate(scenario)
    truth = tape["truth"]
    t: Rows = np.asarray((truth.stamp_ns - tape.start_ns) * 1e-9, dtype=np.float64)
    y_m_t = (tape["y_m"].stamp_ns - tape.start_ns) * 1e-9
    y = np.column_stack([truth[f"x.{axis}"] for axis in AXES])
    y_m = np.column_stack([np.interp(t, y_m_t, tape["y_m"][axis]) for axis in AXES])
    return rms(t, y - y_m), t, y_m


def flown_by_px4(airframe: Path, t: Rows, y_m: Rows) -> dict[str, Rows]:
    """Return the errors of PX4's rate loop with y_m as the setpoint and a y that is 4 ms late."""
    scenario = find_scenario(str(EXAMPLE / "rates.yaml"))
    loop = own_loop(PARAMETERS, scenario, "px4")
    assert loop is not None
    instants = np.arange(0.0, t[-1], PERIOD)
    setpoints = np.column_stack([np.interp(instants, t, column) for column in y_m.T])
    loaded = load_airframe(str(airframe))
    calm = np.zeros((len(instants), len(loaded.states)))
    return rms(instants, loop.flown(scenario, loaded, setpoints, NOISE, calm))


@pytest.fixture(scope="module")
def errors(airframe: Path) -> dict[str, dict[str, Rows]]:
    """Return the errors by controller."""
    by_law, t, y_m = flown("rates.yaml", airframe)
    with_observer, _, _ = flown("rates_observer.yaml", airframe)
    return {"law": by_law, "observer": with_observer, "px4": flown_by_px4(airframe, t, y_m)}


def test_no_axis_is_much_worse_than_by_px4(errors: dict[str, dict[str, Rows]]) -> None:
    """The hardest of nine figures is the yaw rate in roll doublets, because of the sideslip.

    With a feedforward that did not know the bank it was 25 mrad/s, 1.2 times the figure of PX4's
    form.
    """
    law, px4 = errors["law"], errors["px4"]
    assert law["p"][2] < 0.5 * px4["p"][2]
    for axis, name in enumerate(AXES):
        # its own doublet; of q nearly all is the noise of the gyro, of which the law hands on more
        assert law[name][axis] < 1.15 * px4[name][axis]
    total = {
        key: np.sqrt(sum(np.sum(row**2) for row in rows.values())) for key, rows in errors.items()
    }
    assert total["law"] < 0.9 * total["px4"]


def test_table_of_the_page_is_of_these_flights(errors: dict[str, dict[str, Rows]]) -> None:
    with TABLE.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 9
    for row in rows:
        axis = AXES.index(row["axis"])
        for column, key in (
            ("rates.yaml (mrad/s)", "law"),
            ("rates_observer.yaml (mrad/s)", "observer"),
            ("PX4's form (mrad/s)", "px4"),
        ):
            # half of the last digit, and 1 % for another library
            value = errors[key][row["doublet"]][axis]
            assert float(row[column]) == approx(value, abs=0.06, rel=0.01)
