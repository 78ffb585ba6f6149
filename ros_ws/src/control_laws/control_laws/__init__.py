# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Control laws to compare with RISE-DI, a module of equations per law."""
