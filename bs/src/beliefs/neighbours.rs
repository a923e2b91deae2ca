//! Neighbours of each device in bands of distance. [`Ranking`](super::ranking::Ranking) evaluates candidates band by
//! band. Bands must have the width and number used by [`Correlation`](super::correlation::Correlation), whose bounds
//! hold band by band. The last band begins at 2 d_max or beyond. Farther devices are left out: they lie more than d_max
//! from the event, so none is a candidate.

use reveille_common::geometry::{Area, Buckets, Point};
use reveille_common::ids::DeviceId;

/// Neighbours of each device up to a range, in bands of equal width. Band i holds the devices whose distance is nearest
/// to i widths. A device's list is computed on first use.
#[derive(Clone, Debug)]
pub(crate) struct Neighbours {
    buckets: Buckets,
    positions: Vec<Point>,
    /// Bands per metre.
    bands_per_metre: f64,
    band_count: usize,
    lists: Vec<Option<NeighbourList>>,
}

/// Neighbours of one device: band i is `devices[starts[i] .. starts[i + 1]]`, in ascending order.
#[derive(Clone, Debug)]
struct NeighbourList {
    starts: Box<[u32]>,
    devices: Box<[DeviceId]>,
}

impl Neighbours {
    /// Creates the lists for devices at `positions` in `area`, with `band_count` bands.
    pub(crate) fn new(positions: &[Point], area: Area, bands_per_metre: f64, band_count: usize) -> Self {
        Self {
            buckets: Buckets::new(positions, area, 0.5 * band_count as f64 / bands_per_metre),
            positions: positions.to_vec(),
            bands_per_metre,
            band_count,
            lists: vec![None; positions.len()],
        }
    }

    pub(crate) fn position(&self, device: DeviceId) -> Point {
        self.positions[device.index()]
    }

    /// Computes the list of `device`, which [`Self::band`] needs, unless it is known.
    pub(crate) fn prepare(&mut self, device: DeviceId) {
        let Self {
            buckets,
            positions,
            bands_per_metre,
            band_count,
            lists,
        } = self;
        lists[device.index()].get_or_insert_with(|| {
            NeighbourList::new(buckets, positions[device.index()], *bands_per_metre, *band_count)
        });
    }

    /// Returns the devices in band `band`, below `band_count`, of `device`, which was prepared. The first band includes
    /// the device itself.
    pub(crate) fn band(&self, device: DeviceId, band: usize) -> &[DeviceId] {
        let list = self.lists[device.index()].as_ref();
        let list = list.expect("`prepare` was called for the device");
        &list.devices[list.starts[band] as usize..list.starts[band + 1] as usize]
    }
}

impl NeighbourList {
    fn new(buckets: &Buckets, centre: Point, bands_per_metre: f64, band_count: usize) -> Self {
        let mut neighbours: Vec<(u32, DeviceId)> = Vec::new();
        buckets.within(centre, band_count as f64 / bands_per_metre, |index, distance| {
            let band = (distance * bands_per_metre + 0.5) as usize;
            // A distance within half a band of the range rounds up to a band that does not exist. It is above 2 d_max,
            // so the device is no candidate.
            if band < band_count {
                neighbours.push((band as u32, DeviceId(index as u32)));
            }
        });
        neighbours.sort_unstable();
        let mut starts = vec![0_u32; band_count + 1];
        for &(band, _) in &neighbours {
            starts[band as usize + 1] += 1;
        }
        for band in 0..band_count {
            starts[band + 1] += starts[band];
        }
        Self {
            starts: starts.into(),
            devices: neighbours.into_iter().map(|(_, device)| device).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use reveille_common::geometry::{Layout, place_devices};

    use super::*;

    #[test]
    fn each_band_contains_the_devices_at_its_distances() {
        let area = Area {
            width: 20.0,
            height: 10.0,
        };
        for (layout, n) in [(Layout::Uniform, 90), (Layout::Grid, 50), (Layout::Hex, 7)] {
            let positions = place_devices(&layout, area, n, 3);
            let mut neighbours = Neighbours::new(&positions, area, 10.0, 80);
            for h in (0..n).map(DeviceId) {
                neighbours.prepare(h);
                for band in 0..80 {
                    let distance = |j: &u32| positions[*j as usize].distance(positions[h.index()]);
                    let middle = f64::from(band) / 10.0;
                    let expected: Vec<DeviceId> = (0..n)
                        .filter(|j| distance(j) >= middle - 0.05 && distance(j) < middle + 0.05)
                        .map(DeviceId)
                        .collect();
                    assert_eq!(
                        neighbours.band(h, band as usize),
                        expected,
                        "{layout:?}: {h:?}, band {band}"
                    );
                }
            }
        }
    }
}
