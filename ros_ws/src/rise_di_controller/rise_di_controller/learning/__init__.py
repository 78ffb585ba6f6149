# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Models learned in flight, on the side of the controller: taken, refused, or given up."""
