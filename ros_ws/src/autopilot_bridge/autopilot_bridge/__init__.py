# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Bridge to an autopilot, in place of the simulated aircraft.

It holds the channel maps, the conversion, the engagement, the failsafe and the node.
"""
