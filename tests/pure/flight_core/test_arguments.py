# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test how arguments of public functions are converted, and how a wrong one is refused."""

from pathlib import Path

import numpy as np
import pytest
from tests.conftest import refusing

from flight_core.arguments import as_count, as_instance, as_number, as_numbers, as_path


def test_numbers_of_numpy_are_numbers() -> None:
    assert as_number(np.float32(0.5), "rate", 0.0, 1.0) == 0.5
    assert as_count(np.int64(4), "samples", 1) == 4
    assert as_numbers(np.array([1, 2]), "lag", "seconds") == (1.0, 2.0)
    assert as_numbers(0.5, "lag", "seconds") == (0.5,)


@pytest.mark.parametrize("value", ["5", None, True, float("nan"), 10**400])
def test_other_values_are_no_number(value: object) -> None:
    with refusing(r"^rate: found .*, expected 1 to 1000 Hz$"):
        as_number(value, "rate", 1.0, 1000.0, "Hz")


@pytest.mark.parametrize("value", [2.5, 0, "3", True])
def test_a_count_is_an_integer(value: object) -> None:
    with refusing(r"^samples: found .*, expected an integer of 1 or more$"):
        as_count(value, "samples", 1)


@pytest.mark.parametrize("value", ["0.1", ["0.1"], {"q": 0.1}, [[0.1]], [float("inf")]])
def test_a_list_of_numbers_has_numbers(value: object) -> None:
    with refusing(r"^lag: found .*, expected seconds$"):
        as_numbers(value, "lag", "seconds")


def test_paths_are_texts_or_path_like() -> None:
    assert (
        as_path("runs/latest", "run", "")
        == as_path(Path("runs/latest"), "run", "")
        == Path("runs/latest")
    )


@pytest.mark.parametrize("value", [None, 3, b"runs", "", ["runs"]])
def test_other_values_are_no_path(value: object) -> None:
    with refusing(r"^run: found .*, expected the folder of a run$"):
        as_path(value, "run", "the folder of a run")  # type: ignore[arg-type]


def test_an_instance_of_another_class_is_refused() -> None:
    assert as_instance(3, int, "n", "an integer") == 3
    with refusing(r"^n: found 'three', expected an integer$"):
        as_instance("three", int, "n", "an integer")
