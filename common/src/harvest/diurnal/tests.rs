//! Tests of [`Diurnal`] and [`CumulativeHazard`]: counts of arrivals against their probabilities, means against closed
//! forms, gaps against steps through single TTIs, and invalid setups. The sun itself is tested in `harvest/sun.rs`.
//! No test here covers the errors of scenario fields. Counts may deviate by 4.5 standard errors.

use crate::harvest::{Harvest, HarvestSetup, HarvestSource};
use crate::ids::DeviceId;

use super::*;

/// Length of a TTI τ in the setup of a source, as in the paper.
const TAU: f64 = 1.0;
/// The index of a trace, which a diurnal source ignores.
const NO_TRACE: u32 = 0;
const E_B: Energy = Energy::from_micro(5_000_000);

fn sun_with(ttis_per_day: u32) -> Sun {
    Sun {
        latitude: 52.5,
        day_of_year: 60,
        start_hour: 3.7,
        ttis_per_day,
        sky: Sky::Vacuum,
    }
}

fn diurnal_with(lambda: f64, sun: Sun, reference: IrradianceReference) -> Diurnal {
    let diurnal = Diurnal::new(Arrivals { lambda, e_b: E_B }, sun, reference, DayKnowledge::Course);
    assert!(diurnal.setup(TAU).is_valid(), "a valid setup");
    diurnal
}

fn source_of(diurnal: Diurnal, device: u32) -> HarvestSource {
    let setup = Harvest::Diurnal(diurnal).setup(TAU, NO_TRACE);
    HarvestSource::new(&setup, &SharedSourceData::default(), 11, DeviceId(device))
}

/// Counts the arrivals in each TTI (slot) of a day, over devices and days.
fn count_by_slot(diurnal: Diurnal, devices: u32, days: u64) -> Vec<u64> {
    let ttis = u64::from(diurnal.sun.ttis_per_day);
    let mut counts = vec![0; ttis as usize];
    for device in 0..devices {
        let mut source = source_of(diurnal, device);
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
fn arrivals_have_the_probabilities_of_their_slot() {
    for sky in [Sky::Vacuum, Sky::Clear] {
        let diurnal = diurnal_with(0.2, Sun { sky, ..sun_with(24) }, IrradianceReference::DailyMean);
        let (devices, days) = (200, 500);
        let trials = f64::from(devices) * days as f64;
        let probabilities: Vec<f64> = diurnal
            .sun
            .arrival_probabilities(diurnal.zenith_probability(TAU))
            .collect();
        assert!(
            probabilities.iter().filter(|&&p| p > 0.0).count() < 12,
            "the day is shorter than the night"
        );
        let mut square_sum = 0.0;
        for (slot, (&p, &count)) in probabilities
            .iter()
            .zip(&count_by_slot(diurnal, devices, days))
            .enumerate()
        {
            let standard_error = (trials * p * (1.0 - p)).sqrt();
            assert!(
                (count as f64 - trials * p).abs() <= 4.5 * standard_error,
                "slot {slot}: {count} arrivals, not {}",
                trials * p
            );
            square_sum += if standard_error > 0.0 {
                ((count as f64 - trials * p) / standard_error).powi(2)
            } else {
                0.0
            };
        }
        // The sum of at most twelve squares of standard normal draws exceeds 35 with a probability below 0.1 %.
        assert!(square_sum < 35.0, "sum of squared deviations {square_sum}");
    }
}

#[test]
fn arrivals_in_consecutive_ttis_are_independent() {
    let diurnal = diurnal_with(0.2, sun_with(24), IrradianceReference::DailyMean);
    let probabilities: Vec<f64> = diurnal
        .sun
        .arrival_probabilities(diurnal.zenith_probability(TAU))
        .collect();
    let (mut pair_count, mut expected_pairs) = (0_u64, 0.0);
    let days = 100_000;
    let mut source = source_of(diurnal, 3);
    let mut last = Tti::NEVER;
    while source.next_arrival() < Tti(24 * days) {
        let now = source.next_arrival();
        pair_count += u64::from(last.0.wrapping_add(1) == now.0);
        last = now;
        source.take_arrival();
    }
    for slot in 0..24 {
        expected_pairs += days as f64 * probabilities[slot] * probabilities[(slot + 1) % 24];
    }
    assert!(expected_pairs > 10_000.0, "enough pairs for the normal approximation");
    assert!(
        (pair_count as f64 - expected_pairs).abs() < 4.5 * expected_pairs.sqrt(),
        "{pair_count} pairs of arrivals, not {expected_pairs}"
    );
}

#[test]
fn the_mean_equals_eq5_or_its_product_with_the_mean_irradiance() {
    for (latitude, day_of_year) in [(0.0, 81), (60.0, 172), (-35.0, 200)] {
        let place = Sun {
            latitude,
            day_of_year,
            ..sun_with(288)
        };
        let eq5_probability = 0.1 * libm::exp(-0.1);
        let diurnal = diurnal_with(0.1, place, IrradianceReference::DailyMean);
        let HarvestSetup::Diurnal(setup) = Harvest::Diurnal(diurnal).setup(TAU, NO_TRACE) else {
            panic!("{diurnal:?}");
        };
        assert!((setup.mean_probability - eq5_probability).abs() < 1e-12, "{setup:?}");
        let eq5 = Harvest::Eq5(diurnal.arrivals).setup(TAU, NO_TRACE).mean(&[]);
        assert_eq!(Harvest::Diurnal(diurnal).setup(TAU, NO_TRACE).mean(&[]), eq5);
        let zenith_setup = diurnal_with(0.1, place, IrradianceReference::Zenith).setup(TAU);
        assert!(
            (zenith_setup.mean_probability - eq5_probability * place.mean_irradiance()).abs() < 1e-12,
            "{zenith_setup:?}"
        );
        assert!(zenith_setup.zenith_probability.to_bits() == eq5_probability.to_bits() && zenith_setup.is_valid());
        // The profile's sum over a day is its 288 TTIs times their mean.
        let profile = setup.day_profile().expect("known");
        let day_units = profile.energy_between(Tti(1000), Tti(1288)).units();
        assert!(
            (day_units - 288.0 * 5.0 * eq5_probability).abs() < 1e-6,
            "{day_units} units a day"
        );
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
fn a_polar_night_has_no_arrivals_and_a_polar_day_has_some_in_every_slot() {
    let place = Sun {
        latitude: 80.0,
        day_of_year: 355,
        ..sun_with(288)
    };
    let polar_night = diurnal_with(0.3, place, IrradianceReference::Zenith);
    assert_eq!(source_of(polar_night, 0).next_arrival(), Tti::NEVER);
    assert_eq!(
        Harvest::Diurnal(polar_night).setup(TAU, NO_TRACE).mean(&[]),
        Energy::ZERO
    );
    let polar_day = diurnal_with(
        0.3,
        Sun {
            day_of_year: 172,
            ..place
        },
        IrradianceReference::Zenith,
    );
    assert!(count_by_slot(polar_day, 20, 100).iter().all(|&count| count > 0));
    let without_energy = Diurnal::new(
        Arrivals {
            lambda: 0.3,
            e_b: Energy::ZERO,
        },
        sun_with(24),
        IrradianceReference::Zenith,
        DayKnowledge::Course,
    );
    assert_eq!(source_of(without_energy, 0).next_arrival(), Tti::NEVER);
}

#[test]
fn the_hazard_table_equals_steps_through_single_ttis() {
    let diurnal = diurnal_with(0.2, sun_with(17), IrradianceReference::DailyMean);
    let probabilities: Vec<f64> = diurnal
        .sun
        .arrival_probabilities(diurnal.zenith_probability(TAU))
        .collect();
    let hazards = CumulativeHazard::new(probabilities.iter().copied());
    let mut stream = Stream::new(5, crate::rng::Purpose::Harvest, 0);
    for from in 0..400 {
        let target_hazard = -3.0 * libm::log1p(-stream.unit());
        let (mut remaining_hazard, mut k) = (target_hazard, from);
        loop {
            let hazard = -libm::log1p(-probabilities[(k % 17) as usize]);
            if remaining_hazard < hazard {
                break;
            }
            remaining_hazard -= hazard;
            k += 1;
        }
        assert_eq!(
            hazards.first_tti_beyond(Tti(from), target_hazard),
            Tti(k),
            "hazard {target_hazard} from TTI {from}"
        );
    }
    // The end of a day counts as the first light of the next.
    let day_hazard = probabilities.iter().fold(0.0, |sum, p| sum - libm::log1p(-p));
    let first_light = probabilities.iter().position(|&p| p > 0.0).expect("light") as u64;
    let last_light = probabilities.iter().rposition(|&p| p > 0.0).expect("light") as u64;
    assert!(first_light > 0 || last_light < 16, "the day must contain a night");
    assert_eq!(hazards.first_tti_beyond(Tti(0), day_hazard), Tti(17 + first_light));
    assert_eq!(
        hazards.first_tti_beyond(Tti(0), 2.0 * day_hazard),
        Tti(34 + first_light)
    );
}

#[test]
fn an_invalid_setup_is_detected() {
    let valid = diurnal_with(0.1, sun_with(288), IrradianceReference::DailyMean).setup(TAU);
    assert!(valid.is_valid());
    let place = valid.sun;
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
        assert!(!DiurnalSetup { sun, ..valid }.is_valid(), "{sun:?}");
    }
    for zenith_probability in [f64::NAN, -0.1, 100.0] {
        assert!(
            !DiurnalSetup {
                zenith_probability,
                ..valid
            }
            .is_valid(),
            "{zenith_probability}"
        );
    }
}
