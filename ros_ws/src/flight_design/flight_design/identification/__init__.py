# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Effects of inputs and models of an aircraft from flights, in simulation, over a bridge, or in
logs of autopilots.
"""
