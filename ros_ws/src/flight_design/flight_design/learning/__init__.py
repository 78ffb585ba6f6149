# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Learning in flight: A and B are identified from the controller's ticks, and designs proposed.

Between two identifications the aircraft is tested for damage.
"""
