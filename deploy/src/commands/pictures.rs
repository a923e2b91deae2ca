//! Tables that pictures and reports are made of, and the files that they become.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use reveille_common::io::Disk;
use reveille_lab::io::replace;
use reveille_lab::table::Table;
use reveille_study::figures::results::Results;
use reveille_study::figures::scene::Scene;
use reveille_study::figures::{png, svg};

use crate::cli::{FormatArg, PictureArgs};
use crate::display;
use crate::paths::table_of;

/// Reads the tables and puts them together.
pub fn read(paths: &[PathBuf]) -> anyhow::Result<Results> {
    let read = |given: &PathBuf| -> anyhow::Result<(String, Table)> {
        let path = table_of(given)?;
        Ok((path.display().to_string(), Table::read(&path)?))
    };
    let tables = paths.iter().map(read).collect::<Result<Vec<_>, _>>()?;
    Ok(Results::new(&tables, &Disk)?)
}

/// Writes a picture in all formats asked for, and says where.
pub fn write(args: &PictureArgs, name: &str, scene: &Scene) -> anyhow::Result<()> {
    for format in &args.format {
        let (ending, bytes) = match format {
            FormatArg::Svg => ("svg", svg::svg(scene, name).into_bytes()),
            FormatArg::Png => ("png", png::png(scene)),
        };
        save(&args.out, &format!("{name}.{ending}"), &bytes)?;
    }
    Ok(())
}

/// Writes a file into `folder`, which is made if need be, and says so.
pub fn save(folder: &Path, name: &str, bytes: &[u8]) -> anyhow::Result<()> {
    fs::create_dir_all(folder).with_context(|| format!("{}: the folder cannot be made", folder.display()))?;
    let path = folder.join(name);
    replace(&path, bytes).with_context(|| format!("{}: cannot be written", path.display()))?;
    display::out(&format!("{}\n", path.display()))?;
    Ok(())
}
