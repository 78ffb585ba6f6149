# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Analyse flights without ROS: scenarios, the closed loop in one process, metrics and report.

The Python interface is the package `rise_di`.
"""
