# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Identification of the effects of inputs, and of models of an aircraft, from flights.

The flights are simulated, flown over a bridge, or recorded in logs of autopilots.
"""
