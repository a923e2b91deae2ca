//! A scenario as a complete TOML file.

use std::fmt::Write as _;

use super::learning::TableSource;
use super::model::{DeviceClass, EnergyModel, Harvest, PolicyConfig, Scenario, Trace, TraceColumns, TraceEnd};
use crate::geometry::Layout;
use crate::sensing::Sensing;
use crate::units::{Energy, MICRO_PER_UNIT};

impl Scenario {
    /// The complete scenario as TOML, with units. Loading it gives an equal scenario as long as the layout and trace
    /// files that it names are still there.
    #[must_use]
    pub fn to_toml(&self) -> String {
        let Self {
            preset,
            devices,
            ttis,
            seed,
            warm_up,
            tau,
            area,
            layout,
            classes,
            sensing,
            events,
            bs,
            policy,
        } = self;
        let mut page = Page::default();
        page.field("preset", text(preset), "every field below overrides it");
        page.field("devices", devices, "N");
        page.field("ttis", ttis, "K, the warm-up included");
        page.field("seed", seed, "of every random stream");
        page.field("warm_up", float(*warm_up), "share of K left out of the metrics");
        page.field("tau", float(*tau), "duration of a TTI, units of model time");
        page.section("[area]");
        page.field("width", float(area.width), "metres");
        page.field("height", float(area.height), "metres");
        write_layout(&mut page, layout);
        write_sensing(&mut page, sensing);
        page.section("[events]");
        page.field(
            "alpha",
            float(events.alpha),
            "probability of a start in a TTI without an event",
        );
        page.field("duration", events.duration, "TTIs");
        page.section("[bs]");
        page.field("sync_interval", bs.sync_interval, "TTIs");
        page.field(
            "ranking",
            text(bs.ranking.name()),
            "of wake-up candidates: p42 or posterior",
        );
        page.field(
            "battery_knowledge",
            text(bs.battery_knowledge.name()),
            "oracle or reported",
        );
        page.section("[policy]");
        page.field("name", text(policy.name()), "");
        write_policy(&mut page, policy);
        match classes.as_slice() {
            [only] if only.name == "default" => write_class(&mut page, "", only),
            classes => {
                for class in classes {
                    page.section("[[class]]");
                    page.field("name", text(&class.name), "");
                    page.field("share", float(class.share), "of the N devices");
                    write_class(&mut page, "class.", class);
                }
            }
        }
        page.0
    }
}

fn write_policy(page: &mut Page, policy: &PolicyConfig) {
    match policy {
        PolicyConfig::Random | PolicyConfig::Genie => {}
        PolicyConfig::Knn(knn) => {
            page.section("[policy.knn]");
            page.field("neighbours", knn.neighbours, "K, devices that vote on a cluster");
            page.field("limit_radius", knn.limit_radius, "split clusters wider than d_max");
        }
        PolicyConfig::Adjusted(adjusted) => {
            page.section("[policy.adjusted]");
            page.field("t_on", format!("{:?}", adjusted.t_on), "TTIs, to be searched");
            page.field("t_drx", format!("{:?}", adjusted.t_drx), "TTIs, to be searched");
            page.field("pilot_ttis", adjusted.pilot_ttis, "length of the pilot run for a pair");
        }
        PolicyConfig::QLearning(learning) => {
            page.section("[policy.q-learning]");
            let table = match &learning.source {
                TableSource::Shipped => "shipped".into(),
                TableSource::Nothing => "nothing".into(),
                TableSource::File(path) => path.to_string_lossy(),
            };
            page.field("table", text(&table), "shipped, nothing, or a file of `reveille train`");
            page.field("mu1", float(learning.weights.mu1), "weight of misdetections");
            page.field("mu2", float(learning.weights.mu2), "weight of information");
            page.field("zeta", float(learning.weights.zeta), "discount");
            page.field("window", learning.window, "TTIs within which the area is covered once");
            page.field("learn", learning.learn, "whether it goes on learning in the run");
            let (first, last) = learning.epsilon;
            page.field("epsilon", float(first), "share of random decisions while it learns");
            page.field("epsilon_last", float(last), "the same at the end of the run");
            let schedule = &learning.schedule;
            page.field(
                "rate_decay",
                float(schedule.rate_decay),
                "exponent of the learning rate",
            );
            page.field("rate_floor", float(schedule.rate_floor), "the least learning rate");
            page.field(
                "optimism",
                float(schedule.optimism),
                "of the start, 1 for the most an action brings",
            );
        }
    }
}

fn write_layout(page: &mut Page, layout: &Layout) {
    page.section("[layout]");
    if let Layout::File { path, .. } = layout {
        page.field("file", text(&path.to_string_lossy()), "columns x and y, metres");
    }
    page.field("kind", text(layout.name()), "");
}

fn write_sensing(page: &mut Page, sensing: &Sensing) {
    page.section("[sensing]");
    page.field("kind", text(sensing.kind.name()), "");
    page.field("d_max", float(sensing.d_max), "metres");
    page.field("eta", float(sensing.eta), "per metre");
    page.field("psi", float(sensing.psi), "information of a report from distance 0");
    page.field("g", text(sensing.g.name()), "how reports of one event are joined");
}

fn write_class(page: &mut Page, prefix: &str, class: &DeviceClass) {
    let EnergyModel {
        e_max,
        e_idle,
        e_wur,
        e_tx,
        initial,
    } = class.energy;
    page.section(&format!("[{prefix}energy]"));
    page.field("e_max", units(e_max), "units");
    page.field("e_idle", units(e_idle), "units per TTI in S1");
    page.field("e_wur", units(e_wur), "units per TTI in S4");
    page.field("e_tx", units(e_tx), "units per transmission");
    page.field("initial", units(initial), "units in the battery at the start");
    page.section(&format!("[{prefix}harvest]"));
    match &class.harvest {
        Harvest::Eq5 { lambda, e_b } => write_arrivals(page, "eq5", *lambda, *e_b),
        Harvest::ExpMinusLambda { lambda, e_b } => write_arrivals(page, "exp-minus-lambda", *lambda, *e_b),
        Harvest::Mpp { lambda, e_b, off_mean } => {
            write_arrivals(page, "mpp", *lambda, *e_b);
            page.field("off_mean", float(*off_mean), "mean off-duration, units of model time");
        }
        Harvest::Trace(trace) => {
            page.field("kind", text("trace"), "");
            write_trace(page, prefix, trace);
        }
    }
}

fn write_arrivals(page: &mut Page, kind: &str, lambda: f64, e_b: Energy) {
    page.field("kind", text(kind), "");
    page.field("lambda", float(lambda), "per unit of model time");
    page.field("e_b", units(e_b), "units per arrival");
}

fn write_trace(page: &mut Page, prefix: &str, trace: &Trace) {
    let end = match trace.end {
        TraceEnd::Cycle => "cycle",
        TraceEnd::Stop => "stop",
    };
    page.section(&format!("[{prefix}harvest.trace]"));
    page.field("file", text(&trace.file.to_string_lossy()), "");
    match &trace.columns {
        TraceColumns::Shared(name) => page.field("column", text(name), "read by all devices"),
        TraceColumns::PerDevice(names) => {
            let names: Vec<String> = names.iter().map(|name| text(name)).collect();
            page.field(
                "columns",
                format!("[{}]", names.join(", ")),
                "read by one device each, in a circle",
            );
        }
    }
    page.field("scale", float(trace.scale), "units of energy for one in the file");
    page.field("ttis_per_row", trace.ttis_per_row, "TTIs");
    page.field("end", text(end), "what follows the last row");
}

#[derive(Default)]
struct Page(String);

impl Page {
    fn section(&mut self, header: &str) {
        let _ = writeln!(self.0, "\n{header}");
    }

    fn field(&mut self, name: &str, value: impl std::fmt::Display, comment: &str) {
        let _ = match comment {
            "" => writeln!(self.0, "{name} = {value}"),
            comment => writeln!(self.0, "{name} = {value} # {comment}"),
        };
    }
}

fn text(value: &str) -> String {
    toml::Value::String(value.to_owned()).to_string()
}

fn float(value: f64) -> String {
    toml::Value::Float(value).to_string()
}

/// Exact decimal units.
fn units(energy: Energy) -> String {
    let (whole, rest) = (energy.micro() / MICRO_PER_UNIT, energy.micro() % MICRO_PER_UNIT);
    let digits = format!("{rest:06}");
    let decimals = digits.trim_end_matches('0');
    format!("{whole}.{}", if decimals.is_empty() { "0" } else { decimals })
}
