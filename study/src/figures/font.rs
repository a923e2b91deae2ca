//! Text as outlines of DejaVu Sans Condensed, so that a figure looks the same on every machine. Layouts measure and
//! wrap text here; [`super::svg`] and [`super::png`] draw the outlines. Other widths would move text in every figure.

use ttf_parser::{Face, GlyphId, OutlineBuilder};

use super::path::{PathStep, VectorPath};

/// Font weight.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Weight {
    /// Weight of running text.
    Regular,
    /// Weight of titles.
    Bold,
}

/// A glyph of the font.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Glyph {
    /// Font weight.
    pub weight: Weight,
    /// Glyph number in the font.
    pub id: u16,
}

/// Parses the font. This reads only its table directory, so the result is not cached.
fn parse_face(weight: Weight) -> Face<'static> {
    let data = match weight {
        Weight::Regular => dejavu::sans_condensed::regular(),
        Weight::Bold => dejavu::sans_condensed::bold(),
    };
    Face::parse(data, 0).expect("the font that Reveille brings along")
}

/// Returns the font units per em.
pub(crate) fn units_per_em(weight: Weight) -> f64 {
    f64::from(parse_face(weight).units_per_em())
}

/// Returns the glyphs of `text` with their positions along the base line, and the total length, in font units. A
/// missing letter becomes the font's box for missing glyphs.
pub(crate) fn lay_out_glyphs(text: &str, weight: Weight) -> (Vec<(Glyph, u32)>, u32) {
    let face = parse_face(weight);
    let mut next_position = 0;
    let glyphs = text
        .chars()
        .map(|letter| {
            // Glyph 0 of a font is its box for missing letters.
            let id = face.glyph_index(letter).unwrap_or(GlyphId(0));
            let position = next_position;
            next_position += u32::from(face.glyph_hor_advance(id).unwrap_or(0));
            (Glyph { weight, id: id.0 }, position)
        })
        .collect();
    (glyphs, next_position)
}

/// Returns the length of `text`, points.
pub(crate) fn text_width(text: &str, weight: Weight, size: f64) -> f64 {
    f64::from(lay_out_glyphs(text, weight).1) * size / units_per_em(weight)
}

/// Returns whether the font has every letter of `text`.
pub(crate) fn has_all_glyphs(text: &str, weight: Weight) -> bool {
    let face = parse_face(weight);
    text.chars().all(|letter| face.glyph_index(letter).is_some())
}

/// Returns the outline of a glyph, in font units, y upwards; empty for a space.
pub(crate) fn outline(glyph: Glyph) -> VectorPath {
    let mut pen = OutlinePen(VectorPath::default());
    // A letter without an outline leaves the path empty.
    let _bounds = parse_face(glyph.weight).outline_glyph(GlyphId(glyph.id), &mut pen);
    pen.0
}

/// Breaks `text` at spaces into lines of at most `limit` points. A longer word gets its own line.
pub(crate) fn wrap_text(text: &str, weight: Weight, size: f64, limit: f64) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split(' ').filter(|word| !word.is_empty()) {
        if let Some(line) = lines.last_mut() {
            let longer = format!("{line} {word}");
            if text_width(&longer, weight, size) <= limit {
                *line = longer;
                continue;
            }
        }
        lines.push(word.to_owned());
    }
    lines
}

struct OutlinePen(VectorPath);

impl OutlineBuilder for OutlinePen {
    fn move_to(&mut self, x: f32, y: f32) {
        self.0.0.push(PathStep::Move(x.into(), y.into()));
    }

    fn line_to(&mut self, x: f32, y: f32) {
        self.0.0.push(PathStep::Line(x.into(), y.into()));
    }

    fn quad_to(&mut self, x1: f32, y1: f32, x: f32, y: f32) {
        self.0.0.push(PathStep::Quad(x1.into(), y1.into(), x.into(), y.into()));
    }

    fn curve_to(&mut self, x1: f32, y1: f32, x2: f32, y2: f32, x: f32, y: f32) {
        let step = PathStep::Cubic(x1.into(), y1.into(), x2.into(), y2.into(), x.into(), y.into());
        self.0.0.push(step);
    }

    fn close(&mut self) {
        self.0.0.push(PathStep::Close);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_font_has_the_symbols_of_the_paper() {
        for weight in [Weight::Regular, Weight::Bold] {
            assert!(has_all_glyphs(
                "αβγδληξτφΨΣÎ≥≤≈±×·−–…°², Pr(S₃|S₁) 0123456789 %",
                weight
            ));
        }
        assert!(!has_all_glyphs("\u{e000}", Weight::Regular));
    }

    #[test]
    fn wrapped_lines_keep_all_words_within_the_width() {
        let text = "knn, random and genie over 1000 runs of 10 000 TTIs each, mean and 95 % interval of the mean";
        let lines = wrap_text(text, Weight::Regular, 8.0, 120.0);
        assert!(lines.len() > 2);
        assert!(lines.iter().all(|line| text_width(line, Weight::Regular, 8.0) <= 120.0));
        assert_eq!(lines.join(" "), text);
        assert_eq!(wrap_text("incomprehensibilities", Weight::Regular, 8.0, 10.0).len(), 1);
    }

    #[test]
    fn a_space_has_a_width_and_no_outline() {
        let (glyphs, length) = lay_out_glyphs("a b", Weight::Regular);
        assert_eq!(outline(glyphs[1].0), VectorPath::default());
        assert!(glyphs[1].1 < glyphs[2].1 && glyphs[2].1 < length);
    }
}
