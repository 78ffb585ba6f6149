# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Effects of inputs and models of an aircraft from flights.

The flights are in simulation, over a bridge, or in logs of autopilots.
"""
