# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that y_m is repeated and the next step is tried after a failed step of the model."""

import math
from typing import Any

import numpy as np
import pytest

from reference_model import model
from reference_model.params import ReferenceModelConfig
from reference_model.reference import Reference

MS = 1_000_000  # ns
SECTION: dict[str, Any] = {
    "rate": 100.0,
    "outputs": ["q", "V", "p", "r"],
    "second_order": {"natural_frequency": [4.0, 0.5, 5.0, 4.0], "damping": [0.9, 1.0, 0.9, 0.9]},
    "rise": 0.1,
    "live": {"speed": 25.0, "bounds": {"p": 0.5}},
}
COMMAND = np.array([0.1, 0.0, 0.0, 0.0])


def reference() -> Reference:
    return Reference(ReferenceModelConfig.validate_mapping(SECTION, "reference_model"))


@pytest.mark.parametrize("kind", ["raises", "is not finite"])
def test_last_y_m_goes_on_and_next_step_is_tried(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps 10 to 12 of a pitch command fail."""
    made = reference()
    made.take(0, COMMAND, np.array([0.1, 0.0]))
    number = 0
    step = model.step

    def failing(*arguments: Any) -> Any:
        if number not in {10, 11, 12}:
            return step(*arguments)
        if kind == "raises":
            raise IndexError("index 8 is out of bounds")
        return np.full(8, math.nan)

    monkeypatch.setattr(model, "step", failing)
    y_m = []
    said = []
    for number in range(20):
        made.take(number * 10 * MS + 1, COMMAND, np.array([0.1, 0.0]))
        y_m.append(made.sample(number))
        said.append(made.pop_failure())
    cause = {
        "raises": "IndexError index 8 is out of bounds",
        "is not finite": "ArithmeticError a value that is not finite",
    }
    assert [str(failure) for failure in said if failure] == [
        f"a step of the reference model failed, the last y_m is repeated: {cause[kind]}"
    ]
    assert said[10]
    assert made.failed == 3
    assert np.isfinite(y_m).all()
    assert all(np.array_equal(y_m[k], y_m[9]) for k in (10, 11, 12))
    rising = np.diff([value[0] for value in y_m[12:]])
    assert (rising > 0.0).all()  # from where it stood


def test_failure_is_said_again_after_ten_seconds_without_one() -> None:
    model = reference()
    said = []
    for number in range(1, 3000):
        failing = number in {100, 110, 1900, 1910}
        u_m = np.array([math.nan if failing else 0.0, 0.0, 0.0, 0.0])
        model.take((number - 1) * 10 * MS, u_m, np.array([0.0, 0.0]))
        model.sample(number)
        if model.pop_failure():
            said.append(number)
    assert said == [100, 1900]
    assert model.failed == 4
