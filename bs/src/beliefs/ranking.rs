//! Selection of the next device to wake by `P_4,2`, and the information required per event (Sec. III and V-A).
//! [`WakeUpCandidates`](super::candidates::WakeUpCandidates) uses the ranking. Digests depend on the order of
//! candidates, ties included; `tests/src/reference/` repeats it.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use reveille_common::geometry::{Area, Point, farthest_cell_vertex};
use reveille_common::ids::DeviceId;
use reveille_common::sensing::Sensing;

use super::neighbours::Neighbours;
pub use crate::beliefs::correlation::Correlation;

/// Returns the information per event that a deployment can always provide, `I_min` = Ψ p(d*), `[0, Ψ]`. The distance
/// from the worst place to its closest device is d*: Eq. (`E_Info3`) in the LaTeX source of the paper, on a grid Eq.
/// (`E_Info1`). The paper leaves out Ψ = 1; I_min includes it because reports do (Eq. (1)).
pub fn i_min(points: &[Point], area: Area, sensing: &Sensing) -> f64 {
    sensing.psi * sensing.p(farthest_cell_vertex(points, area))
}

/// Wake-up candidates of one event at a time, in descending order of `P_4,2`. For device j, `P_4,2` is the largest
/// Pr(`S_j` = S3 | `S_h` = S3) over the event's reporters h. Ties are broken by device number.
///
/// [`Ranking::start_event`] begins an event, `Ranking::add_reporter` adds a report, and [`Ranking::next_candidate`]
/// returns the next candidate to wake. Reports may be added between two candidates.
///
/// Each probability is an integral, and most of the integrals are never computed. The queue holds whole bands of
/// candidates at similar distances from a reporter, with an upper bound of their probabilities that costs little. A
/// band is evaluated only when no evaluated candidate reaches its bound.
#[derive(Clone, Debug)]
pub struct Ranking {
    correlation: Correlation,
    neighbours: Neighbours,
    queue: BinaryHeap<QueueEntry>,
    /// Reporters of the event and their distances from it, metres.
    reporters: Vec<(DeviceId, f64)>,
    /// Number of the last event for which each device was returned or excluded.
    last_returned_for: Vec<u64>,
    /// Number of the current event, from 1; 0 before the first event, when every device counts as returned.
    event_number: u64,
}

impl Ranking {
    /// Creates a ranking of the devices at `points` in `area`.
    pub fn new(points: &[Point], area: Area, correlation: Correlation) -> Self {
        let (bands_per_metre, band_count) = correlation.bands_per_metre_and_count();
        Self {
            neighbours: Neighbours::new(points, area, bands_per_metre, band_count),
            correlation,
            queue: BinaryHeap::new(),
            reporters: Vec::new(),
            last_returned_for: vec![0; points.len()],
            event_number: 0,
        }
    }

    /// Begins an event and clears all reporters and candidates.
    pub fn start_event(&mut self) {
        self.queue.clear();
        self.reporters.clear();
        // A new event number releases all returned devices without a pass over them.
        self.event_number += 1;
    }

    /// Adds the report of `device`, which is `d` metres, 0 ..= `d_max`, from the event. Devices already returned for
    /// this event are not returned again.
    pub(crate) fn add_reporter(&mut self, device: DeviceId, d: f64) {
        let reporter = self.reporters.len() as u32;
        self.reporters.push((device, d));
        self.neighbours.prepare(device);
        self.queue_band(reporter, 0);
    }

    /// Excludes `device` from the candidates of this event.
    pub(crate) fn exclude(&mut self, device: DeviceId) {
        self.last_returned_for[device.index()] = self.event_number;
    }

    /// Returns the candidate with the largest `P_4,2`, and this probability to eight digits. Only devices in S4 that
    /// the policy may wake (`is_candidate`) and with at least p(`d_max`) count.
    pub fn next_candidate(&mut self, is_candidate: impl Fn(DeviceId) -> bool) -> Option<(DeviceId, f64)> {
        // A device may be queued once per reporter. Its largest value comes first and is its maximum over all
        // reporters.
        while let Some(entry) = self.queue.pop() {
            let QueueEntry {
                bound,
                item,
                device_or_band,
            } = entry;
            match item {
                QueueItem::Band { reporter } => self.evaluate_band(reporter, device_or_band, &is_candidate),
                QueueItem::Evaluated => {
                    let device = DeviceId(device_or_band);
                    if self.last_returned_for[device.index()] != self.event_number && is_candidate(device) {
                        self.last_returned_for[device.index()] = self.event_number;
                        return Some((device, bound.probability()));
                    }
                }
            }
        }
        None
    }

    /// Evaluates the candidates of the `band_index`-th band of `reporter`, and queues its next band.
    fn evaluate_band(&mut self, reporter: u32, band_index: u32, is_candidate: impl Fn(DeviceId) -> bool) {
        let (device, d) = self.reporters[reporter as usize];
        let Self {
            correlation,
            neighbours,
            queue,
            last_returned_for,
            event_number,
            ..
        } = self;
        let column = correlation.bands(d)[band_index as usize].column;
        let position = neighbours.position(device);
        for &j in neighbours.band(device, column) {
            if last_returned_for[j.index()] == *event_number || !is_candidate(j) {
                continue;
            }
            let value = correlation.p42(d, position.distance(neighbours.position(j)));
            if value >= correlation.threshold() {
                queue.push(QueueEntry {
                    bound: RoundedProbability::nearest(value),
                    item: QueueItem::Evaluated,
                    device_or_band: j.0,
                });
            }
        }
        self.queue_band(reporter, band_index + 1);
    }

    /// Queues the first non-empty band of `reporter` from the `band_index`-th on.
    fn queue_band(&mut self, reporter: u32, band_index: u32) {
        let Self {
            correlation,
            neighbours,
            queue,
            reporters,
            ..
        } = self;
        let (device, d) = reporters[reporter as usize];
        let bands = (0..).zip(correlation.bands(d)).skip(band_index as usize);
        let next = bands
            .into_iter()
            .find(|(_, band)| !neighbours.band(device, band.column).is_empty());
        queue.extend(next.map(|(band_index, band)| QueueEntry {
            bound: RoundedProbability::above(band.bound),
            item: QueueItem::Band { reporter },
            device_or_band: band_index,
        }));
    }
}

/// A probability rounded to eight digits, so that even far candidates with tiny values are ordered. Closer
/// probabilities are equal: on a grid, symmetric devices differ only in the last bits of their distances, and the lower
/// number must win.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct RoundedProbability(u64);

impl RoundedProbability {
    /// Number of low bits dropped. The remaining bits are a whole number that grows with the probability.
    const DROPPED_BITS: u32 = 25;

    /// Rounds `p`, which is not negative, to the nearest value.
    fn nearest(p: f64) -> Self {
        // A carry into the exponent is correct, since positive numbers and their bits have the same order.
        Self((p.to_bits() + (1 << (Self::DROPPED_BITS - 1))) >> Self::DROPPED_BITS)
    }

    /// Returns a value above the rounded `p`, and so above every smaller probability.
    fn above(p: f64) -> Self {
        Self(Self::nearest(p).0 + 1)
    }

    fn probability(self) -> f64 {
        f64::from_bits(self.0 << Self::DROPPED_BITS)
    }
}

/// Kind of a queue entry. The order of the variants is part of `cmp` of [`QueueEntry`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum QueueItem {
    /// A candidate with its probability. `device_or_band` is its device number.
    Evaluated,
    /// All candidates in one band of distances from a reporter, with an upper bound on their probabilities.
    /// `device_or_band` is the index of the band in the reporter's list.
    Band { reporter: u32 },
}

/// Candidates and an upper bound on their probability; for a single candidate, the probability.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct QueueEntry {
    bound: RoundedProbability,
    item: QueueItem,
    /// Device number or index of a band, by `item`.
    device_or_band: u32,
}

impl Ord for QueueEntry {
    /// The largest value comes first. At equal values, bounds precede probabilities, as a band may hold a device with a
    /// lower number. Then lower numbers come first.
    fn cmp(&self, other: &Self) -> Ordering {
        (self.bound, self.item)
            .cmp(&(other.bound, other.item))
            .then_with(|| other.device_or_band.cmp(&self.device_or_band))
    }
}

impl PartialOrd for QueueEntry {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use reveille_common::geometry::{Layout, place_devices};
    use reveille_common::rng::{Purpose, Stream};
    use reveille_common::sensing::{DetectionKind, Fusion};

    use super::*;
    use crate::bounds_cache::BoundsCache;

    const AREA: Area = Area {
        width: 20.0,
        height: 20.0,
    };

    fn paper_sensing() -> Sensing {
        Sensing {
            kind: DetectionKind::Range,
            d_max: 4.0,
            eta: 1.0,
            psi: 1.0,
            g: Fusion::Max,
        }
    }

    /// Returns all remaining candidates in order.
    fn drain(ranking: &mut Ranking) -> Vec<u32> {
        std::iter::from_fn(|| ranking.next_candidate(|_| true))
            .map(|(j, _)| j.0)
            .collect()
    }

    fn paper_ranking(points: &[Point]) -> Ranking {
        Ranking::new(
            points,
            AREA,
            Correlation::new(&paper_sensing(), &BoundsCache::default()),
        )
    }

    /// Points of the midpoint rule for the definition.
    const QUADRATURE_POINTS: u32 = 4000;

    /// Computes Pr(`S_j` = S3 | `S_h` = S3) by definition, as the mean of p over the directions φ of the event. The
    /// result is (ln p(|d − γ|), the mean of p/p(|d − γ|)), since p itself may be too small for differences. The points
    /// φ = π t⁴ are dense near the peak of the integrand at φ = 0.
    fn mean_over_directions(sensing: &Sensing, d: f64, gamma: f64) -> (f64, f64) {
        let gap = (d - gamma).abs();
        let (mut sum, mut weights) = (0.0, 0.0);
        for i in 0..QUADRATURE_POINTS {
            let t = (f64::from(i) + 0.5) / f64::from(QUADRATURE_POINTS);
            let (phi, weight) = (PI * t.powi(4), t.powi(3));
            // A form of the cosine rule without cancellation.
            let half = libm::sin(0.5 * phi);
            let distance = (gap * gap + 4.0 * d * gamma * half * half).sqrt();
            sum += weight * libm::exp(-sensing.eta * (distance - gap));
            weights += weight;
        }
        (-sensing.eta * gap, sum / weights)
    }

    /// Returns ln Pr(`S_j` = S3 | `S_h` = S3).
    fn log_p42(sensing: &Sensing, d: f64, gamma: f64) -> f64 {
        let (log_peak, mean) = mean_over_directions(sensing, d, gamma);
        log_peak + libm::log(mean)
    }

    /// The candidates by definition, with ln `P_4,2` of each.
    struct RankingDefinition<'a> {
        sensing: &'a Sensing,
        points: &'a [Point],
        /// ln of the largest probability of each device, with its reporter and distance γ.
        best: Vec<Option<(f64, u32, f64)>>,
    }

    impl<'a> RankingDefinition<'a> {
        fn new(sensing: &'a Sensing, points: &'a [Point]) -> Self {
            Self {
                sensing,
                points,
                best: vec![None; points.len()],
            }
        }

        fn add_reporter(&mut self, reporter: DeviceId, d: f64) {
            for (j, best) in self.best.iter_mut().enumerate() {
                let gamma = self.points[reporter.index()].distance(self.points[j]);
                let log = log_p42(self.sensing, d, gamma);
                if best.is_none_or(|(most, ..)| log > most) {
                    *best = Some((log, reporter.0, gamma));
                }
            }
        }

        /// Asserts that `next` is the best `free` device, within the relative `error` of the integral. No other device
        /// may be better by more than that. Among devices of equal value by symmetry, `next` must have the lowest
        /// number.
        fn assert_is_best(
            &self,
            next: Option<(DeviceId, f64)>,
            free: impl Fn(DeviceId) -> bool,
            error: f64,
            case: &str,
        ) {
            let floor = -self.sensing.eta * self.sensing.d_max;
            let candidates = (0..self.points.len() as u32).map(DeviceId).filter(|&j| free(j));
            let best_of = |j: DeviceId| self.best[j.index()].filter(|(log, ..)| *log >= floor - error);
            let max_log = candidates
                .clone()
                .filter_map(best_of)
                .map(|(log, ..)| log)
                .fold(f64::NEG_INFINITY, f64::max);
            let Some((next, probability)) = next else {
                assert!(
                    max_log < floor + error,
                    "{case}: no candidate returned, and one has probability exp({max_log})"
                );
                return;
            };
            assert!(free(next), "{case}: {next} is not a candidate");
            let Some((log, reporter, gamma)) = best_of(next) else {
                panic!("{case}: {next} is below p(d_max)");
            };
            assert!(
                log >= max_log - 2.0 * error,
                "{case}: {next} has probability exp({log}), another exp({max_log})"
            );
            assert!(
                (libm::log(probability) - log).abs() < error,
                "{case}: probability {probability}, not exp({log})"
            );
            let is_equal_by_symmetry = |j: DeviceId| {
                best_of(j).is_some_and(|(_, other, distance)| other == reporter && (distance - gamma).abs() < 1e-12)
            };
            let first = candidates.into_iter().find(|&j| is_equal_by_symmetry(j));
            assert_eq!(first, Some(next), "{case}: the lowest number of equal devices");
        }
    }

    /// Compares [`Ranking`] with the definition for three events on random points.
    fn compare_with_definition((sensing, correlation): (&Sensing, &Correlation), case: u64, stream: &mut Stream) {
        let decay = sensing.eta * sensing.d_max;
        // The quadrature error is below one millionth. For the steepest decays only the last digits near the smallest
        // doubles remain.
        let error = if decay > 500.0 { 5e-3 } else { 2e-6 };
        // On a grid, devices that report from their own cell cause many ties.
        let layout = [Layout::Uniform, Layout::Grid, Layout::Hex, Layout::JitteredGrid][case as usize % 4].clone();
        let points = place_devices(&layout, AREA, 1 + (case % 90) as u32, case);
        let mut ranking = Ranking::new(&points, AREA, correlation.clone());
        for _event in 0..3 {
            let is_candidate = |j: DeviceId| !(u64::from(j.0) + case).is_multiple_of(5);
            let mut returned = Vec::new();
            let mut definition = RankingDefinition::new(sensing, &points);
            ranking.start_event();
            let check_next =
                |returned: &mut Vec<DeviceId>, ranking: &mut Ranking, definition: &RankingDefinition<'_>| {
                    let next = ranking.next_candidate(is_candidate);
                    let label = format!("case {case}, {layout:?}, decay {decay}");
                    definition.assert_is_best(next, |j| is_candidate(j) && !returned.contains(&j), error, &label);
                    returned.extend(next.map(|(j, _)| j));
                    next.is_some()
                };
            for _report in 0..=stream.below(4) {
                let reporter = DeviceId(stream.below(points.len() as u64) as u32);
                let d = [0.0, 1.0, 4.0, 4.0 * stream.unit()][stream.below(4) as usize];
                ranking.add_reporter(reporter, d);
                definition.add_reporter(reporter, d);
                for _ in 0..stream.below(3) {
                    check_next(&mut returned, &mut ranking, &definition);
                }
            }
            while check_next(&mut returned, &mut ranking, &definition) {}
        }
    }

    #[test]
    fn the_order_equals_a_full_sort_also_between_reports() {
        let mut stream = Stream::new(6, Purpose::Epicentre, 0);
        let correlation = Correlation::new(&paper_sensing(), &BoundsCache::default());
        for case in 0..200 {
            compare_with_definition((&paper_sensing(), &correlation), case, &mut stream);
        }
    }

    #[test]
    fn the_order_equals_a_full_sort_at_steep_decays() {
        let mut stream = Stream::new(7, Purpose::Epicentre, 0);
        for eta in [2.0, 5.5, 10.0, 37.5, 75.0, 175.0] {
            let steep = Sensing { eta, ..paper_sensing() };
            let correlation = Correlation::new(&steep, &BoundsCache::default());
            for case in 0..24 {
                compare_with_definition((&steep, &correlation), case, &mut stream);
            }
        }
    }

    #[test]
    fn ties_go_to_the_lowest_id_and_devices_at_d_max_are_candidates() {
        let at = |x: f64, y: f64| Point::new(10.0 + x, 10.0 + y);
        let points = [
            at(0.0, 4.0),
            at(4.0, 0.0),
            at(0.0, -1.0),
            at(-1.0, 0.0),
            at(4.001, 0.0),
            at(1.0, 0.0),
            at(0.0, 0.0),
        ];
        let mut ranking = paper_ranking(&points);
        ranking.start_event();
        ranking.add_reporter(DeviceId(6), 0.0);
        assert_eq!(drain(&mut ranking), [6, 2, 3, 5, 0, 1]);
        ranking.start_event();
        assert_eq!(ranking.next_candidate(|_| true), None);
    }

    #[test]
    fn symmetric_devices_come_in_the_order_of_their_ids() {
        // Four corners around the middle; their distances differ only by rounding.
        let points: Vec<Point> = [(0.1, 0.1), (0.3, 0.3), (0.3, 0.1), (0.1, 0.3), (0.1 + 0.1, 0.2)]
            .map(|(x, y)| Point::new(x, y))
            .to_vec();
        let distances: Vec<u64> = points[..4].iter().map(|p| p.distance(points[4]).to_bits()).collect();
        assert!(
            distances.iter().any(|&d| d != distances[0]),
            "the case needs distances that differ by rounding"
        );
        let mut ranking = paper_ranking(&points);
        ranking.start_event();
        ranking.add_reporter(DeviceId(4), 1.0);
        let corners = std::iter::from_fn(|| ranking.next_candidate(|j| j.0 < 4)).map(|(j, _)| j.0);
        assert_eq!(corners.collect::<Vec<_>>(), [0, 1, 2, 3]);
    }

    #[test]
    fn i_min_of_a_grid_equals_the_closed_form() {
        for side in [1_u32, 3, 10, 15] {
            let n = side * side;
            let points = place_devices(&Layout::Grid, AREA, n, 0);
            let expected = paper_sensing().p((AREA.surface() / (2.0 * f64::from(n))).sqrt());
            assert!(
                (i_min(&points, AREA, &paper_sensing()) - expected).abs() < 1e-9,
                "N = {n}"
            );
        }
    }
}
