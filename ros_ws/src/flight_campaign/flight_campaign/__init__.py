# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Thousands of uncertain aircraft at once, and other control laws beside RISE-DI."""
