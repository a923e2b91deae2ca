//! Input tables and output files of the commands `figures` and `report`; `compare` reads tables here too. Standard
//! output has one path per written file.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use reveille_common::io::Disk;
use reveille_lab::io::replace;
use reveille_lab::table::Table;
use reveille_study::figures::results::Results;
use reveille_study::figures::scene::Scene;
use reveille_study::figures::{png, svg};

use crate::cli::{FigureOutputArgs, ImageFormatArg};
use crate::display;
use crate::paths::{check_output_folder, resolve_table};

/// Reads the tables and combines them.
pub(super) fn read_tables(paths: &[PathBuf]) -> anyhow::Result<Results> {
    Ok(Results::new(&read_named_tables(paths)?, &Disk)?)
}

/// Reads the tables. Each has its path as its name; a folder stands for the table of its sweep.
pub(super) fn read_named_tables(paths: &[PathBuf]) -> anyhow::Result<Vec<(String, Table)>> {
    let read = |path: &PathBuf| -> anyhow::Result<(String, Table)> {
        let path = resolve_table(path)?;
        Ok((path.display().to_string(), Table::read(&path)?))
    };
    paths.iter().map(read).collect()
}

/// Writes a picture in all requested formats, and prints the paths. `name` is the file name without its extension, and
/// part of the identifiers in the SVG: letters, digits and `-` only.
pub(super) fn write_picture(args: &FigureOutputArgs, name: &str, scene: &Scene) -> anyhow::Result<()> {
    for format in &args.format {
        let (extension, bytes) = match format {
            ImageFormatArg::Svg => ("svg", svg::svg(scene, name).into_bytes()),
            ImageFormatArg::Png => ("png", png::png(scene)),
        };
        write_file(&args.out, &format!("{name}.{extension}"), &bytes)?;
    }
    Ok(())
}

/// Writes a file to `folder`, which is created if needed, and prints its path.
pub(super) fn write_file(folder: &Path, name: &str, bytes: &[u8]) -> anyhow::Result<()> {
    check_output_folder("--out", folder)?;
    fs::create_dir_all(folder).with_context(|| format!("{}: cannot create this folder", folder.display()))?;
    let path = folder.join(name);
    replace(&path, bytes).with_context(|| format!("{}: cannot write this file", path.display()))?;
    display::print_stdout(&format!("{}\n", path.display()))?;
    Ok(())
}
