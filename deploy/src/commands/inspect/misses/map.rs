//! The map of missed events and devices in the report of `inspect misses`.

use std::fmt::Write as _;

use reveille_study::misses::MissMap;

use crate::display::WIDTH;

/// Mark of a device that actions failed, and of cells with such devices.
pub(super) const FAILED_MARK: char = '×';

/// Formats missed events and devices by place, next to each other and north up.
pub(super) fn format_map(map: &MissMap) -> String {
    let digits = map
        .missed_counts
        .iter()
        .chain(&map.device_counts)
        .flatten()
        .max()
        .map_or(1, |most| most.to_string().len());
    let format_cell = |count: &u64| match count {
        0 => format!("{:>width$}", "·", width = digits + 1),
        _ => format!("{count:>width$}", width = digits + 1),
    };
    let format_height = |row: usize| {
        format!("{:.4}", row as f64 * map.cell_m)
            .trim_end_matches('0')
            .trim_end_matches('.')
            .to_owned()
    };
    let label_width = format_height(map.missed_counts.len()).chars().count().max(4);
    let map_width = map.columns * (digits + 1);
    // Wide counts leave no room in one line for both maps, with their frames and the gap of fewer than 8 columns.
    let is_joint = label_width + 2 * map_width + 8 <= WIDTH;
    let title = format!(
        "Missed events and devices by place: cells of {0} m × {0} m, north up",
        format_height(1)
    );
    let format_missed = |row: usize| -> String { map.missed_counts[row].iter().map(format_cell).collect() };
    let format_row = |row: usize, cells: &str| format!("{:>label_width$} │{cells}", format_height(row));
    let has_failed = map.failed_counts.iter().flatten().any(|count| *count > 0);
    let format_devices = |row: usize| -> String {
        let cells = map.device_counts[row].iter().zip(&map.failed_counts[row]);
        let format_marked = |(count, failed): (&u64, &u64)| match failed {
            0 => format_cell(count),
            _ => format!("{:>width$}", format!("{FAILED_MARK}{count}"), width = digits + 1),
        };
        cells.map(format_marked).collect()
    };
    let legend = if has_failed {
        format!("{FAILED_MARK}: cells with devices that actions failed\n")
    } else {
        String::new()
    };
    let rows = (0..map.missed_counts.len()).rev();
    let heads = ["missed", "devices"].map(|head| format!("{head:<map_width$}"));
    let mut text = title + "\n";
    if is_joint {
        let _infallible = writeln!(text, "{:>label_width$}  {}     {}", "m", heads[0], heads[1].trim_end());
        for row in rows {
            let _infallible = writeln!(
                text,
                "{}    │{}",
                format_row(row, &format_missed(row)),
                format_devices(row)
            );
        }
        return text + &legend;
    }
    let columns: [&dyn Fn(usize) -> String; 2] = [&format_missed, &format_devices];
    for (head, format_cells) in heads.iter().zip(columns) {
        let _infallible = writeln!(text, "{:>label_width$}  {}", "m", head.trim_end());
        for row in rows.clone() {
            let _infallible = writeln!(text, "{}", format_row(row, &format_cells(row)));
        }
    }
    text + &legend
}
