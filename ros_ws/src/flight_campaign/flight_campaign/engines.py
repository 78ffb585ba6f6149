# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Engines for the chunks of a campaign: threads of this process, or dask workers, with equal
results.
"""

import logging
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager, suppress
from itertools import islice
from typing import Any

from flight_core.installation import require_package
from flight_core.parameters import ParameterError

CONNECT = 10.0
RECONNECT = 60.0
"""s to wait for a scheduler at the start, and after its loss."""

LOST_WORKER_TIMEOUT = {"distributed.deploy.lost-worker-timeout": "10 minutes"}
"""After the default, 15 s, a cluster gives up a dead worker that starts again. On a busy host a
start may take longer, and the campaign would wait for ever for a cluster without workers."""

AHEAD = 2  # queued chunks a worker: enough to keep it busy, few enough for constant memory

Job = tuple[int, ...]
Work = Callable[[Job], Any]


Engine = Callable[[Work, Iterable[Job]], Iterator[tuple[Job, Any]]]
"""Runs jobs in any order: each job with its result, in the order of completion."""


def require_jax() -> None:
    """Raise ParameterError where JAX is not installed or finds no device, as with JAX_PLATFORMS of
    another host.
    """
    require_package("jax")
    import jax  # noqa: PLC0415 - takes a second, which few commands need

    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:
        platforms = os.environ.get("JAX_PLATFORMS", "")
        reason = str(error).partition("\n")[0] or "no such device"
        raise ParameterError(
            f"JAX_PLATFORMS: found {platforms!r} ({reason}), expected cpu, or a device of this host"
        ) from None


def threads(workers: int | None = None) -> Engine:
    """Threads of this process. The loop is compiled once and releases the interpreter lock, so
    threads run in parallel.
    """
    count = workers or os.cpu_count() or 1

    def fly(work: Work, jobs: Iterable[Job]) -> Iterator[tuple[Job, Any]]:
        waiting = iter(jobs)
        pool = ThreadPoolExecutor(count, thread_name_prefix="campaign")
        try:
            underway: dict[Future[Any], Job] = {
                pool.submit(work, job): job for job in islice(waiting, AHEAD * count)
            }
            while underway:
                finished, _ = wait(underway, return_when=FIRST_COMPLETED)
                for future in finished:
                    job = underway.pop(future)
                    underway.update(
                        (pool.submit(work, following), following)
                        for following in islice(waiting, 1)
                    )
                    yield job, future.result()
        finally:
            pool.shutdown(cancel_futures=True)

    return fly


def dask(workers: int | None = None, scheduler: str | None = None) -> Engine:
    """Processes of this machine, or the workers of a scheduler. The chunks of a dead worker run
    again.

    A scheduler gets the lost chunks again when the scheduler is back within RECONNECT.
    """

    def fly(work: Work, jobs: Iterable[Job]) -> Iterator[tuple[Job, Any]]:
        from distributed import CancelledError, Client, KilledWorker, as_completed  # noqa: PLC0415 - half a second
        from distributed.comm import CommClosedError  # noqa: PLC0415 - as above

        waiting = iter(jobs)
        count = workers or os.cpu_count() or 1
        patience = CONNECT
        for part in (
            "",
            ".client",
            ".nanny",
            ".scheduler",
            ".worker",
        ):  # they log the loss of a peer as tracebacks
            logging.getLogger(f"distributed{part}").setLevel(logging.CRITICAL)
        lost: list[Job] = []
        while True:
            underway: dict[Any, Job] = {}
            with ExitStack() as stack:
                try:
                    if scheduler is None:
                        cluster = stack.enter_context(_local_cluster(count))
                    client = stack.enter_context(
                        Client(scheduler or cluster, timeout=f"{patience:g}s")
                    )
                    ahead = AHEAD * max(count, len(client.scheduler_info()["workers"]))
                except (OSError, ValueError) as error:  # ValueError: no address at all
                    if scheduler is None:
                        raise ParameterError(
                            f"--engine dask: its workers did not start on this host ({error})"
                        ) from None
                    where = f"found {scheduler}, expected a reachable dask scheduler"
                    raise ParameterError(f"--scheduler: {where} ({error})") from None
                try:
                    for job in [*lost, *islice(waiting, max(ahead - len(lost), 0))]:
                        underway[client.submit(work, job, pure=False)] = (
                            job  # never a cached result
                        )
                    finished = as_completed(list(underway))
                    for future in finished:
                        result = future.result()
                        job = underway.pop(future)
                        for following in islice(waiting, 1):
                            more = client.submit(work, following, pure=False)
                            underway[more] = following
                            finished.add(more)
                        yield job, result
                except (CancelledError, CommClosedError):
                    lost = list(underway.values())
                    patience = RECONNECT
                except KilledWorker as error:
                    failure = (
                        f"a chunk that ended {error.allowed_failures + 1} workers, as one "
                        "that needs too much memory does"
                    )
                    raise ParameterError(
                        f"--engine dask: found {failure}, expected a smaller --set chunk"
                    ) from None
                else:
                    return

    return fly


@contextmanager
def _local_cluster(workers: int) -> Iterator[Any]:
    """Processes of this machine."""
    import dask  # noqa: PLC0415 - half a second
    from distributed import LocalCluster  # noqa: PLC0415 - as above

    with dask.config.set(LOST_WORKER_TIMEOUT):
        cluster = LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None)
        try:
            yield cluster
        finally:
            # a worker that is just starting again cannot be joined yet; its outcome is no outcome
            # of the campaign
            with suppress(TimeoutError, AssertionError):
                cluster.close()
