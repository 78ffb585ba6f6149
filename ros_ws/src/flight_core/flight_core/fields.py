# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check the values of a parameter set by their annotations, and refuse them in sentences.

Types are strict. Only these values are converted: an int to a float, a sequence to a tuple, an
array of NumPy to lists, a scalar of NumPy to a number, a path to a str, a mapping to a parameter
set, and a key of digits to an int. The annotations are float, int, bool, str, object, Literal,
tuple, dict, unions of these, and parameter sets. Rules such as a limit come from `Field(...)` in
Annotated.
"""

import math
import operator
import os
import re
import reprlib
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from types import MappingProxyType, NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin


class _ShortRepr(reprlib.Repr):
    """repr of a value for an error sentence, with limited length."""

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


class Problems:
    """Sentences about values that are not permitted."""

    def __init__(self) -> None:
        self.unknown: list[str] = []  # a sentence for each unknown key
        # for each parameter set, the missing keys and the meaning of each
        self.missing: dict[str, dict[str, str]] = {}
        self.others: list[str] = []

    def sentences(self) -> list[str]:
        """List the sentences, beginning with sentences about unknown keys.

        A mistyped key therefore comes before the key that is missing because of the mistake.
        """
        return self.unknown + self.missing_sentences() + self.others

    def missing_sentences(self) -> list[str]:
        """Write one sentence for each set that lacks keys, with the names of all missing keys."""
        sentences = []
        for where, keys in self.missing.items():
            (name, meaning), *more = keys.items()
            if more:
                sentences.append(f"{where}: missing {', '.join(keys)}, expected a value for each")
            else:
                sentences.append(f"{where}.{name}: missing, expected {meaning}")
        return sentences

    def summary(self) -> str:
        """Return the first sentence, sentences about missing keys, and the number of the others."""
        sentences = self.sentences()
        told = list(dict.fromkeys([sentences[0], *self.missing_sentences()]))
        more = len(sentences) - len(told)
        return "; ".join(told) + (f" (and {more} more)" if more else "")

    def lack(self, where: str, name: str, meaning: str) -> None:
        """Note a key that a set lacks, with its meaning."""
        self.missing.setdefault(where, {})[name] = meaning

    def refuse(self, key: str, value: object, expected: str) -> None:
        """Add a sentence with the value that was found for a key, and what is expected."""
        self.others.append(f"{key}: found {short_repr(value)}, expected {expected}")


class Kind(NamedTuple):
    """The values that an annotation permits, and how to convert them."""

    expected: str  # words that describe the permitted values in a sentence
    takes: Callable[[Any], bool]  # whether a value has the type
    # (value of the type, key, problems) -> the value for the parameter set
    content: Callable[[Any, str, Problems], Any]
    # Tells whether all values of a list are permitted as they are. This shortcut saves time,
    # because most values of a scenario are entries of matrices.
    takes_all: Callable[[Sequence[Any]], bool] = lambda _: False

    def read(self, value: object, key: str, problems: Problems) -> Any:
        """Return a value as the parameter set holds it.

        Each value that is not permitted adds a sentence to `problems` and becomes None, also within
        a tuple or a dict.
        """
        if hasattr(value, "dtype") and hasattr(value, "tolist"):  # an array or a scalar of NumPy
            value = value.tolist()
        if self.takes(value):
            return self.content(value, key, problems)
        return problems.refuse(key, value, self.expected)


def _same(value: Any, _key: str, _problems: Problems) -> Any:
    return value


LIMITS: Mapping[str, tuple[Callable[[Any, Any], bool], str]] = MappingProxyType(
    {
        "le": (operator.le, "less than or equal to"),
        "lt": (operator.lt, "less than"),
        "gt": (operator.gt, "greater than"),
        "ge": (operator.ge, "greater than or equal to"),
    }
)
"""The comparison and the words for each kind of limit of a number."""


def _number(kind: type[float], *, allow_inf_nan: bool = False, **limits: float) -> Kind:
    """Permit an int and, if `kind` is float, a float, which is finite unless `allow_inf_nan`."""
    if unknown := limits.keys() - LIMITS.keys():
        raise TypeError(f"a number has no rule {', '.join(sorted(unknown))}")
    checks = [(*LIMITS[rule], limits[rule]) for rule in LIMITS if rule in limits]

    def content(value: Any, key: str, problems: Problems) -> Any:
        try:
            number = kind(value)
        except OverflowError:  # an int beyond the range of a float
            return problems.refuse(key, value, "a finite number")
        if kind is float and not allow_inf_nan and not math.isfinite(number):
            return problems.refuse(key, value, "a finite number")
        for holds, words, limit in checks:
            if not holds(number, limit):
                return problems.refuse(
                    key, value, f"{words} {int(limit) if limit == int(limit) else limit}"
                )
        return number

    def takes_all(values: Sequence[Any]) -> bool:
        if kind is not float or set(map(type, values)) != {float}:
            return False
        ends = (min(values), max(values))
        is_in_limits = all(holds(end, limit) for holds, _, limit in checks for end in ends)
        return is_in_limits and all(map(math.isfinite, values))

    types = (int, kind)
    expected = "an integer" if kind is int else "a number"
    return Kind(
        expected,
        lambda value: isinstance(value, types) and not isinstance(value, bool),
        content,
        takes_all,
    )


def _string(*, min_length: int = 0, pattern: str = "") -> Kind:
    def content(text: str | os.PathLike[str], key: str, problems: Problems) -> Any:
        value = os.fspath(text)
        if not value.isprintable():
            return problems.refuse(key, value, "printable characters")
        if len(value) < min_length:
            return problems.refuse(
                key, value, f"at least {min_length} character{'s' * (min_length > 1)}"
            )
        if pattern and not re.fullmatch(pattern, value):
            return problems.refuse(key, value, f"a string that matches {pattern}")
        return value

    return Kind("a string", lambda value: isinstance(value, (str, os.PathLike)), content)


def _choice(choices: Sequence[object], expected: str = "") -> Kind:
    """Permit a value that equals one of the choices and has its type. 1 is not True or 1.0."""
    words = expected or _either([repr(choice) for choice in choices])
    return Kind(
        words,
        lambda value: any(type(value) is type(choice) and value == choice for choice in choices),
        _same,
    )


def _check_count(count: int, key: str, problems: Problems, least: float, most: float) -> None:
    for fits, words, limit in (
        (count >= least, "at least", least),
        (count <= most, "at most", most),
    ):
        if not fits:
            problems.others.append(
                f"{key}: found {count} values, expected {words} {limit} value{'s' * (limit > 1)}"
            )


def _values(parts: Sequence[Any], *, min_length: float = 0, max_length: float = math.inf) -> Kind:
    """Permit a tuple of values.

    The tuple has either any number of values of one kind, or one value for each of several kinds.
    """
    is_repeated = parts[-1] is Ellipsis
    kinds = [kind_of(part) for part in parts if part is not Ellipsis]
    least, most = (min_length, max_length) if is_repeated else (len(kinds), len(kinds))

    def content(value: Sequence[Any], key: str, problems: Problems) -> tuple[Any, ...]:
        _check_count(len(value), key, problems, least, most)
        if is_repeated and value and kinds[0].takes_all(value):
            return tuple(value)
        each = zip(kinds * len(value) if is_repeated else kinds, value, strict=False)
        return tuple(
            kind.read(item, f"{key}[{i}]", problems) for i, (kind, item) in enumerate(each)
        )

    def takes(value: object) -> bool:
        # YAML and ROS give lists, not tuples
        return isinstance(value, Sequence) and not isinstance(value, (str, bytes))

    return Kind("a list of values", takes, content)


def _table(parts: Sequence[Any], *, min_length: float = 0, max_length: float = math.inf) -> Kind:
    """Permit a dict with keys of one kind and values of another."""
    keys, values = map(kind_of, parts)

    def content(value: Mapping[Any, Any], key: str, problems: Problems) -> dict[Any, Any]:
        _check_count(len(value), key, problems, min_length, max_length)
        table = {}
        for label, item in value.items():
            # JSON has only strings as keys
            is_number = (
                parts[0] is int and isinstance(label, str) and re.fullmatch(r"-?\d{1,18}", label)
            )
            name = int(label) if is_number else label
            if keys.takes(name):
                table[keys.content(name, key, problems)] = values.read(
                    item, f"{key}.{name}", problems
                )
            else:
                problems.others.append(
                    f"{key}: found the key {short_repr(name)}, expected {keys.expected}"
                )
        return table

    return Kind("a dictionary", lambda value: isinstance(value, Mapping), content)


def _group(schema: Any) -> Kind:
    """Permit a parameter set."""
    if not hasattr(schema, "model_fields"):
        raise TypeError(f"{schema} is no type of a parameter")

    def content(value: Any, key: str, problems: Problems) -> Any:
        return value if isinstance(value, schema) else schema.read(value, key, problems)

    expected = f"a dictionary or instance of {schema.__name__}"
    return Kind(expected, lambda value: isinstance(value, (schema, Mapping)), content)


def _union(kinds: Sequence[Kind]) -> Kind:
    """Permit a value of any of the kinds, and read it as the first kind that fits."""

    def content(value: Any, key: str, problems: Problems) -> Any:
        trial = Problems()
        for kind in kinds:
            if kind.takes(value):
                trial = Problems()
                converted = kind.content(value, key, trial)
                if not trial.sentences():
                    return converted
        problems.unknown += trial.unknown
        problems.missing |= trial.missing
        problems.others += trial.others
        return None

    expected = _either(
        list(dict.fromkeys(kind.expected for kind in kinds if kind.expected != "None"))
    )
    return Kind(expected, lambda value: any(kind.takes(value) for kind in kinds), content)


def _either(words: Sequence[str]) -> str:
    return " or ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


GENERIC: Mapping[Any, Callable[..., Kind]] = MappingProxyType(
    {Literal: _choice, tuple: _values, dict: _table}
)
SIMPLE: Mapping[Any, Callable[..., Kind]] = MappingProxyType(
    {
        float: lambda **rules: _number(float, **rules),
        int: lambda **rules: _number(int, **rules),
        bool: lambda: _choice((False, True), "a boolean"),
        str: _string,
        object: lambda: Kind("a value", lambda _value: True, _same),
        NoneType: lambda: _choice((None,)),
    }
)


def kind_of(annotation: Any, rules: Mapping[str, Any] = MappingProxyType({})) -> Kind:
    """Return the kind of values that an annotation permits under rules, such as gt.

    Raises TypeError for an unknown annotation or rule.
    """
    origin = get_origin(annotation)
    parts = get_args(annotation)
    if origin is Annotated:
        own_rules: dict[str, Any] = {}
        for field in parts[1:]:
            own_rules |= field.rules
        return kind_of(parts[0], own_rules | dict(rules))
    if origin in (Union, UnionType):
        return _union([kind_of(part, {} if part is NoneType else rules) for part in parts])
    if origin in GENERIC:
        return GENERIC[origin](parts, **rules)
    return SIMPLE[annotation](**rules) if annotation in SIMPLE else _group(annotation, **rules)


REQUIRED: Any = object()
"""Mark of a field that has no default."""


class FieldInfo:
    """The declaration of a field. In Annotated, only its rules are used."""

    annotation: Any = None

    def __init__(self, default: Any, description: str, rules: Mapping[str, Any]) -> None:
        self.default = default
        self.description = description
        self.rules = rules

    @cached_property
    def kind(self) -> Kind:
        """The kind of values that the field permits."""
        return kind_of(self.annotation, self.rules)


def Field(default: Any = REQUIRED, *, description: str = "", **rules: Any) -> Any:  # noqa: N802 - the name in pydantic
    """Declare the default, the meaning and the rules of a field.

    Args:
        default: Value of the field if a file leaves it out. Without a default, the field is
            required.
        description: Meaning and unit, a sentence.
        rules: gt, ge, lt, le and allow_inf_nan of a number, min_length and pattern of a string,
            min_length and max_length of a tuple and of a dict.

    Returns:
        The declaration, for the body of a parameter set such as a subclass of `ControllerConfig`.

    Examples:
        >>> rise_di.Field(2.0, description="Gain, 1/s.", gt=0).default
        2.0
    """
    return FieldInfo(default, description, rules)
