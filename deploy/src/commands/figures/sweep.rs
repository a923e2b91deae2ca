//! `reveille figures sweep`: pictures of anybody's own sweep.

use std::process::ExitCode;

use reveille_study::figures::sweep::{Wish, named, several};

use super::super::pictures::{read, save, write};
use crate::cli::{AxisArg, SweepFigureArgs};
use crate::display::note;

/// Draws a metric against a field, a picture for each combination of the other fields.
pub fn run(args: &SweepFigureArgs) -> anyhow::Result<ExitCode> {
    let results = read(&args.tables)?;
    let only = args.only.iter();
    let wish = Wish {
        x: named(&args.x).to_owned(),
        y: args.y.clone(),
        by: named(&args.by).to_owned(),
        only: only
            .map(|(field, value)| (named(field).to_owned(), value.clone()))
            .collect(),
        is_log_x: args.log.contains(&AxisArg::X),
        is_log_y: args.log.contains(&AxisArg::Y),
    };
    let pictures = wish.draw(&results)?;
    if let Some(words) = several(&pictures) {
        note!("{words}; --where FIELD=VALUE chooses");
    }
    for picture in &pictures {
        let name = wish.name(&picture.facet);
        for line in &picture.undefined {
            note!("{name}: without {line}, none of whose runs has a value of {}", wish.y);
        }
        write(&args.pictures, &name, &picture.chart.scene())?;
        save(&args.pictures.out, &format!("{name}.csv"), picture.csv.as_bytes())?;
    }
    Ok(ExitCode::SUCCESS)
}
