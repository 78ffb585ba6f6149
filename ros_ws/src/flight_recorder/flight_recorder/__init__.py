# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Records the topics of a flight to a rosbag2-layout MCAP bag."""
