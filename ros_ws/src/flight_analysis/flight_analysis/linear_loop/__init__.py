# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute what the linear loop of a controller tolerates before it becomes unstable.

A box is the set of all aircraft whose entries of A and B, and lags of actuators, lie within given
intervals.

| module | does |
|---|---|
| `delay_margin` | finds the delay at the limit of stability |
| `input_margins` | computes phase, gain, sensitivity, disks and damping of one or many aircraft |
| `told` | compares the lags and delays that the controller was told with those of the aircraft |
| `loop_margins` | builds the loop of a scenario and computes all its margins |
| `uncertain_loop` | writes all aircraft of a box as one loop with a block of deviations |
| `worst_case` | searches the worst aircraft of a box |
| `structured_value` | bounds the structured singular value |
| `branch_and_bound` | proves stability over the box, which it splits where necessary |
| `guarantee` | finds the largest box for which stability and a disk margin can be proved |
| `saturation` | finds the largest box with a proof that holds for any limits of one input |
| `certificate` | writes a guarantee to a file that can be checked without this stack |
"""
