# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The controller as C99, and the proof that C and Python give the same bits. See docs/export.md."""
