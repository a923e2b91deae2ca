//! Scene graph of a figure: shapes and lines of text on a canvas, in points (1/72 inch), y downwards.
//!
//! The SVG and PNG writers both render a scene and add nothing to it. A text may have only letters of the embedded
//! fonts (`font::has_all_glyphs`); no writer checks this.

use super::font::{Weight, text_width};
use super::path::{Rect, VectorPath};

/// A colour with 8 bits per channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rgb(pub u8, pub u8, pub u8);

/// Paint of a shape or text. Ink and paper are swapped when a page is shown in dark mode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Paint {
    /// Colour of text and axes.
    Ink,
    /// Colour of the background.
    Paper,
    /// A fixed colour, the same in dark mode.
    Colour(Rgb),
}

/// Style of a line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stroke {
    /// Paint of the line.
    pub paint: Paint,
    /// Opacity, `(0, 1]`.
    pub opacity: f64,
    /// Width, points, > 0.
    pub width: f64,
    /// Alternating lengths of dashes and gaps, points. The number of lengths must be even, since PNG ignores an odd
    /// number; empty for a solid line.
    pub dashes: &'static [f64],
}

impl Stroke {
    /// Creates a solid line.
    pub(crate) const fn solid(paint: Paint, width: f64) -> Self {
        Self {
            paint,
            opacity: 1.0,
            width,
            dashes: &[],
        }
    }

    /// Returns the stroke with the given dashes.
    #[must_use]
    pub(crate) const fn dashed(self, dashes: &'static [f64]) -> Self {
        Self { dashes, ..self }
    }

    /// Returns the stroke with the given opacity.
    #[must_use]
    pub(crate) const fn with_opacity(self, opacity: f64) -> Self {
        Self { opacity, ..self }
    }
}

/// A path with an optional fill and an optional stroke; with neither it is invisible.
#[derive(Clone, Debug, PartialEq)]
pub struct Shape {
    /// The path.
    pub path: VectorPath,
    /// Paint and opacity of the fill, `(0, 1]`.
    pub fill: Option<(Paint, f64)>,
    /// Stroke along the path.
    pub stroke: Option<Stroke>,
}

/// Point of a line of text to which its position refers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Anchor {
    /// Start of the text.
    Start,
    /// Middle of the text.
    Middle,
    /// End of the text.
    End,
}

/// One line of text.
#[derive(Clone, Debug, PartialEq)]
pub struct Text {
    /// Characters of the text.
    pub text: String,
    /// Position of the anchor on the base line, points.
    pub at: (f64, f64),
    /// Font size, points.
    pub size: f64,
    /// Font weight.
    pub weight: Weight,
    /// Point of the text that lies at `at`.
    pub anchor: Anchor,
    /// Whether it reads from bottom to top.
    pub is_vertical: bool,
    /// Paint of the text.
    pub paint: Paint,
}

impl Text {
    /// Creates text in ink that starts at `at`.
    pub fn new(text: impl Into<String>, at: (f64, f64), size: f64) -> Self {
        Self {
            text: text.into(),
            at,
            size,
            weight: Weight::Regular,
            anchor: Anchor::Start,
            is_vertical: false,
            paint: Paint::Ink,
        }
    }

    /// Returns the text with another anchor.
    #[must_use]
    pub(crate) fn anchored(self, anchor: Anchor) -> Self {
        Self { anchor, ..self }
    }

    /// Returns the text in bold.
    #[must_use]
    pub(crate) fn bold(self) -> Self {
        Self {
            weight: Weight::Bold,
            ..self
        }
    }

    /// Start of the base line, points.
    pub fn start(&self) -> (f64, f64) {
        let length = text_width(&self.text, self.weight, self.size);
        let back = match self.anchor {
            Anchor::Start => 0.0,
            Anchor::Middle => 0.5 * length,
            Anchor::End => length,
        };
        if self.is_vertical {
            (self.at.0, self.at.1 + back)
        } else {
            (self.at.0 - back, self.at.1)
        }
    }

    /// Bounding box, points, with the shares of ascent and descent of [`super::style::TEXT_SIZE`].
    pub fn bounds(&self) -> Rect {
        let (x, y) = self.start();
        let length = text_width(&self.text, self.weight, self.size);
        let (ascent, descent) = (0.76 * self.size, 0.24 * self.size);
        if self.is_vertical {
            [x - ascent, y - length, x + descent, y]
        } else {
            [x, y - ascent, x + length, y + descent]
        }
    }
}

/// One item of a figure.
#[derive(Clone, Debug, PartialEq)]
pub enum SceneItem {
    /// A shape.
    Shape(Shape),
    /// A line of text.
    Text(Text),
}

impl SceneItem {
    /// Bounding box, line widths included, points.
    pub fn bounds(&self) -> Rect {
        match self {
            Self::Shape(shape) => {
                let [left, top, right, bottom] = shape.path.bounds();
                let half_line = shape.stroke.map_or(0.0, |s| 0.5 * s.width);
                [left - half_line, top - half_line, right + half_line, bottom + half_line]
            }
            Self::Text(text) => text.bounds(),
        }
    }
}

/// A complete figure.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// Title for screen readers. `reveille report` orders its figures by it and lists it; a figure also draws it.
    pub title: String,
    /// Description for screen readers, the caption that the figure also draws.
    pub description: String,
    /// Width of the canvas, points.
    pub width: f64,
    /// Height of the canvas, points.
    pub height: f64,
    /// Items on the canvas, from back to front.
    pub items: Vec<SceneItem>,
}

impl Scene {
    /// Creates an empty canvas.
    pub const fn new(width: f64, height: f64) -> Self {
        Self {
            title: String::new(),
            description: String::new(),
            width,
            height,
            items: Vec::new(),
        }
    }

    /// Adds a line on top.
    pub fn line(&mut self, path: VectorPath, stroke: Stroke) {
        self.items.push(SceneItem::Shape(Shape {
            path,
            fill: None,
            stroke: Some(stroke),
        }));
    }

    /// Adds a filled area on top.
    pub fn area(&mut self, path: VectorPath, paint: Paint, opacity: f64) {
        self.items.push(SceneItem::Shape(Shape {
            path,
            fill: Some((paint, opacity)),
            stroke: None,
        }));
    }

    /// Adds a filled area with a border on top.
    pub(crate) fn outlined_area(&mut self, path: VectorPath, fill: Paint, stroke: Stroke) {
        self.items.push(SceneItem::Shape(Shape {
            path,
            fill: Some((fill, 1.0)),
            stroke: Some(stroke),
        }));
    }

    /// Adds text on top.
    pub fn text(&mut self, text: Text) {
        self.items.push(SceneItem::Text(text));
    }

    /// Adds all items of another scene on top, with its upper left corner at `at`. This scene keeps its title,
    /// description and size.
    pub fn add_scene(&mut self, other: Self, at: (f64, f64)) {
        let moved = other.items.into_iter().map(|item| match item {
            SceneItem::Shape(shape) => SceneItem::Shape(Shape {
                path: shape.path.shifted(at),
                ..shape
            }),
            SceneItem::Text(text) => SceneItem::Text(Text {
                at: (text.at.0 + at.0, text.at.1 + at.1),
                ..text
            }),
        });
        self.items.extend(moved);
    }

    /// Items that extend beyond the canvas. A valid scene has none, which only the tests check.
    pub fn items_outside(&self) -> Vec<&SceneItem> {
        let is_outside = |item: &&SceneItem| {
            let [left, top, right, bottom] = item.bounds();
            // Negated as a whole, so that bounds of NaN count as outside.
            !(left >= -0.01 && top >= -0.01 && right <= self.width + 0.01 && bottom <= self.height + 0.01)
        };
        self.items.iter().filter(is_outside).collect()
    }

    /// Pairs of lines of text that overlap. A valid scene has none.
    #[cfg(test)]
    pub(crate) fn overlapping_texts(&self) -> Vec<(&str, &str)> {
        let texts: Vec<&Text> = self
            .items
            .iter()
            .filter_map(|item| match item {
                SceneItem::Text(text) => Some(text),
                SceneItem::Shape(_) => None,
            })
            .collect();
        let mut pairs = Vec::new();
        for (i, a) in texts.iter().enumerate() {
            for b in &texts[..i] {
                if super::path::boxes_overlap(&a.bounds(), &b.bounds()) {
                    pairs.push((b.text.as_str(), a.text.as_str()));
                }
            }
        }
        pairs
    }
}
