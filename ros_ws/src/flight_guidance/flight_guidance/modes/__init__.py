# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The modes of guidance: what is flown now, and the legs and the landing of a route."""
