# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Learning in flight: A and B from the ticks of the controller, their design, and the node.

The aircraft is tested for damage between two identifications.
"""
