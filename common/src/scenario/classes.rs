//! Device classes: their fields, read and written, and the check that together they cover all devices. The name
//! `default` marks a scenario without classes, so it decides how its fields are written and hashed. The tests are in
//! `bs/src/scenario/tests/`, which expects the texts of errors.

use std::collections::BTreeSet;

use super::class_members::{ClassFields, Members};
use super::run::RunSettings;
use crate::declare::{FieldReader, FieldSink, ScenarioError, Visit};
use crate::energy::EnergyModel;
use crate::geometry::Area;
use crate::harvest::Harvest;

/// Maximum number of classes; `geometry/file.rs` and `class_assignment.rs` rely on indices that fit in 16 bits.
pub(crate) const MAX_CLASSES: usize = 256;
/// Tolerance for the difference between the sum of the classes' shares and 1.
const SHARE_TOLERANCE: f64 = 1e-9;
/// The name of the only class in a scenario without declared classes.
const DEFAULT_CLASS_NAME: &str = "default";

/// A class of devices with the same battery, costs and energy source.
#[derive(Clone, Debug, PartialEq)]
pub struct DeviceClass {
    /// Its name in files and tables.
    pub name: String,
    /// The share of all N devices, `(0, 1]`, 0 for a class without devices: declared if every class has a share,
    /// otherwise counted by `validate.rs`. [`Members::Share`] is the share of the devices that no class selects.
    pub share: f64,
    /// The rule that determines its members.
    pub members: Members,
    /// Battery and costs.
    pub energy: EnergyModel,
    /// The energy source.
    pub harvest: Harvest,
}

impl DeviceClass {
    /// Reads the classes from `reader`, for a run with the settings `run` on `area`; a scenario without classes gets a
    /// default one. The flag of each class tells whether its fields specify its members, see [`resolve_members`].
    pub(super) fn read_all(
        reader: &FieldReader<'_>,
        run: &RunSettings,
        area: Area,
    ) -> Result<(Vec<Self>, Vec<bool>), ScenarioError> {
        let items = reader.items();
        if items.is_empty() {
            let default_class = Self {
                name: DEFAULT_CLASS_NAME.to_owned(),
                share: 1.0,
                members: Members::Share(1.0),
                energy: EnergyModel::from_fields(reader)?,
                harvest: Harvest::from_fields(reader, run.tau, run.ttis)?,
            };
            return Ok((vec![default_class], vec![true]));
        }
        if items.len() > MAX_CLASSES {
            let found = format!("{} classes", items.len());
            return Err(reader.invalid_value("class", found, format!("must be at most {MAX_CLASSES}")));
        }
        let mut names = BTreeSet::new();
        let (mut classes, mut specify_members) = (Vec::new(), Vec::new());
        for item in items {
            let (class, specifies_members) = Self::from_fields(item, &mut names, run, area)?;
            classes.push(class);
            specify_members.push(specifies_members);
        }
        Ok((classes, specify_members))
    }

    fn from_fields(
        item: FieldReader<'_>,
        names: &mut BTreeSet<String>,
        run: &RunSettings,
        area: Area,
    ) -> Result<(Self, bool), ScenarioError> {
        let section = ClassFields::SECTION;
        let name = section
            .field("name")
            .map(|field| item.optional_field::<String>(section, field))
            .transpose()?;
        let Some(name) = name.flatten() else {
            return Err(ScenarioError::Missing {
                field: item.locate("class.name").0,
                why: format!("for every class ({})", item.item_origin()),
            });
        };
        if name.trim().is_empty() || name.chars().count() > 64 || name.contains(char::is_control) {
            let shown = format!("\"{}\"", name.escape_debug());
            let allowed = "must be 1 to 64 characters, not all blank, without control characters";
            return Err(item.invalid_value("class.name", shown, allowed));
        }
        let item = item.with_name(&name);
        if !names.insert(name.clone()) {
            return Err(item.invalid_value("class.name", &name, "must differ from the other classes' names"));
        }
        item.reject_unused_fields()?;
        let members = Members::from_fields(&item, &ClassFields::read(&item)?, area)?;
        let specifies_members = members.is_some();
        let class = Self {
            name,
            // `set_class_shares` in `validate.rs` sets it once the members of all classes are known.
            share: 0.0,
            members: members.unwrap_or(Members::Layout),
            energy: EnergyModel::from_fields(&item)?,
            harvest: Harvest::from_fields(&item, run.tau, run.ttis)?,
        };
        Ok((class, specifies_members))
    }

    /// Passes every field of `classes` to `sink`. The only class of a scenario without classes uses the top level.
    pub(super) fn visit_all(classes: &[Self], sink: &mut dyn FieldSink) {
        // A declared class may have the same name. Its members distinguish it, unless it equals the undeclared class.
        let is_undeclared =
            matches!(classes, [only] if only.name == DEFAULT_CLASS_NAME && only.members == Members::Share(1.0));
        for class in classes {
            if !is_undeclared {
                sink.item(&class.name);
                class.members.to_fields(&class.name).visit(sink);
            }
            class.energy.visit(sink);
            class.harvest.visit(sink);
        }
    }
}

/// Checks that the members of all classes are determined. With `is_set_by_layout`, the layout's file names the class of
/// each device, and all classes get [`Members::Layout`]. Otherwise every class must specify its members in its own
/// fields (its flag in `specify_members`), and the shares must add up to 1.
pub(super) fn resolve_members(
    reader: &FieldReader<'_>,
    classes: &mut [DeviceClass],
    specify_members: &[bool],
    is_set_by_layout: bool,
) -> Result<(), ScenarioError> {
    if is_set_by_layout {
        if specify_members.contains(&true) {
            reader.warn(
                "class.share, class.devices and zones have no effect: the column `class` of layout.file assigns the \
                 classes",
            );
        }
        for class in classes {
            class.members = Members::Layout;
        }
        return Ok(());
    }
    for ((item, class), specifies_members) in reader.items().into_iter().zip(classes.iter()).zip(specify_members) {
        if !specifies_members {
            return Err(item.with_name(&class.name).missing_value("class.share", "class.name"));
        }
    }
    let share = |class: &DeviceClass| match class.members {
        Members::Share(share) => Some(share),
        Members::Devices(_) | Members::Within(_) | Members::Layout => None,
    };
    let shares: Vec<f64> = classes.iter().filter_map(share).collect();
    let sum: f64 = shares.iter().sum();
    if !shares.is_empty() && (sum - 1.0).abs() > SHARE_TOLERANCE {
        let shares: Vec<String> = shares.iter().map(f64::to_string).collect();
        let allowed = format!("the shares of all classes must add up to 1, not to {sum}");
        return Err(reader.invalid_value("class", format!("shares {}", shares.join(" + ")), allowed));
    }
    Ok(())
}
