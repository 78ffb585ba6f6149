# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test which keys of a parameter set a computation knows, and that it refuses a new one by name."""

import math

import pytest
from tests.conftest import refusing

from flight_core.fields import Field
from flight_core.known_keys import keys_of, require_known, set_keys, unknown_keys
from flight_core.parameters import Config


class Gust(Config):
    """A section of a mapping by name."""

    start: float
    every: float = Field(default=math.inf, allow_inf_nan=True)


class Air(Config):
    """An optional section."""

    altitude: float
    seed: int = 1


class Sensor(Config):
    """A section with lists, in which nothing and zeros mean the same."""

    noise: tuple[float, ...] = ()
    until: tuple[float, ...] = Field(default=())


class Aircraft(Config):
    """A parameter set of every kind."""

    rate: float
    gusts: dict[str, Gust] = Field(default={})
    air: Air | None = None
    sensor: Sensor = Field(default=Sensor())
    names: dict[str, float] = Field(default={})
    probe: Sensor | None = None


ALL = {"rate", "gusts.*.start", "gusts.*.every", "air.altitude", "air.seed"} | {
    "sensor.noise",
    "sensor.until",
    "names",
    "probe.noise",
    "probe.until",
}


def aircraft(**values: object) -> Aircraft:
    return Aircraft.validate_mapping({"rate": 100.0, **values}, "aircraft")


def test_the_keys_of_a_set_are_those_of_its_sections_too() -> None:
    assert keys_of(Aircraft) == ALL


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({}, ["rate"]),
        ({"sensor": {"noise": [0.0, 0.0]}}, ["rate"]),  # zeros: none
        ({"sensor": {"noise": [0.0, 0.1]}}, ["rate", "sensor.noise"]),
        ({"gusts": {"up": {"start": 1.0}}}, ["rate", "gusts.up.start"]),
        ({"air": {"altitude": 0.0}}, ["rate", "air.altitude"]),  # a value that the file needs
        ({"names": {"a": 1.0}}, ["rate", "names"]),
        ({"probe": {}}, ["rate", "probe"]),  # it is there
    ],
)
def test_a_key_is_set_where_it_has_a_value_of_its_own(
    values: dict[str, object], expected: list[str]
) -> None:
    assert [each.name for each in set_keys(aircraft(**values))] == expected


def test_what_is_unknown_is_named_as_the_file_names_it() -> None:
    known = {"rate", "gusts.*.start", "air.altitude"}
    values = {"up": {"start": 1.0, "every": 2.0}}
    assert [each.name for each in unknown_keys(aircraft(gusts=values), known)] == ["gusts.up.every"]
    assert not unknown_keys(aircraft(gusts={"up": {"start": 1.0}}, air={"altitude": 1.0}), known)
    with refusing(r"^aircraft\.air\.seed: found 2, expected 1: it flies without$"):
        require_known(
            aircraft(air={"altitude": 1.0, "seed": 2}), known, "aircraft", "it flies without"
        )


def test_a_section_of_which_nothing_is_known_is_one_key() -> None:
    with refusing(r"^aircraft\.air: found a section, expected none: it flies without$"):
        require_known(aircraft(air={"altitude": 1.0}), {"rate"}, "aircraft", "it flies without")


def test_an_empty_section_is_known_where_one_of_its_keys_is() -> None:
    there = aircraft(probe={})
    assert not unknown_keys(there, {"rate", "probe.noise"})
    assert [each.name for each in unknown_keys(there, {"rate"})] == ["probe"]
