# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check that a computation knows every key of a parameter set that is not at its default.

Some functions compute a flight without the code of the nodes. Each of them states which keys it
takes into account. `require_known` refuses every other key whose value is not the default. So if a
new key is declared, such a function refuses it until the key is added to the function's set.

A key is a dotted name, such as `actuators.lag`. If sections are given by name in a mapping, they
share their keys. For example, the `start` of every gust is `gusts.*.start`.
"""

from collections.abc import Iterator, Mapping, Set
from typing import Any, NamedTuple, get_args

from flight_core.fields import REQUIRED, short_repr
from flight_core.parameters import Config, ParameterError

ANY = "*"  # stands for any name in a mapping of sections
A_SECTION = "a section"  # value of the key of a section that is left out by default


class SetKey(NamedTuple):
    """A key whose value is not the default."""

    key: str  # the key as in the set of known keys, such as gusts.*.start
    name: str  # the key as in the file, such as gusts.vertical.start
    value: Any
    default: Any = None


def keys_of(schema: type[Config]) -> frozenset[str]:
    """Return every key of a parameter set, including the keys of its sections."""
    return frozenset(_keys(schema, ""))


def _keys(schema: type[Config], prefix: str) -> Iterator[str]:
    for name, field in schema.model_fields.items():
        section, is_by_name = _section(field.annotation)
        key = prefix + name
        if section is None:
            yield key
        else:
            yield from _keys(section, f"{key}.{ANY}." if is_by_name else f"{key}.")


def _section(annotation: Any) -> tuple[type[Config] | None, bool]:
    """Return the parameter set in an annotation, and whether it is the value type of a mapping."""
    if isinstance(annotation, type) and issubclass(annotation, Config):
        return annotation, False
    parts = get_args(annotation)
    for part in parts:
        section, is_by_name = _section(part)
        if section is not None:
            return section, is_by_name or getattr(annotation, "__origin__", None) is dict
    return None, False


def set_keys(parameters: Config) -> Iterator[SetKey]:
    """Yield the keys whose value is not their default.

    If the default is the empty list, a list of zeros is taken as the default, too, because both
    mean that there is no value. Some sections are absent by default. If such a section is given,
    but all of its keys have their defaults, the section itself is the key.
    """
    return _set_keys(parameters, "", "")


def _set_keys(parameters: Config, key: str, name: str) -> Iterator[SetKey]:
    for field_name, field in parameters.model_fields.items():
        value = getattr(parameters, field_name)
        own_key, own_name = key + field_name, name + field_name
        if isinstance(value, Config):
            own = list(_set_keys(value, f"{own_key}.", f"{own_name}."))
            if field.default is None and not own:
                own = [SetKey(own_key, own_name, A_SECTION)]
            yield from own
        elif isinstance(value, Mapping) and _section(field.annotation)[0] is not None:
            for each, section in value.items():
                yield from _set_keys(section, f"{own_key}.{ANY}.", f"{own_name}.{each}.")
        elif field.default is REQUIRED or not _is_default(value, field.default):
            yield SetKey(own_key, own_name, value, field.default)


def _is_default(value: Any, default: Any) -> bool:
    is_nothing = default == () and isinstance(value, tuple)
    return bool(value == default) or (is_nothing and all(part == 0.0 for part in value))


def unknown_keys(parameters: Config, known: Set[str]) -> list[SetKey]:
    """Return the keys outside `known` whose value is not their default.

    If a section is left out by default and none of its keys is known, the result has the section
    instead of its keys.
    """
    sections: dict[str, SetKey] = {}
    for each in set_keys(parameters):
        if each.key not in known and not (
            each.value is A_SECTION and _has_known_key(each.key, known)
        ):
            shown = _outermost(parameters, each, known)
            sections.setdefault(shown.name, shown)
    return list(sections.values())


def _outermost(parameters: Config, found: SetKey, known: Set[str]) -> SetKey:
    """Return the largest optional section around a key that has no known key.

    Returns the key itself if there is no such section.
    """
    keys, names = found.key.split("."), found.name.split(".")
    schema: type[Config] | None = type(parameters)
    for depth in range(1, len(keys)):
        if schema is None:
            break
        field = schema.model_fields.get(keys[depth - 1])
        if field is None:  # the name of a section of a mapping
            continue
        key = ".".join(keys[:depth])
        if field.default is None and not _has_known_key(key, known):
            return SetKey(key, ".".join(names[:depth]), A_SECTION)
        schema = _section(field.annotation)[0]
    return found


def _has_known_key(section: str, known: Set[str]) -> bool:
    """Return whether any key of a section is known."""
    return any(key.startswith(f"{section}.") for key in known)


def require_known(parameters: Config, known: Set[str], section: str, why: str) -> None:
    """Raise ParameterError for a key outside `known` whose value is not the default.

    Args:
        parameters: The parameter set.
        known: The keys that are known, as `keys_of` names them.
        section: The name of the set in a scenario, for the error message.
        why: A text on who does not know the key, for the error message.

    Raises:
        ParameterError: A key outside `known` has a value that is not the default.
    """
    for unknown in unknown_keys(parameters, known):
        found = unknown.value if unknown.value is A_SECTION else short_repr(unknown.value)
        is_none = unknown.default in (None, (), {}) or unknown.default is REQUIRED
        expected = "none" if is_none else short_repr(unknown.default)
        raise ParameterError(f"{section}.{unknown.name}: found {found}, expected {expected}: {why}")
