//! The energy balance of a scenario as text, for `reveille scenario check`. `common/src/energy_balance/` computes it;
//! `docs/scenarios.md` and `docs/tutorial.md` show it. Values start after 18 columns: two spaces and a label of 16.

use std::time::Duration;

use humantime::format_duration;
use reveille_common::digits::format_significant;
use reveille_common::energy_balance::{ClassBalance, EnergyBalance, HarvestRange};

use crate::display::count_noun;

/// Significant digits of amounts and ratios; shares have three.
const DIGITS: u32 = 4;

/// Formats `balance` as lines of at most 80 columns. A scenario with several classes has a block for each.
pub(super) fn format_balance(balance: &EnergyBalance) -> String {
    let mut lines = vec![
        format!("  simulated time  {}", format_simulated_time(balance)),
        format!(
            "  out of reach    {} % of the area is more than d_max = {} m from every device",
            format_significant(100.0 * balance.share_out_of_reach, 3),
            format_significant(balance.d_max, DIGITS)
        ),
        "                  (exact: Voronoi cells outside the discs, devices of this seed)".to_owned(),
        format!("  harvest         {}", format_harvest(balance.harvest())),
    ];
    let has_classes = balance.classes.len() > 1;
    for class in &balance.classes {
        if has_classes {
            let devices = count_noun(class.devices as usize, "device");
            lines.push(format!("  class {}: {devices}", class.name));
            lines.push(format!("  harvest         {}", format_harvest(class.harvest)));
        }
        lines.extend(format_costs(class, balance));
        lines.push(format_affordable_sensing(class, balance));
        lines.extend(format_longest_gap(class, balance));
    }
    lines.join("\n") + "\n"
}

/// Formats a harvest, with a second line for its range if the devices differ.
fn format_harvest(HarvestRange { mean, min, max }: HarvestRange) -> String {
    let [mean_text, min_text, max_text] = [mean, min, max].map(|harvest| format_significant(harvest, DIGITS));
    let range = if min_text == max_text {
        String::new()
    } else {
        format!("\n{:18}by device {min_text} to {max_text}", "")
    };
    format!("{mean_text} units per device and TTI, expected{range}")
}

/// Formats the table of consumptions of the devices of `class`.
fn format_costs(class: &ClassBalance, balance: &EnergyBalance) -> Vec<String> {
    let format_cost_per_tti = |name: &str, cost: f64, ratio: Option<f64>| {
        let lifetime = match class.actions_per_battery(cost) {
            Some(ttis) => format!("{}{}", count_noun(ttis as usize, "TTI"), format_span(balance, ttis)),
            None => "any time".to_owned(),
        };
        let ratio = ratio.map_or_else(|| "–".to_owned(), |ratio| format_significant(ratio, DIGITS));
        format!(
            "  {name:<16}{:>10}{ratio:>18}  {lifetime}",
            format_significant(cost, DIGITS)
        )
    };
    let report_count = class.actions_per_battery(class.report_cost);
    let reports_text = report_count.map_or_else(
        || "any number of reports".to_owned(),
        |reports| count_noun(reports as usize, "report"),
    );
    vec![
        format!("  {:<16}{:>10}{:>18}  full battery pays", "", "cost", "harvest / cost"),
        format_cost_per_tti("always sensing", class.sensing_cost, class.sensing_ratio()),
        format_cost_per_tti("always sleeping", class.sleeping_cost, class.sleeping_ratio()),
        format!(
            "  {:<16}{:>10}{:>18}  {reports_text}",
            "a report",
            format_significant(class.report_cost, DIGITS),
            ""
        ),
    ]
}

/// Formats the share of TTIs in which devices of `class` can sense.
fn format_affordable_sensing(class: &ClassBalance, balance: &EnergyBalance) -> String {
    let format_share = |reports_per_tti: f64| match class.affordable_sensing(reports_per_tti) {
        share if share <= 0.0 => "no TTI".to_owned(),
        share if share >= 1.0 => "every TTI".to_owned(),
        share => format!("{} % of TTIs", format_significant(100.0 * share, 3)),
    };
    format!(
        "  harvest pays    sensing in {};\n{:18}in {} with one report per event",
        format_share(0.0),
        "",
        format_share(balance.reports_per_device_tti)
    )
}

/// Formats the longest stretch without harvest, and how many batteries sleeping through it takes.
fn format_longest_gap(class: &ClassBalance, balance: &EnergyBalance) -> Vec<String> {
    let (Some(gap), Some(batteries)) = (class.longest_gap, class.batteries_of_longest_gap()) else {
        return Vec::new();
    };
    let ttis = count_noun(gap.ttis as usize, "TTI");
    let consequence = if batteries > 1.0 {
        ": every device loses power"
    } else {
        ""
    };
    vec![
        format!(
            "  longest gap     {ttis}{} without harvest, from TTI {}",
            format_span(balance, gap.ttis),
            gap.first
        ),
        format!(
            "{:18}sleeping through it takes {} full batteries{consequence}",
            "",
            format_significant(batteries, 3)
        ),
    ]
}

/// Formats the duration of the run in the time that a TTI represents.
fn format_simulated_time(balance: &EnergyBalance) -> String {
    let ttis = count_noun(balance.ttis as usize, "TTI");
    if let [seconds] = balance.tti_seconds.as_slice() {
        let tti = format_significant(*seconds, DIGITS);
        return format!("{ttis} of {tti} s{}", format_span(balance, balance.ttis));
    }
    let model_time = format_significant(balance.ttis as f64 * balance.tau, 6);
    format!("{ttis}, {model_time} units of model time")
}

/// Formats the time that `ttis` TTIs represent, in brackets. Empty unless the energy sources define one duration of a
/// TTI, and no other.
fn format_span(balance: &EnergyBalance, ttis: u64) -> String {
    let &[tti_seconds] = balance.tti_seconds.as_slice() else {
        return String::new();
    };
    let seconds = ttis as f64 * tti_seconds;
    // Two units of time are enough: 2 days 3h, not 2 days 3h 7m 12s.
    let rounding_seconds = match seconds {
        s if s >= 86_400.0 => 3600.0,
        s if s >= 3600.0 => 60.0,
        s if s >= 1.0 => 1.0,
        _ => 1e-6,
    };
    match Duration::try_from_secs_f64((seconds / rounding_seconds).round() * rounding_seconds) {
        // humantime writes `2days`.
        Ok(span) => format!(" ({})", format_duration(span).to_string().replace("day", " day")),
        Err(_) => String::new(),
    }
}

#[cfg(test)]
mod tests {
    use reveille_bs::scenario::{Override, load};

    use super::*;

    /// Returns the balance of the preset or file `source` with the fields of `set`.
    fn text_with(source: &str, set: &[&str]) -> String {
        let overrides: Vec<Override> = set
            .iter()
            .map(|text| Override::parse(text).expect("FIELD=VALUE"))
            .collect();
        format_balance(&EnergyBalance::new(
            &load(source, &overrides).expect("a scenario").scenario,
        ))
    }

    #[test]
    fn the_text_fits_in_80_columns_and_shows_small_costs() {
        let two_classes = concat!(env!("CARGO_MANIFEST_DIR"), "/scenarios/two-classes.toml");
        let day_and_night = concat!(env!("CARGO_MANIFEST_DIR"), "/scenarios/day-and-night.toml");
        for text in [
            text_with("paper", &["energy.e_wur=0.00003", "harvest.e_b=0.00123456"]),
            text_with(two_classes, &[]),
            text_with(day_and_night, &["ttis=1000000"]),
        ] {
            let widest = text.lines().map(|line| line.chars().count()).max();
            assert!(widest <= Some(80), "{widest:?} columns: {text}");
        }
        let small = text_with("paper", &["energy.e_wur=0.00003"]);
        assert!(small.contains("0.00003"), "{small}");
        let classes = text_with(two_classes, &[]);
        for part in [
            "by device 0.2715 to 1.25",
            "class weak: 80 devices",
            "2799 TTIs",
            "25 reports",
        ] {
            assert!(classes.contains(part), "{part}: {classes}");
        }
        let days = text_with(day_and_night, &[]);
        assert!(days.contains("8640 TTIs of 300 s (30 days)"), "{days}");
        assert!(days.contains("longest gap     14"), "{days}");
        assert!(
            days.contains("sleeping through it takes 0.103 full batteries\n"),
            "{days}"
        );
        let wasteful = text_with(day_and_night, &["energy.e_wur=5"]);
        assert!(
            wasteful.contains("full batteries: every device loses power"),
            "{wasteful}"
        );
        assert!(!small.contains("longest gap"), "{small}");
    }
}
