//! What a base station remembers for those who are asked: who looked when, and how long no place was looked at.

use reveille_common::geometry::{Buckets, Point};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::sensing::Sensing;
use reveille_common::units::Energy;

use crate::beliefs::ages::staleness::Staleness;
use crate::beliefs::ranking::i_min;
use crate::knowledge::{DeviceKnowledge, Knowledge};

/// What has been noticed so far, device by device.
#[derive(Clone, Debug)]
pub struct Memory {
    staleness: Staleness,
    /// The first TTI that has not passed.
    next: Tti,
    /// Whether something was heard in it.
    is_found: bool,
    /// By device, the last TTI that has passed with δ = 1, counted from 1; 0 for none.
    looked: Vec<u64>,
    /// By device, the TTI of the last report, counted from 1; 0 for none.
    reported: Vec<u64>,
    /// By device.
    fixed: Vec<Fixed>,
    positions: Vec<Point>,
    sensing: Sensing,
    near: Near,
    i_min: f64,
}

/// What stays of a device, as it is asked for: few bytes, one after the other.
#[derive(Clone, Copy, Debug)]
pub struct Fixed {
    /// Where it stands, shares of the width and height of the area, `[0, 1]`.
    pub place: [f32; 2],
    /// Ln(1 + n) / ln(N), n the other devices within d_max, `[0, 1]`.
    pub crowd: f32,
    /// H / (h + E_idle), h its mean harvest in a TTI, `[0, 1]`.
    pub harvest: f32,
    /// E_max, units.
    pub e_max: f64,
    /// Whether [`Self::harvest`] is that of every TTI.
    pub is_steady: bool,
}

/// The reports of the TTI in which something was heard last, by device.
#[derive(Clone, Debug)]
struct Near {
    /// I_ij of its own, 0 without.
    information: Vec<f64>,
    /// Distance to the nearest reporter, m; infinite where there is none.
    distance: Vec<f64>,
    /// P(d) of it.
    p: Vec<f64>,
}

impl Memory {
    /// Before TTI 0, of the devices in `known`.
    pub fn new(known: &Knowledge) -> Self {
        let positions = known.positions();
        let lost = known.radio.silence();
        let buckets = Buckets::new(&positions, known.area, known.sensing.d_max);
        let ln_n = libm::log(known.n() as f64).max(f64::MIN_POSITIVE);
        let fixed = |(j, device): (usize, &DeviceKnowledge)| {
            let mut others = 0_u32;
            buckets.within(device.position, known.sensing.d_max, |i, _| others += u32::from(i != j));
            let Point { x, y } = device.position;
            Fixed {
                place: [x / known.area.width, y / known.area.height].map(|share| share as f32),
                crowd: (libm::log(f64::from(1 + others)) / ln_n) as f32,
                harvest: harvest(device.mean_harvest, device.energy.e_idle) as f32,
                e_max: device.energy.e_max.units(),
                is_steady: known.courses[usize::from(device.class)].is_none(),
            }
        };
        Self {
            staleness: Staleness::losing(lost, &positions, known.area, &known.sensing),
            next: Tti::ZERO,
            is_found: false,
            looked: vec![0; known.n()],
            reported: vec![0; known.n()],
            fixed: known.devices.iter().enumerate().map(fixed).collect(),
            near: Near {
                information: vec![0.0; known.n()],
                distance: vec![f64::INFINITY; known.n()],
                p: vec![0.0; known.n()],
            },
            i_min: i_min(&positions, known.area, &known.sensing),
            positions,
            sensing: known.sensing.clone(),
        }
    }

    /// The TTIs before `end` that had not passed have done so under `plan`.
    pub fn pass(&mut self, end: Tti, plan: &Plan) {
        while self.next < end {
            for (j, looked) in self.looked.iter_mut().enumerate() {
                if plan.is_on(DeviceId(j as u32), self.next) {
                    self.staleness.look(j);
                    *looked = self.next.0 + 1;
                }
            }
            self.staleness.pass(std::mem::take(&mut self.is_found));
            self.next = self.next + 1;
        }
    }

    /// Reports have come first in the TTI that passes next, at least one.
    pub fn hear_first(&mut self, reports: &[Report]) {
        self.near.information.fill(0.0);
        self.near.distance.fill(f64::INFINITY);
        self.near.p.fill(0.0);
        for report in reports {
            self.hear(report);
        }
    }

    /// One more has come in the same TTI.
    pub fn hear(&mut self, report: &Report) {
        let Self {
            positions,
            sensing,
            near,
            ..
        } = self;
        self.is_found = true;
        self.reported[report.device.index()] = report.tti.0 + 1;
        near.information[report.device.index()] = report.information;
        let at = positions[report.device.index()];
        for ((own, nearest), p) in positions.iter().zip(&mut near.distance).zip(&mut near.p) {
            let distance = own.distance(at);
            if distance < *nearest {
                (*nearest, *p) = (distance, sensing.p(distance));
            }
        }
    }

    /// I of the report of `device` in the TTI in which something was heard last, `[0, Ψ]`; 0 without.
    pub fn information(&self, device: usize) -> f64 {
        self.near.information[device]
    }

    /// P(d) of the distance from `device` to the nearest of those who reported then, `[0, 1]`.
    pub fn nearness(&self, device: usize) -> f64 {
        self.near.p[device]
    }

    /// TTIs to `now` from the last that has passed in which `device` was told to sense; nothing if there was none.
    pub fn since_sensing(&self, device: usize, now: Tti) -> Option<u64> {
        since(self.looked[device], now)
    }

    /// TTIs from the last report of `device` to `now`; nothing if there was none.
    pub fn since_report(&self, device: usize, now: Tti) -> Option<u64> {
        since(self.reported[device], now)
    }

    /// TTIs from the last report of any device to `now`; nothing if there was none.
    pub fn since_any_report(&self, now: Tti) -> Option<u64> {
        since(self.reported.iter().copied().max().unwrap_or(0), now)
    }

    /// How many times as much as right after a look it is worth to look at what `device` covers, ≥ 1: the mean of
    /// a(a + 1)/2 over the ages a of its places ([`ages`](crate::beliefs::ages)).
    #[inline]
    pub fn staleness(&self, device: usize) -> f64 {
        self.staleness.of(device)
    }

    /// The same of the whole area.
    pub fn staleness_of_all(&self) -> f64 {
        self.staleness.of_all()
    }

    /// What stays of `device`.
    #[inline]
    pub fn fixed(&self, device: usize) -> &Fixed {
        &self.fixed[device]
    }

    /// I_min (Sec. V-A), `[0, Ψ]`.
    pub const fn i_min(&self) -> f64 {
        self.i_min
    }
}

/// H / (h + E_idle) of a harvest h in a TTI.
pub(super) fn harvest(comes: Energy, e_idle: Energy) -> f64 {
    let (comes, e_idle) = (comes.units(), e_idle.units());
    if comes > 0.0 { comes / (comes + e_idle) } else { 0.0 }
}

/// From a TTI that is counted from 1 to `now`.
const fn since(last: u64, now: Tti) -> Option<u64> {
    match last {
        0 => None,
        last => Some((now.0 + 1).saturating_sub(last)),
    }
}
