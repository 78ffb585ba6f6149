# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Writes docs/reference/parameters.md: every parameter of every node, from the classes that validate them."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from aircraft_sim.params import AircraftParameters
from autopilot_bridge.params import BridgeParameters
from flight_analysis.closed_loop.scenario import FlightParameters
from flight_core.parameters import ParameterError, Parameters
from flight_recorder.params import RecorderParameters
from guidance.params import GuidanceParameters
from reference_model.params import ReferenceModelParameters
from rise_di_controller import laws
from rise_di_controller.params import ControllerParameters

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reference" / "parameters.md"
LEAD = """# Parameters

Every parameter of a scenario file, by section. SI and radians, if nothing else is said. A key that is not here is refused. The
page is made from the classes that validate a scenario: `python -m tools.parameters`.
"""
SECTIONS: Mapping[str, type[Parameters]] = {
    "flight": FlightParameters,
    "aircraft": AircraftParameters,
    "reference_model": ReferenceModelParameters,
    "guidance": GuidanceParameters,
    "controller": ControllerParameters,
    "bridge": BridgeParameters,
    "recorder": RecorderParameters,
}


def page() -> str:
    """The text of the page."""
    parts = [LEAD, *(_section(f"`{name}`", schema) for name, schema in SECTIONS.items())]
    for name in laws.names():
        try:
            schema = laws.schema(name)
        except ParameterError:  # a law that needs the full state cannot be flown over topics
            continue
        parts.append(_section(f"`controller` with `law: {name}`", schema, set(ControllerParameters.model_fields)))
    return "\n".join(parts)


def _section(title: str, schema: type[Parameters], known: set[str] = frozenset()) -> str:  # type: ignore[assignment]
    content = schema.model_json_schema()
    rows = [
        f"| `{key}` | {kind} | {default} | {bounds} | {text} |"
        for key, kind, default, bounds, text in _rows(content, content.get("$defs", {}))
        if key.split(".")[0] not in known
    ]
    head = ["| parameter | type | default | bounds | meaning |", "|---|---|---|---|---|"]
    return "\n".join([f"## {title}", "", *head, *rows, ""])


def _rows(schema: Mapping[str, Any], definitions: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, ...]]:
    """Key, type, default, bounds and meaning of each parameter of an object; those of a group under a dotted key."""
    required = schema.get("required", [])
    for name, given in schema.get("properties", {}).items():
        one = _resolved(given, definitions)
        default = "required" if name in required else _value(given.get("default"))
        group = one if "properties" in one else _resolved(one.get("additionalProperties") or {}, definitions)
        key = f"{prefix}{name}"
        if "properties" in group:
            below = key if group is one else f"{key}.NAME"
            yield key, "group", "" if group is one else "none", "", _text(given, one)
            yield from _rows(group, definitions, f"{below}.")
        else:
            yield key, _type(one), default, _bounds(one.get("items") or one), _text(given, one)


def _resolved(schema: Mapping[str, Any], definitions: Mapping[str, Any]) -> Mapping[str, Any]:
    """A schema without its reference, and without the alternative null."""
    if "anyOf" in schema:
        chosen = next(one for one in schema["anyOf"] if one.get("type") != "null")
        return _resolved(chosen, definitions)
    if "$ref" in schema:
        return dict(definitions[schema["$ref"].rsplit("/", 1)[-1]])
    return schema


def _type(schema: Mapping[str, Any]) -> str:
    if "enum" in schema or "const" in schema:
        return ", ".join(f"`{one}`" for one in schema.get("enum", [schema.get("const")]))
    if schema.get("type") == "array":
        return f"list of {_type(schema.get('items') or (schema.get('prefixItems') or [{}])[0])}"
    return str(schema.get("type", "any"))


def _bounds(schema: Mapping[str, Any]) -> str:
    signs = {"exclusiveMinimum": ">", "minimum": ">=", "exclusiveMaximum": "<", "maximum": "<="}
    return ", ".join(f"{sign} {schema[name]:g}" for name, sign in signs.items() if name in schema)


def _value(default: object) -> str:
    return "none" if default in (None, "", [], {}) else f"`{str(default).lower() if isinstance(default, bool) else default}`"


def _text(*schemas: Mapping[str, Any]) -> str:
    return next((" ".join(one["description"].split()).replace("|", "\\|") for one in schemas if "description" in one), "")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
