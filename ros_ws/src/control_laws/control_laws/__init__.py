# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Control laws to compare with RISE-DI. Each law has a module with its equations."""
