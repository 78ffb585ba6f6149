# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Flights without ROS: the closed loop in one process, MCAP bag to tape, metrics, the report page."""
