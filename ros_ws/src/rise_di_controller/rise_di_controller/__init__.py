# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""RISE dynamic inversion: a control law that uses the measured output only, its guard, and a ROS 2 node with a fixed rate."""
