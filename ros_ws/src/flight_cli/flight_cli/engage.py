# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di engage`: bumpless engagement of the autopilot behind a running bridge, and disengagement."""

import sys
from typing import Annotated

import typer

REFUSED = 1


def engage(
    off: Annotated[bool, typer.Option("--off", help="Disengage: give the channels back to the autopilot.")] = False,
    namespace: Annotated[str, typer.Option(help="Namespace of the bridge and the controller.")] = "",
) -> None:
    """Engage the autopilot behind a running bridge without a jump of u, or disengage it.

    The controller is deactivated until u is at trim, the bridge is engaged, the controller is activated. A refusal leaves the
    controller as it was. Exit status: 0 done, 1 refused with the bridge's reason, 2 service not available.
    """
    from flight_bringup.clients import EngagementClient  # noqa: PLC0415 - loads rclpy, which other commands do not need

    with EngagementClient(namespace) as client:
        refusal = client.disengage() if off else client.engage()
    if refusal:
        print(f"error: not {'disengaged' if off else 'engaged'}: {refusal}", file=sys.stderr)
        raise typer.Exit(REFUSED)
    print("disengaged" if off else "engaged, the controller flies")
