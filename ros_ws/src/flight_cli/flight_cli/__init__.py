# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The `rise-di` command of the RISE-DI flight stack, with a module for each subcommand."""
