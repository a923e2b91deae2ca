//! Heat maps of the tables that `q-learning` has learned for one N: duty cycling and wake-ups. The columns of the CSV
//! are a file format; `deploy/src/commands/figures.rs` names the files. The limits of buckets must equal the limits in
//! [`reveille_bs::policy::q_learning::learned`]; a test below compares them. Labels and captions repeat rules from
//! there that no test compares: the halvings of scores, the two lowest battery buckets, smoothing, the learning rate.

use std::f64::consts::PI;
use std::fmt::Write as _;

use reveille_bs::beliefs::ages;
use reveille_bs::policy::q_learning::learned::{
    self, AREA_BUCKETS, BATTERY_BUCKETS, INFORMATION_BUCKETS, LearnedTables, Lookback, QValue, REPORT_BUCKETS,
    SCORE_BUCKETS, TableSet, VALUE_NODES, WakeTable, score_edge,
};
use reveille_common::scenario::WakeUpRanking;

use super::chart::{Chart, ChartPoint, Interval, Series};
use super::error::FigureError;
use super::font::{Weight, wrap_text};
use super::heat::{HeatCell, HeatMap, KnowledgeDegree, RowLabels, draw_key};
use super::scale::Scale;
use super::scene::{Scene, Text};
use super::style::{LEADING, MARGIN, PAGE_WIDTH, Style, TEXT_SIZE, TITLE_SIZE};

/// Heights of the rows of duty tables and of wake-up tables, points.
const DUTY_ROW_HEIGHT: f64 = 15.0;
const WAKE_ROW_HEIGHT: f64 = 12.0;
/// Distance between panels, points.
const PANEL_GAP: f64 = 12.0;
/// Limits of the buckets of Î, shares of Ψ, as used by
/// [`reveille_bs::policy::q_learning::learned::information_bucket`].
const INFORMATION_LIMITS: [f64; INFORMATION_BUCKETS + 1] = [0.0, 0.03, 0.08, 0.15, 0.25, 0.4, 0.55, 0.75, 1.0];
/// First battery bucket in which a device can sense and report.
const FIRST_ABLE_BUCKET: usize = learned::FIRST_ABLE_BUCKET as usize;

/// Finds the tables for `devices` devices and `window` in `learned`, which was read from `file`. The default is the
/// shortest window in the file.
///
/// # Errors
/// The file has no such tables.
pub fn find_table_set<'l>(
    file: &str,
    learned: &'l LearnedTables,
    devices: u32,
    window: Option<Lookback>,
) -> Result<&'l TableSet, FigureError> {
    let windows = learned.lookbacks();
    let shortest = windows.first().copied().unwrap_or(Lookback::Window(1));
    let mut sets = learned.entries.iter();
    let chosen_window = window.unwrap_or(shortest);
    let found = sets.find(|set| set.lookback == chosen_window && set.devices == devices);
    found.ok_or_else(|| {
        let sets_of_window = learned.entries.iter().filter(|set| set.lookback == chosen_window);
        let device_counts: Vec<String> = sets_of_window.map(|set| set.devices.to_string()).collect();
        let windows: Vec<String> = windows.iter().map(|lookback| lookback.describe()).collect();
        FigureError::NoEntry {
            devices,
            window: chosen_window,
            file: file.to_owned(),
            known: if device_counts.is_empty() {
                "no".to_owned()
            } else {
                device_counts.join(", ")
            },
            windows: windows.join(", "),
        }
    })
}

/// Returns E_max, E_idle and E_Tx of the training, units; `None` if the file does not hold them.
fn training_energies(learned: &LearnedTables) -> Option<[f64; 3]> {
    let [e_max, e_idle, e_tx] =
        ["energy.e_max", "energy.e_idle", "energy.e_tx"].map(|name| training_field(learned, name));
    Some([e_max?, e_idle?, e_tx?])
}

/// Returns a numeric field of the training's scenario. `None` for energies if there are several classes, which have
/// separate names in the file; the figure then has shares and sixths instead of units.
fn training_field(learned: &LearnedTables, name: &str) -> Option<f64> {
    let entry = learned.site.numbers.iter().find(|(path, _)| path == name);
    entry.map(|(_, value)| *value)
}

/// Returns the limits of the battery buckets, units.
fn battery_limits([e_max, e_idle, e_tx]: [f64; 3]) -> [f64; BATTERY_BUCKETS + 1] {
    let energy_to_report = e_idle + e_tx;
    let bucket_width = (e_max - energy_to_report) / (BATTERY_BUCKETS - FIRST_ABLE_BUCKET) as f64;
    std::array::from_fn(|limit| match limit {
        0 => 0.0,
        1 => e_idle,
        _ => energy_to_report + bucket_width * (limit - FIRST_ABLE_BUCKET) as f64,
    })
}

/// Returns the limits of the buckets of newly covered area, shares of the sensing disc.
fn area_limits(lookback: Lookback) -> [f64; AREA_BUCKETS + 1] {
    let largest = match lookback {
        Lookback::Window(_) => 1.0,
        Lookback::Ages => ages::MAX_WORTH,
    };
    std::array::from_fn(|limit| match limit {
        0 => 0.0,
        AREA_BUCKETS => largest,
        _ => lookback.bucket_end(limit - 1),
    })
}

/// Returns the limits of the score buckets, shares of Ψ.
fn score_limits() -> [f64; SCORE_BUCKETS + 1] {
    std::array::from_fn(score_edge)
}

/// Formats `value` with two digits, but with all integer digits and at most two decimals, without trailing zeros.
fn format_short(value: f64) -> String {
    let decimals = if value == 0.0 || value >= 9.95 {
        0
    } else if value >= 0.995 {
        1
    } else {
        2
    };
    let text = format!("{value:.decimals$}");
    if text.contains('.') {
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        text
    }
}

/// Creates the heat map of the duty table of `set`.
pub(crate) fn duty_map(learned: &LearnedTables, set: &TableSet) -> HeatMap {
    // The policy decides by the monotone advantages, not by the learned numbers in the cells.
    let advantages = set.duty.advantages();
    let cell = |battery: usize, area: usize| {
        let [on, off] = [true, false].map(|delta| set.duty.at(battery, area, delta));
        HeatCell {
            value: on.value - off.value,
            knowledge: match (on.visits, off.visits) {
                (0, 0) => KnowledgeDegree::Unknown,
                (0, _) | (_, 0) => KnowledgeDegree::PartlyKnown,
                (_, _) => KnowledgeDegree::Known,
            },
            // Below `FIRST_ABLE_BUCKET` the policy lets no device sense, whatever the table holds.
            is_framed: battery >= FIRST_ABLE_BUCKET && advantages[battery][area] > 0.0,
        }
    };
    let limits = training_energies(learned).map(battery_limits);
    let row_name = |battery: usize| {
        let range = limits.map(|limits| {
            format!(
                "{}–{}",
                format_short(limits[battery]),
                format_short(limits[battery + 1])
            )
        });
        match (battery, range) {
            (0, range) => format!("cannot sense: {}", range.unwrap_or_default()),
            (1, range) => format!("cannot report: {}", range.unwrap_or_default()),
            (_, Some(range)) => range,
            // `BATTERY_BUCKETS` − `FIRST_ABLE_BUCKET` is 6.
            (_, None) => format!("sixth {} of the rest", battery - 1),
        }
    };
    let column_limits = |unit: &str, whole: f64| {
        (
            unit.to_owned(),
            area_limits(set.lookback)
                .map(|limit| format_short(whole * limit))
                .to_vec(),
        )
    };
    let mut columns = vec![column_limits("% of the disc", 100.0)];
    if let Some(d_max) = training_field(learned, "sensing.d_max") {
        columns.push(column_limits("m²", PI * d_max * d_max));
    }
    HeatMap {
        x_label: match set.lookback {
            Lookback::Window(_) => "area that the device would newly cover, share of its sensing disc",
            Lookback::Ages => "area that the device would newly cover, weighted by age, share of its disc at age 1",
        }
        .to_owned(),
        y_label: "battery, units".to_owned(),
        columns,
        rows: RowLabels::Names((0..BATTERY_BUCKETS).map(row_name).collect()),
        cells: (0..BATTERY_BUCKETS)
            .map(|battery| (0..AREA_BUCKETS).map(|area| cell(battery, area)).collect())
            .collect(),
    }
}

/// Draws the duty table of `set`, one of `learned`: advantages, with V below them.
pub fn duty_scene(learned: &LearnedTables, set: &TableSet) -> Scene {
    let area = match set.lookback {
        Lookback::Window(_) => "the area that it would newly cover",
        Lookback::Ages => "the area that it would newly cover, weighted by age",
    };
    let title = format!("Value of sensing with N = {}: Q(s, 1) − Q(s, 0)", set.devices);
    let map = duty_map(learned, set);
    let text = format!(
        "A cell is a state s of a device: its battery, and {area}. The number is the gain from sensing in the next TTI \
         (δ = 1) over sleeping, in units of N r(k). Within the bold line the policy lets devices sense, in order of \
         gain: there the battery is enough to sense and report, and the advantage is positive after smoothing (never \
         falling with the area). Colours follow the square root of the number. {}{}",
        if map.count(KnowledgeDegree::PartlyKnown) > 0 {
            "An action that was never tried keeps its initial value, the immediate reward; such a number is a guess. "
        } else {
            ""
        },
        describe_training_of_set(learned, set)
    );
    let (mut scene, y) = titled_scene(title, text.clone());
    let scale_end = map.largest_magnitude();
    let mut y = map.draw(
        &mut scene,
        (MARGIN, y),
        (PAGE_WIDTH - 2.0 * MARGIN, DUTY_ROW_HEIGHT),
        scale_end,
    );
    let partly_known = (map.count(KnowledgeDegree::PartlyKnown) > 0).then_some("one action never tried");
    y = draw_key(&mut scene, (MARGIN, y), scale_end, "senses", partly_known) + 8.0;
    let value_scene = value_chart(learned, set).scene();
    let height = value_scene.height;
    scene.add_scene(value_scene, (0.0, y));
    let (left, mut line_y) = (0.5 * (PAGE_WIDTH + PANEL_GAP), y + MARGIN + TITLE_SIZE);
    for line in wrap_text(&text, Weight::Regular, TEXT_SIZE, PAGE_WIDTH - MARGIN - left) {
        scene.text(Text::new(line, (left, line_y), TEXT_SIZE));
        line_y += LEADING;
    }
    scene.height = (y + height).max(line_y - LEADING + 0.24 * TEXT_SIZE + MARGIN).ceil();
    scene
}

/// Creates a scene with its title. Returns it with the y below the title.
fn titled_scene(title: String, description: String) -> (Scene, f64) {
    let mut scene = Scene::new(PAGE_WIDTH, 0.0);
    scene.text(Text::new(title.as_str(), (MARGIN, MARGIN + TITLE_SIZE), TITLE_SIZE).bold());
    scene.title = title;
    scene.description = description;
    (scene, MARGIN + TITLE_SIZE + LEADING)
}

/// Creates the chart of V against the battery.
fn value_chart(learned: &LearnedTables, set: &TableSet) -> Chart {
    let e_max = training_energies(learned).map(|[e_max, ..]| e_max);
    let point = |node: usize, y: f64| ChartPoint {
        x: e_max.unwrap_or(1.0) * node as f64 / (VALUE_NODES - 1) as f64,
        y,
        y_half_width: f64::NAN,
        x_half_width: f64::NAN,
    };
    let smoothed: Vec<ChartPoint> = (0..).zip(set.duty.values()).map(|(node, y)| point(node, y)).collect();
    let visited = |(_, cell): &(usize, &QValue)| cell.visits > 0;
    let learned_points = set.duty.value.iter().enumerate().filter(visited);
    let learned_points: Vec<ChartPoint> = learned_points.map(|(node, cell)| point(node, cell.value)).collect();
    let ys = smoothed.iter().chain(&learned_points).map(|s| s.y);
    let (y, x) = (
        Scale::linear(ys, false),
        Scale::linear([0.0, point(VALUE_NODES - 1, 0.0).x], true),
    );
    let series = |name: &str, style: Style, is_joined: bool, points: Vec<ChartPoint>| Series {
        name: name.to_owned(),
        style,
        is_joined,
        has_markers: !is_joined,
        interval: Interval::Bars,
        points,
    };
    Chart {
        title: "Value V of a battery".to_owned(),
        x_label: match e_max {
            Some(_) => "battery, units".to_owned(),
            None => "battery, share of E_max".to_owned(),
        },
        y_label: "V, units of N r(k)".to_owned(),
        x,
        y,
        series: vec![
            series("as used by the policy", Style::from_palette(0), true, smoothed),
            series("as learned", Style::from_palette(1), false, learned_points),
        ],
        marks: Vec::new(),
        spans: Vec::new(),
        notes: Vec::new(),
        has_zero_at_border: false,
        caption: "Expected total reward of a device, with discount ζ. The policy smooths it so that it never falls \
            with the battery."
            .to_owned(),
    }
}

/// Describes the training of `set` in two sentences.
fn describe_training_of_set(learned: &LearnedTables, set: &TableSet) -> String {
    let (n, surface) = (set.devices, set.surface);
    format!(
        "{} {}",
        describe_training(learned, &[set.lookback], &format!("with N = {n} on {surface} m²")),
        describe_setting(learned)
    )
}

/// Describes the training of a file: version, weights, schedule and `lookbacks`. `scope` states for which devices and
/// area the episodes are.
pub(super) fn describe_training(learned: &LearnedTables, lookbacks: &[Lookback], scope: &str) -> String {
    let lengths: Vec<String> = lookbacks.iter().map(|lookback| lookback.describe()).collect();
    let (weights, schedule, training) = (learned.weights, &learned.schedule, &learned.training);
    let (first, last) = training.epsilon;
    format!(
        "Learned by {} for μ1 = {}, μ2 = {}, ζ = {} and {}, in {} episodes of {} TTIs {scope}, ε from \
         {first} to {last}, learning rate max((n + 4)^−{}, {}), optimism {}, seed {}{}.",
        learned.made_by,
        weights.mu1,
        weights.mu2,
        weights.zeta,
        lengths.join(", "),
        training.episodes,
        training.ttis,
        schedule.rate_decay,
        schedule.rate_floor,
        schedule.optimism,
        training.seed,
        learned
            .begun_from
            .as_ref()
            .map_or_else(String::new, |from| format!("; started from {from}")),
    )
}

/// Describes the training setting of a file in one sentence.
pub(super) fn describe_setting(learned: &LearnedTables) -> String {
    let words = learned.site.words.iter();
    let words = words.map(|(name, value)| format!("{name} = {value}"));
    let numbers = learned.site.numbers.iter();
    // To four decimals, without trailing zeros.
    let numbers = numbers.map(|(name, value)| format!("{name} = {}", (value * 1e4).round() / 1e4));
    let all: Vec<String> = words.chain(numbers).collect();
    format!("Setting: {}.", all.join(", "))
}

/// Formats the plotted data of the duty table as CSV. `advantage` is the number in the cell, `used` the smoothed one.
pub fn duty_csv(learned: &LearnedTables, set: &TableSet) -> String {
    let mut out = String::from(
        "bucket,battery_from,battery_to,area_from,area_to,q_sleep,visits_sleep,q_sense,visits_sense,\
         advantage,used,senses\n",
    );
    let (areas, batteries) = (
        area_limits(set.lookback),
        training_energies(learned).map(battery_limits),
    );
    let advantages = set.duty.advantages();
    for (battery, cells) in duty_map(learned, set).cells.iter().enumerate() {
        let range = batteries.map_or_else(
            || ",".to_owned(),
            |limits| format!("{},{}", limits[battery], limits[battery + 1]),
        );
        for (area, cell) in cells.iter().enumerate() {
            let [off, on] = [false, true].map(|delta| set.duty.at(battery, area, delta));
            let _ = writeln!(
                out,
                "{battery},{range},{},{},{},{},{},{},{},{},{}",
                areas[area],
                areas[area + 1],
                off.value,
                off.visits,
                on.value,
                on.visits,
                cell.value,
                advantages[battery][area],
                u8::from(cell.is_framed)
            );
        }
    }
    out
}

/// Formats V as CSV. Batteries are in units, or shares of E_max if the file does not hold it.
pub fn value_csv(learned: &LearnedTables, set: &TableSet) -> String {
    let mut out = String::from("battery,value,visits,used\n");
    let e_max = training_energies(learned).map_or(1.0, |[e_max, ..]| e_max);
    for (node, (cell, smoothed)) in set.duty.value.iter().zip(set.duty.values()).enumerate() {
        let battery = e_max * node as f64 / (VALUE_NODES - 1) as f64;
        let _ = writeln!(out, "{battery},{},{},{smoothed}", cell.value, cell.visits);
    }
    out
}

/// Returns the wake-up table of `set` for one ranking.
pub const fn wake_table(set: &TableSet, ranking: WakeUpRanking) -> &WakeTable {
    match ranking {
        WakeUpRanking::P42 => &set.wake_p42,
        WakeUpRanking::Posterior => &set.wake_posterior,
    }
}

/// Creates the heat map of the wake-up table for a bucket of the number of reports: bucket 0 is one report.
fn wake_map(table: &WakeTable, report_bucket: usize) -> HeatMap {
    let smoothed: [_; INFORMATION_BUCKETS] =
        std::array::from_fn(|information| table.monotone_q(information, report_bucket));
    let cell = |score: usize, information: usize| {
        let q_value = table.at([score, information, report_bucket]);
        HeatCell {
            value: q_value.value,
            knowledge: if q_value.visits == 0 {
                KnowledgeDegree::Unknown
            } else {
                KnowledgeDegree::Known
            },
            is_framed: smoothed[information][score] <= 0.0,
        }
    };
    let row = |score: usize| {
        (0..INFORMATION_BUCKETS)
            .map(|information| cell(score, information))
            .collect()
    };
    // As in `score_edge`: every other limit is a root between two halvings and has no label.
    let limit_label = |limit: usize| match SCORE_BUCKETS - limit {
        _ if limit == 0 => "0".to_owned(),
        0 => "1".to_owned(),
        roots if roots % 2 == 1 => String::new(),
        roots => format!("1/{}", 1_u32 << (roots / 2)),
    };
    HeatMap {
        x_label: "information so far Î / Ψ".to_owned(),
        y_label: "score of the best candidate / Ψ".to_owned(),
        columns: vec![(String::new(), INFORMATION_LIMITS.map(format_short).to_vec())],
        rows: RowLabels::Limits((0..=SCORE_BUCKETS).map(limit_label).collect()),
        cells: (0..SCORE_BUCKETS).map(row).collect(),
    }
}

/// Draws the wake-up table of `set` for `ranking`, with a panel for each number of reports.
pub fn wake_scene(learned: &LearnedTables, set: &TableSet, ranking: WakeUpRanking) -> Scene {
    let (table, name) = (wake_table(set, ranking), ranking.name());
    let title = format!("Value of a wake-up with N = {}, ranking {name}: Q", set.devices);
    let text = format!(
        "A cell is the BS's knowledge about an event: the score of the best candidate (rows, as a share of Ψ), the \
         information so far (columns) and the reports so far (panels). The number is the value of waking, in units of \
         N r*(k); the value of stopping is 0. Within the bold line the policy does not wake: there the number is not \
         positive after smoothing (never falling with the score). Cells that were never visited keep the optimistic \
         initial value. Colours follow the square root of the number, with one scale for all panels. {}",
        describe_training_of_set(learned, set)
    );
    let (mut scene, top) = titled_scene(title, text.clone());
    let maps: Vec<HeatMap> = (0..REPORT_BUCKETS).map(|bucket| wake_map(table, bucket)).collect();
    let scale_end = maps.iter().map(HeatMap::largest_magnitude).fold(0.0, f64::max);
    let panel_width = 0.5 * (PAGE_WIDTH - 2.0 * MARGIN - PANEL_GAP);
    let mut y = top;
    for (row, pair) in maps.chunks(2).enumerate() {
        let mut below = y;
        for (column, map) in pair.iter().enumerate() {
            let left = MARGIN + (panel_width + PANEL_GAP) * column as f64;
            let panel_name = match 2 * row + column {
                0 => "after 1 report".to_owned(),
                last if last + 1 == REPORT_BUCKETS => format!("after {REPORT_BUCKETS} or more reports"),
                report_bucket => format!("after {} reports", report_bucket + 1),
            };
            let at = (left + 0.5 * panel_width, y + 2.0);
            scene.text(Text::new(panel_name, at, TEXT_SIZE).anchored(super::scene::Anchor::Middle));
            below = map.draw(
                &mut scene,
                (left, y + LEADING),
                (panel_width, WAKE_ROW_HEIGHT),
                scale_end,
            );
        }
        y = below + 6.0;
    }
    y = draw_key(&mut scene, (MARGIN, y - 2.0), scale_end, "does not wake", None) + LEADING + 4.0;
    for line in wrap_text(&text, Weight::Regular, TEXT_SIZE, PAGE_WIDTH - 2.0 * MARGIN) {
        scene.text(Text::new(line, (MARGIN, y), TEXT_SIZE));
        y += LEADING;
    }
    scene.height = (y - LEADING + 0.24 * TEXT_SIZE + MARGIN).ceil();
    scene
}

/// Formats the plotted data of a wake-up table as CSV.
pub fn wake_csv(set: &TableSet, ranking: WakeUpRanking) -> String {
    let mut out = String::from("reports,score_from,score_to,information_from,information_to,q,visits,used,wakes\n");
    let (table, scores) = (wake_table(set, ranking), score_limits());
    for report_bucket in 0..REPORT_BUCKETS {
        for score in 0..SCORE_BUCKETS {
            for information in 0..INFORMATION_BUCKETS {
                let cell = table.at([score, information, report_bucket]);
                let used = table.monotone_q(information, report_bucket)[score];
                let _ = writeln!(
                    out,
                    "{},{},{},{},{},{},{},{used},{}",
                    report_bucket + 1,
                    scores[score],
                    scores[score + 1],
                    INFORMATION_LIMITS[information],
                    INFORMATION_LIMITS[information + 1],
                    cell.value,
                    cell.visits,
                    u8::from(used > 0.0)
                );
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use reveille_bs::policy::q_learning::learned::{battery_bucket, information_bucket, score_bucket};
    use reveille_bs::scenario::load;
    use reveille_common::units::Energy;

    use super::*;

    /// Checks that values just inside both limits of each bucket fall in that bucket.
    fn assert_limits(limits: &[f64], bucket: impl Fn(f64) -> usize) {
        for (index, pair) in limits.windows(2).enumerate() {
            let margin = 1e-4 * (pair[1] - pair[0]);
            assert_eq!(
                [bucket(pair[0] + margin), bucket(pair[1] - margin)],
                [index, index],
                "bucket {index}, limits {pair:?}"
            );
        }
    }

    #[test]
    fn drawn_limits_are_the_limits_of_the_buckets() {
        assert_limits(&INFORMATION_LIMITS, information_bucket);
        assert_limits(&score_limits(), score_bucket);
        for lookback in [Lookback::Window(1), Lookback::Ages] {
            assert_limits(&area_limits(lookback), |share| lookback.bucket(share));
        }
        let energy = load("paper", &[]).expect("a preset").scenario.classes[0].energy;
        let limits = battery_limits([energy.e_max, energy.e_idle, energy.e_tx].map(Energy::units));
        assert_limits(&limits, |level| {
            battery_bucket(Energy::from_units(level).expect("an energy"), &energy)
        });
    }

    #[test]
    fn limits_are_shortened() {
        let values = [0.0, 0.02, 0.5, 0.725, 1.524, 9.96, 25.833, 100.0, 0.010_053];
        assert_eq!(
            values.map(format_short),
            ["0", "0.02", "0.5", "0.72", "1.5", "10", "26", "100", "0.01"].map(str::to_owned)
        );
    }
}
