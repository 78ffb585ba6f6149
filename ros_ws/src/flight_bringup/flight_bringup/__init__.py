# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Scenarios, launch files and the rise-di command of the RISE-DI flight stack."""
