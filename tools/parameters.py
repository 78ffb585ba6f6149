# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write docs/reference/parameters.md, which has every parameter of every node.

Names, types, bounds and meanings come from the classes that validate the parameters.
"""

from collections.abc import Iterator, Mapping, Set
from pathlib import Path
from types import MappingProxyType, NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from aircraft_sim.params import AircraftConfig
from autopilot_bridge.params import BridgeConfig
from flight_analysis.closed_loop.scenario import FlightConfig
from flight_core.fields import REQUIRED
from flight_core.parameters import SMALLEST, Config, ParameterError
from flight_guidance.params import GuidanceConfig
from flight_recorder.params import RecorderConfig
from reference_model.params import ReferenceModelConfig
from rise_di_controller import laws
from rise_di_controller.params import ControllerConfig

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reference" / "parameters.md"
LEAD = """# Parameters

For you if you write or change a scenario file: every key, by section. [Get started](../get-started.md) has those that you meet first. Two sections
of a file:

```yaml
/**/flight: {ros__parameters: {duration: 60.0}}
/**/aircraft: {ros__parameters: {airframe: osprey, rate: 500.0, step: 0.002, sensors: {noise: [0.0017, 0.03, 0.0017, 0.0017]}}}
```

Units are SI and radians. If no type is named, a value is a number. `= 0.2` is a default. A key is required if it has neither a default nor the word
*optional*. A list has one entry for each channel. NAME stands for a name of your own. No number may be above 1e9, and no time limit above 1e6 s. The
instant `.inf` means never. What stands behind `none:` holds if you leave the key out.

If you leave out an optional key of `guidance`, it follows a [rule](guidance.md#numbers-by-rule). `examples/scenarios/` has examples of the rarer keys.
The node `bridge` has no section; set its keys by `-p`. `python -m tools.parameters` writes this page.
"""  # noqa: E501 - a text as it is written
SHARED = {
    "lockstep": "run in lockstep with the other nodes",
    "start_time": "system time of t = 0, s; 0: at once; -1: when the topic `start` says so",
}
"""Keys that several nodes have, and that `rise-di fly` and the launch files set."""
UNBOUNDED = 1e6
"""Smallest bound that the page states once for all keys, and not beside each key."""
SECTIONS: Mapping[str, type[Config]] = {
    "flight": FlightConfig,
    "aircraft": AircraftConfig,
    "reference_model": ReferenceModelConfig,
    "guidance": GuidanceConfig,
    "controller": ControllerConfig,
    "bridge": BridgeConfig,
    "recorder": RecorderConfig,
}
TYPES = {
    float: "number",
    int: "integer",
    str: "string",
    bool: "boolean",
    dict: "numbers by channel",
    object: "any",
}
HEAD = ("| parameter | value | meaning |", "|---|---|---|")


def page() -> str:
    """Return the text of docs/reference/parameters.md."""
    keys = {key: value for key, value, _ in _rows(AircraftConfig)}
    parts = [LEAD, "## Keys of several sections", "", *HEAD]
    parts += [f"| `{key}` | {keys[key]} | {text} |" for key, text in SHARED.items()]
    parts += [""]
    parts += [_section(f"`{name}`", schema) for name, schema in SECTIONS.items()]
    for name in laws.names():
        try:
            schema = laws.schema(name)
        except ParameterError:  # a law that needs the full state cannot fly over topics
            continue
        parts.append(
            _section(f"`controller` with `law: {name}`", schema, set(ControllerConfig.model_fields))
        )
    return "\n".join(parts)


def _section(title: str, schema: type[Config], known: Set[str] = frozenset()) -> str:
    rows = [
        f"| `{key}` | {value} | {text} |"
        for key, value, text in _rows(schema)
        if key.split(".")[0] not in {*known, *SHARED}
    ]
    return "\n".join([f"## {title}", "", *((*HEAD, *rows) if rows else ("No further keys.",)), ""])


def _rows(schema: type[Config], prefix: str = "") -> Iterator[tuple[str, str, str]]:
    """Yield key, permitted value and meaning of each parameter of a set.

    A parameter of a group has a dotted key. If several groups have the same class, its parameters
    come under the first of them, and the others refer to it.
    """
    places: dict[type[Config], str] = {}
    for name, field in schema.model_fields.items():
        annotation, rules = _resolved(field.annotation, field.rules)
        is_table = get_origin(annotation) is dict
        group = _resolved(get_args(annotation)[1])[0] if is_table else annotation
        key = f"{prefix}{name}"
        if isinstance(group, type) and issubclass(group, Config):
            meaning = _text(field.description or ("" if is_table else group.__doc__ or ""))
            like = places.setdefault(group, key)
            yield (
                key,
                "groups" if is_table else "group",
                meaning if like == key else f"{meaning}; keys as in `{like}`",
            )
            if like == key:
                yield from _rows(group, f"{key}.NAME." if is_table else f"{key}.")
        else:
            item_rules = (
                _resolved(get_args(annotation)[0])[1] if get_origin(annotation) is tuple else rules
            )
            parts = [
                part
                for part in (_type(annotation), _bounds(item_rules), _value(field.default))
                if part
            ]
            yield (
                key,
                " ".join(parts[1:] if parts[0] == TYPES[float] and parts[1:] else parts),
                _text(field.description),
            )


def _resolved(
    annotation: Any, rules: Mapping[str, Any] = MappingProxyType({})
) -> tuple[Any, Mapping[str, Any]]:
    """Return the type in an annotation, without the alternative None, and constraints by name."""
    if get_origin(annotation) is Annotated:
        inner, *outer = get_args(annotation)
        return _resolved(
            inner,
            {rule: limit for field in outer for rule, limit in field.rules.items()} | dict(rules),
        )
    if get_origin(annotation) in (Union, UnionType):
        return _resolved(
            next(
                alternative for alternative in get_args(annotation) if alternative is not NoneType
            ),
            rules,
        )
    return annotation, rules


def _type(annotation: Any) -> str:
    if get_origin(annotation) is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(annotation))
    if get_origin(annotation) is tuple:
        item = _type(_resolved(get_args(annotation)[0])[0])
        return f"list of {item}" if item.startswith("`") else f"{item}s"
    return TYPES[get_origin(annotation) or annotation]


def _bounds(rules: Mapping[str, Any]) -> str:
    """Write the bounds of a number, without those that every number has.

    A lower bound above 0 and up to SMALLEST is written as "> 0".
    """
    signs = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
    limits = {rule: rules[rule] for rule in signs if rule in rules and abs(rules[rule]) < UNBOUNDED}
    if 0.0 < limits.get("ge", 0.0) <= SMALLEST:
        limits["gt"] = 0.0
    if "gt" in limits:
        limits.pop("ge", None)
    if limits.keys() == {"ge", "le"}:
        return f"{limits['ge']:g} to {limits['le']:g}"
    return ", ".join(f"{signs[rule]} {limit:g}" for rule, limit in sorted(limits.items()))


def _value(default: object) -> str:
    if default is REQUIRED:
        return ""
    if default in (None, "", (), {}):
        return "*optional*"
    if isinstance(default, bool):
        return f"= `{str(default).lower()}`"
    items = [
        f"{item:g}" if isinstance(item, float) else str(item)
        for item in (default if isinstance(default, tuple) else (default,))
    ]
    return f"= `[{', '.join(items)}]`" if isinstance(default, tuple) else f"= `{items[0]}`"


def _text(text: str) -> str:
    return " ".join(text.split()).removeprefix("the ").replace("|", "\\|")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
