//! The members of a device class: a share of the devices, a list of devices, or the devices in a zone. Names and order
//! of the fields are part of scenario files and of the scenario hash, their help texts of `docs/scenario.md`.
//! `classes.rs` checks the name and the sum of shares, `validate.rs` the lists.

use crate::declare::{FieldReader, NOT_NEGATIVE, SHARE_ABOVE_ZERO, ScenarioError, number, text, wholes};
use crate::geometry::{Area, Point};
use crate::ids::MAX_DEVICES;

crate::declare! {
    /// Device class with its own battery, energy costs and energy source.
    #[derive(Clone, Debug)]
    pub(super) struct ClassFields in "class" {
        /// Name of the class in files and tables, 1 to 64 characters.
        pub(super) name: Option<String> = text(),
        /// Share of the N devices, except those that a class selects by `devices` or by zone; all shares add up to 1.
        /// Not needed if `layout.file` has a column `class`, which then assigns the classes.
        pub(super) share: Option<f64> = number(SHARE_ABOVE_ZERO, 1.0).required(),
        /// Numbers of the class's devices, from 0, instead of a share.
        pub(super) devices: Option<Vec<u32>> = wholes(0, MAX_DEVICES - 1, MAX_DEVICES as usize, &[]).required(),
        /// Western edge of the class's zone, from `west` to `east` and `south` to `north`, instead of a share. The zone
        /// excludes devices that any class selects by number or an earlier class by zone. An omitted edge is the
        /// area's.
        pub(super) west: Option<f64> = number(NOT_NEGATIVE, 0.0).unit("metres").derived("the area's"),
        /// Eastern edge of the zone, included.
        pub(super) east: Option<f64> = number(NOT_NEGATIVE, 0.0).unit("metres").derived("the area's"),
        /// Southern edge of the zone.
        pub(super) south: Option<f64> = number(NOT_NEGATIVE, 0.0).unit("metres").derived("the area's"),
        /// Northern edge of the zone, included.
        pub(super) north: Option<f64> = number(NOT_NEGATIVE, 0.0).unit("metres").derived("the area's"),
    }
}

/// The rule that determines the members of a class.
#[derive(Clone, Debug, PartialEq)]
pub enum Members {
    /// This share, `(0, 1]`, of the devices that no class lists or covers by its zone, as drawn from the seed.
    Share(f64),
    /// The devices with these numbers.
    Devices(Vec<u32>),
    /// The devices in this zone, except those listed by number or in the zone of an earlier class.
    Within(Zone),
    /// The devices that the layout's file assigns to the class.
    Layout,
}

/// A rectangle of the area, its edges included, in metres from the south-west corner. An omitted edge is the area's; at
/// least one is set.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Zone {
    /// The smallest x.
    pub west: Option<f64>,
    /// The largest x.
    pub east: Option<f64>,
    /// The smallest y.
    pub south: Option<f64>,
    /// The largest y.
    pub north: Option<f64>,
}

impl Zone {
    /// Whether the zone contains `point`.
    pub fn contains(&self, point: Point) -> bool {
        let within = |least: Option<f64>, x: f64, most: Option<f64>| {
            least.is_none_or(|least| x >= least) && most.is_none_or(|most| x <= most)
        };
        within(self.west, point.x, self.east) && within(self.south, point.y, self.north)
    }
}

impl Members {
    /// Returns the rule that the `fields` of a class specify; `None` if they specify none. `class_reader` reads the
    /// table of this class.
    pub(super) fn from_fields(
        class_reader: &FieldReader<'_>,
        fields: &ClassFields,
        area: Area,
    ) -> Result<Option<Self>, ScenarioError> {
        let zone = Zone {
            west: fields.west,
            east: fields.east,
            south: fields.south,
            north: fields.north,
        };
        let has_zone = zone != Zone::default();
        if usize::from(fields.share.is_some()) + usize::from(fields.devices.is_some()) + usize::from(has_zone) > 1 {
            let allowed = "selects its devices in several ways; keep only one of class.share, class.devices and the \
                zone (class.west, east, south, north)";
            return Err(class_reader.invalid_value("class.name", fields.name.as_deref().unwrap_or_default(), allowed));
        }
        let sides = [
            ("class.west", zone.west, zone.east, area.width, "east"),
            ("class.south", zone.south, zone.north, area.height, "north"),
        ];
        for (path, least, most, limit, opposite) in sides {
            let (least, most) = (least.unwrap_or(0.0), most.unwrap_or(limit));
            if least > most {
                let allowed = format!("must be at most {most}, the {opposite} edge of the zone");
                return Err(class_reader.invalid_value(path, least, allowed));
            }
        }
        let by_zone = has_zone.then_some(Self::Within(zone));
        let by_number = || fields.devices.clone().map(Self::Devices);
        Ok(fields.share.map(Self::Share).or_else(by_number).or(by_zone))
    }

    /// Returns the fields to write to a scenario file or to hash, including the class's `name`.
    pub(super) fn to_fields(&self, name: &str) -> ClassFields {
        let mut fields = ClassFields {
            name: Some(name.to_owned()),
            share: None,
            devices: None,
            west: None,
            east: None,
            south: None,
            north: None,
        };
        match self {
            Self::Share(share) => fields.share = Some(*share),
            Self::Devices(devices) => fields.devices = Some(devices.clone()),
            Self::Within(zone) => {
                (fields.west, fields.east, fields.south, fields.north) = (zone.west, zone.east, zone.south, zone.north);
            }
            Self::Layout => {}
        }
        fields
    }
}
