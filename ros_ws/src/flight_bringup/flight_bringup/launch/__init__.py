# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Code that the launch files share.

The code needs the packages `launch` and `launch_ros`, which only a full ROS 2 has.
"""
