//! What lines and markers look like: colours that the colour-blind tell apart (Okabe and Ito), and for print without
//! colours a marker and a dash pattern of its own for each policy.

use std::f64::consts::FRAC_PI_2;

use reveille_bs::policy::registry;
use reveille_lab::series;

use super::path::Path;
use super::scene::{Paint, Rgb, Scene, Stroke};

/// Okabe and Ito's blue.
pub const BLUE: Rgb = Rgb(0x00, 0x72, 0xB2);
/// Okabe and Ito's orange.
pub const ORANGE: Rgb = Rgb(0xE6, 0x9F, 0x00);
/// Okabe and Ito's bluish green.
pub const GREEN: Rgb = Rgb(0x00, 0x9E, 0x73);
/// Okabe and Ito's vermilion.
pub const VERMILION: Rgb = Rgb(0xD5, 0x5E, 0x00);
/// Okabe and Ito's reddish purple.
pub const PURPLE: Rgb = Rgb(0xCC, 0x79, 0xA7);
/// Okabe and Ito's sky blue.
pub const SKY: Rgb = Rgb(0x56, 0xB4, 0xE9);

/// A grey that stands apart from Okabe and Ito's colours in print.
pub const GREY: Rgb = Rgb(0x7F, 0x7F, 0x7F);

/// The form of a marker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Marker {
    /// A disc.
    Circle,
    /// A square.
    Square,
    /// A triangle on its base.
    TriangleUp,
    /// A triangle on its tip.
    TriangleDown,
    /// A square on its tip.
    Diamond,
    /// A star of five points.
    Star,
    /// A hexagon.
    Hexagon,
    /// A pentagon on its tip.
    Pentagon,
}

impl Marker {
    /// Its outline around `centre`; markers of one `size` look equally large.
    pub fn path(self, (x, y): (f64, f64), size: f64) -> Path {
        let up = -FRAC_PI_2;
        match self {
            Self::Circle => Path::circle((x, y), size),
            Self::Square => Path::rectangle([x - 0.88 * size, y - 0.88 * size, x + 0.88 * size, y + 0.88 * size]),
            Self::TriangleUp => Path::polygon((x, y + 0.15 * size), 1.25 * size, 3, up, 1.0),
            Self::TriangleDown => Path::polygon((x, y - 0.15 * size), 1.25 * size, 3, -up, 1.0),
            Self::Diamond => Path::polygon((x, y), 1.2 * size, 4, up, 1.0),
            Self::Star => Path::polygon((x, y), 1.4 * size, 5, up, 0.45),
            Self::Pentagon => Path::polygon((x, y), 1.15 * size, 5, -up, 1.0),
            Self::Hexagon => Path::polygon((x, y), 1.1 * size, 6, up, 1.0),
        }
    }
}

/// How one thing is drawn throughout a picture.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Style {
    /// Its colour.
    pub paint: Paint,
    /// Its marker.
    pub marker: Marker,
    /// Its dashes, empty for a solid line.
    pub dashes: &'static [f64],
}

/// Half the size of markers, points.
pub const MARKER: f64 = 2.4;
/// The width of lines, points.
pub const LINE: f64 = 1.1;

/// The palette of policies by their places: six for those of the paper, one for `age-index`, then a spare one.
const POLICIES: [Style; 8] = [
    Style::new(Paint::Colour(BLUE), Marker::Circle, &[]),
    Style::new(Paint::Colour(ORANGE), Marker::Square, &[6.0, 2.0]),
    Style::new(Paint::Colour(VERMILION), Marker::TriangleDown, &[2.0, 1.6]),
    Style::new(Paint::Colour(GREEN), Marker::Diamond, &[6.0, 1.8, 1.6, 1.8]),
    Style::new(Paint::Colour(PURPLE), Marker::TriangleUp, &[3.5, 1.6]),
    Style::new(Paint::Ink, Marker::Star, &[1.0, 1.6]),
    Style::new(Paint::Colour(SKY), Marker::Hexagon, &[9.0, 2.5]),
    Style::new(Paint::Colour(GREY), Marker::Pentagon, &[9.0, 1.8, 1.6, 1.8]),
];

/// By how many places the marker and the dashes of a policy with another ranking are those of another policy. The spare
/// one lends none.
const RANKED: [usize; 2] = [3, 4];

impl Style {
    const fn new(paint: Paint, marker: Marker, dashes: &'static [f64]) -> Self {
        Self { paint, marker, dashes }
    }

    /// The style of the policy that has place `series` in the palette, the same in all figures. Policies behind its end
    /// share the last.
    pub fn nth_policy(series: usize) -> Self {
        POLICIES[series.min(POLICIES.len() - 1)]
    }

    /// The style of a series by its name: that of its policy, with another marker and other dashes where the name tells
    /// its ranking. Names that are not the paper's share one.
    pub fn of_policy(series: &str) -> Self {
        let (name, is_ranked) = series::policy(series);
        let place = match registry::named(name) {
            Some(policy) => policy.profile().series,
            None => POLICIES.len(),
        };
        let style = Self::nth_policy(place);
        if !is_ranked {
            return style;
        }
        let lenders = POLICIES.len() - 1;
        let [marker, dashes] = RANKED.map(|shift| POLICIES[(place.min(lenders) + shift) % lenders]);
        Self {
            marker: marker.marker,
            dashes: dashes.dashes,
            ..style
        }
    }

    /// The `i`-th of a row of styles for anything but policies.
    pub fn nth(i: usize) -> Self {
        let all = [
            Self::new(Paint::Colour(BLUE), Marker::Circle, &[]),
            Self::new(Paint::Colour(VERMILION), Marker::Square, &[6.0, 2.0]),
            Self::new(Paint::Colour(GREEN), Marker::Diamond, &[2.0, 1.6]),
            Self::new(Paint::Colour(PURPLE), Marker::TriangleUp, &[6.0, 1.8, 1.6, 1.8]),
            Self::new(Paint::Colour(ORANGE), Marker::TriangleDown, &[3.5, 1.6]),
            Self::new(Paint::Colour(SKY), Marker::Hexagon, &[9.0, 2.5]),
        ];
        all[i % all.len()]
    }

    /// The line that goes with it.
    pub const fn line(self) -> Stroke {
        Stroke::solid(self.paint, LINE).dashed(self.dashes)
    }

    /// Puts a marker on `scene`.
    pub fn mark(self, scene: &mut Scene, at: (f64, f64)) {
        scene.area(self.marker.path(at, MARKER), self.paint, 1.0);
    }

    /// Puts a hollow marker on `scene`, larger, so that it shows around a full one, and what is under it shows through.
    pub fn mark_hollow(self, scene: &mut Scene, at: (f64, f64)) {
        scene.line(self.marker.path(at, 1.45 * MARKER), Stroke::solid(self.paint, 0.9));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_two_policies_look_alike_in_colour_marker_or_dashes() {
        for (i, a) in POLICIES.iter().enumerate() {
            for b in &POLICIES[..i] {
                assert_ne!(a.paint, b.paint);
                assert_ne!(a.marker, b.marker);
                assert_ne!(a.dashes, b.dashes);
            }
        }
    }

    #[test]
    fn a_policy_with_another_ranking_has_its_colour_and_another_marker_and_dashes() {
        for policy in ["knn", "adjusted", "q-learning", "dt", "another"] {
            let (own, ranked) = (
                Style::of_policy(policy),
                Style::of_policy(&format!("{policy}+posterior")),
            );
            assert_eq!(own.paint, ranked.paint);
            assert!(own.marker != ranked.marker && own.dashes != ranked.dashes, "{policy}");
        }
    }

    #[test]
    fn policies_behind_the_palette_share_the_spare_style() {
        assert_eq!(Style::nth_policy(0), Style::of_policy("knn"));
        assert_eq!(Style::nth_policy(70), Style::of_policy("another"));
    }

    #[test]
    fn dashes_come_in_pairs() {
        for style in POLICIES.into_iter().chain((0..6).map(Style::nth)) {
            assert!(style.dashes.len().is_multiple_of(2));
        }
    }
}
