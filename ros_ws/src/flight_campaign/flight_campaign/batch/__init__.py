# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Fly thousands of aircraft side by side on JAX.

The modules make the course, the loop and the matrices, and choose the device. The course is what
all aircraft have in common: reference, wind, sensor errors and feedforward.
"""
