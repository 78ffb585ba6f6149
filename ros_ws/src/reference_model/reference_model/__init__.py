# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Reference model of the RISE-DI flight stack.

The model x_m_dot = A_m x_m + B_m u_m, y_m = C x_m turns commands u_m(t) into the reference y_m.
"""
