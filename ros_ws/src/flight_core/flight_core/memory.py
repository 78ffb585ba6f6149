# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Limit the memory of a node.

Without a limit, one packet to its middleware could take all memory of the host.
"""

import resource

DATA_LIMIT = 2 << 30
"""Default limit, bytes. A node of a flight maps 0.2 GB of data (VmData of proc_pid_status(5)). Half
of this are thread stacks."""


def limit_memory(limit: int = DATA_LIMIT) -> None:
    """Limit the data of this process and its later children to `limit` bytes.

    If the user has set a lower limit (ulimit -d), this limit stays. If an allocation exceeds the
    limit, Python raises MemoryError. The middleware does not expect a failure, and ends the
    process. The limit covers the heap and private writable mappings, including thread stacks.
    Source: getrlimit(2), RLIMIT_DATA.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    lowest = min([limit, *(bound for bound in (soft, hard) if bound != resource.RLIM_INFINITY)])
    resource.setrlimit(resource.RLIMIT_DATA, (lowest, hard))
