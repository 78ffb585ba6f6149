# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Show a flight on a page, live or recorded.

The page follows the growing log. Its server joins the ROS graph only to control the flight.

| module | does |
|---|---|
| `series` | keeps the samples of a topic in bounded memory |
| `flight` | follows the log of a run: samples, events, state |
| `page_topics` | names the topics and channels that the page reads |
| `server` | serves the page and the samples to browsers on this host |
| `control` | checks and carries out commands of the page, over a link to the nodes |
| `request_values` | refuses values of a request that are malformed or out of range |
| `foxglove_server` | serves a log to viewers of the Foxglove protocol (optional) |
| `watch` | finds the run and serves it until Ctrl-C |
| `text` | shows a flight in a terminal |
| `page/` | the page with markup, style and scripts |
"""
