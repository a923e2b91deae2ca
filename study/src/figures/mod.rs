//! Figures of the study: the paper's figures drawn from result tables, and figures of deployments, device batteries,
//! `q-learning` tables and weight tuning.
//!
//! ```text
//! tables ─► results ─► study, sweep, pareto, front ─► chart ┐
//! tables, analysis::harvest ─► energy ─► chart              ├─► scene ─► svg, png
//! run ─► run_walk ─► deployment, timeline                   ┤
//! misses::Misses ─► misses                                  ┤
//! runs ─► robustness ─► chart_grid                          ┤
//! run ─► trajectories ─► attention                          ┤
//! LearnedTables ─► learning, q_table                        ┤
//! tuning::History ─► tuning (contour)                       ┘
//! ```
//! A [`scene::Scene`] holds a complete figure; [`svg`] and [`png`] only serialise it. Equal input gives equal bytes.
//! `reveille figures`, `report` and `tune` and the Python package call these modules. A changed look does not reach
//! the pictures in `docs/figures/`, which are committed: `docs/figures/make.sh` draws them again.
//!
//! Several figures share `area_plot`, `cell_map`, `device_marks`, `floor`, `heat`, `note`, `run_title`, `scale`,
//! `stated` and `style`. `paired` draws nothing: it computes differences for the report and `reveille compare`.

pub mod area_plot;
pub mod attention;
mod cell_map;
pub mod chart;
pub mod chart_grid;
mod contour;
pub mod deployment;
mod device_marks;
pub mod energy;
mod error;
mod file_labels;
pub mod floor;
pub(crate) mod font;
pub mod front;
pub mod heat;
pub mod learning;
pub mod misses;
pub mod note;
pub mod paired;
pub mod pareto;
pub mod path;
pub mod png;
pub mod q_table;
pub mod results;
pub mod robustness;
mod run_title;
pub mod run_walk;
pub mod scale;
pub mod scene;
mod stated;
pub mod study;
pub mod style;
pub mod svg;
pub mod sweep;
pub mod timeline;
pub mod tuning;

pub use error::FigureError;

/// Replaces each character of `name` that is unsafe in a file name by `_`. Users' scripts read the names. Different
/// names can become equal; [`results::Results::file_labels`] numbers its labels for this reason.
pub fn to_file_name(name: &str) -> String {
    let keep = |c: char| {
        if c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_') {
            c
        } else {
            '_'
        }
    };
    name.chars().map(keep).collect()
}

#[cfg(test)]
mod tests;
