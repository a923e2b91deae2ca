//! SVG output of a scene. [`super::png`] draws the same scene; neither adds anything to it.
//!
//! Text is written as outlines. Ink is `currentColor` and the background has the class `paper`, so that a page with the
//! figure can swap both in dark mode, as `page.css` of the report does. A standalone figure is dark on white.
//! `docs/figures/make.sh` inserts a background before the line `<defs>`.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use super::font::{Glyph, Weight, lay_out_glyphs, outline, units_per_em};
use super::path::{PathStep, VectorPath};
use super::scene::{Paint, Rgb, Scene, SceneItem, Shape, Text};

/// Renders `scene` as SVG. `name` makes its identifiers unique among figures on the same page. It is not escaped, so it
/// must not contain spaces or characters reserved in XML.
pub fn svg(scene: &Scene, name: &str) -> String {
    let mut glyphs: BTreeMap<Glyph, String> = BTreeMap::new();
    let mut body = String::new();
    for item in &scene.items {
        match item {
            SceneItem::Shape(shape) => body.push_str(&shape_element(shape)),
            SceneItem::Text(text) => body.push_str(&text_element(text, name, &mut glyphs)),
        }
    }
    let (w, h) = (number(scene.width), number(scene.height));
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" xmlns:xlink=\"http://www.w3.org/1999/xlink\" width=\"{w}pt\" \
         height=\"{h}pt\" viewBox=\"0 0 {w} {h}\" color=\"#1a1a1a\" \
         role=\"img\">\n<title>{}</title>\n<desc>{}</desc>\n<defs>\n",
        escape(&scene.title),
        escape(&scene.description)
    );
    for (glyph, data) in &glyphs {
        let _ = writeln!(out, "<path id=\"{}\" d=\"{data}\"/>", glyph_name(name, *glyph));
    }
    let _ = write!(
        out,
        "</defs>\n<rect class=\"paper\" width=\"{w}\" height=\"{h}\" fill=\"#fff\"/>\n{body}</svg>\n"
    );
    out
}

/// Escapes `text` for XML.
pub(crate) fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}

/// Formats a number with at most two decimals.
fn number(x: f64) -> String {
    let text = format!("{x:.2}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    // A small negative number is rounded to -0.00.
    if text == "-0" { "0".to_owned() } else { text.to_owned() }
}

/// Returns the attribute value of `paint`. The colour of ink alone is the style above and `INK` in [`super::png`].
fn colour(paint: Paint) -> String {
    match paint {
        Paint::Ink => "currentColor".to_owned(),
        Paint::Paper => "#fff".to_owned(),
        Paint::Colour(Rgb(r, g, b)) => format!("#{r:02x}{g:02x}{b:02x}"),
    }
}

fn class_attribute(paint: Paint) -> &'static str {
    match paint {
        Paint::Paper => " class=\"paper\"",
        Paint::Ink | Paint::Colour(_) => "",
    }
}

fn path_data(path: &VectorPath) -> String {
    let mut out = String::new();
    for step in &path.0 {
        let (letter, numbers): (char, &[f64]) = match step {
            PathStep::Move(x, y) => ('M', &[*x, *y]),
            PathStep::Line(x, y) => ('L', &[*x, *y]),
            PathStep::Quad(a, b, x, y) => ('Q', &[*a, *b, *x, *y]),
            PathStep::Cubic(a, b, c, d, x, y) => ('C', &[*a, *b, *c, *d, *x, *y]),
            PathStep::Close => ('Z', &[]),
        };
        out.push(letter);
        let numbers: Vec<String> = numbers.iter().map(|x| number(*x)).collect();
        out.push_str(&numbers.join(" "));
    }
    out
}

fn shape_element(shape: &Shape) -> String {
    let mut out = format!("<path d=\"{}\"", path_data(&shape.path));
    match shape.fill {
        Some((paint, opacity)) => {
            let _ = write!(out, "{} fill=\"{}\"", class_attribute(paint), colour(paint));
            if opacity < 1.0 {
                let _ = write!(out, " fill-opacity=\"{}\"", number(opacity));
            }
        }
        None => out.push_str(" fill=\"none\""),
    }
    if let Some(stroke) = shape.stroke {
        let (paint, width) = (colour(stroke.paint), number(stroke.width));
        let _ = write!(
            out,
            " stroke=\"{paint}\" stroke-width=\"{width}\" stroke-linejoin=\"round\""
        );
        if stroke.opacity < 1.0 {
            let _ = write!(out, " stroke-opacity=\"{}\"", number(stroke.opacity));
        }
        if !stroke.dashes.is_empty() {
            let dashes: Vec<String> = stroke.dashes.iter().map(|x| number(*x)).collect();
            let _ = write!(out, " stroke-dasharray=\"{}\"", dashes.join(" "));
        }
    }
    out.push_str("/>\n");
    out
}

fn text_element(text: &Text, name: &str, glyphs: &mut BTreeMap<Glyph, String>) -> String {
    let (x, y) = text.start();
    // Fonts have thousands of units per em, so the scale needs more than two decimals below.
    let scale = text.size / units_per_em(text.weight);
    let turn = if text.is_vertical { " rotate(-90)" } else { "" };
    let mut out = format!(
        "<g transform=\"translate({} {}){turn} scale({scale:.7} -{scale:.7})\" fill=\"{}\">",
        number(x),
        number(y),
        colour(text.paint)
    );
    for (glyph, at) in lay_out_glyphs(&text.text, text.weight).0 {
        let data = glyphs.entry(glyph).or_insert_with(|| path_data(&outline(glyph)));
        if !data.is_empty() {
            let _ = write!(out, "<use xlink:href=\"#{}\" x=\"{at}\"/>", glyph_name(name, glyph));
        }
    }
    out.push_str("</g>\n");
    out
}

fn glyph_name(name: &str, glyph: Glyph) -> String {
    let weight = match glyph.weight {
        Weight::Regular => 'r',
        Weight::Bold => 'b',
    };
    format!("{name}-{weight}{}", glyph.id)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_at_most_two_decimals() {
        for (x, text) in [
            (1.0, "1"),
            (-0.001, "0"),
            (2.504, "2.5"),
            (-3.456, "-3.46"),
            (100.0, "100"),
        ] {
            assert_eq!(number(x), text);
        }
    }

    #[test]
    fn characters_reserved_in_xml_are_escaped() {
        assert_eq!(escape("a < b & \"c\" > d"), "a &lt; b &amp; &quot;c&quot; &gt; d");
    }
}
