# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What a bag of the stack is: writing, reading, scanning and repairing it, without ROS."""
