//! Prometheus metrics of a running run, for `--metrics`. Their names and labels are stable; docs/monitoring.md lists
//! them. `deploy/src/run_watchers.rs` feeds them: frames through [`PrometheusMetrics::count_frame`], notifications
//! through [`MetricsObserver`]. Either source alone leaves some metrics at 0. `deploy/src/metrics_server.rs` serves
//! them.

use std::ops::Deref;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use prometheus_client::encoding::EncodeLabelSet;
use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::Histogram;
use prometheus_client::registry::Registry;
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::scenario::Scenario;
use reveille_common::ids::Tti;
use reveille_common::message::{EventUpdate, Frame, Message, MessageKind};
use reveille_common::score::WindowRecord;
use reveille_common::state::{DeviceState, DeviceView};
use reveille_common::totals::{EnergyByState, MissCause};
use reveille_common::units::Energy;

/// Upper bounds of the delay buckets, TTIs.
const DELAY_BUCKETS: [f64; 9] = [0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 16.0, 32.0];
/// Number of steps between the upper bounds of battery levels, which range from 0 to the largest E_max.
const BATTERY_STEPS: u64 = 10;

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RunLabels {
    run: String,
    policy: String,
    preset: String,
    seed: u64,
    devices: u32,
    version: String,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct KindLabels {
    plane: &'static str,
    kind: &'static str,
}

impl KindLabels {
    const fn new(kind: MessageKind) -> Self {
        Self {
            plane: kind.plane().name(),
            kind: kind.name(),
        }
    }
}

/// Label of a device state or, in `energy_spent_units`, of a purpose of spending.
#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct StateLabels {
    state: &'static str,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct CauseLabels {
    cause: &'static str,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
struct BucketLabels {
    at_most: String,
}

/// Labels of a host, as it states them; the texts can be empty.
#[derive(Clone, Debug, PartialEq, Eq, Hash, EncodeLabelSet)]
pub struct HostLabels {
    /// Number of the host.
    pub host: u32,
    /// Its process id.
    pub pid: String,
    /// Its machine or container.
    pub machine: String,
    /// Its address.
    pub address: String,
}

type FloatGauge = Gauge<f64, AtomicU64>;

/// Statistics of the processes of a run, as known to this process. All but the hosts count from its start and never
/// fall.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ProcessStats {
    /// Hosts that run devices and are not lost.
    pub hosts: u64,
    /// The hosts with devices, lost ones included until another host takes over, with their numbers of devices.
    pub host_devices: Vec<(HostLabels, u32)>,
    /// TTIs that began late under a real-time pace.
    pub late_ttis: u64,
    /// Largest delay of a TTI, seconds.
    pub max_late_s: f64,
    /// Time that the run has spent waiting until its recording caught up, seconds.
    pub recorder_waited_s: f64,
    /// Frames dropped for observers on the bus that were too slow.
    pub dropped_frames: u64,
}

/// Metrics of a run.
pub struct PrometheusMetrics {
    registry: Registry,
    handles: Handles,
    /// Whether the devices must be counted by state and battery after the next grant.
    is_count_requested: AtomicBool,
    /// Largest E_max in the run.
    e_max: Energy,
    /// Last process statistics, from which the counters' increments are computed.
    last_process_stats: Mutex<ProcessStats>,
}

/// Handles of the metrics in the registry. [`Self::register`] sets the exported names.
struct Handles {
    next_tti: Gauge,
    ttis: Counter,
    grants: Counter,
    events: Counter,
    missed_events: Family<CauseLabels, Counter>,
    information: Counter<f64, AtomicU64>,
    wrong_activations: Counter,
    messages: Family<KindLabels, Counter>,
    bytes: Family<KindLabels, Counter>,
    /// Message and byte counters of each kind, in the order of [`MessageKind::ALL`], for lookup by index.
    by_kind: Vec<(Counter, Counter)>,
    /// By purpose of spending.
    spent_energy: Family<StateLabels, Counter<f64, AtomicU64>>,
    harvested_energy: Counter<f64, AtomicU64>,
    devices_by_state: Family<StateLabels, Gauge>,
    /// Cumulative: devices with at most the battery level of the label.
    devices_by_battery: Family<BucketLabels, Gauge>,
    mean_battery: FloatGauge,
    hosts: Gauge,
    /// Only the present hosts, so takeovers do not add series without end.
    host_devices: Family<HostLabels, Gauge>,
    late_ttis: Counter,
    max_late: FloatGauge,
    recorder_waited: Counter<f64, AtomicU64>,
    dropped_messages: Counter,
    /// Delays of detected events, TTIs.
    event_delays: Histogram,
}

impl Handles {
    fn new() -> Self {
        let (messages, bytes) = (Family::default(), Family::default());
        // Every series exists from the start, so that Prometheus reads 0 before the first message of a kind.
        let by_kind = MessageKind::ALL.iter().map(|kind| {
            let labels = KindLabels::new(*kind);
            let counter = |family: &Family<KindLabels, Counter>| family.get_or_create(&labels).clone();
            (counter(&messages), counter(&bytes))
        });
        Self {
            by_kind: by_kind.collect(),
            messages: Family::clone(&messages),
            bytes: Family::clone(&bytes),
            event_delays: Histogram::new(DELAY_BUCKETS),
            next_tti: Gauge::default(),
            ttis: Counter::default(),
            grants: Counter::default(),
            events: Counter::default(),
            missed_events: Family::default(),
            information: Counter::default(),
            wrong_activations: Counter::default(),
            spent_energy: Family::default(),
            harvested_energy: Counter::default(),
            devices_by_state: Family::default(),
            devices_by_battery: Family::default(),
            mean_battery: Gauge::default(),
            hosts: Gauge::default(),
            host_devices: Family::default(),
            late_ttis: Counter::default(),
            max_late: Gauge::default(),
            recorder_waited: Counter::default(),
            dropped_messages: Counter::default(),
        }
    }

    fn register(&self, registry: &mut Registry) {
        registry.register("next_tti", "The next TTI to be granted", self.next_tti.clone());
        registry.register("ttis", "TTIs that were run", self.ttis.clone());
        registry.register("grants", "Grants of the virtual clock", self.grants.clone());
        registry.register("events", "Counted events that have ended", self.events.clone());
        registry.register(
            "events_missed",
            "Counted events that ended without a report, by cause",
            self.missed_events.clone(),
        );
        registry.register(
            "information",
            "Information of counted events at the base station",
            self.information.clone(),
        );
        registry.register(
            "wrong_activations",
            "Wrong activations for counted events",
            self.wrong_activations.clone(),
        );
        registry.register("messages", "Messages by plane and kind", self.messages.clone());
        registry.register(
            "message_bytes",
            "Bytes of messages, as encoded, by plane and kind",
            self.bytes.clone(),
        );
        registry.register(
            "energy_spent_units",
            "Energy spent by devices, by purpose, up to the last window",
            self.spent_energy.clone(),
        );
        registry.register(
            "energy_harvested_units",
            "Energy harvested by devices, up to the last window",
            self.harvested_energy.clone(),
        );
        registry.register("devices", "Devices by state", self.devices_by_state.clone());
        registry.register(
            "devices_with_battery",
            "Devices with at most this many units",
            self.devices_by_battery.clone(),
        );
        registry.register("battery_mean_units", "Mean battery level", self.mean_battery.clone());
        registry.register("hosts_alive", "Hosts that are not lost", self.hosts.clone());
        registry.register(
            "host_devices",
            "Devices of each host, by its process, machine and address",
            self.host_devices.clone(),
        );
        registry.register(
            "late_ttis",
            "TTIs that began late under a real-time pace",
            self.late_ttis.clone(),
        );
        registry.register("late_max_seconds", "The largest delay of a TTI", self.max_late.clone());
        registry.register(
            "recorder_waited_seconds",
            "Time that its recording has delayed the run",
            self.recorder_waited.clone(),
        );
        registry.register(
            "observer_messages_left_out",
            "Messages that were dropped because an observer on the bus was too slow",
            self.dropped_messages.clone(),
        );
        registry.register(
            "event_delay_ttis",
            "TTIs from the start of a counted event to its first report",
            self.event_delays.clone(),
        );
    }
}

impl PrometheusMetrics {
    /// Creates the metrics of `scenario` under the run name `run`, before TTI 0.
    pub fn new(run: &str, scenario: &Scenario) -> Arc<Self> {
        let mut registry = Registry::with_prefix("reveille");
        let handles = Handles::new();
        handles.register(&mut registry);
        let run_info: Family<RunLabels, Gauge> = Family::default();
        let labels = RunLabels {
            run: run.to_owned(),
            policy: scenario.policy.name().to_owned(),
            preset: scenario.run.preset.clone(),
            seed: scenario.run.seed,
            devices: scenario.run.devices,
            version: env!("CARGO_PKG_VERSION").to_owned(),
        };
        run_info.get_or_create(&labels).set(1);
        registry.register("run_info", "Description of the run by labels, always 1", run_info);
        let length: Gauge = Gauge::default();
        length.set(scenario.run.ttis.cast_signed());
        registry.register("run_length_ttis", "Length of the run", length);
        let e_max = scenario.classes.iter().map(|class| class.energy.e_max).max();
        let metrics = Self {
            registry,
            handles,
            is_count_requested: AtomicBool::new(true),
            e_max: e_max.unwrap_or(Energy::ZERO),
            last_process_stats: Mutex::default(),
        };
        metrics.create_series();
        Arc::new(metrics)
    }

    /// Creates every series, so that Prometheus reads 0 before the first occurrence.
    fn create_series(&self) {
        for state in ["sensing", "sleep", "report"] {
            drop(self.handles.spent_energy.get_or_create(&StateLabels { state }));
        }
        for cause in MissCause::ALL {
            drop(self.missed_events(cause));
        }
        // `update_devices` clears the request, but the first states are wanted before any request.
        self.update_devices(&[]);
        self.request_device_count();
    }

    /// Counts a frame.
    pub fn count_frame(&self, frame: &Frame) {
        // `ALL` lists the kinds in the order of declaration, so the discriminant is the index.
        let (messages, bytes) = &self.handles.by_kind[frame.kind as usize];
        messages.inc();
        bytes.inc_by(frame.payload.len() as u64);
        if frame.kind == MessageKind::World
            && let Ok(Message::World(world)) = frame.message()
        {
            self.handles.grants.inc();
            self.handles.ttis.inc_by(world.last - world.first + 1);
            self.handles.next_tti.set((world.last + 1).0.cast_signed());
        }
        if frame.kind == MessageKind::Event
            && let Ok(Message::Event(EventUpdate::Ended(record))) = frame.message()
            && record.counted
        {
            self.handles.events.inc();
            self.handles.information.inc_by(record.tally.information());
            self.handles.wrong_activations.inc_by(record.tally.wrong_activations);
            if let Some(delay) = record.delay() {
                self.handles.event_delays.observe(delay as f64);
            }
            // Every missed event has a cause.
            if let Some(cause) = record.miss_cause {
                self.missed_events(cause).inc();
            }
        }
    }

    /// The counter of missed events with this cause.
    fn missed_events(&self, cause: MissCause) -> impl Deref<Target = Counter> {
        let cause = cause.name();
        self.handles.missed_events.get_or_create(&CauseLabels { cause })
    }

    /// Requests a count of the devices by state and battery after the next grant. See [`Self::is_count_pending`].
    pub fn request_device_count(&self) {
        self.is_count_requested.store(true, Ordering::Relaxed);
    }

    /// Whether a requested count is pending. It stays so until the clock grants a TTI.
    pub fn is_count_pending(&self) -> bool {
        self.is_count_requested.load(Ordering::Relaxed)
    }

    /// Encodes the metrics with the process statistics `process`: in the OpenMetrics format if `is_openmetrics`,
    /// otherwise in the older Prometheus text format.
    pub fn encode(&self, process: ProcessStats, is_openmetrics: bool) -> String {
        // Held to the end; otherwise two parallel requests would count increments twice, or miss hosts.
        let mut before = self.last_process_stats.lock().unwrap_or_else(PoisonError::into_inner);
        let handles = &self.handles;
        handles.hosts.set(process.hosts.cast_signed());
        handles.host_devices.clear();
        for (labels, devices) in &process.host_devices {
            handles.host_devices.get_or_create(labels).set(i64::from(*devices));
        }
        handles.max_late.set(process.max_late_s);
        handles
            .late_ttis
            .inc_by(process.late_ttis.saturating_sub(before.late_ttis));
        handles
            .dropped_messages
            .inc_by(process.dropped_frames.saturating_sub(before.dropped_frames));
        handles
            .recorder_waited
            .inc_by((process.recorder_waited_s - before.recorder_waited_s).max(0.0));
        *before = process;
        let mut text = String::new();
        encode(&mut text, &self.registry).expect("a text takes everything");
        drop(before);
        if is_openmetrics {
            text
        } else {
            to_prometheus_text(&text)
        }
    }

    fn update_devices(&self, views: &[DeviceView]) {
        self.is_count_requested.store(false, Ordering::Relaxed);
        let labels = |state| StateLabels { state };
        let states = [
            // Devices leave S2 within the TTI in which they enter it, so no view shows S2.
            ("S1", DeviceState::Idle),
            ("S3", DeviceState::Transmission),
            ("S4", DeviceState::Sleep { powered: true }),
            ("S4 unpowered", DeviceState::Sleep { powered: false }),
            ("failed", DeviceState::Failed),
        ];
        for (name, state) in states {
            let count = views.iter().filter(|view| view.state == state).count() as u64;
            self.handles
                .devices_by_state
                .get_or_create(&labels(name))
                .set(count.cast_signed());
        }
        for step in 0..=BATTERY_STEPS {
            let upper_bound = Energy::from_micro(self.e_max.micro() * step / BATTERY_STEPS);
            let count = views.iter().filter(|view| view.battery <= upper_bound).count() as u64;
            let at_most = upper_bound.units().to_string();
            self.handles
                .devices_by_battery
                .get_or_create(&BucketLabels { at_most })
                .set(count.cast_signed());
        }
        // `sum` gives -0 for an empty sequence, which would be exported with its sign.
        let sum = views.iter().fold(0.0, |sum, view| sum + view.battery.units());
        self.handles.mean_battery.set(sum / views.len().max(1) as f64);
    }

    fn add_energy(&self, window: &WindowRecord) {
        let EnergyByState { sensing, sleep, report } = window.energy.spent;
        for (state, energy) in [("sensing", sensing), ("sleep", sleep), ("report", report)] {
            self.handles
                .spent_energy
                .get_or_create(&StateLabels { state })
                .inc_by(energy.units());
        }
        self.handles.harvested_energy.inc_by(window.energy.harvested.units());
    }
}

/// Observer that updates the metrics.
#[derive(Clone)]
pub struct MetricsObserver(pub Arc<PrometheusMetrics>);

impl Observer for MetricsObserver {
    fn notify(&mut self, notification: &Notification<'_>) {
        if let Notification::DeviceStates(views) = notification {
            self.0.update_devices(views);
        }
    }

    fn states_due(&self) -> Tti {
        if self.0.is_count_pending() {
            Tti::ZERO
        } else {
            Tti::NEVER
        }
    }

    fn window_closed(&mut self, window: &WindowRecord) -> bool {
        self.0.add_energy(window);
        true
    }
}

/// Converts OpenMetrics to the older Prometheus text format: counter names keep their suffix in descriptions, and the
/// end mark is missing.
fn to_prometheus_text(openmetrics: &str) -> String {
    let counters: Vec<&str> = openmetrics
        .lines()
        .filter_map(|line| line.strip_prefix("# TYPE ")?.strip_suffix(" counter"))
        .collect();
    let line = |line: &str| {
        // At most four parts: a description contains spaces.
        let mut parts = line.splitn(4, ' ');
        match (parts.next(), parts.next(), parts.next(), parts.next()) {
            (Some("#"), Some("EOF" | "UNIT"), ..) => String::new(),
            (Some("#"), Some(keyword), Some(name), Some(text)) if counters.contains(&name) => {
                format!("# {keyword} {name}_total {text}\n")
            }
            _ => format!("{line}\n"),
        }
    };
    openmetrics.lines().map(line).collect()
}

#[cfg(test)]
mod tests {
    use reveille_bs::observer::frames::FrameObserver;
    use reveille_bs::scenario::{Override, load};
    use reveille_lab::preparation::prepare;
    use reveille_lab::run::{Run, RunOptions};

    use super::*;

    fn test_scenario() -> Scenario {
        let fields = ["devices=30", "ttis=500", "policy.name=knn", "events.alpha=0.4"];
        let overrides = fields.map(|field| Override::parse(field).expect("an override"));
        load("paper", &overrides).expect("a scenario").scenario
    }

    /// Returns the labels of a host, and its number of devices.
    fn host(host: u32, devices: u32) -> (HostLabels, u32) {
        let labels = HostLabels {
            host,
            pid: "8".to_owned(),
            machine: format!("m{host}"),
            address: String::new(),
        };
        (labels, devices)
    }

    /// Returns a table of the name, type and help of every metric, as in docs/monitoring.md.
    fn metrics_table(text: &str) -> String {
        let row = |line: &str| {
            let (name, help) = line.strip_prefix("# HELP ")?.split_once(' ')?;
            let prefix = format!("# TYPE {name} ");
            let kind = text
                .lines()
                .find_map(|line| line.strip_prefix(&prefix))
                .expect("a type");
            Some(format!("| `{name}` | {kind} | {help} |\n"))
        };
        let rows: String = text.lines().filter_map(row).collect();
        format!("| name | type | meaning |\n|---|---|---|\n{rows}")
    }

    #[test]
    fn the_monitoring_page_lists_every_metric() {
        // A metric of hosts needs a host to be shown.
        let process = ProcessStats {
            host_devices: vec![host(0, 30)],
            ..ProcessStats::default()
        };
        let text = PrometheusMetrics::new("r", &test_scenario()).encode(process, false);
        let table = metrics_table(&text);
        let page = include_str!("../../docs/monitoring.md");
        assert!(
            page.contains(&format!("<!-- metrics -->\n{table}<!-- /metrics -->")),
            "update the table in docs/monitoring.md:\n{table}"
        );
    }

    #[test]
    fn metrics_equal_the_totals_of_the_run() {
        let scenario = test_scenario();
        let metrics = PrometheusMetrics::new("r", &scenario);
        let frame_metrics = Arc::clone(&metrics);
        let mut observers = (
            FrameObserver::new(0, move |frame| frame_metrics.count_frame(&frame)),
            MetricsObserver(Arc::clone(&metrics)),
        );
        let options = RunOptions {
            window: 100,
            ..RunOptions::default()
        };
        let outcome = Run::new(&prepare(&scenario), options).finish(&mut observers);
        let process = ProcessStats {
            hosts: 3,
            host_devices: vec![host(0, 10), host(2, 20)],
            dropped_frames: 7,
            ..ProcessStats::default()
        };
        let text = metrics.encode(process.clone(), false);
        let value = |name: &str| -> f64 {
            let line = text
                .lines()
                .find_map(|line| line.strip_prefix(name))
                .unwrap_or_else(|| panic!("{name}: {text}"));
            line.trim().parse().expect("a number")
        };
        let assert_close = |metric: f64, expected: f64| {
            let is_close = (metric - expected).abs() <= 1e-6 * expected.abs().max(1.0);
            assert!(is_close, "metric {metric}, expected {expected}");
        };
        let events = outcome.totals.events;
        assert_close(value("reveille_events_total "), events.events as f64);
        let missed_by = |cause| format!("reveille_events_missed_total{{cause=\"{cause}\"}} ");
        let missed: Vec<f64> = MissCause::ALL.map(|cause| value(&missed_by(cause.name()))).to_vec();
        assert_close(missed.iter().sum(), events.misdetected as f64);
        for (cause, metric) in MissCause::ALL.into_iter().zip(missed) {
            assert_close(metric, outcome.totals.missed.by_cause(cause) as f64);
        }
        assert_close(value("reveille_event_delay_ttis_sum "), events.delay_ttis as f64);
        assert_close(
            value("reveille_information_total "),
            events.information_pico as f64 / 1e12,
        );
        assert_close(value("reveille_ttis_total "), 500.0);
        assert_close(value("reveille_next_tti "), 500.0);
        assert_close(value("reveille_hosts_alive "), 3.0);
        assert_close(value("reveille_observer_messages_left_out_total "), 7.0);
        let devices_in = |state: &str| value(&format!("reveille_devices{{state=\"{state}\"}} "));
        assert_close(["S1", "S3", "S4", "S4 unpowered"].map(devices_in).iter().sum(), 30.0);
        let spent: EnergyByState = outcome
            .devices
            .iter()
            .map(|device| device.ledger.whole.spent)
            .fold(EnergyByState::default(), |a, b| a + b);
        let energy_spent_in = |state: &str| value(&format!("reveille_energy_spent_units_total{{state=\"{state}\"}} "));
        assert_close(energy_spent_in("sensing"), spent.sensing.units());
        assert_close(energy_spent_in("report"), spent.report.units());
        let host_series =
            |number| format!("reveille_host_devices{{host=\"{number}\",pid=\"8\",machine=\"m{number}\",address=\"\"}}");
        assert_close(value(&host_series(0)), 10.0);
        assert_close(value(&host_series(2)), 20.0);
        // A second request does not count an increment again, and shows no host that has been replaced.
        let process = ProcessStats {
            host_devices: vec![host(1, 10), host(2, 20)],
            ..process
        };
        let second_request = metrics.encode(process.clone(), false);
        assert!(
            second_request.contains(&host_series(1)) && !second_request.contains(&host_series(0)),
            "{second_request}"
        );
        assert!(
            second_request.contains("reveille_observer_messages_left_out_total 7\n"),
            "{second_request}"
        );
        let open_metrics = metrics.encode(process, true);
        assert!(
            open_metrics.ends_with("# EOF\n") && open_metrics.contains("# TYPE reveille_ttis counter\n"),
            "{open_metrics}"
        );
    }
}
