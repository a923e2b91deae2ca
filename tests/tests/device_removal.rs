//! Removed devices: they send nothing, their ledgers end, and every way to drive the run has the same result.

use std::cell::RefCell;

use reveille_bs::cycle::{PreparedRun, RunOutcome};
use reveille_bs::observer::frames::FrameObserver;
use reveille_bs::scenario::{Override, load};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{DeviceRemoval, Frame, Message, WakeOutcome};
use reveille_common::totals::Ledger;
use reveille_lab::external_inputs::{ExternalInput, ExternalInputs};
use reveille_lab::preparation::prepare;
use reveille_lab::replay::Replay;
use reveille_lab::run::{Run, RunOptions};
use reveille_view::reconstruction::Reconstruction;

const DEVICES: u32 = 50;
const TTIS: u64 = 1000;
/// Warm-up: a tenth of the TTIs, as in all presets.
const WARM_UP: u64 = 100;

fn prepared(policy: &str) -> PreparedRun {
    let set = [
        format!("devices={DEVICES}"),
        format!("ttis={TTIS}"),
        format!("policy.name={policy}"),
    ];
    let set = set.map(|set| Override::parse(&set).expect("an override"));
    prepare(&load("paper", &set).expect("a scenario").scenario)
}

fn run(prepared: &PreparedRun, outages: &[DeviceRemoval], options: RunOptions) -> (RunOutcome, Vec<Frame>) {
    let frames = RefCell::new(Vec::new());
    let mut run = Run::new(prepared, options);
    run.schedule_inputs(&ExternalInputs::from_outages(outages));
    let outcome = run.finish(&mut FrameObserver::new(0, |frame| frames.borrow_mut().push(frame)));
    (outcome, frames.into_inner())
}

fn outage(first: u32, count: u32, tti: u64, wake_ups: Option<u32>) -> DeviceRemoval {
    DeviceRemoval {
        first: DeviceId(first),
        count,
        tti: Tti(tti),
        wake_ups,
    }
}

/// Returns the TTIs and senders of unsolicited reports.
fn reports(frames: &[Frame]) -> Vec<(Tti, DeviceId)> {
    let report = |frame: &Frame| match frame.message() {
        Ok(Message::Report(report)) => Some((report.tti, report.device)),
        _ => None,
    };
    frames.iter().filter_map(report).collect()
}

/// Returns the outcomes of wake-ups, TTI by TTI.
fn wake_ups(frames: &[Frame]) -> Vec<(Tti, DeviceId, WakeOutcome)> {
    let woken = |frame: &Frame| match frame.message() {
        Ok(Message::Woken(woken)) => Some((frame.tti, DeviceId(frame.number?), woken.outcome)),
        _ => None,
    };
    frames.iter().filter_map(woken).collect()
}

/// Returns device removals of all kinds for a run of `policy`, located in the undisturbed run. They are between events,
/// before a report, between wake-ups, and of many devices together.
fn outages(frames: &[Frame]) -> Vec<Vec<DeviceRemoval>> {
    let late = |tti: &Tti| tti.0 > WARM_UP + 300;
    let (reports, wakes) = (reports(frames), wake_ups(frames));
    let (heard, reporter) = *reports.iter().find(|(tti, _)| late(tti)).expect("a report");
    let before = |at: usize| wakes[..at].iter().filter(|wake| wake.0 == wakes[at].0).count() as u32;
    let is_late = |at: &usize| late(&wakes[*at].0);
    let at = (0..wakes.len())
        .filter(is_late)
        .max_by_key(|at| before(*at))
        .expect("wake-ups");
    let ((tti, device, _), before) = (wakes[at], before(at));
    // Two processes together, each with a device that would have reported in that TTI.
    let mut both = reports.windows(2).filter(|two| late(&two[0].0) && two[0].0 == two[1].0);
    let both = both.next().expect("two reports in a TTI");
    vec![
        vec![outage(reporter.0, 1, heard.0, None)],
        vec![outage(device.0, 1, tti.0, Some(before))],
        vec![
            outage(0, 10, 77, None),
            outage(12, 3, tti.0, None),
            outage(20, 9, tti.0 + 1, None),
        ],
        vec![outage(0, DEVICES, 800, None)],
        vec![outage(0, DEVICES, 0, None)],
        both.iter()
            .map(|(tti, device)| outage(device.0, 1, tti.0, None))
            .collect(),
    ]
}

#[test]
fn removed_devices_send_nothing() {
    for policy in ["knn", "age-index"] {
        let prepared = prepared(policy);
        let (_, frames) = run(&prepared, &[], RunOptions::default());
        for outages in outages(&frames) {
            let (outcome, disturbed) = run(&prepared, &outages, RunOptions::default());
            for outage in &outages {
                let is_after = |tti: Tti| tti > outage.tti || (tti == outage.tti && outage.wake_ups.is_none());
                let heard = reports(&disturbed).into_iter();
                let mut late = heard.filter(|(tti, device)| outage.contains(*device) && is_after(*tti));
                assert_eq!(late.next(), None, "{policy}, {outage:?}");
                for (tti, device, came) in wake_ups(&disturbed) {
                    let is_removed = outage.contains(device) && is_after(tti);
                    assert!(
                        !is_removed || came == WakeOutcome::Missed,
                        "{policy}, {outage:?}: {came:?}"
                    );
                }
            }
            let gone = |outage: &DeviceRemoval| {
                let first = WARM_UP.max(outage.tti.0 + 1);
                u64::from(outage.count) * (TTIS - first)
            };
            let share = outages.iter().map(gone).sum::<u64>() as f64 / (u64::from(DEVICES) * (TTIS - WARM_UP)) as f64;
            assert!(
                (outcome.metrics.removed_pct - 100.0 * share).abs() < 1e-9,
                "{policy}, {outages:?}"
            );
            let before = |frames: &[Frame]| -> Vec<Frame> {
                let first = outages[0].tti;
                frames.iter().take_while(|frame| frame.tti < first).cloned().collect()
            };
            assert_eq!(before(&disturbed).len(), before(&frames).len(), "{policy}");
        }
    }
}

/// The wake-up before the removal counts, and the wake-up of the removed device does not.
#[test]
fn a_removal_between_two_wake_ups() {
    let prepared = prepared("knn");
    let (_, frames) = run(&prepared, &[], RunOptions::default());
    let outage = outages(&frames)[1][0];
    let (_, disturbed) = run(&prepared, &[outage], RunOptions::default());
    let of_tti = |frames: &[Frame]| {
        let mut all = wake_ups(frames);
        all.retain(|(tti, ..)| *tti == outage.tti);
        all
    };
    let (before, after) = (of_tti(&frames), of_tti(&disturbed));
    let at = outage.wake_ups.expect("in the middle of wake-ups") as usize;
    assert!(at > 0 && before[..at] == after[..at]);
    assert_eq!((after[at].1, after[at].2), (outage.first, WakeOutcome::Missed));
}

#[test]
fn ledgers_of_removed_devices_end_at_the_removal() {
    let prepared = prepared("age-index");
    let (_, frames) = run(&prepared, &[], RunOptions::default());
    let spoke: Vec<Tti> = frames
        .iter()
        .filter(|frame| {
            frame
                .message()
                .is_ok_and(|message| !matches!(message, Message::World(_) | Message::Plan(_)))
        })
        .map(|frame| frame.tti)
        .collect();
    let quiet = (700..TTIS)
        .find(|k| !spoke.contains(&Tti(*k)))
        .expect("a TTI without an event");
    let outage = outage(4, 11, quiet, None);
    let (outcome, _) = run(&prepared, &[outage], RunOptions::default());
    let mut whole = Run::new(&prepared, RunOptions::default());
    whole.advance(Tti(quiet + 1), &mut ());
    let own: Vec<Ledger> = whole.ledgers(DeviceId(4), 11);
    let gone: Vec<Ledger> = outcome.devices[4..15].iter().map(|device| device.ledger).collect();
    assert_eq!(gone, own);
}

#[test]
fn the_run_is_the_same_however_it_is_granted_and_from_its_messages() {
    for policy in ["knn", "age-index"] {
        let prepared = prepared(policy);
        let (_, frames) = run(&prepared, &[], RunOptions::default());
        for outages in outages(&frames) {
            let (outcome, frames) = run(&prepared, &outages, RunOptions::default());
            let one_by_one = RunOptions {
                lookahead: false,
                window: 7,
            };
            assert_eq!(run(&prepared, &outages, one_by_one).0, outcome, "{policy}, {outages:?}");
            let mut replay = Reconstruction::new(&prepared.scenario);
            for frame in &frames {
                replay
                    .apply(frame)
                    .unwrap_or_else(|error| panic!("{policy}, {outages:?}: {error}"));
            }
            let replayed = replay.finish();
            assert_eq!(
                (replayed.digest, replayed.metrics),
                (outcome.digest, outcome.metrics),
                "{policy}, {outages:?}"
            );
        }
    }
}

#[test]
fn a_replay_with_a_late_removal_goes_back() {
    let prepared = prepared("knn");
    let lost = outage(3, 9, 600, None);
    let (outcome, _) = run(&prepared, &[lost], RunOptions::default());
    for reached in [10, 601, 900] {
        let mut shadow = Replay::new(&prepared, &ExternalInputs::default(), Tti::ZERO);
        shadow.checkpoints(Tti(reached), DeviceId(0), 1);
        shadow.add_input(ExternalInput::Outage(lost));
        assert_eq!(shadow.outcome(Tti(TTIS)), outcome, "from TTI {reached}");
    }
}
