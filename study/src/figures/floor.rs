//! The energy floor: what a policy that looks at the whole area in every TTI cannot go below, and the relaxed bounds of
//! what less energy can buy.
//!
//! Per device and TTI, with C the least number of devices whose discs of d_max cover what those of all N cover, q the
//! share of the area that is covered, and r how many events start in a TTI:
//!
//! ```text
//! floor = (C · E_idle + (N − C) · E_WuR + r · q · E_Tx) / N
//! r     = 1 / (1/α + (1 − q) · (D − 1))
//! ```
//!
//! Whoever looks everywhere has C devices in S1 at least; all others pay for their wake-up radio, and E_idle is more
//! than E_WuR. An event in reach is then detected as it starts and closed by its first report, of which there is one
//! at the least, at E_Tx. One out of reach is on for its D TTIs, in which no other starts. Assumed are full
//! batteries: devices that cannot pay spend less, and then do not look either. A policy that leaves out a part of the
//! area, or looks at it seldom, may spend less; how much information that costs the floor does not say.
//!
//! C is data, made by `study/data/cover.py` with an exact solver; where it was not solved to the end it is the proven
//! lower bound.

use reveille_common::event::Process;
use reveille_common::geometry::Layout;
use reveille_common::scenario::Scenario;
use reveille_common::sensing::DetectionKind;

use super::chart::{Interval, Sample, Series};
use super::scene::Paint;
use super::style::{Marker, Style};

/// Least covers: layout, N, deployments, and the means over them of the least cover and of the share in reach.
const COVERS: &str = include_str!("../../data/cover.csv");
/// Relaxed bounds: layout, N, energy per device and TTI, information.
const BOUNDS: &str = include_str!("../../data/bounds.csv");
/// The area and range of [`COVERS`], metres.
const SIDE: f64 = 20.0;
const D_MAX: f64 = 4.0;

/// What a caption says of the floor.
pub const NOTE: &str = "Energy floor: the least that looking at the whole area in reach in every TTI takes (the \
    deployment's least cover senses, all others listen, one report an event, full batteries), where that is \
    no more than the harvest; who looks at less may spend less.";
/// What a caption says of the relaxed bound.
pub const BOUND_NOTE: &str = "Relaxed bound: an estimate, not a proof, from a prototype of 20 runs: each TTI the best \
    choice of so many devices looks, two reports an event, batteries never bind.";

/// The energy floor per device and TTI, units, for `n` devices under `scenario`. `None` where there are no covers:
/// other areas, ranges, layouts or numbers of devices, detection by chance, events that do not come everywhere alike,
/// or several classes of devices.
pub fn floor(scenario: &Scenario, n: u32) -> Option<f64> {
    let [class] = &scenario.classes[..] else { return None };
    let is_same = |value: f64, stated: f64| (value - stated).abs() < 1e-9;
    let is_covered = is_same(scenario.area.width, SIDE)
        && is_same(scenario.area.height, SIDE)
        && is_same(scenario.sensing.d_max, D_MAX)
        && scenario.sensing.kind == DetectionKind::Range
        && scenario.events.process == Process::Uniform;
    let (cover, reach) = cover(&scenario.layout, n).filter(|_| is_covered)?;
    let energy = &class.energy;
    let blocked = (1.0 - reach) * (scenario.events.duration as f64 - 1.0);
    let starts = 1.0 / (1.0 / scenario.events.alpha + blocked);
    let n = f64::from(n);
    let sensing = cover * energy.e_idle.units();
    let asleep = (n - cover) * energy.e_wur.units();
    let reports = starts * reach * energy.e_tx.units();
    Some((sensing + asleep + reports) / n)
}

/// The energy floor, where it is no more than what devices harvest: more cannot be spent for long.
pub fn affordable(scenario: &Scenario, n: u32) -> Option<f64> {
    let harvest = scenario.classes.first()?.harvest.mean(scenario.tau).units();
    floor(scenario, n).filter(|floor| *floor <= harvest)
}

/// The least cover of `n` devices and the share of the area in their reach.
fn cover(layout: &Layout, n: u32) -> Option<(f64, f64)> {
    let found = rows(COVERS).find(|row| is_of(row, layout, n))?;
    Some((found.get(3)?.parse().ok()?, found.get(6)?.parse().ok()?))
}

/// The relaxed bounds for `n` devices as points of energy and information, by rising energy; none but for the events,
/// ranges and energies of the preset `paper`.
pub fn bounds(layout: &Layout, n: u32) -> Vec<Sample> {
    let own = rows(BOUNDS).filter(|row| is_of(row, layout, n));
    let point = |row: Vec<&str>| Some(sample(row.get(2)?.parse().ok()?, row.get(3)?.parse().ok()?));
    own.filter_map(point).collect()
}

/// The rows of a table without its head.
fn rows(table: &str) -> impl Iterator<Item = Vec<&str>> {
    table.lines().skip(1).map(|line| line.split(',').collect())
}

fn is_of(row: &[&str], layout: &Layout, n: u32) -> bool {
    let layout = match layout {
        Layout::JitteredGrid => "jittered-grid",
        Layout::Uniform => "uniform",
        Layout::PoissonDisk | Layout::Grid | Layout::Hex | Layout::File(_) => return false,
    };
    row.first() == Some(&layout) && row.get(1).and_then(|text| text.parse().ok()) == Some(n)
}

/// A point that nobody measured.
pub const fn sample(x: f64, y: f64) -> Sample {
    Sample {
        x,
        y,
        half: f64::NAN,
        across: f64::NAN,
    }
}

/// The line of the floor through `samples`.
pub fn series(samples: Vec<Sample>) -> Series {
    line("energy floor", &[8.0, 2.0, 1.0, 2.0, 1.0, 2.0], samples)
}

/// The line of the relaxed bound through `samples`.
pub fn bound_series(samples: Vec<Sample>) -> Series {
    line("relaxed bound", &[4.0, 2.0], samples)
}

fn line(name: &str, dashes: &'static [f64], samples: Vec<Sample>) -> Series {
    Series {
        name: name.to_owned(),
        style: Style {
            paint: Paint::Ink,
            marker: Marker::Circle,
            dashes,
        },
        joined: true,
        marked: false,
        interval: Interval::Area,
        samples,
    }
}

#[cfg(test)]
mod tests {
    use reveille_bs::scenario::{Override, load};

    use super::*;

    fn scenario(set: &[&str]) -> Scenario {
        let set: Vec<Override> = set
            .iter()
            .map(|text| Override::parse(text).expect("an override"))
            .collect();
        load("paper", &set).expect("a scenario")
    }

    #[test]
    fn every_row_of_the_data_is_whole() {
        let columns = [COVERS, BOUNDS].map(|table| table.lines().next().expect("a head").split(',').count());
        assert_eq!(columns, [7, 4]);
        for (table, columns) in [COVERS, BOUNDS].into_iter().zip(columns) {
            for row in rows(table) {
                assert_eq!(row.len(), columns, "{row:?}");
                assert!(["jittered-grid", "uniform"].contains(&row[0]), "{row:?}");
                assert!(
                    row[1..]
                        .iter()
                        .all(|cell| cell.parse::<f64>().is_ok_and(f64::is_finite)),
                    "{row:?}"
                );
            }
        }
        for layout in [Layout::JitteredGrid, Layout::Uniform] {
            for n in [10, 20, 40, 50, 60, 80, 100, 130, 160, 200, 250] {
                let (cover, reach) = cover(&layout, n).expect("a cover");
                assert!(reach > 0.0 && reach <= 1.0 && cover <= f64::from(n), "{cover} {reach}");
                // Discs of 16π m² cannot cover more than their area.
                assert!(cover * 16.0 * std::f64::consts::PI >= reach * 400.0, "{cover} {reach}");
            }
        }
    }

    #[test]
    fn the_floor_is_what_cover_listeners_and_one_report_an_event_cost() {
        let (cover, reach) = cover(&Layout::JitteredGrid, 10).expect("a cover");
        assert!(
            (cover - 10.0).abs() < 1e-12 && (0.7..0.8).contains(&reach),
            "{cover} {reach}"
        );
        // All ten sense; of 5 TTIs to wait for an event, and 3 more that one out of reach takes.
        let expected = 1.0 + reach * 10.0 / (5.0 + 3.0 * (1.0 - reach)) / 10.0;
        let found = floor(&scenario(&[]), 10).expect("a floor");
        assert!((found - expected).abs() < 1e-12, "{found} {expected}");
        // Events of one TTI block nothing.
        let short = floor(&scenario(&["events.duration=1"]), 10).expect("a floor");
        assert!((short - (1.0 + 0.2 * reach)).abs() < 1e-12, "{short}");
    }

    #[test]
    fn many_devices_listen_and_few_look() {
        let (cover, reach) = cover(&Layout::JitteredGrid, 250).expect("a cover");
        let found = floor(&scenario(&["energy.e_wur=0"]), 250).expect("a floor");
        assert!((found - (cover + 2.0 * reach) / 250.0).abs() < 1e-9, "{found}");
        let listening = floor(&scenario(&[]), 250).expect("a floor") - found;
        assert!(
            (listening - 0.071_429 * (250.0 - cover) / 250.0).abs() < 1e-9,
            "{listening}"
        );
    }

    #[test]
    fn there_is_no_floor_where_no_cover_is_known() {
        for set in [
            "sensing.d_max=5",
            "sensing.kind=probabilistic",
            "layout.kind=hex",
            "area.width=30",
            "events.process=bursts",
        ] {
            assert_eq!(floor(&scenario(&[set]), 50), None, "{set}");
        }
        assert_eq!(floor(&scenario(&[]), 51), None);
        assert_eq!(
            affordable(&scenario(&[]), 10),
            None,
            "a unit and more, and 0.45 are harvested"
        );
        assert_eq!(affordable(&scenario(&[]), 250), floor(&scenario(&[]), 250));
        assert!(bounds(&Layout::Uniform, 250).is_empty() && bounds(&Layout::JitteredGrid, 250).len() == 3);
    }
}
