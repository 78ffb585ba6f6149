# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Writes docs/reference/parameters.md: every parameter of every node, from the classes that validate them."""

from collections.abc import Iterator, Mapping, Set
from pathlib import Path
from types import MappingProxyType, NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from aircraft_sim.params import AircraftConfig
from autopilot_bridge.params import BridgeConfig
from flight_analysis.closed_loop.scenario import FlightConfig
from flight_core.fields import REQUIRED
from flight_core.parameters import Config, ParameterError
from flight_guidance.params import GuidanceConfig
from flight_recorder.params import RecorderConfig
from reference_model.params import ReferenceModelConfig
from rise_di_controller import laws
from rise_di_controller.params import ControllerConfig

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reference" / "parameters.md"
LEAD = """# Parameters

Every parameter of a scenario file, by section, and of the node `bridge`, which has no section: `-p` sets its parameters.
SI and radians, if nothing else is said. A key that is not here is refused. The page is made from the classes that validate a
scenario: `python -m tools.parameters`.
"""
SECTIONS: Mapping[str, type[Config]] = {
    "flight": FlightConfig,
    "aircraft": AircraftConfig,
    "reference_model": ReferenceModelConfig,
    "guidance": GuidanceConfig,
    "controller": ControllerConfig,
    "bridge": BridgeConfig,
    "recorder": RecorderConfig,
}
TYPES = {float: "number", int: "integer", str: "string", bool: "boolean", dict: "object", object: "any"}


def page() -> str:
    """The text of the page."""
    parts = [LEAD, *(_section(f"`{name}`", schema) for name, schema in SECTIONS.items())]
    for name in laws.names():
        try:
            schema = laws.schema(name)
        except ParameterError:  # a law that needs the full state cannot be flown over topics
            continue
        parts.append(_section(f"`controller` with `law: {name}`", schema, set(ControllerConfig.model_fields)))
    return "\n".join(parts)


def _section(title: str, schema: type[Config], known: Set[str] = frozenset()) -> str:
    rows = [
        f"| `{key}` | {kind} | {default} | {bounds} | {text} |"
        for key, kind, default, bounds, text in _rows(schema)
        if key.split(".")[0] not in known
    ]
    head = ["| parameter | type | default | bounds | meaning |", "|---|---|---|---|---|"]
    return "\n".join([f"## {title}", "", *head, *rows, ""])


def _rows(schema: type[Config], prefix: str = "") -> Iterator[tuple[str, ...]]:
    """Key, type, default, bounds and meaning of each parameter of a set; those of a group under a dotted key."""
    for name, field in schema.model_fields.items():
        one, rules = _resolved(field.annotation, field.rules)
        named = get_origin(one) is dict
        group = _resolved(get_args(one)[1])[0] if named else one
        key = f"{prefix}{name}"
        if isinstance(group, type) and issubclass(group, Config):
            meaning = field.description or ("" if named else group.__doc__ or "")
            yield key, "group", "none" if named else "", "", _text(meaning)
            yield from _rows(group, f"{key}.NAME." if named else f"{key}.")
        else:
            default = "required" if field.default is REQUIRED else _value(field.default)
            item_rules = _resolved(get_args(one)[0])[1] if get_origin(one) is tuple else rules
            yield key, _type(one), default, _bounds(item_rules), _text(field.description)


def _resolved(annotation: Any, rules: Mapping[str, Any] = MappingProxyType({})) -> tuple[Any, Mapping[str, Any]]:
    """A type without its rules and without the alternative None, and the rules."""
    if get_origin(annotation) is Annotated:
        inner, *outer = get_args(annotation)
        return _resolved(inner, {rule: limit for field in outer for rule, limit in field.rules.items()} | dict(rules))
    if get_origin(annotation) in (Union, UnionType):
        return _resolved(next(alternative for alternative in get_args(annotation) if alternative is not NoneType), rules)
    return annotation, rules


def _type(annotation: Any) -> str:
    if get_origin(annotation) is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(annotation))
    if get_origin(annotation) is tuple:
        return f"list of {_type(_resolved(get_args(annotation)[0])[0])}"
    return TYPES[get_origin(annotation) or annotation]


def _bounds(rules: Mapping[str, Any]) -> str:
    signs = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
    shown = signs if "ge" not in rules else {name: sign for name, sign in signs.items() if name != "gt"}
    return ", ".join(f"{sign} {rules[name]:g}" for name, sign in shown.items() if name in rules)


def _value(default: object) -> str:
    if default in (None, "", (), {}):
        return "none"
    return (
        f"`{list(default) if isinstance(default, tuple) else str(default).lower() if isinstance(default, bool) else default}`"
    )


def _text(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
