# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test what the annotations of a parameter set permit.

They are compared with pydantic's strict types, which were not written here.
"""

import math
from collections.abc import Callable
from typing import Annotated, Any, Literal

import pydantic
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from flight_core.fields import Field, Kind, Problems, kind_of
from flight_core.files import dump_yaml, parse_yaml
from flight_core.parameters import Config, ParameterError

# Each with the declaration of rules as its argument: the stack's Field or pydantic's.
ANNOTATIONS: list[Callable[[Any], Any]] = [
    lambda _: float,
    lambda _: int,
    lambda _: bool,
    lambda rule: Annotated[float, rule(gt=0, le=2)],
    lambda rule: Annotated[float, rule(ge=-1, lt=1, allow_inf_nan=True)],
    lambda rule: Annotated[int, rule(ge=0, lt=3)],
    lambda rule: Annotated[str, rule(min_length=2, pattern=r"^[a-c]\w*$")],
    lambda _: Literal["a", "ab"],
    lambda _: float | None,
    lambda rule: Annotated[float, rule(gt=0)] | Literal["a"] | None,
    lambda rule: Annotated[
        tuple[Annotated[float, rule(gt=0)], ...], rule(min_length=1, max_length=2)
    ],
    lambda _: tuple[int, float],
    lambda _: tuple[tuple[int, ...], ...],
    lambda _: bool | int | float | str | tuple[int, ...] | tuple[float, ...],
    lambda rule: Annotated[dict[str, float | None], rule(min_length=1)],
]
NUMBERS = st.sampled_from(
    [-1, 0, 1, 2, 3, 2**70, -1.0, -0.0, 0.0, 0.5, 1.0, 2.0, 1e308, math.inf, -math.inf, math.nan]
)
# Printable: pydantic takes other texts too, a parameter set does not (test_text.py).
TEXTS = st.sampled_from(["", "a", "ab", "abc!", "1", "1.5", "yes"])
VALUES = st.recursive(
    st.none() | st.booleans() | NUMBERS | st.integers() | st.floats() | TEXTS,
    lambda inner: (
        st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(st.sampled_from(["a", "b", 1]), inner, max_size=2)
    ),
    max_leaves=4,
)
STRICT = pydantic.ConfigDict(strict=True, allow_inf_nan=False)
PAIRS = [
    (kind_of(annotation(Field)), pydantic.TypeAdapter(annotation(pydantic.Field), config=STRICT))
    for annotation in ANNOTATIONS
]


@pytest.mark.parametrize("kind, adapter", PAIRS, ids=map(str, range(len(PAIRS))))
@given(value=VALUES)
@example(value=(1, 2.0))
@example(value=10**400)
def test_field_agrees_with_strict_pydantic(
    kind: Kind, adapter: pydantic.TypeAdapter[Any], value: object
) -> None:
    """A field accepts the values that strict pydantic accepts, and stores the same."""
    problems = Problems()
    held = kind.read(value, "key", problems)
    try:
        expected = adapter.validate_python(value)
    except pydantic.ValidationError:
        assert problems.sentences()
        assert all(
            sentence.startswith("key") and ": found " in sentence
            for sentence in problems.sentences()
        )
    else:
        assert problems.sentences() == []
        assert repr(held) == repr(expected)


class Inner(Config):
    """A group."""

    a: float = Field(gt=0, description="the rate, Hz")
    b: dict[str, tuple[int, ...]] = Field(default={})


class Outer(Config):
    """A set with a group and a union."""

    inner: Inner
    scale: Annotated[float, Field(gt=0)] | tuple[float, ...] = 1.0

    def _check(self) -> None:
        if self.inner.a == self.scale:
            raise ParameterError("scale: found that of inner, expected another")


@pytest.mark.parametrize(
    "values, sentence",
    [
        ({}, "set.inner: missing, expected a value"),
        ({"inner": {}}, "set.inner.a: missing, expected the rate, Hz"),
        (
            {"inner": {"aa": 1.0}},
            (
                "set.inner.aa: unknown key, expected a perhaps, or another of a, b; "
                "set.inner.a: missing, expected the rate, Hz"
            ),
        ),
        (
            {"inner": {"a": 0}, "scale": 0},
            "set.inner.a: found 0, expected greater than 0 (and 1 more)",
        ),
        (
            {"inner": {"a": 2.0, "b": {"c": [1, 1.5]}}},
            "set.inner.b.c[1]: found 1.5, expected an integer",
        ),
        (
            {"inner": {"a": 2.0}, "scale": "1"},
            "set.scale: found '1', expected a number or a list of values",
        ),
        ({"inner": {"a": 2.0}, "scale": 2}, "set.scale: found that of inner, expected another"),
        ({"inner": {"a": 2.0}, 3: 2}, "set: found the key 3, expected a name"),
    ],
)
def test_sentence_names_key_value_and_expectation(values: dict[Any, Any], sentence: str) -> None:
    with pytest.raises(ParameterError) as refused:
        Outer.validate_mapping(values, "set")
    assert str(refused.value) == sentence


def test_set_is_frozen_and_reads_back() -> None:
    """A set is equal after a dump, and after JSON."""
    made = Outer(inner=Inner(a=2.0, b={"c": (1, 2)}))
    with pytest.raises(AttributeError, match="found an assignment"):
        made.scale = 3.0  # type: ignore[misc]
    assert Outer.validate_mapping(made.model_dump(), "set") == made
    assert Outer.model_validate_json(made.model_dump_json()) == made
    assert made.model_dump(mode="json", exclude_defaults=True) == {
        "inner": {"a": 2.0, "b": {"c": [1, 2]}}
    }
    assert made.model_copy(update={"scale": 3.0}).model_dump(exclude_unset=True)["scale"] == 3.0
    assert made.scale == 1.0
    for text in ("", "[]", "[" * 100_000, '{"inner": 1}'):
        with pytest.raises(ValueError, match=r"Outer|Expecting"):
            Outer.model_validate_json(text)


@pytest.mark.parametrize(
    "annotation",
    [Annotated[str, Field(gt=0)], Annotated[float, Field(min_length=1)], list[int], complex],
)
def test_unknown_rule_or_type_raises(annotation: Any) -> None:
    """A rule or a type that no parameter has is an error in the declaration."""
    with pytest.raises(TypeError):
        kind_of(annotation)


@pytest.mark.parametrize(
    "text, value",
    [
        ("1e-3", 1e-3),
        ("6e1", 60.0),
        ("1.0e12", 1e12),
        (".5", 0.5),
        ("-2", -2),
        ("0x1F", 31),
        ("0o17", 15),
        ("-.inf", -math.inf),
    ],
)
def test_numbers_are_those_of_yaml_1_2(text: str, value: float) -> None:
    """The expected values follow from the core schema of YAML 1.2.2, section 10.3.2."""
    read = parse_yaml(f"a: {text}", "file", "a mapping")["a"]
    assert (type(read), read) == (type(value), value)


@pytest.mark.parametrize("text", ["060", "1:00", "1e"])
def test_ambiguous_numbers_are_no_numbers(text: str) -> None:
    """YAML 1.1 reads 060 as 48 and 1:00 as 60.

    Such text stays text, so a number field refuses it.
    """
    assert parse_yaml(
        f"a: '{text}'\nb: {text if text != '-' else repr(text)}", "file", "a mapping"
    ) == {"a": text, "b": text}


@given(
    st.recursive(st.text() | st.floats(allow_nan=False) | st.integers() | st.booleans(), st.lists)
)
def test_dumped_yaml_reads_back(value: object) -> None:
    assert parse_yaml(dump_yaml({"a": value}), "file", "a mapping") == {"a": value}


@pytest.mark.parametrize("text", ["1e3", "0o17", "12e45"])
def test_text_like_a_number_is_quoted(text: str) -> None:
    assert parse_yaml(dump_yaml({"a": text}), "file", "a mapping") == {"a": text}
