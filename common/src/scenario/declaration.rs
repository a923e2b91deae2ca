//! All fields of a scenario together.

use super::bs::BsSettings;
use super::members::OwnFields;
use super::model::Policies;
use super::run::{PRESETS, PolicyName, Run};
use crate::declare::{Alternative, Declaration, List};
use crate::energy::EnergyModel;
use crate::event::settings::Events;
use crate::geometry::{Area, Layout};
use crate::harvest::Harvest;
use crate::radio::Radio;
use crate::sensing::Sensing;

/// What may be said in a scenario file of a program that knows `policies`.
pub fn declaration(policies: Policies<'_>) -> Declaration {
    let mut sections = vec![Run::SECTION, Area::SECTION, Layout::SECTION, Sensing::SECTION];
    sections.extend(Events::SECTIONS);
    sections.extend(Radio::SECTIONS);
    sections.extend([BsSettings::SECTION, PolicyName::SECTION]);
    sections.extend(policies.iter().filter_map(|policy| policy.section()));
    sections.push(EnergyModel::SECTION);
    sections.extend(Harvest::SECTIONS);
    Declaration {
        title: "A scenario of Reveille",
        sections,
        list: List {
            section: OwnFields::SECTION,
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
