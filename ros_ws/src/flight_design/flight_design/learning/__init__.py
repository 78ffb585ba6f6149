# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Learning in flight: A and B from the ticks of the controller, proposals of an observer, tests for
damage, the node.
"""
