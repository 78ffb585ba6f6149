# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The bridge to an autopilot, which replaces the simulated aircraft.

It has the channel maps, their conversion, the engagement, the failsafe and the node.
"""
