# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""The log of a flight, a rosbag2 bag of MCAP files, without ROS.

| module | does |
|---|---|
| `bag` | writes a bag: `BagWriter` |
| `rosbag2_metadata` | reads and makes metadata.yaml |
| `disk` | reserves disk space for the end of a file |
| `message_definitions` | finds the definition of a message type |
| `provenance` | collects versions, revision, host and command |
| `scan` | reads the records of an MCAP file that may be truncated or damaged |
| `follow` | reads a log while it is written |
| `repair` | rebuilds a truncated or damaged bag |
| `stored_messages` | lists the messages of a bag as bytes, and its parameter changes |
| `named_vectors` | decodes messages as named vectors |
| `tape_reader`, `tape_writer` | convert between a bag and a `Tape` |
| `playback` | schedules the messages of a bag to send them again |
| `latency` | computes the time from y to u |
"""
