# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Airframes: their files, models of other tools, and the laws of physics that they must obey."""
