//! Styles of lines and markers, and the measures of figures. The colours suit colour-blind readers (Okabe and Ito);
//! each policy has its own marker and dash pattern for print without colours, the same in all figures. No two policies
//! may share a colour, a marker or dashes. A test compares the colours as colour-blind readers see them.

use std::f64::consts::FRAC_PI_2;

use reveille_bs::policy::registry;
use reveille_lab::series;

use super::path::VectorPath;
use super::scene::{Paint, Rgb, Scene, Stroke};

/// Okabe and Ito's blue.
pub(crate) const BLUE: Rgb = Rgb(0x00, 0x72, 0xB2);
/// Okabe and Ito's orange.
pub(crate) const ORANGE: Rgb = Rgb(0xE6, 0x9F, 0x00);
/// Okabe and Ito's bluish green.
pub(crate) const GREEN: Rgb = Rgb(0x00, 0x9E, 0x73);
/// Okabe and Ito's vermilion.
pub(crate) const VERMILION: Rgb = Rgb(0xD5, 0x5E, 0x00);
/// Okabe and Ito's reddish purple.
pub(crate) const PURPLE: Rgb = Rgb(0xCC, 0x79, 0xA7);
/// Okabe and Ito's sky blue.
pub(crate) const SKY: Rgb = Rgb(0x56, 0xB4, 0xE9);

/// A grey that is distinct from Okabe and Ito's colours in print.
pub(crate) const GREY: Rgb = Rgb(0x7F, 0x7F, 0x7F);
/// A dark grey that differs from Okabe and Ito's green and purple for colour-blind readers too.
const DARK_GREY: Rgb = Rgb(0x5A, 0x5A, 0x5A);
/// A dark brown, far from Okabe and Ito's other colours. Their sky blue is too close to their blue for two policies.
const BROWN: Rgb = Rgb(0x75, 0x40, 0x00);
/// Tol's wine.
const WINE: Rgb = Rgb(0x88, 0x22, 0x55);
/// Tol's indigo.
const INDIGO: Rgb = Rgb(0x33, 0x22, 0x88);
/// Tol's olive.
const OLIVE: Rgb = Rgb(0x99, 0x99, 0x33);

/// Shape of a marker.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MarkerShape {
    /// A disc.
    Circle,
    /// A square.
    Square,
    /// A triangle that points up.
    TriangleUp,
    /// A triangle that points down.
    TriangleDown,
    /// A square on its tip.
    Diamond,
    /// A star of five points.
    Star,
    /// A hexagon.
    Hexagon,
    /// A pentagon that points down.
    Pentagon,
    /// A star of four points.
    FourPoints,
    /// A star of six points.
    SixPoints,
    /// A triangle that points to the right.
    TriangleRight,
}

impl MarkerShape {
    /// Returns the outline of the marker around a centre. All shapes look as large as a circle of radius `r`.
    pub fn path(self, (x, y): (f64, f64), r: f64) -> VectorPath {
        let up = -FRAC_PI_2;
        match self {
            Self::Circle => VectorPath::circle((x, y), r),
            Self::Square => VectorPath::rectangle([x - 0.88 * r, y - 0.88 * r, x + 0.88 * r, y + 0.88 * r]),
            Self::TriangleUp => VectorPath::polygon((x, y + 0.15 * r), 1.25 * r, 3, up, 1.0),
            Self::TriangleDown => VectorPath::polygon((x, y - 0.15 * r), 1.25 * r, 3, -up, 1.0),
            Self::Diamond => VectorPath::polygon((x, y), 1.2 * r, 4, up, 1.0),
            Self::Star => VectorPath::polygon((x, y), 1.4 * r, 5, up, 0.45),
            Self::Pentagon => VectorPath::polygon((x, y), 1.15 * r, 5, -up, 1.0),
            Self::Hexagon => VectorPath::polygon((x, y), 1.1 * r, 6, up, 1.0),
            Self::FourPoints => VectorPath::polygon((x, y), 1.5 * r, 4, up, 0.35),
            Self::SixPoints => VectorPath::polygon((x, y), 1.35 * r, 6, up, 0.55),
            Self::TriangleRight => VectorPath::polygon((x - 0.15 * r, y), 1.25 * r, 3, 0.0, 1.0),
        }
    }
}

/// Style of one series throughout a figure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Style {
    /// Colour.
    pub paint: Paint,
    /// Marker shape.
    pub marker: MarkerShape,
    /// Dash pattern; empty for a solid line.
    pub dashes: &'static [f64],
}

/// Radius of markers, as in [`MarkerShape::path`], points.
pub(crate) const MARKER_RADIUS: f64 = 2.4;
/// The width of lines, points.
pub(crate) const LINE_WIDTH: f64 = 1.1;

/// Styles of policies by name; the entry of `external` is the last.
const POLICY_STYLES: [(&str, Style); 8] = [
    ("knn", Style::new(Paint::Colour(BLUE), MarkerShape::Circle, &[])),
    (
        "adjusted",
        Style::new(Paint::Colour(ORANGE), MarkerShape::Square, &[6.0, 2.0]),
    ),
    (
        "random",
        Style::new(Paint::Colour(VERMILION), MarkerShape::TriangleDown, &[2.0, 1.6]),
    ),
    (
        "q-learning",
        Style::new(Paint::Colour(GREEN), MarkerShape::Diamond, &[6.0, 1.8, 1.6, 1.8]),
    ),
    (
        "dt",
        Style::new(Paint::Colour(PURPLE), MarkerShape::TriangleUp, &[3.5, 1.6]),
    ),
    ("genie", Style::new(Paint::Ink, MarkerShape::Star, &[1.0, 1.6])),
    (
        "age-index",
        Style::new(Paint::Colour(BROWN), MarkerShape::Hexagon, &[9.0, 2.5]),
    ),
    (
        "external",
        Style::new(Paint::Colour(DARK_GREY), MarkerShape::Pentagon, &[9.0, 1.8, 1.6, 1.8]),
    ),
];

/// Styles of registered policies without an entry above, in the order of the registry: a policy registered before them
/// changes their styles. Unregistered policies share the last one.
const FREE_STYLES: [Style; 3] = [
    Style::new(Paint::Colour(WINE), MarkerShape::FourPoints, &[12.0, 2.0]),
    Style::new(Paint::Colour(INDIGO), MarkerShape::SixPoints, &[3.5, 1.6, 1.0, 1.6]),
    Style::new(Paint::Colour(OLIVE), MarkerShape::TriangleRight, &[6.0, 4.0]),
];

/// Offsets in [`POLICY_STYLES`] of the entries that lend a marker and dashes to a policy with another ranking. The last
/// entry, `external`, lends neither.
const RANKED_STYLE_OFFSETS: [usize; 2] = [3, 4];

impl Style {
    const fn new(paint: Paint, marker: MarkerShape, dashes: &'static [f64]) -> Self {
        Self { paint, marker, dashes }
    }

    /// Returns the style of a series by name, the same in all figures. A series with another ranking has its policy's
    /// colour with another marker and other dashes.
    pub fn of_policy(series: &str) -> Self {
        let (name, is_ranked) = series::split_policy(series);
        let index = POLICY_STYLES.iter().position(|(listed, _)| *listed == name);
        let style = index.map_or_else(|| Self::of_unlisted_policy(name), |index| POLICY_STYLES[index].1);
        if !is_ranked {
            return style;
        }
        // The offsets differ and are smaller than the number of lenders, so marker and dashes come from two other
        // policies.
        let lender_count = POLICY_STYLES.len() - 1;
        let [marker_lender, dashes_lender] =
            RANKED_STYLE_OFFSETS.map(|offset| POLICY_STYLES[(index.unwrap_or(lender_count) + offset) % lender_count].1);
        Self {
            marker: marker_lender.marker,
            dashes: dashes_lender.dashes,
            ..style
        }
    }

    /// Returns the style of a policy without an entry in [`POLICY_STYLES`].
    fn of_unlisted_policy(name: &str) -> Self {
        let is_unlisted = |name: &&str| POLICY_STYLES.iter().all(|(listed, _)| listed != name);
        // The registry decides, not the given tables, so that a policy looks the same in all figures.
        let before = registry::names().filter(is_unlisted).take_while(|other| *other != name);
        FREE_STYLES[before.count().min(FREE_STYLES.len() - 1)]
    }

    /// Returns the `i`-th style of a cyclic palette of six, for series that are not policies. `pareto`, `learning` and
    /// `sweep` count on six; `energy` and `q_table` use some by index.
    pub fn from_palette(i: usize) -> Self {
        let all = [
            Self::new(Paint::Colour(BLUE), MarkerShape::Circle, &[]),
            Self::new(Paint::Colour(VERMILION), MarkerShape::Square, &[6.0, 2.0]),
            Self::new(Paint::Colour(GREEN), MarkerShape::Diamond, &[2.0, 1.6]),
            Self::new(Paint::Colour(PURPLE), MarkerShape::TriangleUp, &[6.0, 1.8, 1.6, 1.8]),
            Self::new(Paint::Colour(ORANGE), MarkerShape::TriangleDown, &[3.5, 1.6]),
            Self::new(Paint::Colour(BROWN), MarkerShape::Hexagon, &[9.0, 2.5]),
        ];
        all[i % all.len()]
    }

    /// Stroke of the line in this style.
    pub const fn stroke(self) -> Stroke {
        Stroke::solid(self.paint, LINE_WIDTH).dashed(self.dashes)
    }

    /// Adds a marker to `scene`.
    pub fn draw_marker(self, scene: &mut Scene, at: (f64, f64)) {
        scene.area(self.marker.path(at, MARKER_RADIUS), self.paint, 1.0);
    }

    /// Adds a hollow marker to `scene`. It is large enough to surround a filled one and does not hide it.
    pub(crate) fn draw_hollow_marker(self, scene: &mut Scene, at: (f64, f64)) {
        scene.line(
            self.marker.path(at, 1.45 * MARKER_RADIUS),
            Stroke::solid(self.paint, 0.9),
        );
    }
}

/// Width of a single-column figure, points: 3.5 inch, as docs/figures-and-report.md states.
pub(crate) const COLUMN_WIDTH: f64 = 252.0;
/// Width of a figure across both columns, points.
pub(crate) const PAGE_WIDTH: f64 = 516.0;
/// The smallest font size, points, stated in docs/figures-and-report.md and in tests. In the figures, 0.76 of a font
/// size is the height of a letter above the base line, 0.24 the depth below it, and 0.36 half the height of a digit.
pub const TEXT_SIZE: f64 = 8.0;
/// The font size of titles, points.
pub(crate) const TITLE_SIZE: f64 = 9.5;
/// Line spacing of text, points.
pub(crate) const LEADING: f64 = 10.5;
/// Margin of the figure, points.
pub(crate) const MARGIN: f64 = 6.0;

#[cfg(test)]
mod tests {
    use reveille_bs::policy::outside;

    use super::*;

    fn policy_styles() -> impl Iterator<Item = Style> {
        POLICY_STYLES.into_iter().map(|(_, style)| style)
    }

    #[test]
    fn styles_differ_in_colour_marker_and_dashes() {
        let styles: Vec<Style> = policy_styles().chain(FREE_STYLES).collect();
        for (i, a) in styles.iter().enumerate() {
            for b in &styles[..i] {
                assert_ne!(a.paint, b.paint);
                assert_ne!(a.marker, b.marker);
                assert_ne!(a.dashes, b.dashes);
            }
        }
    }

    /// Returns the colour in CIE L*a*b*, D65, as `matrix` changes its linear RGB.
    fn to_lab(paint: Paint, matrix: [[f64; 3]; 3]) -> [f64; 3] {
        let Rgb(red, green, blue) = match paint {
            Paint::Colour(colour) => colour,
            Paint::Ink => Rgb(0, 0, 0),
            Paint::Paper => Rgb(255, 255, 255),
        };
        let linear = [red, green, blue].map(|channel| {
            let share = f64::from(channel) / 255.0;
            if share <= 0.04045 {
                share / 12.92
            } else {
                libm::pow((share + 0.055) / 1.055, 2.4)
            }
        });
        let dot = |row: [f64; 3], v: [f64; 3]| row.iter().zip(v).map(|(a, b)| a * b).sum::<f64>();
        let seen = matrix.map(|row| dot(row, linear).clamp(0.0, 1.0));
        let [x, y, z] = [
            dot([0.4124, 0.3576, 0.1805], seen) / 0.950_47,
            dot([0.2126, 0.7152, 0.0722], seen),
            dot([0.0193, 0.1192, 0.9505], seen) / 1.088_83,
        ]
        .map(|t| {
            if t > 0.008_856 {
                libm::cbrt(t)
            } else {
                7.787 * t + 16.0 / 116.0
            }
        });
        [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
    }

    /// Colours of policies are easy to tell apart, also with deuteranopia and protanopia (Machado et al. 2009).
    #[test]
    fn colours_of_policies_are_far_apart() {
        const NORMAL: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        const DEUTERANOPIA: [[f64; 3]; 3] = [
            [0.367_322, 0.860_646, -0.227_968],
            [0.280_085, 0.672_501, 0.047_413],
            [-0.011_82, 0.042_94, 0.968_881],
        ];
        const PROTANOPIA: [[f64; 3]; 3] = [
            [0.152_286, 1.052_583, -0.204_868],
            [0.114_503, 0.786_281, 0.099_216],
            [-0.003_882, -0.048_116, 1.051_998],
        ];
        for (matrix, least) in [(NORMAL, 30.0), (DEUTERANOPIA, 17.0), (PROTANOPIA, 17.0)] {
            for (i, (a, a_style)) in POLICY_STYLES.iter().enumerate() {
                for (b, b_style) in &POLICY_STYLES[..i] {
                    let [p, q] = [a_style, b_style].map(|style| to_lab(style.paint, matrix));
                    let distance = p.iter().zip(q).map(|(x, y)| (x - y) * (x - y)).sum::<f64>().sqrt();
                    assert!(distance >= least, "{a} and {b}: {distance:.1}");
                }
            }
        }
    }

    #[test]
    fn policies_have_distinct_styles() {
        let names: Vec<&str> = registry::names().chain([outside::EXTERNAL_NAME]).collect();
        for (i, a) in names.iter().enumerate() {
            for b in &names[..i] {
                assert_ne!(Style::of_policy(a), Style::of_policy(b), "{a}, {b}");
            }
        }
        assert!(policy_styles().all(|style| style != Style::of_policy("another")));
        assert!(
            POLICY_STYLES.iter().all(|(name, _)| names.contains(name)),
            "a style of an unknown policy"
        );
    }

    #[test]
    fn another_ranking_keeps_the_colour_and_changes_marker_and_dashes() {
        for policy in ["knn", "adjusted", "q-learning", "dt", "another"] {
            let (p42, posterior) = (
                Style::of_policy(policy),
                Style::of_policy(&format!("{policy}+posterior")),
            );
            assert_eq!(p42.paint, posterior.paint);
            assert!(
                p42.marker != posterior.marker && p42.dashes != posterior.dashes,
                "{policy}"
            );
        }
    }

    #[test]
    fn dashes_and_gaps_are_paired() {
        for style in policy_styles()
            .chain(FREE_STYLES)
            .chain((0..6).map(Style::from_palette))
        {
            assert!(style.dashes.len().is_multiple_of(2));
        }
    }
}
