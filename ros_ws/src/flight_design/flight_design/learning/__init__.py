# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Learning in flight: identify A and B from the ticks of the controller, design for them, propose.

Between two identifications the aircraft is tested for damage.
"""
