# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The law of the paper, the protocol of every control law, and the linear loop of a law."""
