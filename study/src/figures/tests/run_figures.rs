//! Tests of the figures of one run: deployments, timelines and missed events.

use std::path::Path;

use reveille_bs::scenario::parse;
use reveille_common::geometry::Point;
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Change, DeviceRange, OperatorAction};
use reveille_common::totals::MissCause;

use super::super::deployment::DeviceRole;
use super::super::deployment::EventChoice::{Automatic, Number, Without};
use super::super::scene::{Paint, Scene, SceneItem};
use super::super::{deployment, misses, path, run_walk, style, timeline};
use super::{check_properties, scenario_with, texts_of};
use crate::misses::{MissedEvent, Misses};

#[test]
fn deployments_and_timelines_can_be_drawn_for_each_policy() {
    for (policy, n) in [("knn", "80"), ("adjusted", "30"), ("random", "150"), ("genie", "1")] {
        let policy = format!("policy.name={policy}");
        let n = format!("devices={n}");
        let scenario = scenario_with(&[&policy, &n, "ttis=300", "policy.adjusted.pilot_ttis=100"]);
        let event_scene = deployment::EventScene::from_scenario(&scenario, Automatic).expect("an event");
        assert_eq!(event_scene.roles.len(), scenario.run.devices as usize);
        let reports = event_scene.roles.iter().filter(|role| {
            matches!(
                role,
                DeviceRole::Reporter | DeviceRole::Woken(_) | DeviceRole::WrongActivation(_)
            )
        });
        assert_eq!(
            reports.count() as u64,
            event_scene.event.expect("an event").tally.reports,
            "{policy}: the drawn reporters are the devices that reported"
        );
        let drawn = deployment::scene(&scenario, &event_scene);
        check_properties("deployment", &drawn);
        let stops = matches!(scenario.policy.name(), "knn" | "adjusted");
        assert_eq!(
            drawn.description.contains("stops at I_min"),
            stops,
            "{}",
            drawn.description
        );
        let shown = timeline::Timeline::from_scenario(&scenario, &[], 30, 120).expect("a timeline");
        check_properties("timeline", &timeline::scene(&scenario, &shown));
    }
}

/// Rings mark all classes but the most frequent one, and the timeline names the class of each device.
#[test]
fn device_classes_are_marked() {
    let text = "devices = 12\nttis = 300\n[policy]\nname = \"random\"\n[[class]]\nname = \"weak\"\nshare = 0.75\n\
                energy.e_wur = 0.00003\n[[class]]\nname = \"strong\"\nshare = 0.25\nenergy.e_max = 0.5\n\
                energy.e_idle = 0.1\nenergy.e_tx = 0.5\n";
    let scenario = parse(text, "classes.toml", Path::new(""), &[])
        .expect("a scenario")
        .scenario;
    let event_scene = deployment::EventScene::from_scenario(&scenario, Automatic).expect("an event");
    let marked = deployment::scene(&scenario, &event_scene);
    check_properties("classes", &marked);
    let legend = texts_of(&marked);
    for entry in ["class weak (9), no ring", "class strong (3)"] {
        assert!(legend.contains(&entry), "{entry}: {legend:?}");
    }
    let purple = Paint::Colour(style::PURPLE);
    let is_ring = |item: &&SceneItem| match item {
        SceneItem::Shape(shape) => shape.fill.is_none() && shape.stroke.is_some_and(|stroke| stroke.paint == purple),
        SceneItem::Text(_) => false,
    };
    let rings: Vec<&SceneItem> = marked.items.iter().filter(is_ring).collect();
    assert_eq!(rings.len(), 4, "three devices and the legend");
    for text in marked.items.iter().filter(|item| matches!(item, SceneItem::Text(_))) {
        let is_crossed = rings
            .iter()
            .any(|ring| path::boxes_overlap(&ring.bounds(), &text.bounds()));
        assert!(!is_crossed, "{text:?}");
    }
    let mut run_misses = Misses::new(scenario.clone());
    run_misses.end = Tti(300);
    let map_of_misses = misses::scene(&run_misses);
    check_properties("class-misses", &map_of_misses);
    assert!(texts_of(&map_of_misses).contains(&"class strong (3)"));
    let classes = reveille_common::scenario::assign_classes(&scenario);
    let of_class = |class: u16| {
        (0..12)
            .find(|device| classes[*device as usize] == class)
            .expect("a device")
    };
    let shown = timeline::Timeline::from_scenario(&scenario, &[of_class(0), of_class(1)], 30, 60).expect("a timeline");
    let drawn = timeline::scene(&scenario, &shown);
    check_properties("class-timeline", &drawn);
    let drawn_texts = texts_of(&drawn);
    for entry in [
        "class weak: E_max 100, E_idle 1, E_WuR 0.00003, E_Tx 10 units",
        "class strong: E_max 0.5, E_idle 0.1, E_WuR 0.0714, E_Tx 0.5 units",
        "0.25",
    ] {
        assert!(drawn_texts.contains(&entry), "{entry}: {drawn_texts:?}");
    }
    let is_event = |item: &&SceneItem| match item {
        SceneItem::Shape(shape) => {
            matches!(shape.fill, Some((paint, opacity)) if opacity < 0.4 && paint != Paint::Paper)
        }
        SceneItem::Text(_) => false,
    };
    for class_line in drawn.items.iter().filter(|item| match item {
        SceneItem::Text(text) => text.text.starts_with("class "),
        SceneItem::Shape(_) => false,
    }) {
        let crosses = |event: &SceneItem| path::boxes_overlap(&event.bounds(), &class_line.bounds());
        assert!(!drawn.items.iter().filter(is_event).any(crosses), "{class_line:?}");
    }
}

/// Devices woken beyond d_max have a separate mark, and devices of a small deployment have numbers.
#[test]
fn wrong_activations_and_device_numbers_are_marked() {
    let scenario = scenario_with(&["policy.name=knn", "devices=40", "ttis=300"]);
    let events = run_walk::collect_events(&scenario);
    let mut wrong = 0;
    for event in events.iter().filter(|event| event.tally.wake_ups > 0) {
        let event_scene = deployment::EventScene::from_scenario(&scenario, Number(event.event.0)).expect("an event");
        for (role, position) in event_scene.roles.iter().zip(&event_scene.positions) {
            let is_far = position.distance(event.epicentre) > scenario.sensing.d_max;
            let is_wrong = matches!(role, DeviceRole::WrongActivation(_));
            if is_wrong || matches!(role, DeviceRole::Woken(_)) {
                assert_eq!(is_wrong, is_far, "event {}", event.event.0);
            }
            wrong += u32::from(is_wrong);
        }
        let drawn = deployment::scene(&scenario, &event_scene);
        let texts = texts_of(&drawn);
        let is_label =
            |label: &str, device: u32| label == device.to_string() || label.starts_with(&format!("{device} (w"));
        let numbered = (0..40).filter(|device| texts.iter().any(|text| is_label(text, *device)));
        assert!(numbered.count() >= 35, "event {}: {texts:?}", event.event.0);
        let legend_count = texts
            .iter()
            .filter(|text| text.starts_with("wrong activation, beyond d_max"));
        let has_wrong = event_scene
            .roles
            .iter()
            .any(|role| matches!(role, DeviceRole::WrongActivation(_)));
        assert_eq!(legend_count.count(), usize::from(has_wrong));
        if event.start == event.last {
            assert!(
                drawn.description.contains("began and ended in TTI"),
                "{}",
                drawn.description
            );
        }
    }
    assert!(wrong > 0, "no wrong activation in the run");
}

#[test]
fn a_deployment_can_be_drawn_without_an_event() {
    let scenario = scenario_with(&["devices=150", "ttis=300"]);
    let event_scene = deployment::EventScene::from_scenario(&scenario, Without).expect("a quiet TTI");
    let events = run_walk::collect_events(&scenario);
    assert!(
        !events
            .iter()
            .any(|event| (event.start..=event.last).contains(&event_scene.tti))
    );
    let drawn = deployment::scene(&scenario, &event_scene);
    check_properties("no-event", &drawn);
    assert_eq!(
        deployment::file_name(&scenario, &event_scene),
        format!("deployment-knn-n150-s1-k{}", event_scene.tti)
    );
    assert!(!texts_of(&drawn).contains(&"event, with d_max"));
    // All of a large deployment's numbers would not fit, and no device takes part in an event.
    assert!(
        !drawn.description.contains("Numbers are devices"),
        "{}",
        drawn.description
    );
}

#[test]
fn an_event_without_a_report_can_be_drawn() {
    let scenario = scenario_with(&["policy.name=random", "devices=3", "ttis=300"]);
    let events = run_walk::collect_events(&scenario);
    let unreported = events
        .iter()
        .find(|event| event.tally.reports == 0)
        .expect("an event without a report");
    let event_scene = deployment::EventScene::from_scenario(&scenario, Number(unreported.event.0)).expect("an event");
    check_properties("unreported", &deployment::scene(&scenario, &event_scene));
}

#[test]
fn missed_events_have_a_marker_and_a_count_for_each_cause() {
    let mut run_misses = Misses::new(scenario_with(&["devices=30"]));
    let scene_without_misses = misses::scene(&run_misses);
    check_properties("no misses", &scene_without_misses);
    assert!(
        scene_without_misses.description.contains("No event was counted."),
        "{}",
        scene_without_misses.description
    );
    let causes = MissCause::ALL.map(Some).into_iter().chain([None]);
    for (number, cause) in (0_u64..).zip(causes) {
        run_misses.counted_starts.push(Tti(1000 + number));
        for event in 0..=number {
            run_misses.missed.push(MissedEvent {
                event,
                start: Tti(1000 + number),
                epicentre: Point::new(1.0 + 2.0 * number as f64, 1.0 + 2.0 * event as f64),
                cause,
                nearest: DeviceId(0),
                distance_m: 1.0,
            });
        }
    }
    let scene = misses::scene(&run_misses);
    check_properties("misses", &scene);
    let texts = texts_of(&scene);
    for (cause, count) in run_misses.causes() {
        let entry = format!("{} ({count})", crate::misses::cause_name(cause));
        assert!(texts.contains(&entry.as_str()), "no {entry}: {texts:?}");
    }
    let shapes = |scene: &Scene| {
        scene
            .items
            .iter()
            .filter(|item| matches!(item, SceneItem::Shape(_)))
            .count()
    };
    // Each event and each entry of the legend has a marker: one for each cause, and one for unknown causes.
    assert_eq!(
        shapes(&scene) - shapes(&scene_without_misses),
        run_misses.missed.len() + MissCause::ALL.len() + 1
    );

    let devices = DeviceRange {
        first: DeviceId(3),
        count: 2,
    };
    let tti = Tti(1005);
    run_misses.end = Tti(1100);
    run_misses.actions = vec![OperatorAction {
        tti,
        change: Change::Fail(devices),
    }];
    let scene_with_failures = misses::scene(&run_misses);
    assert!(texts_of(&scene_with_failures).contains(&"failed device (2)"));
    // The two lines of a cross replace a dot, and the legend has one more cross.
    assert_eq!(shapes(&scene_with_failures), shapes(&scene) + 2 + 2);
}
