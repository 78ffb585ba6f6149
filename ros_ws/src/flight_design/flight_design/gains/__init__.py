# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Selection of the law's gains and observers for an aircraft, with the margins of the loop."""
