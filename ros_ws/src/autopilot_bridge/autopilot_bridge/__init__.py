# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Bridge to an autopilot, in place of the simulated aircraft: channel maps, conversion, engagement,
failsafe, node.
"""
