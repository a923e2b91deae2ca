//! Battery levels of device machines under a fixed duty cycle, counted at the end of every TTI. Another order of draws
//! changes the measured columns of `reveille analyse battery` and of docs/analysis.md.

use rayon::prelude::*;
use reveille_common::event::Stimulus;
use reveille_common::geometry::Point;
use reveille_common::harvest::{ArrivalsSetup, HarvestSetup};
use reveille_common::ids::{DeviceId, EventId, Tti};
use reveille_common::message::DeviceSetup;
use reveille_common::plan::DutyCycle;
use reveille_common::radio::RadioSettings;
use reveille_common::rng::{Geometric, Purpose, Stream};
use reveille_common::scenario::EnergyModel;
use reveille_common::sensing::{DetectionKind, Fusion, Sensing};
use reveille_common::units::Energy;
use reveille_device::machine::{Machine, Physics};

use super::chain::ChainInput;
use super::lattice::Lattice;

/// Sample of devices and TTIs to count.
#[derive(Clone, Copy, Debug)]
pub struct SampleConfig {
    /// Seed of the devices' streams.
    pub seed: u64,
    /// Number of devices, each with its own arrival stream. The duty cycle of each is shifted by one more TTI.
    pub devices: u32,
    /// Counted TTIs of each device.
    pub ttis: u64,
    /// TTIs before the counted ones.
    pub warm_up: u64,
}

/// Counts the TTIs by battery level at their end, one vector for each device. [`super::compare`] has checked `input`
/// and `sample`.
pub(super) fn count_levels(
    model: &EnergyModel,
    e_b: Energy,
    lattice: &Lattice,
    input: &ChainInput,
    sample: &SampleConfig,
) -> Vec<Vec<u64>> {
    let setups: Vec<DeviceSetup> = (0..sample.devices)
        .map(|id| DeviceSetup {
            id: DeviceId(id),
            position: Point::new(0.0, 0.0),
            energy: *model,
            harvest: HarvestSetup::Arrivals(ArrivalsSetup { p: input.arrival, e_b }),
        })
        .collect();
    let physics = Physics::new(
        sample.seed,
        Tti::ZERO,
        sensing_without_misses(),
        RadioSettings::default(),
        &setups,
        Vec::new(),
    );
    let count_device = |setup: &DeviceSetup| count_device_levels(setup, &physics, lattice, input, sample);
    setups.par_iter().map(count_device).collect()
}

/// Counts one device. An event at its position makes it active in S1, a wake-up in S4: with `input.activation` in each
/// TTI, as in the chain.
fn count_device_levels(
    setup: &DeviceSetup,
    physics: &Physics,
    lattice: &Lattice,
    input: &ChainInput,
    sample: &SampleConfig,
) -> Vec<u64> {
    let mut counts = vec![0; lattice.level_count()];
    let mut machine = Machine::new(setup, physics);
    let duty = DutyCycle {
        t_on: input.t_on,
        t_drx: input.t_drx,
        offset: setup.id.0 % input.t_drx,
    };
    machine.set_duty(Tti::ZERO, duty);
    let gaps = Geometric::new(input.activation);
    let mut stream = Stream::new(sample.seed, Purpose::EventGap, u64::from(setup.id.0));
    // Gaps start at 1, and the first activation may be due in TTI 0.
    let mut next_activation = gaps.draw(&mut stream).saturating_sub(1);
    let stimulus = Stimulus {
        event: EventId(0),
        epicentre: setup.position,
    };
    for k in 0..sample.warm_up + sample.ttis {
        let tti = Tti(k);
        machine.begin(tti);
        if k == next_activation {
            // The gap is `u64::MAX` if the device never becomes active.
            next_activation = k.saturating_add(gaps.draw(&mut stream));
            if duty.is_on(tti) {
                machine.sense(tti, &stimulus, physics);
            } else {
                machine.wake(tti, Some(&stimulus), physics);
            }
        }
        if k >= sample.warm_up {
            counts[lattice.nearest_level(machine.battery())] += 1;
        }
    }
    counts
}

const fn sensing_without_misses() -> Sensing {
    Sensing {
        kind: DetectionKind::Range,
        d_max: 1.0,
        eta: 1.0,
        psi: 1.0,
        g: Fusion::Max,
    }
}
