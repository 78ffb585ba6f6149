# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The fence: zones, the last safe turn, and the ways home inside the fence."""
