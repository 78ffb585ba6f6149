# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Learn an aircraft in flight: identify A and B from the controller's ticks, and propose designs.

Between two identifications the aircraft is tested for damage.
"""
