# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Decide in the controller which models learned in flight are used, and which are dropped again."""
