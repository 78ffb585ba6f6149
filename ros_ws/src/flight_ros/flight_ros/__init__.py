# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Shared ROS code of the RISE-DI flight stack: topics, parameters, messages as named vectors, base
class of a node.
"""
