//! The audit compares what a run has noted with a replay: the same is whole, and a lie is found in its TTI, with who
//! told it.

use reveille_bs::observe::{Happening, Observer};
use reveille_bs::prepared::Prepared;
use reveille_bs::scenario::{Override, load};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Frame, Message, MessageKind, Report, States};
use reveille_common::units::Energy;
use reveille_lab::inputs::Inputs;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Options, Run};
use reveille_lab::shadow::{Difference, Noting, Shadow};

const TTIS: u64 = 600;

fn prepared(policy: &str, knowledge: &str) -> Prepared {
    let set = [
        format!("ttis={TTIS}"),
        format!("policy.name={policy}"),
        format!("bs.battery_knowledge={knowledge}"),
    ];
    let set = set.map(|set| Override::parse(&set).expect("an override"));
    prepare(&load("paper", &set).expect("a scenario"))
}

/// What a run notes, as its base station hands it to the audit.
#[derive(Default)]
struct Notes {
    noting: Noting,
    frames: Vec<Frame>,
}

impl Observer for Notes {
    fn see(&mut self, happening: &Happening<'_>) {
        let Self { noting, frames } = self;
        noting.of(happening, |frame| frames.push(frame));
    }

    fn told(&mut self, tti: Tti, batteries: &[Energy]) {
        self.frames.push(Noting::told(tti, batteries));
    }
}

fn noted(prepared: &Prepared) -> Vec<Frame> {
    let mut notes = Notes::default();
    Run::new(prepared, Options::default()).finish(&mut notes);
    notes.frames
}

/// What a shadow finds that follows these notes, `step` TTIs at a time.
fn audited(prepared: &Prepared, frames: &[Frame], step: u64) -> Result<(), Difference> {
    let mut shadow = Shadow::new(prepared, &Inputs::default(), Tti::ZERO);
    let mut rest = frames;
    for k in (step..=TTIS).step_by(step as usize) {
        let before = rest.iter().take_while(|frame| frame.tti < Tti(k)).count();
        let (now, later) = rest.split_at(before);
        shadow.compare(Tti(k), now)?;
        assert_eq!(shadow.compared(), Tti(k));
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
        // Nobody is told of batteries before the first TTI.
        assert_eq!(told, if knowledge == "oracle" { TTIS - 1 } else { 0 }, "{policy}");
        for step in [1, 50, TTIS] {
            assert_eq!(audited(&prepared, &frames, step), Ok(()), "{policy}, by {step}");
        }
    }
}

#[test]
fn who_lies_about_its_battery_is_named() {
    let prepared = prepared("q-learning", "oracle");
    let mut frames = noted(&prepared);
    let at = frames
        .iter()
        .position(|frame| frame.kind == MessageKind::States && frame.tti == Tti(321));
    let at = at.expect("batteries are told in each TTI");
    let Ok(Message::States(mut states)) = frames[at].message() else {
        panic!("no batteries");
    };
    let honest = states.views[17].battery;
    states.views[17].battery = honest + Energy::from_micro(2_000_000);
    let held = honest.units();
    frames[at] = Frame::of::<States>(Tti(321), (), &states);
    let found = audited(&prepared, &frames, 50).expect_err("a lie");
    assert_eq!((found.tti, found.device), (Tti(321), Some(DeviceId(17))));
    let said = format!("said to hold {:.2} units before it, and held {held:.2}", held + 2.0);
    assert!(found.what.contains(&said), "{}", found.what);
}

#[test]
fn who_lies_in_a_report_is_named() {
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
    frames[at] = Frame::of(report.tti, report.device, &lie);
    let found = audited(&prepared, &frames, 50).expect_err("a lie");
    assert_eq!((found.tti, found.device), (report.tti, Some(report.device)));
    // One that is missing is no better.
    frames.remove(at);
    assert_eq!(audited(&prepared, &frames, 50).expect_err("a silence").tti, report.tti);
}
