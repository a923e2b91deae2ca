//! Removed devices: they send nothing, their ledgers end, and runs with and without lookahead, a reconstruction and a
//! replay have the same result. Removals over the bus are tested in `tests/program/`.

use std::cell::RefCell;

use reveille_bs::cycle::{PreparedRun, RunOutcome};
use reveille_bs::observer::frames::FrameObserver;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{DeviceRemoval, Frame, Message, WakeOutcome};
use reveille_common::totals::Ledger;
use reveille_lab::external_inputs::{ExternalInput, ExternalInputs};
use reveille_lab::preparation::prepare;
use reveille_lab::replay::Replay;
use reveille_lab::run::{Run, RunOptions};
use reveille_tests::scenarios::paper;
use reveille_view::reconstruction::Reconstruction;

const DEVICES: u32 = 50;
const TTIS: u64 = 1000;
/// Warm-up: a tenth of the TTIs, as in all presets.
const WARM_UP: u64 = 100;

fn prepared(policy: &str) -> PreparedRun {
    prepare(&paper(&[
        &format!("devices={DEVICES}"),
        &format!("ttis={TTIS}"),
        &format!("policy.name={policy}"),
    ]))
}

fn run(prepared: &PreparedRun, removals: &[DeviceRemoval], options: RunOptions) -> (RunOutcome, Vec<Frame>) {
    let frames = RefCell::new(Vec::new());
    let mut run = Run::new(prepared, options);
    run.schedule_inputs(&ExternalInputs::from_removals(removals));
    let outcome = run.finish(&mut FrameObserver::new(0, |frame| frames.borrow_mut().push(frame)));
    (outcome, frames.into_inner())
}

/// Removal of `count` devices from `first` on, in TTI `tti`: after that number of its `wake_ups`, or before sensing
/// (`None`).
fn removal(first: u32, count: u32, tti: u64, wake_ups: Option<u32>) -> DeviceRemoval {
    DeviceRemoval {
        first: DeviceId(first),
        count,
        tti: Tti(tti),
        wake_ups,
    }
}

/// Returns the TTIs and senders of all reports, answers to wake-ups included.
fn reports(frames: &[Frame]) -> Vec<(Tti, DeviceId)> {
    let tti_and_sender = |frame: &Frame| match frame.message() {
        Ok(Message::Report(report)) => Some((report.tti, report.device)),
        _ => None,
    };
    frames.iter().filter_map(tti_and_sender).collect()
}

/// Returns the outcomes of wake-ups, TTI by TTI.
fn wake_ups(frames: &[Frame]) -> Vec<(Tti, DeviceId, WakeOutcome)> {
    let tti_device_and_outcome = |frame: &Frame| match frame.message() {
        Ok(Message::Woken(woken)) => Some((frame.tti, DeviceId(frame.number?), woken.outcome)),
        _ => None,
    };
    frames.iter().filter_map(tti_device_and_outcome).collect()
}

/// Index of the removal between wake-ups in [`removals_of_all_kinds`].
const BETWEEN_WAKE_UPS: usize = 1;

/// Returns removals between events, in the TTI of a report, between wake-ups, and of many devices together. TTIs and
/// devices are chosen from the `frames` of the undisturbed run.
fn removals_of_all_kinds(frames: &[Frame]) -> Vec<Vec<DeviceRemoval>> {
    let is_late = |tti: Tti| tti.0 > WARM_UP + 300;
    let (reports, wake_ups) = (reports(frames), wake_ups(frames));
    let (report_tti, reporter) = *reports.iter().find(|(tti, _)| is_late(*tti)).expect("a report");
    let earlier_in_tti = |index: usize| {
        let earlier = wake_ups[..index].iter();
        earlier.filter(|wake_up| wake_up.0 == wake_ups[index].0).count() as u32
    };
    let last_wake_up = (0..wake_ups.len())
        .filter(|index| is_late(wake_ups[*index].0))
        .max_by_key(|index| earlier_in_tti(*index))
        .expect("wake-ups");
    let (tti, device, _) = wake_ups[last_wake_up];
    // Two processes together, each with a device that would have reported in that TTI.
    let mut simultaneous = reports
        .windows(2)
        .filter(|pair| is_late(pair[0].0) && pair[0].0 == pair[1].0);
    let simultaneous = simultaneous.next().expect("two reports in a TTI");
    vec![
        vec![removal(reporter.0, 1, report_tti.0, None)],
        vec![removal(device.0, 1, tti.0, Some(earlier_in_tti(last_wake_up)))],
        vec![
            removal(0, 10, 77, None),
            removal(12, 3, tti.0, None),
            removal(20, 9, tti.0 + 1, None),
        ],
        vec![removal(0, DEVICES, 800, None)],
        vec![removal(0, DEVICES, 0, None)],
        simultaneous
            .iter()
            .map(|(tti, device)| removal(device.0, 1, tti.0, None))
            .collect(),
    ]
}

#[test]
fn removed_devices_send_nothing() {
    for policy in ["knn", "age-index"] {
        let prepared = prepared(policy);
        let (_, frames) = run(&prepared, &[], RunOptions::default());
        for removals in removals_of_all_kinds(&frames) {
            let (outcome, frames_with_removals) = run(&prepared, &removals, RunOptions::default());
            for removal in &removals {
                let is_after = |tti: Tti| tti > removal.tti || (tti == removal.tti && removal.wake_ups.is_none());
                let mut reports_of_removed = reports(&frames_with_removals)
                    .into_iter()
                    .filter(|(tti, device)| removal.contains(*device) && is_after(*tti));
                assert_eq!(reports_of_removed.next(), None, "{policy}, {removal:?}");
                for (tti, device, outcome) in wake_ups(&frames_with_removals) {
                    let is_removed = removal.contains(device) && is_after(tti);
                    assert!(
                        !is_removed || outcome == WakeOutcome::Missed,
                        "{policy}, {removal:?}: {outcome:?}"
                    );
                }
            }
            let removed_ttis = |removal: &DeviceRemoval| {
                let first = WARM_UP.max(removal.tti.0 + 1);
                u64::from(removal.count) * (TTIS - first)
            };
            let measured_ttis = u64::from(DEVICES) * (TTIS - WARM_UP);
            let removed_share = removals.iter().map(removed_ttis).sum::<u64>() as f64 / measured_ttis as f64;
            assert!(
                (outcome.metrics.removed_pct - 100.0 * removed_share).abs() < 1e-9,
                "{policy}, {removals:?}: removed_pct {}, expected share {removed_share}",
                outcome.metrics.removed_pct
            );
            let frames_before_removal = |frames: &[Frame]| {
                let first = removals[0].tti;
                frames.iter().take_while(|frame| frame.tti < first).count()
            };
            assert_eq!(
                frames_before_removal(&frames_with_removals),
                frames_before_removal(&frames),
                "{policy}"
            );
        }
    }
}

#[test]
fn a_removal_between_two_wake_ups_affects_only_the_second() {
    let prepared = prepared("knn");
    let (_, frames) = run(&prepared, &[], RunOptions::default());
    let removal = removals_of_all_kinds(&frames)[BETWEEN_WAKE_UPS][0];
    let (_, frames_with_removal) = run(&prepared, &[removal], RunOptions::default());
    let wake_ups_in_tti = |frames: &[Frame]| {
        let mut wake_ups = wake_ups(frames);
        wake_ups.retain(|(tti, ..)| *tti == removal.tti);
        wake_ups
    };
    let (undisturbed, disturbed) = (wake_ups_in_tti(&frames), wake_ups_in_tti(&frames_with_removal));
    let earlier = removal.wake_ups.expect("a removal between wake-ups") as usize;
    assert!(earlier > 0 && undisturbed[..earlier] == disturbed[..earlier]);
    assert_eq!(
        (disturbed[earlier].1, disturbed[earlier].2),
        (removal.first, WakeOutcome::Missed)
    );
}

#[test]
fn ledgers_of_removed_devices_end_at_the_removal() {
    let prepared = prepared("age-index");
    let (_, frames) = run(&prepared, &[], RunOptions::default());
    // TTIs with messages other than events and plans, such as reports.
    let busy_ttis: Vec<Tti> = frames
        .iter()
        .filter(|frame| {
            frame
                .message()
                .is_ok_and(|message| !matches!(message, Message::World(_) | Message::Plan(_)))
        })
        .map(|frame| frame.tti)
        .collect();
    let quiet_tti = (700..TTIS)
        .find(|k| !busy_ttis.contains(&Tti(*k)))
        .expect("a TTI without reports");
    let removal = removal(4, 11, quiet_tti, None);
    let (outcome, _) = run(&prepared, &[removal], RunOptions::default());
    let mut undisturbed = Run::new(&prepared, RunOptions::default());
    undisturbed.advance(Tti(quiet_tti + 1), &mut ());
    let expected_ledgers: Vec<Ledger> = undisturbed.ledgers(DeviceId(4), 11);
    let ledgers: Vec<Ledger> = outcome.devices[4..15].iter().map(|device| device.ledger).collect();
    assert_eq!(ledgers, expected_ledgers);
}

#[test]
fn a_run_with_removals_equals_its_reconstruction_and_a_run_without_lookahead() {
    for policy in ["knn", "age-index"] {
        let prepared = prepared(policy);
        let (_, frames) = run(&prepared, &[], RunOptions::default());
        for removals in removals_of_all_kinds(&frames) {
            let (outcome, frames) = run(&prepared, &removals, RunOptions::default());
            let without_lookahead = RunOptions {
                lookahead: false,
                window: 7,
            };
            assert_eq!(
                run(&prepared, &removals, without_lookahead).0,
                outcome,
                "{policy}, {removals:?}"
            );
            let mut reconstruction = Reconstruction::new(&prepared.scenario);
            for frame in &frames {
                reconstruction
                    .apply(frame)
                    .unwrap_or_else(|error| panic!("{policy}, {removals:?}: {error}"));
            }
            let reconstructed = reconstruction.finish();
            assert_eq!(
                (reconstructed.digest, reconstructed.metrics),
                (outcome.digest, outcome.metrics),
                "{policy}, {removals:?}"
            );
        }
    }
}

#[test]
fn a_replay_accepts_a_removal_in_an_earlier_tti() {
    let prepared = prepared("knn");
    let removal = removal(3, 9, 600, None);
    let (outcome, _) = run(&prepared, &[removal], RunOptions::default());
    for replayed_until in [10, 601, 900] {
        let mut replay = Replay::new(&prepared, &ExternalInputs::default(), Tti::ZERO);
        replay.checkpoints(Tti(replayed_until), DeviceId(0), 1);
        replay.add_input(ExternalInput::Removal(removal));
        assert_eq!(
            replay.outcome(Tti(TTIS)),
            outcome,
            "replayed until TTI {replayed_until}"
        );
    }
}
