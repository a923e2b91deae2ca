//! Sessions of routers, which connect a network of device processes to the BS. A router forwards the messages of the
//! run under the rules of `access`, and takes no part in the run. To know the keys of the run it needs the run's
//! secret, which it receives like a host (`HostOffer::Nothing`).

use super::session::{CONNECT_RETRY, open_listening, session_config, set_option, set_tls};
use super::{Bus, BusError, Endpoint, access};
use crate::keys::{KeyExprs, RunName};
use crate::secret::Secret;

/// The facts about the link towards the BS that a router needs before it opens its session.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Upstream {
    /// The secret of the run's members, from the BS.
    pub secret: Secret,
    /// zenoh's id of the session at the other end of the link: the BS, or another router.
    pub session_id: String,
}

impl Bus {
    /// Returns zenoh's id of the session to which this client is connected; `None` while it is not connected.
    pub async fn upstream_id(&self) -> Option<String> {
        self.session.info().routers_zid().await.next().map(|id| id.to_string())
    }

    /// Opens the session of a router for `run`, which listens on `listen` and connects to `connect`. It reconnects for
    /// as long as it exists.
    ///
    /// # Errors
    /// If an endpoint is invalid, or `listen` is in use.
    pub async fn route(
        listen: Endpoint<'_>,
        connect: Endpoint<'_>,
        run: RunName,
        upstream: &Upstream,
    ) -> Result<Self, BusError> {
        connect.parse()?;
        let keys = KeyExprs::for_members(run, upstream.secret);
        let rules = access::access_config(&keys, listen.tls.is_some(), Some(&upstream.session_id));
        let mut config = session_config("router", 1)?;
        set_tls(&mut config, listen, true)?;
        set_tls(&mut config, connect, false)?;
        let connect_list = format!("[{:?}]", connect.address);
        let settings = [
            ("listen/exit_on_failure", "true"),
            ("connect/endpoints", &*connect_list),
            ("connect/exit_on_failure", "false"),
            // Without end and in the background: with a limit, zenoh tries only once.
            ("connect/timeout_ms", "-1"),
            ("connect/retry", CONNECT_RETRY),
            ("access_control", &*rules),
        ];
        for (key, value) in access::PEER_LIMITS.iter().chain(&settings) {
            set_option(&mut config, key, value)?;
        }
        let (endpoint, session) = open_listening(config, listen).await?;
        Ok(Self::new(session, keys, &endpoint))
    }
}
