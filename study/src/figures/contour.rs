//! Contour lines of values on a grid, as segments, for the tuning figure. Nothing else depends on it.

/// A point of the unit square.
type UnitPoint = (f64, f64);

/// Returns the contour at `level` as segments (marching squares). `rows` ascend in y and have equal length. Their
/// values are at the middles of equal cells of the unit square, and stay constant beyond the outermost middles.
pub(super) fn contour_segments(rows: &[Vec<f64>], level: f64) -> Vec<(UnitPoint, UnitPoint)> {
    let (row_count, column_count) = (rows.len(), rows.first().map_or(0, Vec::len));
    let mut segments = Vec::new();
    if row_count == 0 || column_count == 0 {
        return segments;
    }
    // Nodes 0 and n + 1 lie on the border and have the values of their neighbours.
    let position = |i: usize, count: usize| ((i as f64 - 0.5) / count as f64).clamp(0.0, 1.0);
    let value = |i: usize, j: usize| rows[j.clamp(1, row_count) - 1][i.clamp(1, column_count) - 1];
    for j in 0..=row_count {
        for i in 0..=column_count {
            let corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
                .map(|(i, j)| ((position(i, column_count), position(j, row_count)), value(i, j)));
            let mut crossings = Vec::new();
            for side in 0..4 {
                let ((a, value_a), (b, value_b)) = (corners[side], corners[(side + 1) % 4]);
                if (value_a >= level) != (value_b >= level) {
                    // The two values lie on different sides of the level, so they differ.
                    let share = (level - value_a) / (value_b - value_a);
                    crossings.push((a.0 + share * (b.0 - a.0), a.1 + share * (b.1 - a.1)));
                }
            }
            // With four crossings the middle decides which corners are connected.
            if crossings.len() == 4 {
                let middle = corners.iter().map(|(_, value)| value).sum::<f64>() / 4.0;
                if (middle >= level) != (corners[0].1 >= level) {
                    crossings.rotate_left(1);
                }
            }
            // A line that enters a cell leaves it, so the number of crossings is even.
            segments.extend(crossings.chunks_exact(2).map(|pair| (pair[0], pair[1])));
        }
    }
    segments
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the values of `function` in the middles of 40 × 40 cells of the unit square.
    fn grid(function: impl Fn(f64, f64) -> f64) -> Vec<Vec<f64>> {
        let middle = |i: u32| (f64::from(i) + 0.5) / 40.0;
        (0..40)
            .map(|j| (0..40).map(|i| function(middle(i), middle(j))).collect())
            .collect()
    }

    fn total_length(segments: &[(UnitPoint, UnitPoint)]) -> f64 {
        let segment_length =
            |(a, b): &(UnitPoint, UnitPoint)| ((a.0 - b.0) * (a.0 - b.0) + (a.1 - b.1) * (a.1 - b.1)).sqrt();
        segments.iter().map(segment_length).sum()
    }

    #[test]
    fn the_contour_of_a_cone_is_a_circle() {
        let cone = grid(|x, y| ((x - 0.5) * (x - 0.5) + (y - 0.5) * (y - 0.5)).sqrt());
        let segments = contour_segments(&cone, 0.3);
        assert!(
            (total_length(&segments) - 0.6 * std::f64::consts::PI).abs() < 0.01,
            "length {}",
            total_length(&segments)
        );
        for (a, _) in &segments {
            let radius = ((a.0 - 0.5) * (a.0 - 0.5) + (a.1 - 0.5) * (a.1 - 0.5)).sqrt();
            assert!((radius - 0.3).abs() < 0.002, "radius {radius}");
        }
        assert!(contour_segments(&cone, 2.0).is_empty() && contour_segments(&[], 0.0).is_empty());
    }

    #[test]
    fn the_contour_of_a_plane_reaches_from_edge_to_edge() {
        let segments = contour_segments(&grid(|x, _| x), 0.4);
        assert!(
            (total_length(&segments) - 1.0).abs() < 1e-9,
            "length {}",
            total_length(&segments)
        );
        assert!(
            segments
                .iter()
                .all(|(a, b)| (a.0 - 0.4).abs() < 1e-9 && (b.0 - 0.4).abs() < 1e-9)
        );
    }

    #[test]
    fn contours_do_not_cross_at_a_saddle() {
        // The middle (0.5) is above the level, so the high corners are connected.
        let saddle = vec![vec![1.0, 0.0], vec![0.0, 1.0]];
        let segments = contour_segments(&saddle, 0.4);
        assert!(!segments.is_empty());
        // Each segment lies on one side of the diagonal through the high corners.
        for (a, b) in segments {
            let side = |p: &UnitPoint| p.1 - p.0;
            assert!(side(&a) * side(&b) > 0.0, "{a:?} to {b:?}");
        }
    }
}
