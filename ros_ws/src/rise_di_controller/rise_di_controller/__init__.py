# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""RISE dynamic inversion: a control law from the measured output only.

Beside the law are a guard, and a ROS 2 node with a fixed rate.
"""
