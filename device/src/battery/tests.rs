//! Tests of [`Battery`] without a device, against sums in plain integers. The tests of the machine cover spans
//! ([`Battery::spend`]); only whole runs cover checkpoints. All levels and costs are arbitrary.

use proptest::prelude::*;
use reveille_common::scenario::EnergyModel;
use reveille_common::units::Energy;

use super::Battery;

const fn micro(n: u64) -> Energy {
    Energy::from_micro(n)
}

fn battery_with(initial: u64, capacity: u64) -> Battery {
    Battery::new(&EnergyModel {
        e_max: micro(capacity),
        e_idle: micro(1),
        e_wur: micro(1),
        e_tx: micro(1),
        initial: micro(initial),
    })
}

#[test]
fn a_harvest_beyond_the_capacity_overflows() {
    let mut battery = battery_with(5, 10);
    battery.harvest(micro(3));
    assert_eq!((battery.level(), battery.overflow()), (micro(8), micro(0)));
    battery.harvest(micro(7));
    assert_eq!((battery.level(), battery.overflow()), (micro(10), micro(5)));
    assert_eq!(battery.harvested(), micro(10), "the overflow counts as harvested");
}

#[test]
fn a_payable_action_takes_its_cost() {
    let mut battery = battery_with(5, 10);
    assert_eq!(battery.pay(micro(5)), Ok(()), "the level equals the cost");
    assert_eq!(battery.level(), micro(0));
    assert_eq!(battery.pay(micro(0)), Ok(()), "a cost of 0 with an empty battery");
}

#[test]
fn an_unpayable_action_empties_the_battery() {
    let mut battery = battery_with(5, 10);
    assert_eq!(battery.pay(micro(6)), Err(micro(5)));
    assert_eq!(battery.level(), micro(0));
    assert_eq!(battery.pay(micro(1)), Err(micro(0)));
}

#[test]
#[should_panic(expected = "at most E_max")]
fn an_initial_level_above_the_capacity_panics() {
    battery_with(11, 10);
}

proptest! {
    #[test]
    fn harvest_and_payments_are_balanced(
        initial in 0..=50_u64,
        steps in prop::collection::vec((any::<bool>(), 0..40_u64), 0..60),
    ) {
        let mut battery = battery_with(initial, 50);
        let (mut level, mut harvested, mut spent, mut overflow) = (initial, 0, 0, 0);
        for (is_harvest, energy) in steps {
            if is_harvest {
                battery.harvest(micro(energy));
                harvested += energy;
                overflow += (level + energy).saturating_sub(50);
                level = (level + energy).min(50);
            } else {
                let paid = battery.pay(micro(energy));
                prop_assert_eq!(paid, if energy <= level { Ok(()) } else { Err(micro(level)) });
                spent += energy.min(level);
                level -= energy.min(level);
            }
        }
        prop_assert_eq!(
            [battery.initial(), battery.harvested(), battery.overflow(), battery.level()].map(Energy::micro),
            [initial, harvested, overflow, level]
        );
        prop_assert_eq!(initial + harvested, spent + overflow + level);
    }
}
