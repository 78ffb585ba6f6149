# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The bridge to an autopilot, which takes the place of the simulated aircraft.

The package has the channel maps and their conversion, the engagement, the failsafe and the node. A
channel map is a file that says which message field of the autopilot each channel of y and u is in.
"""
