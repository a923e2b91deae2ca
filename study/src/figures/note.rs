//! Labels next to points of a chart, placed where there is room. `pareto` labels points with N, `front` with settings;
//! [`super::chart`] places the labels. Only their positions and the choice of omitted labels depend on this module.

use super::font::{Weight, text_width};
use super::path::{Rect, boxes_overlap};
use super::scene::{Anchor, Text};
use super::style::{MARKER_RADIUS, TEXT_SIZE};

/// A label next to a point of a chart, in units of the axes. The chart converts it and calls [`place_notes`].
#[derive(Clone, Debug, PartialEq)]
pub struct Note {
    /// Value on the x axis.
    pub x: f64,
    /// Value on the y axis.
    pub y: f64,
    /// Characters of the label.
    pub text: String,
}

/// Items that labels avoid; positions and sizes in typographic points.
#[derive(Clone, Debug, Default)]
pub struct Obstacles {
    /// Centres and radii of markers.
    pub markers: Vec<((f64, f64), f64)>,
    /// Lines, which notes cross only if there is no other room.
    pub lines: Vec<[(f64, f64); 2]>,
    /// Additional gap between a point and its label, for markers larger than in charts, points.
    pub extra_gap: f64,
}

/// Places `labels`, each with its position, within `frame`, clear of each other and of `obstacles`, all in typographic
/// points. Earlier labels have priority; a label without a free side is omitted.
pub fn place_notes(labels: &[((f64, f64), &str)], obstacles: &Obstacles, frame: Rect) -> Vec<Text> {
    let markers = obstacles.markers.iter();
    let marker_boxes: Vec<Rect> = markers.map(|&((x, y), r)| [x - r, y - r, x + r, y + r]).collect();
    let mut placed: Vec<Text> = Vec::new();
    for &(point, label) in labels {
        let placed_boxes: Vec<Rect> = placed.iter().map(Text::bounds).collect();
        let is_free = |text: &Text| {
            let bounds = text.bounds();
            let is_inside =
                bounds[0] >= frame[0] && bounds[1] >= frame[1] && bounds[2] <= frame[2] && bounds[3] <= frame[3];
            is_inside
                && !marker_boxes
                    .iter()
                    .chain(&placed_boxes)
                    .any(|other| boxes_overlap(&bounds, other))
        };
        let crossing_count = |text: &Text| {
            let bounds = box_above_base_line(text);
            obstacles
                .lines
                .iter()
                .filter(|line| crosses_box(bounds, **line))
                .count()
        };
        // Of equally good sides `min_by_key` takes the first.
        let best = candidate_texts(point, label, obstacles.extra_gap)
            .into_iter()
            .filter(is_free)
            .min_by_key(crossing_count);
        placed.extend(best);
    }
    placed
}

/// Returns the box of a text without the room for descenders. Numbers have none; the brackets and commas of settings
/// may cross a line.
fn box_above_base_line(text: &Text) -> Rect {
    let [left, top, right, _] = text.bounds();
    [left, top, right, text.at.1]
}

/// Returns whether a line crosses a box: its part between left and right overlaps its part between top and bottom.
fn crosses_box([left, top, right, bottom]: Rect, [from, to]: [(f64, f64); 2]) -> bool {
    // Shares of the line at which it enters and leaves the box.
    let (mut entry_share, mut exit_share) = (0.0_f64, 1.0_f64);
    for (start_coordinate, length, low, high) in [
        (from.0, to.0 - from.0, left, right),
        (from.1, to.1 - from.1, top, bottom),
    ] {
        if length == 0.0 {
            if start_coordinate <= low || start_coordinate >= high {
                return false;
            }
        } else {
            let (a, b) = ((low - start_coordinate) / length, (high - start_coordinate) / length);
            (entry_share, exit_share) = (entry_share.max(a.min(b)), exit_share.min(a.max(b)));
        }
    }
    entry_share < exit_share
}

/// Returns candidate texts right of, left of, above, below and in the corners around a point, in order of preference.
fn candidate_texts((x, y): (f64, f64), label: &str, extra_gap: f64) -> [Text; 8] {
    // Gap between the point and the text, points.
    let gap = MARKER_RADIUS + 2.0 + extra_gap;
    let half_width = 0.5 * text_width(label, Weight::Regular, TEXT_SIZE);
    let middle = y + 0.36 * TEXT_SIZE;
    let (above, below) = (y - gap - 0.24 * TEXT_SIZE, y + gap + 0.76 * TEXT_SIZE);
    let text = |x: f64, y: f64| Text::new(label, (x, y), TEXT_SIZE).anchored(Anchor::Middle);
    [
        text(x + gap + half_width, middle),
        text(x - gap - half_width, middle),
        text(x, above),
        text(x, below),
        text(x + MARKER_RADIUS + half_width, above),
        text(x - MARKER_RADIUS - half_width, above),
        text(x + MARKER_RADIUS + half_width, below),
        text(x - MARKER_RADIUS - half_width, below),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    const FRAME: Rect = [0.0, 0.0, 100.0, 100.0];

    #[test]
    fn notes_do_not_overlap_notes_markers_or_the_border() {
        let points: Vec<(f64, f64)> = (0..10).map(|i| (50.0 + 0.5 * f64::from(i), 50.0)).collect();
        let notes: Vec<_> = points.iter().map(|point| (*point, "250")).collect();
        let markers = points.iter().map(|point| (*point, MARKER_RADIUS)).collect();
        let obstacles = Obstacles {
            markers,
            ..Obstacles::default()
        };
        let placed = place_notes(&notes, &obstacles, FRAME);
        assert!((2..10).contains(&placed.len()), "{placed:?}");
        for (i, note) in placed.iter().enumerate() {
            assert!(
                placed[..i]
                    .iter()
                    .all(|other| !boxes_overlap(&note.bounds(), &other.bounds()))
            );
            for (x, y) in &points {
                assert!(
                    !boxes_overlap(&note.bounds(), &[x - 1.0, y - 1.0, x + 1.0, y + 1.0]),
                    "{note:?}"
                );
            }
        }
        let corner = place_notes(&[((99.0, 1.0), "10")], &Obstacles::default(), FRAME);
        let [left, top, right, bottom] = corner[0].bounds();
        assert!(left >= 0.0 && top >= 0.0 && right <= 100.0 && bottom <= 100.0);
    }

    #[test]
    fn the_first_note_has_the_best_place() {
        let placed = place_notes(
            &[((50.0, 50.0), "10"), ((50.0, 50.0), "20")],
            &Obstacles::default(),
            FRAME,
        );
        assert_eq!(placed[0].text, "10");
        assert!(placed[0].bounds()[0] > 50.0 && placed[1].bounds()[2] < 50.0);
    }

    #[test]
    fn notes_cross_lines_only_without_other_space() {
        let to_the_right = [(50.0, 50.0), (100.0, 50.0)];
        let obstacles = |lines: &[[(f64, f64); 2]]| Obstacles {
            markers: vec![((50.0, 50.0), MARKER_RADIUS)],
            lines: lines.to_vec(),
            extra_gap: 0.0,
        };
        let placed = place_notes(&[((50.0, 50.0), "10")], &obstacles(&[to_the_right]), FRAME);
        assert!(placed[0].bounds()[2] < 50.0, "{placed:?}");
        // Lines so close that every side is crossed.
        let everywhere: Vec<_> = (0..100).map(|y| [(0.0, f64::from(y)), (100.0, f64::from(y))]).collect();
        assert_eq!(
            place_notes(&[((50.0, 50.0), "10")], &obstacles(&everywhere), FRAME).len(),
            1
        );
    }

    #[test]
    fn a_line_through_a_box_or_inside_it_crosses_it() {
        let corners = [10.0, 10.0, 20.0, 20.0];
        for (line, expected) in [
            ([(0.0, 0.0), (30.0, 30.0)], true),
            ([(15.0, 12.0), (16.0, 13.0)], true),
            ([(15.0, 0.0), (15.0, 30.0)], true),
            ([(0.0, 15.0), (9.0, 15.0)], false),
            ([(0.0, 12.0), (12.0, 0.0)], false),
            ([(25.0, 0.0), (25.0, 30.0)], false),
        ] {
            assert_eq!(crosses_box(corners, line), expected, "{line:?}");
        }
    }
}
