# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Take, refuse or give up models that are learned in flight, on the controller's side."""
