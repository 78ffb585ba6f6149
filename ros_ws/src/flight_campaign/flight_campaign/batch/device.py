# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Describe the device on which JAX flies aircraft, and choose settings that suit it."""

import logging
import os
from contextlib import AbstractContextManager, nullcontext
from threading import Lock

import jax

from flight_campaign.batch.batch_schedule import Schedule, with_branches, without_branches

CPU_CHUNK = 1000  # aircraft at once on a CPU; their matrices, 2 MB, stay in the caches of a core
# largest number of aircraft at once on a device; more were not faster on one H200
LARGEST_CHUNK = 250_000
BYTES = 16_384  # bytes per aircraft; osprey_servo needed 11,300 on one H200 (JAX 0.11.2)
THREADS = 3  # threads for a device: while one chunk flies, another is drawn, and a third is written

VISIBLE = {"cuda": "CUDA_VISIBLE_DEVICES", "rocm": "HIP_VISIBLE_DEVICES"}
"""Environment variables that name the devices of a process, by a word in the name of the platform.
"""

_TURN = Lock()


def _as_sentence(record: logging.LogRecord) -> bool:
    """Shorten the log record of a failing plugin, such as that of a missing GPU, to one sentence.

    JAX would log a traceback, and then fly on the other devices.
    """
    if record.exc_info and (error := record.exc_info[1]):
        record.msg = "warning: a plugin of JAX is left out (%s): the other devices fly"
        record.args = (str(error).partition("\n")[0],)
        record.exc_info = None
    return True


logging.getLogger("jax._src.xla_bridge").addFilter(_as_sentence)


def is_cpu() -> bool:
    """Return whether JAX computes on the processor."""
    return jax.default_backend() == "cpu"


def device_name() -> str:
    """Return the name of the device to show: NVIDIA H200, or the cores of the processor."""
    return f"{thread_count()} CPU cores" if is_cpu() else jax.devices()[0].device_kind


def schedule_of_device() -> Schedule:
    """Return the schedule that is fastest on the device."""
    return with_branches if is_cpu() else without_branches


def thread_count() -> int:
    """Return the number of threads that keep the device busy; on a CPU, one for each core."""
    return os.cpu_count() or 1 if is_cpu() else THREADS


def turn() -> AbstractContextManager[object]:
    """Return the context in which a thread flies a chunk, so that threads take turns on a GPU.

    On a GPU only one thread enters it at a time, and meanwhile other threads draw or write their
    chunks. On a CPU every thread may enter it.
    """
    return nullcontext() if is_cpu() else _TURN


def chunk_of_device(aircraft: int) -> int:
    """Return how many aircraft fly at once, so that equal chunks fit into the memory."""
    if is_cpu():
        return CPU_CHUNK
    memory = (jax.devices()[0].memory_stats() or {}).get("bytes_limit", BYTES * LARGEST_CHUNK)
    most = max(min(LARGEST_CHUNK, memory // BYTES), 1)
    chunks = -(-aircraft // most)
    return -(-aircraft // chunks)


def separate_devices() -> list[dict[str, str]]:
    """Return the environment of a process for each device, in which it sees only this device.

    Returns [] for a CPU.
    """
    devices = jax.local_devices()
    platform = devices[0].client.platform_version
    variable = next((VISIBLE[word] for word in VISIBLE if word in platform), None)
    if variable is None:
        return []
    every = ",".join(str(number) for number in range(len(devices)))
    return [{variable: name} for name in os.environ.get(variable, every).split(",")]
