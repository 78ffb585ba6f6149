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
| `file_kinds` | names the kind of a file by its first bytes |
| `open_log` | opens the files of a log for every reader: MCAP, packed files, compressed messages |
| `scan` | reads the records of an intact, truncated or damaged MCAP file |
| `follow` | reads a growing log |
| `repair` | rebuilds a truncated or damaged bag |
| `stored_messages` | lists the messages of a bag as bytes, and the parameter changes |
| `named_vectors` | decodes messages as named vectors |
| `tape_reader`, `tape_writer` | convert between a bag and a `Tape` |
| `playback` | schedules the messages of a bag for sending |
| `age_of_u` | reads the age of u at the aircraft |
| `latency` | computes the time from y to u |
"""
