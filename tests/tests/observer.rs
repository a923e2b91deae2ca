//! An observer sees the same in memory and over the bus: every plan, grant, report, failure, wake-up, outcome, close
//! and state, in the same order.

use std::sync::Arc;
use std::time::Duration;

use reveille_bs::cycle::PreparedRun;
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::policy::factory::PolicyEntry;
use reveille_bs::policy::registry::POLICIES;
use reveille_bs::scenario::{Override, load};
use reveille_bs::server::{OnLoss, RunProgress, RunSpec, ServerConfig, dismiss_hosts, serve};
use reveille_bs::session::Session;
use reveille_common::bus::Bus;
use reveille_common::message::Pace;
use reveille_device::host::{HostConfig, run_host};
use reveille_lab::preparation::prepare;
use reveille_lab::run::{Run, RunOptions};

const PATIENCE: Duration = Duration::from_secs(20);

/// Records every notification, and requests the states after every fifth grant.
#[derive(Default)]
struct Record {
    lines: Vec<String>,
    closed: u64,
}

impl Observer for Record {
    fn notify(&mut self, notification: &Notification<'_>) {
        self.closed += u64::from(matches!(notification, Notification::TtiClosed(_)));
        self.lines.push(format!("{notification:?}"));
    }

    fn wants_states(&self) -> bool {
        self.closed.is_multiple_of(5)
    }

    fn wants_beliefs(&self) -> bool {
        true
    }
}

fn prepared(set: &[&str]) -> PreparedRun {
    let overrides: Vec<Override> = set
        .iter()
        .map(|set| Override::parse(set).expect("an override"))
        .collect();
    prepare(&load("paper", &overrides).expect("a scenario").scenario)
}

fn in_memory(prepared: &PreparedRun, lookahead: bool) -> Vec<String> {
    let options = RunOptions {
        lookahead,
        ..RunOptions::default()
    };
    let mut record = Record::default();
    Run::new(prepared, options).finish(&mut record);
    record.lines
}

async fn over_the_bus(prepared: &PreparedRun, lookahead: bool, hosts: u32) -> Vec<String> {
    let run = "observer-test";
    let bus = Bus::listen("tcp/127.0.0.1:0", run.parse().expect("a name"))
        .await
        .expect("a port");
    let devices = prepared.scenario.run.devices;
    for host in 0..hosts {
        let endpoint = bus.endpoint().to_owned();
        tokio::spawn(async move {
            let own = Bus::connect(&endpoint, run.parse().expect("a name"), PATIENCE)
                .await
                .expect("a link");
            let offer = HostConfig {
                max_devices: devices.div_ceil(hosts),
                name: format!("host {host} of a test"),
                key: None,
                patience: PATIENCE,
                stands_by: false,
                uses_worker: false,
            };
            run_host(&own, offer, &|_| {}).await
        });
    }
    let settings = ServerConfig {
        lookahead,
        pace: Pace::Max,
        on_loss: OnLoss::End,
        window_ttis: u64::MAX,
        join_timeout: Some(PATIENCE),
        starts_paused: false,
        state_interval_ttis: 0,
        run_key: None,
        join_needs_key: false,
    };
    let course = RunSpec {
        prepared,
        session: Session::new(prepared, settings.window_ttis),
        checkpoint: None,
        replay: None,
        decision_timeout: None,
    };
    let mut record = Record::default();
    let progress = Arc::new(RunProgress::default());
    serve(&bus, course, &settings, &progress, &mut record)
        .await
        .expect("a run");
    dismiss_hosts(&bus, None).expect("a bus");
    record.lines
}

/// Prepares a run of `policy`, with short pilot runs if the policy makes them.
fn settings(policy: &PolicyEntry, others: &[&str]) -> PreparedRun {
    let name = format!("policy.name={}", policy.name);
    let mut set = vec![name.as_str()];
    if policy.name == "adjusted" {
        set.push("policy.adjusted.pilot_ttis=200");
    }
    set.extend(others);
    prepared(&set)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn memory_and_bus_show_the_same() {
    // Batteries run low and the levels are not known, so that wake-ups fail or are not received.
    let poor = [
        "devices=40",
        "ttis=400",
        "harvest.lambda=0.03",
        "energy.initial=40",
        "events.alpha=0.4",
        "bs.battery_knowledge=reported",
    ];
    let looking_ahead = POLICIES.iter().map(|policy| (policy, true));
    let plain = POLICIES.iter().take(1).map(|policy| (policy, false));
    for (policy, lookahead) in looking_ahead.chain(plain) {
        let name = policy.name;
        let prepared = settings(policy, &poor);
        let memory = in_memory(&prepared, lookahead);
        let bus = over_the_bus(&prepared, lookahead, 3).await;
        for (line, (expected, found)) in memory.iter().zip(&bus).enumerate() {
            assert_eq!(expected, found, "{name}: the {line}th notification");
        }
        assert_eq!(memory.len(), bus.len(), "{name}");
        let count = |kind: &str| memory.iter().filter(|line| line.starts_with(kind)).count();
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
fn an_observer_changes_nothing() {
    for policy in POLICIES {
        let prepared = settings(policy, &["devices=30", "ttis=800"]);
        let plain = Run::new(&prepared, RunOptions::default()).finish(&mut ());
        let mut both = (Record::default(), Record::default());
        let seen = Run::new(&prepared, RunOptions::default()).finish(&mut both);
        assert_eq!(plain, seen);
        assert_eq!(both.0.lines, both.1.lines);
    }
}
