//! Kinds of devices.

use std::collections::BTreeSet;

use crate::declare::{ABOVE_ZERO, Reader, ScenarioError, Sink, number, text};
use crate::energy::EnergyModel;
use crate::harvest::Harvest;

/// The largest number of device classes.
pub const MAX_CLASSES: usize = 256;
/// How far from 1 the sum of the classes' shares may be.
const SHARE_TOLERANCE: f64 = 1e-9;
/// The name of the one class of a scenario without classes.
const ONLY: &str = "default";

crate::declare! {
    /// A kind of device with its own battery, costs and energy source.
    #[derive(Clone, Debug)]
    pub(super) struct OwnFields in "class" {
        /// Its name in files and tables, 1 to 64 characters.
        name: Option<String> = text(),
        /// Its share of the N devices; all shares add up to 1. Not needed where `layout.file` has a column `class`,
        /// which decides then.
        share: Option<f64> = number(ABOVE_ZERO, 1.0).required(),
    }
}

/// A kind of device with its own battery, costs and energy source.
#[derive(Clone, Debug, PartialEq)]
pub struct DeviceClass {
    /// Its name in files and tables.
    pub name: String,
    /// Its share of the N devices, `(0, 1]`; 0 for a class that the layout's file gives no device.
    pub share: f64,
    /// Battery and costs.
    pub energy: EnergyModel,
    /// The energy source.
    pub harvest: Harvest,
}

impl DeviceClass {
    /// The classes that `reader` has, for TTIs of duration `tau`; the only one of a scenario without. Shares may be
    /// missing, see [`check_shares`].
    pub(super) fn settle_all(reader: &Reader<'_>, tau: f64) -> Result<(Vec<Self>, Vec<Option<f64>>), ScenarioError> {
        let items = reader.items();
        if items.is_empty() {
            let only = Self {
                name: ONLY.to_owned(),
                share: 1.0,
                energy: EnergyModel::settle(reader)?,
                harvest: Harvest::settle(reader, tau)?,
            };
            return Ok((vec![only], vec![Some(1.0)]));
        }
        if items.len() > MAX_CLASSES {
            let found = format!("{} classes", items.len());
            return Err(reader.refuse("class", found, format!("must be at most {MAX_CLASSES}")));
        }
        let mut names = BTreeSet::new();
        let (mut classes, mut shares) = (Vec::new(), Vec::new());
        for item in items {
            let (class, share) = Self::settle(item, &mut names, tau)?;
            classes.push(class);
            shares.push(share);
        }
        Ok((classes, shares))
    }

    fn settle(item: Reader<'_>, names: &mut BTreeSet<String>, tau: f64) -> Result<(Self, Option<f64>), ScenarioError> {
        let section = OwnFields::SECTION;
        let given = section
            .field("name")
            .map(|field| item.given::<String>(section, field))
            .transpose()?;
        let Some(name) = given.flatten() else {
            return Err(ScenarioError::Missing {
                field: item.locate("class.name").0,
                why: format!("for every class ({})", item.place()),
            });
        };
        if name.trim().is_empty() || name.chars().count() > 64 || name.contains(char::is_control) {
            let shown = format!("\"{}\"", name.escape_debug());
            let allowed = "must be 1 to 64 characters, not all blank, without control characters";
            return Err(item.refuse("class.name", shown, allowed));
        }
        let item = item.known_as(&name);
        if !names.insert(name.clone()) {
            return Err(item.refuse("class.name", &name, "must differ from the other classes' names"));
        }
        item.check_idle()?;
        let share = OwnFields::read(&item)?.share;
        let class = Self {
            name,
            share: share.unwrap_or_default(),
            energy: EnergyModel::settle(&item)?,
            harvest: Harvest::settle(&item, tau)?,
        };
        Ok((class, share))
    }

    /// Hands every field of `classes` to `sink`. The only class of a scenario without classes speaks for the top level.
    /// Shares are left out where the layout decides who is of which class.
    pub(super) fn visit_all(classes: &[Self], layout_decides: bool, sink: &mut dyn Sink) {
        let is_plain = matches!(classes, [only] if only.name == ONLY);
        for class in classes {
            if !is_plain {
                sink.item(&class.name);
                let own = OwnFields {
                    name: Some(class.name.clone()),
                    share: (!layout_decides).then_some(class.share),
                };
                own.visit(sink);
            }
            class.energy.visit(sink);
            class.harvest.visit(sink);
        }
    }
}

/// Settles how many devices each class has. Where the layout's file names the class of each device, `by_layout`, it
/// decides, and the shares become those that it comes to; else every class needs a share, and they add up to 1.
pub(super) fn check_shares(
    reader: &Reader<'_>,
    classes: &mut [DeviceClass],
    shares: &[Option<f64>],
    by_layout: Option<&[u16]>,
) -> Result<(), ScenarioError> {
    let items = || reader.items().into_iter().zip(classes.iter());
    if let Some(by_layout) = by_layout {
        if shares.iter().any(Option::is_some) {
            reader.warn("class.share has no effect: the column `class` of layout.file says who is of which class");
        }
        for (index, class) in classes.iter_mut().enumerate() {
            let devices = by_layout.iter().filter(|&&of| usize::from(of) == index).count();
            class.share = devices as f64 / by_layout.len() as f64;
            if devices == 0 {
                reader.warn(format!("no device of layout.file is of the class `{}`", class.name));
            }
        }
        return Ok(());
    }
    for ((item, class), share) in items().zip(shares) {
        if share.is_none() {
            return Err(item.known_as(&class.name).needed("class.share", "class.name"));
        }
    }
    let sum: f64 = classes.iter().map(|class| class.share).sum();
    if (sum - 1.0).abs() > SHARE_TOLERANCE {
        let shares: Vec<String> = classes.iter().map(|class| class.share.to_string()).collect();
        let allowed = format!("the shares of all classes must add up to 1, not to {sum}");
        return Err(reader.refuse("class", format!("shares {}", shares.join(" + ")), allowed));
    }
    Ok(())
}
