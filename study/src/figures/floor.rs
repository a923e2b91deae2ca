//! Energy floor and relaxed bounds. The floor is the least energy of a policy that senses the whole area in every TTI;
//! the bounds estimate the information that less energy can buy.
//!
//! Per device and TTI, with C the least number of devices whose discs of radius d_max cover the area that all N cover.
//! q is the covered share of the area, and r the number of events that start per TTI:
//!
//! ```text
//! floor = (C · E_idle + (N − C) · E_WuR + r · q · E_Tx) / N
//! r     = 1 / (1/α + (1 − q) · (D − 1))
//! ```
//!
//! Such a policy needs at least C devices in S1. All others pay for their wake-up radio, and E_idle is greater than
//! E_WuR. A covered event is detected as it starts and closed by its first report, so it costs at least one E_Tx. An
//! event out of reach lasts D TTIs, in which no other event starts. The floor assumes full batteries: devices that
//! cannot pay spend less, but then do not sense either. A policy that skips a part of the area, or senses it rarely,
//! may spend less. The floor does not tell how much information that costs.
//!
//! `study/data/cover.py` computes C with an exact solver. For instances not solved to optimality, C is the proven lower
//! bound.

use reveille_bs::scenario::Scenario;
use reveille_common::event::ProcessSettings;
use reveille_common::geometry::Layout;
use reveille_common::sensing::DetectionKind;

use super::chart::{ChartPoint, Interval, Series};
use super::scene::Paint;
use super::style::{MarkerShape, Style};

/// Least covers by layout and N, made by `study/data/cover.py`: number of deployments, and the means over them of the
/// least cover and of the share in reach. Columns are read by position.
const COVER_CSV: &str = include_str!("../../data/cover.csv");
/// Relaxed bounds: layout, N, energy per device and TTI, information. Columns are read by position.
const BOUND_CSV: &str = include_str!("../../data/bounds.csv");
/// Side of the square area for which [`COVER_CSV`] was computed, metres.
const COVER_AREA_SIDE: f64 = 20.0;
/// d_max for which [`COVER_CSV`] was computed, metres.
const COVER_D_MAX: f64 = 4.0;

/// Caption text about the floor.
pub(crate) const FLOOR_CAPTION: &str = "Energy floor: the least energy to observe the whole area in reach in every TTI \
    (a minimum cover senses, all others listen, one report per event, full batteries), shown where the harvest reaches \
    it. A policy that observes less can spend less.";
/// Caption text about the relaxed bound.
pub(crate) const BOUND_CAPTION: &str = "Relaxed bound: an estimate, not a proof, from 20 runs of a prototype. In each \
    TTI the best set of a given number of devices senses, with two reports per event and no battery limits.";

/// Returns the energy floor per device and TTI, units, for `n` devices under `scenario`. `None` without cover data:
/// other areas, ranges, layouts or numbers of devices. Also `None` for probabilistic detection, events that are not
/// uniform over the area, or several device classes.
pub fn energy_floor(scenario: &Scenario, n: u32) -> Option<f64> {
    // With several classes the smallest cover need not be the cheapest one.
    let [class] = &scenario.classes[..] else { return None };
    let is_same = |value: f64, stated: f64| (value - stated).abs() < 1e-9;
    let has_cover_data = is_same(scenario.area.width, COVER_AREA_SIDE)
        && is_same(scenario.area.height, COVER_AREA_SIDE)
        && is_same(scenario.sensing.d_max, COVER_D_MAX)
        && scenario.sensing.kind == DetectionKind::Range
        && scenario.events.process == ProcessSettings::Uniform;
    let (cover, covered_share) = least_cover(&scenario.layout, n).filter(|_| has_cover_data)?;
    let energy = &class.energy;
    // An event out of reach lasts D TTIs, in which no other can start; one in reach ends in its first TTI.
    let blocked_ttis = (1.0 - covered_share) * (scenario.events.duration as f64 - 1.0);
    let events_per_tti = 1.0 / (1.0 / scenario.events.alpha + blocked_ttis);
    let n = f64::from(n);
    let sensing = cover * energy.e_idle.units();
    let listening = (n - cover) * energy.e_wur.units();
    let reports = events_per_tti * covered_share * energy.e_tx.units();
    Some((sensing + listening + reports) / n)
}

/// Returns the energy floor, if it does not exceed the mean harvest; devices cannot spend more in the long run.
pub(crate) fn floor_within_harvest(scenario: &Scenario, n: u32) -> Option<f64> {
    let harvest = scenario.classes.first()?.harvest.mean(scenario.run.tau).units();
    energy_floor(scenario, n).filter(|floor| *floor <= harvest)
}

/// Returns the least cover of `n` devices and the share of the area within their reach.
fn least_cover(layout: &Layout, n: u32) -> Option<(f64, f64)> {
    let row = csv_rows(COVER_CSV).find(|row| is_row_of(row, layout, n))?;
    // Columns `cover_at_least` and `reach`.
    Some((row.get(3)?.parse().ok()?, row.get(6)?.parse().ok()?))
}

/// Returns the relaxed bounds for `n` devices as points of energy and information, in ascending order of energy. They
/// are valid only for the events, ranges and energies of the preset `paper`.
pub fn relaxed_bounds(layout: &Layout, n: u32) -> Vec<ChartPoint> {
    let rows_at_n = csv_rows(BOUND_CSV).filter(|row| is_row_of(row, layout, n));
    let point = |row: Vec<&str>| Some(exact_point(row.get(2)?.parse().ok()?, row.get(3)?.parse().ok()?));
    rows_at_n.filter_map(point).collect()
}

/// Returns the rows of a table without its header.
fn csv_rows(table: &str) -> impl Iterator<Item = Vec<&str>> {
    table.lines().skip(1).map(|line| line.split(',').collect())
}

fn is_row_of(row: &[&str], layout: &Layout, n: u32) -> bool {
    let layout = match layout {
        Layout::JitteredGrid => "jittered-grid",
        Layout::Uniform => "uniform",
        Layout::PoissonDisk | Layout::Grid | Layout::Hex | Layout::File(_) => return false,
    };
    row.first() == Some(&layout) && row.get(1).and_then(|text| text.parse().ok()) == Some(n)
}

/// Creates a point without intervals, since it is not measured.
pub const fn exact_point(x: f64, y: f64) -> ChartPoint {
    ChartPoint {
        x,
        y,
        y_half_width: f64::NAN,
        x_half_width: f64::NAN,
    }
}

/// Creates the line of the energy floor through `points`.
pub fn floor_series(points: Vec<ChartPoint>) -> Series {
    ink_series("energy floor", &[8.0, 2.0, 1.0, 2.0, 1.0, 2.0], points)
}

/// Creates the line of the relaxed bound through `points`.
pub(crate) fn bound_series(points: Vec<ChartPoint>) -> Series {
    ink_series("relaxed bound", &[4.0, 2.0], points)
}

fn ink_series(name: &str, dashes: &'static [f64], points: Vec<ChartPoint>) -> Series {
    Series {
        name: name.to_owned(),
        style: Style {
            paint: Paint::Ink,
            marker: MarkerShape::Circle,
            dashes,
        },
        is_joined: true,
        has_markers: false,
        interval: Interval::Band,
        points,
    }
}

#[cfg(test)]
mod tests {
    use reveille_bs::scenario::{Override, load};

    use super::*;

    fn scenario_with(set: &[&str]) -> Scenario {
        let set: Vec<Override> = set
            .iter()
            .map(|text| Override::parse(text).expect("an override"))
            .collect();
        load("paper", &set).expect("a scenario").scenario
    }

    #[test]
    fn each_row_of_the_data_is_complete() {
        let columns = [COVER_CSV, BOUND_CSV].map(|table| table.lines().next().expect("a head").split(',').count());
        assert_eq!(columns, [7, 4]);
        for (table, columns) in [COVER_CSV, BOUND_CSV].into_iter().zip(columns) {
            for row in csv_rows(table) {
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
        // LAYOUTS and SIZES in `study/data/cover.py`.
        for layout in [Layout::JitteredGrid, Layout::Uniform] {
            for n in [10, 20, 40, 50, 60, 80, 100, 130, 160, 200, 250] {
                let (cover, reach) = least_cover(&layout, n).expect("a cover");
                assert!(
                    reach > 0.0 && reach <= 1.0 && cover <= f64::from(n),
                    "N = {n}: cover {cover}, reach {reach}"
                );
                // Discs of 16π m² cannot cover more than their area.
                assert!(
                    cover * 16.0 * std::f64::consts::PI >= reach * 400.0,
                    "N = {n}: cover {cover}, reach {reach}"
                );
            }
        }
    }

    #[test]
    fn the_floor_is_the_cost_of_cover_listening_and_reports() {
        let (cover, reach) = least_cover(&Layout::JitteredGrid, 10).expect("a cover");
        assert!(
            (cover - 10.0).abs() < 1e-12 && (0.7..0.8).contains(&reach),
            "cover {cover}, reach {reach}"
        );
        // All ten sense. An event starts 5 TTIs after the last on average; one out of reach adds 3 TTIs.
        let expected = 1.0 + reach * 10.0 / (5.0 + 3.0 * (1.0 - reach)) / 10.0;
        let floor = energy_floor(&scenario_with(&[]), 10).expect("a floor");
        assert!((floor - expected).abs() < 1e-12, "floor {floor}, expected {expected}");
        // Events of one TTI do not delay the next event.
        let short_events = energy_floor(&scenario_with(&["events.duration=1"]), 10).expect("a floor");
        assert!(
            (short_events - (1.0 + 0.2 * reach)).abs() < 1e-12,
            "floor {short_events}"
        );
    }

    #[test]
    fn listening_costs_e_wur_per_device_outside_the_cover() {
        let (cover, reach) = least_cover(&Layout::JitteredGrid, 250).expect("a cover");
        let floor = energy_floor(&scenario_with(&["energy.e_wur=0"]), 250).expect("a floor");
        assert!((floor - (cover + 2.0 * reach) / 250.0).abs() < 1e-9, "floor {floor}");
        let listening = energy_floor(&scenario_with(&[]), 250).expect("a floor") - floor;
        assert!(
            (listening - 0.071_429 * (250.0 - cover) / 250.0).abs() < 1e-9,
            "cost of listening {listening}"
        );
    }

    #[test]
    fn without_a_known_cover_there_is_no_floor() {
        for set in [
            "sensing.d_max=5",
            "sensing.kind=probabilistic",
            "layout.kind=hex",
            "area.width=30",
            "events.process=bursts",
        ] {
            assert_eq!(energy_floor(&scenario_with(&[set]), 50), None, "{set}");
        }
        assert_eq!(energy_floor(&scenario_with(&[]), 51), None);
        assert_eq!(
            floor_within_harvest(&scenario_with(&[]), 10),
            None,
            "the floor is above 1 unit, the harvest is 0.45"
        );
        assert_eq!(
            floor_within_harvest(&scenario_with(&[]), 250),
            energy_floor(&scenario_with(&[]), 250)
        );
        assert!(
            relaxed_bounds(&Layout::Uniform, 250).is_empty() && relaxed_bounds(&Layout::JitteredGrid, 250).len() == 3
        );
    }
}
