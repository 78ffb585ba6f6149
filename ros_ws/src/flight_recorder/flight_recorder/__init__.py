# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Records the topics of a flight to a bag, which is a log in MCAP with the layout of rosbag2."""
