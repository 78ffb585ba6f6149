# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Keep an aircraft inside a fence: zones, the last safe turn, and the ways home."""
