# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Implement `rise-di engage`, which engages or disengages the autopilot behind a bridge."""

from dataclasses import dataclass

import typer

from flight_cli.words import namespace_option, option, warn
from flight_core.environment import require_ros_environment

REFUSED = 1


@dataclass(frozen=True, kw_only=True)
class Engage:
    """Engage the autopilot behind a running bridge without a jump of u, or disengage it.

    The command waits until u is at trim, and for a change of mode if the map asks for one. The
    bridge keeps the controller active until the engagement ends. If the map has a condition for the
    loss of the pilot's transmitter, the engagement ends with this loss. If the map has no such
    condition, the engagement ends after its max_engaged, unless you engage again before. Exit
    status: 0 done, 1 refused with the bridge's reason, 2 service not available.
    """

    off: bool = option("Disengage, which gives the channels back to the autopilot.", default=False)
    blind: bool = option(
        "Engage without regard to the pilot's transmitter; max_engaged does not end it either.",
        default=False,
    )
    namespace: str = namespace_option()

    def execute(self) -> None:
        """Send the request to the bridge, and print its answer."""
        require_ros_environment()
        from autopilot_bridge.client import EngagementClient  # noqa: PLC0415 - loads rclpy, which other commands do not need

        with EngagementClient(self.namespace) as client:
            refusal = client.disengage() if self.off else client.engage(warn, blind=self.blind)
        if refusal:
            warn(f"error: not {'disengaged' if self.off else 'engaged'}: {refusal}")
            raise typer.Exit(REFUSED)
        print("disengaged" if self.off else "engaged, the controller flies")
