# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""RISE dynamic inversion: the control law from the measured output alone, and its fixed-rate ROS 2 node."""
