//! Random small scenarios as TOML text, which the emulator loads like any scenario file, and the preset `paper` with
//! given fields. After a change of a range or weight here, `random_scenarios_cover_every_case` in
//! `tests/tests/reference.rs` must pass: it checks how often [`small`] and [`crowded`] cover each case.
//! `tests/tests/analysis.rs` and `ledger.rs` rely on limits that the functions here state.

use std::fmt::Write as _;
use std::path::Path;

use proptest::prelude::*;
use reveille_bs::scenario::{Loaded, Override, Scenario, load, parse};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::{Change, DeviceRange, OperatorAction, Setting};
use reveille_common::rng::{Purpose, Stream};
use reveille_common::units::Energy;

/// Folder of the files that random scenarios name. `energy.csv` holds units per TTI. `points.csv` is a layout within
/// the smallest random area (4 m × 4 m) and has two devices at the same place; it has a point for each of the at most
/// 12 devices. `tests/tests/closed_forms.rs` repeats the values of `energy.csv`.
const FILES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/data");

/// Parses overrides of the form `field=value`.
///
/// # Panics
/// If one of them is not an override.
pub fn overrides(fields: &[&str]) -> Vec<Override> {
    let parsed = fields.iter().map(|field| Override::parse(field));
    parsed.map(|result| result.expect("an override")).collect()
}

/// Loads the preset `paper` with `fields` overridden, each of the form `field=value`.
///
/// # Panics
/// If a field or a value is invalid.
pub fn paper(fields: &[&str]) -> Scenario {
    let loaded = load("paper", &overrides(fields));
    loaded.unwrap_or_else(|error| panic!("{fields:?}: {error}")).scenario
}

/// Parses a scenario from `text`, which may name files of this package's `data` folder.
///
/// # Panics
/// If `text` is not a valid scenario.
pub fn scenario(text: &str) -> Scenario {
    scenario_with_warnings(text).scenario
}

/// Parses a scenario like [`scenario`] and returns it with its warnings.
///
/// # Panics
/// If `text` is not a valid scenario.
pub fn scenario_with_warnings(text: &str) -> Loaded {
    parse(text, "test", Path::new(FILES), &[]).unwrap_or_else(|error| panic!("{error}\n{text}"))
}

/// Draws a script of 1 to 12 actions that `scenario` allows, in the order of TTIs. An action takes over the TTI of the
/// action drawn before it with probability 0.3. The price is set only under `age-index`.
pub fn draw_actions(scenario: &Scenario, seed: u64) -> Vec<OperatorAction> {
    // Only training and tests draw from this stream, no run does.
    let mut stream = Stream::new(seed, Purpose::Training, 0);
    let ttis = scenario.run.ttis;
    let mut actions: Vec<OperatorAction> = Vec::new();
    for _ in 0..=stream.below(12) {
        let shared_tti = actions
            .last()
            .filter(|_| stream.unit() < 0.3)
            .map(|action| action.tti.0);
        let tti = Tti(shared_tti.unwrap_or_else(|| stream.below(ttis)));
        let first_device = stream.below(u64::from(scenario.run.devices)) as u32;
        let range = DeviceRange {
            first: DeviceId(first_device),
            count: 1 + stream.below(u64::from(scenario.run.devices - first_device)) as u32,
        };
        let change = match stream.below(8) {
            0..=2 => Change::Fail(range),
            3..=4 => Change::Revive(range),
            5 if scenario.events.has_constant_rate() => Change::Set(Setting::EventRate, 1.0 - stream.unit()),
            6 if scenario.policy.name() == "age-index" => Change::Set(Setting::Price, 2.0 * stream.unit()),
            _ => Change::AddEnergy(range, Energy::from_micro(1 + stream.below(40_000_000))),
        };
        actions.push(OperatorAction { tti, change });
    }
    actions.sort_by_key(|action| action.tti);
    actions
}

/// Generates a small scenario with a policy that [`simulate`](crate::reference::simulate) runs. It has at most 12
/// devices and 200 TTIs.
pub fn small() -> impl Strategy<Value = String> {
    let sections = (
        run_fields(),
        deployment_sections(),
        event_sections(),
        radio_section(),
        policy_sections(),
        energy_and_harvest_sections(),
    );
    sections.prop_map(|(run, deployment, events, radio, policy, energy)| {
        format!("{run}{deployment}{events}{radio}{policy}{energy}")
    })
}

/// Generates a small scenario with the policy `name` and a perfect radio. Only `knn` and `adjusted` have drawn
/// settings; a caller can append the section of another policy.
pub fn small_with_policy(name: &'static str) -> impl Strategy<Value = String> {
    (
        run_fields(),
        deployment_sections(),
        event_sections(),
        policy_sections(),
        energy_and_harvest_sections(),
    )
        .prop_map(move |(run, deployment, events, policy, energy)| {
            // The first two lines are `[policy]` and the drawn name, which is not used.
            let settings = policy.splitn(3, '\n').nth(2).unwrap_or_default();
            format!("{run}{deployment}{events}[policy]\nname = \"{name}\"\n{settings}{energy}")
        })
}

/// Generates a small scenario with a policy of [`small`], or with `q-learning`, which
/// [`simulate`](crate::reference::simulate) does not run.
pub fn small_or_q_learning() -> impl Strategy<Value = String> {
    prop_oneof![3 => small().boxed(), 1 => with_q_learning().boxed()]
}

/// Generates a small scenario with a perfect radio and so much energy that no device ever lacks it: with the default
/// costs a device spends at most 11 units in a TTI, so 10 000 units last for the at most 200 TTIs.
pub fn with_ample_energy() -> impl Strategy<Value = String> {
    (run_fields(), deployment_sections(), event_sections(), policy_sections()).prop_map(
        |(run, deployment, events, policy)| {
            format!("{run}{deployment}{events}{policy}[energy]\ne_max = 10000.0\ninitial = 10000.0\n")
        },
    )
}

/// Generates a scenario in which `knn` often wakes several devices: they are close together and most can answer. The
/// radio is perfect. It shares no section with [`small`] and can have up to 30 devices.
pub fn crowded() -> impl Strategy<Value = String> {
    let size = (6..=30u32, 1..=80u64, any_seed());
    let metres_and_eta = (4.0..9.0f64, 4.0..9.0f64, 1.2..3.5f64, 0.2..1.2f64);
    let layout = prop_oneof![Just("uniform"), Just("jittered-grid"), Just("poisson-disk")];
    let fusion = prop_oneof![3 => Just("max"), 1 => Just("sum-saturation")];
    let knn = (1..=6u32, any::<bool>());
    let initial = prop_oneof![Just(2.0), Just(50.0), Just(1000.0)];
    (size, metres_and_eta, layout, fusion, knn, initial).prop_map(
        |((devices, ttis, seed), (width, height, d_max, eta), layout, fusion, (neighbours, limit_radius), initial)| {
            format!(
                "devices = {devices}\nttis = {ttis}\nseed = {seed}\n[area]\nwidth = {width:?}\nheight = {height:?}\n\
                 [layout]\nkind = \"{layout}\"\n[sensing]\nd_max = {d_max:?}\neta = {eta:?}\ng = \"{fusion}\"\n\
                 [events]\nalpha = 0.6\n[policy]\nname = \"knn\"\n[policy.knn]\nneighbours = {neighbours}\n\
                 limit_radius = {limit_radius}\n[energy]\ne_max = 1000.0\ninitial = {initial:?}\n[harvest]\ne_b = 9.0\n"
            )
        },
    )
}

/// Generates a seed of 63 bits, since numbers in TOML are signed.
fn any_seed() -> impl Strategy<Value = u64> {
    any::<u64>().prop_map(|bits| bits >> 1)
}

/// Generates the fields of the run and the section `[bs]`, which [`with_q_learning`] extends. `points.csv` and
/// `tests/tests/ledger.rs` rely on at most 12 devices, [`with_ample_energy`] on at most 200 TTIs.
fn run_fields() -> impl Strategy<Value = String> {
    let warm_up = prop_oneof![Just(0.0), 0.0..0.5f64];
    let tau = prop_oneof![4 => Just(1.0), 1 => 0.25..2.0f64];
    (1..=12u32, 1..=200u64, any_seed(), warm_up, tau, 1..=60u64).prop_map(
        |(devices, ttis, seed, warm_up, tau, sync_interval)| {
            format!(
                "devices = {devices}\nttis = {ttis}\nseed = {seed}\nwarm_up = {warm_up:?}\ntau = {tau:?}\n\
                 [bs]\nsync_interval = {sync_interval}\n"
            )
        },
    )
}

/// Generates the sections `[area]`, `[layout]` and `[sensing]`.
fn deployment_sections() -> impl Strategy<Value = String> {
    let layout = prop_oneof![
        Just("kind = \"uniform\""),
        Just("kind = \"jittered-grid\""),
        Just("kind = \"poisson-disk\""),
        Just("kind = \"grid\""),
        Just("kind = \"hex\""),
        Just("kind = \"file\"\nfile = \"points.csv\""),
    ];
    let sensing_kind = prop_oneof![Just("range"), Just("probabilistic")];
    let fusion = prop_oneof![Just("max"), Just("sum-saturation")];
    let psi = prop_oneof![2 => Just(1.0), 1 => 0.2..3.0f64];
    (
        layout,
        sensing_kind,
        fusion,
        psi,
        4.0..15.0f64,
        4.0..15.0f64,
        1.0..5.6f64,
        0.1..1.5f64,
    )
        .prop_map(|(layout, sensing_kind, fusion, psi, width, height, d_max, eta)| {
            format!(
                "[area]\nwidth = {width:?}\nheight = {height:?}\n[layout]\n{layout}\n[sensing]\n\
                 kind = \"{sensing_kind}\"\ng = \"{fusion}\"\npsi = {psi:?}\nd_max = {d_max:?}\neta = {eta:?}\n"
            )
        })
}

/// Generates the section `[events]` and the section of its process.
fn event_sections() -> impl Strategy<Value = String> {
    let alpha = prop_oneof![1 => Just(1.0), 4 => 0.02..0.9f64];
    let duration_kind = prop_oneof![Just("fixed"), Just("geometric")];
    (alpha, 1..=6u64, duration_kind, event_process()).prop_map(|(alpha, duration, duration_kind, (process, fields))| {
        format!(
            "[events]\nprocess = \"{process}\"\nalpha = {alpha:?}\nduration = {duration}\n\
             duration_kind = \"{duration_kind}\"\n[events.{process}]\n{fields}"
        )
        // This process has no fields.
        .replace("[events.uniform]\n", "")
    })
}

/// Generates the name of an event process and its fields.
fn event_process() -> impl Strategy<Value = (&'static str, String)> {
    let share = || prop_oneof![1 => Just(0.0), 1 => Just(1.0), 3 => 0.1..0.9f64];
    let metres = |max: f64| prop_oneof![1 => Just(0.0), 4 => 0.1..max, 1 => Just(max)];
    let hot_spots = (1..=4u32, share(), metres(2.0)).prop_map(|(places, share, sigma)| {
        let fields = format!("places = {places}\nshare = {share:?}\nsigma = {sigma:?}\n");
        ("hot-spots", fields)
    });
    let radius = prop_oneof![4 => metres(6.0), 1 => Just(1e6)];
    let aftershocks = (share(), radius).prop_map(|(probability, radius)| {
        let fields = format!("probability = {probability:?}\nradius = {radius:?}\n");
        ("aftershocks", fields)
    });
    let busy_alpha = prop_oneof![1 => Just(1.0), 3 => 0.3..0.95f64];
    let quiet_alpha = prop_oneof![1 => Just(0.0), 3 => 0.01..0.3f64, 1 => Just(1.0)];
    let bursts = (busy_alpha, quiet_alpha, mean_phase_ttis(), mean_phase_ttis()).prop_map(
        |(busy_alpha, quiet_alpha, busy_ttis, quiet_ttis)| {
            let fields = format!(
                "busy_alpha = {busy_alpha:?}\nquiet_alpha = {quiet_alpha:?}\nbusy_ttis = {busy_ttis:?}\n\
                 quiet_ttis = {quiet_ttis:?}\n"
            );
            ("bursts", fields)
        },
    );
    let uniform = Just(("uniform", String::new()));
    prop_oneof![uniform, hot_spots, aftershocks, bursts]
}

/// Generates the mean length of a phase of events or interference, TTIs.
fn mean_phase_ttis() -> impl Strategy<Value = f64> {
    prop_oneof![1 => Just(1.0), 4 => 1.0..25.0f64]
}

/// Generates a section `[radio]`; about half of the radios never fail, the others fail in some ways.
fn radio_section() -> impl Strategy<Value = String> {
    let probability = || prop_oneof![3 => Just(0.0), 3 => 0.0..0.5f64, 1 => Just(1.0)];
    let burst_loss = prop_oneof![Just(1.0), 0.0..1.0f64];
    let bursts = proptest::option::weighted(0.3, (mean_phase_ttis(), mean_phase_ttis(), burst_loss));
    let failing = (
        probability(),
        probability(),
        probability(),
        probability(),
        bursts,
        0..4u32,
    ).prop_map(
        |(wake_miss, false_wake_up, uplink_loss, plan_loss, bursts, wake_latency)| {
            let bursts = bursts.map_or_else(String::new, |(burst_ttis, quiet_ttis, loss)| {
                format!(
                    "interference = \"bursts\"\n[radio.bursts]\nburst_ttis = {burst_ttis:?}\n\
                     quiet_ttis = {quiet_ttis:?}\nloss = {loss:?}\n"
                )
            });
            format!(
                "[radio]\nwake_miss = {wake_miss:?}\nfalse_wake_up = {false_wake_up:?}\nuplink_loss = {uplink_loss:?}\n\
                 plan_loss = {plan_loss:?}\nwake_latency = {wake_latency}\n{bursts}"
            )
        },
    );
    prop_oneof![Just(String::new()), failing]
}

/// Generates the sections of the policy. [`small_with_policy`] relies on the first two lines, and
/// `tests/tests/ledger.rs` on cycles of at most 9 TTIs. `random` keeps its default cycles, which
/// [`ReferencePolicy::new`](crate::reference::ReferencePolicy::new) repeats.
fn policy_sections() -> impl Strategy<Value = String> {
    let name = prop_oneof![2 => Just("knn"), 1 => Just("random"), 1 => Just("genie"), 2 => Just("adjusted")];
    let t_drx = proptest::collection::vec(1..=9u32, 1..=2);
    (name, 1..=6u32, any::<bool>(), t_drx).prop_map(|(name, neighbours, limit_radius, t_drx)| {
        format!(
            "[policy]\nname = \"{name}\"\n[policy.knn]\nneighbours = {neighbours}\nlimit_radius = {limit_radius}\n\
             [policy.adjusted]\nt_on = [1, 3]\nt_drx = {t_drx:?}\npilot_ttis = 40\n\
             pilot_events = 4\npilot_limit = 150\n"
        )
    })
}

/// Generates a small scenario with `q-learning` and optimistic initial values.
fn with_q_learning() -> impl Strategy<Value = String> {
    let ranking = prop_oneof![Just("p42"), Just("posterior")];
    let knowledge = prop_oneof![Just("oracle"), Just("reported")];
    let settings = (ranking, knowledge, 1..=6u32, 0.0..60.0f64);
    (
        run_fields(),
        deployment_sections(),
        event_sections(),
        energy_and_harvest_sections(),
        settings,
    )
        .prop_map(|(run, deployment, events, energy, (ranking, knowledge, window, mu1))| {
            let bs = format!("[bs]\nranking = \"{ranking}\"\nbattery_knowledge = \"{knowledge}\"\n");
            let run = run.replace("[bs]\n", &bs);
            format!(
                "{run}{deployment}{events}[policy]\nname = \"q-learning\"\n[policy.q-learning]\ntable = \"nothing\"\n\
                 learn = true\nwindow = {window}\nmu1 = {mu1:?}\nepsilon = 0.2\n{energy}"
            )
        })
}

/// Generates the energy and harvest sections: the defaults, and up to three classes that override some of them. Without
/// a class all devices use the defaults.
fn energy_and_harvest_sections() -> impl Strategy<Value = String> {
    let class = (
        0.1..1.0f64,
        proptest::option::of(energy_fields()),
        proptest::option::of(harvest_section()),
    );
    let classes = proptest::collection::vec(class, 0..=3);
    // A class inherits the fields that it omits, and `column` excludes `columns`: all classes use the same one.
    (energy_fields(), harvest_section(), any::<bool>(), classes).prop_map(
        |(energy, harvest, shares_column, classes)| {
            let mut text = format!("[energy]\n{energy}{}", harvest.text("harvest", shares_column));
            let total_weight: f64 = classes.iter().map(|(weight, ..)| weight).sum();
            for (i, (weight, energy, harvest)) in classes.into_iter().enumerate() {
                let share = weight / total_weight;
                writeln!(text, "[[class]]\nname = \"c{i}\"\nshare = {share:?}").expect("a String can be written");
                if let Some(energy) = energy {
                    write!(text, "[class.energy]\n{energy}").expect("a String can be written");
                }
                if let Some(harvest) = harvest {
                    text.push_str(&harvest.text("class.harvest", shares_column));
                }
            }
            text
        },
    )
}

/// Generates the fields of `[energy]`, as shares of `E_max` from 0 to 1: loading refuses costs and initial levels above
/// `E_max`. Their micro-units rarely divide one another.
fn energy_fields() -> impl Strategy<Value = String> {
    let e_max = prop_oneof![Just(100.0), 0.5..30.0f64, Just(0.000_001)];
    let cost_per_tti = || prop_oneof![1 => Just(0.0), 3 => 0.0..0.05f64, 1 => 0.0..=1.0f64];
    let report_cost = prop_oneof![1 => Just(0.0), 4 => 0.02..0.4f64, 1 => 0.0..=1.0f64, 1 => Just(1.0)];
    let initial = prop_oneof![1 => Just(0.0), 2 => 0.0..=1.0f64, 1 => Just(1.0)];
    (e_max, cost_per_tti(), cost_per_tti(), report_cost, initial).prop_map(|(e_max, e_idle, e_wur, e_tx, initial)| {
        // Shares round down and E_max rounds up, so that no share exceeds E_max.
        let [e_idle, e_wur, e_tx, initial] =
            [e_idle, e_wur, e_tx, initial].map(|share| (share * e_max * 1e6).floor() / 1e6);
        let e_max = (e_max * 1e6).ceil() / 1e6;
        format!("e_max = {e_max:?}\ne_idle = {e_idle:?}\ne_wur = {e_wur:?}\ne_tx = {e_tx:?}\ninitial = {initial:?}\n")
    })
}

/// Parts of a `[harvest]` section, of the run or of a class.
#[derive(Clone, Debug)]
struct HarvestSection {
    /// Fields outside `[harvest.trace]`.
    source: String,
    /// Fields of `[harvest.trace]` without the column; `None` for other kinds than `trace`.
    trace: Option<String>,
    /// Line `column = …`, for all devices.
    column: &'static str,
    /// Line `columns = …`, of which each device gets one column.
    columns: &'static str,
}

impl HarvestSection {
    /// Returns the section `section`, such as `class.harvest`, with `column` if `shares_column`, or else `columns`.
    fn text(&self, section: &str, shares_column: bool) -> String {
        let column_line = if shares_column { self.column } else { self.columns };
        let trace_section = match &self.trace {
            Some(fields) => format!("[{section}.trace]\n{fields}{column_line}\n"),
            None => String::new(),
        };
        format!("[{section}]\n{}{trace_section}", self.source)
    }
}

/// Generates a harvest section that loads: the arrival probability of a day is at most 1.
fn harvest_section() -> impl Strategy<Value = HarvestSection> {
    let kind = prop_oneof![
        3 => Just("eq5"),
        1 => Just("exp-minus-lambda"),
        2 => Just("mpp"),
        2 => Just("diurnal"),
        2 => Just("trace"),
    ];
    let column = prop_oneof![Just("column = \"sun\""), Just("column = \"rain\"")];
    let columns = prop_oneof![
        Just("columns = [\"sun\", \"wind\", \"rain\"]"),
        Just("columns = [\"wind\", \"rain\"]"),
    ];
    let e_b = prop_oneof![1 => Just(0.0), 4 => 0.0..8.0f64, 1 => 0.0..60.0f64];
    let end = prop_oneof![Just("cycle"), Just("stop")];
    let off_mean = proptest::option::of(0.1..20.0f64);
    let trace = (1..=4u64, end, 0.0..2.0f64, 0..3u64);
    let day = diurnal_fields();
    (kind, column, columns, e_b, 0.02..3.0f64, off_mean, trace, day).prop_map(
        |(
            kind,
            column,
            columns,
            e_b,
            lambda,
            off_mean,
            (ttis_per_row, end, scale, start),
            (diurnal, is_daily_mean),
        )| {
            // Noon is far above the daily mean; its arrival probability must not exceed 1.
            let lambda = if kind == "diurnal" && is_daily_mean {
                lambda / 30.0
            } else {
                lambda
            };
            let mut source = format!("kind = \"{kind}\"\n");
            if kind != "trace" {
                writeln!(source, "lambda = {lambda:?}\ne_b = {e_b:?}").expect("a String can be written");
            }
            if kind == "diurnal" {
                source.push_str(&diurnal);
            }
            if let Some(off_mean) = off_mean.filter(|_| kind == "mpp") {
                writeln!(source, "off_mean = {off_mean:?}").expect("a String can be written");
            }
            let trace = (kind == "trace").then(|| {
                format!(
                    "file = \"energy.csv\"\nttis_per_row = {ttis_per_row}\nend = \"{end}\"\nscale = {scale:?}\n\
                     start = {start}\n"
                )
            });
            HarvestSection {
                source,
                trace,
                column,
                columns,
            }
        },
    )
}

/// Generates the fields `diurnal.*` for a day of at most 60 TTIs, and whether λ refers to the daily mean.
fn diurnal_fields() -> impl Strategy<Value = (String, bool)> {
    let sky = prop_oneof![Just("vacuum"), Just("clear")];
    let known = prop_oneof![3 => Just("course"), 1 => Just("mean")];
    let latitude = prop_oneof![4 => -45.0..45.0f64, 1 => -90.0..90.0f64];
    (latitude, 1..=365u32, 0.0..24.0f64, 2..=60u32, sky, known, any::<bool>()).prop_map(
        |(latitude, day_of_year, start_hour, ttis_per_day, sky, known, is_daily_mean)| {
            // In short or polar days, noon is even farther above the daily mean.
            let is_daily_mean = is_daily_mean && latitude.abs() < 45.0 && ttis_per_day >= 12;
            let reference = if is_daily_mean { "daily-mean" } else { "zenith" };
            let fields = [
                format!("diurnal.latitude = {latitude:?}"),
                format!("diurnal.day_of_year = {day_of_year}"),
                format!("diurnal.start_hour = {start_hour:?}"),
                format!("diurnal.ttis_per_day = {ttis_per_day}"),
                format!("diurnal.sky = \"{sky}\""),
                format!("diurnal.known = \"{known}\""),
                format!("diurnal.reference = \"{reference}\"\n"),
            ];
            (fields.join("\n"), is_daily_mean)
        },
    )
}
