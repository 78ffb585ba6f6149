# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Bridge to an autopilot, in place of the simulated aircraft.

Channel maps, conversion, engagement, failsafe and node are here.
"""
