# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""A real autopilot in the simulated aircraft's place: channel maps, the conversion, engagement and silence, the node."""
