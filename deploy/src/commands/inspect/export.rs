//! `reveille inspect export`: writes a recording in a format of other tools. `view/src/export/` defines the formats,
//! `cli::ExportFormatArg` their names and file extensions.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;
use std::process::ExitCode;

use anyhow::{Context, anyhow, bail};
use clap::ValueEnum as _;
use reveille_common::message::Frame;
use reveille_lab::io::open_part_file;
use reveille_view::export::device_rows::{self, DeviceRow, DeviceRows};
use reveille_view::export::dissector;
use reveille_view::export::pcapng::PacketWriter;
use reveille_view::export::perfetto::PerfettoWriter;
use reveille_view::export::table::{COLUMNS, MessageRow, MessageTableWriter};
use reveille_view::filter::Filter;
use reveille_view::recording::RecordingError;

use super::super::default_window;
use super::source::{RecordingFile, check_tti_range, find_recording, open_recording};
use crate::cli::{ExportArgs, ExportFormatArg};
use crate::display::{count_noun, note, print_stdout};
use crate::exit::{ExitReason, InvalidUsage};
use crate::paths::is_same_path;

/// Writes the requested file.
pub(super) fn run(args: &ExportArgs) -> anyhow::Result<ExitCode> {
    check_tti_range(args.since, args.until)?;
    let file = args
        .file
        .as_ref()
        .map(|path| Ok::<_, anyhow::Error>((path, chosen_format(args)?)))
        .transpose()?;
    if let Some(path) = &args.dissector {
        check_may_write(path, args.force)?;
        std::fs::write(path, dissector::lua_script()).with_context(|| format!("cannot write {}", path.display()))?;
        print_stdout(&format!("{}\n", path.display()))?;
    }
    let Some((given_path, format)) = file else {
        return Ok(ExitReason::Done.into());
    };
    let recording_path = &find_recording(given_path)?;
    let out_path = args
        .out
        .clone()
        .unwrap_or_else(|| recording_path.with_extension(format.extension()));
    let mut recording = open_recording(recording_path)?;
    check_may_write(&out_path, args.force)?;
    // With --force, `check_may_write` accepts every file, the recording itself included.
    anyhow::ensure!(
        !is_same_path(recording_path, &out_path),
        "--out {}: is the recording itself; name another file",
        out_path.display()
    );
    // Written to a part file: half an export looks whole, and the old file must stay until the new one is complete.
    let write_error = || format!("cannot write {}", out_path.display());
    let part = open_part_file(&out_path, |part| File::create(part)).with_context(write_error)?;
    let out_file = BufWriter::new(part.as_file());
    let (frame_count, torn) =
        write_format(args, format, &mut recording, out_file).with_context(|| recording_path.display().to_string())?;
    part.persist(&out_path)
        .map_err(|refused| refused.error)
        .with_context(write_error)?;
    note!("{}", count_noun(frame_count, "message"));
    print_stdout(&format!("{}\n", out_path.display()))?;
    match torn {
        None => Ok(ExitReason::Done.into()),
        Some(error) => {
            bail!(
                "{}: {error}; the messages before this point were written",
                recording_path.display()
            );
        }
    }
}

/// Returns the format that `--to` or the extension of `--out` names.
fn chosen_format(args: &ExportArgs) -> anyhow::Result<ExportFormatArg> {
    if let Some(format) = args.to {
        return Ok(format);
    }
    let Some(out) = &args.out else {
        bail!(InvalidUsage(
            "--to FORMAT or --out FILE is required with a recording".to_owned()
        ));
    };
    let name = out.to_string_lossy();
    let has_extension = |format: &&ExportFormatArg| name.ends_with(&format!(".{}", format.extension()));
    // The last match is the longest: `devices.csv` comes after `csv`.
    let mut formats = ExportFormatArg::value_variants().iter();
    formats.rfind(has_extension).copied().ok_or_else(|| {
        let extensions: Vec<&str> = ExportFormatArg::value_variants()
            .iter()
            .map(|format| format.extension())
            .collect();
        anyhow!(InvalidUsage(format!(
            "--out {}: the extension names no format; use one of {}, or choose the format with --to",
            out.display(),
            extensions.join(", ")
        )))
    })
}

/// Checks that `path` is free, or may be replaced.
fn check_may_write(path: &Path, force: bool) -> anyhow::Result<()> {
    if path.exists() && !force {
        bail!("{}: file exists; use --force to replace it", path.display());
    }
    Ok(())
}

/// The number of written messages, and the error at which the recording is torn, if it is.
type ExportResult = (usize, Option<RecordingError>);

/// Writes the messages in this `format`, up to a tear. Each branch must flush `out`, whose drop ignores errors.
fn write_format(
    args: &ExportArgs,
    format: ExportFormatArg,
    recording: &mut RecordingFile,
    out: BufWriter<&File>,
) -> anyhow::Result<ExportResult> {
    match format {
        ExportFormatArg::Pcapng => {
            let mut packets = PacketWriter::begin(out)?;
            let result = for_each_frame(args, recording, |frame| Ok(packets.write(frame)?))?;
            packets.finish()?;
            Ok(result)
        }
        ExportFormatArg::Perfetto => {
            check_starts_at_zero(args, "a trace")?;
            let scenario = recording.bundle().load()?;
            let mut trace = PerfettoWriter::begin(out, recording.run(), &scenario, args.battery_every)?;
            let result = for_each_frame(args, recording, |frame| Ok(trace.write(frame)?))?;
            trace.finish()?;
            Ok(result)
        }
        ExportFormatArg::Csv => {
            let mut rows = csv::Writer::from_writer(out);
            rows.write_record(COLUMNS)?;
            let result = for_each_frame(args, recording, |frame| {
                Ok(rows.write_record(MessageRow::new(frame).csv_fields())?)
            })?;
            rows.flush()?;
            Ok(result)
        }
        ExportFormatArg::Parquet => {
            let mut rows = MessageTableWriter::begin(out)?;
            let result = for_each_frame(args, recording, |frame| Ok(rows.write(MessageRow::new(frame))?))?;
            rows.finish()?.flush()?;
            Ok(result)
        }
        ExportFormatArg::Devices => {
            check_starts_at_zero(args, "a table of devices")?;
            let scenario = recording.bundle().load()?;
            let interval = args.every.unwrap_or_else(|| default_window(&scenario));
            let mut table = csv::Writer::from_writer(out);
            table.write_record(device_rows::COLUMNS)?;
            let mut rows = DeviceRows::new(&scenario, interval);
            // A grant that begins before the last TTI can end after it.
            let is_late = |row: &DeviceRow| args.until.is_some_and(|until| row.tti.0 > until);
            let mut write_row = |row: DeviceRow| {
                if !is_late(&row) {
                    table.write_record(row.csv_fields())?;
                }
                anyhow::Ok(())
            };
            let result = for_each_frame(args, recording, |frame| rows.apply(frame, &mut write_row))?;
            rows.finish(&mut write_row)?;
            table.flush()?;
            Ok(result)
        }
    }
}

/// Checks that an export whose device states depend on all earlier messages starts at TTI 0.
fn check_starts_at_zero(args: &ExportArgs, content: &str) -> anyhow::Result<()> {
    anyhow::ensure!(
        args.since.is_none(),
        "--since: {content} must start at TTI 0, as device states depend on all earlier messages; leave it out"
    );
    Ok(())
}

/// Passes the frames of the requested TTIs to `on_frame`, up to a tear.
fn for_each_frame(
    args: &ExportArgs,
    recording: &mut RecordingFile,
    mut on_frame: impl FnMut(&Frame) -> anyhow::Result<()>,
) -> anyhow::Result<ExportResult> {
    let filter = Filter {
        ttis: Some(args.since.unwrap_or(0)..=args.until.unwrap_or(u64::MAX)),
        ..Filter::default()
    };
    recording.seek(filter.first_tti())?;
    let mut frame_count = 0;
    loop {
        match recording.next_frame() {
            Ok(Some(frame)) if !filter.is_over(frame.tti) => {
                on_frame(&frame)?;
                frame_count += 1;
            }
            Ok(_) => return Ok((frame_count, None)),
            Err(error) => return Ok((frame_count, Some(error))),
        }
    }
}
