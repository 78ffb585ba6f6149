# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Airframes: files with units and signs, models of other tools, and what physics fixes in them."""
