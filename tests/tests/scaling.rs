//! Ψ is a unit: a run whose reports are worth three times as much, or a tenth, has the same commands and scaled
//! information (Eq. (1)).

use reveille_bs::cycle::RunOutcome;
use reveille_bs::observer::{Notification, Observer};
use reveille_bs::scenario::{Override, load};
use reveille_common::ids::{DeviceId, Tti};
use reveille_common::plan::Plan;
use reveille_common::totals::PICO_PER_INFORMATION;
use reveille_lab::preparation::start;
use reveille_lab::run::RunOptions;

/// Commands, and senders and information of reports.
#[derive(Default)]
struct ScaledRun {
    plans: Vec<(Tti, Plan)>,
    wake_ups: Vec<(Tti, DeviceId)>,
    reports: Vec<(Tti, DeviceId, f64)>,
    ended: Vec<f64>,
}

impl Observer for ScaledRun {
    fn notify(&mut self, notification: &Notification<'_>) {
        match notification {
            Notification::PlanSent { update, .. } => self.plans.push((update.from, update.plan.clone())),
            Notification::WakeUpSent { tti, device, .. } => self.wake_ups.push((*tti, *device)),
            Notification::ReportReceived(report) => self.reports.push((report.tti, report.device, report.information)),
            Notification::EventEnded(event) => {
                self.ended
                    .push(event.tally.information_pico as f64 / PICO_PER_INFORMATION);
            }
            Notification::TtisGranted(_)
            | Notification::EventStarted(_)
            | Notification::ReportLost(_)
            | Notification::DevicesRemoved(_)
            | Notification::ReportFailed { .. }
            | Notification::WakeUpCompleted { .. }
            | Notification::TtiClosed(_)
            | Notification::BeliefUpdated { .. }
            | Notification::DeviceStates(_) => {}
        }
    }
}

fn run(set: &[&str], psi: f64) -> (RunOutcome, ScaledRun) {
    let psi = format!("sensing.psi={psi:?}");
    let set = set.iter().copied().chain([psi.as_str()]);
    let overrides: Vec<Override> = set.map(|set| Override::parse(set).expect("an override")).collect();
    let mut heard = ScaledRun::default();
    let outcome = start(
        &load("paper", &overrides).expect("a scenario").scenario,
        RunOptions::default(),
    )
    .finish(&mut heard);
    (outcome, heard)
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
    let mut woken = 0;
    for (policy, ranking, g) in policies.iter().flat_map(|policy| {
        let kinds = [
            ("p42", "max"),
            ("posterior", "max"),
            ("p42", "sum-saturation"),
            ("posterior", "sum-saturation"),
        ];
        kinds.map(|(ranking, g)| (*policy, ranking, g))
    }) {
        let (ranking, g) = (format!("bs.ranking={ranking}"), format!("sensing.g={g}"));
        let others = ["devices=120", "ttis=1500", "layout.kind=uniform", "events.alpha=0.3"];
        let set: Vec<&str> = policy
            .iter()
            .copied()
            .chain(others)
            .chain([ranking.as_str(), g.as_str()])
            .collect();
        let (outcome, one) = run(&set, 1.0);
        for psi in [0.1, 3.0] {
            let (scaled, other) = run(&set, psi);
            assert_eq!(one.plans, other.plans, "plans, Ψ = {psi}, {set:?}");
            assert_eq!(one.wake_ups, other.wake_ups, "wake-ups, Ψ = {psi}, {set:?}");
            assert_eq!(one.reports.len(), other.reports.len(), "reports, Ψ = {psi}, {set:?}");
            for ((k, j, unit), (other_k, other_j, information)) in one.reports.iter().zip(&other.reports) {
                assert_eq!((k, j), (other_k, other_j), "reports, Ψ = {psi}, {set:?}");
                assert!(
                    (psi * unit - information).abs() < 1e-12 * psi,
                    "{psi}: {unit} and {information}"
                );
            }
            for (unit, information) in one.ended.iter().zip(&other.ended) {
                assert!(
                    (psi * unit - information).abs() < 1e-11,
                    "{psi}: {unit} and {information}"
                );
            }
            assert_eq!(outcome.totals.energy, scaled.totals.energy, "Ψ = {psi}, {set:?}");
            assert!((psi * outcome.metrics.info_p1 - scaled.metrics.info_p1).abs() < 1e-9);
            for ((name, fact), (other_name, scaled)) in outcome.facts.iter().zip(&scaled.facts) {
                let expected = if *name == "i_min" { psi * fact } else { *fact };
                assert!(
                    (expected - scaled).abs() < 1e-12,
                    "{name}, Ψ = {psi}: {fact} and {scaled}"
                );
                assert_eq!(name, other_name);
            }
        }
        woken += one.wake_ups.len();
    }
    assert!(woken > 3000, "{woken} wake-ups hardly tell");
}
