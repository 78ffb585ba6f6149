# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Control laws beside RISE-DI, as pure steps over a fleet, and what each of them may see."""
