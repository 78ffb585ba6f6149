# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read the ROS parameters of a node as a validated set.

The overrides are validated as a whole, and then each parameter is declared.
"""

import sys
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from flight_core.fields import short_repr
from flight_core.files import require_no_octal
from flight_core.parameters import NodeConfig, ParameterError, flatten, nest, one_of, require
from flight_core.scenario_file import ROS_PARAMETERS, is_given_to_all, is_given_to_node
from flight_core.text import bounded

P = TypeVar("P", bound=NodeConfig)
AT_RESTART = "a change at a restart only"
"""What an error says is expected, if an operator changes in flight a parameter that only the node
itself may change (`changed_by_node`)."""


def read_parameters(node: Node, schema: type[P]) -> P:
    """Validate the overrides of a node, and declare its parameters.

    The node was created with automatically_declare_parameters_from_overrides. Every parameter of
    the set is declared with its description. A parameter that is not tunable is read-only. Raises
    ParameterError.
    """
    _require_no_octal(sys.argv)
    overrides = _without_global(node, nest(_overrides(node)), schema)
    try:
        parameters = schema.validate_mapping(overrides, node.get_name())
    except ParameterError as error:
        if overrides:
            raise
        expected = f"a section for {node.get_fully_qualified_name()} in a file of --params-file"
        raise ParameterError(
            f"{node.get_name()}: found no parameters, expected {expected}: {error}"
        ) from None
    tunable = parameters.tunable()
    by_node = parameters.changed_by_node()
    descriptions = {
        name: field.description or "" for name, field in type(parameters).model_fields.items()
    }
    for name, value in flatten(parameters.model_dump()):
        group = name.split(".")[0]
        is_read_only = group not in tunable | by_node and name not in tunable
        # with dynamic_typing, the set validates the types, and accepts an integer as a float
        descriptor = ParameterDescriptor(
            description=descriptions.get(group, ""),
            read_only=is_read_only,
            dynamic_typing=True,
            additional_constraints=AT_RESTART if group in by_node else "",
        )
        if node.has_parameter(name):
            node.set_descriptor(name, descriptor)
        elif value != ():
            node.declare_parameter(name, value, descriptor)
    for name in sorted(tunable):
        # An optional parameter without an override is declared too, because it can be set in
        # flight. A group that contains parameters is no parameter.
        if not node.has_parameter(name) and not node.get_parameters_by_prefix(name):
            node.declare_parameter(
                name,
                None,
                ParameterDescriptor(description=descriptions.get(name, ""), dynamic_typing=True),
            )
    return parameters


def _without_global(
    node: Node, overrides: dict[str, Any], schema: type[NodeConfig]
) -> dict[str, Any]:
    """Leave out parameters that were given to all nodes and that are unknown to this node.

    The node also undeclares these parameters, because an ordinary node of ROS does not declare a
    parameter that it does not know. An unknown parameter in a section for this node stays, and is
    refused later.
    """
    known = schema.keys_beside(overrides)
    foreign = [key for key in overrides if key not in known and _is_global(node, key, sys.argv)]
    for key in foreign:
        names = [key, *(f"{key}.{name}" for name in node.get_parameters_by_prefix(key))]
        for name in filter(node.has_parameter, names):
            node.undeclare_parameter(name)
    if foreign:
        expected = f"expected {one_of(sorted(known), foreign[0])}"
        node.get_logger().warning(
            bounded(f"left alone: {', '.join(foreign)}, a parameter of all nodes; {expected}")
        )
    return {key: value for key, value in overrides.items() if key not in foreign}


def _is_global(node: Node, key: str, arguments: Sequence[str]) -> bool:
    """Return whether a parameter was given only to all nodes together, and not to this node."""
    name = node.get_name()
    is_given = False
    for option, value in pairwise(arguments):
        if option == "--params-file":
            path = Path(value)
            content = path.read_bytes()
            if is_given_to_node(content, path, name, key, node.get_namespace()):
                return False
            is_given |= is_given_to_all(content, path, key)
        elif option in {"-p", "--param"}:
            words = value.partition(":=")[0].split(":")
            if words[-1].split(".")[0] == key:
                if len(words) > 1:
                    return False
                is_given = True
    return is_given


def _require_no_octal(arguments: Sequence[str]) -> None:
    for option, value in pairwise(arguments):
        if option == "--params-file":
            require_no_octal(Path(value).read_bytes(), value)  # rcl has read it
        elif option in {"-p", "--param"}:
            name, _, number = value.partition(":=")
            require_no_octal(number, name)


def changed(node: Node, parameters: P, changes: list[Parameter]) -> P:
    """Change some parameters of a set, and validate it as a whole.

    Raises ParameterError for an invalid set. It is also raised for a parameter that only the node
    itself changes in flight (`changed_by_node`). A user can change such a parameter only at a
    restart.
    """
    for change in changes:
        is_for_node_only = change.name.split(".")[0] in parameters.changed_by_node()
        name = f"{node.get_name()}.{change.name}"
        require(not is_for_node_only, name, short_repr(change.value), AT_RESTART)
    values = {
        change.name: _as_list(change.value)
        for change in changes
        if change.name.split(".")[0] not in ROS_PARAMETERS
    }
    return type(parameters).validate_mapping(nest(_overrides(node) | values), node.get_name())


def _overrides(node: Node) -> dict[str, Any]:
    return {
        name: _as_list(parameter.value)
        for name, parameter in node.get_parameters_by_prefix("").items()
        if name.split(".")[0] not in ROS_PARAMETERS and parameter.value is not None
    }


def _as_list(value: Any) -> Any:
    """Return a sequence as a list, and any other value unchanged."""
    return (
        value
        if isinstance(value, str | bytes | Mapping) or not hasattr(value, "__iter__")
        else list(value)
    )
