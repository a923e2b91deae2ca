//! `reveille link`: a relay between two TCP endpoints that delays and loses data like a slow link, without privileges
//! of the kernel. It passes any protocol over TCP, TLS included. `docs/testbeds.md` explains the model.

use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, anyhow};
use reveille_common::rng::{Purpose, Stream};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc::channel;

use crate::cli::LinkArgs;
use crate::display::note;
use crate::exit::ExitReason;
use crate::signals::{SignalMode, Signals};

/// Largest payload of a TCP segment on Ethernet, bytes.
const SEGMENT_BYTES: usize = 1448;
/// The retransmission timeout of Linux for round trips of up to about 100 ms.
const RETRANSMISSION_TIMEOUT: Duration = Duration::from_millis(200);
/// Most segments on the way in one direction: 6 MB.
const MAX_SEGMENTS: usize = 4096;

/// One direction of a connection over an impaired link. Times count from any fixed instant.
struct Direction {
    delay: Duration,
    /// Probability that a segment is lost, at most 0.5.
    loss: f64,
    stream: Stream,
    /// The latest arrival so far.
    last_arrival: Duration,
}

impl Direction {
    /// Creates direction `index` of a link with the seed, the delay and the loss of `args`.
    fn new(args: &LinkArgs, index: u64) -> Self {
        Self {
            delay: args.delay.unwrap_or_default(),
            loss: args.loss,
            stream: Stream::new(args.seed, Purpose::LinkLoss, index),
            last_arrival: Duration::ZERO,
        }
    }

    /// Returns the time at which TCP delivers a segment that is sent at `sent`. A lost segment is sent again after a
    /// timeout, which doubles; later segments wait for it, because TCP delivers in order.
    fn arrival(&mut self, sent: Duration) -> Duration {
        let (mut arrival, mut timeout) = (sent + self.delay, RETRANSMISSION_TIMEOUT);
        while self.stream.unit() < self.loss {
            arrival += timeout;
            timeout *= 2;
        }
        self.last_arrival = self.last_arrival.max(arrival);
        self.last_arrival
    }
}

/// Relays connections until a signal.
pub(crate) async fn run(args: &LinkArgs) -> anyhow::Result<ExitCode> {
    let signals = Signals::install(SignalMode::HasNoResults)?;
    let target = parse_endpoint("--connect", &args.connect)?;
    let listener = TcpListener::bind(parse_endpoint("--listen", &args.listen)?).await;
    let listener = listener.with_context(|| format!("--listen {}: cannot listen", args.listen))?;
    note!("relaying tcp/{} to {}", listener.local_addr()?, args.connect);
    let relay_all = async {
        for connection in 0.. {
            let (near, client) = listener.accept().await.context("cannot accept a connection")?;
            let directions = [2 * connection, 2 * connection + 1].map(|index| Direction::new(args, index));
            let target = target.to_owned();
            tokio::spawn(async move {
                // The name is resolved for each connection, so that a target with a new address is found.
                match TcpStream::connect(&target).await {
                    Ok(far) => relay(near, far, directions).await,
                    Err(error) => tracing::warn!("{client}: cannot connect to tcp/{target}: {error}"),
                }
            });
        }
        anyhow::Ok(())
    };
    // Ends at a signal, or with an error.
    signals.unless_interrupted(relay_all).await.unwrap_or(Ok(()))?;
    Ok(ExitReason::Done.into())
}

/// Returns the address of a TCP endpoint.
fn parse_endpoint<'a>(option: &str, endpoint: &'a str) -> anyhow::Result<&'a str> {
    endpoint
        .strip_prefix("tcp/")
        .ok_or_else(|| anyhow!("{option} {endpoint}: not a TCP endpoint; use tcp/ADDRESS:PORT"))
}

/// Relays both directions until one of them ends. The bus closes a connection as a whole, so the other one then has no
/// receiver.
async fn relay(near: TcpStream, far: TcpStream, [forth, back]: [Direction; 2]) {
    // Without this option the kernel would hold small segments back.
    let _is_slower = near.set_nodelay(true).is_err() || far.set_nodelay(true).is_err();
    let ((near_reader, near_writer), (far_reader, far_writer)) = (near.into_split(), far.into_split());
    // A broken connection is an ordinary end, which both sides notice.
    let _is_broken = tokio::select! {
        end = pump(near_reader, far_writer, forth) => end.is_err(),
        end = pump(far_reader, near_writer, back) => end.is_err(),
    };
}

/// Passes the data of `reader` to `writer` over one direction of the link.
async fn pump(
    mut reader: impl AsyncRead + Unpin,
    mut writer: impl AsyncWrite + Unpin,
    mut direction: Direction,
) -> std::io::Result<()> {
    let started = crate::runtime::now();
    let (sender, mut segments) = channel(MAX_SEGMENTS);
    let read_all = async move {
        let mut buffer = [0; SEGMENT_BYTES];
        loop {
            let length = reader.read(&mut buffer).await?;
            let arrival = direction.arrival(started.elapsed());
            if length == 0 || sender.send((arrival, buffer[..length].to_vec())).await.is_err() {
                // The drop of `sender` ends the other half.
                return Ok(());
            }
        }
    };
    let write_all = async move {
        while let Some((arrival, segment)) = segments.recv().await {
            tokio::time::sleep_until((started + arrival).into()).await;
            writer.write_all(&segment).await?;
        }
        writer.shutdown().await
    };
    tokio::try_join!(read_all, write_all).map(|_| ())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn direction(delay_ms: u64, loss: f64, index: u64) -> Direction {
        let args = LinkArgs {
            listen: String::new(),
            connect: String::new(),
            delay: Some(Duration::from_millis(delay_ms)),
            loss,
            seed: 1,
        };
        Direction::new(&args, index)
    }

    /// A second way to the same arrivals: each segment is sent until an attempt succeeds, and delivery is the latest
    /// arrival of it and all before it.
    fn reference_arrivals(sent_ms: &[u64], delay_ms: u64, loss: f64, index: u64) -> Vec<u64> {
        let mut stream = Stream::new(1, Purpose::LinkLoss, index);
        let arrivals: Vec<u64> = sent_ms
            .iter()
            .map(|sent| {
                let attempts = 1 + std::iter::repeat_with(|| stream.unit())
                    .take_while(|draw| *draw < loss)
                    .count();
                // 200 + 400 + … = 200 (2ⁿ − 1).
                sent + delay_ms + 200 * ((1 << (attempts - 1)) - 1)
            })
            .collect();
        (1..=arrivals.len())
            .map(|count| *arrivals[..count].iter().max().expect("a segment"))
            .collect()
    }

    #[test]
    fn each_segment_arrives_after_the_delay_and_its_losses_in_order() {
        let sent_ms: Vec<u64> = (0..2000).map(|k| 7 * k).collect();
        for (delay_ms, loss) in [(20, 0.0), (20, 0.05), (0, 0.3), (350, 0.5)] {
            for index in 0..2 {
                let mut direction = direction(delay_ms, loss, index);
                let arrivals: Vec<u64> = sent_ms
                    .iter()
                    .map(|sent| direction.arrival(Duration::from_millis(*sent)).as_millis() as u64)
                    .collect();
                assert_eq!(
                    arrivals,
                    reference_arrivals(&sent_ms, delay_ms, loss, index),
                    "{delay_ms} ms, {loss}"
                );
            }
        }
    }

    #[test]
    fn segments_are_lost_at_the_given_rate() {
        let (count, loss) = (100_000_u64, 0.01);
        let mut direction = direction(20, loss, 0);
        // A second apart, so that no segment waits for another.
        let late = (0..count).filter(|k| {
            direction.arrival(Duration::from_secs(*k)) > Duration::from_secs(*k) + Duration::from_millis(20)
        });
        let late = late.count() as f64;
        // Six standard deviations of a binomial count: √(100 000 · 0.01 · 0.99) = 31.
        assert!((late - 1000.0).abs() < 190.0, "{late} of {count}");
    }

    #[test]
    fn other_directions_lose_other_segments() {
        let arrivals = |index| {
            let mut direction = direction(20, 0.3, index);
            (0..50)
                .map(|k| direction.arrival(Duration::from_secs(k)))
                .collect::<Vec<_>>()
        };
        assert_eq!(arrivals(0), arrivals(0));
        assert_ne!(arrivals(0), arrivals(1));
    }

    #[test]
    fn only_tcp_endpoints_are_accepted() {
        assert_eq!(
            parse_endpoint("--listen", "tcp/0.0.0.0:7447").ok(),
            Some("0.0.0.0:7447")
        );
        let refusal = parse_endpoint("--connect", "tls/bs:7447")
            .expect_err("no TCP")
            .to_string();
        assert_eq!(
            refusal,
            "--connect tls/bs:7447: not a TCP endpoint; use tcp/ADDRESS:PORT"
        );
    }
}
