//! Which devices are of a class: a share of them, those of a list, or those that stand at a place.

use crate::declare::{ABOVE_ZERO, NOT_NEGATIVE, Reader, ScenarioError, number, text, wholes};
use crate::geometry::{Area, Point};
use crate::ids::MAX_DEVICES;

crate::declare! {
    /// A kind of device with its own battery, costs and energy source.
    #[derive(Clone, Debug)]
    pub(super) struct OwnFields in "class" {
        /// Its name in files and tables, 1 to 64 characters.
        pub(super) name: Option<String> = text(),
        /// Its share of the N devices, or of those that no class names by `devices` or by place; all shares add up to
        /// 1. Not needed where `layout.file` has a column `class`, which decides then.
        pub(super) share: Option<f64> = number(ABOVE_ZERO, 1.0).required(),
        /// Its devices by number, from 0, in place of a share.
        pub(super) devices: Option<Vec<u32>> = wholes(0, MAX_DEVICES - 1, MAX_DEVICES as usize, &[]).required(),
        /// In place of a share, the devices from `west` to `east` and from `south` to `north` that no class names by
        /// number and no earlier class by place. This is the western end; what is left out of the four is the area's.
        pub(super) west: Option<f64> = number(NOT_NEGATIVE, 0.0).unit("metres").derived("the area's"),
        /// The eastern end, included.
        pub(super) east: Option<f64> = number(NOT_NEGATIVE, 0.0).unit("metres").derived("the area's"),
        /// The southern end.
        pub(super) south: Option<f64> = number(NOT_NEGATIVE, 0.0).unit("metres").derived("the area's"),
        /// The northern end, included.
        pub(super) north: Option<f64> = number(NOT_NEGATIVE, 0.0).unit("metres").derived("the area's"),
    }
}

/// Which devices are of a class.
#[derive(Clone, Debug, PartialEq)]
pub enum Members {
    /// This share, `(0, 1]`, of the devices that no class names otherwise. The seed decides which.
    Share(f64),
    /// Those with these numbers.
    Devices(Vec<u32>),
    /// Those that stand at this place, but for those that are named by number or by the place of an earlier class.
    Within(Zone),
    /// Those that the layout's file says.
    Layout,
}

/// A rectangle of the area, its ends included, metres from the south-west corner; an end that is left out is the
/// area's.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Zone {
    /// The least x.
    pub west: Option<f64>,
    /// The largest x.
    pub east: Option<f64>,
    /// The least y.
    pub south: Option<f64>,
    /// The largest y.
    pub north: Option<f64>,
}

impl Zone {
    /// Whether it holds `point`.
    pub fn contains(&self, point: Point) -> bool {
        let within = |least: Option<f64>, x: f64, most: Option<f64>| {
            least.is_none_or(|least| x >= least) && most.is_none_or(|most| x <= most)
        };
        within(self.west, point.x, self.east) && within(self.south, point.y, self.north)
    }
}

impl Members {
    /// Those that `own`, which `item` has, say; nothing where none of them does.
    pub(super) fn settle(item: &Reader<'_>, own: &OwnFields, area: Area) -> Result<Option<Self>, ScenarioError> {
        let zone = Zone {
            west: own.west,
            east: own.east,
            south: own.south,
            north: own.north,
        };
        let is_placed = zone != Zone::default();
        if usize::from(own.share.is_some()) + usize::from(own.devices.is_some()) + usize::from(is_placed) > 1 {
            let allowed = "is one of three ways to say which devices are of the class: give its share, or its devices \
                by number, or the place (west, east, south, north) where they stand";
            return Err(item.refuse("class.name", own.name.as_deref().unwrap_or_default(), allowed));
        }
        let ends = [
            ("class.west", zone.west, zone.east, area.width, "east"),
            ("class.south", zone.south, zone.north, area.height, "north"),
        ];
        for (path, least, most, limit, other) in ends {
            let (least, most) = (least.unwrap_or(0.0), most.unwrap_or(limit));
            if least > most {
                let allowed = format!("must be at most {most}, its {other} end");
                return Err(item.refuse(path, least, allowed));
            }
        }
        let by_place = is_placed.then_some(Self::Within(zone));
        let by_number = || own.devices.clone().map(Self::Devices);
        Ok(own.share.map(Self::Share).or_else(by_number).or(by_place))
    }

    /// What says so in a file, beside the name.
    pub(super) fn own_fields(&self, name: &str) -> OwnFields {
        let mut own = OwnFields {
            name: Some(name.to_owned()),
            share: None,
            devices: None,
            west: None,
            east: None,
            south: None,
            north: None,
        };
        match self {
            Self::Share(share) => own.share = Some(*share),
            Self::Devices(devices) => own.devices = Some(devices.clone()),
            Self::Within(zone) => {
                (own.west, own.east, own.south, own.north) = (zone.west, zone.east, zone.south, zone.north);
            }
            Self::Layout => {}
        }
        own
    }
}
