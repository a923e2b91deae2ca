//! Liveliness tokens of base stations and hosts. A token disappears with its session: the BS detects lost hosts by it,
//! hosts a lost BS, and clients find the runs of an endpoint. [`crate::keys`] defines the keys of tokens.

use std::pin::Pin;
use std::time::Duration;

use zenoh::Wait;
use zenoh::liveliness::LivelinessToken;
use zenoh::sample::{Sample, SampleKind};

use super::{Bus, BusError, DeclarationGuard};
use crate::keys::KeyExprs;

/// A callback that receives each token that appears or disappears.
type TokenHandler = dyn Fn(&str, bool) + Send + Sync;
type TokensFuture<'b> = Pin<Box<dyn Future<Output = Result<Vec<Option<String>>, BusError>> + Send + 'b>>;

impl Bus {
    /// Declares a liveliness token, which disappears when the guard is dropped or the session is lost.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn declare_alive(&self, key: String) -> Result<DeclarationGuard, BusError> {
        let token: LivelinessToken = self.session.liveliness().declare_token(key).wait()?;
        Ok(DeclarationGuard::new(token))
    }

    /// Calls `handle` with the key of each token that matches `key`, at first of those that exist; the flag is true if
    /// the token appeared. The callback must not block.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub fn watch_alive<F>(&self, key: String, handle: F) -> Result<DeclarationGuard, BusError>
    where
        F: Fn(&str, bool) + Send + Sync + 'static,
    {
        self.watch_alive_boxed(key, Box::new(handle))
    }

    /// Watches tokens with a boxed callback. Not generic, so zenoh's code is compiled only once, in this crate.
    fn watch_alive_boxed(&self, key: String, handle: Box<TokenHandler>) -> Result<DeclarationGuard, BusError> {
        let on_sample = move |sample: Sample| handle(sample.key_expr().as_str(), sample.kind() == SampleKind::Put);
        Ok(DeclarationGuard::new(
            self.session
                .liveliness()
                .declare_subscriber(key)
                // Without the history, tokens that exist already would not be reported.
                .history(true)
                .callback(on_sample)
                .wait()?,
        ))
    }

    /// Returns the sorted names of the runs whose BS this session can reach, found within `patience`.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub async fn list_runs(&self, patience: Duration) -> Result<Vec<String>, BusError> {
        let tokens = self
            .query_tokens(KeyExprs::all_bs_liveliness().to_owned(), patience)
            .await?;
        // In `KeyExprs::all_bs_liveliness` the second segment is the name of the run.
        let name = |key: &String| key.split('/').nth(1).map(str::to_owned);
        let mut runs: Vec<String> = tokens.iter().flatten().filter_map(name).collect();
        runs.sort();
        Ok(runs)
    }

    /// Returns the number of this run's live hosts that this session can reach, found within `patience`.
    ///
    /// # Errors
    /// If zenoh refuses.
    pub async fn count_alive_hosts(&self, patience: Duration) -> Result<u32, BusError> {
        let tokens = self
            .query_tokens(self.key_exprs.all_host_liveliness(), patience)
            .await?;
        Ok(tokens.iter().flatten().count() as u32)
    }

    /// Queries the tokens that match `key`; an error reply becomes `None`. Boxed, so zenoh's code is compiled only
    /// here.
    fn query_tokens(&self, key: String, patience: Duration) -> TokensFuture<'_> {
        Box::pin(async move {
            let replies = self.session.liveliness().get(key).timeout(patience).await?;
            let mut tokens = Vec::new();
            while let Ok(reply) = replies.recv_async().await {
                let sample = reply.result().ok();
                tokens.push(sample.map(|sample| sample.key_expr().as_str().to_owned()));
            }
            Ok(tokens)
        })
    }

    /// Returns the error for a run that is not served here, with the names of the runs that are.
    pub async fn no_run_error(&self) -> BusError {
        // The names are only a hint. The error remains correct without them.
        let runs = self.list_runs(Duration::from_secs(1)).await.unwrap_or_default();
        let hint = if runs.is_empty() {
            "no run is served there".to_owned()
        } else {
            format!("runs there: {}", runs.join(", "))
        };
        BusError::RunNotFound {
            endpoint: self.endpoint.to_string(),
            run: self.key_exprs.run().clone(),
            hint,
        }
    }
}
