//! `reveille merge`: merges the tables of shards into one. `lab/src/sweep/` merges; the result has the same bytes as
//! the table of a sweep without shards (`tests/program/sweep.rs`).

use std::path::Path;
use std::process::ExitCode;

use anyhow::{anyhow, bail};
use reveille_lab::sweep::merge;
use reveille_lab::table::{Format, Table};

use crate::cli::MergeArgs;
use crate::display;
use crate::paths::{is_same_path, resolve_table};

/// Merges tables.
pub(crate) fn run(args: &MergeArgs) -> anyhow::Result<ExitCode> {
    let format = table_format(&args.out)?;
    let mut tables = Vec::with_capacity(args.shards.len());
    for path_or_folder in &args.shards {
        let path =
            resolve_table(path_or_folder).map_err(|error| anyhow!("{error}; use --partial to merge without it"))?;
        // With --force the merged table would replace one of its parts.
        if is_same_path(&path, &args.out) {
            bail!(
                "--out {}: is one of the tables to merge; name another file",
                args.out.display()
            );
        }
        let table = Table::read(&path)?;
        tables.push((path, table));
    }
    let table = merge(tables, args.partial)?;
    if args.out.exists() && !args.force {
        bail!("{}: file exists; use --force to replace it", args.out.display());
    }
    table.write(&args.out, format)?;
    let shard_note = match &table.metadata.shard {
        Some(shards) => format!(", from shards {shards} only"),
        None => String::new(),
    };
    let runs = display::count_noun(table.rows.len(), "run");
    display::print_stdout(&format!("{runs} in {}{shard_note}\n", args.out.display()))?;
    Ok(ExitCode::SUCCESS)
}

/// Returns the format of the table at `out`, by the extension of the file.
fn table_format(out: &Path) -> anyhow::Result<Format> {
    let extension = out.extension().unwrap_or_default();
    let format = [Format::Parquet, Format::Csv]
        .into_iter()
        .find(|format| extension.eq_ignore_ascii_case(format.extension()));
    format.ok_or_else(|| anyhow!("--out {}: the file must end in .parquet or .csv", out.display()))
}
