# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Guidance of a multicopter, and the rules for its gains and limits."""
