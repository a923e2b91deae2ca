//! The audit (`lab::replay::Replay::compare`): the frames of an unchanged run pass, and a changed frame is reported
//! with its TTI and sender. The thread that audits a run on the bus is tested in `tests/program/`.

use reveille_bs::cycle::PreparedRun;
use reveille_bs::observer::{Notification, Observer};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{DeviceStates, Frame, Message, MessageKind, Report};
use reveille_common::units::Energy;
use reveille_lab::external_inputs::ExternalInputs;
use reveille_lab::preparation::prepare;
use reveille_lab::replay::{DigestFrameEncoder, Divergence, Replay};
use reveille_lab::run::{Run, RunOptions};
use reveille_tests::scenarios::paper;

const TTIS: u64 = 600;

fn prepare_policy(policy: &str, battery_knowledge: &str) -> PreparedRun {
    prepare(&paper(&[
        &format!("ttis={TTIS}"),
        &format!("policy.name={policy}"),
        &format!("bs.battery_knowledge={battery_knowledge}"),
    ]))
}

/// Frames of a run, as the base station passes them to the audit (`deploy/src/audit.rs`).
#[derive(Default)]
struct FrameRecorder {
    encoder: DigestFrameEncoder,
    frames: Vec<Frame>,
}

impl Observer for FrameRecorder {
    fn notify(&mut self, notification: &Notification<'_>) {
        let Self { encoder, frames } = self;
        encoder.encode(notification, |frame| frames.push(frame));
    }

    fn batteries_revealed(&mut self, tti: Tti, batteries: &[Energy]) {
        self.frames.push(DigestFrameEncoder::batteries_frame(tti, batteries));
    }
}

fn record_frames(prepared: &PreparedRun) -> Vec<Frame> {
    let mut recorder = FrameRecorder::default();
    Run::new(prepared, RunOptions::default()).finish(&mut recorder);
    recorder.frames
}

/// Audits `frames`, which are in the order of TTIs, `step` TTIs at a time. `step` divides [`TTIS`].
fn audit(prepared: &PreparedRun, frames: &[Frame], step: u64) -> Result<(), Divergence> {
    let mut replay = Replay::new(prepared, &ExternalInputs::default(), Tti::ZERO);
    let mut unaudited = frames;
    for k in (step..=TTIS).step_by(step as usize) {
        let frame_count = unaudited.iter().take_while(|frame| frame.tti < Tti(k)).count();
        let (step_frames, later_frames) = unaudited.split_at(frame_count);
        replay.compare(Tti(k), step_frames)?;
        assert_eq!(replay.compared_until(), Tti(k));
        unaudited = later_frames;
    }
    assert!(unaudited.is_empty());
    Ok(())
}

#[test]
fn an_unchanged_run_passes_the_audit() {
    for (policy, battery_knowledge) in [("knn", "reported"), ("age-index", "oracle"), ("q-learning", "oracle")] {
        let prepared = prepare_policy(policy, battery_knowledge);
        let frames = record_frames(&prepared);
        let states_frames = frames.iter().filter(|frame| frame.kind == MessageKind::States).count() as u64;
        // Before the first TTI no batteries are passed to the policy.
        let expected_frames = if battery_knowledge == "oracle" { TTIS - 1 } else { 0 };
        assert_eq!(states_frames, expected_frames, "{policy}");
        for step in [1, 50, TTIS] {
            assert_eq!(
                audit(&prepared, &frames, step),
                Ok(()),
                "{policy}, {step} TTIs at a time"
            );
        }
    }
}

#[test]
fn a_false_battery_level_is_reported_with_its_device() {
    let (tti, device) = (Tti(321), DeviceId(17));
    let prepared = prepare_policy("q-learning", "oracle");
    let mut frames = record_frames(&prepared);
    let index = frames
        .iter()
        .position(|frame| frame.kind == MessageKind::States && frame.tti == tti);
    let index = index.expect("each TTI has battery levels");
    let Ok(Message::States(mut states)) = frames[index].message() else {
        panic!("no states");
    };
    let battery = &mut states.views[device.index()].battery;
    let true_units = battery.units();
    *battery += Energy::from_micro(2_000_000);
    frames[index] = Frame::new::<DeviceStates>(tti, (), &states);
    let divergence = audit(&prepared, &frames, 50).expect_err("a false battery level");
    assert_eq!((divergence.tti, divergence.device), (tti, Some(device)));
    // The text of `lab/src/replay.rs`.
    let expected_text = format!(
        "{} units in the battery of device 17, and the replay {true_units} units",
        true_units + 2.0
    );
    assert!(
        divergence.description.contains(&expected_text),
        "{}",
        divergence.description
    );
}

#[test]
fn a_false_or_missing_report_is_reported_with_its_tti() {
    let prepared = prepare_policy("knn", "reported");
    let mut frames = record_frames(&prepared);
    let index = frames
        .iter()
        .position(|frame| frame.kind == MessageKind::Report && frame.tti > Tti(200));
    let index = index.expect("reports");
    let Ok(Message::Report(report)) = frames[index].message() else {
        panic!("no report");
    };
    let false_report = Report {
        battery: Energy::from_micro(report.battery.micro() / 2),
        ..report
    };
    frames[index] = Frame::new(report.tti, report.device, &false_report);
    let divergence = audit(&prepared, &frames, 50).expect_err("a false report");
    assert_eq!((divergence.tti, divergence.device), (report.tti, Some(report.device)));
    frames.remove(index);
    let divergence = audit(&prepared, &frames, 50).expect_err("a missing report");
    assert_eq!(divergence.tti, report.tti);
}
