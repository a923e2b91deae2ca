//! `reveille merge`: one table of the tables of shards.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::bail;
use reveille_lab::sweep::merge;
use reveille_lab::table::{Format, Table};

use crate::cli::MergeArgs;
use crate::display;

/// Merges tables.
pub fn run(args: &MergeArgs) -> anyhow::Result<ExitCode> {
    let mut tables = Vec::with_capacity(args.shards.len());
    for given in &args.shards {
        let path = table_of(given)?;
        if is_same(&path, &args.out) {
            bail!(
                "--out {}: is one of the tables to merge, which would be lost; name another file",
                args.out.display()
            );
        }
        let table = Table::read(&path)?;
        tables.push((path, table));
    }
    let table = merge(tables, args.partial)?;
    table.write(&args.out, Format::of(&args.out))?;
    let part = match &table.about.shard {
        Some(shards) => format!(", of shards {shards} alone"),
        None => String::new(),
    };
    let runs = display::count(table.rows.len(), "run");
    display::out(&format!("{runs} in {}{part}\n", args.out.display()))?;
    Ok(ExitCode::SUCCESS)
}

/// Whether both paths lead to one file.
fn is_same(a: &Path, b: &Path) -> bool {
    match (a.canonicalize(), b.canonicalize()) {
        (Ok(a), Ok(b)) => a == b,
        (Err(_), _) | (_, Err(_)) => false,
    }
}

/// The table in the folder of a sweep, or the file that is named.
fn table_of(given: &Path) -> anyhow::Result<PathBuf> {
    if !given.is_dir() {
        return Ok(given.to_owned());
    }
    let found = [Format::Parquet, Format::Csv]
        .map(|format| given.join(format!("results.{}", format.ending())))
        .into_iter()
        .find(|path| path.exists());
    match found {
        Some(path) => Ok(path),
        None if given.join("runs.journal").exists() => bail!(
            "{}: its sweep is not finished; give its command again, or merge the others with --partial",
            given.display()
        ),
        None => bail!("{}: the folder holds no table of a sweep", given.display()),
    }
}
