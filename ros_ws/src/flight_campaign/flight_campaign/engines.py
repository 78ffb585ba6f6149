# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Provide engines that compute the chunks of a campaign, with equal results.

An engine is threads of this process, or workers of dask.
"""

import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager, suppress
from itertools import islice
from typing import Any

from flight_core.installation import require_package
from flight_core.parameters import ParameterError

CONNECT = 10.0
RECONNECT = 60.0
"""s to wait for a scheduler at the start, and after it was lost."""

LOST_WORKER_TIMEOUT = {"distributed.deploy.lost-worker-timeout": "10 minutes"}
"""By default a cluster gives up a dead worker after 15 s, even if it is just starting again. On a
busy host a start may take longer, and the campaign would wait for ever for a cluster without
workers."""

AHEAD = 2  # number of queued chunks per worker, which keeps it busy without much memory

Job = tuple[int, ...]
"""Numbers that say what to compute, which are (case, chunk) in a campaign. An engine passes them to
`Work` unread."""

Work = Callable[[Job], Any]

Engine = Callable[[Work, Iterable[Job]], Iterator[tuple[Job, Any]]]
"""Runs jobs, and yields each with its result in the order in which they are complete."""


Devices = Sequence[Mapping[str, str]]
"""Environments of processes, each of which sees one device."""


def require_jax(*, shared: bool = False) -> None:
    """Raise ParameterError if JAX is not installed or finds no device.

    For example, JAX finds no device if JAX_PLATFORMS is for another host. If `shared` is True, this
    process does not reserve the whole memory of its device, so that others can use it, too.
    """
    require_package("jax")
    if shared:
        os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    from flight_campaign.batch import device  # noqa: PLC0415 - JAX takes a second, which few commands need

    try:
        device.is_cpu()  # this makes JAX look for its devices
    except (RuntimeError, AssertionError) as error:
        platforms = os.environ.get("JAX_PLATFORMS", "")
        reason = str(error).partition("\n")[0] or "no such device"
        raise ParameterError(
            f"JAX_PLATFORMS: found {platforms!r} ({reason}), expected cpu, or a device of this host"
        ) from None


def threads(workers: int | None = None) -> Engine:
    """Return an engine of threads of this process.

    If `workers` is None, there are just enough threads to keep the device busy. The loop is
    compiled once and releases the interpreter lock, so that threads run in parallel.
    """

    def fly(work: Work, jobs: Iterable[Job]) -> Iterator[tuple[Job, Any]]:
        from flight_campaign.batch import device  # noqa: PLC0415 - JAX takes a second

        count = workers or device.thread_count()
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


def dask(
    workers: int | None = None, scheduler: str | None = None, *, on_devices: bool = True
) -> Engine:
    """Return an engine that flies in processes of this machine, or on the workers of a scheduler.

    The chunks of a dead worker run again. If a scheduler is lost and comes back within RECONNECT,
    the lost chunks are sent to it again. On a host with GPUs, each process has a different GPU.
    If `on_devices` is False, no process has a GPU, and by default there is one for each core. This
    suits aircraft that fly one by one, because such flights run on cores.
    """

    def fly(work: Work, jobs: Iterable[Job]) -> Iterator[tuple[Job, Any]]:
        from distributed import CancelledError, KilledWorker  # noqa: PLC0415 - half a second
        from distributed.comm import CommClosedError  # noqa: PLC0415 - as above

        waiting = iter(jobs)
        devices = _separate_devices() if on_devices and scheduler is None else []
        count = workers or len(devices) or os.cpu_count() or 1
        patience = CONNECT
        # These loggers would write tracebacks if a peer is lost.
        for part in ("", ".client", ".nanny", ".scheduler", ".worker"):
            logging.getLogger(f"distributed{part}").setLevel(logging.CRITICAL)
        lost_jobs: list[Job] = []
        while True:
            underway: dict[Any, Job] = {}
            with ExitStack() as stack:
                client, threads_known = _connected(stack, scheduler, count, devices, patience)
                queue_length = AHEAD * max(count, threads_known)
                first = [*lost_jobs, *islice(waiting, max(queue_length - len(lost_jobs), 0))]
                try:
                    yield from _results(client, work, first, waiting, underway)
                except (CancelledError, CommClosedError):
                    lost_jobs = list(underway.values())
                    patience = RECONNECT
                except KilledWorker as error:
                    failure = (
                        f"a chunk that ended {error.allowed_failures + 1} workers, as one "
                        "that needs too much memory does"
                    )
                    raise ParameterError(
                        f"--engine dask: found {failure}, expected a smaller --chunk"
                    ) from None
                else:
                    return

    return fly


def _connected(
    stack: ExitStack, scheduler: str | None, count: int, devices: Devices, patience: float
) -> tuple[Any, int]:
    """Connect to the scheduler, or to `count` processes of this machine.

    Returns the client, and the number of threads of its workers.
    """
    from distributed import Client  # noqa: PLC0415 - half a second

    try:
        cluster = scheduler or stack.enter_context(_local_cluster(count, devices))
        client = stack.enter_context(Client(cluster, timeout=f"{patience:g}s"))
        if devices:
            client.register_plugin(_one_device_each(devices))
        workers = client.scheduler_info()["workers"].values()
        return client, sum(worker["nthreads"] for worker in workers)
    except (OSError, ValueError) as error:
        # A ValueError means that `scheduler` is no address.
        if scheduler is None:
            raise ParameterError(
                f"--engine dask: its workers did not start on this host ({error})"
            ) from None
        where = f"found {scheduler}, expected a reachable dask scheduler"
        raise ParameterError(f"--scheduler: {where} ({error})") from None


def _results(
    client: Any, work: Work, first: Iterable[Job], waiting: Iterator[Job], underway: dict[Any, Job]
) -> Iterator[tuple[Job, Any]]:
    """Yield jobs with their results; `underway` has the submitted jobs by their futures."""
    from distributed import as_completed  # noqa: PLC0415 - half a second

    for job in first:
        # With pure=False dask never takes a cached result.
        underway[client.submit(work, job, pure=False)] = job
    finished = as_completed(list(underway))
    for future in finished:
        result = future.result()
        job = underway.pop(future)
        for following in islice(waiting, 1):
            more = client.submit(work, following, pure=False)
            underway[more] = following
            finished.add(more)
        yield job, result


def _separate_devices() -> Devices:
    from flight_campaign.batch.device import separate_devices  # noqa: PLC0415 - JAX takes a second

    return separate_devices()


def _one_device_each(devices: Devices) -> Any:
    """Return a plugin that gives each local worker a device before its first chunk."""
    from distributed import WorkerPlugin  # noqa: PLC0415 - half a second

    class OneDeviceEach(WorkerPlugin):
        def setup(self, worker: Any) -> None:
            os.environ.update(devices[worker.name % len(devices)])

    return OneDeviceEach()


@contextmanager
def _local_cluster(workers: int, devices: Devices) -> Iterator[Any]:
    """Start processes on this machine, each with enough threads to keep a device busy."""
    import dask  # noqa: PLC0415 - half a second
    from distributed import LocalCluster  # noqa: PLC0415 - as above

    from flight_campaign.batch.device import THREADS  # noqa: PLC0415 - JAX

    with dask.config.set(LOST_WORKER_TIMEOUT):
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=THREADS if devices else 1,
            dashboard_address=":0",  # any free port that no other cluster of the host has
            # no messages about workers that end during a chunk, as after Ctrl-C
            silence_logs=logging.CRITICAL,
        )
        try:
            yield cluster
        finally:
            # A worker that is just starting again cannot be joined yet, but the campaign does not
            # need it any more.
            with suppress(TimeoutError, AssertionError):
                cluster.close()
