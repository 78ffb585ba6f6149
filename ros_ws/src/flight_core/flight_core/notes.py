# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Give notes to the user of a process, each note only once.

They go to the standard error if no logging is configured.
"""

import logging
from functools import cache

from flight_core.text import bounded


@cache
def note(sentence: str) -> None:
    """Log a sentence as a warning, once in a process."""
    logging.getLogger(__name__).warning("note: %s", bounded(sentence))
