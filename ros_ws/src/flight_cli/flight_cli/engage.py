# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di engage`: bumpless engagement of the autopilot behind a running bridge, and
disengagement.
"""

from typing import Annotated

import typer

from flight_cli.words import Namespace, option, warn
from flight_core.environment import require_ros_environment

REFUSED = 1


def engage(
    off: Annotated[
        bool, option("Disengage: give the channels back to the autopilot.", "--off")
    ] = False,
    blind: Annotated[
        bool,
        option(
            "Engage without regard to the pilot's transmitter, and without end by max_engaged.",
            "--blind",
        ),
    ] = False,
    namespace: Namespace = "",
) -> None:
    """Engage the autopilot behind a running bridge without a jump of u, or disengage it.

    The command waits until u is at trim, and for a change of mode where the map asks for one. The
    bridge activates the controller until the end of the engagement. The loss of the pilot's
    transmitter ends the engagement where the map has a condition for it; elsewhere max_engaged of
    the map ends the engagement, unless you engage again before. Exit status: 0 done, 1 refused with
    the bridge's reason, 2 service not available.
    """
    require_ros_environment()
    from autopilot_bridge.client import EngagementClient  # noqa: PLC0415 - loads rclpy, which other commands do not need

    with EngagementClient(namespace) as client:
        refusal = client.disengage() if off else client.engage(warn, blind=blind)
    if refusal:
        warn(f"error: not {'disengaged' if off else 'engaged'}: {refusal}")
        raise typer.Exit(REFUSED)
    print("disengaged" if off else "engaged, the controller flies")
