# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Connect the network namespaces of two processes by a network with delay and loss.

python -m tests.ros.relay PID PID DELAY LOSS

It forwards the packets of two TUN devices, `net0` in each namespace, after DELAY s. A share LOSS is
lost. It prints "up" when the devices exist. SIGUSR1 pulls the cable for a second.
"""

import ctypes
import fcntl
import os
import random
import select
import signal
import struct
import sys
import time
from collections import deque
from pathlib import Path

CLONE_NEWNET = 0x40000000  # sched.h
TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 0x0001, 0x1000  # linux/if_tun.h
PULLED = 1.0  # s
NAME = "net0"


def device(pid: int) -> int:
    """Return a TUN device in the network namespace of a process.

    Raises OSError without the permission.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    with (
        Path("/proc/self/ns/net").open("rb") as own_namespace,
        Path(f"/proc/{pid}/ns/net").open("rb") as peer_namespace,
    ):
        if libc.setns(peer_namespace.fileno(), CLONE_NEWNET):
            raise OSError(ctypes.get_errno(), "setns")
        tun = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
        fcntl.ioctl(tun, TUNSETIFF, struct.pack("16sH", NAME.encode(), IFF_TUN | IFF_NO_PI))
        libc.setns(own_namespace.fileno(), CLONE_NEWNET)
    return tun


def forward(ends: tuple[int, int], delay: float, loss: float) -> None:
    """Forward until the process ends."""
    until = 0.0
    rng = random.Random(1)  # noqa: S311 - loss

    def pull(*_: object) -> None:
        nonlocal until
        until = time.monotonic() + PULLED

    signal.signal(signal.SIGUSR1, pull)
    waiting: deque[tuple[float, int, bytes]] = deque()  # due at, to, packet
    poll = select.poll()
    for end in ends:
        poll.register(end, select.POLLIN)
    print("up", flush=True)
    while True:
        rest = None if not waiting else max(0.0, waiting[0][0] - time.monotonic()) * 1e3
        for end, _ in poll.poll(rest):
            packet = os.read(end, 65536)
            now = time.monotonic()
            if now >= until and rng.random() >= loss:
                waiting.append((now + delay, ends[end == ends[0]], packet))
        while waiting and waiting[0][0] <= time.monotonic():
            _, end, packet = waiting.popleft()
            try:
                os.write(end, packet)
            except OSError:
                continue  # the device is not up yet


if __name__ == "__main__":
    forward(
        (device(int(sys.argv[1])), device(int(sys.argv[2]))), float(sys.argv[3]), float(sys.argv[4])
    )
