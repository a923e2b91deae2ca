//! A bucket grid that finds the points within a radius of a place, or nearest to it: for world, beliefs, policies and
//! run tables. The order of results is fixed, and [`Buckets::nearest`] breaks ties by index: decisions and digests must
//! not differ between runs. Sums over the results depend on the order of visits, so a change of the cells can
//! change digests.

use super::{Area, Point};

/// Points sorted into the cells of a grid, for queries that touch only the cells nearby. It is built once for a
/// deployment and never changes.
#[derive(Clone, Debug)]
pub struct Buckets {
    columns: usize,
    rows: usize,
    /// Cells per metre east and north.
    cells_per_metre: Point,
    /// Added to every query's radius, metres, so that rounding at a cell's border cannot hide a point.
    slack: f64,
    /// The points of cell c are `points[cell_starts[c] .. cell_starts[c + 1]]`.
    cell_starts: Vec<u32>,
    /// The points cell by cell, each with its index in the slice of [`Self::new`].
    points: Vec<(u32, Point)>,
}

impl Buckets {
    /// Creates a grid over `points` of `area`, fastest for queries of about `radius` metres, ≥ 0. Queries of any other
    /// radius are correct too. There are at most about as many cells as points.
    pub fn new(points: &[Point], area: Area, radius: f64) -> Self {
        let spacing = (area.surface() / points.len().max(1) as f64).sqrt();
        // Cells no smaller than the mean spacing: a small radius would otherwise need more cells than points.
        let side = radius.max(spacing);
        let cells = |length: f64| ((length / side) as usize).clamp(1, points.len().max(1));
        let (columns, rows) = (cells(area.width), cells(area.height));
        let mut buckets = Self {
            columns,
            rows,
            cells_per_metre: Point::new(columns as f64 / area.width, rows as f64 / area.height),
            slack: 1e-12 * (area.width + area.height),
            cell_starts: vec![0; columns * rows + 1],
            points: vec![(0, Point::default()); points.len()],
        };
        for &p in points {
            let cell = buckets.cell_index(p);
            buckets.cell_starts[cell + 1] += 1;
        }
        for cell in 0..columns * rows {
            buckets.cell_starts[cell + 1] += buckets.cell_starts[cell];
        }
        // A counting sort keeps points of a cell in the order of their indices, so queries visit them alike in every
        // run.
        let mut next_free = buckets.cell_starts.clone();
        for (index, &p) in (0..).zip(points) {
            let cell = buckets.cell_index(p);
            buckets.points[next_free[cell] as usize] = (index, p);
            next_free[cell] += 1;
        }
        buckets
    }

    /// Calls `visit(index, distance)` for each point at most `radius` metres from `centre`, with its index in the slice
    /// of [`Self::new`] and its distance in metres. The order is the same in every run but does not follow the indices.
    pub fn within(&self, centre: Point, radius: f64, mut visit: impl FnMut(usize, f64)) {
        self.within_squared(centre, radius, |index, squared| visit(index as usize, squared.sqrt()));
    }

    /// The `k` points nearest to `centre`, or all if there are fewer, by ascending distance and then index. Each has
    /// its squared distance, square metres, and its index: in the other order than in [`Self::within`].
    pub fn nearest(&self, centre: Point, k: usize) -> Vec<(f64, u32)> {
        let mut nearby = Vec::new();
        // One cell wide. Doubling ends, since a radius as large as the area finds all points.
        let mut radius = 1.0 / self.cells_per_metre.x.min(self.cells_per_metre.y);
        loop {
            self.within_squared(centre, radius, |index, squared| nearby.push((squared, index)));
            if nearby.len() >= k.min(self.points.len()) {
                // Ties by index: the order of cells must not decide which of two equally far points is among the `k`.
                nearby.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
                nearby.truncate(k);
                return nearby;
            }
            nearby.clear();
            radius *= 2.0;
        }
    }

    /// Calls `visit(index, squared distance)` for each point at most `radius` metres from `centre`.
    fn within_squared(&self, centre: Point, radius: f64, mut visit: impl FnMut(u32, f64)) {
        let padded_radius = radius * (1.0 + 1e-12) + self.slack;
        // A square above this is too far despite rounding, and skips the root.
        let max_squared = padded_radius * padded_radius * (1.0 + 1e-12);
        // A square below this is near despite rounding, and skips it too.
        let sure_squared = radius * radius * (1.0 - 1e-12);
        let (west_column, east_column) = (
            self.column(centre.x - padded_radius),
            self.column(centre.x + padded_radius),
        );
        let (south_row, north_row) = (self.row(centre.y - padded_radius), self.row(centre.y + padded_radius));
        for row in south_row..=north_row {
            let start = self.cell_starts[row * self.columns + west_column] as usize;
            let end = self.cell_starts[row * self.columns + east_column + 1] as usize;
            for &(index, p) in &self.points[start..end] {
                let squared = centre.distance_squared(p);
                // Squaring rounds, so a point exactly at the radius is decided by the root, as in `Point::distance`.
                if squared <= sure_squared || squared <= max_squared && squared.sqrt() <= radius {
                    visit(index, squared);
                }
            }
        }
    }

    fn cell_index(&self, p: Point) -> usize {
        self.row(p.y) * self.columns + self.column(p.x)
    }

    /// The column of the cells at `x`. The conversion saturates, so positions west of the area belong to its first
    /// column.
    fn column(&self, x: f64) -> usize {
        ((x * self.cells_per_metre.x) as usize).min(self.columns - 1)
    }

    fn row(&self, y: f64) -> usize {
        ((y * self.cells_per_metre.y) as usize).min(self.rows - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Purpose, Stream};

    fn draw_point(stream: &mut Stream, area: Area) -> Point {
        Point::new(stream.unit() * area.width, stream.unit() * area.height)
    }

    /// Returns the points within `radius` with their distances, by index.
    fn find_within(buckets: &Buckets, centre: Point, radius: f64) -> Vec<(usize, f64)> {
        let mut within = Vec::new();
        buckets.within(centre, radius, |index, distance| within.push((index, distance)));
        within.sort_by_key(|&(index, _)| index);
        within
    }

    /// Finds the same points by a full scan.
    fn scan_within(points: &[Point], centre: Point, radius: f64) -> Vec<(usize, f64)> {
        let distances = points.iter().map(|p| centre.distance(*p)).enumerate();
        distances.filter(|&(_, d)| d <= radius).collect()
    }

    #[test]
    fn within_equals_a_full_scan() {
        let mut stream = Stream::new(1, Purpose::Epicentre, 0);
        for (width, height) in [(20.0, 20.0), (100.0, 3.0), (0.5, 70.0), (1e6, 1e-6)] {
            let area = Area { width, height };
            for n in [0, 1, 2, 17, 400] {
                let points: Vec<_> = (0..n).map(|_| draw_point(&mut stream, area)).collect();
                for bucket_radius in [1e-3, 4.0, 1000.0] {
                    let buckets = Buckets::new(&points, area, bucket_radius);
                    for radius in [0.0, 0.3, 4.0, 25.0, 1e7] {
                        let centre = draw_point(&mut stream, area);
                        assert_eq!(
                            find_within(&buckets, centre, radius),
                            scan_within(&points, centre, radius),
                            "{n} points on {width} m x {height} m, buckets for {bucket_radius} m, radius {radius} m"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn nearest_equals_a_full_sort() {
        let mut stream = Stream::new(2, Purpose::Epicentre, 0);
        for (width, height) in [(20.0, 20.0), (100.0, 3.0), (1e6, 1e-6)] {
            let area = Area { width, height };
            for n in [0, 1, 3, 200] {
                // Each point occurs twice, so that there are equal distances.
                let drawn: Vec<_> = (0..n).map(|_| draw_point(&mut stream, area)).collect();
                let points = [drawn.clone(), drawn].concat();
                let buckets = Buckets::new(&points, area, 0.0);
                for centre in [draw_point(&mut stream, area), Point::default()] {
                    let mut sorted: Vec<_> = (0..)
                        .zip(&points)
                        .map(|(i, p)| (centre.distance_squared(*p), i))
                        .collect();
                    sorted.sort_by(|a, b| a.partial_cmp(b).expect("numbers"));
                    for k in [0, 1, 2, 7, 1000] {
                        let expected = &sorted[..k.min(sorted.len())];
                        assert_eq!(
                            buckets.nearest(centre, k),
                            expected,
                            "{k} nearest of {n} on {width} m x {height} m"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn points_at_the_radius_and_on_bucket_borders_are_found() {
        let area = Area {
            width: 20.0,
            height: 20.0,
        };
        let points: Vec<_> = (0..=20)
            .flat_map(|x| (0..=20).map(move |y| Point::new(f64::from(x), f64::from(y))))
            .collect();
        let buckets = Buckets::new(&points, area, 4.0);
        for &centre in &points {
            for radius in [1.0, 4.0, 5.0] {
                assert_eq!(
                    find_within(&buckets, centre, radius),
                    scan_within(&points, centre, radius),
                    "{centre:?}, radius {radius} m"
                );
            }
        }
    }
}
