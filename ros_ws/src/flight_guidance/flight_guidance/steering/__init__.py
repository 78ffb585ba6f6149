# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The laws of guidance, which turn a path, an altitude or an attitude into body rates."""
