//! `reveille inspect tail`: the messages of a run, decoded, as they go.

use std::io::Write;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use reveille_common::bus::Bus;
use reveille_common::ids::DeviceId;
use reveille_common::keys;
use reveille_common::message::{Addressee, ClockCommand, Message, Plane, TapBatch, TapFrame};
use serde_json::json;

use crate::cli::{InspectCommand, TailArgs};
use crate::display::note;
use crate::exit::Exit;
use crate::local;

const PATIENCE: Duration = Duration::from_secs(5);

/// Follows a run.
pub async fn run(command: &InspectCommand) -> anyhow::Result<ExitCode> {
    match command {
        InspectCommand::Tail(args) => tail(args).await,
    }
}

async fn tail(args: &TailArgs) -> anyhow::Result<ExitCode> {
    check(args)?;
    let (endpoint, run) = local::find(&args.target)?;
    let bus = Bus::connect(&endpoint, run, PATIENCE).await?;
    if !bus.runs(PATIENCE).await?.contains(&bus.keys().run().to_string()) {
        return Err(bus.no_run().await.into());
    }
    greet(args, &bus).await?;
    let (send, mut batches) = tokio::sync::mpsc::unbounded_channel();
    let ended = Arc::new(tokio::sync::Notify::new());
    let bell = Arc::clone(&ended);
    let _watch = bus.watch_alive(bus.keys().bs_alive(), move |_, alive| {
        if !alive {
            bell.notify_one();
        }
    })?;
    let _tap = bus.observe(move |batch| {
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
    note!("{printed} messages shown, {left_out} left out because this could not keep up");
    bus.close().await;
    Ok(Exit::Done.into())
}

/// Refuses filters that together let nothing through.
fn check(args: &TailArgs) -> anyhow::Result<()> {
    let Some(plane) = args.plane.map(Plane::from) else {
        return Ok(());
    };
    for kind in &args.kind {
        anyhow::ensure!(
            kind.plane() == plane,
            "--plane {} leaves nothing of --kind {}, which travels on the plane {}",
            plane.name(),
            kind.name(),
            kind.plane().name()
        );
    }
    Ok(())
}

/// Says where the run is: of a paused run nothing else may come for long.
async fn greet(args: &TailArgs, bus: &Bus) -> anyhow::Result<()> {
    let run = bus.keys().run();
    let Some(status) = bus.ask(&ClockCommand::Status, PATIENCE).await? else {
        return Err(bus.no_run().await.into());
    };
    let devices = status.devices;
    if let Some(device) = args.device {
        anyhow::ensure!(
            device < devices,
            "--device {device}: run {run} has {devices} devices, 0 to {}",
            devices.saturating_sub(1)
        );
    }
    note!("connected to run {run}: {status}");
    Ok(())
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
    let message = Message::decode(kind, &frame.payload);
    if let Some(device) = args.device.map(DeviceId)
        && !message.as_ref().is_ok_and(|message| message.concerns(number, device))
    {
        return None;
    }
    let (tti, bytes) = (frame.tti, frame.payload.len());
    Some(if args.json {
        let message = match message {
            Ok(message) => json!(message),
            Err(error) => json!({ "malformed": error.to_string() }),
        };
        let (plane, kind) = (plane.name(), kind.name());
        let line =
            json!({ "tti": tti.0, "plane": plane, "kind": kind, "number": number, "bytes": bytes, "message": message });
        line.to_string()
    } else {
        let message = message.map_or_else(|error| format!("not a message: {error}"), |message| message.to_string());
        let (plane, name, whose) = (plane.name(), kind.name(), whose(kind.addressee(), number));
        format!("{tti:>8} {plane} {name:<7} {whose:<11} {bytes:>6} B  {message}")
    })
}

/// Whose number it is that the key has, such as `device 7`.
fn whose(addressee: Addressee, number: Option<u32>) -> String {
    number.map_or_else(String::new, |number| format!("{} {number}", addressee.name()))
}
