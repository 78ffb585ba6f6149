# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Thousands of aircraft side by side on JAX: the course, the loop, its matrices and device."""
