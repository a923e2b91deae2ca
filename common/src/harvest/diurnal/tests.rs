//! Tests of diurnal arrivals against their expected counts.

use crate::harvest::{Harvest, HarvestSetup, HarvestSource};
use crate::ids::DeviceId;

use super::*;

const E_B: Energy = Energy::from_micro(5_000_000);

fn sun(ttis_per_day: u32) -> Sun {
    Sun {
        latitude: 52.5,
        day_of_year: 60,
        start_hour: 3.7,
        ttis_per_day,
        sky: Sky::Vacuum,
    }
}

fn diurnal(lambda: f64, sun: Sun, reference: IrradianceReference) -> Diurnal {
    let made = Diurnal::new(Arrivals { lambda, e_b: E_B }, sun, reference, DayKnowledge::Course);
    assert!(made.setup(1.0).is_valid(), "an arrival is at most certain");
    made
}

fn source(of: Diurnal, device: u32) -> HarvestSource {
    let setup = Harvest::Diurnal(of).setup(1.0, 0);
    HarvestSource::new(&setup, &SharedSourceData::default(), 11, DeviceId(device))
}

/// Counts the arrivals in each TTI of a day, over devices and days.
fn counted(of: Diurnal, devices: u32, days: u64) -> Vec<u64> {
    let ttis = u64::from(of.sun.ttis_per_day);
    let mut counts = vec![0; ttis as usize];
    for device in 0..devices {
        let mut source = source(of, device);
        while source.next_arrival() < Tti(days * ttis) {
            let now = source.next_arrival();
            counts[(now.0 % ttis) as usize] += 1;
            assert_eq!(source.take_arrival(), E_B);
            assert!(source.next_arrival() > now);
        }
    }
    counts
}

#[test]
fn arrivals_follow_the_sun() {
    for sky in [Sky::Vacuum, Sky::Clear] {
        let of = diurnal(0.2, Sun { sky, ..sun(24) }, IrradianceReference::DailyMean);
        let (devices, days) = (200, 500);
        let trials = f64::from(devices) * days as f64;
        let p: Vec<f64> = of.sun.arrival_probabilities(of.zenith_probability(1.0)).collect();
        assert!(p.iter().filter(|&&p| p > 0.0).count() < 13, "a day of early spring");
        let mut squares = 0.0;
        for (slot, (&p, &count)) in p.iter().zip(&counted(of, devices, days)).enumerate() {
            let error = (trials * p * (1.0 - p)).sqrt();
            assert!(
                (count as f64 - trials * p).abs() <= 4.5 * error,
                "{slot}: {count}, not {}",
                trials * p
            );
            squares += if error > 0.0 {
                ((count as f64 - trials * p) / error).powi(2)
            } else {
                0.0
            };
        }
        // The sum of some twelve squares of standard normal draws.
        assert!(squares < 35.0, "{squares}");
    }
}

#[test]
fn arrivals_of_one_tti_and_the_next_do_not_depend_on_each_other() {
    let of = diurnal(0.2, sun(24), IrradianceReference::DailyMean);
    let p: Vec<f64> = of.sun.arrival_probabilities(of.zenith_probability(1.0)).collect();
    let (mut pairs, mut expected) = (0_u64, 0.0);
    let days = 100_000;
    let mut source = source(of, 3);
    let mut last = Tti::NEVER;
    while source.next_arrival() < Tti(24 * days) {
        let now = source.next_arrival();
        pairs += u64::from(last.0.wrapping_add(1) == now.0);
        last = now;
        source.take_arrival();
    }
    for slot in 0..24 {
        expected += days as f64 * p[slot] * p[(slot + 1) % 24];
    }
    assert!(expected > 10_000.0);
    assert!(
        (pairs as f64 - expected).abs() < 4.5 * expected.sqrt(),
        "{pairs}, not {expected}"
    );
}

#[test]
fn the_daily_mean_is_that_of_eq5_and_under_the_zenith_the_integral() {
    for (latitude, day_of_year) in [(0.0, 81), (60.0, 172), (-35.0, 200)] {
        let place = Sun {
            latitude,
            day_of_year,
            ..sun(288)
        };
        let p = 0.1 * libm::exp(-0.1);
        let of = diurnal(0.1, place, IrradianceReference::DailyMean);
        let HarvestSetup::Diurnal(setup) = Harvest::Diurnal(of).setup(1.0, 0) else {
            panic!("{of:?}");
        };
        assert!((setup.mean - p).abs() < 1e-12, "{setup:?}");
        let eq5 = Harvest::Eq5(of.arrivals).setup(1.0, 0).mean(&[]);
        assert_eq!(Harvest::Diurnal(of).setup(1.0, 0).mean(&[]), eq5);
        let zenith = diurnal(0.1, place, IrradianceReference::Zenith).setup(1.0);
        assert!((zenith.mean - p * place.mean_irradiance()).abs() < 1e-12, "{zenith:?}");
        assert!(zenith.zenith.to_bits() == p.to_bits() && zenith.is_valid());
        // The profile's sum over a day equals the mean of its TTIs.
        let course = setup.day_profile().expect("known");
        let day = course.energy_between(Tti(1000), Tti(1288)).units();
        assert!((day - 288.0 * 5.0 * p).abs() < 1e-6, "{day}");
        assert_eq!(
            DiurnalSetup {
                known: DayKnowledge::Mean,
                ..setup
            }
            .day_profile(),
            None
        );
    }
}

#[test]
fn nothing_comes_at_night_and_a_polar_night_has_no_end() {
    let place = Sun {
        latitude: 80.0,
        day_of_year: 355,
        ..sun(288)
    };
    let dark = diurnal(0.3, place, IrradianceReference::Zenith);
    assert_eq!(source(dark, 0).next_arrival(), Tti::NEVER);
    assert_eq!(Harvest::Diurnal(dark).setup(1.0, 0).mean(&[]), Energy::ZERO);
    let bright = diurnal(
        0.3,
        Sun {
            day_of_year: 172,
            ..place
        },
        IrradianceReference::Zenith,
    );
    assert!(counted(bright, 20, 100).iter().all(|&count| count > 0));
    let nothing = Diurnal::new(
        Arrivals {
            lambda: 0.3,
            e_b: Energy::ZERO,
        },
        sun(24),
        IrradianceReference::Zenith,
        DayKnowledge::Course,
    );
    assert_eq!(source(nothing, 0).next_arrival(), Tti::NEVER);
}

/// The TTI from the hazard table equals the result of stepping through the TTIs one by one.
#[test]
fn a_gap_is_that_of_one_tti_after_another() {
    let of = diurnal(0.2, sun(17), IrradianceReference::DailyMean);
    let day: Vec<f64> = of.sun.arrival_probabilities(of.zenith_probability(1.0)).collect();
    let hazards = CumulativeHazard::new(day.iter().copied());
    let mut stream = Stream::new(5, crate::rng::Purpose::Harvest, 0);
    for from in 0..400 {
        let asked = -3.0 * libm::log1p(-stream.unit());
        let (mut left, mut k) = (asked, from);
        loop {
            let hazard = -libm::log1p(-day[(k % 17) as usize]);
            if left < hazard {
                break;
            }
            left -= hazard;
            k += 1;
        }
        assert_eq!(
            hazards.first_tti_beyond(Tti(from), asked),
            Tti(k),
            "{asked} from {from}"
        );
    }
    // The end of a day counts as the first light of the next.
    let whole = day.iter().fold(0.0, |sum, p| sum - libm::log1p(-p));
    let first = day.iter().position(|&p| p > 0.0).expect("light") as u64;
    let last = day.iter().rposition(|&p| p > 0.0).expect("light") as u64;
    assert!(first == 0 || last < 16, "a night within the run of TTIs");
    assert_eq!(hazards.first_tti_beyond(Tti(0), whole), Tti(17 + first));
    assert_eq!(hazards.first_tti_beyond(Tti(0), 2.0 * whole), Tti(34 + first));
}

#[test]
fn a_setup_from_elsewhere_is_checked() {
    let sound = diurnal(0.1, sun(288), IrradianceReference::DailyMean).setup(1.0);
    assert!(sound.is_valid());
    let place = sound.sun;
    let suns = [
        Sun {
            latitude: 90.1,
            ..place
        },
        Sun {
            latitude: f64::NAN,
            ..place
        },
        Sun {
            day_of_year: 366,
            ..place
        },
        Sun {
            start_hour: 24.0,
            ..place
        },
        Sun {
            ttis_per_day: 0,
            ..place
        },
        Sun {
            ttis_per_day: MAX_TTIS_PER_DAY + 1,
            ..place
        },
    ];
    for sun in suns {
        assert!(!DiurnalSetup { sun, ..sound }.is_valid(), "{sun:?}");
    }
    for zenith in [f64::NAN, -0.1, 100.0] {
        assert!(!DiurnalSetup { zenith, ..sound }.is_valid(), "{zenith}");
    }
}
