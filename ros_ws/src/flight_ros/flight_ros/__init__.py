# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Shared ROS code of the RISE-DI flight stack.

It has topics, parameters, messages as named vectors, and the base class of a node.
"""
