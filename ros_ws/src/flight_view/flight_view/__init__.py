# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Show a flight on a page, live or recorded.

The page follows the growing log. Its server joins the ROS graph only to control the flight.

| module | does |
|---|---|
| `series` | keeps the samples of a topic in bounded memory |
| `flight` | follows the log of a run: samples, events, state |
| `description` | describes the scenario for the page |
| `background` | reads the background of the map from a GeoJSON file |
| `fleet` | gives the places of all aircraft of a fleet, for the map |
| `page_topics` | names the topics and channels that the page reads |
| `server` | serves the page and the samples to browsers on this host |
| `control` | checks and carries out commands of the page, over a link to the nodes |
| `control_client` | talks to the nodes of the flight for `control`, as a ROS 2 client |
| `request_values` | refuses values of a request that are malformed or out of range |
| `foxglove_server` | serves a log to viewers of the Foxglove protocol (optional) |
| `watch` | finds the run and serves it until Ctrl-C |
| `text` | shows a flight in a terminal |
| `page/` | the page with markup, style and scripts |
"""
