//! PNG output of a scene, drawn from the same paths and glyph outlines as [`super::svg`]. `tests/mod.rs` and
//! docs/figures-and-report.md state the resolution. Another version of `tiny_skia` or `png` can change the bytes.

use tiny_skia::{Color, FillRule, LineJoin, Mask, Paint as Brush, PathBuilder, Pixmap, StrokeDash, Transform};

use super::font::{lay_out_glyphs, outline, units_per_em};
use super::path::{PathStep, VectorPath};
use super::scene::{Paint, Rgb, Scene, SceneItem, Shape, Stroke, Text};

/// Pixels per inch.
pub(crate) const DPI: f64 = 300.0;
/// Points per inch.
const POINTS_PER_INCH: f64 = 72.0;
/// Colour of ink, repeated in the style of [`super::svg`] and as `--ink` in the report's `page.css`.
const INK: Rgb = Rgb(0x1a, 0x1a, 0x1a);
/// No clipping.
const NO_CLIP: Option<&Mask> = None;

/// Renders `scene` as PNG at `DPI`, dark on white.
///
/// # Panics
/// If the canvas is too large for memory.
pub fn png(scene: &Scene) -> Vec<u8> {
    let scale = DPI / POINTS_PER_INCH;
    let (w, h) = (
        (scene.width * DPI / POINTS_PER_INCH).ceil() as u32,
        (scene.height * DPI / POINTS_PER_INCH).ceil() as u32,
    );
    // `Pixmap::new` rejects a side of 0.
    let mut pixmap = Pixmap::new(w.max(1), h.max(1)).expect("a canvas of a few inches");
    pixmap.fill(Color::WHITE);
    let to_pixels = Transform::from_scale(scale as f32, scale as f32);
    for item in &scene.items {
        match item {
            SceneItem::Shape(shape) => draw_shape(&mut pixmap, shape, to_pixels),
            SceneItem::Text(text) => draw_text(&mut pixmap, text, to_pixels),
        }
    }
    encode(&pixmap)
}

fn encode(pixmap: &Pixmap) -> Vec<u8> {
    // The background is opaque and so is each pixel: alpha can be omitted.
    let rgb: Vec<u8> = pixmap.data().chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect();
    let mut file = Vec::new();
    let mut encoder = png::Encoder::new(&mut file, pixmap.width(), pixmap.height());
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let per_metre = (DPI / 0.0254).round() as u32;
    encoder.set_pixel_dims(Some(png::PixelDimensions {
        xppu: per_metre,
        yppu: per_metre,
        unit: png::Unit::Meter,
    }));
    let mut writer = encoder.write_header().expect("memory takes everything");
    writer.write_image_data(&rgb).expect("memory takes everything");
    writer.finish().expect("memory takes everything");
    file
}

fn brush(paint: Paint, opacity: f64) -> Brush<'static> {
    let Rgb(r, g, b) = match paint {
        Paint::Ink => INK,
        Paint::Paper => Rgb(255, 255, 255),
        Paint::Colour(rgb) => rgb,
    };
    let mut brush = Brush::default();
    brush.set_color_rgba8(r, g, b, (opacity * 255.0).round() as u8);
    brush.anti_alias = true;
    brush
}

fn to_skia_path(path: &VectorPath) -> Option<tiny_skia::Path> {
    let mut builder = PathBuilder::new();
    for step in &path.0 {
        match *step {
            PathStep::Move(x, y) => builder.move_to(x as f32, y as f32),
            PathStep::Line(x, y) => builder.line_to(x as f32, y as f32),
            PathStep::Quad(a, b, x, y) => builder.quad_to(a as f32, b as f32, x as f32, y as f32),
            PathStep::Cubic(a, b, c, d, x, y) => {
                builder.cubic_to(a as f32, b as f32, c as f32, d as f32, x as f32, y as f32);
            }
            PathStep::Close => builder.close(),
        }
    }
    builder.finish()
}

fn draw_shape(pixmap: &mut Pixmap, shape: &Shape, to_pixels: Transform) {
    let Some(path) = to_skia_path(&shape.path) else { return };
    let [left, top, right, bottom] = shape.path.bounds();
    // An interval of no width has nothing to fill.
    let has_surface = right - left > 1e-6 && bottom - top > 1e-6;
    if let Some((paint, opacity)) = shape.fill.filter(|_| has_surface) {
        pixmap.fill_path(&path, &brush(paint, opacity), FillRule::Winding, to_pixels, NO_CLIP);
    }
    if let Some(Stroke {
        paint,
        opacity,
        width,
        dashes,
    }) = shape.stroke
    {
        let dashes: Vec<f32> = dashes.iter().map(|d| *d as f32).collect();
        let stroke = tiny_skia::Stroke {
            width: width as f32,
            line_join: LineJoin::Round,
            dash: StrokeDash::new(dashes, 0.0),
            ..tiny_skia::Stroke::default()
        };
        pixmap.stroke_path(&path, &brush(paint, opacity), &stroke, to_pixels, NO_CLIP);
    }
}

fn draw_text(pixmap: &mut Pixmap, text: &Text, to_pixels: Transform) {
    let (x, y) = text.start();
    let scale = (text.size / units_per_em(text.weight)) as f32;
    let mut base_line_to_pixels = to_pixels.pre_translate(x as f32, y as f32);
    if text.is_vertical {
        base_line_to_pixels = base_line_to_pixels.pre_concat(Transform::from_row(0.0, -1.0, 1.0, 0.0, 0.0, 0.0));
    }
    // Outlines of glyphs are in font units, y upwards.
    let text_to_pixels = base_line_to_pixels.pre_scale(scale, -scale);
    for (glyph, at) in lay_out_glyphs(&text.text, text.weight).0 {
        if let Some(path) = to_skia_path(&outline(glyph)) {
            let glyph_to_pixels = text_to_pixels.pre_translate(at as f32, 0.0);
            pixmap.fill_path(
                &path,
                &brush(text.paint, 1.0),
                FillRule::Winding,
                glyph_to_pixels,
                NO_CLIP,
            );
        }
    }
}
