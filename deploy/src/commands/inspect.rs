//! `reveille inspect tail`: the messages of a run, decoded, as they go.

use std::io::Write;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use reveille_common::bus::Bus;
use reveille_common::codec;
use reveille_common::keys::{self, Kind};
use reveille_common::message::{
    Answer, Clock, ClockCommand, JoinRequest, PlanUpdate, Ready, Report, TapBatch, TapFrame, WakeUp,
};
use serde::Serialize;
use serde_json::{Value, json};

use crate::cli::{InspectCommand, PlaneArg, TailArgs};
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
    let left_out = AtomicU64::new(0);
    let mut expected = None;
    let mut printed = 0;
    loop {
        tokio::select! {
            batch = batches.recv() => {
                let Some(TapBatch { first, frames }) = batch else { break };
                left_out.fetch_add(first.saturating_sub(expected.unwrap_or(first)), Ordering::Relaxed);
                expected = Some(first + frames.len() as u64);
                if !print(args, &frames, &mut printed) {
                    break;
                }
            }
            () = ended.notified() => break,
            _ = tokio::signal::ctrl_c() => break,
        }
    }
    eprintln!(
        "{printed} messages shown, {} left out because this could not keep up",
        left_out.into_inner()
    );
    bus.close().await;
    Ok(ExitCode::SUCCESS)
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
    let plane = kind.plane().name();
    let wanted_plane = args
        .plane
        .is_none_or(|p| plane == if p == PlaneArg::Air { "air" } else { "emu" });
    if !wanted_plane || !(args.kind.is_empty() || args.kind.contains(&kind)) {
        return None;
    }
    let message = decode(kind, &frame.payload);
    if args
        .device
        .is_some_and(|device| !concerns(kind, number, &message, device))
    {
        return None;
    }
    let (tti, bytes, name) = (frame.tti, frame.payload.len(), kind.name());
    Some(if args.json {
        json!({ "tti": tti.0, "plane": plane, "kind": name, "number": number, "bytes": bytes, "message": message })
            .to_string()
    } else {
        let number = number.map(|n| n.to_string()).unwrap_or_default();
        format!(
            "{tti:>8} {plane} {name:<7} {number:>5} {bytes:>6} B  {}",
            brief(&message)
        )
    })
}

/// Whether a message is to or from `device`.
fn concerns(kind: Kind, number: Option<u32>, message: &Value, device: u32) -> bool {
    match kind {
        Kind::Wake | Kind::Report => number == Some(device),
        Kind::Plan => true,
        Kind::Answer => message.get("NotWoken").and_then(|m| m.get("device")) == Some(&json!(device)),
        Kind::Clock | Kind::Join | Kind::Ready | Kind::Control => false,
    }
}

fn decode(kind: Kind, payload: &[u8]) -> Value {
    fn read<T: Serialize + serde::de::DeserializeOwned>(payload: &[u8]) -> Value {
        match codec::decode::<T>(payload) {
            Ok(message) => serde_json::to_value(message).unwrap_or_else(|e| json!({ "unprintable": e.to_string() })),
            Err(error) => json!({ "malformed": error.to_string() }),
        }
    }
    match kind {
        Kind::Plan => read::<PlanUpdate>(payload),
        Kind::Wake => read::<WakeUp>(payload),
        Kind::Report => read::<Report>(payload),
        Kind::Clock => read::<Clock>(payload),
        Kind::Answer => read::<Answer>(payload),
        Kind::Join => read::<JoinRequest>(payload),
        Kind::Ready => read::<Ready>(payload),
        Kind::Control => read::<ClockCommand>(payload),
    }
}

/// A message in one short line.
fn brief(message: &Value) -> String {
    const LONGEST: usize = 160;
    let text = message.to_string().replace('"', "");
    match text.char_indices().nth(LONGEST) {
        Some((end, _)) => format!("{}… ({} characters)", &text[..end], text.len()),
        None => text,
    }
}
