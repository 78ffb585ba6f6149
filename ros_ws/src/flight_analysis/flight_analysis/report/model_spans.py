# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find when the controller flew which parameters, and the error in each of these spans of time."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from flight_analysis.closed_loop.learning_loop import GUARANTEE, LOOP_DIGITS
from flight_analysis.metrics.errors import best_error, error_metrics
from flight_core.modes import Mode
from flight_core.tape import Tape


class ParameterSpan(NamedTuple):
    """A span of time in which the controller had the same parameters."""

    digest: int
    name: str  # name of the parameters, as in `model_names`
    start: float  # s
    stop: float  # s


class ModelSpan(NamedTuple):
    """The error over a span of time in which the controller had the same parameters."""

    name: str  # name of the parameters, as in `model_names`
    model: int  # index of the parameters; 0 for those at the start
    start: float  # s
    stop: float  # s
    rms: dict[str, float]  # rms of `best_error` by channel
    # Every aircraft is proved stable whose entries differ from the learned model by at most so many
    # times their stated deviations. None if these parameters were not learned, or if the log has no
    # guarantee.
    stable: float | None = None
    loop: str = ""  # name of the loop of that guarantee, the first digits of its digest


class KeptGuarantee(NamedTuple):
    """The guarantee of a learner's proposal, as it is in the log."""

    stable: float  # number of stated deviations, as in `ModelSpan`
    loop: str


def guarantees(tape: Tape) -> dict[int, KeptGuarantee]:
    """Return the guarantees of the learner's proposals, by the digest of their parameters."""
    if "learned" not in tape or GUARANTEE[-1] not in tape["learned"].names:
        return {}
    columns = (tape["learned"][name].tolist() for name in GUARANTEE)
    return {
        int(digest): KeptGuarantee(stable, f"{int(loop):0{LOOP_DIGITS}x}")
        for digest, stable, loop in zip(*columns, strict=True)
        if loop
    }


def model_names(first: Sequence[float], proposals: Sequence[float]) -> list[str]:
    """Name the sets of parameters of a flight, given the times of their first use, s.

    The times in `first` ascend, and the first set is named "start". `proposals` has the times of a
    learner's proposals, s. A set that was first used before all proposals is "file", "file 2" and
    so on. The other sets are "model 1", "model 2" and so on.
    """
    names = ["start"]
    for time in first[1:]:
        is_learned = any(instant <= time for instant in proposals)
        kind = "model" if is_learned else "file"
        number = sum(name.startswith(kind) for name in names) + 1
        names.append(f"{kind} {number}" if is_learned or number > 1 else kind)
    return names[: len(first)]


def parameter_spans(tape: Tape) -> list[ParameterSpan]:
    """Return the spans of time in which the controller had the same parameters.

    The result is empty if the log has no topic `internals`.
    """
    if "internals" not in tape or "parameters" not in tape["internals"].names:
        return []
    t = tape.time("internals")
    digests = tape["internals"]["parameters"]
    changes = np.flatnonzero(np.diff(digests, prepend=np.nan) != 0.0)
    first: dict[int, float] = {}
    for change in changes.tolist():
        first.setdefault(int(digests[change]), float(t[change]))
    proposals: list[float] = []
    if "learned" in tape:
        proposals = tape.time("learned")[tape["learned"]["proposed"] > 0.0].tolist()
    names = dict(zip(first, model_names(list(first.values()), proposals), strict=True))
    ends = [*t[changes[1:]].tolist(), *t[-1:].tolist()]
    return [
        ParameterSpan(digest, names[digest], start, stop)
        for digest, start, stop in zip(
            digests[changes].astype(np.int64).tolist(), t[changes].tolist(), ends, strict=True
        )
    ]


def errors_by_model(tape: Tape) -> list[ModelSpan]:
    """Return the rms of `best_error` for each span of time with the same parameters.

    The result is empty if nothing was learned. The rms covers the time in which the law is engaged.
    """
    if "learned" not in tape or "internals" not in tape:
        return []
    _, error = best_error(tape)
    t = (error.stamp_ns - tape.start_ns) / 1e9
    ticks = tape.time("internals")
    last_ticks = np.maximum(np.searchsorted(ticks, t, side="right") - 1, 0)
    is_engaged = tape["internals"]["mode"][last_ticks] == Mode.ENGAGED
    spans = []
    names = parameter_spans(tape)
    digests = list(dict.fromkeys(span.digest for span in names))
    kept = guarantees(tape)
    for span in names:
        stop = float(t[-1]) if span is names[-1] else span.stop
        in_span = (t >= span.start) & (t < stop) & is_engaged
        rms = {name: error_metrics(error[name][in_span]).rms for name in error.names}
        guarantee = kept.get(span.digest)
        if in_span.any():
            spans.append(
                ModelSpan(
                    name=span.name,
                    model=digests.index(span.digest),
                    start=span.start,
                    stop=stop,
                    rms=rms,
                    stable=None if guarantee is None else guarantee.stable,
                    loop="" if guarantee is None else guarantee.loop,
                )
            )
    return spans
