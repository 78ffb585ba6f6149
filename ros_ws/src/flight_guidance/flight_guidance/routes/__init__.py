# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read files of routes, missions and fences as waypoints in the local tangent plane."""
