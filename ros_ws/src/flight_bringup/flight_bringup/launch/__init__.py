# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What the launch files share. Needs `launch` and `launch_ros`, which come with a full ROS 2 alone."""
