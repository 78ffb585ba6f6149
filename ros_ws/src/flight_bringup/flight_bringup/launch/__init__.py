# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Shared code of the launch files. Needs `launch` and `launch_ros`, which only a full ROS 2 has."""
