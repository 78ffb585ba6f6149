# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""What the linear loop of a controller tolerates.

| module | does |
|---|---|
| `delay_margin` | the delay at the limit of stability |
| `input_margins` | phase, gain, sensitivity, disks and damping of an aircraft, or of many |
| `told` | what the controller was told of its aircraft, beside the aircraft that flies |
| `loop_margins` | the loop of a scenario, and all margins of it |
| `uncertain_loop` | the box of uncertain aircraft as a loop with a block of deviations |
| `worst_case` | searches the worst aircraft of a box |
| `structured_value` | bounds the structured singular value |
| `branch_and_bound` | proves stability over the box, which it splits where necessary |
| `guarantee` | the largest box for which stability and a disk are proved |
| `saturation` | the largest part of a box that is proved with any limits of one input |
| `certificate` | a guarantee as a file, which can be checked without this stack |
"""
