# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Validate parameter sets that are declared once, with one sentence for each error.

A set is a frozen class of annotated fields. `validate_mapping` builds it from the nested mapping of
a scenario file or of a ROS node. The first value that is not permitted raises a `ParameterError`.
Its message is a sentence with the key, what was found, and what is expected.

Declarations and methods have the names of pydantic 2. The stack does not use pydantic itself.
Ubuntu 24.04 has release 1.10, with a different interface and no strict types. With pydantic 2 the
parameters of a node took twice as long to import.
"""

import difflib
import inspect
import json
from collections.abc import Iterator, Mapping, Sequence, Set
from typing import Annotated, Any, ClassVar, Literal, Self, dataclass_transform, get_origin

from flight_core.fields import REQUIRED, Field, FieldInfo, Problems, short_repr
from flight_core.text import bounded


class ParameterError(ValueError):
    """An invalid parameter or parameter set.

    The message is one sentence for the user, which is printable and of limited length.

    Args: sentence: The key, the value that was found, and the expected value.

    Examples:
        >>> rise_di.find_scenario("osprey_servo", duration=-1.0)
        Traceback (most recent call last):
        flight_core.parameters.ParameterError: flight.duration: ...
    """

    def __init__(self, sentence: str) -> None:
        super().__init__(bounded(sentence))


@dataclass_transform(kw_only_default=True, frozen_default=True, field_specifiers=(Field,))
class Config:
    """Base of every parameter set, which is frozen, finite and strictly typed.

    A set has no unknown keys. An int is accepted as a float.
    """

    model_fields: ClassVar[dict[str, FieldInfo]] = {}
    """Fields by name, beginning with the fields of base classes."""

    def __init_subclass__(cls) -> None:
        new_fields = {}
        for name, annotation in inspect.get_annotations(cls).items():
            origin: Any = get_origin(annotation)
            if origin is not ClassVar:
                default = vars(cls).get(name, REQUIRED)
                new_fields[name] = field = (
                    default if isinstance(default, FieldInfo) else Field(default)
                )
                field.annotation = annotation
                if default is not REQUIRED:
                    delattr(cls, name)
        bases = (
            base.model_fields for base in reversed(cls.__mro__[1:]) if issubclass(base, Config)
        )
        cls.model_fields = {}
        for fields in (*bases, new_fields):
            cls.model_fields |= fields

    def __init__(self, **values: Any) -> None:
        vars(self).update(vars(type(self).validate_mapping(values, type(self).__name__)))

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(
            f"{type(self).__name__}.{name}: found an assignment, expected none to a parameter set"
        )

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and all(
            getattr(self, name) == getattr(other, name) for name in self.model_fields
        )

    def __hash__(self) -> int:
        return hash(tuple(getattr(self, name) for name in self.model_fields))

    def __repr__(self) -> str:
        fields = ", ".join(f"{name}={getattr(self, name)!r}" for name in self.model_fields)
        return f"{type(self).__name__}({fields})"

    @classmethod
    def validate_mapping(cls, values: Mapping[str, Any], where: str, *, check: bool = True) -> Self:
        """Build the set from a nested mapping.

        `where`, such as "controller", names the set in errors. If `check` is False, the caller must
        check the relations between the values of the set. Raises ParameterError with a sentence for
        the first key that is not permitted, and for every missing key.
        """
        problems = Problems()
        try:
            parameters = cls.read(values, where, problems, check=check)
        except ArithmeticError as error:  # a check of several keys together overflowed
            numbers = f"numbers too large or too small ({error.args[-1]})"
            raise ParameterError(
                f"{where}: found {numbers}, expected numbers of a flight"
            ) from None
        if parameters is None:
            raise ParameterError(problems.summary())
        return parameters

    @classmethod
    def read(
        cls, values: Mapping[Any, Any], key: str, problems: Problems, *, check: bool = True
    ) -> Self | None:
        """Build the set from a nested mapping.

        Returns None and adds a sentence to `problems` if a value is not permitted.
        """
        count_before = len(problems.sentences())
        content = {}
        for name, field in cls.model_fields.items():
            if name in values:
                content[name] = field.kind.read(values[name], f"{key}.{name}", problems)
            elif field.default is REQUIRED:
                problems.lack(key, name, field.description or "a value")
            else:
                content[name] = (
                    dict(field.default) if isinstance(field.default, dict) else field.default
                )
        for name in values:
            if not isinstance(name, str):
                problems.unknown.append(f"{key}: found the key {short_repr(name)}, expected a name")
            elif name not in cls.model_fields:
                problems.unknown.append(
                    f"{key}.{name}: unknown key, expected {one_of(sorted(cls.model_fields), name)}"
                )
        if len(problems.sentences()) > count_before:
            return None
        parameters = cls.__new__(cls)
        vars(parameters).update(content, _given=frozenset(values))
        try:
            if check:
                parameters._check()
        except ValueError as error:  # its message begins with the key inside this set
            problems.others.append(f"{key}.{error}")
            return None
        return parameters

    @classmethod
    def keys_beside(cls, values: Mapping[str, Any]) -> Set[str]:
        """Return all keys that a set with these values may have."""
        return cls.model_fields.keys()

    def changed(self, changes: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values with changes by dotted name, without validation.

        The value None removes a parameter. Raises ParameterError if a name is both a value and a
        group.
        """
        flat = dict(flatten(self.model_dump()))
        for name in changes:
            flat = {
                key: value
                for key, value in flat.items()
                if key != name and not key.startswith(name + ".")
            }
        return nest(flat | dict(changes))

    def _check(self) -> None:
        """Check relations between the values. Raises ParameterError if they do not hold."""

    def model_copy(self, *, update: Mapping[str, Any]) -> Self:
        """Copy the set with new values, without a check of the values."""
        copy = type(self).__new__(type(self))
        values = {name: getattr(self, name) for name in self.model_fields}
        vars(copy).update(values | dict(update), _given=vars(self)["_given"] | update.keys())
        return copy

    def model_dump(
        self,
        *,
        mode: Literal["python", "json"] = "python",
        exclude: Set[str] = frozenset(),
        exclude_none: bool = False,
        exclude_defaults: bool = False,
        exclude_unset: bool = False,
    ) -> dict[str, Any]:
        """Return the set as nested dicts, with lists in place of tuples in mode json.

        `exclude` names fields of this set only, not of sets nested in it.
        """

        def plain(value: Any) -> Any:
            if isinstance(value, Config):
                return value.model_dump(
                    mode=mode,
                    exclude_none=exclude_none,
                    exclude_defaults=exclude_defaults,
                    exclude_unset=exclude_unset,
                )
            if isinstance(value, dict):
                return {name: plain(item) for name, item in value.items()}
            if isinstance(value, (tuple, list)):
                return (list if mode == "json" else type(value))(map(plain, value))
            return value

        tree = {}
        for name, field in self.model_fields.items():
            value = getattr(self, name)
            is_excluded = (
                name in exclude
                or (exclude_none and value is None)
                or (exclude_defaults and value == field.default)
                or (exclude_unset and name not in vars(self)["_given"])
            )
            if not is_excluded:
                tree[name] = plain(value)
        return tree

    def model_dump_json(self, *, indent: int | None = None) -> str:
        """Write the set as JSON."""
        separators = (",", ":") if indent is None else None
        return json.dumps(
            self.model_dump(mode="json"), indent=indent, separators=separators, ensure_ascii=False
        )

    @classmethod
    def model_validate_json(cls, text: str) -> Self:
        """Build the set from JSON.

        Raises ParameterError if a value is not permitted, and ValueError if the text is not JSON.
        """
        try:
            values = json.loads(text)
        except RecursionError:
            raise ParameterError(
                f"{cls.__name__}: found JSON that is nested too deeply, expected an object"
            ) from None
        require(isinstance(values, dict), cls.__name__, short_repr(values), "an object")
        return cls.validate_mapping(values, cls.__name__)


class NodeConfig(Config):
    """Base of the parameters of a node of a flight."""

    lockstep: bool = Field(
        default=False, description="run in lockstep with the other nodes, as fast as possible"
    )

    @classmethod
    def tunable(cls) -> frozenset[str]:
        """Return the parameters that can change in flight, as dotted names or names of groups."""
        return frozenset()

    @classmethod
    def changed_by_node(cls) -> frozenset[str]:
        """Return the groups of parameters that only the node itself can change in flight."""
        return frozenset()


SMALLEST = 1e-9
LARGEST = 1e9
"""Bounds of the magnitude of a quantity in SI units. A value beyond them is a mistake in units, and
makes products and quotients of the law overflow."""
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[float, Field(gt=0, ge=SMALLEST, le=LARGEST)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]
RATES = (1, 1000)
"""The lowest and the highest rate of a node, Hz. benchmarks/speed.py measures nodes up to the
highest."""
Rate = Annotated[float, Field(ge=RATES[0], le=RATES[1])]
RateOrZero = Annotated[float, Field(ge=0, le=RATES[1])]
"""Type of a rate that not every flight has; 0 stands for none."""
Numbers = Annotated[tuple[Number, ...], Field(min_length=1)]
Positives = Annotated[tuple[Positive, ...], Field(min_length=1)]
"""Type of a parameter: a list of at least one number, each above 0."""
NonNegatives = Annotated[tuple[NonNegative, ...], Field(min_length=1)]
"""Type of a parameter: a list of at least one number, each 0 or more."""
Name = Annotated[str, Field(pattern=r"[A-Za-z][A-Za-z0-9_.]*")]
"""Type of the name of a channel, a state or an input. A name goes unchanged into C code, pages and
files of other programs."""
Names = Annotated[tuple[Name, ...], Field(min_length=1)]
Signs = Annotated[tuple[Literal[1, -1], ...], Field(min_length=1)]


def require(condition: bool, key: str, actual: object, expected: str) -> None:
    """Raise ParameterError if the condition does not hold.

    The message names `key`, what was found and what is expected.
    """
    if not condition:
        raise ParameterError(f"{key}: found {actual}, expected {expected}")


def one_of(known: Sequence[str], name: str) -> str:
    """Return a text that lists the known names, with the one most similar to `name` first."""
    near = difflib.get_close_matches(name, known, n=1)
    return (
        f"{near[0]} perhaps, or another of {', '.join(known)}"
        if near
        else f"one of {', '.join(known)}"
    )


def require_length(key: str, values: Sequence[object], names: Sequence[str]) -> None:
    """Raise ParameterError if the number of values is not the number of channels.

    Args:
        key: Name of the parameter, for the error message.
        values: Values of the parameter.
        names: Names of the channels.

    Raises:
        ParameterError: The numbers differ.

    Examples:
        >>> rise_di.require_length("gain", [1.0, 2.0], ["q", "V"])
    """
    require(
        len(values) == len(names),
        key,
        f"{len(values)} values",
        f"{len(names)}, one for each of {', '.join(names)}",
    )


def require_distinct(key: str, names: Sequence[str]) -> None:
    """Raise ParameterError if a name is given twice."""
    require(len(set(names)) == len(names), key, ", ".join(names), "different names")


def require_channels(key: str, names: Sequence[str], expected: Sequence[str], owner: str) -> None:
    """Raise ParameterError if the names are not the channels of `owner`, in any order."""
    require(
        sorted(names) == sorted(expected),
        key,
        ", ".join(names),
        f"{owner} in any order: {', '.join(expected)}",
    )


def flatten(mapping: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the pairs (dotted name, value) of a nested mapping.

    Dotted names are the names of parameters in ROS 2. Values that are None are left out.
    """
    for key, value in mapping.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f"{prefix}{key}.")
        elif value is not None:
            yield prefix + key, value


def nest(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Build a nested mapping from dotted names, the inverse of `flatten`.

    Raises ParameterError if a name belongs to both a value and a group.
    """
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
