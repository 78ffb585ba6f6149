# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Validated parameter sets: one declaration for each set, one sentence for each error.

A set is a frozen pydantic model. `validate_mapping` builds it from the nested mapping that a scenario file or a ROS node
holds. The first value that does not fit becomes a `ParameterError` of one sentence: the key, what was found, what is expected.
"""

import difflib
import reprlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

MAX_SENTENCE_LENGTH = 1000  # characters of an error sentence, however long the bad input is


def printable(text: str) -> str:
    """A text with unprintable characters, such as line ends and terminal control codes, written as escapes."""
    return "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in text)


class ParameterError(ValueError):
    """An invalid parameter or parameter set. The message is one sentence for the user.

    Unprintable characters are written as escapes; the middle of a long sentence is left out.
    """

    def __init__(self, sentence: str) -> None:
        if len(sentence) > MAX_SENTENCE_LENGTH:
            sentence = f"{sentence[: MAX_SENTENCE_LENGTH // 2]} ... {sentence[5 - MAX_SENTENCE_LENGTH // 2 :]}"
        super().__init__(printable(sentence))


class _ShortRepr(reprlib.Repr):
    """repr of a value for an error sentence, of limited length."""

    def __init__(self) -> None:
        super().__init__()
        self.maxstring = self.maxother = self.maxlong = 120

    def repr_int(self, value: int, level: int) -> str:
        try:
            return super().repr_int(value, level)
        except ValueError:  # Python converts at most 4300 digits
            return f"a number of {value.bit_length()} bits"


short_repr = _ShortRepr().repr
"""repr of a value of any size, for an error sentence."""


class Parameters(BaseModel):
    """Base of every parameter set: frozen, finite, strictly typed (an int is accepted as a float), without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @classmethod
    def validate_mapping(cls, values: Mapping[str, Any], where: str) -> Self:
        """Build the set from a nested mapping; `where` is its name in errors, e.g. "controller".

        Raises ParameterError with one sentence for the first key that does not fit.
        """
        try:
            return cls.model_validate(dict(values))
        except ValidationError as error:
            # A mistyped key is reported before the key that is missing because of it.
            first, *others = sorted(error.errors(), key=lambda one: one["type"] not in {"extra_forbidden", "invalid_key"})
            more = f" (and {len(others)} more)" if others else ""
            raise ParameterError(_sentence(cls, where, first) + more) from None
        except ArithmeticError as error:  # of a check that computes with several keys
            found = f"numbers too large or too small ({error.args[-1]})"
            raise ParameterError(f"{where}: found {found}, expected those of a flight") from None


class NodeParameters(Parameters):
    """Base of the parameters of a node of a flight."""

    lockstep: bool = Field(default=False, description="run in lockstep with the other nodes, as fast as possible")

    @classmethod
    def tunable(cls) -> frozenset[str]:
        """Parameters that may change in flight: dotted names, or names of groups of which all members may."""
        return frozenset()


class KeyedParameters(NodeParameters):
    """Base of the parameters of a node whose messages can carry a message authentication code."""

    key_file: str = Field(
        default="", description="file of the key of the message authentication codes (flight_core.authentication); empty: none"
    )


def as_tuple(value: object) -> object:
    """A sequence other than a string as a tuple; any other value unchanged, for the next validator to reject."""
    return tuple(value) if isinstance(value, Sequence) and not isinstance(value, str) else value


# Sequences of a YAML file or a ROS parameter arrive as lists; a frozen set keeps tuples.
Numbers = Annotated[tuple[float, ...], Field(min_length=1), BeforeValidator(as_tuple)]
Positives = Annotated[tuple[Annotated[float, Field(gt=0)], ...], Field(min_length=1), BeforeValidator(as_tuple)]
NonNegatives = Annotated[tuple[Annotated[float, Field(ge=0)], ...], Field(min_length=1), BeforeValidator(as_tuple)]
Names = Annotated[tuple[str, ...], Field(min_length=1), BeforeValidator(as_tuple)]
Signs = Annotated[tuple[int, ...], Field(min_length=1), BeforeValidator(as_tuple)]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]


def require(condition: bool, key: str, found: object, expected: str) -> None:
    """Raise ParameterError naming `key`, what was found and what is expected, unless the condition holds."""
    if not condition:
        raise ParameterError(f"{key}: found {found}, expected {expected}")


def require_length(key: str, values: Sequence[object], names: Sequence[str]) -> None:
    """Raise ParameterError unless there is one value for each named channel."""
    require(len(values) == len(names), key, f"{len(values)} values", f"{len(names)}, one for each of {', '.join(names)}")


def flatten(mapping: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Nested mapping -> (dotted name, value) pairs, the parameter names of ROS 2; None values are left out."""
    for key, value in mapping.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f"{prefix}{key}.")
        elif value is not None:
            yield prefix + key, value


def nest(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted names -> nested mapping, the inverse of `flatten`. Raises ParameterError for a name with both value and group."""
    tree: dict[str, Any] = {}
    for name, value in flat.items():
        *groups, leaf = name.split(".")
        node = tree
        for group in groups:
            node = node.setdefault(group, {})
            require(isinstance(node, dict), name, "both a value and a group", "one of the two")
        require(leaf not in node, name, "both a value and a group", "one of the two")
        node[leaf] = value
    return tree


def _sentence(cls: type[BaseModel], where: str, error: Any) -> str:
    location, kind, found = error["loc"], error["type"], error["input"]
    if kind == "invalid_key" or location[-1:] == ("[key]",):
        key = ".".join([where, *map(str, location[: -1 if kind == "invalid_key" else -2])])
        return f"{key}: found the key {short_repr(found)}, expected a name"
    key = where + "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location)
    if kind == "extra_forbidden":
        known = sorted(_fields_at(cls, location[:-1]))
        near = difflib.get_close_matches(str(location[-1]), known, n=1)
        return f"{key}: unknown key, expected {f'{near[0]} perhaps, or another' if near else 'one'} of {', '.join(known)}"
    if kind == "missing":
        field = _fields_at(cls, location[:-1]).get(str(location[-1]))
        meaning = field.description if field is not None and field.description else "a value"
        return f"{key}: missing, expected {meaning}"
    if kind == "value_error":
        return f"{key}.{error['ctx']['error']}"  # `require` raised it, with the rest of the key and the sentence
    if kind == "too_short":
        least = error["ctx"]["min_length"]
        return f"{key}: found {error['ctx']['actual_length']} values, expected at least {least} value{'s' * (least > 1)}"
    expected = (
        "a list of values" if kind == "tuple_type" else error["msg"].removeprefix("Input should be ").replace("a valid ", "a ")
    )
    return f"{key}: found {short_repr(found)}, expected {expected}"


def _fields_at(cls: type[BaseModel], location: Sequence[str | int]) -> dict[str, Any]:
    model: Any = cls
    for part in location:
        if not (isinstance(model, type) and issubclass(model, BaseModel)):
            return {}
        annotation = model.model_fields[str(part)].annotation if str(part) in model.model_fields else None
        candidates = [annotation, *getattr(annotation, "__args__", ())]
        model = next((c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)), None)
    return dict(model.model_fields) if isinstance(model, type) and issubclass(model, BaseModel) else {}
