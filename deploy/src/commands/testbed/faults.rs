//! The schedule of faults of a testbed: lines such as `700 disconnect weak-1 for 5s`, in a file of `testbed init
//! --faults` and in `testbed.toml`. `docs/testbeds.md` explains the kinds; `docker` applies them.

use std::fmt;
use std::time::Duration;

use clap::ValueEnum;

use super::placement::{BS_SERVICE, DASHBOARD_SERVICE};
use crate::cli::{FaultKind, parse_duration};

/// A fault of one container.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Fault {
    pub kind: FaultKind,
    /// The service of the container.
    pub container: String,
    /// Time until the container is restored; `None` without an end.
    pub duration: Option<Duration>,
}

/// A fault before a TTI.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct ScheduledFault {
    /// The TTI before which the clock pauses for the fault.
    pub tti: u64,
    pub fault: Fault,
}

impl Fault {
    /// Creates a fault of one of `containers`.
    ///
    /// # Errors
    /// If there is no such container, or the kind takes no duration.
    pub(super) fn new(
        kind: FaultKind,
        container: &str,
        duration: Option<Duration>,
        containers: &[String],
    ) -> Result<Self, String> {
        if !containers.iter().any(|known| known == container) {
            return Err(format!(
                "{container}: no such container; use one of {}",
                containers.join(", ")
            ));
        }
        if (kind, container) == (FaultKind::Stop, BS_SERVICE) {
            return Err("stop bs: would end the run; use kill, after which the engine starts it again".to_owned());
        }
        let reason = match kind {
            FaultKind::Kill => "the engine starts the process again",
            FaultKind::Restore => "it ends other faults",
            FaultKind::Pause | FaultKind::Disconnect | FaultKind::Slow | FaultKind::Stop => "",
        };
        if duration.is_some() && !reason.is_empty() {
            return Err(format!("{kind} takes no duration: {reason}"));
        }
        Ok(Self {
            kind,
            container: container.to_owned(),
            duration,
        })
    }

    /// Whether the run waits for the container until the fault ends. It does not wait for the dashboard.
    pub(super) fn halts_run(&self) -> bool {
        let cuts_off = matches!(self.kind, FaultKind::Pause | FaultKind::Disconnect | FaultKind::Stop);
        cuts_off && self.container != DASHBOARD_SERVICE
    }

    /// The fault that ends this one.
    pub(super) fn restoration(&self) -> Self {
        Self {
            kind: FaultKind::Restore,
            container: self.container.clone(),
            duration: None,
        }
    }
}

/// Parses the lines of a schedule, with their numbers, for a run of `ttis` TTIs in `containers`. Empty lines and `#`
/// comments are skipped.
///
/// # Errors
/// If a line is no fault of this testbed; names the line by its number.
pub(super) fn parse_schedule<'a>(
    lines: impl IntoIterator<Item = (usize, &'a str)>,
    ttis: u64,
    containers: &[String],
) -> Result<Vec<ScheduledFault>, String> {
    let mut faults = Vec::new();
    for (number, line) in lines {
        let words: Vec<&str> = line.split('#').next().unwrap_or_default().split_whitespace().collect();
        if !words.is_empty() {
            let fault = parse_line(&words, ttis, containers);
            faults.push(fault.map_err(|cause| format!("line {number}: {cause}"))?);
        }
    }
    // Stable, so that faults in one TTI keep their order.
    faults.sort_by_key(|fault| fault.tti);
    Ok(faults)
}

fn parse_line(words: &[&str], ttis: u64, containers: &[String]) -> Result<ScheduledFault, String> {
    let (tti, kind, container, duration) = match words {
        [tti, kind, container] => (tti, kind, container, None),
        [tti, kind, container, "for", duration] => (tti, kind, container, Some(duration)),
        _ => return Err("use `TTI KIND CONTAINER [for DURATION]`, such as `700 disconnect bs for 5s`".to_owned()),
    };
    let tti = tti.parse().ok().filter(|tti| *tti < ttis);
    let tti = tti.ok_or_else(|| format!("`{}` must be a TTI of the run, from 0 to {}", words[0], ttis - 1))?;
    let kinds = FaultKind::value_variants()
        .iter()
        .map(ToString::to_string)
        .collect::<Vec<_>>();
    let kind = FaultKind::from_str(kind, false).map_err(|_| format!("`{kind}` must be one of {}", kinds.join(", ")))?;
    let duration = duration
        .map(|text| parse_duration(text).map_err(|cause| format!("`{text}` {cause}")))
        .transpose()?;
    let fault = Fault::new(kind, container, duration, containers)?;
    if fault.duration.is_none() && fault.halts_run() {
        return Err(format!(
            "{fault} needs a duration, such as `for 5s`: the run would wait for {container} before the next line"
        ));
    }
    Ok(ScheduledFault { tti, fault })
}

impl fmt::Display for FaultKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let value = self.to_possible_value();
        f.write_str(value.as_ref().map_or("", |value| value.get_name()))
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            kind,
            container,
            duration,
        } = self;
        write!(f, "{kind} {container}")?;
        duration.map_or(Ok(()), |duration| {
            write!(f, " for {}", humantime::format_duration(duration))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn containers() -> Vec<String> {
        ["bs", "weak-link", "weak-1", "strong-1"].map(str::to_owned).to_vec()
    }

    #[test]
    fn a_schedule_is_sorted_by_tti() {
        let text = "# comment\n\n900 restore weak-1\n 500  kill weak-1 # comment\n500 disconnect weak-link for 1m30s\n";
        let faults = parse_schedule((1..).zip(text.lines()), 1000, &containers()).expect("valid");
        let lines: Vec<String> = faults
            .iter()
            .map(|fault| format!("{} {}", fault.tti, fault.fault))
            .collect();
        assert_eq!(
            lines,
            [
                "500 kill weak-1",
                "500 disconnect weak-link for 1m 30s",
                "900 restore weak-1"
            ]
        );
        assert_eq!(faults[1].fault.duration, Some(Duration::from_secs(90)));
    }

    #[test]
    fn an_invalid_line_is_named_with_its_cause() {
        for (line, cause) in [
            ("500 kill", "use `TTI KIND CONTAINER [for DURATION]`"),
            ("500 pause weak-1 5s", "use `TTI KIND CONTAINER [for DURATION]`"),
            ("1000 kill weak-1", "`1000` must be a TTI of the run, from 0 to 999"),
            ("-1 kill weak-1", "`-1` must be a TTI"),
            (
                "500 explode weak-1",
                "`explode` must be one of kill, pause, disconnect, slow, stop, restore",
            ),
            (
                "500 kill weak-2",
                "weak-2: no such container; use one of bs, weak-link, weak-1, strong-1",
            ),
            ("500 pause weak-1 for 5", "`5` must be a time"),
            ("500 kill weak-1 for 5s", "kill takes no duration: the engine starts"),
            ("500 stop bs", "stop bs: would end the run; use kill"),
            ("500 restore bs for 5s", "restore takes no duration"),
            ("500 pause bs", "pause bs needs a duration, such as `for 5s`"),
        ] {
            let refusal = parse_schedule([(2, ""), (7, line)], 1000, &containers()).expect_err(line);
            assert!(refusal.starts_with(&format!("line 7: {cause}")), "{line}: {refusal}");
        }
    }
}
