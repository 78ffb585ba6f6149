# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Let a live page control a flight, by a ROS 2 client that talks to the flight's nodes."""

from collections.abc import Mapping, Sequence
from typing import Any

from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import GetParameters, ListParameters, SetParametersAtomically
from rclpy.parameter import Parameter, parameter_value_to_python

from autopilot_bridge.client import EngagementClient
from flight_core.outcome import Refusal
from flight_guidance.client import TargetClient
from flight_ros.client import Client

STRINGS = Parameter.Type.STRING_ARRAY


class ControlClient(Client):
    """Changes a running flight for `rise-di watch --control`.

    One thread calls the methods, and each call may wait. Only `cancel` returns at once, and another
    thread calls it. A method returns the reason if a node refuses the change, else None. It
    raises ParameterError if a node or its answer is missing.
    """

    NODES = ("aircraft", "bridge", "controller", "guidance")

    def __init__(self, namespace: str) -> None:
        super().__init__("control", namespace)
        self._targets: TargetClient | None = None
        self._engagement: EngagementClient | None = None

    def nodes(self) -> list[str]:
        """Return the nodes of the flight that are in the ROS graph and can be commanded."""
        namespace = self._node.get_namespace()
        running = {
            name for name, where in self._node.get_node_names_and_namespaces() if where == namespace
        }
        return [name for name in self.NODES if name in running]

    def parameters(self, node: str, names: Sequence[str]) -> dict[str, Any]:
        """Return the values of the node's parameters and groups `names`, if they are set."""
        everything = ListParameters.Request(depth=ListParameters.Request.DEPTH_RECURSIVE)
        declared_names = self._call(
            ListParameters, f"{node}/list_parameters", everything
        ).result.names
        # A single undeclared name would make the whole answer empty.
        selection = [
            name for name in declared_names if name in names or name.split(".")[0] in names
        ]
        values = self._call(
            GetParameters, f"{node}/get_parameters", GetParameters.Request(names=selection)
        ).values
        python_values = {
            name: parameter_value_to_python(value)
            for name, value in zip(selection, values, strict=True)
        }
        return {
            name: value.tolist() if hasattr(value, "tolist") else value
            for name, value in python_values.items()
            if value is not None
        }

    def set_parameters(self, node: str, values: Mapping[str, Any]) -> Refusal | None:
        """Set parameters of a node together, or none of them."""
        request = SetParametersAtomically.Request()
        # rclpy sends an empty list as bytes. Only the list of faults may be empty.
        request.parameters = [
            Parameter(name, STRINGS if value == [] else None, value).to_parameter_msg()
            for name, value in values.items()
        ]
        result = self._call(
            SetParametersAtomically, f"{node}/set_parameters_atomically", request
        ).result
        return None if result.successful else Refusal(str(result.reason))

    def activate(self, *, active: bool) -> Refusal | None:
        """Activate or deactivate the controller."""
        number = Transition.TRANSITION_ACTIVATE if active else Transition.TRANSITION_DEACTIVATE
        request = ChangeState.Request(transition=Transition(id=number))
        response = self._call(ChangeState, "controller/change_state", request)
        if response.success:
            return None
        return Refusal(f"the controller is {'active' if active else 'inactive'} already")

    def send_target(self, values: Mapping[str, float]) -> Refusal | None:
        """Send a target to guidance, SI, as `rise-di guide` does."""
        return self._operator().send(values)

    def send_route(self, points: Sequence[Sequence[float]]) -> Refusal | None:
        """Publish a route of waypoints, each with north, east and altitude in m."""
        return self._operator().send_route(points)

    def keep_link(self) -> None:
        """Tell guidance, if the flight has any, that the link to an operator still exists.

        The time `guidance.home.link_timeout` begins again.
        """
        if "guidance" in self.nodes():
            self._operator().keep_link()

    def guide(self, service: str) -> Refusal | None:
        """Call a service of guidance, which is hold, skip, resume or home."""
        return self._operator().call(service)

    def _operator(self) -> TargetClient:
        self._targets = self._targets or TargetClient(parent=self)
        return self._targets

    def engage(self) -> Refusal | None:
        """Engage the bridge, as `rise-di engage` does."""
        return self._bridge().engage(lambda reason: None)

    def disengage(self) -> Refusal | None:
        """Disengage the bridge."""
        return self._bridge().disengage()

    def _bridge(self) -> EngagementClient:
        self._engagement = self._engagement or EngagementClient(parent=self)
        return self._engagement

    def cancel(self) -> None:
        """End the wait of the running method. Another thread calls this."""
        self._cancelled.set()

    def resume(self) -> None:
        """Let methods wait again after `cancel`."""
        self._cancelled.clear()

    def note(self, text: str) -> None:
        """Write a line to the log of the flight."""
        self._node.get_logger().info(text)
