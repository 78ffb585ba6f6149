# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS parameters as a validated set: what was given is checked as a whole, then every parameter is declared and described."""

from collections.abc import Mapping
from typing import Any, TypeVar

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from flight_core.parameters import Parameters, flatten, nest

P = TypeVar("P", bound=Parameters)
NOT_OURS = ("use_sim_time", "start_type_description_service", "qos_overrides")


def read_parameters(node: Node, schema: type[P], tunable: frozenset[str]) -> P:
    """Validate the overrides of a node made with automatically_declare_parameters_from_overrides.

    Afterwards every parameter of the set is declared, with its description; read-only unless `tunable`. Raises ParameterError.
    """
    parameters = schema.validate_mapping(nest(_given(node)), node.get_name())
    descriptions = dict(_descriptions(schema))
    for name, value in flatten(parameters.model_dump()):
        group = name.split(".")[0]
        # dynamic_typing: the set decides about types, and takes an integer where a number is meant
        descriptor = ParameterDescriptor(
            description=descriptions.get(group, ""), read_only=group not in tunable, dynamic_typing=True
        )
        if node.has_parameter(name):
            node.set_descriptor(name, descriptor)
        elif value != ():
            node.declare_parameter(name, value, descriptor)
    for name in tunable:
        if not node.has_parameter(name):  # an optional one that was not given, but may be in flight
            node.declare_parameter(name, None, ParameterDescriptor(description=descriptions.get(name, ""), dynamic_typing=True))
    return parameters


def changed(node: Node, parameters: P, changes: list[Parameter]) -> P:
    """The set with some parameters changed, checked as a whole. Raises ParameterError."""
    ours = {change.name: _plain(change.value) for change in changes if change.name.split(".")[0] not in NOT_OURS}
    return type(parameters).validate_mapping(nest(_given(node) | ours), node.get_name())


def _given(node: Node) -> dict[str, Any]:
    return {
        name: _plain(parameter.value)
        for name, parameter in node.get_parameters_by_prefix("").items()
        if name.split(".")[0] not in NOT_OURS and parameter.value is not None
    }


def _plain(value: Any) -> Any:
    return value if isinstance(value, str | bytes | Mapping) or not hasattr(value, "__iter__") else list(value)


def _descriptions(schema: type[Parameters]) -> list[tuple[str, str]]:
    return [(name, field.description or "") for name, field in schema.model_fields.items()]
