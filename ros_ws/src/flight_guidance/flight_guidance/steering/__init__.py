# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The laws of guidance: from a path, an altitude or an attitude to body rates."""
