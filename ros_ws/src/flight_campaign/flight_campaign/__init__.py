# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly Monte Carlo campaigns over thousands of uncertain aircraft.

The package also tunes control laws and compares them.
"""
