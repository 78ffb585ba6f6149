# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di engage`: the autopilot behind a running bridge is taken over without a jump, or given back."""

import sys
from typing import Annotated

import typer

REFUSED = 1


def engage(
    off: Annotated[bool, typer.Option("--off", help="Give the autopilot its channels back.")] = False,
    namespace: Annotated[str, typer.Option(help="Of the bridge and the controller.")] = "",
) -> None:
    """Deactivate the controller until u is at trim, engage the bridge, activate the controller: u then begins without a jump.

    Exit status: 0 done, 1 refused, with the bridge's reason; the controller is then left as it was. 2 nobody there.
    """
    from flight_bringup.clients import EngagementClient  # noqa: PLC0415 - loads rclpy, which other commands do not need

    with EngagementClient(namespace) as engager:
        refusal = engager.give_back() if off else engager.take_over()
    if refusal:
        print(f"error: not {'given back' if off else 'engaged'}: {refusal}", file=sys.stderr)
        raise typer.Exit(REFUSED)
    print("given back" if off else "engaged, the controller flies")
