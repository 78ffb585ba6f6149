# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Run the guarded law as a ROS 2 lifecycle node, at a fixed rate or in lockstep.

The node subscribes to y and y_m, and publishes u and internals. It handles overruns, conflicting
publishers and stale inputs.
"""

from collections.abc import Callable, Sequence

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn

from flight_core.channels import reason_against_inputs
from flight_core.modes import Mode
from flight_core.outcome import Refusal
from flight_core.rates import NANOSECONDS, nanoseconds, period_ns, seconds
from flight_core.text import bounded
from flight_core.vectors import ChannelError, SampleFault, StampedVector
from flight_ros import reports
from flight_ros.flight_node import FlightNode
from flight_ros.lockstep import LockstepInputs
from flight_ros.messages import NO_CHANNELS, Decoder
from flight_ros.rclpy_private import answer_invalid_transitions
from flight_ros.reports import MAX_REPORT_SIZE, Report
from flight_ros.subscriptions import PolledSubscription
from flight_ros.throttle import Throttle
from flight_ros.ticker import Tick
from flight_ros.topics import (
    AUTHORITY,
    EFFECTS,
    INTERNALS,
    LEARNING,
    LOCKSTEP,
    PROPOSAL,
    PROPOSALS,
    Y_M,
    U,
    Y,
)
from rise_di_controller.controller import Controller, ControlOutput
from rise_di_controller.laws import AnyLaw
from rise_di_controller.learning.learned_channels import authority_names
from rise_di_controller.learning.proposals import (
    AUTHORITY_TICKS,
    Event,
    EventKind,
    Learning,
    Proposal,
)
from rise_di_controller.params import ControllerConfig
from rise_di_controller.rise_di_config import RiseDiConfig

LONG_MAX_AGE = 1.0  # max_age, s, above which the log warns that the failsafe begins late
SLOW_PERIOD_NS = 60 * NANOSECONDS  # time between two warnings that a rate is too low for max_age
BEHIND_NS = 1_000_000
"""Time by which a tick follows the instants of y and y_m, which come every 2 ms at 500 Hz. By then
both have arrived, and their nodes have finished their own ticks of up to 1 ms. Ticks at a random
phase would delay u by up to 2 ms more, and ticks at the instants of y and y_m would wait for one of
two processors."""


class ControllerNode(LifecycleNodeMixin, FlightNode[ControllerConfig]):
    """Takes y and y_m at every tick, steps the law and publishes u.

    u has the stamp of the y from which it is computed.

    In lockstep, the time of the flight is the number of samples of y. A tick waits for the y and
    the y_m of its instant, and publishes exactly one u. If the controller has no output, this u has
    no channels.
    """

    def __init__(self) -> None:
        FlightNode.__init__(self, "controller", AnyLaw)
        LifecycleNodeMixin.__init__(self)
        answer_invalid_transitions(self)
        self._active = False
        self._is_shut_down = False
        # A standby node that was never activated publishes no u, because the active node does.
        self._publishes = self.parameters.autostart
        self._controller = Controller(self.parameters)
        y_input = self.parameters.measured, self._taking(self._controller.take_y)
        y_m_input = self.parameters.outputs, self._taking(self._controller.take_y_m)
        self._y, self._y_m = (
            self.receive(
                topic,
                Decoder(names).decode,
                take,
                max_age_ns=self._max_age_ns,
                lock=self.publisher_lock(self._timeouts_ns),
            )
            for topic, (names, take) in ((Y, y_input), (Y_M, y_m_input))
        )
        self._publish_u, self._publish_internals = self.advertise(U), self.advertise(INTERNALS)
        self._u_encoder = self.encoder(self.parameters.effectors)
        self._internals_encoder = self.encoder(self._controller.names)
        self._publish_effects = self.advertise(EFFECTS) if self.parameters.probe else None
        self._effects_encoder = self.encoder(self.parameters.inputs)
        self._stuck: Refusal | None = None  # a refusal that names the inputs without effect
        self._learning = self._new_learning()
        if self.parameters.lockstep:
            self._empty_encoder = self.encoder(())
            self._inputs = LockstepInputs(
                y_period_ns=period_ns(self.parameters.y_rate, "y_rate"),
                period_ns=self.period_ns(),
                receive_y=self._y.receive,
                receive_other=self._y_m.receive,
                is_ready=self._has_proposal,
            )
        self._last_ns = 0  # instant of the last tick
        self._still_vanes: tuple[str, ...] = ()
        self._restarts = 0  # how often the law has engaged again without a command
        self._slow = Throttle(SLOW_PERIOD_NS)
        if self.parameters.autostart:
            self.trigger_configure()
            if self.parameters.start_active:
                self.trigger_activate()
        else:
            self.get_logger().info(
                "unconfigured: waiting to be configured and activated (autostart is false)"
            )

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Reset the law. The parameters were validated when they were set."""
        # This keeps u, so that a node that is configured again continues without a jump of u.
        self._controller.restart()
        self.get_logger().info(self.parameters.summary())
        self._warn_long_max_age(self.parameters)
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Allow the law to engage with the next fresh y and y_m."""
        self._active = self._publishes = True
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop the law. u is held or ramps to trim, as the parameter `on_deactivate` says."""
        self._active = False
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop the law for good, and publish nothing more. The aircraft's failsafe then begins."""
        self._active = self._publishes = False
        self._is_shut_down = True
        return TransitionCallbackReturn.SUCCESS

    def on_parameters(self, parameters: ControllerConfig) -> None:
        """Replace the parameters between two ticks, all at once and without a jump of u."""
        self._controller.retune(parameters)
        if parameters.max_age != self.parameters.max_age:
            self._warn_long_max_age(parameters)

    def _warn_long_max_age(self, parameters: ControllerConfig) -> None:
        if parameters.max_age > LONG_MAX_AGE:
            late = f"the failsafe begins {parameters.max_age:g} s after the last y or y_m"
            self.get_logger().warning(f"max_age = {parameters.max_age:g} s: {late}")

    def period_ns(self) -> int:
        return self._controller.period_ns

    def inputs(self) -> Sequence[PolledSubscription]:
        return self._y.subscription, self._y_m.subscription

    def start_ns(self) -> int:
        """Return when the ticks start, ns: BEHIND_NS after a whole period of the system clock.

        If half a period is shorter than BEHIND_NS, the ticks start half a period after the whole
        period.
        """
        return self.next_period_ns() + min(BEHIND_NS, self.period_ns() // 2)

    def tick(self, tick: Tick, now_ns: int) -> None:
        if self._is_shut_down:
            return
        now_ns += tick.late_ns
        if self._last_ns and (instants := self._controller.overrun(self._last_ns, now_ns)):
            self.get_logger().warning(
                f"overrun of {seconds(now_ns - self._last_ns):.3f} s: re-engaging"
            )
            for instant_ns in instants:
                self._step(instant_ns, 0)
        self._last_ns = now_ns
        self._y.poll(now_ns)
        self._y_m.poll(now_ns)
        self._step(now_ns, tick.late_ns)
        self._learn(now_ns)
        if tick.number % AUTHORITY_TICKS == 0:
            self._publish_authority(now_ns)
        if self._active and self._controller.mode is not Mode.ENGAGED:
            self._warn_stale_inputs(now_ns)

    def _taking(
        self, take: Callable[[StampedVector, int], Refusal | None]
    ) -> Callable[[StampedVector, int], None]:
        """Wrap `take` so that it raises ChannelError for a sample that it drops.

        The receiver then counts and logs the dropped sample.
        """

        def taking(sample: StampedVector, now_ns: int) -> None:
            if (refusal := take(sample, now_ns)) is not None:
                raise ChannelError(SampleFault.IMPLAUSIBLE, str(refusal))

        return taking

    def _tell_restart(self) -> None:
        """Count and log it if the law has engaged again by itself.

        There is at most one such line in 2 s.
        """
        if (reason := self._controller.pop_restart_reason()) is not None:
            self._restarts += 1
            self.get_logger().warning(f"the law engages again: {reason}", throttle_duration_sec=2.0)

    def _tell_effects(self, output: ControlOutput) -> None:
        """Publish the effects of the inputs after a test of the probe, and log which are stuck."""
        if output.effects is None or self._publish_effects is None:
            return
        self._publish_effects(self._effects_encoder.encode(output.stamp_ns, output.effects))
        before = self._stuck
        self._stuck = reason_against_inputs(self.parameters.inputs, output.effects.tolist())
        if self._stuck is not None:
            self.get_logger().warning(str(self._stuck), throttle_duration_sec=5.0)
        elif before is not None:
            self.get_logger().info("every probed input answers again")

    def _tell_vanes(self) -> None:
        """Log when a vane begins or ceases to stand still."""
        before = self._still_vanes
        self._still_vanes = self._controller.still_vanes()
        if before == self._still_vanes:
            return
        if still := set(self._still_vanes) - set(before):
            self.get_logger().warning(f"vane {', '.join(sorted(still))} stands still: left out")
        if moves := set(before) - set(self._still_vanes):
            self.get_logger().info(f"vane {', '.join(sorted(moves))} moves again: measured")

    def _max_age_ns(self) -> int:
        return nanoseconds(self.parameters.max_age)

    def _timeouts_ns(self) -> tuple[int, int]:
        """Return the ages after which another publisher may take over from a silent one, ns.

        The first age holds for the same node in a new process. The second age holds for a different
        node, which may take over only after the failsafe has brought u to trim.
        """
        return self._max_age_ns(), self._max_age_ns() + nanoseconds(
            self.parameters.hold + self.parameters.ramp
        )

    def _step(self, now_ns: int, late_ns: int) -> bool:
        """Run one tick of the controller, and return whether it had an output to publish."""
        before = self._controller.mode
        output = self._controller.tick(now_ns, late_ns, active=self._active)
        if self._learning is not None and output is not None and self._controller.has_internals:
            self._learning.ticked(self._controller, now_ns)
        if self._controller.mode is not before:
            self.get_logger().info(f"{before.name} -> {self._controller.mode.name}")
        self._tell_vanes()
        self._tell_restart()
        if output is None or not self._publishes:
            return False
        # If a tick was suspended halfway, its old u is not published. The aircraft has started its
        # failsafe meanwhile, and u would jump.
        if self.parameters.lockstep or self.now_ns() - now_ns <= self._max_age_ns():
            self._publish_u(self._u_encoder.encode(output.stamp_ns, output.u))
        if self._controller.has_internals:
            self._publish_internals(
                self._internals_encoder.encode(output.stamp_ns, output.internals)
            )
        self._tell_effects(output)
        return True

    def advance(self) -> bool:
        advanced = False
        for now_ns, is_due, y, y_m in self._inputs.complete():
            if y is not None:
                self._y.accept(y, now_ns)
            for sample in y_m:
                self._y_m.accept(sample, now_ns)
            if is_due:
                self._learn(now_ns)
                if now_ns % (AUTHORITY_TICKS * self.period_ns()) == 0:
                    self._publish_authority(now_ns)
            if is_due and not self._step(now_ns, late_ns=0):
                self._publish_u(self._empty_encoder.encode(now_ns, NO_CHANNELS))
            advanced = True
        return advanced

    def awaited_topic(self) -> str:
        if self._waits_for_proposal:
            return self._proposals.name
        return (self._y_m if self._inputs.has_y else self._y).name

    # With a learner

    def _new_learning(self) -> Learning | None:
        """Create the object that takes a learner's proposals, or return None without learning."""
        self._decoded = self._waits_for_proposal = False
        parameters = self.parameters
        if not isinstance(parameters, RiseDiConfig) or parameters.learn is None:
            return None
        # A learner that is started again makes its first identification after the first of
        # `updates`.
        timeouts_ns = (
            nanoseconds(parameters.learn.updates[0]),
            nanoseconds(2.0 * parameters.learn.window),
        )
        self._proposals = self.receive(
            PROPOSAL,
            self._decode_proposal,
            self._take_proposal,
            max_age_ns=None,  # `Learning` limits the age instead
            lock=self.publisher_lock(lambda: timeouts_ns),
            qos=LOCKSTEP if parameters.lockstep else PROPOSALS,
            max_size=MAX_REPORT_SIZE,
        )
        self._publish_learning, self._send_authority = (
            self.advertise(LEARNING),
            self.advertise(AUTHORITY),
        )
        self._authority_encoder = self.encoder(authority_names(parameters.outputs))
        return Learning(parameters, self._say, simulated=parameters.lockstep)

    def _learn(self, now_ns: int) -> None:
        """Let due proposals act, between two ticks."""
        if self._learning is None:
            return
        self._decoded = False
        self._proposals.poll(now_ns)
        if (parameters := self._learning.step(self._controller, now_ns)) is not None:
            self.adopt(parameters)

    def _publish_authority(self, now_ns: int) -> None:
        """Publish the authority of the inputs, which follows from the model in force, for guidance.

        Without a learner nothing is published.
        """
        if self._learning is not None:
            self._send_authority(
                self._authority_encoder.encode(now_ns, self._learning.authority(self._controller))
            )

    def _has_proposal(self, now_ns: int) -> bool:
        """Return whether a step in lockstep can begin.

        It can if no proposal of the learner is due before it, or if this proposal has come.
        """
        if self._learning is None:
            return True
        self._proposals.poll(now_ns)
        self._waits_for_proposal = self._learning.is_waiting(now_ns)
        return not self._waits_for_proposal

    def _decode_proposal(self, raw: bytes) -> Report:
        if self._decoded and not self.parameters.lockstep:
            raise ChannelError(SampleFault.RATE, "a second proposal in a tick, expected one")
        self._decoded = True
        return reports.decode(raw)

    def _take_proposal(self, report: Report, now_ns: int) -> None:
        change = dict(report.values)
        start = change.pop("start", None)
        flown = change.pop("flown", None)
        if not isinstance(start, int) or not isinstance(flown, int):
            raise ChannelError(
                SampleFault.MALFORMED, "a proposal without the digests start and flown"
            )
        assert self._learning is not None  # noqa: S101 - created together with the receiver
        self._learning.receive(
            Proposal(
                stamp_ns=report.stamp_ns,
                start=start,
                flown=flown,
                change=change,
                sentence=report.sentence or None,
            ),
            self._controller,
            now_ns,
        )

    def _say(self, event: Event) -> None:
        """Log and publish what became of a proposed model, or that the controller fell back."""
        sentence = bounded(event.sentence)
        if event.kind is EventKind.REFUSED:
            self.get_logger().warning(sentence)
        else:
            self.get_logger().info(sentence)
        report = Report(
            event.stamp_ns,
            self.instance,
            sentence,
            {"event": event.kind},
            is_warning=not event.change,
        )
        self._publish_learning(reports.encode(report, "learning"))

    def _warn_stale_inputs(self, now_ns: int) -> None:
        stale = self._controller.stale(now_ns)
        for receiver in (self._y, self._y_m):
            if receiver.subscription.topic.name in stale:
                self.warn_no_publisher(receiver.subscription)
                slowness = receiver.slowness(self._max_age_ns())
                if slowness and self._slow.is_due(receiver.name):
                    self.get_logger().warning(f"{receiver.name}: {slowness}")
        if not stale:
            publisher = None if self._y.lock is None else self._y.lock.publisher
            why = self.clock_of(publisher or "") or ": check for a delay and for different clocks"
            self.get_logger().warning(
                f"no {self._y_m.name} at the stamp of {self._y.name}{why}",
                throttle_duration_sec=2.0,
            )

    def status(self) -> tuple[bytes, str, dict[str, object]]:
        if self._is_shut_down:
            return DiagnosticStatus.WARN, "shut down: no u comes any more", {}
        mode = self._controller.mode
        level = DiagnosticStatus.OK if mode is Mode.ENGAGED else DiagnosticStatus.WARN
        ages = {}
        if not self.parameters.lockstep:
            ages = {
                f"age of {name} (s)": f"{age:.4f}"
                for name, age in self._controller.ages(self.now_ns()).items()
            }
        if self.parameters.vanes:
            still = {"vanes left out": ", ".join(self._still_vanes) or "none"}
        else:
            still = {}
        restarts = {"restarts of the law": self._restarts}
        stuck = "none" if self._stuck is None else str(self._stuck)
        effects = {"without effect": stuck} if self.parameters.probe else {}
        return (
            level,
            mode.name,
            {
                "mode": mode.name,
                "law": self.parameters.summary(),
                **restarts,
                **effects,
                **still,
                **ages,
            },
        )
