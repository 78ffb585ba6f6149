# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check that the environment has what ROS 2 needs, before rclpy is loaded.

The check takes less than a millisecond. Without it, rclpy would end with a traceback, with a bus
error or after a timeout.
"""

import os
import re
import resource
import socket
import sys
import time
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import NoReturn

PROFILE_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
MAX_PARTICIPANTS = 100  # most participants in a domain, as in `flight_ros/loopback.xml`
SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - only its free space is read
LEAST_SHARED_MEMORY = 1 << 16  # bytes; rclpy and a flight use 12 kB
LEAST_FILES = 128  # least number of files that a process must be able to hold open
LAST_START = 2**31 - 86_400
"""Last time at which a node can start, s since the epoch. It is a day before the last stamp of ROS
2, on 2038-01-19, because a stamp counts seconds in 32 bits with a sign
(builtin_interfaces/Time)."""
MAX_DOMAIN = 232  # a higher domain has port numbers above 65535 (DDSI-RTPS 2.3, section 9.6.1.1)


def require_ros_environment() -> None:
    """Raise ParameterError, which states the remedy, if no node can start here.

    The check covers the clock, the domain, the middleware, shared memory, open files, logs and
    loopback.
    """
    _require_clock()
    _require_domain()
    _require_middleware()
    _require_shared_memory()
    _require_files()
    _require_log_folder()
    _require_log_settings()
    if PROFILE_VARIABLE not in os.environ:
        _require_loopback()


def _require_clock() -> None:
    now = time.time()
    if not 0.0 <= now < LAST_START:
        date = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(now))
        span = "1970 to 2038-01-18 03:14 UTC, which the stamps of ROS 2 can hold"
        _refuse(
            f"system clock: found {date}, expected {span}: set the clock (date --set), or fly "
            "with --in-process"
        )


def _require_domain() -> None:
    domain = os.environ.get("ROS_DOMAIN_ID", "")
    is_domain = not domain or (re.fullmatch(r"[0-9]{1,9}", domain) and int(domain) <= MAX_DOMAIN)
    if not is_domain:
        _refuse(f"ROS_DOMAIN_ID: found {domain!r}, expected a number from 0 to {MAX_DOMAIN}")


def _require_middleware() -> None:
    """Raise ParameterError if the middleware is not installed.

    If the installation of ROS 2 has no index of its middlewares, any name passes.
    """
    name = os.environ.get("RMW_IMPLEMENTATION", "")
    prefixes = [
        *filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)),
        sys.prefix,
    ]
    indexes = [
        Path(prefix) / "share/ament_index/resource_index/rmw_typesupport" for prefix in prefixes
    ]
    folders = filter(Path.is_dir, indexes)
    installed = {path.name for path in chain.from_iterable(map(Path.iterdir, folders))}
    choices = sorted(installed - {"rmw_implementation"})
    if name and choices and name not in choices:
        _refuse(f"RMW_IMPLEMENTATION: found {name!r}, expected one of {', '.join(choices)}")


def _require_shared_memory() -> None:
    """Raise ParameterError if the file system of shared memory is full.

    rclpy writes a page of shared memory when it is loaded. If the file system is full, this write
    ends in a bus error.
    """
    try:
        state = os.statvfs(SHARED_MEMORY)
    except OSError:  # without the folder, rclpy uses no shared memory
        return
    free = state.f_bavail * state.f_frsize
    if state.f_blocks > 0 and free < LEAST_SHARED_MEMORY:
        mend = "remove files there, or start a container with --shm-size=64m"
        _refuse(
            f"{SHARED_MEMORY}: found {free} bytes free, expected {LEAST_SHARED_MEMORY} or more: "
            f"{mend}"
        )


def _require_files() -> None:
    """Raise ParameterError if the limit of open files is below LEAST_FILES.

    A node has some 50 files and sockets open.
    """
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    if most < LEAST_FILES:
        _refuse(
            f"ulimit -n: found {most} open files, expected {LEAST_FILES} or more: ulimit -n 1024"
        )


def _require_log_settings() -> None:
    """Raise ParameterError if a setting of rcutils/logging.h turns each log line into an error."""
    for variable in (
        "RCUTILS_LOGGING_USE_STDOUT",
        "RCUTILS_LOGGING_BUFFERED_STREAM",
        "RCUTILS_COLORIZED_OUTPUT",
    ):
        if (value := os.environ.get(variable, "")) not in {"", "0", "1"}:
            _refuse(f"{variable}: found {value!r}, expected 0, 1, or none")


def log_folder() -> Path | None:
    """Return the folder for the logs of nodes, as rcl_logging_interface chooses it.

    Returns None if none of the environment variables for it is set.
    """
    for variable, inside in (("ROS_LOG_DIR", ""), ("ROS_HOME", "log"), ("HOME", ".ros/log")):
        if value := os.environ.get(variable):
            home = os.environ.get("HOME", "~")
            return Path(home + value[1:] if value.startswith("~") else value) / inside
    return None


def _require_log_folder() -> None:
    folder = log_folder()
    if folder is None:
        _refuse(
            "ROS_LOG_DIR: found none and no HOME, expected a folder for the logs of nodes: "
            "ROS_LOG_DIR=FOLDER"
        )
    probe = folder / f".rise-di-{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.close(os.open(probe, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
    except (OSError, ValueError) as error:
        if folder.is_dir() and isinstance(error, FileExistsError):
            return  # a killed process with the same number has left this file
        reason = error.strerror if isinstance(error, OSError) else str(error)
        _refuse(
            f"{folder}: cannot be written ({reason}), expected a folder for the logs of nodes "
            "that can: ROS_LOG_DIR=FOLDER"
        )
    finally:
        with suppress(OSError, ValueError):
            probe.unlink()


def _require_loopback() -> None:
    """Raise ParameterError if the host has no loopback.

    Nodes talk over 127.0.0.1 if the user has no profile of Fast DDS.
    """
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            probe.connect(probe.getsockname())
            probe.send(b"")
    except OSError as error:
        _refuse(
            f"127.0.0.1: cannot be reached ({error.strerror}), expected the loopback interface "
            "up: ip link set lo up"
        )


def _refuse(sentence: str) -> NoReturn:
    from flight_core.parameters import ParameterError  # noqa: PLC0415 - a node starts without it

    raise ParameterError(sentence) from None
