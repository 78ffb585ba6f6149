# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Export the controller as C99, and prove that C and Python give the same bits.

See docs/export.md.
"""
