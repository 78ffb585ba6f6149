# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Files of routes, missions and fences, read into waypoints of the local tangent plane."""
