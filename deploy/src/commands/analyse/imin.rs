//! `reveille analyse imin`: the paper's estimate of E(I_min), the mean of I_min, next to its mean over deployments.
//! Names of columns are a public interface (see `sheet`). `docs/analysis.md` quotes the numbers; no test compares them.

use reveille_study::analysis::imin::measure;

use super::lists::{build_scenario, split_list};
use super::sheet::{Findings, Sheet};
use crate::cli::IminArgs;

/// The columns, in the order of the values of a row in [`run`].
const COLUMNS: &[&str] = &[
    "layout",
    "n",
    "grid_formula",
    "mean",
    "sd",
    "half_width",
    "min",
    "max",
    "deployments",
];

/// Measures E(I_min) for every layout with every N.
pub(super) fn run(args: &IminArgs) -> anyhow::Result<()> {
    let mut rows = Vec::new();
    let mut area_and_runs = String::new();
    for layout in split_list("--layouts", &args.layouts, "uniform,grid")? {
        for devices in split_list("--devices", &args.devices, "10,50,250")? {
            let fields = [
                ("--layouts", "layout.kind", Some(layout)),
                ("--devices", "devices", Some(devices)),
            ];
            let scenario = build_scenario(&args.study, &fields)?;
            let comparison = measure(&scenario, args.seeds)?;
            rows.push(vec![
                layout.into(),
                scenario.run.devices.into(),
                comparison.square_grid.into(),
                comparison.measured.mean.into(),
                comparison.measured.deviation.into(),
                comparison.measured.half_width.into(),
                comparison.measured_range.0.into(),
                comparison.measured_range.1.into(),
                (comparison.measured.runs as u64).into(),
            ]);
            area_and_runs = format!(
                "{} × {} m · η {} · {} deployments",
                scenario.area.width, scenario.area.height, scenario.sensing.eta, args.seeds
            );
        }
    }
    let findings = Findings {
        title: format!("E(I_min) over deployments · {area_and_runs}"),
        sheets: vec![Sheet {
            name: "imin",
            title: "I_min = Ψ p(d*), d* the largest distance from a device to a vertex of its Voronoi cell; \
                grid_formula: Ψ p(√(ξ/2N))."
                .to_owned(),
            columns: COLUMNS,
            rows,
        }],
        notes: vec![
            "Ψ p(√(ξ/2N)) is the value of a square grid. A random layout has a lower value, set by its largest hole. \
             The layouts grid and hex do not depend on the seed."
                .to_owned(),
        ],
    };
    findings.present(&args.study)
}
