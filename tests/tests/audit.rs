//! The audit compares the records of a run with a replay: equal records pass, and a divergence is reported with its TTI
//! and sender.

use reveille_bs::cycle::PreparedRun;
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::scenario::{Override, load};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{DeviceStates, Frame, Message, MessageKind, Report};
use reveille_common::units::Energy;
use reveille_lab::external_inputs::ExternalInputs;
use reveille_lab::preparation::prepare;
use reveille_lab::replay::{DigestFrames, Divergence, Replay};
use reveille_lab::run::{Run, RunOptions};

const TTIS: u64 = 600;

fn prepared(policy: &str, knowledge: &str) -> PreparedRun {
    let set = [
        format!("ttis={TTIS}"),
        format!("policy.name={policy}"),
        format!("bs.battery_knowledge={knowledge}"),
    ];
    let set = set.map(|set| Override::parse(&set).expect("an override"));
    prepare(&load("paper", &set).expect("a scenario").scenario)
}

/// Records of a run, as the base station passes them to the audit.
#[derive(Default)]
struct RecordedNotes {
    noting: DigestFrames,
    frames: Vec<Frame>,
}

impl Observer for RecordedNotes {
    fn notify(&mut self, notification: &Notification<'_>) {
        let Self { noting, frames } = self;
        noting.encode(notification, |frame| frames.push(frame));
    }

    fn batteries_revealed(&mut self, tti: Tti, batteries: &[Energy]) {
        self.frames.push(DigestFrames::batteries_frame(tti, batteries));
    }
}

fn noted(prepared: &PreparedRun) -> Vec<Frame> {
    let mut notes = RecordedNotes::default();
    Run::new(prepared, RunOptions::default()).finish(&mut notes);
    notes.frames
}

/// Returns the result of a replay that follows these records, `step` TTIs at a time.
fn audited(prepared: &PreparedRun, frames: &[Frame], step: u64) -> Result<(), Divergence> {
    let mut shadow = Replay::new(prepared, &ExternalInputs::default(), Tti::ZERO);
    let mut rest = frames;
    for k in (step..=TTIS).step_by(step as usize) {
        let before = rest.iter().take_while(|frame| frame.tti < Tti(k)).count();
        let (now, later) = rest.split_at(before);
        shadow.compare(Tti(k), now)?;
        assert_eq!(shadow.compared_until(), Tti(k));
        rest = later;
    }
    assert!(rest.is_empty());
    Ok(())
}

#[test]
fn an_honest_run_is_whole() {
    for (policy, knowledge) in [("knn", "reported"), ("age-index", "oracle"), ("q-learning", "oracle")] {
        let prepared = prepared(policy, knowledge);
        let frames = noted(&prepared);
        let told = frames.iter().filter(|frame| frame.kind == MessageKind::States).count() as u64;
        // Before the first TTI no batteries are passed to the policy.
        assert_eq!(told, if knowledge == "oracle" { TTIS - 1 } else { 0 }, "{policy}");
        for step in [1, 50, TTIS] {
            assert_eq!(audited(&prepared, &frames, step), Ok(()), "{policy}, by {step}");
        }
    }
}

#[test]
fn a_host_with_a_false_battery_is_named() {
    let prepared = prepared("q-learning", "oracle");
    let mut frames = noted(&prepared);
    let at = frames
        .iter()
        .position(|frame| frame.kind == MessageKind::States && frame.tti == Tti(321));
    let at = at.expect("each TTI has battery levels");
    let Ok(Message::States(mut states)) = frames[at].message() else {
        panic!("no batteries");
    };
    let honest = states.views[17].battery;
    states.views[17].battery = honest + Energy::from_micro(2_000_000);
    let held = honest.units();
    frames[at] = Frame::new::<DeviceStates>(Tti(321), (), &states);
    let found = audited(&prepared, &frames, 50).expect_err("a lie");
    assert_eq!((found.tti, found.device), (Tti(321), Some(DeviceId(17))));
    let said = format!(
        "{:.2} units in the battery of device 17, and the replay {held:.2}",
        held + 2.0
    );
    assert!(found.description.contains(&said), "{}", found.description);
}

#[test]
fn a_host_with_a_false_report_is_named() {
    let prepared = prepared("knn", "reported");
    let mut frames = noted(&prepared);
    let at = frames
        .iter()
        .position(|frame| frame.kind == MessageKind::Report && frame.tti > Tti(200));
    let at = at.expect("reports");
    let Ok(Message::Report(report)) = frames[at].message() else {
        panic!("no report");
    };
    let lie = Report {
        battery: Energy::from_micro(report.battery.micro() / 2),
        ..report
    };
    frames[at] = Frame::new(report.tti, report.device, &lie);
    let found = audited(&prepared, &frames, 50).expect_err("a lie");
    assert_eq!((found.tti, found.device), (report.tti, Some(report.device)));
    // A missing report is a divergence as well.
    frames.remove(at);
    assert_eq!(audited(&prepared, &frames, 50).expect_err("a silence").tti, report.tti);
}
