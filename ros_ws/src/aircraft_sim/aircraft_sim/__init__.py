# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated aircraft of the RISE-DI flight stack, with wind, actuators and sensors.

x_dot = A x + f(x, t) + B u, y = C x.
"""
