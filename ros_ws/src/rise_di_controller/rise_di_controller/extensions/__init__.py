# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Extend the law of the paper by feedforward, observer, schedule and allocation."""
