//! Which sleeping device the base station wakes next, and how much information it asks for (Sec. III and V-A).

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use reveille_common::geometry::{Area, Buckets, Point, farthest_cell_vertex};
use reveille_common::ids::DeviceId;
use reveille_common::sensing::Sensing;

pub use crate::correlation::Correlation;

/// The information per event that a deployment can give wherever the event is, `I_min` = p(d*), `[0, 1]`: the report of
/// the closest device in the worst place, of which d* is the distance (Eq. (`E_Info3`); on a grid Eq. (`E_Info1`)).
pub fn i_min(points: &[Point], area: Area, sensing: &Sensing) -> f64 {
    sensing.p(farthest_cell_vertex(points, area))
}

/// The wake-up candidates of one event after another, each event's by falling `P_4,2` = max over its reporters h of
/// Pr(`S_j` = S3 | `S_h` = S3), ties by device number.
///
/// An event begins with [`Ranking::start`]; every report goes to one of the `add_reporter` methods; [`Ranking::next`]
/// gives the candidate to wake next. Reports may be added between two candidates.
///
/// Most integrals are never computed: a pair of reporter and candidate enters the queue with a cheap upper bound, and
/// is evaluated only when no other candidate is known to be better than that bound.
#[derive(Clone, Debug)]
pub struct Ranking {
    correlation: Correlation,
    buckets: Buckets,
    positions: Vec<Point>,
    queue: BinaryHeap<Entry>,
    /// Where this event's reporters are, and how far from it.
    reporters: Vec<(Point, f64)>,
    /// The number of the last event for which each device was given out.
    given_out: Vec<u64>,
    event: u64,
}

impl Ranking {
    /// A ranking of the devices at `points` in `area`.
    pub fn new(points: &[Point], area: Area, correlation: Correlation) -> Self {
        Self {
            buckets: Buckets::new(points, area, correlation.range()),
            positions: points.to_vec(),
            correlation,
            queue: BinaryHeap::new(),
            reporters: Vec::new(),
            given_out: vec![0; points.len()],
            event: 0,
        }
    }

    /// Begins an event: forgets all reporters and candidates.
    pub fn start(&mut self) {
        self.queue.clear();
        self.reporters.clear();
        self.event += 1;
    }

    /// Takes in the report of a device at `position` that is `d` metres, 0 ..= `d_max`, from the event, with `candidates`.
    /// A device that was already given out for this event is not given out again.
    pub fn add_reporter(&mut self, position: Point, d: f64, candidates: impl IntoIterator<Item = DeviceId>) {
        let reporter = self.add(position, d);
        let (correlation, given_out, positions) = (&self.correlation, &self.given_out, &self.positions);
        let (event, reach) = (self.event, correlation.reach(d));
        self.queue.extend(candidates.into_iter().filter_map(|device| {
            let gamma = position.distance(positions[device.index()]);
            (gamma <= reach && given_out[device.index()] != event)
                .then(|| Entry::bound(correlation, device, reporter, d, gamma))
                .flatten()
        }));
    }

    /// The same with all devices in reach as candidates.
    pub fn add_reporter_to_all(&mut self, position: Point, d: f64) {
        let reporter = self.add(position, d);
        let (correlation, given_out, queue) = (&self.correlation, &self.given_out, &mut self.queue);
        let event = self.event;
        self.buckets.within(position, correlation.reach(d), |index, gamma| {
            if given_out[index] != event {
                queue.extend(Entry::bound(correlation, DeviceId(index as u32), reporter, d, gamma));
            }
        });
    }

    /// Gives out the candidate with the largest `P_4,2` for which `is_candidate` holds (one in S4 that the policy may
    /// wake), if any has at least p(`d_max`).
    pub fn next(&mut self, is_candidate: impl Fn(DeviceId) -> bool) -> Option<DeviceId> {
        while let Some(Entry { device, reporter, .. }) = self.queue.pop() {
            if self.given_out[device.index()] == self.event || !is_candidate(device) {
                continue;
            }
            if reporter == EXACT {
                self.given_out[device.index()] = self.event;
                return Some(device);
            }
            let (position, d) = self.reporters[reporter as usize];
            let value = self
                .correlation
                .p42(d, position.distance(self.positions[device.index()]));
            if value >= self.correlation.threshold() {
                self.queue.push(Entry {
                    nano: nano(value),
                    device,
                    reporter: EXACT,
                });
            }
        }
        None
    }

    fn add(&mut self, position: Point, d: f64) -> u32 {
        self.reporters.push((position, d));
        self.reporters.len() as u32 - 1
    }
}

/// `p` to the nearest 10⁻⁹. Probabilities that are closer are equal: on a grid, devices that stand alike differ only in
/// the last bit of their distances, and the lower number is to come first.
fn nano(p: f64) -> u32 {
    (p * 1e9 + 0.5) as u32
}

/// In place of a reporter: the entry holds the probability itself.
const EXACT: u32 = u32::MAX;

/// A candidate's probability under one reporter, or an upper bound on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Entry {
    /// In 10⁻⁹.
    nano: u32,
    device: DeviceId,
    /// The reporter of a bound, or [`EXACT`].
    reporter: u32,
}

impl Entry {
    /// The bound for a candidate `gamma` metres from a reporter, unless it falls short of p(`d_max`).
    fn bound(correlation: &Correlation, device: DeviceId, reporter: u32, d: f64, gamma: f64) -> Option<Self> {
        let bound = correlation.bound(d, gamma);
        (bound >= correlation.threshold()).then(|| Self {
            nano: nano(bound) + 1,
            device,
            reporter,
        })
    }
}

impl Ord for Entry {
    /// The largest value comes first. At equal values bounds come before probabilities, as they may hide a device with
    /// a lower number; then lower numbers come first.
    fn cmp(&self, other: &Self) -> Ordering {
        self.nano
            .cmp(&other.nano)
            .then_with(|| (self.reporter != EXACT).cmp(&(other.reporter != EXACT)))
            .then_with(|| other.device.cmp(&self.device))
            .then_with(|| other.reporter.cmp(&self.reporter))
    }
}

impl PartialOrd for Entry {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::geometry::{Layout, place};
    use reveille_common::rng::{Purpose, Stream};
    use reveille_common::sensing::{DetectionKind, Fusion};

    use super::*;

    const AREA: Area = Area {
        width: 20.0,
        height: 20.0,
    };

    fn paper() -> Sensing {
        Sensing {
            kind: DetectionKind::Range,
            d_max: 4.0,
            eta: 1.0,
            psi: 1.0,
            g: Fusion::Max,
        }
    }

    fn all(ranking: &mut Ranking) -> Vec<u32> {
        std::iter::from_fn(|| ranking.next(|_| true)).map(|j| j.0).collect()
    }

    fn ranking(points: &[Point]) -> Ranking {
        Ranking::new(points, AREA, Correlation::new(&paper()))
    }

    /// The definition: all candidates that may be woken with their largest probability, sorted.
    fn sorted(points: &[Point], reporters: &[(Point, f64)], candidate: impl Fn(DeviceId) -> bool) -> Vec<DeviceId> {
        let correlation = Correlation::new(&paper());
        let mut ranked: Vec<_> = (0..points.len() as u32)
            .map(DeviceId)
            .filter(|&j| candidate(j))
            .map(|j| {
                let by = |&(h, d): &(Point, f64)| correlation.p42(d, h.distance(points[j.index()]));
                (reporters.iter().map(by).fold(0.0, f64::max), j)
            })
            .filter(|&(probability, _)| probability >= paper().p(4.0))
            .collect();
        let nano = |p: f64| (p * 1e9).round() as u64;
        ranked.sort_by_key(|&(probability, j)| (std::cmp::Reverse(nano(probability)), j));
        ranked.into_iter().map(|(_, j)| j).collect()
    }

    #[test]
    fn gives_the_order_of_a_full_sort_also_between_reports() {
        let mut stream = Stream::new(6, Purpose::Epicentre, 0);
        for case in 0..400_u64 {
            // A grid of devices that report from their own cell makes ties by the dozen.
            let layout = [Layout::Uniform, Layout::Grid, Layout::Hex, Layout::JitteredGrid][case as usize % 4].clone();
            let points = place(&layout, AREA, 1 + (case % 90) as u32, case);
            let mut ranking = ranking(&points);
            for _event in 0..3 {
                let may = |j: DeviceId| (u64::from(j.0) + case) % 5 != 0;
                let (mut reporters, mut given) = (Vec::new(), Vec::new());
                ranking.start();
                for _report in 0..=stream.below(4) {
                    let position = points[stream.below(points.len() as u64) as usize];
                    let d = [0.0, 1.0, 4.0, 4.0 * stream.unit()][stream.below(4) as usize];
                    reporters.push((position, d));
                    if case % 2 == 0 {
                        ranking.add_reporter_to_all(position, d);
                    } else {
                        ranking.add_reporter(position, d, (0..points.len() as u32).map(DeviceId));
                    }
                    for _ in 0..stream.below(3) {
                        let expected = sorted(&points, &reporters, |j| may(j) && !given.contains(&j));
                        let next = ranking.next(may);
                        assert_eq!(next, expected.first().copied(), "case {case}, {layout:?}");
                        given.extend(next);
                    }
                }
                let rest: Vec<_> = std::iter::from_fn(|| ranking.next(may)).collect();
                assert_eq!(rest, sorted(&points, &reporters, |j| may(j) && !given.contains(&j)));
            }
        }
    }

    #[test]
    fn ties_go_to_the_lower_number_and_the_range_is_closed() {
        let at = |x: f64, y: f64| Point::new(10.0 + x, 10.0 + y);
        let points = [
            at(0.0, 4.0),
            at(4.0, 0.0),
            at(0.0, -1.0),
            at(-1.0, 0.0),
            at(4.001, 0.0),
            at(1.0, 0.0),
        ];
        let mut ranking = ranking(&points);
        ranking.start();
        ranking.add_reporter_to_all(at(0.0, 0.0), 0.0);
        assert_eq!(all(&mut ranking), [2, 3, 5, 0, 1]);
        ranking.start();
        assert_eq!(ranking.next(|_| true), None);
    }

    #[test]
    fn devices_that_stand_alike_come_in_the_order_of_their_numbers() {
        // The four corners around the middle, where the distances differ by rounding alone.
        let points: Vec<Point> = [(0.1, 0.1), (0.3, 0.3), (0.3, 0.1), (0.1, 0.3)]
            .map(|(x, y)| Point::new(x, y))
            .to_vec();
        let middle = Point::new(0.1 + 0.1, 0.2);
        let distances: Vec<u64> = points.iter().map(|p| p.distance(middle).to_bits()).collect();
        assert!(
            distances.iter().any(|&d| d != distances[0]),
            "the case has lost its point"
        );
        let mut ranking = ranking(&points);
        ranking.start();
        ranking.add_reporter_to_all(middle, 1.0);
        assert_eq!(all(&mut ranking), [0, 1, 2, 3]);
    }

    #[test]
    fn i_min_of_a_grid_is_the_papers() {
        for side in [1_u32, 3, 10, 15] {
            let n = side * side;
            let points = place(&Layout::Grid, AREA, n, 0);
            let expected = paper().p((AREA.surface() / (2.0 * f64::from(n))).sqrt());
            assert!((i_min(&points, AREA, &paper()) - expected).abs() < 1e-9, "N = {n}");
        }
    }
}
