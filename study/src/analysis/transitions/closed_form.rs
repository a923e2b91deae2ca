//! Closed forms of P_m,n (Sec. IV) for one device, as printed in the paper, with the inputs of all devices of a
//! deployment. Results are not corrected: they may leave [0, 1] or be NaN. [`PAIRS`] sets the order of the rows of
//! `reveille analyse transitions`, which docs/analysis.md quotes.

use reveille_bs::beliefs::correlation::Correlation;
use reveille_bs::bounds_cache::BoundsCache;
use reveille_bs::scenario::Scenario;
use reveille_common::geometry::Point;
use reveille_common::harvest::Arrivals;
use reveille_common::plan::DutyCycle;
use reveille_common::scenario::{DeviceClass, assign_classes};

use crate::analysis::battery::{Eq8, Eq8Input, highest_state};

/// The transitions (m, n) of Fig. 4, in the order of all arrays here.
pub const PAIRS: [(usize, usize); 10] = [
    (1, 1),
    (1, 2),
    (1, 4),
    (2, 3),
    (2, 4),
    (3, 1),
    (3, 4),
    (4, 1),
    (4, 2),
    (4, 4),
];

/// Rows and columns of the grid of epicentres for the means. Another number changes the printed columns of the command.
const EPICENTRES_PER_SIDE: u32 = 24;

/// Inputs of one device's closed forms, except α.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClosedFormInputs {
    /// Duty cycle.
    pub duty: DutyCycle,
    /// Mean of p(d_ij) over epicentres uniform on the area.
    pub mean_p: f64,
    /// P_4,2, Eq. (9): mean of Pr(S_j = S3 | S_h = S3) over epicentres that have a device in range, h the closest one
    /// and another device than j; 0 without such an epicentre.
    pub p42: f64,
    /// P_2,3 = Pr(B ≥ E_Tx), Eq. (8) as printed.
    pub p23: f64,
}

/// Evaluates the printed P_m,n of a device with `inputs` for events of probability `alpha`, in the order of [`PAIRS`].
pub fn evaluate_printed(inputs: &ClosedFormInputs, alpha: f64) -> [f64; PAIRS.len()] {
    let (t_on, t_drx) = (inputs.duty.t_on, inputs.duty.t_drx);
    let p41 = f64::from(t_on) / f64::from(t_drx);
    let p12 = alpha * inputs.mean_p;
    let p11 = duty_sum(t_on, t_drx, 1.0 - alpha);
    let p31 = duty_sum(t_on, t_drx, 1.0);
    [
        p11,
        p12,
        1.0 - p11 - p12,
        inputs.p23,
        1.0 - inputs.p23,
        p31,
        1.0 - p31,
        p41,
        inputs.p42,
        1.0 - p41 - inputs.p42,
    ]
}

/// Computes Σ_{i=τ}^{t_on} base^i (t_on − i)/(t_DRX − i), i in steps of τ: Eqs. (12) and (13). 0/0 if t_on = t_DRX.
/// t_on must not exceed t_DRX, as in every [`DutyCycle`].
fn duty_sum(t_on: u32, t_drx: u32, base: f64) -> f64 {
    let mut power = 1.0;
    let mut sum = 0.0;
    for i in 1..=t_on {
        power *= base;
        sum += power * f64::from(t_on - i) / f64::from(t_drx - i);
    }
    sum
}

/// Computes the inputs of all devices at `positions` with the duty cycles `duties` and the device classes `classes`, in
/// the order of ids.
pub(super) fn device_inputs(
    scenario: &Scenario,
    positions: &[Point],
    duties: &[DutyCycle],
    classes: &[&DeviceClass],
) -> Vec<ClosedFormInputs> {
    let (mean_p, p42) = means_over_epicentres(scenario, positions);
    let by_device = duties.iter().zip(classes).zip(mean_p.iter().zip(&p42));
    by_device
        .map(|((&duty, class), (&mean_p, &p42))| ClosedFormInputs {
            duty,
            mean_p,
            p42,
            p23: printed_p23(class, scenario.events.alpha * mean_p + p42),
        })
        .collect()
}

/// Evaluates Eq. (8) for E_Tx, which can exceed 1; NaN for energy sources without λ and E_B, and where [`Eq8`] is NaN.
fn printed_p23(class: &DeviceClass, activation: f64) -> f64 {
    let Some(Arrivals { lambda, e_b }) = class.harvest.arrivals() else {
        return f64::NAN;
    };
    let e_max = class.energy.e_max.units();
    let input = Eq8Input {
        e: class.energy.e_tx.units(),
        e_max,
        m: highest_state(e_max, e_b.units(), lambda),
        activation,
    };
    Eq8::new(input).sum
}

/// Computes the means of p(d_ij) and of P_4,2 for each device, over the epicentres that [`ClosedFormInputs`] states.
fn means_over_epicentres(scenario: &Scenario, positions: &[Point]) -> (Vec<f64>, Vec<f64>) {
    let (sensing, correlation) = (
        &scenario.sensing,
        Correlation::new(&scenario.sensing, &BoundsCache::default()),
    );
    let mut mean_p = vec![0.0; positions.len()];
    let (mut p42, mut sample_counts) = (vec![0.0; positions.len()], vec![0_u32; positions.len()]);
    for cell in 0..EPICENTRES_PER_SIDE * EPICENTRES_PER_SIDE {
        let coordinate = |index: u32, length: f64| (f64::from(index) + 0.5) / f64::from(EPICENTRES_PER_SIDE) * length;
        let epicentre = Point::new(
            coordinate(cell % EPICENTRES_PER_SIDE, scenario.area.width),
            coordinate(cell / EPICENTRES_PER_SIDE, scenario.area.height),
        );
        let distances: Vec<f64> = positions.iter().map(|p| p.distance(epicentre)).collect();
        for (mean, &d) in mean_p.iter_mut().zip(&distances) {
            *mean += sensing.p(d) / f64::from(EPICENTRES_PER_SIDE * EPICENTRES_PER_SIDE);
        }
        // The reporter h of Eq. (9) is the device closest to the epicentre.
        let closest = (0..positions.len()).min_by(|&a, &b| distances[a].total_cmp(&distances[b]));
        let Some(h) = closest.filter(|&h| distances[h] <= sensing.d_max) else {
            continue;
        };
        for j in (0..positions.len()).filter(|&j| j != h) {
            p42[j] += correlation.p42(distances[h], positions[h].distance(positions[j]));
            sample_counts[j] += 1;
        }
    }
    for (sum, &n) in p42.iter_mut().zip(&sample_counts) {
        // If a device is the closest one for every epicentre in range, it has no terms and its mean is 0.
        *sum /= f64::from(n.max(1));
    }
    (mean_p, p42)
}

/// Class of each device, in the order of ids.
pub(super) fn device_classes(scenario: &Scenario) -> Vec<&DeviceClass> {
    let assigned = assign_classes(scenario);
    assigned
        .into_iter()
        .map(|class| &scenario.classes[usize::from(class)])
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn inputs_with_duty(t_on: u32, t_drx: u32) -> ClosedFormInputs {
        ClosedFormInputs {
            duty: DutyCycle { t_on, t_drx, offset: 0 },
            mean_p: 0.2,
            p42: 0.1,
            p23: 0.9,
        }
    }

    fn assert_close(forms: &[f64; PAIRS.len()], expected: &[f64; PAIRS.len()]) {
        for (i, (form, expected_form)) in forms.iter().zip(expected).enumerate() {
            assert!(
                (form - expected_form).abs() < 1e-12,
                "P_{:?}: {form}, expected {expected_form}",
                PAIRS[i]
            );
        }
    }

    #[test]
    fn the_sums_of_eqs_12_and_13_equal_a_calculation_by_hand() {
        // t_on = 3, t_DRX = 5, α = 1/2: Σ = 1/2 · 2/4 + 1/4 · 1/3 + 0, and without α 2/4 + 1/3.
        let forms = evaluate_printed(&inputs_with_duty(3, 5), 0.5);
        let (p11, p31) = (0.25 + 1.0 / 12.0, 5.0 / 6.0);
        let expected = [p11, 0.1, 0.9 - p11, 0.9, 0.1, p31, 1.0 - p31, 0.6, 0.1, 0.3];
        assert_close(&forms, &expected);
        // A device that spends single TTIs in S1 never stays there.
        let single_ttis = evaluate_printed(&inputs_with_duty(1, 4), 0.5);
        assert_eq!((single_ttis[0], single_ttis[5], single_ttis[7]), (0.0, 0.0, 0.25));
    }

    #[test]
    fn printed_forms_can_leave_the_unit_interval() {
        // With a long t_on, nearly every term is nearly 1.
        let long_t_on = evaluate_printed(&inputs_with_duty(16, 17), 0.01);
        assert!(
            long_t_on[0] > 1.0 && long_t_on[2] < 0.0 && long_t_on[5] > 1.0,
            "{long_t_on:?}"
        );
        // t_on = t_DRX, a device that always senses, gives 0/0.
        assert!(evaluate_printed(&inputs_with_duty(2, 2), 0.1)[0].is_nan());
        // A short cycle and a close neighbour.
        let close_neighbour = ClosedFormInputs {
            p42: 0.6,
            ..inputs_with_duty(1, 2)
        };
        assert!(evaluate_printed(&close_neighbour, 0.1)[9] < 0.0);
    }
}
