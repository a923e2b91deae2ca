//! `reveille inspect tail`: decoded messages, one per line. Each line of `--json` has the keys of
//! `view/src/frame_line.rs`; [`Printer::format_exchange`] repeats them for a paired wake-up. `tests/recordings/` reads
//! them.

use std::io::Write;
use std::process::ExitCode;

use anyhow::bail;
use reveille_bs::scenario::Scenario;
use reveille_common::deployment::Deployment;
use reveille_common::ids::DeviceId;
use reveille_common::message::{Frame, Message, MessageKind, Plane};
use reveille_common::state::DeviceState;
use reveille_view::device_mirror::DeviceMirror;
use reveille_view::filter::Filter;
use reveille_view::frame_line::FrameLine;
use reveille_view::wake_up_pairs::{PairStep, WakeUpExchange, WakeUpPairer};
use serde_json::json;

use super::source::{FrameSource, check_tti_range, device_groups};
use crate::cli::{ColourArg, TailArgs};
use crate::display::{count_noun, note};
use crate::exit::ExitReason;
use crate::terminal;

/// Prints the requested messages.
pub(super) async fn run(args: &TailArgs) -> anyhow::Result<ExitCode> {
    check_tti_range(args.since, args.until)?;
    let mut filter = filter_without_devices(args);
    filter.check_kinds().map_err(anyhow::Error::msg)?;
    let mut source = FrameSource::open(args.file.as_deref(), &args.target).await?;
    let needs_scenario = args.cluster.is_some() || !filter.states.is_empty();
    let scenario = if needs_scenario || matches!(source, FrameSource::Recorded(..)) {
        Some(source.bundle().await?.load()?)
    } else {
        None
    };
    let device_count = match (&source, &scenario) {
        (FrameSource::Live(live), _) => live.devices,
        (_, Some(scenario)) => scenario.run.devices,
        // Not reached: the scenario of a recording is loaded above.
        (_, None) => 0,
    };
    if let Some(device) = args.device {
        let last = device_count.saturating_sub(1);
        anyhow::ensure!(
            device < device_count,
            "--device {device}: the run has {}, 0 to {last}",
            count_noun(device_count, "device")
        );
        filter.devices = Some(vec![DeviceId(device)]);
    }
    if let (Some(cluster), Some(scenario)) = (args.cluster, &scenario) {
        filter.devices = Some(cluster_devices(scenario, cluster, filter.devices.as_deref())?);
    }
    let mut printer = Printer::new(args, filter, scenario.as_ref());
    // With --state the mirror needs every frame, so a recording is read from its start.
    if printer.mirror.is_none() {
        source.seek(printer.filter.first_tti())?;
    }
    source.report_position();
    let result = printer.print(&mut source).await;
    note!("{}", source.closing_line(printer.printed_lines));
    let has_only_ttis = printer.filter
        == Filter {
            ttis: printer.filter.ttis.clone(),
            ..Filter::default()
        };
    if printer.printed_lines == 0 && result.is_ok() && has_only_ttis && args.since.is_some_and(|since| since > 0) {
        note!(
            "no message has these TTIs: the run can be shorter, or a grant can cover them, whose messages have its \
             first TTI; choose an earlier --since, or run with --no-lookahead"
        );
    }
    if let (0, Ok(()), Some(device), FrameSource::Recorded(..)) = (printer.printed_lines, &result, args.device, &source)
    {
        note!(
            "no message of device {device} passes the filters; `reveille inspect export FILE --to devices --every 1` \
             writes its state and battery in each TTI"
        );
    }
    source.close().await;
    result.map(|()| ExitReason::Done.into())
}

/// Returns the filter of all options except `--device` and `--cluster`, which need the run.
fn filter_without_devices(args: &TailArgs) -> Filter {
    let (first, last) = (args.since.unwrap_or(0), args.until.unwrap_or(u64::MAX));
    let is_limited = args.since.is_some() || args.until.is_some();
    Filter {
        plane: args.plane.map(Plane::from),
        kinds: args.kind.clone(),
        devices: None,
        ttis: is_limited.then_some(first..=last),
        states: args.state.clone(),
    }
}

/// Returns the devices of a cluster of the policy of `scenario`, limited to `allowed` if given.
fn cluster_devices(scenario: &Scenario, cluster: u32, allowed: Option<&[DeviceId]>) -> anyhow::Result<Vec<DeviceId>> {
    let Some(cluster_of_device) = device_groups(scenario) else {
        bail!(
            "--cluster: policy {} has no clusters that the scenario determines; leave it out",
            scenario.policy.name()
        );
    };
    let last_cluster = cluster_of_device.iter().max().copied().unwrap_or(0);
    anyhow::ensure!(
        cluster <= last_cluster,
        "--cluster {cluster}: the run has {}, 0 to {last_cluster}",
        count_noun(last_cluster + 1, "cluster")
    );
    let ids = (0..).map(DeviceId).zip(&cluster_of_device);
    let members = ids
        .filter(|(_, own_cluster)| **own_cluster == cluster)
        .map(|(id, _)| id);
    Ok(members
        .filter(|id| allowed.is_none_or(|allowed| allowed.contains(id)))
        .collect())
}

/// Prints the frames that pass the filter.
struct Printer<'a> {
    args: &'a TailArgs,
    filter: Filter,
    /// Joins a wake-up and its outcome to one line, if requested.
    pairer: Option<WakeUpPairer>,
    /// Tracks the states of devices, for `--state`.
    mirror: Option<DeviceMirror>,
    /// The state of the last woken device before its wake-up, for the line of a pair, which comes later.
    state_before_wake: Option<DeviceState>,
    has_colour: bool,
    printed_lines: u64,
}

impl<'a> Printer<'a> {
    fn new(args: &'a TailArgs, filter: Filter, scenario: Option<&Scenario>) -> Self {
        let filters_states = |_: &&Scenario| !filter.states.is_empty();
        Self {
            pairer: args.pair_wake_ups.then(WakeUpPairer::default),
            state_before_wake: None,
            mirror: scenario
                .filter(filters_states)
                .map(|scenario| DeviceMirror::new(scenario, &Deployment::new(scenario))),
            has_colour: match args.colour {
                ColourArg::Always => true,
                ColourArg::Never => false,
                ColourArg::Auto => terminal::shows_colours(),
            },
            filter,
            args,
            printed_lines: 0,
        }
    }

    /// Prints until enough messages are printed, the output is closed, or the source ends.
    ///
    /// # Errors
    /// If the recording is torn, or frames that `--state` needs are missing.
    async fn print(&mut self, source: &mut FrameSource) -> anyhow::Result<()> {
        let mut is_first_batch = true;
        while !self.is_done() {
            let Some((frames, dropped_before)) = source.next().await? else {
                return Ok(());
            };
            // The mirror follows the states from TTI 0 on; after a gap they would be wrong.
            if let (Some(_), Some(frame)) = (&self.mirror, frames.first()) {
                let is_late = std::mem::take(&mut is_first_batch) && frame.tti.0 > 0;
                if dropped_before > 0 || is_late {
                    bail!(
                        "--state: messages before TTI {} were not received, and device states depend on them; record \
                        the run with --record, then use `reveille inspect tail FILE --state`",
                        frame.tti
                    );
                }
            }
            let mut out = std::io::stdout().lock();
            for frame in &frames {
                if self.is_done() || self.filter.is_over(frame.tti) {
                    return Ok(());
                }
                if let Some(line) = self.format_frame(frame)? {
                    // A reader that closes the pipe, such as `head`, ends the command in order.
                    if writeln!(out, "{line}").is_err() {
                        return Ok(());
                    }
                    self.printed_lines += 1;
                }
            }
            if matches!(source, FrameSource::Live(_)) && out.flush().is_err() {
                return Ok(());
            }
        }
        Ok(())
    }

    fn is_done(&self) -> bool {
        self.args.count.is_some_and(|count| self.printed_lines >= count)
    }

    /// Formats the line of a frame, if it passes the filter. Call it with every frame in order: it also advances the
    /// mirror and the pairs.
    fn format_frame(&mut self, frame: &Frame) -> anyhow::Result<Option<String>> {
        let line = FrameLine::new(frame);
        let mut state = None;
        if let Some(mirror) = &mut self.mirror {
            // Filters see the state before the message has its effect.
            state = frame.device().and_then(|device| mirror.state(device));
            if frame.kind == MessageKind::Wake {
                self.state_before_wake = state;
            }
            if let Ok(message) = &line.message {
                mirror.apply(frame, message)?;
            }
        }
        let step = self
            .pairer
            .as_mut()
            .map_or(PairStep::Unpaired, |pairer| pairer.push(frame, &line.message));
        if let PairStep::Paired(exchange) = step {
            // The filter treats the line of an exchange as a wake-up, although its last frame is of another kind.
            let wake_frame = Frame {
                kind: MessageKind::Wake,
                ..frame.clone()
            };
            let passes = self
                .filter
                .passes(&wake_frame, line.message.as_ref().ok(), self.state_before_wake);
            return Ok(passes.then(|| self.format_exchange(&exchange)));
        }
        let passes = step == PairStep::Unpaired && self.filter.passes(frame, line.message.as_ref().ok(), state);
        Ok(passes.then(|| self.format_line(frame.kind, &line)))
    }

    fn format_exchange(&self, exchange: &WakeUpExchange) -> String {
        let WakeUpExchange {
            tti,
            device,
            outcome,
            bytes,
        } = exchange;
        if self.args.json {
            let message = json!({ "tti": tti, "outcome": outcome });
            return json!({
                "tti": tti, "plane": "air", "kind": "wake", "number": device, "bytes": bytes, "message": message
            })
            .to_string();
        }
        self.coloured(MessageKind::Wake, exchange.to_string())
    }

    fn format_line(&self, kind: MessageKind, line: &FrameLine<'_>) -> String {
        if self.args.json {
            line.to_json()
        } else {
            self.coloured(kind, format!("{line}{}", self.duty_in_plan(line)))
        }
    }

    /// Returns the duty cycle of the only requested device if `line` is a plan, whose text names only some devices.
    fn duty_in_plan(&self, line: &FrameLine<'_>) -> String {
        let (Some(device), Ok(Message::Plan(update))) = (self.args.device, &line.message) else {
            return String::new();
        };
        let cycle = update.plan.duty_cycle(DeviceId(device));
        let (on, ttis) = (cycle.t_on, cycle.t_drx);
        if on == 0 {
            format!("; device {device} sleeps")
        } else if on == ttis {
            format!("; device {device} senses")
        } else {
            let next = cycle.next_on(update.from);
            format!("; device {device} senses in {on} of every {ttis} TTIs, next in TTI {next}")
        }
    }

    /// Returns `text` in the colour of its kind.
    fn coloured(&self, kind: MessageKind, text: String) -> String {
        let code = match (kind, kind.plane()) {
            (MessageKind::Wake, _) => "1;33",
            (MessageKind::Report, _) => "32",
            (_, Plane::Air) => "36",
            (_, Plane::Emu) => "2",
            (_, Plane::Truth) => "35",
        };
        if self.has_colour {
            format!("\u{1b}[{code}m{text}\u{1b}[0m")
        } else {
            text
        }
    }
}
