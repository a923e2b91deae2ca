//! The declaration of all fields of a scenario, in the order in which files, schema and reference page
//! (`docs/scenario.md`, compared by a test) show them. Hashing follows the order of
//! [`Scenario::visit`](super::Scenario::visit) instead: a new section needs a line in both.

use super::class_members::ClassFields;
use super::policy::{Policies, PolicyKind};
use super::run::{BsSettings, PRESETS, PolicyName, RunSettings};
use crate::declare::{Alternative, Declaration, TableArray};
use crate::energy::EnergyModel;
use crate::event::event_settings::EventSettings;
use crate::geometry::{Area, Layout};
use crate::harvest::Harvest;
use crate::radio::RadioSettings;
use crate::sensing::Sensing;

/// Returns the declaration of scenario files for a program that knows `policies`.
pub fn declaration<K: PolicyKind>(policies: Policies<'_, K>) -> Declaration {
    let mut sections = vec![RunSettings::SECTION, Area::SECTION, Layout::SECTION, Sensing::SECTION];
    sections.extend(EventSettings::SECTIONS);
    sections.extend(RadioSettings::SECTIONS);
    sections.extend([BsSettings::SECTION, PolicyName::SECTION]);
    sections.extend(policies.iter().filter_map(|policy| policy.section()));
    sections.push(EnergyModel::SECTION);
    sections.extend(Harvest::SECTIONS);
    Declaration {
        title: "A scenario of Reveille",
        sections,
        list: TableArray {
            section: ClassFields::SECTION,
            // The paths of `EnergyModel::SECTION` and, with everything below it, `Harvest::SECTIONS`.
            inherits: &["energy", "harvest"],
        },
        registered: policies
            .iter()
            .map(|policy| Alternative {
                name: policy.name(),
                about: policy.about(),
            })
            .collect(),
        presets: PRESETS,
    }
}
