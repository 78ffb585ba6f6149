# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The bridge to an autopilot, which replaces the simulated aircraft.

The package has the channel maps and their conversion, the engagement, the failsafe and the node.
"""
