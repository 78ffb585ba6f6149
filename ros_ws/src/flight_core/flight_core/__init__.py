# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Basics of the RISE-DI flight stack, without ROS.

They are parameters, named vectors, rates, integrators, scenario files, outcomes and the tape.
"""
