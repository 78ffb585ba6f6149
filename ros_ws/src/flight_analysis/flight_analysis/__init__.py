# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Analysis of flights without ROS: scenarios, the closed loop in one process, metrics, the report.

The Python interface is the package `rise_di`.
"""
