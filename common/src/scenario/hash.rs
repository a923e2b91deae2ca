//! The fingerprint of a scenario.

use std::fmt::Write as _;

use sha2::{Digest, Sha256};

use super::learning::{BatteryKnowledge, WakeUpRanking};
use super::model::{DeviceClass, EnergyModel, Harvest, PolicyConfig, Scenario, TraceColumns, TraceEnd};
use crate::geometry::Layout;
use crate::learned::{Schedule, Weights};
use crate::sensing::{DetectionKind, Fusion};
use crate::units::Energy;

impl Scenario {
    /// SHA-256 of everything that decides a run, with the contents of layout and trace files in place of their paths.
    /// The preset's name is left out: it decides nothing beyond the fields that it sets.
    #[must_use]
    pub fn hash(&self) -> [u8; 32] {
        let Self {
            preset: _,
            devices,
            ttis,
            seed,
            warm_up,
            tau,
            area,
            layout,
            classes,
            sensing,
            events,
            bs,
            policy,
        } = self;
        let mut form = Form(Sha256::new());
        form.text("reveille scenario 1");
        form.number(u64::from(*devices));
        form.number(*ttis);
        form.number(*seed);
        for value in [*warm_up, *tau, area.width, area.height] {
            form.float(value);
        }
        form.layout(layout);
        form.number(match sensing.kind {
            DetectionKind::Range => 0,
            DetectionKind::Probabilistic => 1,
        });
        for value in [sensing.d_max, sensing.eta, sensing.psi, events.alpha] {
            form.float(value);
        }
        form.number(match sensing.g {
            Fusion::Max => 0,
            Fusion::SumSaturation => 1,
        });
        form.number(events.duration);
        form.number(bs.sync_interval);
        form.text(policy.name());
        match policy {
            PolicyConfig::Random | PolicyConfig::Genie => {}
            PolicyConfig::Knn(knn) => {
                form.number(u64::from(knn.neighbours));
                form.number(u64::from(knn.limit_radius));
            }
            PolicyConfig::Adjusted(adjusted) => {
                for list in [&adjusted.t_on, &adjusted.t_drx] {
                    form.number(list.len() as u64);
                    for &ttis in list {
                        form.number(u64::from(ttis));
                    }
                }
                form.number(adjusted.pilot_ttis);
            }
            PolicyConfig::QLearning(learning) => {
                let Weights { mu1, mu2, zeta } = learning.weights;
                let (first, last) = learning.epsilon;
                let Schedule {
                    rate_decay,
                    rate_floor,
                    optimism,
                } = learning.schedule;
                for value in [mu1, mu2, zeta, first, last, rate_decay, rate_floor, optimism] {
                    form.float(value);
                }
                form.number(u64::from(learning.window));
                form.number(u64::from(learning.learn));
                form.0.update(learning.start.fingerprint());
            }
        }
        // Scenarios from before there was a choice keep their hash.
        if bs.ranking == WakeUpRanking::Posterior {
            form.text("posterior");
        }
        if bs.battery_knowledge == BatteryKnowledge::Reported {
            form.text("reported");
        }
        form.number(classes.len() as u64);
        for class in classes {
            form.class(class);
        }
        form.0.finalize().into()
    }

    /// [`Scenario::hash`] as 64 hexadecimal digits.
    #[must_use]
    pub fn hash_hex(&self) -> String {
        self.hash().iter().fold(String::with_capacity(64), |mut digits, byte| {
            let _ = write!(digits, "{byte:02x}");
            digits
        })
    }
}

/// Values one after another, each of a length that is fixed or in front of it, so that no two scenarios read the same.
struct Form(Sha256);

impl Form {
    fn number(&mut self, value: u64) {
        self.0.update(value.to_le_bytes());
    }

    fn float(&mut self, value: f64) {
        self.number(value.to_bits());
    }

    fn energy(&mut self, value: Energy) {
        self.number(value.micro());
    }

    fn text(&mut self, value: &str) {
        self.number(value.len() as u64);
        self.0.update(value.as_bytes());
    }

    fn layout(&mut self, layout: &Layout) {
        self.number(match layout {
            Layout::Uniform => 0,
            Layout::JitteredGrid => 1,
            Layout::PoissonDisk => 2,
            Layout::Grid => 3,
            Layout::Hex => 4,
            Layout::File { .. } => 5,
        });
        if let Layout::File { points, .. } = layout {
            self.number(points.len() as u64);
            for point in points.iter() {
                self.float(point.x);
                self.float(point.y);
            }
        }
    }

    fn class(&mut self, class: &DeviceClass) {
        let DeviceClass {
            name,
            share,
            energy,
            harvest,
        } = class;
        let EnergyModel {
            e_max,
            e_idle,
            e_wur,
            e_tx,
            initial,
        } = *energy;
        self.text(name);
        self.float(*share);
        for amount in [e_max, e_idle, e_wur, e_tx, initial] {
            self.energy(amount);
        }
        self.harvest(harvest);
    }

    fn harvest(&mut self, harvest: &Harvest) {
        match harvest {
            Harvest::Eq5 { lambda, e_b } => self.arrivals(0, *lambda, *e_b),
            Harvest::ExpMinusLambda { lambda, e_b } => self.arrivals(1, *lambda, *e_b),
            Harvest::Mpp { lambda, e_b, off_mean } => {
                self.arrivals(2, *lambda, *e_b);
                self.float(*off_mean);
            }
            Harvest::Trace(trace) => {
                self.number(3);
                self.number(match trace.columns {
                    TraceColumns::Shared(_) => 0,
                    TraceColumns::PerDevice(_) => 1,
                });
                self.number(match trace.end {
                    TraceEnd::Cycle => 0,
                    TraceEnd::Stop => 1,
                });
                self.number(trace.ttis_per_row);
                self.number(trace.values.len() as u64);
                for column in trace.values.iter() {
                    self.number(column.len() as u64);
                    for &energy in column {
                        self.energy(energy);
                    }
                }
            }
        }
    }

    fn arrivals(&mut self, kind: u64, lambda: f64, e_b: Energy) {
        self.number(kind);
        self.float(lambda);
        self.energy(e_b);
    }
}
