# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Launch files, process runner, monitor and player of the RISE-DI flight stack."""
