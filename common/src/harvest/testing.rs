//! A small harvest trace, and the harvest of whole scenarios, for tests.

use std::collections::BTreeSet;

use super::{HarvestSource, SharedSourceData};
use crate::deployment::Deployment;
use crate::ids::Tti;
use crate::scenario::testing::TestScenario;

/// Draws the harvest of every device of the run, and returns its mean in units per TTI.
pub(crate) fn draw_mean_harvests(scenario: &TestScenario) -> Vec<f64> {
    let deployment = Deployment::new(scenario);
    let shared = SharedSourceData::new(deployment.devices.iter().map(|d| &d.harvest), deployment.traces);
    let drawn = deployment.devices.iter().map(|device| {
        let mut source = HarvestSource::new(&device.harvest, &shared, scenario.run.seed, device.id);
        let mut sum = 0.0;
        while source.next_arrival() < Tti(scenario.run.ttis) {
            sum += source.take_arrival().units();
        }
        sum / scenario.run.ttis as f64
    });
    drawn.collect()
}

/// Returns the TTIs of the run in which each device harvests energy.
pub(crate) fn arrival_ttis(scenario: &TestScenario) -> Vec<BTreeSet<Tti>> {
    let deployment = Deployment::new(scenario);
    let shared = SharedSourceData::new(deployment.devices.iter().map(|d| &d.harvest), deployment.traces);
    let of_device = deployment.devices.iter().map(|device| {
        let mut source = HarvestSource::new(&device.harvest, &shared, scenario.run.seed, device.id);
        let mut ttis = BTreeSet::new();
        while source.next_arrival() < Tti(scenario.run.ttis) {
            ttis.insert(source.next_arrival());
            source.take_arrival();
        }
        ttis
    });
    of_device.collect()
}

/// Writes a trace of three columns to a temporary file for `name`, and returns the fields that read it. `end` is the
/// value of `harvest.trace.end`. Tests run at the same time, so each needs other names. `trace/tests.rs` repeats the
/// values and the TTIs per row.
pub(crate) fn trace_fields(name: &str, end: &str) -> Vec<String> {
    let path = std::env::temp_dir().join(format!("reveille-trace-{name}-{}.csv", std::process::id()));
    std::fs::write(&path, "a,b,c\n1,0,7\n2,0,0\n0,0,3\n").expect("a file");
    [
        "harvest.kind=trace".to_owned(),
        format!("harvest.trace.file={}", path.display()),
        "harvest.trace.columns=[\"a\", \"b\", \"c\"]".to_owned(),
        "harvest.trace.ttis_per_row=4".to_owned(),
        format!("harvest.trace.end={end}"),
        "devices=7".to_owned(),
    ]
    .to_vec()
}
