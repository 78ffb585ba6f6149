# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Export the controller as C99 code, and prove that it computes the same bits as Python.

See docs/export.md.
"""
