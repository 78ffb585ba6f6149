# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The only shared ROS code of the RISE-DI flight stack: topics, parameters, messages as named vectors, node skeleton."""
