//! Barriers without a model, over zenoh and over unix sockets, with as many processes as the emulator uses: the
//! baselines of `bus`. `start_hosts` writes the arguments that `bench bare-host` in `cli/tools.rs` parses.

use std::io::{Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context;
use reveille_common::bus::Bus;

use super::barrier::{self, BareBarrier};
use crate::child_process::Children;
use crate::runtime::{CLIENT_WORKERS, SERVER_WORKERS, now, runtime};

/// Name of the run on the bus; the processes of one benchmark agree on it.
const RUN_NAME: &str = "bare";
/// Rounds before the measurement, in which links and threads reach their usual state.
const WARM_UP_ROUNDS: u32 = 20;

/// Sizes in bytes of the messages of a quiet TTI.
#[derive(Clone, Copy)]
pub(super) struct QuietTtiSizes {
    /// Size of a grant, BS → hosts.
    pub grant: usize,
    /// Size of an answer, host → BS.
    pub answer: usize,
}

/// Measures the rounds per second of a bare zenoh barrier over `hosts` processes.
pub(super) fn zenoh(hosts: u32, sizes: QuietTtiSizes, seconds: f64) -> anyhow::Result<f64> {
    let runtime = runtime(SERVER_WORKERS)?;
    runtime.block_on(async {
        // Without access rules: the baseline is zenoh alone.
        let bus = Bus::listen_open("tcp/127.0.0.1:0", RUN_NAME.parse()?).await?;
        let barrier = BareBarrier::new(&bus)?;
        let bs_alive = bus.declare_alive(bus.key_exprs().bs_liveliness())?;
        let children = start_hosts("zenoh", bus.endpoint(), hosts, sizes)?;
        let grant = vec![0; sizes.grant];
        // A host declares its liveliness token after it has subscribed: once all are seen, no grant is lost.
        let started = now();
        while bus.count_alive_hosts(Duration::from_secs(10)).await? < hosts {
            anyhow::ensure!(
                started.elapsed() < Duration::from_mins(1),
                "the hosts of the bare barrier did not join within a minute"
            );
        }
        let rate = measure_rate(seconds, || barrier.round(&grant, hosts as usize))?;
        // The hosts watch the liveliness token of the base station and leave when it disappears.
        drop(bs_alive);
        children.wait();
        Ok(rate)
    })
}

/// Measures the rounds per second of a barrier over `hosts` unix sockets.
pub(super) fn unix(hosts: u32, sizes: QuietTtiSizes, seconds: f64) -> anyhow::Result<f64> {
    let path = std::env::temp_dir().join(format!("reveille-bench-{}.sock", std::process::id()));
    // A killed benchmark with the same pid may have left a socket here, which `bind` refuses to replace.
    let _stale = std::fs::remove_file(&path);
    let listener = UnixListener::bind(&path).with_context(|| format!("cannot listen on {}", path.display()))?;
    let children = start_hosts("unix", &path.display().to_string(), hosts, sizes)?;
    let mut links = (0..hosts)
        .map(|_| listener.accept().map(|(link, _)| link))
        .collect::<std::io::Result<Vec<UnixStream>>>()?;
    let (grant, mut answer) = (vec![0; sizes.grant], vec![0; sizes.answer]);
    let rate = measure_rate(seconds, || {
        // All grants go out before the first answer is read: the hosts must work at the same time, as in the emulator.
        for link in &mut links {
            link.write_all(&grant)?;
        }
        for link in &mut links {
            link.read_exact(&mut answer)?;
        }
        Ok(())
    })?;
    // A host leaves when its link is closed.
    drop(links);
    children.wait();
    std::fs::remove_file(&path)?;
    Ok(rate)
}

/// Runs host `number` in its own process. `kind` is `zenoh`, or anything else for `unix`; the pair has the fields of
/// [`QuietTtiSizes`], in bytes.
pub(super) fn host(
    kind: &str,
    endpoint: &str,
    (grant_size, answer_size): (usize, usize),
    number: u32,
) -> anyhow::Result<ExitCode> {
    if kind == "zenoh" {
        runtime(CLIENT_WORKERS)?.block_on(async {
            let bus = Bus::connect(endpoint, RUN_NAME.parse()?, Duration::from_secs(30)).await?;
            barrier::host(&bus, number, answer_size).await?;
            bus.close().await;
            anyhow::Ok(())
        })?;
    } else {
        let mut link = UnixStream::connect(endpoint)?;
        let (mut grant, answer) = (vec![0; grant_size], vec![0; answer_size]);
        while link.read_exact(&mut grant).is_ok() && link.write_all(&answer).is_ok() {}
    }
    Ok(ExitCode::SUCCESS)
}

/// Starts `hosts` processes that call [`host`].
fn start_hosts(kind: &str, endpoint: &str, hosts: u32, sizes: QuietTtiSizes) -> anyhow::Result<Children> {
    let (sizes, parent) = (
        format!("{},{}", sizes.grant, sizes.answer),
        std::process::id().to_string(),
    );
    Children::spawn((0..hosts).map(|number| {
        [
            "bench",
            "bare-host",
            kind,
            endpoint,
            &sizes,
            &number.to_string(),
            &parent,
        ]
        .map(str::to_owned)
        .to_vec()
    }))
}

/// Returns the rounds per second over at least `seconds`, after the warm-up.
fn measure_rate(seconds: f64, mut round: impl FnMut() -> anyhow::Result<()>) -> anyhow::Result<f64> {
    for _ in 0..WARM_UP_ROUNDS {
        round()?;
    }
    let (started, mut rounds) = (now(), 0_u32);
    while started.elapsed().as_secs_f64() < seconds {
        round()?;
        rounds += 1;
    }
    Ok(f64::from(rounds) / started.elapsed().as_secs_f64())
}
