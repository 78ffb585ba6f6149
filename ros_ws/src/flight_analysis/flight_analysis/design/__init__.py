# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Design of the controller: gain conditions and selection, identification, properties of airframes, the stability proof."""
