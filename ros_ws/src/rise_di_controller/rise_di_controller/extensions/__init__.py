# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Extensions of the paper, all off by default: feedforward, observer, schedule, allocation."""
