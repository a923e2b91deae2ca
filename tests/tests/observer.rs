//! An observer receives the same notifications, in the same order, from a run in memory and from a run over the bus.
//! The hosts run as tasks of this process; frames, recordings, lost hosts and operator actions are not checked here.

use std::sync::Arc;
use std::time::Duration;

use reveille_bs::cycle::PreparedRun;
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::policy::factory::PolicyEntry;
use reveille_bs::policy::registry::POLICIES;
use reveille_bs::server::{OnLoss, RunProgress, RunSpec, ServerConfig, dismiss_hosts, serve};
use reveille_bs::session::Session;
use reveille_common::bus::Bus;
use reveille_common::ids::Tti;
use reveille_common::message::HostOffer;
use reveille_common::message::Pace;
use reveille_device::host::{HostConfig, run_host};
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};
use reveille_tests::scenarios::paper;

/// Time limit for connecting and joining on the bus.
const PATIENCE: Duration = Duration::from_secs(20);

/// Records every notification as its debug text, and requests the states in every fifth TTI.
#[derive(Default)]
struct NotificationRecorder {
    /// Notifications, in order.
    lines: Vec<String>,
    closed_ttis: u64,
}

impl Observer for NotificationRecorder {
    fn notify(&mut self, notification: &Notification<'_>) {
        self.closed_ttis += u64::from(matches!(notification, Notification::TtiClosed(_)));
        self.lines.push(format!("{notification:?}"));
    }

    fn states_due(&self) -> Tti {
        Tti(self.closed_ttis.next_multiple_of(5))
    }

    fn wants_beliefs(&self) -> bool {
        true
    }
}

fn notifications_in_memory(prepared: &PreparedRun, lookahead: bool) -> Vec<String> {
    let options = RunOptions {
        lookahead,
        ..RunOptions::default()
    };
    let mut recorder = NotificationRecorder::default();
    Run::new(prepared, options).finish(&mut recorder);
    recorder.lines
}

/// Runs a base station and `host_count` hosts over the bus. They share the devices evenly.
async fn notifications_over_bus(prepared: &PreparedRun, lookahead: bool, host_count: u32) -> Vec<String> {
    let run_name = "observer-test";
    let bus = Bus::listen("tcp/127.0.0.1:0", run_name.parse().expect("a name"))
        .await
        .expect("a port");
    let devices = prepared.scenario.run.devices;
    for host in 0..host_count {
        let endpoint = bus.endpoint().to_owned();
        tokio::spawn(async move {
            let host_bus = Bus::connect(&endpoint, run_name.parse().expect("a name"), PATIENCE)
                .await
                .expect("a link");
            let config = HostConfig {
                offer: HostOffer::AtMost(devices.div_ceil(host_count)),
                name: format!("host {host} of a test"),
                key: None,
                patience: PATIENCE,
                stands_by: false,
                forces_worker: false,
            };
            run_host(&host_bus, config, &|_| {}).await
        });
    }
    let config = ServerConfig {
        run_id: 7,
        lookahead,
        pace: Pace::Max,
        on_loss: OnLoss::End,
        loss_timeout: None,
        window_ttis: u64::MAX,
        join_timeout: Some(PATIENCE),
        starts_paused: false,
        state_interval_ttis: 0,
        run_key: None,
        join_needs_key: false,
    };
    let spec = RunSpec {
        prepared,
        session: Session::new(prepared, config.window_ttis),
        checkpoint: None,
        replay: None,
        decision_timeout: None,
    };
    let mut recorder = NotificationRecorder::default();
    let progress = Arc::new(RunProgress::default());
    serve(&bus, spec, &config, &progress, &mut recorder)
        .await
        .expect("a run");
    dismiss_hosts(&bus, None).await.expect("a bus");
    recorder.lines
}

/// Prepares a run of `policy`, with short pilot runs if the policy makes them.
fn prepare_policy(policy: &PolicyEntry, other_fields: &[&str]) -> PreparedRun {
    let name = format!("policy.name={}", policy.name);
    let mut fields = vec![name.as_str()];
    if policy.name == "adjusted" {
        fields.push("policy.adjusted.pilot_ttis=200");
    }
    fields.extend(other_fields);
    prepare(&paper(&fields))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn notifications_in_memory_and_over_the_bus_are_equal() {
    // Batteries run low and the levels are not known, so that wake-ups fail or are not received.
    let scarce_energy = [
        "devices=40",
        "ttis=400",
        "harvest.lambda=0.03",
        "energy.initial=40",
        "events.alpha=0.4",
        "bs.battery_knowledge=reported",
    ];
    let with_lookahead = POLICIES.iter().map(|policy| (policy, true));
    // One policy is enough without lookahead, whose effect `lookahead.rs` tests.
    let without_lookahead = POLICIES.iter().take(1).map(|policy| (policy, false));
    for (policy, lookahead) in with_lookahead.chain(without_lookahead) {
        let name = policy.name;
        let prepared = prepare_policy(policy, &scarce_energy);
        let memory_lines = notifications_in_memory(&prepared, lookahead);
        let bus_lines = notifications_over_bus(&prepared, lookahead, 3).await;
        for (index, (in_memory, over_bus)) in memory_lines.iter().zip(&bus_lines).enumerate() {
            assert_eq!(in_memory, over_bus, "{name}: notification {index}");
        }
        assert_eq!(memory_lines.len(), bus_lines.len(), "{name}");
        let count = |kind: &str| memory_lines.iter().filter(|line| line.starts_with(kind)).count();
        for kind in [
            "PlanSent",
            "TtisGranted",
            "EventStarted",
            "EventEnded",
            "TtiClosed",
            "DeviceStates",
        ] {
            assert!(count(kind) > 0, "{name}: no {kind}");
        }
        for kind in ["WakeUpSent", "WakeUpCompleted"] {
            assert_eq!(count(kind) > 0, policy.wakes, "{name}: {kind}");
        }
    }
}

#[test]
fn an_observer_does_not_change_the_outcome() {
    for policy in POLICIES {
        let prepared = prepare_policy(policy, &["devices=30", "ttis=800"]);
        let unobserved = Run::new(&prepared, RunOptions::default()).finish(&mut ());
        let mut recorders = (NotificationRecorder::default(), NotificationRecorder::default());
        let observed = Run::new(&prepared, RunOptions::default()).finish(&mut recorders);
        assert_eq!(unobserved, observed);
        assert_eq!(recorders.0.lines, recorders.1.lines);
    }
}
