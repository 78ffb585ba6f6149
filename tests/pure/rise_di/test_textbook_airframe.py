# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test with the lateral motion of the Boeing 747 of NASA CR-2144, as its tables print it.

The condition is Mach 0.8 at 40 000 ft (Heffley, Jewell).
"""

from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.signal import StateSpace

from rise_di import own_airframe, select_gains

TABLES = Path(__file__).parents[1] / "published_airframes.yaml"


def test_a_weak_aileron_is_named_with_the_sideslip_that_asks_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The dihedral is -3.05 1/s^2, the aileron 0.143: a degree of sideslip asks 3.05 / 0.143 = 21
    # degrees of aileron, and some for the roll of the rudder that holds r. A gust of 3 % of V0 is
    # 1.7 degrees of sideslip. One size of the commands and no samples: a quarter of the time.
    monkeypatch.setattr(own_airframe, "SIZES", (0.125,))
    monkeypatch.setattr(own_airframe, "SAMPLES", 0)
    table = yaml.safe_load(TABLES.read_text())["b747"]
    A = np.array(table["A"])[4:, 4:]  # of beta, r, p, phi in rad and s
    B = np.array(table["B"])[4:, 2:]
    new_files = own_airframe.new_airframe(
        StateSpace(A, B, np.eye(4), np.zeros((4, 2))),
        folder=tmp_path,
        name="b747",
        speed="774 ft/s",
        states="beta: rad, r: rad/s, p: rad/s, phi: rad",
        inputs="rudder: rad nose left, aileron: rad roll right",
        outputs="p, r",
        text="NASA CR-2144",
    )
    # the command of the header of the scenario
    again = select_gains(new_files.airframe_file, new_files.scenario_file, samples=0).chosen
    assert dict(zip(again.outputs, again.inputs, strict=True)) == {"p": "aileron", "r": "rudder"}
    assert new_files.note.endswith("paired by C B: p by aileron, r by rudder")
    shortfall = str(new_files.shortfall)
    assert (
        "The first flight has aileron at 100 % of its end stop: the gusts ask for it" in shortfall
    )
    assert "a degree of sideslip asks " in shortfall
    assert new_files.scenario_file.read_text().count(f"# {shortfall}\n") == 1
