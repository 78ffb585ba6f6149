# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Tune control laws by one procedure, and compare them on the same aircraft and winds."""
