//! `reveille inspect stats`: numbers and bytes of messages. Programs of users read the keys of `--json`, so do not
//! rename them. The text fits 80 columns (`tests/program/widths.rs`).

use std::io::IsTerminal;
use std::process::ExitCode;
use std::time::Duration;

use comfy_table::presets::UTF8_FULL_CONDENSED;
use comfy_table::{CellAlignment, Table};
use reveille_common::ids::Tti;
use reveille_common::message::{MessageKind, Plane};
use reveille_view::traffic::{MessageCount, TrafficStats};
use serde_json::{Value, json};

use super::source::{FrameSource, check_tti_range};
use crate::cli::StatsArgs;
use crate::display::{WIDTH, count_noun, note, print_stdout, wrap_text};
use crate::exit::ExitReason;

/// Time between two tables with `--watch`; without it there is only the table at the end.
const WATCH_INTERVAL: Duration = Duration::from_secs(1);

/// Counts the messages of the TTIs from `--since` to `--until`, until the run or recording ends or a signal arrives.
pub(super) async fn run(args: &StatsArgs) -> anyhow::Result<ExitCode> {
    check_tti_range(args.since, args.until)?;
    let mut source = FrameSource::open(args.file.as_deref(), &args.target).await?;
    let device_count = source.bundle().await?.load()?.run.devices;
    // Without a seek, which would skip a grant that begins before `--since`.
    source.report_position();
    let mut traffic = TrafficStats::within(Tti(args.since.unwrap_or(0)), args.until.map(Tti));
    let mut last_shown = crate::runtime::now();
    let torn = loop {
        match source.next().await {
            Ok(Some((frames, _))) => frames.iter().for_each(|frame| traffic.count(frame)),
            Ok(None) => break None,
            Err(error) => break Some(error),
        }
        if args.watch && last_shown.elapsed() >= WATCH_INTERVAL {
            // Control codes belong on a screen, not in a file.
            let clear_screen = if std::io::stdout().is_terminal() {
                "\u{1b}[2J\u{1b}[H"
            } else {
                ""
            };
            print_stdout(&format!(
                "{clear_screen}{}\n",
                format_stats(args, &traffic, device_count)
            ))?;
            last_shown = crate::runtime::now();
        }
    };
    print_stdout(&format!("{}\n", format_stats(args, &traffic, device_count)))?;
    if let FrameSource::Live(live) = &source
        && live.dropped_frames() > 0
    {
        note!(
            "{} dropped and not counted (reader too slow)",
            count_noun(live.dropped_frames(), "message")
        );
    }
    source.close().await;
    torn.map_or_else(|| Ok(ExitReason::Done.into()), Err)
}

/// Formats the statistics of a run with `device_count` devices; `args.devices` adds a row for each device.
fn format_stats(args: &StatsArgs, traffic: &TrafficStats, device_count: u32) -> String {
    if args.json {
        json_stats(traffic, device_count, args.devices).to_string()
    } else {
        text_stats(traffic, device_count, args.devices)
    }
}

fn json_stats(traffic: &TrafficStats, device_count: u32, by_device: bool) -> Value {
    let kinds = traffic.kinds().map(|(kind, count)| {
        json!({ "kind": kind.name(), "plane": kind.plane().name(), "messages": count.messages, "bytes": count.bytes })
    });
    let mut output = json!({
        "n": device_count,
        "ttis": traffic.ttis(),
        "kinds": kinds.collect::<Vec<_>>(),
        "control": traffic.control(),
        "uplink": traffic.uplink(),
        "control_share_of_air_bytes": traffic.control_share(),
    });
    if by_device {
        let device_json = |(device, kinds): (_, &std::collections::BTreeMap<MessageKind, MessageCount>)| {
            let kinds = kinds.iter().map(|(kind, count)| (kind.name().to_owned(), json!(count)));
            json!({ "device": device, "kinds": kinds.collect::<serde_json::Map<_, _>>() })
        };
        output["devices"] = traffic.devices().map(device_json).collect();
    }
    output
}

fn text_stats(traffic: &TrafficStats, device_count: u32, by_device: bool) -> String {
    let ttis = traffic.ttis().max(1) as f64;
    let mut table = Table::new();
    // Units below the quantities, so that large counts fit into 80 columns.
    let header = [
        "kind",
        "plane",
        "messages",
        "bytes",
        "messages\nper TTI",
        "bytes\nper TTI",
        "bytes per TTI\nand device",
    ];
    table.load_style(UTF8_FULL_CONDENSED).set_header(header);
    for column in table.column_iter_mut() {
        column.set_padding((0, 0));
    }
    let row = |name: &str, plane: &str, count: MessageCount| {
        let bytes_per_tti = count.bytes as f64 / ttis;
        [
            name.to_owned(),
            plane.to_owned(),
            count.messages.to_string(),
            count.bytes.to_string(),
            format!("{:.3}", count.messages as f64 / ttis),
            format!("{bytes_per_tti:.2}"),
            format!("{:.4}", bytes_per_tti / f64::from(device_count.max(1))),
        ]
    };
    for (kind, count) in traffic.kinds() {
        table.add_row(row(kind.name(), kind.plane().name(), count));
    }
    for plane in Plane::ALL {
        table.add_row(row("all", plane.name(), traffic.plane(plane)));
    }
    for column in table.column_iter_mut().skip(2) {
        column.set_cell_alignment(CellAlignment::Right);
    }
    let span = traffic.tti_range().map_or_else(
        || "no TTIs".to_owned(),
        |(first, last)| format!("TTIs {first} to {last}, {}", count_noun(device_count, "device")),
    );
    let mut output = vec![format!("{span}\n{table}")];
    if let Some(share) = traffic.control_share() {
        let control = traffic.control();
        let line = format!(
            "control: {} and {}, {:.2} bytes a TTI, {:.1} % of all bytes on the air",
            count_noun(traffic.kind(MessageKind::Plan).messages as usize, "plan"),
            count_noun(traffic.kind(MessageKind::Wake).messages as usize, "wake-up"),
            control.bytes as f64 / ttis,
            100.0 * share
        );
        output.push(wrap_text(&line, WIDTH));
    }
    if by_device {
        output.push(device_table(traffic).to_string());
    }
    output.join("\n")
}

fn device_table(traffic: &TrafficStats) -> Table {
    let mut table = Table::new();
    table.load_style(UTF8_FULL_CONDENSED).set_header([
        "device",
        "wake-ups",
        "woken or not",
        "reports",
        "report bytes",
        "failed",
    ]);
    for (device, kinds) in traffic.devices() {
        let count_of = |kind| kinds.get(&kind).copied().unwrap_or_default();
        table.add_row([
            device.to_string(),
            count_of(MessageKind::Wake).messages.to_string(),
            count_of(MessageKind::Woken).messages.to_string(),
            count_of(MessageKind::Report).messages.to_string(),
            count_of(MessageKind::Report).bytes.to_string(),
            count_of(MessageKind::Failed).messages.to_string(),
        ]);
    }
    for column in table.column_iter_mut() {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}
