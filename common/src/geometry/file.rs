//! Positions and classes of devices from a layout file, for `layout.rs`. The scenario hash covers the values that are
//! used. The help of `layout.file` repeats the names of the columns `x`, `y` and `class`.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::{Area, Point};
use crate::columns::{self, ColumnData, MAX_FILE_BYTES};
use crate::declare::{FieldReader, FieldSink, FieldValue, ScenarioError, Section, did_you_mean, quoted_list, truncate};
use crate::digits::count_noun;

const FILE_FIELD: &str = "layout.file";

/// A layout from a file.
#[derive(Clone, Debug, PartialEq)]
pub struct FileLayout {
    /// The path of the file.
    pub path: PathBuf,
    /// Its first N points, N devices in the scenario.
    pub points: Arc<Vec<Point>>,
    /// The classes of the first N devices as indices into the scenario's classes, if the file has the column `class`.
    pub classes: Option<Arc<Vec<u16>>>,
}

impl FileLayout {
    /// Reads the first `devices` devices of `file`, which must all lie on `area`. The column `class` uses
    /// `class_names`, which is empty for a scenario without classes.
    pub(super) fn from_fields(
        reader: &FieldReader<'_>,
        file: &str,
        area: Area,
        devices: u32,
        class_names: &[&str],
    ) -> Result<Self, ScenarioError> {
        let path = reader.absolute_path(FILE_FIELD, file)?;
        let count = devices as usize;
        let points_and_classes = reader
            .read_bytes(&path, MAX_FILE_BYTES)
            .map_err(|error| error.to_string())
            .and_then(|bytes| {
                Ok((
                    read_points(&path, &bytes, area, count)?,
                    columns::read_texts(&path, &bytes, "class")?,
                ))
            });
        let ((points, points_in_file), class_column) = match points_and_classes {
            Ok(values) => values,
            Err(reason) => return Err(reader.file_error(FILE_FIELD, path, reason)),
        };
        if points_in_file > count {
            reader.warn(format!(
                "{} has {points_in_file} positions; the first {count} are used",
                path.display()
            ));
        }
        let classes = match class_column {
            Some(column) if !class_names.is_empty() => match class_indices(&column, class_names, count) {
                Ok(indices) => Some(Arc::new(indices)),
                Err(reason) => return Err(reader.file_error(FILE_FIELD, path, reason)),
            },
            Some(_) => {
                let notice = "has a column `class`, which has no effect without [[class]] in the scenario";
                reader.warn(format!("{} {notice}", path.display()));
                None
            }
            None => None,
        };
        Ok(Self {
            path,
            points: Arc::new(points),
            classes,
        })
    }

    /// Passes the file's name and the values used from it to `sink`.
    pub(super) fn visit(&self, sink: &mut dyn FieldSink, section: &'static Section) {
        let Some(field) = section.field("file") else { return };
        sink.field(section, field, FieldValue::Path(&self.path.to_string_lossy()));
        // Only the positions that are used are hashed, not the path or the rest of the file.
        let positions = self
            .points
            .iter()
            .flat_map(|point| [point.x.to_le_bytes(), point.y.to_le_bytes()]);
        sink.content(&positions.flatten().collect::<Vec<u8>>());
        if let Some(classes) = &self.classes {
            sink.content(
                &classes
                    .iter()
                    .flat_map(|class| class.to_le_bytes())
                    .collect::<Vec<u8>>(),
            );
        }
    }
}

/// Reads the first `count` points of a layout file, all within `area`, and the number of points in the file.
fn read_points(path: &Path, bytes: &[u8], area: Area, count: usize) -> Result<(Vec<Point>, usize), String> {
    let coordinates = columns::read_numbers(path, bytes, &["x".to_owned(), "y".to_owned()], 0..usize::MAX)?;
    let [xs, ys] = coordinates.values.as_slice() else {
        return Err("has no columns `x` and `y`".to_owned());
    };
    if xs.len() < count {
        return Err(format!(
            "has {}, too few for {}",
            count_noun(xs.len(), "point"),
            count_noun(count, "device")
        ));
    }
    let points: Vec<Point> = xs
        .iter()
        .zip(ys)
        .take(count)
        // Adding 0 turns -0 into 0, since -0 has another hash.
        .map(|(&x, &y)| Point::new(x + 0.0, y + 0.0))
        .collect();
    match points.iter().position(|&point| !area.contains(point)) {
        None => Ok((points, xs.len())),
        Some(row) => Err(format!(
            "{}: the point ({}, {}) lies outside the area of {} by {} metres",
            coordinates.describe_row(row),
            points[row].x,
            points[row].y,
            area.width,
            area.height
        )),
    }
}

/// The indices in `class_names` of the first `count` names in `column`.
fn class_indices(column: &ColumnData<String>, class_names: &[&str], count: usize) -> Result<Vec<u16>, String> {
    let class_index = |(row, name): (usize, &String)| {
        let index = class_names.iter().position(|class| class == name);
        // A scenario has at most MAX_CLASSES classes, so the index fits.
        index.map(|index| index as u16).ok_or_else(|| {
            format!(
                "{}, column `class`: the scenario has no class \"{}\"; its classes are {}{}",
                column.describe_row(row),
                truncate(name),
                quoted_list(class_names.iter().copied()),
                did_you_mean(name, class_names.iter().copied())
            )
        })
    };
    let names = column.values.first().into_iter().flatten();
    names.take(count).enumerate().map(class_index).collect()
}
