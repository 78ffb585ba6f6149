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
| `log_content` | reads the content of a bag's files for `tape_reader` |
| `columns` | keeps the samples of a topic as columns, long topics in a temporary file |
| `clock` | checks the stamps of a topic in the order of the recording |
| `repair` | rebuilds a truncated or damaged bag |
| `stored_messages` | lists the messages of a bag as bytes, and the parameter changes |
| `named_vectors` | decodes messages as named vectors |
| `tape_reader`, `tape_writer` | convert between a bag and a `Tape` |
| `playback` | schedules the messages of a bag for sending |
| `log_messages` | collects warnings, errors and other messages of a log in words |
| `flight_processes` | finds when each process of a flight was ready, and how long it lived |
| `engagements` | finds the engagements of a bridge |
| `learning_messages` | writes and reads what became of a learner's proposals |
| `age_of_u` | reads the age of u at the aircraft |
| `latency` | computes the time from y to u |
| `vehicle_log` | reads the logs of autopilots: DataFlash, tlog and ULog |
| `vehicle_readers`, `log_samples` | decode these logs for `vehicle_log`, and make tables of them |
| `vehicle_tables` | says in which message each format has a quantity |
| `flown_instance` | finds the sensor by which the autopilot flew, if a log has several |
| `dataflash`, `ulog_messages` | find the messages of a log on a card that lost bytes |
| `px4_parameters` | derives the rate and the delay of PX4's body rates from its parameters |
"""
