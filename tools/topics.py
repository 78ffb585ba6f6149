# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Write the table of topics in docs/topics.md, and the access control policy of DDS Security.

Both come from flight_core.topics.
"""

from pathlib import Path
from xml.etree import ElementTree

from autopilot_bridge.map_rows import MAVLINK
from autopilot_bridge.params import LIBRARY, load_map
from flight_core.topics import FLIGHT, NODES, TOPICS, VECTOR, Topic, published_by

REPOSITORY = Path(__file__).resolve().parents[1]
PAGE = REPOSITORY / "docs" / "topics.md"
POLICY = (
    REPOSITORY
    / "ros_ws"
    / "src"
    / "flight_bringup"
    / "flight_bringup"
    / "security"
    / "flight.policy.xml"
)
HEAD = ("| topic | from -> to | channels, or message and content |", "|---|---|---|")
FURTHER_ROWS = (
    "| `commands` | `rise-di import` -> log | trim + u by input, SI, of an imported flight |",
    "| `alive/<role>` | all nodes, in lockstep | `std_msgs/msg/String`; liveliness |",
)
POLICY_COMMENT = """ SPDX-FileCopyrightText: RISE-DI contributors
     SPDX-License-Identifier: Apache-2.0

     Access control for DDS Security (docs/security.md): an enclave for each node with the topics that it
     may publish and subscribe and the services that it offers. No node may call a service, except the
     bridge, which activates and deactivates the controller: add a profile for each client that sets
     parameters, changes the controller's state or engages the bridge. Lockstep needs `alive/*`, `clock` and
     `recorded`. The bridge has the topics of all maps of the library: delete those of other autopilots. Add
     the topics of `recorder.topics` to the recorder. Guidance publishes `/tf` where tf2_msgs is installed.
     `python -m tools.topics` writes this file, tests/ros/flight_bringup/test_policy.py compares it with the nodes. """  # noqa: E501 - a text as it is written

IN_LOCKSTEP = NODES[:-1]  # all nodes but the bridge
MONITOR = "monitor"
TYPES = "~get_type_description"
PARAMETER_SERVICES = (
    *(
        "describe_parameters",
        "get_parameter_types",
        "get_parameters",
        "get_type_description",
        "list_parameters",
    ),
    *("set_parameters", "set_parameters_atomically"),
)
SERVICES = {
    "guidance": ("engage", "hold", "skip", "resume", "home"),
    "controller": (
        "change_state",
        "get_available_states",
        "get_available_transitions",
        "get_state",
        "get_transition_graph",
    ),
    "bridge": ("engage", "engage_blind"),
}
FURTHER = {"guidance": ["/tf"], "controller": ["~transition_event"]}  # topics of ROS 2


def table() -> str:
    """Return the table of the topics in Markdown."""
    return "\n".join([*HEAD, *map(_row, TOPICS), *FURTHER_ROWS])


def _row(topic: Topic) -> str:
    ends = topic.ends.replace("nodes", "all nodes").replace("_", " ")
    message = "" if topic.message == VECTOR else f"`{topic.message}`; "
    return f"| `{topic.name}` | {ends} | {message}{topic.meaning} |"


def page() -> str:
    """Return the text of docs/topics.md, with the table of the present topics."""
    text = PAGE.read_text(encoding="utf-8")
    begin = text.index("| topic | from -> to |")
    return text[:begin] + table() + text[text.index("\n\n", begin) :]


def policy() -> str:
    """Return the access control policy of DDS Security, as XML."""
    root = ElementTree.Element("policy", version="0.2.0")
    enclaves = ElementTree.SubElement(root, "enclaves")
    for node in (*NODES, MONITOR):
        enclave = ElementTree.SubElement(enclaves, "enclave", path=f"/flight/{node}")
        profile = ElementTree.SubElement(
            ElementTree.SubElement(enclave, "profiles"), "profile", ns="/", node=node
        )
        sent_topics, received, requested = _of_maps() if node == "bridge" else ([], [], [])
        alive = [f"alive/{role}" for role in IN_LOCKSTEP if node in IN_LOCKSTEP]
        liveliness = f"alive/{node}"
        publishes = [
            *published_by(node),
            *FURTHER.get(node, []),
            *(name for name in alive if name == liveliness),
            *sent_topics,
        ]
        subscribes = [
            topic.name
            for topic in TOPICS
            if node in topic.subscribers or (node == "recorder" and topic in FLIGHT)
        ]
        _list(profile, "topics", "publish", publishes)
        _list(
            profile,
            "topics",
            "subscribe",
            [*subscribes, *(name for name in alive if name != liveliness), *received],
        )
        _list(profile, "services", "request", requested)
        replies = [f"~{name}" for name in (*SERVICES.get(node, ()), *PARAMETER_SERVICES)]
        _list(profile, "services", "reply", [TYPES] if node == MONITOR else replies)
    ElementTree.indent(root)
    body = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n<!--{POLICY_COMMENT}-->\n{body}\n'


def _list(profile: ElementTree.Element, kind: str, verb: str, names: list[str]) -> None:
    if names:
        group = ElementTree.SubElement(profile, kind, {verb: "ALLOW"})
        for name in names:
            ElementTree.SubElement(group, kind[:-1]).text = name


def _of_maps() -> tuple[list[str], list[str], list[str]]:
    """Return the topics that the bridge sends and receives, and the services that it requests.

    The maps of the library and of the examples name these topics and services.
    """
    files = (
        path
        for folder in (LIBRARY, REPOSITORY / "examples" / "maps")
        for path in sorted(folder.glob("*.yaml"))
    )
    rows = {row for path in files for row in load_map(str(path)).used_topics()}
    sent_topics: set[str] = set()
    received: set[str] = set()
    requested = {"controller/change_state", "controller/get_state"}
    for key, topic, kind in rows:
        is_sent = key.startswith("messages.")
        is_mavlink = kind.startswith(f"{MAVLINK}/")
        if "/srv/" in kind:
            requested.add(topic)
        elif is_mavlink and not is_sent:  # the bridge publishes it for the recorder
            sent_topics.add(topic)
        elif not is_mavlink:
            (sent_topics if is_sent else received).add(topic)
    return sorted(sent_topics), sorted(received), sorted(requested)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    POLICY.write_text(policy(), encoding="utf-8")
