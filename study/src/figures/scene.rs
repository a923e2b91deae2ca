//! A picture before it is a file: shapes and lines of text on a canvas, in points (1/72 inch), y downwards.
//!
//! SVG and PNG are both made from this, and neither adds anything: what is in the scene is in both.

use super::font::{Weight, width};
use super::path::Path;

/// A colour of 8 bits a channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rgb(pub u8, pub u8, pub u8);

/// What something is painted with. Ink and paper change places where a page is shown in the dark.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Paint {
    /// The colour of text and axes.
    Ink,
    /// The ground.
    Paper,
    /// A colour that stays.
    Colour(Rgb),
}

/// How a line is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stroke {
    /// The paint that it is drawn with.
    pub paint: Paint,
    /// Opacity, `(0, 1]`.
    pub opacity: f64,
    /// Width, points, > 0.
    pub width: f64,
    /// Lengths of dashes and gaps by turns, points; empty for a solid line. An even number of them.
    pub dashes: &'static [f64],
}

impl Stroke {
    /// A solid line.
    pub const fn solid(paint: Paint, width: f64) -> Self {
        Self {
            paint,
            opacity: 1.0,
            width,
            dashes: &[],
        }
    }

    /// The same line, dashed.
    #[must_use]
    pub const fn dashed(self, dashes: &'static [f64]) -> Self {
        Self { dashes, ..self }
    }

    /// The same line, paler.
    #[must_use]
    pub const fn faded(self, opacity: f64) -> Self {
        Self { opacity, ..self }
    }
}

/// A path with what fills it and what goes along it.
#[derive(Clone, Debug, PartialEq)]
pub struct Shape {
    /// The path.
    pub path: Path,
    /// What fills it, and how opaque, `(0, 1]`.
    pub fill: Option<(Paint, f64)>,
    /// What goes along it.
    pub stroke: Option<Stroke>,
}

/// Which point of a line of text its position means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Anchor {
    /// Its start.
    Start,
    /// Its middle.
    Middle,
    /// Its end.
    End,
}

/// One line of text.
#[derive(Clone, Debug, PartialEq)]
pub struct Text {
    /// What it says.
    pub text: String,
    /// Where its base line is, points.
    pub at: (f64, f64),
    /// Font size, points.
    pub size: f64,
    /// Its weight.
    pub weight: Weight,
    /// What of it is at `at`.
    pub anchor: Anchor,
    /// Whether it reads from bottom to top.
    pub upwards: bool,
    /// The paint that it is drawn with.
    pub paint: Paint,
}

impl Text {
    /// Text in ink that starts at `at`.
    pub fn new(text: impl Into<String>, at: (f64, f64), size: f64) -> Self {
        Self {
            text: text.into(),
            at,
            size,
            weight: Weight::Regular,
            anchor: Anchor::Start,
            upwards: false,
            paint: Paint::Ink,
        }
    }

    /// The same text, held by another point.
    #[must_use]
    pub fn anchored(self, anchor: Anchor) -> Self {
        Self { anchor, ..self }
    }

    /// The same text, bold.
    #[must_use]
    pub fn bold(self) -> Self {
        Self {
            weight: Weight::Bold,
            ..self
        }
    }

    /// Where its base line starts, points.
    pub fn start(&self) -> (f64, f64) {
        let length = width(&self.text, self.weight, self.size);
        let back = match self.anchor {
            Anchor::Start => 0.0,
            Anchor::Middle => 0.5 * length,
            Anchor::End => length,
        };
        if self.upwards {
            (self.at.0, self.at.1 + back)
        } else {
            (self.at.0 - back, self.at.1)
        }
    }

    /// The corners of the box around it: left, top, right, bottom, points. Ascent and descent are those of the font.
    pub fn bounds(&self) -> [f64; 4] {
        let (x, y) = self.start();
        let length = width(&self.text, self.weight, self.size);
        let (ascent, descent) = (0.76 * self.size, 0.24 * self.size);
        if self.upwards {
            [x - ascent, y - length, x + descent, y]
        } else {
            [x, y - ascent, x + length, y + descent]
        }
    }
}

/// One thing in a picture.
#[derive(Clone, Debug, PartialEq)]
pub enum Item {
    /// A shape.
    Shape(Shape),
    /// A line of text.
    Text(Text),
}

impl Item {
    /// The corners of the box around it: left, top, right, bottom, points; the width of lines counts.
    pub fn bounds(&self) -> [f64; 4] {
        match self {
            Self::Shape(shape) => {
                let [left, top, right, bottom] = shape.path.bounds();
                let out = shape.stroke.map_or(0.0, |s| 0.5 * s.width);
                [left - out, top - out, right + out, bottom + out]
            }
            Self::Text(text) => text.bounds(),
        }
    }
}

/// A picture.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// Its title, for those who cannot see it.
    pub title: String,
    /// What it shows, for those who cannot see it.
    pub description: String,
    /// Width of the canvas, points.
    pub width: f64,
    /// Height of the canvas, points.
    pub height: f64,
    /// What is on it, from back to front.
    pub items: Vec<Item>,
}

impl Scene {
    /// An empty canvas.
    pub const fn new(width: f64, height: f64) -> Self {
        Self {
            title: String::new(),
            description: String::new(),
            width,
            height,
            items: Vec::new(),
        }
    }

    /// Puts a line on top.
    pub fn line(&mut self, path: Path, stroke: Stroke) {
        self.items.push(Item::Shape(Shape {
            path,
            fill: None,
            stroke: Some(stroke),
        }));
    }

    /// Puts an area on top.
    pub fn area(&mut self, path: Path, paint: Paint, opacity: f64) {
        self.items.push(Item::Shape(Shape {
            path,
            fill: Some((paint, opacity)),
            stroke: None,
        }));
    }

    /// Puts an area with a border on top.
    pub fn outlined(&mut self, path: Path, fill: Paint, stroke: Stroke) {
        self.items.push(Item::Shape(Shape {
            path,
            fill: Some((fill, 1.0)),
            stroke: Some(stroke),
        }));
    }

    /// Puts text on top.
    pub fn text(&mut self, text: Text) {
        self.items.push(Item::Text(text));
    }

    /// Puts all that is on another canvas on top, its corner at `at`.
    pub fn put(&mut self, other: Self, at: (f64, f64)) {
        let moved = other.items.into_iter().map(|item| match item {
            Item::Shape(shape) => Item::Shape(Shape {
                path: shape.path.moved(at),
                ..shape
            }),
            Item::Text(text) => Item::Text(Text {
                at: (text.at.0 + at.0, text.at.1 + at.1),
                ..text
            }),
        });
        self.items.extend(moved);
    }

    /// The items that are not wholly on the canvas. A scene that is fit to be seen has none.
    pub fn outside(&self) -> Vec<&Item> {
        let is_outside = |item: &&Item| {
            let [left, top, right, bottom] = item.bounds();
            !(left >= -0.01 && top >= -0.01 && right <= self.width + 0.01 && bottom <= self.height + 0.01)
        };
        self.items.iter().filter(is_outside).collect()
    }

    /// The lines of text that stand on top of each other, in pairs.
    pub fn overlapping(&self) -> Vec<(&str, &str)> {
        let texts: Vec<&Text> = self
            .items
            .iter()
            .filter_map(|item| match item {
                Item::Text(text) => Some(text),
                Item::Shape(_) => None,
            })
            .collect();
        let mut pairs = Vec::new();
        for (i, a) in texts.iter().enumerate() {
            for b in &texts[..i] {
                let (p, q) = (a.bounds(), b.bounds());
                if p[0] < q[2] && q[0] < p[2] && p[1] < q[3] && q[1] < p[3] {
                    pairs.push((b.text.as_str(), a.text.as_str()));
                }
            }
        }
        pairs
    }
}
