# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""RISE dynamic inversion: a control law that uses the measured output only.

The package also has a guard, and a ROS 2 node that runs the law at a fixed rate.
"""
