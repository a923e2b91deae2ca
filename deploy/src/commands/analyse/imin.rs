//! `reveille analyse imin`: the paper's estimate of E(I_min), the mean of I_min, next to its mean over deployments.
//! Names of columns are a public interface (see `sheet`).

use reveille_study::analysis::imin::measure;

use super::lists::{build_scenario, split_list};
use super::sheet::{Findings, Sheet};
use crate::cli::IminArgs;

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

/// Measures E(I_min).
pub(super) fn run(args: &IminArgs) -> anyhow::Result<()> {
    let mut rows = Vec::new();
    let mut set_up = String::new();
    for layout in split_list("--layouts", &args.layouts, "uniform,grid")? {
        for devices in split_list("--devices", &args.devices, "10,50,250")? {
            let fields = [
                ("--layouts", "layout.kind", Some(layout)),
                ("--devices", "devices", Some(devices)),
            ];
            let scenario = build_scenario(&args.study, &fields)?;
            let result = measure(&scenario, args.seeds)?;
            rows.push(vec![
                layout.into(),
                scenario.run.devices.into(),
                result.square_grid.into(),
                result.measured.mean.into(),
                result.measured.deviation.into(),
                result.measured.half_width.into(),
                result.measured_range.0.into(),
                result.measured_range.1.into(),
                (result.measured.runs as u64).into(),
            ]);
            set_up = format!(
                "{} × {} m · η {} · {} deployments",
                scenario.area.width, scenario.area.height, scenario.sensing.eta, args.seeds
            );
        }
    }
    let findings = Findings {
        title: format!("E(I_min) over deployments · {set_up}"),
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
