//! Ψ is a unit of information (Eq. (1)): with another Ψ, a run has the same plans, wake-ups and energy, and its
//! information scales. `genie` and `dt`, other scenarios and the bus are not covered. The tolerances cover
//! rounding only.

use reveille_bs::cycle::RunOutcome;
use reveille_bs::observer::{Notification, Observer};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::plan::Plan;
use reveille_common::totals::PICO_PER_INFORMATION;
use reveille_lab::preparation::start;
use reveille_lab::run::RunOptions;
use reveille_tests::scenarios::paper;

/// Plans, wake-ups and information of a run.
#[derive(Default)]
struct InformationObserver {
    /// Sent plans, each with its first TTI.
    plans: Vec<(Tti, Plan)>,
    /// TTIs and devices of sent wake-ups.
    wake_ups: Vec<(Tti, DeviceId)>,
    /// Information of each received report without a wake-up, with its TTI and sender.
    reports: Vec<(Tti, DeviceId, f64)>,
    /// Information of each ended event, which includes the reports of woken devices.
    event_information: Vec<f64>,
}

impl Observer for InformationObserver {
    fn notify(&mut self, notification: &Notification<'_>) {
        match notification {
            Notification::PlanSent { update, .. } => self.plans.push((update.from, update.plan.clone())),
            Notification::WakeUpSent { tti, device, .. } => self.wake_ups.push((*tti, *device)),
            Notification::ReportReceived(report) => self.reports.push((report.tti, report.device, report.information)),
            Notification::EventEnded(event) => {
                self.event_information
                    .push(event.tally.information_pico as f64 / PICO_PER_INFORMATION);
            }
            Notification::TtisGranted(_)
            | Notification::EventStarted(_)
            | Notification::ReportLost(_)
            | Notification::DevicesRemoved(_)
            | Notification::ActionTaken(_)
            | Notification::ReportFailed { .. }
            | Notification::WakeUpCompleted { .. }
            | Notification::TtiClosed(_)
            | Notification::BeliefUpdated { .. }
            | Notification::DeviceStates(_) => {}
        }
    }
}

/// Runs the preset `paper` with `fields`, each of the form `field=value`, and with Ψ = `psi`.
fn run(fields: &[&str], psi: f64) -> (RunOutcome, InformationObserver) {
    let psi = format!("sensing.psi={psi:?}");
    let scenario = paper(&[fields, &[psi.as_str()]].concat());
    let mut observer = InformationObserver::default();
    let outcome = start(&scenario, RunOptions::default()).finish(&mut observer);
    (outcome, observer)
}

#[test]
fn a_run_scales_with_psi() {
    let policies: [&[&str]; 6] = [
        &["policy.name=knn"],
        &["policy.name=age-index"],
        &["policy.name=q-learning", "policy.q-learning.ages=true"],
        &[
            "policy.name=adjusted",
            "policy.adjusted.t_drx=[4,8]",
            "policy.adjusted.pilot_ttis=600",
        ],
        &["policy.name=q-learning"],
        &["policy.name=random"],
    ];
    let rankings_and_fusions = [
        ["bs.ranking=p42", "sensing.g=max"],
        ["bs.ranking=posterior", "sensing.g=max"],
        ["bs.ranking=p42", "sensing.g=sum-saturation"],
        ["bs.ranking=posterior", "sensing.g=sum-saturation"],
    ];
    let common_fields = ["devices=120", "ttis=1500", "layout.kind=uniform", "events.alpha=0.3"];
    let mut wake_up_count = 0;
    for (policy, ranking_and_fusion) in policies
        .iter()
        .flat_map(|policy| rankings_and_fusions.map(|fields| (*policy, fields)))
    {
        let fields = [policy, &common_fields, &ranking_and_fusion].concat();
        let (unit_outcome, unit) = run(&fields, 1.0);
        for psi in [0.1, 3.0] {
            let case = format!("Ψ = {psi}, {fields:?}");
            let (scaled_outcome, scaled) = run(&fields, psi);
            assert_eq!(unit.plans, scaled.plans, "plans, {case}");
            assert_eq!(unit.wake_ups, scaled.wake_ups, "wake-ups, {case}");
            assert_eq!(unit.reports.len(), scaled.reports.len(), "reports, {case}");
            for ((unit_tti, unit_device, unit_information), (tti, device, information)) in
                unit.reports.iter().zip(&scaled.reports)
            {
                assert_eq!((unit_tti, unit_device), (tti, device), "reports, {case}");
                assert!(
                    (psi * unit_information - information).abs() < 1e-12 * psi,
                    "report with {unit_information} for Ψ = 1 has {information}, {case}"
                );
            }
            assert_eq!(
                unit.event_information.len(),
                scaled.event_information.len(),
                "events, {case}"
            );
            for (unit_information, information) in unit.event_information.iter().zip(&scaled.event_information) {
                // Information of events is rounded to 1e-12.
                assert!(
                    (psi * unit_information - information).abs() < 1e-11,
                    "event with {unit_information} for Ψ = 1 has {information}, {case}"
                );
            }
            assert_eq!(unit_outcome.totals.energy, scaled_outcome.totals.energy, "{case}");
            let [unit_p1, scaled_p1] = [&unit_outcome, &scaled_outcome].map(|outcome| outcome.metrics.info_p1);
            assert!(
                (psi * unit_p1 - scaled_p1).abs() < 1e-9,
                "P1 {unit_p1} for Ψ = 1, {scaled_p1}, {case}"
            );
            for ((unit_name, unit_fact), (name, fact)) in unit_outcome.facts.iter().zip(&scaled_outcome.facts) {
                assert_eq!(unit_name, name);
                let expected = if *name == "i_min" { psi * unit_fact } else { *unit_fact };
                assert!(
                    (expected - fact).abs() < 1e-12,
                    "{name} {fact}, expected {expected}, {case}"
                );
            }
        }
        wake_up_count += unit.wake_ups.len();
    }
    // Not a requirement: without wake-ups the comparison would be vacuous.
    assert!(wake_up_count > 3000, "only {wake_up_count} wake-ups");
}
