# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Follow the log of a run, live or recorded.

A `Flight` keeps the samples by topic, the events and the state of the recording.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
from mcap.records import Attachment, Metadata
from numpy.typing import NDArray
from rosbags.serde.errors import SerdeError

from flight_analysis.closed_loop.scenario import Scenario, parse_scenario
from flight_analysis.metrics.controller_log import known_entries
from flight_analysis.metrics.settling import settling_bands
from flight_analysis.report.display_units import display_unit
from flight_analysis.report.recorded_flight import log_account
from flight_core.modes import Mode
from flight_core.parameters import ParameterError
from flight_core.rates import NANOSECONDS
from flight_core.tape import Signal, Tape
from flight_core.text import printable
from flight_core.vectors import FloatArray
from flight_guidance.odometry import ROUTE_FRAMES
from flight_guidance.routes.route_file import Waypoint
from flight_log.bag import CHANNEL_UNITS, LOST_MESSAGES, SCENARIO_MEDIA_TYPE, full_names
from flight_log.disk import is_locked
from flight_log.engagements import ENGAGEMENT, KEY_VALUE
from flight_log.flight_processes import LOG, ROSOUT
from flight_log.follow import Follower, Messages
from flight_log.learning_messages import DIAGNOSTIC_ARRAY, LEARNING
from flight_log.log_content import StoredFile
from flight_log.log_messages import LogMessage, bounded, log_message
from flight_log.named_vectors import (
    JOINT_STATE,
    Decoder,
    Samples,
    decoder,
    flight_start_ns,
    tables,
    typestore,
)
from flight_log.stored_messages import PARAMETER_EVENT, PARAMETER_EVENTS
from flight_log.tape_reader import read_run, topics_text
from flight_view.background import Line
from flight_view.description import (
    MODES,
    ParameterTicks,
    mission,
    rms_by_model,
    scenario_description,
)
from flight_view.page_topics import GROUPS, IN_TICKS, LEARNED, RATES
from flight_view.series import Series

SHARED = (ROSOUT, PARAMETER_EVENTS)  # topics that all aircraft share
POSE = "pose"
ROUTE = "route"
ROUTE_TYPE = "nav_msgs/msg/Path"
# Bytes of the log, about 1 s, that a busy host may leave unread. Above this the state is "reading".
LIVE_BACKLOG = 200_000
MAX_EVENTS = 5000
MAX_NOTES = 50
MAX_CHANNELS = 200
MAX_SPANS = 200
BATCH = 2000  # messages that are decoded together
SILENT = 1.0  # time without a sample after which the state is "no data", s


@dataclass
class _Topic:
    name: str  # name without the namespace
    decode: Decoder
    messages: list[bytes] = field(default_factory=list)  # messages that are not decoded yet
    names: tuple[str, ...] = ()  # names of all channels
    columns: NDArray[np.intp] | None = None  # columns of the channels that are kept


class Flight:
    """A flight in a growing log. `update` reads the new messages.

    `namespace` selects an aircraft, by default the first one in the log. `scenario` replaces the
    scenario in the log. `background` has lines for the map, as `read_background` returns them.
    `remaps` has the same meaning as in `read_run`.
    """

    def __init__(
        self,
        run: Path,
        now: Callable[[], float] = time.monotonic,
        namespace: str | None = None,
        scenario: StoredFile | None = None,
        background: Sequence[Line] = (),
        remaps: Mapping[str, str] = {},
    ) -> None:
        self.run = run
        self._remaps = remaps
        self.name = printable(run.stem if run.is_file() else run.resolve().name)
        self.samples: dict[str, Series] = {}  # samples by topic
        self.events: list[LogMessage] = []
        # What a page shows apart from the samples, ready for JSON. At first it is the names of the
        # modes, and more is added when the scenario is read.
        self.description: dict[str, Any] = {
            "name": self.name,
            "modes": MODES,
            "background": background,
        }
        self.notes: list[str] = []
        self.described = 0  # number of changes of `description`
        self.scenario: Scenario | None = None  # None until it is read
        self.digest = 0  # digest of the parameters in the newest tick, which float32 cannot hold
        self.bands: dict[str, float] = {}  # half-widths of the settling bands, SI
        self._follower = Follower(run, self._rate_of, full_names(remaps))
        self._topics: dict[str, _Topic] = {}  # topics by full name
        self._asked = namespace is not None
        self._namespace = None if namespace is None else f"/{namespace.strip('/')}".rstrip("/")
        self._kinds: dict[str, str] = {}  # types of the topics of the log, by full name
        self._unreadable = 0
        self._start_ns: int | None = None  # stamp of flight time 0 from `truth`
        self._reference_ns: int | None = None  # stamp of the first y_m
        self._first_ns: int | None = None
        self._mode = -1
        self._banded_ns = 0  # length of the record of ticks from which the bands were computed
        self._flown: list[ParameterTicks] = []
        self._now = now
        self._changed = now()
        self._behind = False  # whether there is more to read at once
        self._account: Thread | None = None  # thread that counts the samples of an ended log
        self._lacks: list[str] = []
        self._given = scenario
        if scenario is not None:
            self._take_scenario(scenario.content)

    @property
    def start_ns(self) -> int:
        """Stamp of flight time 0.

        It comes from `truth`. A log without `truth` begins at the first y_m, where the commands
        begin, and a log without y_m at its earliest stamp.
        """
        return next(
            (
                stamp
                for stamp in (self._start_ns, self._reference_ns, self._first_ns)
                if stamp is not None
            ),
            0,
        )

    @property
    def aircraft(self) -> str:
        """The namespace of the aircraft, or the name of the run if there is no namespace."""
        return (self._namespace or "").strip("/") or self.name

    @property
    def end(self) -> float:
        """Flight time of the newest sample, s, or 0 if there are no samples."""
        newest = [int(samples.stamp_ns[-1]) for samples in self.samples.values() if samples.count]
        return (max(newest) - self.start_ns) / NANOSECONDS if newest else 0.0

    def state(self) -> str:
        """Return the state of the recording as a word.

        The words are "waiting", "reading" (of what is already recorded), "recording", "no data",
        "interrupted" and "ended".
        """
        if self._behind:
            return "reading"
        if self._follower.complete:
            return "ended"
        if self._now() - self._changed <= SILENT:
            return "recording" if self.samples else "waiting"
        path = self._follower.path
        if path is None:
            return "waiting"
        with suppress(OSError):
            if is_locked(path):
                return "no data" if self.samples else "waiting"
        return "interrupted"

    @property
    def models(self) -> dict[str, Any]:
        """Headings and rows of the table of rms errors for each model, as in the report.

        They are empty without a learner.
        """
        if LEARNED not in self.samples or not self._flown:
            return {}
        entries = self.samples[LEARNED]
        is_proposed = entries.values[:, entries.names.index("proposed")] > 0.0
        proposed_ns = entries.stamp_ns[is_proposed].tolist()
        return rms_by_model(self._flown, self.start_ns, self.scenario, proposed_ns)

    def faults(self) -> list[str]:
        """Sentences on what the log lacks."""
        follower = self._follower
        sentences = [*self.notes, *self._lacks]
        if follower.complete and not self.samples:
            among = f" among {bounded(topics_text(self._kinds))}" if self._kinds else ""
            sentences.append(f"no sample of a flight{among}")
        if follower.fault:
            sentences.append(f"the log cannot be read further: {bounded(follower.fault)}")
        if follower.damaged:
            sentences.append(f"{follower.damaged} damaged parts of the log are left out")
        if self._unreadable:
            sentences.append(f"{self._unreadable} samples are unreadable")
        refusals = {
            name: samples.refused for name, samples in self.samples.items() if samples.refused
        }
        sentences += [
            f"{name}: {count} samples out of order are left out" for name, count in refusals.items()
        ]
        return sentences

    def update(self, budget: float = math.inf) -> bool:
        """Read new messages for at most about `budget` s.

        Returns whether there was anything to read. The next call continues. Raises ParameterError
        if the log cannot be read, or if the folder has several bags.
        """
        deadline = time.monotonic() + budget
        news = False
        self._behind = False
        try:
            for record in self._follower.read():
                news = True
                if isinstance(record, Messages):
                    self._take(record)
                else:
                    self._take_record(record)
                if time.monotonic() > deadline:
                    self._behind = self._follower.backlog > LIVE_BACKLOG
                    break
        except OSError as error:
            raise ParameterError(
                f"{self.run}: cannot be read ({error.strerror}), expected the log of a flight"
            ) from None
        if news:
            for topic in self._topics.values():
                self._decode(topic)
            self._changed = self._now()
            self._update_bands()
        elif self._account is None and self.state() in {"ended", "interrupted"}:
            self._account = Thread(target=self._count, daemon=True)
            self._account.start()
        return news

    def counted(self) -> None:
        """Wait until the samples of an ended log are counted."""
        if self._account is not None:
            self._account.join()

    def _count(self) -> None:
        """Find what an ended log lacks.

        The page reads only a part of the samples, but this method reads the whole log.
        """
        try:
            run = read_run(self.run, self._namespace, None, self._remaps)
            if self._given is not None:
                run = run._replace(scenario=self._given)
            account = log_account(run)
            lacks = () if account is None else account.notes()
            self._lacks = [bounded(sentence) for sentence in (*run.tape.notes, *lacks)]
        except (ParameterError, OSError):
            return
        except RuntimeError as error:
            # The process is ending, so the reader cannot start a thread any more.
            if "shutdown" not in str(error):
                raise

    def _rate_of(self, topic: str, type_name: str) -> float:
        if len(self._kinds) < MAX_CHANNELS:
            self._kinds[topic] = type_name
        if (topic, type_name) in ((ROSOUT, LOG), (PARAMETER_EVENTS, PARAMETER_EVENT)):
            return math.inf
        if topic.endswith(ENGAGEMENT) and type_name == KEY_VALUE:
            return math.inf
        namespace, _, name = topic.rpartition("/")
        if (name, type_name) in ((ROUTE, ROUTE_TYPE), (LEARNING, DIAGNOSTIC_ARRAY)):
            return math.inf
        if type_name != JOINT_STATE or name not in RATES:
            return 0.0
        if self._namespace is None:
            self._namespace = namespace
        if namespace != self._namespace:
            if not self._asked:
                self._note(
                    f"another aircraft in the namespace {namespace or '/'} is not shown: "
                    f"--namespace {namespace or '/'}"
                )
            return 0.0
        return RATES[name]

    def _is_shown(self, namespace: str) -> bool:
        """Return whether the page shows the aircraft in a namespace, or may come to show it."""
        return self._namespace in {None, namespace}

    def _note(self, sentence: str) -> None:
        if (line := bounded(sentence)) not in self.notes and len(self.notes) < MAX_NOTES:
            self.notes.append(line)

    def _take_record(self, record: Attachment | Metadata) -> None:
        if isinstance(record, Metadata):
            if record.name == LOST_MESSAGES:
                for topic, count in record.metadata.items():
                    self._note(f"{topic}: the recorder lost {count} messages")
            elif record.name == CHANNEL_UNITS and "units" not in self.description:
                units = {name: display_unit(unit) for name, unit in record.metadata.items()}
                self.description |= {"units": {name: asdict(unit) for name, unit in units.items()}}
                self.described += 1
        elif record.media_type == SCENARIO_MEDIA_TYPE and "units" not in self.description:
            self._take_scenario(record.data)

    def _take_scenario(self, content: bytes) -> None:
        try:
            path = Path("scenario.yaml")
            self.scenario = parse_scenario(content, path)
            self.described += 1
            # This reads the airframe, whose file may be missing on this machine.
            self.description |= scenario_description(self.scenario)
        except ParameterError as error:
            self._note(f"units, limits and commands are unknown: {error}")

    def _take(self, messages: Messages) -> None:
        if messages.type_name != JOINT_STATE:
            self._take_events(messages)
            return
        topic = self._topics.get(messages.topic)
        if topic is None:
            if (decode := decoder(messages.type_name)) is None:
                return
            topic = self._topics[messages.topic] = _Topic(messages.topic.rpartition("/")[2], decode)
            if topic.name == "internals":
                self._follower.skip({f"{self._namespace}/{name}" for name in IN_TICKS})
        topic.messages += messages.data
        if len(topic.messages) >= BATCH:
            self._decode(topic)

    def _decode(self, topic: _Topic) -> None:
        """Decode all waiting messages of a topic together, because one by one would be slow."""
        messages = topic.messages
        topic.messages = []
        for decoded in map(topic.decode, tables(messages)):
            self._unreadable += decoded.unreadable
            for samples in decoded.samples:
                self._take_samples(topic, samples)

    def _take_samples(self, topic: _Topic, decoded: Samples) -> None:
        names, stamp_ns, values = decoded.names, decoded.stamp_ns, decoded.values
        # A pose has only the channels that a bridge has received so far. Poses with fewer channels
        # than the largest pose are left out.
        if topic.name == POSE and set(names) > set(topic.names):
            topic.columns = None
        # A second publisher may have another order, so values are matched by name.
        if names != topic.names and sorted(names) == sorted(topic.names):
            names, values = topic.names, values[:, [names.index(name) for name in topic.names]]
        if topic.columns is None:
            group = GROUPS.get(topic.name)
            columns = [
                i
                for i, name in enumerate(names)
                if group is None or name in group or name.partition(".")[0] in group
            ]
            if len(columns) > MAX_CHANNELS:
                self._note(
                    f"{topic.name}: {len(columns) - MAX_CHANNELS} of its channels are not shown"
                )
            topic.names = names
            topic.columns = np.array(columns[:MAX_CHANNELS], dtype=np.intp)
            narrower = self.samples.get(topic.name)
            samples = self.samples[topic.name] = Series(
                tuple(bounded(names[i]) for i in topic.columns)
            )
            # After this, pages read the topic again.
            samples.thinned = 0 if narrower is None else narrower.thinned + 1
        samples = self.samples[topic.name]
        if topic.name == POSE and set(names) < set(topic.names):
            return
        if names != topic.names or values.shape[1] != len(names):
            self._unreadable += len(stamp_ns)
            return
        earliest = int(stamp_ns.min())
        self._first_ns = earliest if self._first_ns is None else min(self._first_ns, earliest)
        if topic.name == "y_m" and self._reference_ns is None:
            self._reference_ns = earliest
        if topic.name == "truth" and "t" in names and self._start_ns is None:
            self._start_ns = flight_start_ns(int(stamp_ns[0]), float(values[0, names.index("t")]))
        if topic.name == "internals" and "mode" in names:
            self._take_modes(stamp_ns, values[:, names.index("mode")])
        if (
            topic.name == "internals"
            and {"mode", "parameters"} <= set(names)
            and math.isfinite(digest := values[-1, names.index("parameters")])
        ):
            self.digest = int(digest)
            self._take_errors(stamp_ns, names, values)
        samples.append(stamp_ns, values[:, topic.columns])
        if topic.name == LEARNED:
            entries = known_entries(
                Signal(samples.stamp_ns, samples.names, samples.values.astype(float))
            )
            self.description |= {"learned": entries}
            self.described += 1

    def _take_errors(
        self, stamp_ns: NDArray[np.int64], names: Sequence[str], values: FloatArray
    ) -> None:
        """Sum the squares of e over the engaged ticks, for each set of parameters."""
        digests = values[:, names.index("parameters")]
        is_engaged = values[:, names.index("mode")] == Mode.ENGAGED
        errors = {
            bounded(name[2:]): values[:, k]
            for k, name in enumerate(names[:MAX_CHANNELS])
            if name.startswith("e.")
        }
        for rows in np.split(np.arange(len(digests)), np.flatnonzero(np.diff(digests)) + 1):
            digest = float(digests[rows[0]])
            start_ns = int(stamp_ns[rows[0]])
            stop_ns = int(stamp_ns[rows[-1]])
            engaged_rows = rows[is_engaged[rows]]
            squares = {name: float(np.sum(e[engaged_rows] ** 2)) for name, e in errors.items()}
            span = ParameterTicks(
                digest=digest,
                start_ns=start_ns,
                stop_ns=stop_ns,
                ticks=len(engaged_rows),
                squares=squares,
            )
            if self._flown and (before := self._flown[-1]).digest == digest:
                self._flown.pop()
                total = {name: square + before.squares[name] for name, square in squares.items()}
                span = before._replace(
                    stop_ns=stop_ns, ticks=before.ticks + len(engaged_rows), squares=total
                )
            if len(self._flown) < MAX_SPANS:
                self._flown.append(span)

    def _take_modes(self, stamp_ns: NDArray[np.int64], modes: NDArray[np.float64]) -> None:
        changes = np.flatnonzero(np.diff(modes, prepend=self._mode))
        for k in changes.tolist():
            number = modes[k]
            is_mode = number in set(Mode)
            self._add_event(
                LogMessage(
                    stamp_ns=int(stamp_ns[k]),
                    kind="mode",
                    text=Mode(int(number)).name if is_mode else f"mode {number:g}",
                )
            )
        self._mode = modes[-1]

    def _take_events(self, messages: Messages) -> None:
        namespace = (
            messages.topic.removesuffix(ENGAGEMENT)
            .removesuffix(f"/{ROUTE}")
            .removesuffix(f"/{LEARNING}")
        )
        if messages.topic not in SHARED and not self._is_shown(namespace):
            return
        store = typestore()
        for sent_ns, data in zip(messages.sent_ns, messages.data, strict=True):
            try:
                message: Any = store.deserialize_cdr(data, messages.type_name)
            except SerdeError:
                self._unreadable += 1
                continue
            if messages.type_name == ROUTE_TYPE:
                if message.header.frame_id not in ROUTE_FRAMES:
                    continue
                places = [stamped_pose.pose.position for stamped_pose in message.poses]
                self._take_route(sent_ns, [Waypoint(place.y, place.x, place.z) for place in places])
                continue
            has_begun = self._first_ns is not None
            event = log_message(message, messages.type_name, sent_ns, has_begun=has_begun)
            if event is not None and (event.namespace is None or self._is_shown(event.namespace)):
                self._add_event(event)

    def _take_route(self, sent_ns: int, waypoints: Sequence[Waypoint]) -> None:
        """Replace the route by a route that was received in flight.

        If guidance refuses the new route, the old route stays.
        """
        guidance = None if self.scenario is None else self.scenario.guidance
        if guidance is None:
            return
        try:
            self.description |= mission(guidance, waypoints)
        except ParameterError:
            # If guidance refuses the route, the log has a message about it.
            return
        self.described += 1
        self._add_event(
            LogMessage(stamp_ns=sent_ns, kind=ROUTE, text=f"{len(waypoints)} waypoints")
        )

    def _add_event(self, event: LogMessage) -> None:
        if len(self.events) < MAX_EVENTS:
            self.events.append(replace(event, text=bounded(event.text)))
        else:
            self._note(f"events after the first {MAX_EVENTS} are left out")

    def _update_bands(self) -> None:
        """Update the settling bands whenever the record of ticks has become a tenth longer."""
        samples = self.samples.get("internals")
        if samples is None or samples.count < 2:
            return
        recorded_ns = int(samples.stamp_ns[-1] - samples.stamp_ns[0])
        if recorded_ns <= 1.1 * self._banded_ns:
            return
        y, y_m = (self._ticks(group) for group in ("y", "y_m"))
        if y.names and y.names == y_m.names:
            self.bands = settling_bands(Tape({"y": y, "y_m": y_m}))
        self._banded_ns = recorded_ns

    def _ticks(self, group: str) -> Signal:
        """Return a group of channels from the samples of the topic `internals`."""
        ticks = self.samples["internals"]
        columns = [k for k, name in enumerate(ticks.names) if name.startswith(f"{group}.")]
        names = tuple(ticks.names[k].removeprefix(f"{group}.") for k in columns)
        return Signal(ticks.stamp_ns, names, ticks.values[:, columns].astype(float))
