# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Compute what the linear loop of a controller tolerates before it becomes unstable.

| module | does |
|---|---|
| `delay_margin` | the delay at the limit of stability |
| `input_margins` | phase, gain, sensitivity, disks and damping of an aircraft, or of many |
| `told` | compares what the controller was told of its aircraft with the aircraft that flies |
| `loop_margins` | the loop of a scenario, and all its margins |
| `uncertain_loop` | all aircraft of a box as one loop with a block of deviations |
| `worst_case` | searches the worst aircraft of a box |
| `structured_value` | bounds the structured singular value |
| `branch_and_bound` | proves stability over the box, which it splits where necessary |
| `guarantee` | the largest box for which stability and a disk are proved |
| `saturation` | the largest part of a box with a proof for any limits of one input |
| `certificate` | a guarantee as a file, which can be checked without this stack |
"""
