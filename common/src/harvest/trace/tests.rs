//! Tests of the reading of traces, and of their start, end and row limit in whole scenarios.

use std::cell::RefCell;
use std::fmt::Write as _;
use std::path::Path;

use super::*;
use crate::harvest::testing::{draw_mean_harvests, trace_fields};
use crate::scenario::testing::{load, load_with, scenario_with};

fn ghi_column(text: &str) -> ColumnData<f64> {
    columns::read_numbers(Path::new("t.csv"), text.as_bytes(), &["ghi".to_owned()], 0..usize::MAX).expect("a column")
}

/// Scales a column of the trace `text`. Returns its energies, or the error, and the warnings.
fn scale_column(text: &str, scale: f64) -> (Result<Vec<Vec<Energy>>, String>, Vec<String>) {
    let warnings = RefCell::new(Vec::new());
    let energies = scale_to_energy(&ghi_column(text), &["ghi".to_owned()], scale, &|text| {
        warnings.borrow_mut().push(text);
    });
    (energies, warnings.into_inner())
}

#[test]
fn values_are_scaled_to_micro_units() {
    let (values, warnings) = scale_column("ghi\n0\n500\n", 0.002);
    assert_eq!(values.expect("valid"), [[Energy::ZERO, Energy::from_micro(1_000_000)]]);
    assert_eq!(warnings, [""; 0]);
}

#[test]
fn a_mean_that_changes_by_rounding_is_warned_of() {
    // Values below half a micro-unit become 0, and others keep the mean.
    let (values, warnings) = scale_column("ghi\n1\n3\n", 4e-7);
    assert_eq!(values.expect("valid"), [[Energy::ZERO, Energy::from_micro(1)]]);
    let expected = "the mean of column `ghi` of the trace changes from 0.0000008 to 0.0000005 per TTI, since energies";
    assert!(warnings.len() == 1 && warnings[0].starts_with(expected), "{warnings:?}");
    assert_eq!(scale_column("ghi\n1\n999\n", 4e-7).1, [""; 0]);
}

#[test]
fn a_negative_irradiance_is_refused_with_its_line() {
    let panel = Panel {
        area_cm2: 10.0,
        efficiency: 0.1,
        unit_mj: 1.0,
        tti_seconds: 60.0,
        row_seconds: 60.0,
    };
    let names = ["ghi".to_owned()];
    let reason =
        convert_irradiance(&panel, &ghi_column("ghi\n1\n-3\n"), &names, TraceEnd::Cycle, 1).expect_err("negative");
    assert!(
        reason.starts_with("line 3, column `ghi`: the irradiance -3 W/m² must be"),
        "{reason}"
    );
    // 10 cm² at a tenth: 1 W/m² is 0.1 mJ a second.
    let rows = convert_irradiance(&panel, &ghi_column("ghi\n2\n2\n"), &names, TraceEnd::Stop, 1).expect("valid");
    assert_eq!(rows, [[Energy::from_micro(12_000_000); 2]]);
}

#[test]
fn a_negative_value_is_refused_with_its_line() {
    let reason = scale_column("ghi\n1\n-3\n", 1.0).0.expect_err("negative");
    assert!(reason.starts_with("line 3, column `ghi`: -3 times"), "{reason}");
}

/// The second calculation reads the rows of the file TTI by TTI.
#[test]
fn a_trace_starts_at_the_given_row_and_then_repeats_or_stops() {
    // The columns `a`, `b` and `c` of `trace_fields`. A row lasts 4 TTIs, and device i reads column i mod 3.
    let columns = [[1.0, 2.0, 0.0], [0.0, 0.0, 0.0], [7.0, 0.0, 3.0]];
    let unshifted_hash = |end: &str| scenario_with(&trace_fields("hash", end)).hash_hex();
    for end in ["cycle", "stop"] {
        for start in 0..3_usize {
            let mut fields = trace_fields(&format!("start-{end}"), end);
            fields.extend(["ttis=31".to_owned(), format!("harvest.trace.start={start}")]);
            let scenario = scenario_with(&fields);
            let drawn_means = draw_mean_harvests(&scenario);
            for (device, drawn_mean) in drawn_means.iter().enumerate() {
                let harvest_in = |tti: usize| {
                    let row = start + tti / 4;
                    match end {
                        "stop" if row > 2 => 0.0,
                        _ => columns[device % 3][row % 3],
                    }
                };
                let expected = (0..31).map(harvest_in).sum::<f64>() / 31.0;
                assert!(
                    (drawn_mean - expected).abs() < 1e-12,
                    "{end} from row {start}, device {device}: {drawn_mean}"
                );
                let declared = &scenario.classes[0].harvest;
                if device == 0 {
                    // The base station knows the mean of the rows that are used, not that a trace stops.
                    let row_count = if end == "stop" { 3 - start } else { 3 };
                    let sum: f64 = columns[0][3 - row_count..].iter().sum();
                    let known = sum / row_count as f64;
                    let mean = declared.mean(1.0).units();
                    assert!(
                        (mean - known).abs() < 1e-6,
                        "{end} from row {start}: mean {mean}, not {known}"
                    );
                }
            }
            let toml = scenario.to_toml();
            assert_eq!(toml.contains("\nstart = "), start > 0, "{toml}");
            let file = std::env::temp_dir().join(format!("reveille-start-{end}-{}.toml", std::process::id()));
            std::fs::write(&file, toml).expect("a file");
            let reloaded = load(&file.to_string_lossy(), &[]).expect("a scenario");
            assert_eq!(reloaded, scenario, "{end} from row {start}");
        }
        let mut from_row_0 = trace_fields("hash", end);
        from_row_0.push("harvest.trace.start=0".to_owned());
        assert_eq!(scenario_with(&from_row_0).hash_hex(), unshifted_hash(end));
    }
}

#[test]
fn a_start_after_the_last_row_is_refused() {
    let mut fields = trace_fields("late", "cycle");
    fields.push("harvest.trace.start=3".to_owned());
    let error = load_with(&fields).expect_err("too late").to_string();
    assert!(
        error.contains("harvest.trace.start = 3: must be below 3, the number of rows of "),
        "{error}"
    );
}

/// The file has 10 020 rows, and the list names its column 1000 times: more than the 10⁷ values that are kept
/// (`MAX_VALUES` in `columns/data.rs`).
#[test]
fn a_trace_with_too_many_rows_is_read_in_part() {
    let path = std::env::temp_dir().join(format!("reveille-long-{}.csv", std::process::id()));
    let rows = 10_020;
    let mut text = String::from("w\n");
    for row in 0..rows {
        // Row 9990 holds 0, the next one 1, and so on; the rows before them hold 5.
        let value = if row < 9_990 { 5 } else { row - 9_990 };
        writeln!(text, "{value}").expect("a String can be written");
    }
    std::fs::write(&path, text).expect("a file");
    let file = format!("harvest.trace.file={}", path.display());
    let load_from = |start: u64, ttis: u64, end: &str| {
        load_with(&[
            "harvest.kind=trace".to_owned(),
            file.clone(),
            format!("harvest.trace.columns=[{}]", vec!["\"w\""; 1000].join(",")),
            format!("harvest.trace.start={start}"),
            format!("ttis={ttis}"),
            format!("harvest.trace.end={end}"),
            "devices=1".to_owned(),
        ])
    };
    let middle = load_from(9_995, 10, "cycle").expect("a scenario");
    let read = middle.classes[0].harvest.trace_columns()[0]
        .iter()
        .map(|energy| energy.units());
    assert_eq!(read.collect::<Vec<f64>>(), (5..15).map(f64::from).collect::<Vec<f64>>());
    assert_eq!(draw_mean_harvests(&middle), [9.5]);
    let end = load_from(10_015, 10, "stop").expect("a scenario");
    assert_eq!(draw_mean_harvests(&end), [(25.0 + 26.0 + 27.0 + 28.0 + 29.0) / 10.0]);
    let error = load_from(10_015, 10, "cycle")
        .expect_err("too late to repeat")
        .to_string();
    assert!(
        error.contains("the run needs 10 rows from row 10015 on, and 5 follow"),
        "{error}"
    );
    let error = load_from(0, 10_001, "stop").expect_err("too many rows").to_string();
    assert!(
        error.contains("has more than 10000000 values in 1000 columns"),
        "{error}"
    );
    std::fs::remove_file(&path).expect("removed");
}
