//! `reveille router`: forwards the messages of a run between networks. `common/src/bus/router.rs` has the session, and
//! `common/src/bus/access.rs` the rules. A router keeps no state: it asks the base station for the secret of the run,
//! and opens another session if the base station was started again. Tests wait for the note `connected to run`.

use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, bail};
use reveille_common::bus::{Bus, BusError, Endpoint, Role, TlsFiles, Upstream, draw_nonce};
use reveille_common::message::{HostOffer, JoinReply, JoinRequest};
use reveille_common::secret::Secret;
use tokio::sync::watch;

use super::device::process_name;
use crate::cli::RouterArgs;
use crate::display::note;
use crate::exit::ExitReason;
use crate::signals::{SignalMode, Signals};
use crate::{file_limits, key, runtime, tls};

/// Time of an attempt to reach the base station, and pause before the next one.
const ATTEMPT_TIMEOUT: Duration = Duration::from_secs(2);
const ATTEMPT_PAUSE: Duration = Duration::from_secs(1);
/// Time for the link to return while the base station answers other sessions; then the router opens another session.
const LINK_PATIENCE: Duration = Duration::from_secs(5);

/// Forwards messages until Ctrl-C.
pub(crate) async fn run(args: &RouterArgs) -> anyhow::Result<ExitCode> {
    let tls_files = tls::files_of_role(args.tls.as_deref(), &[Role::Router])?;
    let signals = Signals::install(SignalMode::HasNoResults)?;
    file_limits::ensure_for_station(1)?;
    let run_key = args.key_file.as_deref().map(key::read).transpose()?;
    let endpoint = args.connect.clone();
    let router = Router {
        args,
        tls_files,
        run_key,
        name: tokio::task::spawn_blocking(move || process_name(&endpoint)).await?,
    };
    match signals.unless_interrupted(Box::pin(router.forward())).await {
        Some(Err(error)) => Err(error),
        // The usual end is a signal.
        Some(Ok(())) | None => Ok(ExitReason::Done.into()),
    }
}

struct Router<'a> {
    args: &'a RouterArgs,
    tls_files: Option<TlsFiles>,
    run_key: Option<Secret>,
    /// Name of this process, for the log of the base station.
    name: String,
}

impl Router<'_> {
    fn endpoint<'e>(&'e self, address: &'e str) -> Endpoint<'e> {
        Endpoint {
            address,
            tls: self.tls_files.as_ref(),
        }
    }

    /// Forwards messages for ever.
    async fn forward(&self) -> anyhow::Result<()> {
        let RouterArgs {
            listen, connect, run, ..
        } = self.args;
        let (listen, connect) = (self.endpoint(listen), self.endpoint(connect));
        loop {
            let upstream = self.wait_for_upstream().await?;
            let bus = Bus::route(listen, connect, run.clone(), &upstream).await?;
            let (alive_sender, mut is_bs_alive) = watch::channel(false);
            let watched = bus.watch_alive(bus.key_exprs().bs_liveliness(), move |_, is_alive| {
                alive_sender.send_replace(is_alive);
            })?;
            self.serve(&upstream, bus.endpoint(), &mut is_bs_alive).await?;
            drop(watched);
            bus.close().await;
        }
    }

    /// Returns when the session needs to be opened again.
    async fn serve(
        &self,
        upstream: &Upstream,
        endpoint: &str,
        is_bs_alive: &mut watch::Receiver<bool>,
    ) -> anyhow::Result<()> {
        let RouterArgs { connect, run, .. } = self.args;
        let mut has_connected = false;
        loop {
            let lost_at = runtime::now();
            let mut answered_at = None;
            while !*is_bs_alive.borrow_and_update() {
                let probe = async {
                    tokio::time::sleep(ATTEMPT_PAUSE).await;
                    self.ask_base_station().await
                };
                let found = tokio::select! {
                    _sender_lives = is_bs_alive.changed() => continue,
                    found = probe => found?,
                };
                let Some(found) = found else { continue };
                let waited = answered_at.get_or_insert_with(runtime::now).elapsed();
                if found != *upstream || waited > LINK_PATIENCE {
                    tracing::warn!("the base station of run {run} was started again; opening the links again");
                    return Ok(());
                }
            }
            if has_connected {
                let seconds = lost_at.elapsed().as_secs_f64();
                note!("reconnected to run {run} at {connect} after {seconds:.1} s");
            } else {
                note!("connected to run {run} at {connect}; listening on {endpoint}");
                has_connected = true;
            }
            let _sender_lives = is_bs_alive.wait_for(|is_alive| !is_alive).await.is_ok();
            tracing::warn!(
                "lost the base station of run {run} at {connect}: its process ended or the link broke; retrying"
            );
        }
    }

    /// Waits for the base station without a limit.
    async fn wait_for_upstream(&self) -> anyhow::Result<Upstream> {
        let RouterArgs { connect, run, .. } = self.args;
        let mut has_warned = false;
        loop {
            if let Some(upstream) = self.ask_base_station().await? {
                return Ok(upstream);
            }
            if !has_warned {
                has_warned = true;
                tracing::warn!("no base station of run {run} answers at {connect} yet; retrying");
            }
            tokio::time::sleep(ATTEMPT_PAUSE).await;
        }
    }

    /// Asks the base station for the secret of the run; `None` if it does not answer.
    async fn ask_base_station(&self) -> anyhow::Result<Option<Upstream>> {
        let RouterArgs { connect, run, .. } = self.args;
        let bus = match Bus::connect(self.endpoint(connect), run.clone(), ATTEMPT_TIMEOUT).await {
            Ok(bus) => bus,
            Err(BusError::Connect { .. } | BusError::ConnectTls { .. } | BusError::ConnectFailed(..)) => {
                return Ok(None);
            }
            Err(error) => return Err(error.into()),
        };
        let request = JoinRequest {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            offer: HostOffer::Nothing,
            nonce: draw_nonce()?,
            name: self.name.clone(),
        };
        let reply = bus.query_until(&request, self.run_key, ATTEMPT_TIMEOUT).await;
        let session_id = bus.upstream_id().await;
        bus.close().await;
        let reply = match reply {
            Err(error @ BusError::Refused(_)) => return Err(error).context(format!("run {run} at {connect}")),
            Err(error) => {
                tracing::debug!(%error, "the link broke during the query");
                return Ok(None);
            }
            Ok(reply) => reply,
        };
        let reply = match reply {
            Some(JoinReply::Routes(secret)) => session_id.map(|session_id| Upstream { secret, session_id }),
            Some(JoinReply::Refused(why)) => bail!("the base station refused: {why}"),
            Some(JoinReply::Welcome(_) | JoinReply::AwaitShare | JoinReply::Retry(_)) => {
                bail!("the base station answered a router like a device process, which is a bug")
            }
            None => None,
        };
        Ok(reply)
    }
}
