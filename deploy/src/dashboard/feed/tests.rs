//! Tests of the dashboard's copy of a run: its heat, its curves and its heading against counts of the messages.

use std::collections::BTreeMap;

use reveille_bs::observer::frames::FrameObserver;
use reveille_bs::scenario::{Override, load};
use reveille_common::message::{Change, DeviceRange, OperatorAction};
use reveille_lab::external_inputs::ExternalInput;
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};

use super::*;

#[test]
fn heat_counts_up_to_the_requested_tti() {
    let set = ["devices=12", "ttis=1500", "policy.name=knn", "sensing.d_max=2"];
    let set = set.map(|set| Override::parse(set).expect("an override"));
    let scenario = load("paper", &set).expect("a scenario").scenario;
    let feed = Feed::new("r", &scenario, None, FeedOrigin::Recording(Path::new("r")), None);
    let mut records = Vec::new();
    let on_frame = |frame: Frame| {
        if let Ok(Message::Event(EventUpdate::Ended(record))) = frame.message() {
            records.push(record);
        }
        feed.apply(frame);
    };
    let mut run = Run::new(&prepare(&scenario), RunOptions::default());
    // The failure begins with a TTI inside a grant.
    run.schedule_input(ExternalInput::Action(OperatorAction {
        tti: Tti(380),
        change: Change::Fail(DeviceRange {
            first: DeviceId(0),
            count: 12,
        }),
    }));
    run.finish(&mut FrameObserver::new(0, on_frame));
    let positions = Deployment::new(&scenario).positions();
    // The number of TTIs from TTI 0 to each TTI in which each device was awake by plan and had power.
    let mut counts = vec![0_u64; 12];
    let sensing_ttis: Vec<Vec<u64>> = (0..1500)
        .map(|tti| {
            let snapshot = feed.history(|history| history.snapshot_at(Tti(tti)).expect("an available TTI"));
            for (id, count) in (0..).map(DeviceId).zip(&mut counts) {
                let is_asleep = matches!(
                    snapshot.views[id.index()].state,
                    DeviceState::Sleep { .. } | DeviceState::Failed
                );
                // A device that detects an event, but cannot pay its report, goes to sleep.
                let has_sensed = !is_asleep || snapshot.failed_reporters.contains(&id);
                *count += u64::from(snapshot.planned_on[id.index()] && has_sensed);
            }
            counts.clone()
        })
        .collect();
    for tti in (370..410).chain([0, 200, 777, 1499]) {
        let heat = feed.heat_json(Tti(tti)).expect("an available TTI");
        let (mut near_counts, mut near_miss_counts) = (vec![0; 12], vec![0; 12]);
        for record in records.iter().filter(|record| record.last.0 <= tti) {
            let distances: Vec<f64> = positions.iter().map(|at| at.distance(record.epicentre)).collect();
            let nearest = (0..12).min_by(|a, b| distances[*a].total_cmp(&distances[*b]));
            let nearest = nearest.expect("a device");
            near_counts[nearest] += 1;
            near_miss_counts[nearest] += i32::from(record.delay().is_none());
        }
        assert_eq!(heat["events"], json!(near_counts), "TTI {tti}");
        assert_eq!(heat["misses"], json!(near_miss_counts), "TTI {tti}");
        assert_eq!(heat["looks"], json!(sensing_ttis[tti as usize]), "TTI {tti}");
    }
    assert!(records.iter().any(|record| record.last.0 > 777), "no late event");
    assert!(
        sensing_ttis[379].iter().sum::<u64>() > 200,
        "the devices sense before they fail"
    );
    assert_eq!(feed.heat_json(Tti(1500)), None);
}

#[test]
fn header_and_curves_agree_between_grants() {
    let set = [
        "devices=20",
        "ttis=2000",
        "policy.name=knn",
        "sensing.d_max=2",
        "events.alpha=0.4",
    ];
    let set = set.map(|set| Override::parse(set).expect("an override"));
    let scenario = load("paper", &set).expect("a scenario").scenario;
    let feed = Feed::new("r", &scenario, None, FeedOrigin::Recording(Path::new("r")), None);
    let (mut events, mut missed, mut shares) = (0, 0, BTreeMap::new());
    // A paused run stands between two grants.
    let mut check = |events: u64, missed: u64| {
        let (now, curves) = (feed.current_json(), feed.curves());
        let Some(last) = curves.last() else { return };
        assert_eq!((&now["events"], &now["missed"]), (&json!(events), &json!(missed)));
        let share = (events > 0).then_some(100.0 * missed as f64 / events as f64);
        assert_eq!(
            (&now["tti"], last.metrics[1]),
            (&json!(last.tti), share),
            "TTI {}",
            last.tti
        );
        shares.insert(last.tti, share);
    };
    let on_frame = |frame: Frame| {
        if matches!(frame.kind, MessageKind::Plan | MessageKind::World) {
            check(events, missed);
        }
        if let Ok(Message::Event(EventUpdate::Ended(record))) = frame.message()
            && record.counted
        {
            events += 1;
            missed += u64::from(record.delay().is_none());
        }
        feed.apply(frame);
    };
    Run::new(&prepare(&scenario), RunOptions::default()).finish(&mut FrameObserver::new(0, on_frame));
    check(events, missed);
    assert!(missed > 10 && events > missed, "{missed} of {events} missed");
    feed.end();
    let points = feed.curves();
    assert!(points.len() > 300 && points.last().is_some_and(|last| last.tti == Tti(1999)));
    // Stored points equal the values of a pause at their TTIs.
    for point in points {
        assert_eq!(shares.get(&point.tti), Some(&point.metrics[1]), "TTI {}", point.tti);
    }
}
