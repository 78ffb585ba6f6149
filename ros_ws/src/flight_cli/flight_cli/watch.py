# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""`rise-di watch`: see a flight on a page or in the terminal, live or recorded."""

from pathlib import Path
from typing import Annotated

import typer

from flight_core.parameters import require
from flight_view.watch import DEFAULT_PORT, newest_run, require_log, serve


def watch(
    run: Annotated[
        Path | None, typer.Argument(help="Folder of a run, or an MCAP file; by default the run in progress, else the last one.")
    ] = None,
    ghost: Annotated[Path | None, typer.Argument(metavar="[RUN2]", help="A second run, shown as a ghost.")] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port on this host; 0 takes any free one.")] = DEFAULT_PORT,
    wait: Annotated[bool, typer.Option("--wait", help="Wait for the log of RUN where there is none yet.")] = False,
    runs: Annotated[Path, typer.Option(help="Folder of the runs.")] = Path("runs"),
) -> None:
    """See a flight on a page: charts, horizon, scene and timeline, live while it is recorded, or again later.

    The page is served on this host alone; Ctrl-C ends it. Exit status: 0, or 2 for bad input.
    """
    chosen = [newest_run(runs) if run is None else run, *([ghost] if ghost is not None else [])]
    for one in chosen:
        if not wait:
            require_log(one)
    require(not wait or run is not None, "--wait", "no RUN", "the folder of a run that will be recorded")
    serve(chosen, port, lambda line: print(line, flush=True))
