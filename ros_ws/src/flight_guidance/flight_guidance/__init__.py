# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Guidance of the RISE-DI flight stack, outside the control law.

Guidance commands attitude, altitude and course, and flies routes.
"""
