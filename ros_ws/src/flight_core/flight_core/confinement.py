# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Confine a process to one folder for its files, and cut it off the network, by the kernel.

Sources: unshare(2), landlock(7); include/uapi/linux/landlock.h.
"""

import ctypes
import os
import struct
from pathlib import Path

CLONE_NEWUSER = 0x10000000
CLONE_NEWNET = 0x40000000
# numbers of system calls, which are the same on every architecture
CREATE_RULESET = 444
ADD_RULE = 445
RESTRICT_SELF = 446
PATH_BENEATH = 1
VERSION_FLAG = 1
NO_NEW_PRIVS = 38  # PR_SET_NO_NEW_PRIVS of prctl(2)
WRITE_FILE = 1 << 1
TRUNCATE = 1 << 14
# rights to write a file, and to remove and make files, folders, links and sockets
CHANGES = WRITE_FILE | sum(1 << bit for bit in range(4, 13))
REFER_VERSION = 2  # first version of landlock with LANDLOCK_ACCESS_FS_REFER
TRUNCATE_VERSION = 3  # first version of landlock with LANDLOCK_ACCESS_FS_TRUNCATE
REFER = 1 << 13

_LIBC = ctypes.CDLL(None, use_errno=True)


def confine(folder: Path) -> list[str]:
    """Cut this process off the network, and let it change files only beneath `folder`.

    The process must have a single thread. Returns a sentence for each measure that the kernel does
    not support.
    """
    sentences = []
    if _LIBC.unshare(CLONE_NEWUSER | CLONE_NEWNET):
        sentences.append(
            "foreign files are read with access to the network: the kernel refuses a namespace "
            f"({_reason()})"
        )
    if not _write_beneath(folder):
        sentences.append(
            "foreign files are read with the right to write files: the kernel refuses landlock "
            f"({_reason()})"
        )
    return sentences


def _write_beneath(folder: Path) -> bool:
    """Restrict changes of files to `folder` and /dev/null.

    Returns whether the kernel supports this.
    """
    version = _LIBC.syscall(CREATE_RULESET, None, 0, VERSION_FLAG)
    if version < 1:
        return False
    changes = CHANGES
    if version >= REFER_VERSION:
        changes |= REFER
    if version >= TRUNCATE_VERSION:
        changes |= TRUNCATE
    ruleset = _LIBC.syscall(CREATE_RULESET, struct.pack("=Q", changes), 8, 0)
    if ruleset < 0:
        return False
    for path, rights in ((folder, changes), (Path(os.devnull), changes & (WRITE_FILE | TRUNCATE))):
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
        has_failed = _LIBC.syscall(
            ADD_RULE, ruleset, PATH_BENEATH, struct.pack("=Qi", rights, descriptor), 0
        )
        os.close(descriptor)
        if has_failed:
            return False
    is_restricted = not _LIBC.prctl(NO_NEW_PRIVS, 1, 0, 0, 0) and not _LIBC.syscall(
        RESTRICT_SELF, ruleset, 0
    )
    os.close(ruleset)
    return is_restricted


def _reason() -> str:
    return os.strerror(ctypes.get_errno())
