# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Shared words of the RISE-DI flight stack: validated parameters, named vectors, integrators, rates, scenario files, tapes."""
