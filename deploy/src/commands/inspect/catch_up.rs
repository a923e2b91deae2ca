//! Catch-up: shows an observer that connects late the whole run, from TTI 0 on.
//!
//! The same scenario and seed give the same run. TTIs before the connection are replayed in memory; later frames are
//! received from the run.
//!
//! ```text
//!   TTI 0 ──── replayed ────► the grant open at connection ──── replayed ────► the next grant ──── received ────► end
//!                             (its plan may be missed, so its frames are dropped)
//! ```
//! The last TTI of a grant is replayed once the next grant begins or the run ends. Only then does the input log have
//! the devices removed in that TTI and the decisions of a policy process. Actions in the TTI from which on frames are
//! received come from the log too, since their frames may be missed. Replayed frames lack the emulation plane and the
//! states of `--record-states`. `live` connects to the run and calls this module.

use anyhow::{Context, bail};
use reveille_bs::observer::frames::FrameObserver;
use reveille_bs::scenario::Scenario;
use reveille_common::ids::Tti;
use reveille_common::message::{ClockMessage, ClockStatus, Frame, Message};
use reveille_lab::external_inputs::InputLogParser;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};

use super::passed_frames::PassedFrames;
use crate::signals::run_on_thread;

/// Context of an error in the input log.
const LOG_CONTEXT: &str = "the input log of the run";

/// Passes on the replayed past of a run before the received frames.
pub(crate) struct CatchUp {
    scenario: Scenario,
    /// The input log, as far as it was read.
    log: InputLogParser,
    /// Bytes read of the log.
    bytes_read: u64,
    /// The replay, from its first use to the end of the catch-up.
    replay: Option<Run>,
    /// The next TTI to pass on.
    next_tti: Tti,
    /// Returns whether to stop the replay.
    should_stop: Box<dyn Fn() -> bool + Send>,
    /// Whether the grant open at the connection, or at the last gap, continues. Its frames may be incomplete and are
    /// not passed on.
    is_in_open_grant: bool,
    /// Whether the catch-up is complete, so that received frames are passed on.
    is_over: bool,
    /// The frames passed on so far, also before [`Self::restart`].
    passed: PassedFrames,
}

impl CatchUp {
    /// Creates the catch-up of a run of `scenario`, before its first frame. The replay ends early once
    /// `should_stop` returns true.
    pub(crate) fn new(scenario: Scenario, should_stop: impl Fn() -> bool + Send + 'static) -> Self {
        Self {
            scenario,
            log: InputLogParser::default(),
            bytes_read: 0,
            replay: None,
            next_tti: Tti::ZERO,
            should_stop: Box::new(should_stop),
            is_in_open_grant: false,
            is_over: false,
            passed: PassedFrames::default(),
        }
    }

    /// Starts again after frames have been lost. Frames that were passed on are not passed on a second time. The input
    /// log must be read again from its start.
    pub(crate) fn restart(&mut self) {
        (self.log, self.bytes_read, self.replay) = (InputLogParser::default(), 0, None);
        (self.next_tti, self.is_in_open_grant, self.is_over) = (Tti::ZERO, false, false);
        self.passed.restart();
    }

    /// Notes that frames were lost before the next received one.
    pub(crate) const fn note_gap(&mut self) {
        if self.is_over {
            self.passed.note_gap();
        } else {
            // The replay has these frames. The plan of the next grant may be among them, so that grant is replayed too.
            self.is_in_open_grant = false;
        }
    }

    /// Whether the catch-up is complete, so that received frames are passed on.
    pub(crate) const fn is_over(&self) -> bool {
        self.is_over
    }

    /// The offset of the first unread byte of the input log.
    pub(crate) const fn bytes_read(&self) -> u64 {
        self.bytes_read
    }

    /// Adds the next part of the input log, which starts at [`Self::bytes_read`], up to its last whole line. Returns
    /// false without a whole line.
    ///
    /// # Errors
    /// If the part does not belong to a log of this run.
    pub(crate) fn read_input_log(&mut self, part: &[u8]) -> anyhow::Result<bool> {
        let known_counts = self.log.inputs().counts();
        // A part can end within a line, whose rest comes with the next part.
        let whole_bytes = part.iter().rposition(|byte| *byte == b'\n').map_or(0, |last| last + 1);
        let text = std::str::from_utf8(&part[..whole_bytes]).context(LOG_CONTEXT)?;
        let consumed_bytes = self.log.read(text, &self.scenario).context(LOG_CONTEXT)?;
        self.bytes_read += consumed_bytes as u64;
        // A started replay lacks only the new inputs; `replay_until` passes on all others at its start.
        if let Some(replay) = &mut self.replay {
            replay.schedule_inputs(&self.log.inputs().after(known_counts));
        }
        Ok(consumed_bytes > 0)
    }

    /// The next TTI to pass on, until the catch-up is complete.
    pub(crate) const fn replayed_until(&self) -> Tti {
        self.next_tti
    }

    /// Passes on the TTIs that were closed when the clock had this `status`.
    ///
    /// # Errors
    /// See [`Self::replay_until`].
    pub(crate) fn replay_closed_ttis(
        &mut self,
        status: &ClockStatus,
        on_frame: impl FnMut(Frame),
    ) -> anyhow::Result<()> {
        // While the clock runs, the TTI before the next one can still be open.
        let open_ttis = u64::from(!status.paused);
        let end = Tti(status.tti.0.saturating_sub(open_ttis));
        self.pass_new_frames(on_frame, |this, on_new_frame| this.replay_until(end, on_new_frame))?;
        Ok(())
    }

    /// Calls `produce` with a consumer of frames that passes the new ones to `on_frame`.
    fn pass_new_frames<T>(
        &mut self,
        mut on_frame: impl FnMut(Frame),
        produce: impl FnOnce(&mut Self, &mut dyn FnMut(Frame)) -> T,
    ) -> T {
        let mut passed = std::mem::take(&mut self.passed);
        let produced = produce(self, &mut |frame| {
            if let Some(frame) = passed.filter_new(frame) {
                on_frame(frame);
            }
        });
        self.passed = passed;
        produced
    }

    /// Passes on all TTIs before `end` that are still due. Returns false if it was stopped before `end`.
    ///
    /// # Errors
    /// If a decision in one of the TTIs is unknown.
    fn replay_until(&mut self, end: Tti, mut on_frame: &mut dyn FnMut(Frame)) -> anyhow::Result<bool> {
        if end <= self.next_tti {
            return Ok(true);
        }
        let replay = match &mut self.replay {
            Some(replay) => replay,
            replay_slot => {
                // One TTI at a time: a grant with lookahead could go beyond `end`.
                let options = RunOptions {
                    lookahead: false,
                    ..RunOptions::default()
                };
                let scenario = self.scenario.clone();
                let prepare_run = move || Run::new(&prepare(&scenario), options);
                // On another thread, since the preparation can contain a search that takes hours.
                let Some(mut replay) = run_on_thread(prepare_run, &self.should_stop)? else {
                    return Ok(false);
                };
                replay.schedule_inputs(self.log.inputs());
                replay_slot.insert(replay)
            }
        };
        // An interval of 0 TTIs: no frames of states.
        let mut frame_observer = FrameObserver::new(0, &mut on_frame);
        while replay.cycle().next_tti() < end {
            if (self.should_stop)() {
                return Ok(false);
            }
            replay.run_grant(&mut frame_observer);
            if let Some(tti) = replay.missing_decision() {
                bail!("the input log of the run has no decision for TTI {tti}");
            }
        }
        self.next_tti = end;
        Ok(true)
    }

    /// Takes a received frame and passes on everything before it first. Before a plan, world or clock frame, the input
    /// log must have been read up to it: `Live::follow` repeats these kinds, so change both.
    ///
    /// # Errors
    /// See [`Self::replay_until`].
    pub(crate) fn push(&mut self, frame: Frame, on_frame: impl FnMut(Frame)) -> anyhow::Result<()> {
        self.pass_new_frames(on_frame, |this, on_new_frame| this.take_frame(frame, on_new_frame))
    }

    fn take_frame(&mut self, frame: Frame, on_frame: &mut dyn FnMut(Frame)) -> anyhow::Result<()> {
        if self.is_over {
            on_frame(frame);
            return Ok(());
        }
        // From this TTI on every frame was received, and all TTIs before it are closed.
        let received_from = match frame.message() {
            // A plan is sent before the grant in which it takes effect.
            Ok(Message::Plan(update)) if self.is_in_open_grant || update.from == self.next_tti => update.from,
            Ok(Message::World(world)) if self.is_in_open_grant => world.first,
            Ok(Message::World(world)) => {
                // The grant that was open at the connection: its plan may have been missed, so it is replayed.
                if world.last >= self.next_tti {
                    self.is_in_open_grant = self.replay_until(world.last, on_frame)?;
                }
                return Ok(());
            }
            Ok(Message::Clock(ClockMessage::CollectLedgers(end))) => end,
            Ok(_) | Err(_) => return Ok(()),
        };
        if self.replay_until(received_from, &mut *on_frame)? {
            // The replay is not needed any more, and can be large.
            (self.is_over, self.replay) = (true, None);
            let actions = self.log.inputs().actions.iter();
            let due_actions = actions.filter(|action| action.tti == received_from);
            due_actions.for_each(|action| on_frame(Frame::new(action.tti, (), action)));
            on_frame(frame);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;
    use std::ops::Range;

    use reveille_bs::policy::external::{Decision, DecisionStage, PlanDecision, RecordedDecision};
    use reveille_bs::policy::outside;
    use reveille_common::ids::DeviceId;
    use reveille_common::io::Disk;
    use reveille_common::message::{Change, DeviceRange, DeviceRemoval, MessageKind, OperatorAction, Pace, Setting};
    use reveille_common::plan::Plan;
    use reveille_common::rng::{Purpose, Stream};
    use reveille_common::scenario::{Override, load};
    use reveille_common::units::Energy;
    use reveille_lab::external_inputs::{ExternalInput, ExternalInputs, first_line, input_line};
    use reveille_lab::stepped_run::SteppedRun;

    use super::*;

    /// Returns a short scenario, in which the base station synchronises often.
    fn scenario_of_policy(policy: &str) -> Scenario {
        let set = [
            "devices=20",
            "ttis=240",
            "bs.sync_interval=7",
            &format!("policy.name={policy}"),
        ];
        let set = set.map(|set| Override::parse(set).expect("an override"));
        load("paper", &set, &outside::kinds_with_external(), &Disk)
            .expect("a scenario")
            .scenario
    }

    /// The frames that an observer receives from a run, and each external input with the number of frames before it.
    #[derive(Default)]
    struct ReceivedRun {
        frames: Vec<Frame>,
        inputs: Vec<(usize, ExternalInput)>,
    }

    impl ReceivedRun {
        /// Creates a run with removals.
        fn new(scenario: &Scenario, removals: &[DeviceRemoval], lookahead: bool) -> Self {
            let inputs = ExternalInputs::from_removals(removals);
            Self::with_inputs(scenario, &inputs, MessageKind::Removed, lookahead)
        }

        /// Creates a run with actions, logged at the start if `scripted`, otherwise just before they take effect.
        fn with_actions(scenario: &Scenario, actions: &[OperatorAction], lookahead: bool, scripted: bool) -> Self {
            let inputs = ExternalInputs::from_actions(actions);
            let mut received = Self::with_inputs(scenario, &inputs, MessageKind::Action, lookahead);
            if scripted {
                received.inputs.iter_mut().for_each(|(index, _)| *index = 0);
            }
            received
        }

        /// Creates a run with inputs of one kind, each logged just before its frame of kind `kind`.
        fn with_inputs(scenario: &Scenario, inputs: &ExternalInputs, kind: MessageKind, lookahead: bool) -> Self {
            let mut frames = Vec::new();
            let options = RunOptions {
                lookahead,
                ..RunOptions::default()
            };
            let mut run = Run::new(&prepare(scenario), options);
            run.schedule_inputs(inputs);
            run.finish(&mut FrameObserver::new(0, |frame: Frame| frames.push(frame)));
            let of_kind = |(index, frame): (usize, &Frame)| (frame.kind == kind).then_some(index);
            let logged_at = frames.iter().enumerate().filter_map(of_kind);
            let inputs = logged_at.zip(inputs.iter()).collect();
            Self { frames, inputs }
        }

        /// Creates a run with random decisions and a plan request every `plan_ttis` TTIs.
        fn with_decisions(scenario: &Scenario, plan_ttis: u64) -> Self {
            let frames = RefCell::new(Vec::new());
            let mut run = SteppedRun::new(scenario, FrameObserver::new(0, |frame| frames.borrow_mut().push(frame)));
            let (mut stream, mut inputs) = (Stream::new(3, Purpose::Training, 0), Vec::new());
            while let Some(request) = run.pending_decision() {
                let (tti, n) = (request.observation.now, request.observation.known.n() as u64);
                let mut random_device = || DeviceId(stream.below(n) as u32);
                let decision = match request.stage {
                    DecisionStage::Plan => Decision::Plan(PlanDecision {
                        plan: Plan::from_devices(
                            n as usize,
                            &[random_device(), random_device(), random_device(), random_device()],
                        ),
                        next: tti + plan_ttis,
                    }),
                    DecisionStage::Wake if random_device().0 % 2 == 0 => Decision::Wake(vec![random_device()]),
                    DecisionStage::Wake => Decision::Wake(Vec::new()),
                };
                let recorded = RecordedDecision {
                    tti,
                    decision: decision.clone(),
                };
                inputs.push((frames.borrow().len(), ExternalInput::Decision(recorded)));
                match decision {
                    Decision::Plan(plan_decision) => run.decide(plan_decision),
                    Decision::Wake(devices) => run.wake(&devices),
                }
            }
            run.finish();
            let frames = frames.into_inner();
            Self { frames, inputs }
        }

        /// Asserts that an observer receives the whole run wherever it joins. It reads the input log only as far as the
        /// log was written when the last received frame was sent.
        fn assert_complete_from_any_frame(mut self, scenario: &Scenario) {
            let end = Tti(scenario.run.ttis);
            self.frames
                .push(Frame::new(end, (), &ClockMessage::CollectLedgers(end)));
            // World frames depend on how TTIs were granted.
            let without_world = |frames: &[Frame]| {
                let mut frames = frames.to_vec();
                frames.retain(|frame| frame.kind != MessageKind::World);
                frames
            };
            let (expected, mut line_ends) = (without_world(&self.frames), vec![first_line(scenario).len()]);
            let mut log = first_line(scenario);
            for (_, input) in &self.inputs {
                log += &input_line(input);
                line_ends.push(log.len());
            }
            let sent = SentRun {
                scenario,
                frames: &self.frames,
                log: log.as_bytes(),
                inputs_sent_before: self.inputs.iter().map(|(before, _)| *before).collect(),
                line_ends,
            };
            let count = self.frames.len();
            for joined_at in (0..count).step_by(5).chain(0..12) {
                for paused in [false, true] {
                    if paused && !sent.can_pause_at(joined_at) {
                        continue;
                    }
                    let mut observer = Observer::new(scenario);
                    observer.join(&sent, joined_at..count, paused);
                    assert!(
                        without_world(&observer.received) == expected,
                        "joined at frame {joined_at}, paused: {paused}"
                    );
                }
            }
            self.assert_continues_after_gaps(scenario, &sent, &expected);
            // The connection is lost, and frames with it. A base station that was resumed sends earlier frames again.
            for lost_at in (0..count).step_by(41) {
                for back_at in [lost_at.saturating_sub(60), lost_at, lost_at + 3, lost_at + 90] {
                    let mut observer = Observer::new(scenario);
                    observer.join(&sent, 0..lost_at, false);
                    observer.catch_up.restart();
                    observer.join(&sent, back_at.min(count - 1)..count, false);
                    assert!(
                        without_world(&observer.received) == expected,
                        "lost at frame {lost_at}, back at frame {back_at}"
                    );
                    let mut next_tti = 0;
                    for frame in &observer.received {
                        if let Ok(Message::World(world)) = frame.message() {
                            assert_eq!(
                                world.first.0, next_tti,
                                "lost at frame {lost_at}, back at frame {back_at}"
                            );
                            next_tti = world.last.0 + 1;
                        }
                    }
                    assert_eq!(next_tti, end.0);
                }
            }
        }
    }

    impl ReceivedRun {
        /// Asserts that an observer with random gaps and lost connections receives no frame twice, and all frames after
        /// the last TTI before the last return. A gap during the catch-up costs no frame.
        fn assert_continues_after_gaps(&self, scenario: &Scenario, sent: &SentRun<'_>, expected: &[Frame]) {
            let count = self.frames.len();
            let mut stream = Stream::new(5, Purpose::Training, 0);
            let mut below = |limit: usize| stream.below(limit as u64) as usize;
            for case in 0..40 {
                let mut observer = Observer::new(scenario);
                let (mut next, mut is_complete, mut steps) = (below(count), true, Vec::new());
                observer.join(sent, next..next, false);
                for _ in 0..6 {
                    let end = (next + below(50)).min(count - 1);
                    observer.receive(sent, next..end);
                    let is_gap = below(2) == 0;
                    next = if is_gap {
                        is_complete &= !observer.catch_up.is_over();
                        observer.catch_up.note_gap();
                        end + below(20)
                    } else {
                        observer.catch_up.restart();
                        (end + below(90)).saturating_sub(60)
                    };
                    next = next.min(count - 1);
                    steps.push((end, if is_gap { "gap" } else { "connection lost" }, next));
                    if !is_gap {
                        observer.join(sent, next..next, false);
                    }
                }
                let last_before = observer.received.iter().map(|frame| frame.tti).max();
                observer.catch_up.restart();
                observer.join(sent, count - 1..count, false);
                observer.received.retain(|frame| frame.kind != MessageKind::World);
                let received = observer.received;
                // The received frames are a part of the sent ones, in their order.
                let mut remaining = expected.iter();
                for frame in &received {
                    assert!(
                        remaining.any(|sent| sent == frame),
                        "case {case}: {frame:?} is repeated after {steps:?}"
                    );
                }
                let later = |frame: &&Frame| is_complete || Some(frame.tti) > last_before;
                assert_eq!(
                    received.iter().filter(later).count(),
                    expected.iter().filter(later).count(),
                    "case {case}: {steps:?}"
                );
            }
        }
    }

    /// The frames and the input log of a run.
    struct SentRun<'a> {
        scenario: &'a Scenario,
        frames: &'a [Frame],
        log: &'a [u8],
        /// The number of frames before each external input.
        inputs_sent_before: Vec<usize>,
        /// The ends of the lines of `log`, without and with the first inputs.
        line_ends: Vec<usize>,
    }

    impl SentRun<'_> {
        /// The part of the log known before frame `index`, with some bytes of a line that is being written.
        fn log_before(&self, index: usize) -> &[u8] {
            let input_count = self.inputs_sent_before.partition_point(|before| *before < index);
            &self.log[..self.log.len().min(self.line_ends[input_count] + 9)]
        }

        fn can_pause_at(&self, index: usize) -> bool {
            matches!(self.frames[index].kind, MessageKind::Plan | MessageKind::Clock)
        }

        /// The status of the clock before frame `index`.
        fn status(&self, index: usize, paused: bool) -> ClockStatus {
            let next_tti = self.frames[..index]
                .iter()
                .rev()
                .find_map(|frame| match frame.message() {
                    Ok(Message::World(world)) => Some(world.last + 1),
                    Ok(_) | Err(_) => None,
                });
            ClockStatus {
                run_id: 7,
                tti: next_tti.unwrap_or_default(),
                ttis: self.scenario.run.ttis,
                paused,
                stop_before: Tti(self.scenario.run.ttis),
                pace: Pace::Max,
                begun: true,
                devices: self.scenario.run.devices,
                hosts: Vec::new(),
            }
        }
    }

    struct Observer {
        catch_up: CatchUp,
        received: Vec<Frame>,
    }

    impl Observer {
        fn new(scenario: &Scenario) -> Self {
            Self {
                catch_up: CatchUp::new(scenario.clone(), || false),
                received: Vec::new(),
            }
        }

        /// Connects before the first of `frames`, and receives them.
        fn join(&mut self, sent: &SentRun<'_>, frames: Range<usize>, paused: bool) {
            let Self { catch_up, received } = self;
            let status = sent.status(frames.start, paused);
            catch_up.read_input_log(sent.log_before(frames.start)).expect("a log");
            catch_up
                .replay_closed_ttis(&status, |frame| received.push(frame))
                .expect("a consistent run");
            self.receive(sent, frames);
        }

        /// Receives `frames`.
        fn receive(&mut self, sent: &SentRun<'_>, frames: Range<usize>) {
            let Self { catch_up, received } = self;
            for index in frames {
                catch_up
                    .read_input_log(&sent.log_before(index + 1)[catch_up.bytes_read() as usize..])
                    .expect("a log");
                catch_up
                    .push(sent.frames[index].clone(), |frame| received.push(frame))
                    .expect("a consistent run");
            }
        }
    }

    #[test]
    fn a_late_observer_receives_the_whole_run() {
        for policy in ["knn", "age-index"] {
            let scenario = scenario_of_policy(policy);
            for lookahead in [true, false] {
                ReceivedRun::new(&scenario, &[], lookahead).assert_complete_from_any_frame(&scenario);
            }
        }
    }

    #[test]
    fn a_late_observer_receives_removed_devices() {
        let scenario = scenario_of_policy("knn");
        let removal = |first, tti| DeviceRemoval {
            first: DeviceId(first),
            count: 5,
            tti: Tti(tti),
            wake_ups: None,
        };
        let removals = [removal(0, 40), removal(10, 41), removal(5, 180)];
        for lookahead in [true, false] {
            let received = ReceivedRun::new(&scenario, &removals, lookahead);
            assert_eq!(received.inputs.len(), removals.len());
            received.assert_complete_from_any_frame(&scenario);
        }
    }

    #[test]
    fn a_late_observer_receives_actions() {
        let range = |first, count| DeviceRange {
            first: DeviceId(first),
            count,
        };
        let changes = [
            (0, Change::Fail(range(3, 2))),
            (40, Change::Fail(range(0, 9))),
            (40, Change::AddEnergy(range(4, 9), Energy::from_micro(3_000_000))),
            (41, Change::Revive(range(0, 20))),
            (100, Change::Set(Setting::EventRate, 0.5)),
            (239, Change::Fail(range(0, 20))),
        ];
        let actions = changes.map(|(tti, change)| OperatorAction { tti: Tti(tti), change });
        for (policy, lookahead) in [("knn", true), ("age-index", true), ("age-index", false)] {
            let scenario = scenario_of_policy(policy);
            for scripted in [false, true] {
                let received = ReceivedRun::with_actions(&scenario, &actions, lookahead, scripted);
                assert_eq!(received.inputs.len(), actions.len());
                received.assert_complete_from_any_frame(&scenario);
            }
        }
    }

    #[test]
    fn a_late_observer_receives_external_decisions() {
        let scenario = scenario_of_policy("external");
        for plan_ttis in [1, 30, 500] {
            ReceivedRun::with_decisions(&scenario, plan_ttis).assert_complete_from_any_frame(&scenario);
        }
    }
}
