# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A limit of memory for a node.

Without it, one packet to its middleware could take the memory of the host.
"""

import resource

DATA_LIMIT = 2 << 30
"""Bytes. A node of a flight maps 0.2 GB of data (VmData of proc_pid_status(5)), half of which are
thread stacks."""


def limit_memory(limit: int = DATA_LIMIT) -> None:
    """Limit the data of this process and its later children to `limit` bytes.

    If the user has set a lower limit (ulimit -d), it stays. An allocation beyond the limit fails:
    Python raises MemoryError, and the middleware, which does not expect that, ends the process.
    Source: getrlimit(2), RLIMIT_DATA: heap and private writable mappings, thread stacks included.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    lowest = min([limit, *(bound for bound in (soft, hard) if bound != resource.RLIM_INFINITY)])
    resource.setrlimit(resource.RLIMIT_DATA, (lowest, hard))
