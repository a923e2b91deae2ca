//! What a base station remembers for those who are asked: who looked when, and how long no place was looked at.

use reveille_common::geometry::{Buckets, Point};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::message::Report;
use reveille_common::plan::Plan;
use reveille_common::sensing::Sensing;

use crate::beliefs::ages::{self, Ages};
use crate::beliefs::ranking::i_min;
use crate::knowledge::Knowledge;

/// What has been noticed so far, device by device.
#[derive(Clone, Debug)]
pub struct Memory {
    ages: Ages,
    /// By device, what [`Ages::worth`] is where every place was looked at in the last TTI.
    fresh: Vec<f64>,
    all_fresh: f64,
    /// The first TTI that has not passed.
    next: Tti,
    /// Whether something was heard in it.
    is_found: bool,
    /// By device, the last TTI that has passed with δ = 1, counted from 1; 0 for none.
    looked: Vec<u64>,
    /// By device, the TTI of the last report, counted from 1; 0 for none.
    reported: Vec<u64>,
    /// Ln(1 + other devices within d_max) / ln(N), by device.
    crowds: Vec<f64>,
    positions: Vec<Point>,
    sensing: Sensing,
    near: Near,
    i_min: f64,
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
        let ages = Ages::losing(lost, &positions, known.area, &known.sensing, ages::worths());
        let buckets = Buckets::new(&positions, known.area, known.sensing.d_max);
        let ln_n = libm::log(known.n() as f64).max(f64::MIN_POSITIVE);
        let crowd = |j: usize| {
            let mut others = 0_u32;
            buckets.within(positions[j], known.sensing.d_max, |i, _| others += u32::from(i != j));
            libm::log(f64::from(1 + others)) / ln_n
        };
        Self {
            fresh: (0..known.n()).map(|j| ages.worth(j)).collect(),
            all_fresh: ages.all(),
            next: Tti::ZERO,
            is_found: false,
            looked: vec![0; known.n()],
            reported: vec![0; known.n()],
            crowds: (0..known.n()).map(crowd).collect(),
            near: Near {
                information: vec![0.0; known.n()],
                distance: vec![f64::INFINITY; known.n()],
                p: vec![0.0; known.n()],
            },
            i_min: i_min(&positions, known.area, &known.sensing),
            ages,
            positions,
            sensing: known.sensing.clone(),
        }
    }

    /// The TTIs before `end` that had not passed have done so under `plan`.
    pub fn pass(&mut self, end: Tti, plan: &Plan) {
        while self.next < end {
            for (j, looked) in self.looked.iter_mut().enumerate() {
                if plan.duty_cycle(DeviceId(j as u32)).is_on(self.next) {
                    self.ages.add(j);
                    *looked = self.next.0 + 1;
                }
            }
            self.ages.pass(std::mem::take(&mut self.is_found));
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
    /// a(a + 1)/2 over the ages a of its places ([`ages`]).
    pub fn staleness(&self, device: usize) -> f64 {
        let fresh = self.fresh[device];
        if fresh > 0.0 {
            self.ages.worth(device) / fresh
        } else {
            1.0
        }
    }

    /// The same of the whole area.
    pub fn staleness_of_all(&self) -> f64 {
        self.ages.all() / self.all_fresh
    }

    /// Ln(1 + n) / ln(N), n the other devices within d_max of `device`, `[0, 1]`.
    pub fn crowd(&self, device: usize) -> f64 {
        self.crowds[device]
    }

    /// I_min (Sec. V-A), `[0, Ψ]`.
    pub const fn i_min(&self) -> f64 {
        self.i_min
    }
}

/// From a TTI that is counted from 1 to `now`.
const fn since(last: u64, now: Tti) -> Option<u64> {
    match last {
        0 => None,
        last => Some((now.0 + 1).saturating_sub(last)),
    }
}
