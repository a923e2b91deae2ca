//! What a BS believes, for observers.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::Concerns;

/// Where the BS believes the event to be, once all that a TTI has brought is heard.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Belief {
    /// The places that it may be at, at least one.
    pub places: Vec<Likely>,
}

/// A place that an event may be at. Single precision: it is there to be looked at.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Likely {
    /// Metres from the left edge of the area.
    pub x: f32,
    /// Metres from its lower edge.
    pub y: f32,
    /// How likely it is, `[0, 1]`; the sum over all places is 1.
    pub share: f32,
}

impl Concerns for Belief {}

impl fmt::Display for Belief {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let best = self.places.iter().max_by(|a, b| a.share.total_cmp(&b.share));
        match best {
            Some(Likely { x, y, .. }) if self.places.len() == 1 => write!(f, "the event is at ({x:.2}, {y:.2}) m"),
            Some(Likely { x, y, share }) => {
                let (places, percent) = (self.places.len(), share * 100.0);
                write!(
                    f,
                    "the event is at one of {places} places, most likely ({x:.2}, {y:.2}) m, {percent:.0} %"
                )
            }
            None => f.write_str("the event may be anywhere"),
        }
    }
}
