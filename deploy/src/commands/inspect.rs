//! `reveille inspect tail`: the messages of a run, decoded, as they go.

use std::fmt;
use std::io::Write;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use reveille_common::bus::Bus;
use reveille_common::codec;
use reveille_common::event::Stimulus;
use reveille_common::keys::{self, Kind};
use reveille_common::message::{
    Answer, Clock, ClockCommand, JoinRequest, PlanUpdate, Ready, Report, TapBatch, TapFrame, Tick, WakeUp,
};
use reveille_common::plan::Plan;
use serde::Serialize;
use serde_json::json;

use crate::cli::{InspectCommand, TailArgs};
use crate::local;

const PATIENCE: Duration = Duration::from_secs(5);

/// Follows a run.
pub async fn run(command: &InspectCommand) -> anyhow::Result<ExitCode> {
    match command {
        InspectCommand::Tail(args) => tail(args).await,
    }
}

async fn tail(args: &TailArgs) -> anyhow::Result<ExitCode> {
    let (endpoint, run) = local::find(&args.target)?;
    let bus = Bus::connect(&endpoint, run, PATIENCE).await?;
    if !bus.runs(PATIENCE).await?.contains(&bus.keys().run().to_string()) {
        return Err(bus.no_run().await.into());
    }
    let (send, mut batches) = tokio::sync::mpsc::unbounded_channel();
    let ended = Arc::new(tokio::sync::Notify::new());
    let bell = Arc::clone(&ended);
    let _watch = bus.watch_alive(bus.keys().bs_alive(), move |_, alive| {
        if !alive {
            bell.notify_one();
        }
    })?;
    let _tap = bus.subscribe(bus.keys().tap(), move |_, batch: TapBatch| {
        let _gone = send.send(batch).is_err();
    })?;
    let mut follower = Follower::default();
    loop {
        tokio::select! {
            batch = batches.recv() => if !batch.is_some_and(|batch| follower.take(args, &batch)) {
                break;
            },
            () = ended.notified() => {
                // What has arrived is still shown.
                while batches.try_recv().is_ok_and(|batch| follower.take(args, &batch)) {}
                break;
            }
            _ = tokio::signal::ctrl_c() => break,
        }
    }
    let Follower { printed, left_out, .. } = follower;
    eprintln!("{printed} messages shown, {left_out} left out because this could not keep up");
    bus.close().await;
    Ok(ExitCode::SUCCESS)
}

/// How far the run has been followed.
#[derive(Default)]
struct Follower {
    /// The number of the next frame, once one has come.
    expected: Option<u64>,
    printed: u64,
    left_out: u64,
}

impl Follower {
    /// Prints what `args` asks for and counts what is missing before it. False when enough is printed, or nobody reads.
    fn take(&mut self, args: &TailArgs, batch: &TapBatch) -> bool {
        self.left_out += batch.first.saturating_sub(self.expected.unwrap_or(batch.first));
        self.expected = Some(batch.first.saturating_add(batch.frames.len() as u64));
        print(args, &batch.frames, &mut self.printed)
    }
}

/// Prints the frames that `args` asks for. False when enough are printed, or nobody reads.
fn print(args: &TailArgs, frames: &[TapFrame], printed: &mut u64) -> bool {
    let mut out = std::io::stdout().lock();
    for frame in frames {
        if args.count.is_some_and(|count| *printed >= count) {
            return false;
        }
        if let Some(line) = line(args, frame) {
            if writeln!(out, "{line}").is_err() {
                return false;
            }
            *printed += 1;
        }
    }
    out.flush().is_ok() && args.count.is_none_or(|count| *printed < count)
}

/// One line for a frame that passes the filters.
fn line(args: &TailArgs, frame: &TapFrame) -> Option<String> {
    let (kind, number) = keys::classify(&frame.key)?;
    let plane = kind.plane();
    let is_wanted = args.plane.is_none_or(|wanted| plane == wanted.into());
    if !is_wanted || !(args.kind.is_empty() || args.kind.contains(&kind)) {
        return None;
    }
    let message = Message::read(kind, &frame.payload);
    if args.device.is_some_and(|device| !message.concerns(number, device)) {
        return None;
    }
    let (tti, bytes) = (frame.tti, frame.payload.len());
    Some(if args.json {
        let (plane, kind) = (plane.name(), kind.name());
        let line =
            json!({ "tti": tti.0, "plane": plane, "kind": kind, "number": number, "bytes": bytes, "message": message });
        line.to_string()
    } else {
        let number = number.map(|n| n.to_string()).unwrap_or_default();
        format!(
            "{tti:>8} {} {:<7} {number:>5} {bytes:>6} B  {message}",
            plane.name(),
            kind.name()
        )
    })
}

/// A decoded message of any kind.
#[derive(Serialize)]
#[serde(untagged)]
enum Message {
    Plan(PlanUpdate),
    Wake(WakeUp),
    Report(Report),
    Clock(Clock),
    Answer(Answer),
    Join(JoinRequest),
    Ready(Ready),
    Control(ClockCommand),
    Malformed { malformed: String },
}

impl Message {
    fn read(kind: Kind, payload: &[u8]) -> Self {
        let message = match kind {
            Kind::Plan => codec::decode(payload).map(Self::Plan),
            Kind::Wake => codec::decode(payload).map(Self::Wake),
            Kind::Report => codec::decode(payload).map(Self::Report),
            Kind::Clock => codec::decode(payload).map(Self::Clock),
            Kind::Answer => codec::decode(payload).map(Self::Answer),
            Kind::Join => codec::decode(payload).map(Self::Join),
            Kind::Ready => codec::decode(payload).map(Self::Ready),
            Kind::Control => codec::decode(payload).map(Self::Control),
        };
        message.unwrap_or_else(|error| Self::Malformed {
            malformed: error.to_string(),
        })
    }

    /// Whether it is to or from `device`; `number` is the one in its key.
    fn concerns(&self, number: Option<u32>, device: u32) -> bool {
        match self {
            Self::Plan(_) => true,
            Self::Wake(_) | Self::Report(_) => number == Some(device),
            Self::Answer(Answer::NotWoken { device: who, .. }) => who.0 == device,
            Self::Answer(Answer::Done { failures, .. }) => failures.iter().any(|f| f.device.0 == device),
            Self::Answer(Answer::Final { ledgers, .. }) => ledgers.iter().any(|(who, _)| who.0 == device),
            Self::Clock(_) | Self::Join(_) | Self::Ready(_) | Self::Control(_) | Self::Malformed { .. } => false,
        }
    }
}

impl fmt::Display for Message {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Plan(PlanUpdate {
                from,
                plan: Plan::Bits { bits },
            }) => {
                let on: u32 = bits.iter().map(|byte| byte.count_ones()).sum();
                write!(f, "δ from TTI {from}: {on} devices sense")
            }
            Self::Plan(PlanUpdate {
                from,
                plan: Plan::Periodic(cycles),
            }) => {
                let on = cycles.iter().filter(|cycle| cycle.is_on(*from)).count();
                write!(
                    f,
                    "δ from TTI {from}: periodic, {on} of {} devices sense first",
                    cycles.len()
                )
            }
            Self::Wake(WakeUp { .. }) => f.write_str("wake-up"),
            Self::Report(Report {
                information, battery, ..
            }) => write!(f, "I {information:.4}, battery {:.2} left", battery.units()),
            Self::Clock(Clock::Grant(tick)) => grant(f, tick),
            Self::Clock(Clock::Finish(end)) => write!(f, "the run ends before TTI {end}"),
            Self::Clock(Clock::Dismiss) => f.write_str("hosts may leave"),
            Self::Answer(answer) => describe(f, answer),
            Self::Join(JoinRequest { version, count, .. }) => {
                write!(f, "offers to carry {count} devices, reveille {version}")
            }
            Self::Ready(Ready { host }) => write!(f, "host {host} is ready"),
            Self::Control(command) => write!(f, "{command:?}"),
            Self::Malformed { malformed } => write!(f, "not a message: {malformed}"),
        }
    }
}

fn grant(f: &mut fmt::Formatter<'_>, tick: &Tick) -> fmt::Result {
    let Tick {
        first,
        last,
        stimulus,
        account,
        batteries,
        plan: _,
    } = tick;
    if first == last {
        write!(f, "TTI {first}")?;
    } else {
        write!(f, "TTIs {first} to {last}")?;
    }
    if let Some(Stimulus { event, epicentre }) = stimulus {
        write!(f, ", event {} at ({:.2}, {:.2}) m", event.0, epicentre.x, epicentre.y)?;
    }
    f.write_str(if *account { ", sums wanted" } else { "" })?;
    f.write_str(if *batteries { ", batteries wanted" } else { "" })
}

fn describe(f: &mut fmt::Formatter<'_>, answer: &Answer) -> fmt::Result {
    match answer {
        Answer::Done {
            reports,
            failures,
            totals,
            ..
        } => {
            write!(f, "done, {reports} reports")?;
            for failure in failures {
                write!(f, ", device {} could not transmit", failure.device)?;
            }
            totals
                .as_ref()
                .map_or(Ok(()), |sums| write!(f, ", batteries hold {}", sums.battery))
        }
        Answer::NotWoken {
            device,
            failure: Some(failure),
            ..
        } => {
            write!(
                f,
                "device {device} woke and could not transmit, {} drained",
                failure.drained
            )
        }
        Answer::NotWoken {
            device, failure: None, ..
        } => write!(f, "device {device} did not hear its wake-up"),
        Answer::Final { ledgers, .. } => write!(f, "the ledgers of {} devices", ledgers.len()),
    }
}
