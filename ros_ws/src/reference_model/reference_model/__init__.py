# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Reference model of the RISE-DI flight stack.

Commands u_m(t) and x_m_dot = A_m x_m + B_m u_m give y_m = C x_m.
"""
