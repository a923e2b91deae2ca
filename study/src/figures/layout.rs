//! Sizes that all pictures share.

/// Width of a picture, points: 3.5 inch.
pub const COLUMN: f64 = 252.0;
/// Width of a picture across both columns, points.
pub const WIDE: f64 = 516.0;
/// The smallest font size, points.
pub const SMALL: f64 = 8.0;
/// The font size of titles, points.
pub const LARGE: f64 = 9.5;
/// Distance of lines of text, points.
pub const LEADING: f64 = 10.5;
/// Distance from everything to the border, points.
pub const EDGE: f64 = 6.0;
