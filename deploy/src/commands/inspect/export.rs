//! `reveille inspect export`: a recording as a file that other tools open.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, bail};
use reveille_common::message::Frame;
use reveille_view::export::dissector;
use reveille_view::export::pcapng::Packets;
use reveille_view::export::perfetto::Trace;
use reveille_view::export::table::{COLUMNS, Row, Rows};
use reveille_view::filter::Filter;
use reveille_view::recording::RecordingError;

use super::source::{Recording, open};
use crate::cli::{ExportArgs, ToArg};
use crate::display::{count, note, out};
use crate::exit::Exit;
use crate::paths::is_same;

/// Writes what is asked for.
pub fn run(args: &ExportArgs) -> anyhow::Result<ExitCode> {
    if let Some(path) = &args.dissector {
        free(path, args.force)?;
        std::fs::write(path, dissector::lua()).with_context(|| format!("cannot write {}", path.display()))?;
        out(&format!("{}\n", path.display()))?;
    }
    let (Some(from), Some(to)) = (&args.file, args.to) else {
        return Ok(Exit::Done.into());
    };
    let path = args.out.clone().unwrap_or_else(|| from.with_extension(to.ending()));
    let mut recording = open(from)?;
    free(&path, args.force)?;
    anyhow::ensure!(!is_same(from, &path), "{}: is the recording itself", path.display());
    // Half a file would be taken for a whole one, and what is replaced stays until there is something in its place.
    let part = PathBuf::from(format!("{}.part", path.display()));
    let file = File::create(&part).with_context(|| format!("cannot write {}", path.display()))?;
    let written = write(args, to, &mut recording, BufWriter::new(file)).with_context(|| from.display().to_string());
    let (frames, torn) = match written {
        Ok(written) => written,
        Err(error) => {
            let _gone = std::fs::remove_file(&part).is_ok();
            return Err(error);
        }
    };
    std::fs::rename(&part, &path).with_context(|| format!("cannot write {}", path.display()))?;
    note!("{}", count(frames, "message"));
    out(&format!("{}\n", path.display()))?;
    match torn {
        None => Ok(Exit::Done.into()),
        Some(error) => {
            bail!("{}: {error}; what is before is written", from.display());
        }
    }
}

/// Makes sure that there is nothing at `path`, or that it may be replaced.
fn free(path: &Path, force: bool) -> anyhow::Result<()> {
    if path.exists() && !force {
        bail!("{}: is there already; --force replaces it", path.display());
    }
    Ok(())
}

/// How many messages were written, and where the recording is torn, if it is.
type Written = (usize, Option<RecordingError>);

/// Writes the messages in the form `to`, up to a tear.
fn write(args: &ExportArgs, to: ToArg, recording: &mut Recording, out: BufWriter<File>) -> anyhow::Result<Written> {
    match to {
        ToArg::Pcapng => {
            let mut packets = Packets::begin(out)?;
            let frames = each(args, recording, |frame| Ok(packets.write(frame)?))?;
            packets.finish()?;
            Ok(frames)
        }
        ToArg::Perfetto => {
            if args.since.is_some() {
                bail!("--since: a trace begins with the run, as the states of devices follow from all that was before");
            }
            let scenario = recording.bundle().load()?;
            let mut trace = Trace::begin(out, recording.run(), &scenario, args.battery_every)?;
            let frames = each(args, recording, |frame| Ok(trace.write(frame)?))?;
            trace.finish()?;
            Ok(frames)
        }
        ToArg::Csv => {
            let mut rows = csv::Writer::from_writer(out);
            rows.write_record(COLUMNS)?;
            let frames = each(args, recording, |frame| Ok(rows.write_record(Row::of(frame).fields())?))?;
            rows.flush()?;
            Ok(frames)
        }
        ToArg::Parquet => {
            let mut rows = Rows::begin(out)?;
            let frames = each(args, recording, |frame| Ok(rows.write(Row::of(frame))?))?;
            rows.finish()?.flush()?;
            Ok(frames)
        }
    }
}

/// Hands on the frames that are asked for, up to a tear.
fn each(
    args: &ExportArgs,
    recording: &mut Recording,
    mut take: impl FnMut(&Frame) -> anyhow::Result<()>,
) -> anyhow::Result<Written> {
    let filter = Filter {
        ttis: Some(args.since.unwrap_or(0)..=args.until.unwrap_or(u64::MAX)),
        ..Filter::default()
    };
    recording.seek(filter.first())?;
    let mut frames = 0;
    loop {
        match recording.next_frame() {
            Ok(Some(frame)) if !filter.is_over(frame.tti) => {
                take(&frame)?;
                frames += 1;
            }
            Ok(_) => return Ok((frames, None)),
            Err(error) => return Ok((frames, Some(error))),
        }
    }
}
