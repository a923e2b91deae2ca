//! Checks of single values, with errors that say where the value was set.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use super::error::{Place, ScenarioError};
use super::layers::Places;
use crate::units::{Energy, MAX_UNITS};

/// The section of a field: its path in [`Places`], how a user knows it, and the section that it falls back on.
#[derive(Clone, Debug)]
pub(super) struct Section {
    path: String,
    shown: String,
    fallback: Option<&'static str>,
}

impl Section {
    /// A top-level section; "" is the top level itself.
    pub(super) fn top(name: &'static str) -> Self {
        Self {
            path: name.to_owned(),
            shown: name.to_owned(),
            fallback: None,
        }
    }

    /// The `index`-th class, known to the user as `shown`.
    pub(super) fn class(index: usize, shown: &str) -> Self {
        Self {
            path: format!("class.{index}"),
            shown: format!("class.{shown}"),
            fallback: None,
        }
    }

    /// A section of a class, which takes what it leaves out from the top-level section `name`.
    pub(super) fn within(&self, name: &'static str) -> Self {
        Self {
            path: format!("{}.{name}", self.path),
            shown: format!("{}.{name}", self.shown),
            fallback: Some(name),
        }
    }
}

/// Looks values up in the memory of the layers and refuses what is out of range.
pub(super) struct Checker<'a> {
    places: &'a Places,
    base_dir: &'a Path,
}

/// A range of floats in words and as a test.
pub(super) type Range = (&'static str, fn(f64) -> bool);

/// Above 0, and not so large that squares and sums overflow.
pub(super) const POSITIVE: Range = ("must be greater than 0 and at most 1000000", |x| x > 0.0 && x <= 1e6);
/// 0 or more, likewise.
pub(super) const NOT_NEGATIVE: Range = ("must be at least 0 and at most 1000000", |x| (0.0..=1e6).contains(&x));
/// A share that may be 0 but not 1.
pub(super) const BELOW_ONE: Range = ("must be at least 0 and less than 1", |x| (0.0..1.0).contains(&x));
/// A share or probability that may be 1 but not 0.
pub(super) const ABOVE_ZERO: Range = ("must be greater than 0 and at most 1", |x| x > 0.0 && x <= 1.0);

impl<'a> Checker<'a> {
    /// A checker for files relative to `base_dir`.
    pub(super) const fn new(places: &'a Places, base_dir: &'a Path) -> Self {
        Self { places, base_dir }
    }

    /// The full path of a field as the user knows it, and where it was set.
    pub(super) fn locate(&self, section: &Section, name: &str) -> (String, Place) {
        let own = self.places.get(&dotted(&section.path, name));
        let inherited = section.fallback.map(|fallback| dotted(fallback, name));
        match (own, inherited) {
            (None, Some(path)) if self.places.contains_key(&path) => {
                let place = self.places.get(&path).cloned();
                (path, place.unwrap_or(Place::Nowhere))
            }
            (own, _) => (dotted(&section.shown, name), own.cloned().unwrap_or(Place::Nowhere)),
        }
    }

    /// The error of a value that may not be.
    pub(super) fn refuse(
        &self,
        section: &Section,
        name: &str,
        value: impl Display,
        allowed: impl Into<String>,
    ) -> ScenarioError {
        let (field, place) = self.locate(section, name);
        ScenarioError::Invalid {
            field,
            value: super::error::shortened(&value.to_string()),
            allowed: allowed.into(),
            place,
        }
    }

    /// A value that has to be there because of the field `(section, because)`.
    pub(super) fn need<T>(
        &self,
        section: &Section,
        name: &str,
        value: Option<T>,
        because: &str,
    ) -> Result<T, ScenarioError> {
        value.ok_or_else(|| {
            let (reason, place) = self.locate(section, because);
            let (field, _) = self.locate(section, name);
            ScenarioError::Missing {
                field,
                why: format!("because of {reason}, {place}"),
            }
        })
    }

    /// Refuses a field of this very section that has an effect only where `holds` holds.
    pub(super) fn idle(&self, section: &Section, name: &str, holds: &str) -> Result<(), ScenarioError> {
        let Some(place) = self.places.get(&dotted(&section.path, name)) else {
            return Ok(());
        };
        Err(ScenarioError::Idle {
            field: dotted(&section.shown, name),
            holds: holds.to_owned(),
            place: place.clone(),
        })
    }

    /// A value that every scenario has, from the `paper` preset if from nowhere else.
    pub(super) fn set<T>(section: &Section, name: &str, value: Option<T>) -> Result<T, ScenarioError> {
        value.ok_or_else(|| ScenarioError::Missing {
            field: dotted(&section.shown, name),
            why: "in every scenario".to_owned(),
        })
    }

    /// A float within `range`.
    pub(super) fn number(
        &self,
        section: &Section,
        name: &str,
        value: Option<f64>,
        range: Range,
    ) -> Result<f64, ScenarioError> {
        let value = Self::set(section, name, value)?;
        // Adding 0 turns -0 into 0, which is written and hashed otherwise.
        if range.1(value) {
            Ok(value + 0.0)
        } else {
            Err(self.refuse(section, name, value, range.0))
        }
    }

    /// A whole number from `least` to `most`.
    pub(super) fn whole(
        &self,
        section: &Section,
        name: &str,
        value: Option<u64>,
        (least, most): (u64, u64),
    ) -> Result<u64, ScenarioError> {
        let value = Self::set(section, name, value)?;
        if (least..=most).contains(&value) {
            Ok(value)
        } else {
            Err(self.refuse(
                section,
                name,
                value,
                format!("must be at least {least} and at most {most}"),
            ))
        }
    }

    /// An amount of energy.
    pub(super) fn energy(&self, section: &Section, name: &str, value: Option<f64>) -> Result<Energy, ScenarioError> {
        let value = Self::set(section, name, value)?;
        let allowed = format!("must be at least 0 and at most {MAX_UNITS} units");
        Energy::from_units(value).ok_or_else(|| self.refuse(section, name, value, allowed))
    }

    /// The absolute path of a file that a scenario names: relative to the scenario file, or, if given on the command
    /// line, to the working directory.
    pub(super) fn file(&self, section: &Section, name: &str, file: &str) -> Result<PathBuf, ScenarioError> {
        let (_, place) = self.locate(section, name);
        let path = match place {
            Place::Flag(_) => PathBuf::from(file),
            Place::File { .. } | Place::Preset(_) | Place::Nowhere => self.base_dir.join(file),
        };
        if file.is_empty() {
            return Err(self.refuse(section, name, "\"\"", "must be the path of a file"));
        }
        std::path::absolute(&path).map_err(|error| self.data(section, name, path, error.to_string()))
    }

    /// The error of a file that cannot be used.
    pub(super) fn data(&self, section: &Section, name: &str, file: PathBuf, reason: String) -> ScenarioError {
        let (field, place) = self.locate(section, name);
        ScenarioError::Data {
            field,
            file,
            reason,
            place,
        }
    }
}

fn dotted(section: &str, name: &str) -> String {
    if section.is_empty() {
        name.to_owned()
    } else {
        format!("{section}.{name}")
    }
}
