# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The device of JAX that aircraft fly on, and what follows from its kind."""

import jax

from flight_campaign.batch_schedule import Schedule, with_branches, without_branches


def is_cpu() -> bool:
    """Whether JAX computes on the processor."""
    return jax.default_backend() == "cpu"


def schedule_of_device() -> Schedule:
    """The schedule that is fastest on the device."""
    return with_branches if is_cpu() else without_branches
